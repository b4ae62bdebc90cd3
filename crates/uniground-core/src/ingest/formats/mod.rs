//! Dataset layouts. Each file knows one layout and describes it as a [`Scan`]; nothing is decoded here.

mod color_depth_pose;
mod neutral;

use super::bounded::read_text;
use super::scan::Scan;
use super::{IngestError, MAX_FRAMES};
use crate::geometry::Matrix4;
use camino::{Utf8Path, Utf8PathBuf};
use std::fs;

/// Reads the layout below `folder` without checking it.
///
/// # Errors
/// [`IngestError`] naming the file, or what the folder holds instead of a scan.
pub(super) fn read(folder: &Utf8Path) -> Result<Scan, IngestError> {
    let root = scene_root(folder)?;
    if root.join("scene.json").is_file() {
        neutral::read(&root)
    } else if color_depth_pose::recognises(&root) {
        color_depth_pose::read(&root)
    } else {
        Err(IngestError::UnknownLayout { found: describe(&root)? })
    }
}

/// Refuses a scan of more frames than are read.
fn check_frames(file: &str, frames: usize) -> Result<(), IngestError> {
    match frames > MAX_FRAMES {
        true => Err(IngestError::malformed(file, format!("{frames} frames, {MAX_FRAMES} are read at most: leave some out"))),
        false => Ok(()),
    }
}

/// Archives are often made of one folder: step into it. Files that operating systems leave behind are not looked at.
fn scene_root(folder: &Utf8Path) -> Result<Utf8PathBuf, IngestError> {
    match &entries(folder)?[..] {
        [only] if folder.join(only).is_dir() => Ok(folder.join(only)),
        _ => Ok(folder.to_owned()),
    }
}

fn describe(root: &Utf8Path) -> Result<String, IngestError> {
    let names = entries(root)?;
    let shown = names.iter().take(8).cloned().collect::<Vec<_>>().join(", ");
    Ok(match names.len() {
        0 => "nothing".into(),
        n if n > 8 => format!("{shown} and {} more", n - 8),
        _ => shown,
    })
}

/// Names in a folder, sorted, without hidden files and `__MACOSX`.
fn entries(folder: &Utf8Path) -> Result<Vec<String>, IngestError> {
    let io = |source| IngestError::Io { file: folder.file_name().unwrap_or("archive").into(), source };
    let mut names = Vec::new();
    for entry in fs::read_dir(folder).map_err(io)? {
        let name = entry.map_err(io)?.file_name().to_string_lossy().into_owned();
        if !name.starts_with('.') && name != "__MACOSX" {
            names.push(name);
        }
    }
    names.sort();
    Ok(names)
}

/// A matrix of 16 numbers is far shorter.
const MAX_MATRIX_BYTES: u64 = 16 << 10;

/// Reads a file of whitespace-separated numbers.
fn read_numbers(root: &Utf8Path, file: &Utf8Path) -> Result<Vec<f32>, IngestError> {
    let text = read_text(root, file, MAX_MATRIX_BYTES)?;
    text.split_whitespace()
        .map(|word| {
            word.trim_end_matches(',')
                .parse()
                .map_err(|_| IngestError::malformed(file, format!("{word:?} is not a number")))
        })
        .collect()
}

/// Reads a row-major 4x4 pose.
fn read_pose(root: &Utf8Path, file: &Utf8Path) -> Result<Matrix4<f32>, IngestError> {
    let values = read_numbers(root, file)?;
    match values.len() {
        16 => Ok(Matrix4::from_row_slice(&values)),
        n => Err(IngestError::malformed(file, format!("a pose has 16 numbers (4x4), this file has {n}"))),
    }
}
