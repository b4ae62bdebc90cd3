//! Errors in an upload. Messages are written for the uploader and name the file, frame or field.

use camino::Utf8PathBuf;
use serde::{Deserialize, Serialize};
use std::io;
use uniground_geometry::pose::PoseError;
use uniground_geometry::progress::Cancelled;
use uniground_geometry::scene::{FrameError, FrameIndex};

/// The reason why a scan was refused or could not be read, or that reading was cancelled.
#[derive(Debug, thiserror::Error)]
#[allow(missing_docs)] // Every message describes its variant.
pub enum IngestError {
    #[error("the upload is not a readable {kind} archive: {reason}")]
    ArchiveUnreadable { kind: &'static str, reason: String },
    #[error("archive entry {entry:?} {reason}")]
    UnsafeEntry { entry: String, reason: &'static str },
    #[error("the archive unpacks to more than {limit}")]
    ArchiveTooLarge { limit: String },
    #[error(
        "unknown scene layout: expected scene.json, color/ depth/ pose/ with intrinsic.txt, a scan of a supported data set or app, a cloud or a mesh; the archive contains {found}"
    )]
    UnknownLayout { found: String },
    #[error("{file}: {reason}")]
    Malformed { file: Utf8PathBuf, reason: String },
    #[error("{file} is missing")]
    MissingFile { file: Utf8PathBuf },
    #[error(
        "{file}: the camera's intrinsics are missing: fx, fy, cx and cy in pixels, or a 3x3 matrix"
    )]
    MissingIntrinsics { file: Utf8PathBuf },
    #[error("{file}: intrinsics do not fit the picture: {reason}")]
    BadIntrinsics { file: Utf8PathBuf, reason: String },
    #[error(
        "the scan has {color} color pictures, {depth} depth pictures and {pose} poses; first one without a match: {first}"
    )]
    FrameCountMismatch { color: usize, depth: usize, pose: usize, first: Utf8PathBuf },
    #[error("frame {frame}: {file}: {source}")]
    BadPose {
        frame: FrameIndex,
        file: Utf8PathBuf,
        #[source]
        source: PoseError,
    },
    #[error("{file}: the cloud has no points")]
    EmptyCloud { file: Utf8PathBuf },
    #[error("the scene has no frames and no points")]
    EmptyScene,
    #[error("no frame can be used: {reason}")]
    NoUsableFrames { reason: String },
    #[error(
        "{damaged} of {total} frames are damaged or incomplete, but at most a tenth can be skipped; the first: {first}"
    )]
    TooManyDamaged { damaged: usize, total: usize, first: Box<IngestError> },
    #[error("this looks like {looks_like}, but {missing}")]
    IncompleteLayout { looks_like: &'static str, missing: String },
    #[error("the cloud does not show which of its axes points up: {reason}. Set {choice}")]
    UpUnknown { reason: String, choice: String },
    #[error(
        "{file} does not state its unit of length, and its size does not tell: {readings}. Set metres_per_unit"
    )]
    UnitUnknown { file: Utf8PathBuf, readings: String },
    #[error(transparent)]
    Frame(#[from] FrameError),
    #[error(
        "cloud, poses and depth do not agree: only {agreement:.0}% of the sampled points fit the depth pictures, and no other convention fits (best: {hypothesis}, {other_agreement:.0}%): {cause}"
    )]
    NothingFits { agreement: f32, hypothesis: String, other_agreement: f32, cause: String },
    #[error(
        "cloud, poses and depth do not agree as declared ({agreement:.0}% of the sampled points fit the depth pictures), and two other readings fit about equally well: {readings}. State the right one in a scene.json"
    )]
    ConventionUnclear { agreement: f32, readings: String },
    #[error(
        "these frames do not fit this scene: {agreement:.0}% of its points in view fit their depth. Their poses must be in the coordinates of the files that the scene was made from, or set world=scene or world=map"
    )]
    DoesNotBelong { agreement: f32 },
    #[error("{file}: {source}")]
    Io {
        file: Utf8PathBuf,
        #[source]
        source: io::Error,
    },
    #[error("{file}: reading it takes more than {limit}")]
    TooCostly { file: Utf8PathBuf, limit: String },
    #[error(transparent)]
    Cancelled(#[from] Cancelled),
    /// An error that a reader in another process returned, with its kind and its message.
    #[error("{message}")]
    Reported { kind: IngestErrorKind, message: String },
}

