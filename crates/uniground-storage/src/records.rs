//! Types of the JSON in rows. They belong to the store, so that changes of the API or the pipelines
//! cannot make stored data unreadable.
//!
//! Records are written in the current version, which the column `record_version` stores. Records of
//! any version are read: unknown fields are ignored, missing fields get a value that marks them as
//! unknown, and unreadable parts are omitted, so that their scene stays usable. If a field changes
//! its meaning, raise the version and check it when reading.

mod instance;
mod settings;

pub use instance::InstanceRecord;

use serde::de::DeserializeOwned;
use serde_json::Value;
use uniground_geometry::boxes::Aabb;
use uniground_geometry::scene::{ImportReport, ParseReport};
use uniground_types::settings::{ParseModels, ParseSettings};

/// Version of the records that this program writes.
pub const RECORD_VERSION: u32 = 1;

/// The settings and the results of a parse, as stored.
#[derive(Debug, Clone, PartialEq)]
pub struct ParseRecord {
    pub settings: ParseSettings,
    pub models: ParseModels,
    /// `None` if its version cannot be read.
    pub import: Option<ImportReport>,
    /// `None` if its version cannot be read.
    pub report: Option<ParseReport>,
    pub extent: Option<Aabb>,
}

impl ParseRecord {
    /// Reads the columns of a row.
    pub(super) fn read(
        settings: &str,
        models: &str,
        import: &str,
        report: &str,
        extent: &str,
    ) -> Self {
        let models: Value = value(models);
        let name =
            |key: &str| models.get(key).and_then(Value::as_str).unwrap_or("unknown").to_owned();
        Self {
            settings: settings::read(value(settings)),
            models: ParseModels { masks: name("masks"), encoder: name("encoder") },
            import: read_or_none("import report", import),
            report: read_or_none("parse report", report),
            extent: read_or_none("extent", extent),
        }
    }
}

fn value(text: &str) -> Value {
    serde_json::from_str(text).unwrap_or(Value::Null)
}

pub(super) fn read_or_none<T: DeserializeOwned>(what: &str, text: &str) -> Option<T> {
    serde_json::from_str(text)
        .inspect_err(
            |error| tracing::warn!(what, %error, "stored record has an unknown version; skipped"),
        )
        .ok()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn readable_fields_of_other_versions_are_read() {
        let record = ParseRecord::read(
            r#"{"parsing": {"superpoints": {"voxel_m": 0.07, "colour_of_the_sky": 3}, "wholes": {"enabled": false}, "depth_tolerance": "loose"}}"#,
            r#"{"masks": "rgbd-9", "vlm": "x"}"#,
            r#"{"format": "uniground-scene/9"}"#,
            r#"{"points": 1, "frames_used": 2, "superpoints": 3, "instances": 4, "structural": 0, "without_views": 0, "stages": [], "warnings": [], "more": true}"#,
            r#"{"center": [1, 2, 3], "size": [4, 5, 6]}"#,
        );
        assert_eq!(
            (
                record.settings.parsing.superpoints.voxel_m,
                record.settings.parsing.part_merging.enabled
            ),
            (0.07, false)
        );
        assert_eq!(
            record.settings.parsing.depth_tolerance,
            ParseSettings::default().parsing.depth_tolerance
        );
        assert_eq!(
            (record.models.masks.as_str(), record.models.encoder.as_str()),
            ("rgbd-9", "unknown")
        );
        assert!(
            record.import.is_none() && record.report.is_some_and(|report| report.instances == 4)
        );
        assert_eq!(record.extent.unwrap().size.z, 6.0);
    }
}
