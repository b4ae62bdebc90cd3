//! What a parse depends on, beside the content: settings, the choice of models, and the hash of both.

use crate::error::Error;
use crate::ingest::ImportSettings;
use crate::models::attributes;
use crate::models::neural::{Models, Role};
use crate::scene_parsing::ParsingSettings;
use crate::scene_parsing::masks::MaskSource;
use crate::scene_parsing::masks::rgbd::RgbdMasks;
use serde::{Deserialize, Serialize};
use sha2::{Digest, Sha256};
use utoipa::ToSchema;

/// Raised when stage 1 changes what it computes: older parses are kept, but not taken for new ones.
pub(super) const STAGE_1_VERSION: u32 = 2;

/// Everything a parse depends on, beside the content.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize, ToSchema)]
#[serde(deny_unknown_fields, default)]
pub struct ParseSettings {
    pub import: ImportSettings,
    pub parsing: ParsingSettings,
    pub models: ModelChoice,
}

/// Which of the server's models take part.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
#[serde(deny_unknown_fields, default)]
pub struct ModelChoice {
    pub masks: PartChoice,
    pub encoder: PartChoice,
    /// Where a model fails the built-in parts do the work instead, and the report says so. Otherwise the parse fails.
    pub allow_builtin: bool,
}

#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
#[serde(rename_all = "snake_case")]
pub enum PartChoice {
    /// What the server was started with.
    #[default]
    Configured,
    /// The part that needs no model.
    Builtin,
}

impl ModelChoice {
    pub(super) const BUILTIN: Self = Self { masks: PartChoice::Builtin, encoder: PartChoice::Builtin, allow_builtin: false };

    /// The models that take part.
    pub(super) fn of(self, models: &Models) -> Models {
        models.only(self.masks == PartChoice::Configured, self.encoder == PartChoice::Configured)
    }
}

/// Where settings start from; given settings then replace single values.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize, ToSchema, clap::ValueEnum)]
#[serde(rename_all = "snake_case")]
pub enum ParsePreset {
    /// What measures best over several rooms.
    #[default]
    Default,
    /// Every value the paper states.
    Paper,
}

/// Models a parse was made with: name and version each.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
pub struct ParseModels {
    pub masks: String,
    pub encoder: String,
}

impl ParseModels {
    pub(super) fn of(models: &Models) -> Self {
        Self {
            masks: models.label(Role::Masks).unwrap_or_else(|| RgbdMasks::default().name().to_owned()),
            encoder: models.label(Role::Encoder).unwrap_or_else(|| attributes::NAME.to_owned()),
        }
    }
}

impl ParseSettings {
    /// A preset with single values replaced by `overrides`, a partial settings object.
    ///
    /// # Errors
    /// [`Error::Invalid`] with a JSON pointer below `/settings`.
    pub fn from_request(preset: ParsePreset, overrides: Option<serde_json::Value>) -> Result<Self, Error> {
        let base = match preset {
            ParsePreset::Default => Self::default(),
            ParsePreset::Paper => Self { parsing: ParsingSettings::paper(), ..Self::default() },
        };
        let mut merged = serde_json::to_value(base)?;
        if let Some(overrides) = overrides {
            merge(&mut merged, overrides, "/settings")?;
        }
        let settings: Self = serde_path_to_error::deserialize(merged).map_err(|e| {
            let pointer = e.path().iter().map(|segment| format!("/{segment}")).collect::<String>();
            Error::invalid(format!("/settings{pointer}"), e.inner().to_string())
        })?;
        settings.check()?;
        Ok(settings)
    }

