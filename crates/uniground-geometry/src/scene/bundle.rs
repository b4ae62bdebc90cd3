//! What an import produces: a cloud, references to its frames, and what was found out on the way.

use super::{FrameRef, ImportReport, PointCloud};
use camino::{Utf8Path, Utf8PathBuf};
use serde::{Deserialize, Serialize};

/// A scan in canonical form. The cloud is in memory; frames are decoded one at a time by whoever
/// needs them.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub struct SceneBundle {
    /// The scan's own, or fused from its frames.
    pub cloud: PointCloud,
    /// Those that can be used, in the scan's order; none for a bare cloud.
    pub frames: Vec<FrameRef>,
    /// What the import found.
    pub report: ImportReport,
    /// What was added to the scan since, in order; none of it is in the fields above. Kept apart:
    /// what came first is imported once.
    #[serde(skip)]
    pub additions: Vec<Addition>,
}

/// Frames that were added to a scan, and what they change in its cloud.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub struct Addition {
    /// What identifies the scan up to here: of the same one the same is made.
    pub made_of: String,
    /// Counted on from those of before.
    pub frames: Vec<FrameRef>,
    /// Points of the cloud so far that are still there, ascending: the others were looked through.
    pub kept: Vec<u32>,
    /// Points that were not there before.
    pub new: PointCloud,
    /// What is nearer to a known point is no new one, metres: as wide is the gap between a surface
    /// and its continuation.
    pub apart_m: f32,
    /// How many frames could not be used.
    pub frames_skipped: u32,
    /// What is odd but was accepted.
    pub warnings: Vec<String>,
}

impl Addition {
    /// The cloud after the addition, given that of before: what is still there, then what is new.
    #[must_use]
    pub fn applied_to(&self, before: &PointCloud) -> PointCloud {
        let kept = self.kept.iter().map(|&point| point as usize);
        let positions = kept
            .clone()
            .map(|point| before.positions[point])
            .chain(self.new.positions.iter().copied());
        let colours =
            kept.map(|point| before.colours[point]).chain(self.new.colours.iter().copied());
        PointCloud { positions: positions.collect(), colours: colours.collect() }
    }

    /// The same with the paths of its frames changed.
    #[must_use]
    pub fn with_paths(mut self, path: impl Fn(&Utf8Path) -> Utf8PathBuf) -> Self {
        self.frames = self.frames.into_iter().map(|frame| frame.with_paths(&path)).collect();
        self
    }
}

impl SceneBundle {
    /// The report and the frames with everything that was added.
    #[must_use]
    pub fn in_all(&self) -> (ImportReport, Vec<FrameRef>) {
        let (mut report, mut frames) = (self.report.clone(), self.frames.clone());
        for addition in &self.additions {
            report.frames += addition.frames.len() as u32;
            report.frames_skipped += addition.frames_skipped;
            report.warnings.extend(addition.warnings.iter().cloned());
            frames.extend(addition.frames.iter().cloned());
        }
        (report, frames)
    }

    /// Points of the cloud with everything that was added.
    #[must_use]
    pub fn points(&self) -> usize {
        self.additions.last().map_or(self.cloud.len(), |last| last.kept.len() + last.new.len())
    }

    /// The number that the frames of the next addition begin with.
    #[must_use]
    pub fn next_frame(&self) -> u32 {
        let frames = self.additions.last().map_or(&self.frames, |last| &last.frames);
        frames.iter().map(|frame| frame.index.0 + 1).max().unwrap_or(0)
    }

    /// The same bundle with the paths of its frames changed.
    #[must_use]
    pub fn with_paths(mut self, path: impl Fn(&Utf8Path) -> Utf8PathBuf) -> Self {
        self.frames = self.frames.into_iter().map(|frame| frame.with_paths(&path)).collect();
        self
    }
}
