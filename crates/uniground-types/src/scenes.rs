//! Scans and their parses, as callers see them.

use crate::geometry::boxes::Aabb;
use crate::geometry::up_axis::UpAxis;
use crate::job::{Job, JobError};
use crate::placement::SceneToMap;
use crate::scene::{ImportReport, ParseReport};
use crate::settings::{LevellingChoice, ParseModels, ParsePreset, ParseSettings};
use serde::{Deserialize, Deserializer, Serialize};
use std::collections::BTreeMap;

/// How far a scene has come.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(rename_all = "snake_case")]
pub enum SceneStatus {
    /// Stored, not parsed.
    Uploaded,
    /// The first parse is queued or running.
    Parsing,
    /// Questions are answered.
    Ready,
    /// The only parse so far failed or was cancelled; see `error`.
    Failed,
}

/// Sizes of a scene's current parse.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct SceneCounts {
    /// Points of the cloud.
    pub points: u64,
    /// Frames looked at, a sample of those imported.
    pub frames_used: u32,
    /// Small even patches the cloud was cut into before merging.
    pub superpoints: u32,
    /// Instances found, floor, walls and ceiling included.
    pub instances: u32,
}

/// A scene: one uploaded scan and its current parse.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct Scene {
    /// UUIDv7; in order of time.
    pub id: String,
    /// One line of 1 to 200 characters, given at the upload, taken from the archive, or `scene`.
    /// Need not be unique.
    pub name: String,
    /// Whether questions can be asked.
    pub status: SceneStatus,
    /// SHA-256 of the uploaded bytes, hex; of a scene that has grown, of what it is made of.
    pub content_hash: String,
    /// Number of the current parse, from 1; 0 before the first. Questions use the current one
    /// until a newer is ready.
    pub parse_version: u32,
    /// Sizes of the current parse; `null` before the first.
    pub counts: Option<SceneCounts>,
    /// Box of all points, world frame (Z up), metres.
    pub extent: Option<Aabb>,
    /// Where the scene lies in somebody's map; `null` where nobody has said.
    #[serde(default)]
    pub scene_to_map: Option<SceneToMap>,
    /// What that map's frame is called; `null` where nobody has said.
    #[serde(default)]
    pub map_frame_id: Option<String>,
    /// What the scene is filed under: `building`, `floor`, whatever its owner says.
    #[serde(default)]
    pub labels: BTreeMap<String, String>,
    /// What the importer found.
    pub import: Option<ImportReport>,
    /// What stage 1 did; `null` in lists.
    pub report: Option<ParseReport>,
    /// Settings of the current parse, defaults filled in; `null` before the first, and in lists.
    pub settings: Option<ParseSettings>,
    /// Models of the current parse; `null` before the first.
    pub models: Option<ParseModels>,
    /// The latest parse job on this scene.
    pub job_id: Option<String>,
    /// Why the latest parse failed; `null` after a cancel.
    pub error: Option<JobError>,
    /// When it was uploaded, RFC 3339 UTC.
    pub created_at: String,
    /// When it was last changed, parsed, or asked to be, RFC 3339 UTC.
    pub updated_at: String,
}

/// One page of scenes.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct SceneList {
    /// Newest first.
    pub scenes: Vec<Scene>,
    /// Pass as `cursor` for the next page; `null` on the last.
    pub next_cursor: Option<String>,
}

/// A new scene and the job that parses it.
#[derive(Debug, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct Created {
    /// As it stands now; with a known `Idempotency-Key`, the scene that key made before.
    pub scene: Scene,
    /// `null` when the scan was only stored.
    pub job: Option<Job>,
}

