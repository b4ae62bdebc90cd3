//! Scenes and their parses.

use crate::geometry::boxes::Aabb;
use crate::geometry::up_axis::UpAxis;
use crate::job::{Job, JobError};
use crate::placement::SceneToMap;
use crate::scene::{ImportReport, ParseReport};
use crate::settings::{LevellingChoice, ParseModels, ParsePreset, ParseSettings};
use serde::{Deserialize, Deserializer, Serialize};
use std::collections::BTreeMap;

/// Status of a scene.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(rename_all = "snake_case")]
pub enum SceneStatus {
    /// Stored, not parsed.
    Uploaded,
    /// The first parse is queued or running.
    Parsing,
    /// Ready for questions.
    Ready,
    /// The only parse so far failed or was cancelled. See `error`.
    Failed,
}

/// What made a scene's current parse.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(rename_all = "snake_case")]
pub enum ParseQuality {
    /// The built-in methods, in seconds. The server's neural networks find and name more. With
    /// `serve --parse draft-first` their parse follows; with `draft-only` it can be requested.
    Draft,
    /// Everything that the server is configured to use.
    Full,
}

/// Sizes of a scene's current parse.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct SceneCounts {
    /// Number of points in the cloud.
    pub points: u64,
    /// Number of frames used, a sample of the imported ones.
    pub frames_used: u32,
    /// Number of superpoints: small uniform patches of the cloud.
    pub superpoints: u32,
    /// Number of instances, including floor, walls and ceiling.
    pub instances: u32,
}

/// A scene: an uploaded scan and its current parse.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct Scene {
    /// UUIDv7, so ids sort by time.
    pub id: String,
    /// Name, one line of 1 to 200 characters: set at the upload, taken from the archive, or
    /// `scene`. Names may repeat.
    pub name: String,
    /// Status of the scene.
    pub status: SceneStatus,
    /// SHA-256 of the uploaded bytes, hex. If frames were added, a hash over all uploads.
    pub content_hash: String,
    /// Version of the current parse, from 1. 0 before the first. Questions use it until a newer one
    /// is ready.
    pub parse_version: u32,
    /// What made the current parse. `null` before the first. While it is `draft`, the job `job_id`
    /// makes the full parse; objects keep their ids.
    #[serde(default)]
    pub quality: Option<ParseQuality>,
    /// Sizes of the current parse. `null` before the first.
    pub counts: Option<SceneCounts>,
    /// Box of all points; meters, world frame (Z up).
    pub extent: Option<Aabb>,
    /// Transform from the scene to a map. `null` if not set.
    #[serde(default)]
    pub scene_to_map: Option<SceneToMap>,
    /// Name of the map frame. `null` if not set.
    #[serde(default)]
    pub map_frame_id: Option<String>,
    /// Labels, like `building` or `floor`.
    #[serde(default)]
    pub labels: BTreeMap<String, String>,
    /// Report of the importer.
    pub import: Option<ImportReport>,
    /// Report of stage 1 (parsing). `null` in lists.
    pub report: Option<ParseReport>,
    /// Settings of the current parse, including defaults. `null` before the first parse, and in
    /// lists.
    pub settings: Option<ParseSettings>,
    /// Models of the current parse. `null` before the first.
    pub models: Option<ParseModels>,
    /// Id of the latest parse job of this scene.
    pub job_id: Option<String>,
    /// Error of the latest parse. `null` after a cancellation.
    pub error: Option<JobError>,
    /// Upload time, RFC 3339 UTC.
    pub created_at: String,
    /// Time of the last change or parse request, RFC 3339 UTC.
    pub updated_at: String,
}

/// A page of scenes.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct SceneList {
    /// Scenes, newest first.
    pub scenes: Vec<Scene>,
    /// Cursor of the next page. `null` on the last page.
    pub next_cursor: Option<String>,
}

/// A new scene and its parse job.
#[derive(Debug, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct Created {
    /// The scene. With a known `Idempotency-Key`, the scene of the first request.
    pub scene: Scene,
    /// The parse job. `null` if the scan was only stored.
    pub job: Option<Job>,
}

