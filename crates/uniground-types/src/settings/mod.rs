//! Parse settings and the choice of models. Together with the scan they determine the result of a
//! parse.
//!
//! Every number of stage 1 is a field with its default, its unit and, if stated, the paper's value.

mod import;
mod instances;
mod masks;
mod merging;
mod neural;
mod parsing;
mod superpoints;

pub use import::{FusionSettings, ImportSettings, LevellingChoice, check_metres_per_unit};
pub use instances::{FrameSamplingSettings, InstanceSettings, ViewSettings};
pub use masks::{MaskOrder, RgbdSettings, SamPrompts, SamSettings};
pub use merging::{MergeSettings, Normalisation, PartMergingSettings};
pub use neural::{AppearanceSettings, CorrectionSettings};
pub use parsing::ParsingSettings;
pub use superpoints::SuperpointSettings;

use crate::problem::FieldError;
use serde::{Deserialize, Serialize};

/// Parse settings. Together with the scan they determine the result.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(deny_unknown_fields, default)]
pub struct ParseSettings {
    /// Import settings.
    pub import: ImportSettings,
    /// Settings of stage 1, which segments the cloud into instances.
    pub parsing: ParsingSettings,
    /// Choice of models.
    pub models: ModelChoice,
}

/// Choice of the server's models.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(deny_unknown_fields, default)]
pub struct ModelChoice {
    /// Component that segments pictures and corrects the outlines of instances.
    pub masks: PartChoice,
    /// Encoder that compares pictures and words.
    pub encoder: PartChoice,
    /// Whether built-in components replace a model that fails. The report then records it. If
    /// `false`, the parse fails.
    pub allow_builtin: bool,
}

/// Choice of a component.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(rename_all = "snake_case")]
pub enum PartChoice {
    /// The configured one of the server.
    #[default]
    Configured,
    /// The built-in one, without a model.
    Builtin,
}

/// Preset of settings. Given settings override its values.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(rename_all = "snake_case")]
pub enum ParsePreset {
    /// Best accuracy over several rooms.
    #[default]
    Default,
    /// The values of the paper.
    Paper,
}

/// Models of a parse, each with name and version.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct ParseModels {
    /// Component that segmented the pictures: a model as `name@fingerprint`, or a built-in
    /// component like `rgbd-2`.
    pub masks: String,
    /// Encoder of the instances: a model as `name@fingerprint`, or a built-in component like
    /// `attributes-2`.
    pub encoder: String,
}

impl ParseSettings {
    /// Returns a preset with `overrides`, a partial settings object, applied.
    ///
    /// # Errors
    /// Returns a [`FieldError`] with a JSON pointer below `/settings`.
    pub fn from_request(
        preset: ParsePreset,
        overrides: Option<serde_json::Value>,
    ) -> Result<Self, FieldError> {
        let base = match preset {
            ParsePreset::Default => Self::default(),
            ParsePreset::Paper => Self { parsing: ParsingSettings::paper(), ..Self::default() },
        };
        let unreadable = |error: serde_json::Error| FieldError::new("/settings", error.to_string());
        let mut merged = serde_json::to_value(base).map_err(unreadable)?;
        if let Some(mut overrides) = overrides {
            rename_deprecated_settings(&mut overrides);
            merge(&mut merged, overrides, "/settings")?;
        }
        let settings: Self = serde_path_to_error::deserialize(merged).map_err(|e| {
            let pointer = e.path().iter().map(|segment| format!("/{segment}")).collect::<String>();
            FieldError::new(format!("/settings{pointer}"), e.inner().to_string())
        })?;
        settings.check()?;
        Ok(settings)
    }