    fn check(&self) -> Result<(), Error> {
        let fusion = &self.import.fusion;
        for (pointer, fine, expected) in [
            ("/min_share_of_mean", (0.0..=1.0).contains(&fusion.min_share_of_mean), "0 to 1"),
            ("/voxel_m", (0.001..=1.0).contains(&fusion.voxel_m), "0.001 to 1 metres"),
            ("/max_depth_m", fusion.max_depth_m.is_finite() && fusion.max_depth_m > 0.0, "above 0"),
            (
                "/silhouette_tolerance",
                fusion.silhouette_tolerance.is_finite() && fusion.silhouette_tolerance > 0.0,
                "above 0",
            ),
        ] {
            if !fine {
                return Err(Error::invalid(format!("/settings/import/fusion{pointer}"), format!("must be {expected}")));
            }
        }
        self.parsing
            .check()
            .map_err(|(pointer, expected)| Error::invalid(format!("/settings/parsing{pointer}"), format!("must be {expected}")))
    }

    /// Identifies settings and the code and models that read them.
    pub(super) fn hash(&self, models: &ParseModels) -> Result<String, Error> {
        let mut hasher = Sha256::new();
        hasher.update(serde_json::to_vec(&(STAGE_1_VERSION, models, self))?);
        Ok(hasher.finalize().iter().take(16).map(|byte| format!("{byte:02x}")).collect())
    }
}

/// Replaces values in `base` by those of `over`, object by object. A list is no object, though serde would take it for one.
fn merge(base: &mut serde_json::Value, over: serde_json::Value, pointer: &str) -> Result<(), Error> {
    match (base, over) {
        (serde_json::Value::Object(base), serde_json::Value::Object(over)) => {
            for (key, value) in over {
                let pointer = format!("{pointer}/{key}");
                merge(base.entry(key).or_insert(serde_json::Value::Null), value, &pointer)?;
            }
        }
        (serde_json::Value::Object(_), _) => return Err(Error::invalid(pointer, "must be an object")),
        (base, over) => *base = over,
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;
    use serde_json::json;

    #[test]
    fn single_values_replace_those_of_the_preset() {
        let settings = ParseSettings::from_request(ParsePreset::Paper, Some(json!({"parsing": {"superpoints": {"seed_m": 0.5}}}))).unwrap();
        assert_eq!((settings.parsing.superpoints.seed_m, settings.parsing.superpoints.voxel_m), (0.5, 0.05));
        assert_eq!(settings.parsing.depth_tolerance, 0.15);
    }

    #[test]
    fn wrong_settings_are_named_by_pointer() {
        for (overrides, expected) in [
            (json!({"parsing": {"superpoints": {"voxel_m": -1}}}), "/settings/parsing/superpoints/voxel_m"),
            (json!({"parsing": {"superpoints": {"voxel_m": "wide"}}}), "/settings/parsing/superpoints/voxel_m"),
            (json!({"parsing": {"superpoint": {}}}), "/settings/parsing"),
            (json!({"import": {"fusion": {"voxel_m": 0}}}), "/settings/import/fusion/voxel_m"),
            (json!(7), "/settings"),
            (json!([]), "/settings"),
            (json!({"parsing": {"superpoints": [0.05, 0.3]}}), "/settings/parsing/superpoints"),
        ] {
            let Err(Error::Invalid { pointer, .. }) = ParseSettings::from_request(ParsePreset::Default, Some(overrides.clone())) else {
                panic!("{overrides} was accepted")
            };
            assert!(pointer.starts_with(expected), "{overrides}: {pointer}");
        }
    }

    #[test]
    fn settings_and_models_make_the_hash() {
        let models = |encoder: &str| ParseModels { masks: "m".into(), encoder: encoder.into() };
        let (default, paper) = (ParseSettings::default(), ParseSettings::from_request(ParsePreset::Paper, None).unwrap());
        assert_eq!(default.hash(&models("a")).unwrap(), default.clone().hash(&models("a")).unwrap());
        assert_ne!(default.hash(&models("a")).unwrap(), paper.hash(&models("a")).unwrap());
        assert_ne!(default.hash(&models("a")).unwrap(), default.hash(&models("b")).unwrap());
    }
}
