//! Reads camera matrices from separate files.

use super::files::FolderListing;
use super::numbers::{parse, read_numbers};
use crate::IngestError;
use crate::limited_reader::read_text;
use crate::scan::picture_size;
use camino::{Utf8Path, Utf8PathBuf};
use serde::Deserialize;
use uniground_geometry::scene::Intrinsics;

/// Usual names of color camera matrices, the most common first.
const NAMES: [&str; 12] = [
    "intrinsic.txt",
    "intrinsics.txt",
    "intrinsic/intrinsic_color.txt",
    "intrinsic_color.txt",
    "intrinsics_color.txt",
    "color_intrinsic.txt",
    "camera-intrinsics.txt",
    "camera_intrinsics.txt",
    "camera_matrix.txt",
    "intrinsic.json",
    "camera_intrinsic.json",
    "intrinsics.json",
];
const MAX_JSON_BYTES: u64 = 64 << 10;

/// Open3D's description of a camera. The matrix is column-major.
#[derive(Deserialize)]
struct Open3d {
    width: u32,
    height: u32,
    intrinsic_matrix: Vec<f32>,
}

/// Returns the file with the color camera's matrix.
pub(super) fn find_color_file(folder: &FolderListing) -> Option<Utf8PathBuf> {
    folder.first_file(&NAMES)
}

/// Reads the color camera. Matrices without a size apply to the size of the first color picture.
pub(super) fn read_color_intrinsics(
    folder: &FolderListing,
    first_color: &Utf8Path,
) -> Result<Intrinsics, IngestError> {
    match find_color_file(folder) {
        Some(file) => read_intrinsics(&folder.root, &file, first_color),
        None => Err(IngestError::MissingIntrinsics { file: NAMES[0].into() }),
    }
}

/// Reads a 3x3 or 4x4 matrix, four numbers `fx fy cx cy`, or Open3D's JSON. Without a size of its
/// own, the picture's size is used.
pub(super) fn read_intrinsics(
    root: &Utf8Path,
    file: &Utf8Path,
    picture: &Utf8Path,
) -> Result<Intrinsics, IngestError> {
    if file.extension() == Some("json") {
        let text = read_text(root, file, MAX_JSON_BYTES)?;
        let camera: Open3d =
            serde_json::from_str(&text).map_err(|e| IngestError::malformed(file, e))?;
        let Open3d { width, height, intrinsic_matrix } = camera;
        return match intrinsic_matrix[..] {
            [fx, _, _, _, fy, _, cx, cy, _] => Ok(Intrinsics { width, height, fx, fy, cx, cy }),
            _ => Err(IngestError::malformed(
                file,
                format!("intrinsic_matrix has {} numbers, 9 are expected", intrinsic_matrix.len()),
            )),
        };
    }
    let values = read_numbers(root, file)?;
    intrinsics_from_values(root, file, &values, picture)
}

/// Builds the same from given numbers.
pub(super) fn intrinsics_from_values(
    root: &Utf8Path,
    file: &Utf8Path,
    values: &[f64],
    picture: &Utf8Path,
) -> Result<Intrinsics, IngestError> {
    let at = match values.len() {
        9 => [0, 4, 2, 5],
        16 => [0, 5, 2, 6],
        4 => [0, 1, 2, 3],
        n => {
            return Err(IngestError::malformed(
                file,
                format!("a camera matrix has 9 or 16 numbers, this file has {n}"),
            ));
        }
    };
    let [fx, fy, cx, cy] = at.map(|i| values[i] as f32);
    let (width, height) = picture_size(root, picture)?
        .ok_or_else(|| IngestError::malformed(picture, "the picture does not state its size"))?;
    Ok(Intrinsics { width, height, fx, fy, cx, cy })
}

/// Reads `width height fx fy cx cy`, the format of ARKitScenes.
pub(super) fn read_pincam(root: &Utf8Path, file: &Utf8Path) -> Result<Intrinsics, IngestError> {
    let text = read_text(root, file, MAX_JSON_BYTES)?;
    let values = parse(&text)
        .map_err(|word| IngestError::malformed(file, format!("{word:?} is not a number")))?;
    let [w, h, fx, fy, cx, cy] = values[..] else {
        return Err(IngestError::malformed(
            file,
            format!(
                "a camera has 6 numbers (width height fx fy cx cy), this file has {}",
                values.len()
            ),
        ));
    };
    Ok(Intrinsics {
        width: w as u32,
        height: h as u32,
        fx: fx as f32,
        fy: fy as f32,
        cx: cx as f32,
        cy: cy as f32,
    })
}
