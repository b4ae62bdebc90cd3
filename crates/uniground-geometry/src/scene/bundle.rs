//! The result of an import: a cloud, references to its frames, and the import report.

use super::{FrameRef, ImportReport, PointCloud};
use camino::{Utf8Path, Utf8PathBuf};
use serde::{Deserialize, Serialize};
use uniground_types::findings::Finding;

/// A scan in canonical form. The cloud is in memory; frames are decoded one at a time where needed.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub struct SceneBundle {
    /// The scan's own cloud, or one fused from its frames.
    pub cloud: PointCloud,
    /// The usable frames, in the scan's order; empty for a bare cloud.
    pub frames: Vec<FrameRef>,
    /// The import report.
    pub report: ImportReport,
    /// Additions to the scan, in order. The fields above do not include them, so that the original
    /// scan is imported only once.
    #[serde(skip)]
    pub additions: Vec<Addition>,
}

/// Frames added to a scan, and the changes they make to its cloud.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub struct Addition {
    /// Identifies the scan up to and including this addition: equal values mean equal imports.
    pub made_of: String,
    /// Numbered consecutively after the earlier frames.
    pub frames: Vec<FrameRef>,
    /// Previous points that still exist, ascending. The new frames saw through the others.
    pub kept: Vec<u32>,
    /// Points that did not exist before.
    pub new: PointCloud,
    /// Minimum distance of a new point to known points, meters. This is also the width of the gap
    /// between a surface and its continuation.
    pub apart_m: f32,
    /// Number of frames that could not be used.
    pub frames_skipped: u32,
    /// What was found while importing it.
    pub findings: Vec<Finding>,
}

impl Addition {
    /// Returns the cloud after the addition, given the previous one: remaining points, then new
    /// points.
    #[must_use]
    pub fn apply_to(&self, before: &PointCloud) -> PointCloud {
        let kept = self.kept.iter().map(|&point| point as usize);
        let positions = kept
            .clone()
            .map(|point| before.positions[point])
            .chain(self.new.positions.iter().copied());
        let colors = kept.map(|point| before.colors[point]).chain(self.new.colors.iter().copied());
        PointCloud { positions: positions.collect(), colors: colors.collect() }
    }

    /// Returns the same addition with the paths of its frames changed.
    #[must_use]
    pub fn with_paths(mut self, path: impl Fn(&Utf8Path) -> Utf8PathBuf) -> Self {
        self.frames = self.frames.into_iter().map(|frame| frame.with_paths(&path)).collect();
        self
    }
}

impl SceneBundle {
    /// Returns the report and the frames including all additions.
    #[must_use]
    pub fn combine_additions(&self) -> (ImportReport, Vec<FrameRef>) {
        let (mut report, mut frames) = (self.report.clone(), self.frames.clone());
        for addition in &self.additions {
            report.frames += addition.frames.len() as u32;
            report.frames_skipped += addition.frames_skipped;
            report.add_findings(addition.findings.clone());
            frames.extend(addition.frames.iter().cloned());
        }
        (report, frames)
    }

    /// Returns the number of points of the cloud, including all additions.
    #[must_use]
    pub fn points(&self) -> usize {
        self.additions.last().map_or(self.cloud.len(), |last| last.kept.len() + last.new.len())
    }

    /// Returns the index at which the frames of the next addition begin.
    #[must_use]
    pub fn next_frame(&self) -> u32 {
        let frames = self.additions.last().map_or(&self.frames, |last| &last.frames);
        frames.iter().map(|frame| frame.index.0 + 1).max().unwrap_or(0)
    }

    /// Returns the same bundle with the paths of its frames changed.
    #[must_use]
    pub fn with_paths(mut self, path: impl Fn(&Utf8Path) -> Utf8PathBuf) -> Self {
        self.frames = self.frames.into_iter().map(|frame| frame.with_paths(&path)).collect();
        self
    }
}
