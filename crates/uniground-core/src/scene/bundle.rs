//! What an import produces: a cloud, references to its frames, and what was found out on the way.

use super::{FrameRef, ImportReport, PointCloud};
use camino::{Utf8Path, Utf8PathBuf};
use serde::{Deserialize, Serialize};

/// A scan in canonical form. The cloud is in memory; frames are decoded one at a time by whoever needs them.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub struct SceneBundle {
    /// The scan's own, or fused from its frames.
    pub cloud: PointCloud,
    /// Those that can be used, in the scan's order; none for a bare cloud.
    pub frames: Vec<FrameRef>,
    /// What the import found.
    pub report: ImportReport,
}

impl SceneBundle {
    /// The same bundle with the paths of its frames changed.
    #[must_use]
    pub fn with_paths(mut self, path: impl Fn(&Utf8Path) -> Utf8PathBuf) -> Self {
        self.frames = self.frames.into_iter().map(|frame| frame.with_paths(&path)).collect();
        self
    }
}
