//! Point cloud and mesh files, recognized by their first bytes. Each file of this folder reads one
//! format. All of them pass points to a [`CloudBuilder`], which drops invalid points, thins out
//! clouds that are too large, and subtracts an offset from map coordinates.

mod color_range;
mod e57;
mod gathered;
mod gltf;
mod las;
mod mesh;
mod obj;
mod pcd;
mod ply;
mod text;
mod texture;

use super::IngestError;
use super::limited_reader::BYTE_ORDER_MARK;
use camino::Utf8Path;
use gathered::CloudBuilder;
pub(super) use gathered::{CloudBounds, CoordinateOrigin, LoadedCloud};
use std::fs::File;
use std::io::Read;
use uniground_geometry::up_axis::UpAxis;

/// A format of point clouds or meshes.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum CloudKind {
    Ply,
    Pcd,
    /// LAS and LAZ.
    Las,
    E57,
    /// Lines of numbers: XYZ, PTS, TXT, CSV.
    Text,
    Obj,
    /// glTF and GLB.
    Gltf,
}

/// Number of bytes that suffice to recognize a format.
const HEAD_BYTES: u64 = 4096;

impl CloudKind {
    /// Detects the format by a file's first bytes. If those are only numbers, its extension
    /// decides. `None`: not a supported cloud.
    pub fn detect(file: &Utf8Path) -> Option<Self> {
        let mut head = Vec::new();
        File::open(file).ok()?.take(HEAD_BYTES).read_to_end(&mut head).ok()?;
        Self::from_head(&head, file.extension().unwrap_or_default())
    }

    /// Detects the format by the first bytes. If those are only numbers, the extension decides.
    pub fn from_head(head: &[u8], extension: &str) -> Option<Self> {
        let head = head.strip_prefix(BYTE_ORDER_MARK).unwrap_or(head);
        if head.starts_with(b"ply") {
            return Some(Self::Ply);
        }
        if head.starts_with(b"LASF") {
            return Some(Self::Las);
        }
        if head.starts_with(b"ASTM-E57") {
            return Some(Self::E57);
        }
        if head.starts_with(b"glTF") {
            return Some(Self::Gltf);
        }
        let first = head.split(|b| *b == b'\n').find(|line| !line.trim_ascii().is_empty())?;
        if first.starts_with(b"# .PCD")
            || (first.starts_with(b"VERSION") && head.windows(6).any(|w| w == b"FIELDS"))
        {
            return Some(Self::Pcd);
        }
        // Binary data is not text, whatever its extension.
        let is_text = !head.contains(&0);
        match extension.to_ascii_lowercase().as_str() {
            "gltf" if is_text => Some(Self::Gltf),
            "obj" if is_text => Some(Self::Obj),
            "xyz" | "xyzn" | "xyzrgb" | "pts" | "txt" | "csv" | "asc"
                if is_text && text::can_read(head) =>
            {
                Some(Self::Text)
            }
            _ => None,
        }
    }

    /// Returns the up axis that the format defines.
    pub fn up_axis(self) -> Option<UpAxis> {
        match self {
            Self::Gltf => Some(UpAxis::Y),
            // Surveying formats: heights are z.
            Self::Las | Self::E57 => Some(UpAxis::Z),
            Self::Ply | Self::Pcd | Self::Text | Self::Obj => None,
        }
    }

    /// Returns whether the format defines lengths to be in meters.
    pub fn is_metric(self) -> bool {
        match self {
            Self::Gltf | Self::Las | Self::E57 => true,
            Self::Ply | Self::Pcd | Self::Text | Self::Obj => false,
        }
    }

    pub fn name(self) -> &'static str {
        match self {
            Self::Ply => "ply",
            Self::Pcd => "pcd",
            Self::Las => "las",
            Self::E57 => "e57",
            Self::Text => "xyz",
            Self::Obj => "obj",
            Self::Gltf => "gltf",
        }
    }
}

/// Checks the header of a cloud: whether its points can be read, and how many it announces.
///
/// # Errors
/// Returns an [`IngestError`] that names `file` (a path below `root`).
pub(super) fn check(
    root: &Utf8Path,
    file: &Utf8Path,
    bounds: &CloudBounds,
) -> Result<(), IngestError> {
    match detect_kind(root, file)? {
        CloudKind::Ply => ply::check(root, file, bounds),
        CloudKind::Pcd => pcd::check(root, file, bounds),
        CloudKind::Las => las::check(root, file, bounds),
        CloudKind::E57 => e57::check(root, file, bounds),
        // These formats announce no counts. They are checked while they are read.
        CloudKind::Text | CloudKind::Obj => Ok(()),
        CloudKind::Gltf => gltf::check(root, file),
    }
}

/// Reads a cloud. Points without color become mid-gray. Meshes are sampled evenly, always at the
/// same positions.
///
/// # Errors
/// Returns an [`IngestError`] that names `file` (a path below `root`).
pub(super) fn read(
    root: &Utf8Path,
    file: &Utf8Path,
    bounds: &CloudBounds,
    origin: CoordinateOrigin,
) -> Result<LoadedCloud, IngestError> {
    let kind = detect_kind(root, file)?;
    let loaded = read_with(root, file, kind, CloudBuilder::new(kind, bounds, origin))?;
    // The range of the colors is known only after all of them: a few wrong ones must not darken all
    // others.
    let Some(range) = loaded.other_color_range() else { return Ok(loaded) };
    let mut builder = CloudBuilder::new(kind, bounds, origin);
    builder.fix_color_range(range);
    read_with(root, file, kind, builder)
}

fn read_with(
    root: &Utf8Path,
    file: &Utf8Path,
    kind: CloudKind,
    gathered: CloudBuilder,
) -> Result<LoadedCloud, IngestError> {
    let gathered = match kind {
        CloudKind::Ply => ply::read(root, file, gathered),
        CloudKind::Pcd => pcd::read(root, file, gathered),
        CloudKind::Las => las::read(root, file, gathered),
        CloudKind::E57 => e57::read(root, file, gathered),
        CloudKind::Text => text::read(root, file, gathered),
        CloudKind::Obj => obj::read(root, file, gathered),
        CloudKind::Gltf => gltf::read(root, file, gathered),
    };
    gathered?.finish(file)
}

fn detect_kind(root: &Utf8Path, file: &Utf8Path) -> Result<CloudKind, IngestError> {
    let path = root.join(file);
    if !path.is_file() {
        return Err(IngestError::MissingFile { file: file.to_owned() });
    }
    match CloudKind::detect(&path) {
        Some(kind) => Ok(kind),
        // A file named `.ply` is always read as PLY, so that its reader reports what is wrong with
        // it.
        None if file.extension() == Some("ply") => Ok(CloudKind::Ply),
        None => Err(IngestError::malformed(
            file,
            "not a supported cloud: use PLY, PCD, LAS, LAZ, E57, XYZ, PTS, TXT, CSV, OBJ, glTF or GLB",
        )),
    }
}

/// Runs a third-party reader. Converts its panics on damaged files to errors.
fn catch_panics<T>(
    file: &Utf8Path,
    read: impl FnOnce() -> Result<T, IngestError> + std::panic::UnwindSafe,
) -> Result<T, IngestError> {
    std::panic::catch_unwind(read)
        .unwrap_or_else(|_| Err(IngestError::malformed(file, "it is damaged: its reader gave up")))
}