/// The kinds of [`IngestError`], without details. Each has a stable code. Where many frames are
/// damaged, the kind of the first one is used.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[allow(missing_docs)] // Each is the error of the same name.
pub enum IngestErrorKind {
    ArchiveUnreadable,
    UnsafeEntry,
    ArchiveTooLarge,
    UnknownLayout,
    Malformed,
    MissingFile,
    MissingIntrinsics,
    BadIntrinsics,
    FrameCountMismatch,
    BadPose,
    EmptyCloud,
    EmptyScene,
    NoUsableFrames,
    IncompleteLayout,
    UpUnknown,
    UnitUnknown,
    Frame,
    NothingFits,
    DoesNotBelong,
    TooCostly,
    Io,
    Cancelled,
}

impl IngestError {
    /// Returns the kind, which has a stable code. For many damaged frames, returns the kind of the
    /// first error.
    #[must_use]
    pub fn kind(&self) -> IngestErrorKind {
        match self {
            Self::ArchiveUnreadable { .. } => IngestErrorKind::ArchiveUnreadable,
            Self::UnsafeEntry { .. } => IngestErrorKind::UnsafeEntry,
            Self::ArchiveTooLarge { .. } => IngestErrorKind::ArchiveTooLarge,
            Self::UnknownLayout { .. } => IngestErrorKind::UnknownLayout,
            Self::Malformed { .. } => IngestErrorKind::Malformed,
            Self::MissingFile { .. } => IngestErrorKind::MissingFile,
            Self::MissingIntrinsics { .. } => IngestErrorKind::MissingIntrinsics,
            Self::BadIntrinsics { .. } => IngestErrorKind::BadIntrinsics,
            Self::FrameCountMismatch { .. } => IngestErrorKind::FrameCountMismatch,
            Self::BadPose { .. } => IngestErrorKind::BadPose,
            Self::EmptyCloud { .. } => IngestErrorKind::EmptyCloud,
            Self::EmptyScene => IngestErrorKind::EmptyScene,
            Self::NoUsableFrames { .. } => IngestErrorKind::NoUsableFrames,
            Self::TooManyDamaged { first, .. } => first.kind(),
            Self::IncompleteLayout { .. } => IngestErrorKind::IncompleteLayout,
            Self::UpUnknown { .. } => IngestErrorKind::UpUnknown,
            Self::UnitUnknown { .. } => IngestErrorKind::UnitUnknown,
            Self::Frame(_) => IngestErrorKind::Frame,
            Self::NothingFits { .. } | Self::ConventionUnclear { .. } => {
                IngestErrorKind::NothingFits
            }
            Self::DoesNotBelong { .. } => IngestErrorKind::DoesNotBelong,
            Self::TooCostly { .. } => IngestErrorKind::TooCostly,
            Self::Io { .. } => IngestErrorKind::Io,
            Self::Cancelled(_) => IngestErrorKind::Cancelled,
            Self::Reported { kind, .. } => *kind,
        }
    }

    /// Converts an error of reading a file of the archive. The upload is at fault unless the disk
    /// failed.
    pub(super) fn reading(file: impl Into<Utf8PathBuf>, source: io::Error) -> Self {
        use io::ErrorKind::{
            InvalidData, InvalidFilename, InvalidInput, IsADirectory, NotADirectory, NotFound,
            UnexpectedEof,
        };
        let file = file.into();
        match source.kind() {
            NotFound => Self::MissingFile { file },
            InvalidData => Self::malformed(file, "not a UTF-8 text file"),
            UnexpectedEof => Self::malformed(file, "the file is truncated"),
            IsADirectory | NotADirectory | InvalidFilename | InvalidInput => {
                Self::malformed(file, "not a file, or not a valid file name")
            }
            _ => Self::Io { file, source },
        }
    }

    pub(super) fn unsafe_entry(entry: &str, reason: &'static str) -> Self {
        Self::UnsafeEntry { entry: entry.into(), reason }
    }

    pub(super) fn malformed(file: impl Into<Utf8PathBuf>, reason: impl ToString) -> Self {
        Self::Malformed { file: file.into(), reason: reason.to_string() }
    }
}