    fn check(&self) -> Result<(), FieldError> {
        let fusion = &self.import.fusion;
        for (pointer, fine, expected) in [
            ("/min_share_of_mean", (0.0..=1.0).contains(&fusion.min_share_of_mean), "0 to 1"),
            ("/voxel_m", (0.001..=1.0).contains(&fusion.voxel_m), "0.001 to 1 meters"),
            ("/truncation_voxels", (1.0..=20.0).contains(&fusion.truncation_voxels), "1 to 20"),
            ("/max_depth_m", fusion.max_depth_m.is_finite() && fusion.max_depth_m > 0.0, "above 0"),
            (
                "/silhouette_tolerance",
                fusion.silhouette_tolerance.is_finite() && fusion.silhouette_tolerance > 0.0,
                "above 0",
            ),
        ] {
            if !fine {
                return Err(FieldError::new(
                    format!("/settings/import/fusion{pointer}"),
                    format!("must be {expected}"),
                ));
            }
        }
        check_metres_per_unit("/settings/import/metres_per_unit", self.import.metres_per_unit)?;
        self.parsing.check().map_err(|(pointer, expected)| {
            FieldError::new(format!("/settings/parsing{pointer}"), format!("must be {expected}"))
        })
    }
}

/// Renamed settings: parent, old name, new name.
const RENAMED: [(&str, &str, &str); 1] = [("/parsing", "wholes", "part_merging")];

/// Renames old settings to their current names, in complete or partial settings.
pub fn rename_deprecated_settings(settings: &mut serde_json::Value) {
    for (place, old, new) in RENAMED {
        let Some(object) = settings.pointer_mut(place).and_then(serde_json::Value::as_object_mut)
        else {
            continue;
        };
        if let Some(value) = object.remove(old) {
            object.entry(new).or_insert(value);
        }
    }
}

/// Merges `over` into `base` recursively. Lists are replaced as a whole.
fn merge(
    base: &mut serde_json::Value,
    over: serde_json::Value,
    pointer: &str,
) -> Result<(), FieldError> {
    match (base, over) {
        (serde_json::Value::Object(base), serde_json::Value::Object(over)) => {
            for (key, value) in over {
                let pointer = format!("{pointer}/{key}");
                merge(base.entry(key).or_insert(serde_json::Value::Null), value, &pointer)?;
            }
        }
        (serde_json::Value::Object(_), _) => {
            return Err(FieldError::new(pointer, "must be an object"));
        }
        (base, over) => *base = over,
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;
    use serde_json::json;

    #[test]
    fn single_values_override_the_preset() {
        let settings = ParseSettings::from_request(
            ParsePreset::Paper,
            Some(json!({"parsing": {"superpoints": {"seed_m": 0.5}}})),
        )
        .unwrap();
        assert_eq!(
            (settings.parsing.superpoints.seed_m, settings.parsing.superpoints.voxel_m),
            (0.5, 0.05)
        );
        assert_eq!(settings.parsing.depth_tolerance, 0.15);
    }

    #[test]
    fn errors_of_invalid_settings_have_a_json_pointer() {
        for (overrides, expected) in [
            (
                json!({"parsing": {"superpoints": {"voxel_m": -1}}}),
                "/settings/parsing/superpoints/voxel_m",
            ),
            (
                json!({"parsing": {"superpoints": {"voxel_m": "wide"}}}),
                "/settings/parsing/superpoints/voxel_m",
            ),
            (json!({"parsing": {"superpoint": {}}}), "/settings/parsing"),
            (json!({"import": {"fusion": {"voxel_m": 0}}}), "/settings/import/fusion/voxel_m"),
            (json!({"import": {"metres_per_unit": 0}}), "/settings/import/metres_per_unit"),
            // Becomes infinite as an `f32`.
            (
                json!({"parsing": {"superpoints": {"normal_weight": 1e300}}}),
                "/settings/parsing/superpoints/normal_weight",
            ),
            (json!(7), "/settings"),
            (json!([]), "/settings"),
            (json!({"parsing": {"superpoints": [0.05, 0.3]}}), "/settings/parsing/superpoints"),
        ] {
            let Err(FieldError { pointer, .. }) =
                ParseSettings::from_request(ParsePreset::Default, Some(overrides.clone()))
            else {
                panic!("{overrides} was accepted")
            };
            assert!(pointer.starts_with(expected), "{overrides}: {pointer}");
        }
    }

    #[test]
    fn deprecated_setting_names_are_accepted() {
        let settings = ParseSettings::from_request(
            ParsePreset::Default,
            Some(json!({"parsing": {"wholes": {"enabled": false}}})),
        )
        .unwrap();
        assert!(!settings.parsing.part_merging.enabled);
    }
}