/// What is to be different about a scene; what is left out stays.
#[derive(Debug, Default, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(deny_unknown_fields)]
pub struct SceneChange {
    /// One line of 1 to 200 characters, not blank, without control characters.
    #[cfg_attr(feature = "openapi", schema(min_length = 1, max_length = 200))]
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub name: Option<String>,
    /// Where the scene lies in a map: questions may then ask for boxes in it. `null` takes it
    /// away.
    #[cfg_attr(feature = "openapi", schema(value_type = Option<SceneToMap>))]
    #[serde(
        default,
        deserialize_with = "deserialize_nullable",
        skip_serializing_if = "Option::is_none"
    )]
    pub scene_to_map: Option<Option<SceneToMap>>,
    /// What the map's frame is called, as tf has it: a name like a scene's. `null` takes it away.
    #[cfg_attr(feature = "openapi", schema(value_type = Option<String>, min_length = 1, max_length = 200, example = "map"))]
    #[serde(
        default,
        deserialize_with = "deserialize_nullable",
        skip_serializing_if = "Option::is_none"
    )]
    pub map_frame_id: Option<Option<String>>,
    /// What the scene is filed under, all of it: labels that are left out are taken away. At most
    /// 20; names of 1 to 63 letters, digits, `.`, `_`, `-` and `/`, values of 1 to 100
    /// characters without commas.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub labels: Option<BTreeMap<String, String>>,
}

/// What a field says, `null` too: a field that is left out says nothing.
fn deserialize_nullable<'de, D: Deserializer<'de>, T: Deserialize<'de>>(
    deserializer: D,
) -> Result<Option<T>, D::Error> {
    T::deserialize(deserializer).map(Some)
}

/// A scan on the server's own disk.
#[derive(Debug, Clone, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(deny_unknown_fields)]
pub struct ImportRequest {
    /// A file or folder below the one that the server's operator named, relative to it: whatever
    /// can be uploaded, a folder unpacked.
    #[cfg_attr(
        feature = "openapi",
        schema(min_length = 1, max_length = 4096, example = "monday/kitchen")
    )]
    pub path: String,
    /// Name of the scene; default: what the archive calls itself.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[cfg_attr(feature = "openapi", schema(min_length = 1, max_length = 200))]
    pub name: Option<String>,
    /// `false` only stores the scan.
    #[serde(default = "default_true")]
    #[cfg_attr(feature = "openapi", schema(default = true))]
    pub parse: bool,
    /// The axis that points up in the files, for scans that do not say; default: the axis the
    /// cameras hold up.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub up: Option<UpAxis>,
    /// Length of one unit of the files' clouds and poses, metres, for files that are not in
    /// metres; default: told by their size.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub metres_per_unit: Option<f64>,
    /// Whether a world that is tilted is turned level.
    #[serde(default)]
    pub levelling: LevellingChoice,
    /// Settings to parse with.
    #[serde(default)]
    pub preset: ParsePreset,
}

fn default_true() -> bool {
    true
}

impl ImportRequest {
    /// Of a file or folder, to be parsed at once with the default settings.
    #[must_use]
    pub fn from_path(path: impl Into<String>) -> Self {
        Self {
            path: path.into(),
            name: None,
            parse: true,
            up: None,
            metres_per_unit: None,
            levelling: LevellingChoice::default(),
            preset: ParsePreset::default(),
        }
    }
}

/// How to parse. An empty object parses with the default settings.
#[derive(Debug, Default, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(deny_unknown_fields, default)]
pub struct ParseRequest {
    /// What `settings` start from.
    pub preset: ParsePreset,
    /// Single values that replace those of the preset, e.g. `{"parsing": {"superpoints":
    /// {"voxel_m": 0.02}}}`.
    #[cfg_attr(feature = "openapi", schema(value_type = Option<ParseSettings>))]
    pub settings: Option<serde_json::Value>,
}

/// Everything known about a scene's current parse.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct SceneReport {
    /// UUIDv7 of the scene.
    pub scene_id: String,
    /// Number of the current parse, from 1.
    pub parse_version: u32,
    /// What the importer found.
    pub import: Option<ImportReport>,
    /// What every stage did and took.
    pub parse: Option<ParseReport>,
    /// Settings of the parse, defaults filled in.
    pub settings: Option<ParseSettings>,
    /// Models the parse was made with.
    pub models: Option<ParseModels>,
    /// The cloud by superpoint and by instance, and instances over up to three frames; empty for
    /// parses of old versions.
    pub pictures: Vec<ReportPictureLink>,
}

/// A picture of a parse.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct ReportPictureLink {
    /// `superpoints`, `instances`, `frame-1` and so on: the file without `.jpg`.
    pub name: String,
    /// What it shows.
    pub title: String,
    /// JPEG, relative to the server.
    pub url: String,
}