/// Changes of a scene. Omitted fields stay unchanged.
#[derive(Debug, Default, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(deny_unknown_fields)]
pub struct SceneChange {
    /// Name, one line of 1 to 200 characters, not blank, without control characters.
    #[cfg_attr(feature = "openapi", schema(min_length = 1, max_length = 200))]
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub name: Option<String>,
    /// Transform from the scene to a map. Questions can then request boxes in the map. `null`
    /// removes it.
    #[cfg_attr(feature = "openapi", schema(value_type = Option<SceneToMap>))]
    #[serde(
        default,
        deserialize_with = "deserialize_nullable",
        skip_serializing_if = "Option::is_none"
    )]
    pub scene_to_map: Option<Option<SceneToMap>>,
    /// Name of the map frame in tf, 1 to 200 characters. `null` removes it.
    #[cfg_attr(feature = "openapi", schema(value_type = Option<String>, min_length = 1, max_length = 200, example = "map"))]
    #[serde(
        default,
        deserialize_with = "deserialize_nullable",
        skip_serializing_if = "Option::is_none"
    )]
    pub map_frame_id: Option<Option<String>>,
    /// Labels. They replace all existing labels. At most 20; names of 1 to 63 letters, digits, `.`,
    /// `_`, `-` and `/`, values of 1 to 100 characters without commas.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub labels: Option<BTreeMap<String, String>>,
}

/// Deserializes a field so that `null` and an omitted field differ.
fn deserialize_nullable<'de, D: Deserializer<'de>, T: Deserialize<'de>>(
    deserializer: D,
) -> Result<Option<T>, D::Error> {
    T::deserialize(deserializer).map(Some)
}

/// A scan on the server's disk to import.
#[derive(Debug, Clone, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(deny_unknown_fields)]
pub struct ImportRequest {
    /// Path of a file or an unpacked folder, relative to the configured import folder. Same formats
    /// as for uploads.
    #[cfg_attr(
        feature = "openapi",
        schema(min_length = 1, max_length = 4096, example = "monday/kitchen")
    )]
    pub path: String,
    /// Name of the scene. Default: the name in the archive.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[cfg_attr(feature = "openapi", schema(min_length = 1, max_length = 200))]
    pub name: Option<String>,
    /// `false` stores the scan without parsing it. Default: `true`.
    #[serde(default = "default_true")]
    #[cfg_attr(feature = "openapi", schema(default = true))]
    pub parse: bool,
    /// Axis of the files that points up, for scans that do not state it. Default: the axis that the
    /// cameras hold up.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub up: Option<UpAxis>,
    /// Length of one unit of the files' clouds and poses, meters. Default: estimated from their
    /// size.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub metres_per_unit: Option<f64>,
    /// Whether to level a tilted world.
    #[serde(default)]
    pub levelling: LevellingChoice,
    /// Preset of the parse settings.
    #[serde(default)]
    pub preset: ParsePreset,
}

fn default_true() -> bool {
    true
}

impl ImportRequest {
    /// Creates a request for a file or folder with default options.
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

/// Parse options. An empty object uses the default settings.
#[derive(Debug, Default, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(deny_unknown_fields, default)]
pub struct ParseRequest {
    /// Preset from which `settings` start.
    pub preset: ParsePreset,
    /// Values that override the preset, e.g. `{"parsing": {"superpoints": {"voxel_m": 0.02}}}`.
    #[cfg_attr(feature = "openapi", schema(value_type = Option<ParseSettings>))]
    pub settings: Option<serde_json::Value>,
}

/// Full report of a scene's current parse.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct SceneReport {
    /// UUIDv7 of the scene.
    pub scene_id: String,
    /// Version of the current parse, from 1.
    pub parse_version: u32,
    /// Report of the importer.
    pub import: Option<ImportReport>,
    /// Report of each stage.
    pub parse: Option<ParseReport>,
    /// Settings of the parse, including defaults.
    pub settings: Option<ParseSettings>,
    /// Models of the parse.
    pub models: Option<ParseModels>,
    /// Pictures of the cloud by superpoint and by instance, and of instances in up to three frames.
    /// Empty for parses from older versions.
    pub pictures: Vec<ReportPictureLink>,
}

/// A picture of a parse.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct ReportPictureLink {
    /// File name without `.jpg`: `superpoints`, `instances`, `frame-1` and so on.
    pub name: String,
    /// Title of the picture.
    pub title: String,
    /// URL of the JPEG, relative to the server.
    pub url: String,
}
