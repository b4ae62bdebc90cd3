//! The findings of an import: what was read, left out and assumed.

use serde::{Deserialize, Serialize};

/// What a finding is about.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(rename_all = "snake_case")]
pub enum FindingSubject {
    /// The upload's files.
    Files,
    /// Frames: which pictures and poses belong together, and which frames are used.
    Frames,
    /// The point cloud or mesh.
    Cloud,
    /// Colors of points.
    Color,
    /// Direction of the poses, axes of the cameras and unit of the depth pictures, which are checked
    /// together.
    Poses,
    /// Intrinsics of the camera.
    Camera,
    /// The unit of length.
    Units,
    /// Which way is up.
    Up,
}

/// The kind of a finding.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(rename_all = "snake_case")]
pub enum FindingKind {
    /// Something that was read.
    Read,
    /// Something that is not used.
    LeftOut,
    /// Something that the files do not state, or that was taken from the data although they state
    /// something else.
    Assumed,
    /// Something that was converted, such as a tilted scan that was rotated level.
    Changed,
    /// Something unusual that was accepted.
    Unusual,
}

/// One finding of an import.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct Finding {
    /// The kind.
    pub kind: FindingKind,
    /// What it is about.
    pub about: FindingSubject,
    /// The finding as a sentence.
    pub text: String,
    /// Whether the finding can make results worse. Such findings are in `warnings` too.
    pub warning: bool,
    /// File or folder in the upload.
    #[serde(default)]
    pub file: Option<String>,
    /// Number of files, frames or points.
    #[serde(default)]
    pub count: Option<u64>,
    /// For assumptions: how clearly the data supports this reading over the next best one that was
    /// tried, `0..=1`; below 0.5 the other one fits better. `null` where nothing was compared.
    #[serde(default)]
    pub confidence: Option<f32>,
    /// For assumptions: the parameter or file that states it instead, such as `up` or
    /// `intrinsic.txt`.
    #[serde(default)]
    pub state_with: Option<String>,
}

impl Finding {
    fn new(
        kind: FindingKind,
        about: FindingSubject,
        warning: bool,
        text: impl Into<String>,
    ) -> Self {
        let text = text.into();
        Self {
            kind,
            about,
            text,
            warning,
            file: None,
            count: None,
            confidence: None,
            state_with: None,
        }
    }

    /// Something that was read.
    #[must_use]
    pub fn read(about: FindingSubject, text: impl Into<String>) -> Self {
        Self::new(FindingKind::Read, about, false, text)
    }

    /// Something that is not used, with a warning.
    #[must_use]
    pub fn left_out(about: FindingSubject, text: impl Into<String>) -> Self {
        Self::new(FindingKind::LeftOut, about, true, text)
    }

    /// An assumption, with a warning.
    #[must_use]
    pub fn assumed(about: FindingSubject, text: impl Into<String>) -> Self {
        Self::new(FindingKind::Assumed, about, true, text)
    }

    /// A conversion, with a warning.
    #[must_use]
    pub fn changed(about: FindingSubject, text: impl Into<String>) -> Self {
        Self::new(FindingKind::Changed, about, true, text)
    }

    /// Something unusual, with a warning.
    #[must_use]
    pub fn unusual(about: FindingSubject, text: impl Into<String>) -> Self {
        Self::new(FindingKind::Unusual, about, true, text)
    }

    /// Removes the warning: the finding is normal.
    #[must_use]
    pub fn without_warning(mut self) -> Self {
        self.warning = false;
        self
    }

    /// Names the file.
    #[must_use]
    pub fn in_file(mut self, file: impl Into<String>) -> Self {
        self.file = Some(file.into());
        self
    }

    /// Adds the number of files, frames or points.
    #[must_use]
    pub fn counting(mut self, count: usize) -> Self {
        self.count = Some(count as u64);
        self
    }

    /// Adds how clearly the data supports an assumption.
    #[must_use]
    pub fn with_confidence(mut self, confidence: impl Into<Option<f32>>) -> Self {
        self.confidence = confidence.into();
        self
    }

    /// Adds what states it instead.
    #[must_use]
    pub fn stated_with(mut self, parameter: impl Into<String>) -> Self {
        self.state_with = Some(parameter.into());
        self
    }
}
