//! What an import produces: a cloud, references to its frames, and what was found out on the way.

use super::{FrameRef, PointCloud};
use crate::geometry::up_axis::UpAxis;
use camino::{Utf8Path, Utf8PathBuf};
use serde::{Deserialize, Serialize};
use utoipa::ToSchema;

/// A scan in canonical form. The cloud is in memory; frames are decoded one at a time by whoever needs them.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub struct SceneBundle {
    pub cloud: PointCloud,
    pub frames: Vec<FrameRef>,
    pub report: ImportReport,
}

impl SceneBundle {
    /// The same bundle with the paths of its frames changed.
    #[must_use]
    pub fn with_paths(mut self, path: impl Fn(&Utf8Path) -> Utf8PathBuf) -> Self {
        for frame in &mut self.frames {
            frame.color = path(&frame.color);
            frame.depth = path(&frame.depth);
        }
        self
    }
}

/// How poses are to be read.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
#[serde(rename_all = "snake_case")]
pub enum PoseConvention {
    CameraToWorld,
    WorldToCamera,
}

/// What the importer found; part of the scene's public record.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct ImportReport {
    /// Layout of the archive: `uniground-scene/1` or `color-depth-pose`.
    pub format: String,
    /// The axis that pointed up in the files; the stored scene has Z up.
    pub up: UpAxis,
    pub pose: PoseConvention,
    /// Camera axes of the files: `opencv` or `opengl`.
    pub camera_axes: String,
    pub frames: u32,
    /// Frames left out because the tracker marked their pose as lost (infinite).
    pub frames_skipped: u32,
    /// Points in the archive's own cloud; `null` when the cloud is fused from the frames.
    pub cloud_points: Option<u64>,
    /// Share of sampled points that agree with the depth pictures they project into, `0..=1`; `null` where it could not be measured.
    pub reprojection_agreement: Option<f32>,
    /// What is odd but was accepted, each with its file or frame.
    pub warnings: Vec<String>,
}
