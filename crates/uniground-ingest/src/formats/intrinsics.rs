//! Reads camera matrices from separate files.

use super::files::{FolderListing, TextFiles};
use super::numbers::parse;
use crate::IngestError;
use crate::scan::picture_size;
use camino::{Utf8Path, Utf8PathBuf};
use serde::Deserialize;
use uniground_geometry::scene::Intrinsics;

/// Usual names of color camera matrices, the most common first.
const NAMES: [&str; 15] = [
    "intrinsic.txt",
    "intrinsics.txt",
    "intrinsic/intrinsic_color.txt",
    "intrinsic_color.txt",
    "intrinsics_color.txt",
    "color_intrinsic.txt",
    "camera-intrinsics.txt",
    "camera_intrinsics.txt",
    "camera_matrix.txt",
    "K.txt",
    "cam_K.txt",
    "camera_K.txt",
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

/// A camera by its parameters.
#[derive(Deserialize)]
struct NamedParameters {
    #[serde(alias = "w")]
    width: Option<u32>,
    #[serde(alias = "h")]
    height: Option<u32>,
    #[serde(alias = "fl_x")]
    fx: f32,
    #[serde(alias = "fl_y")]
    fy: f32,
    #[serde(alias = "ppx")]
    cx: f32,
    #[serde(alias = "ppy")]
    cy: f32,
}

#[derive(Deserialize)]
#[serde(untagged)]
enum JsonCamera {
    Matrix(Open3d),
    Named(NamedParameters),
}

/// Names of the parameters in text files.
const PARAMETERS: [&str; 4] = ["fx", "fy", "cx", "cy"];

/// Returns the values of `fx`, `fy`, `cx` and `cy`, if a text gives them by name.
fn named_parameters(text: &str) -> Option<[f64; 4]> {
    let separates = |c: char| c.is_whitespace() || ",;:={}\"'".contains(c);
    let words: Vec<&str> = text.split(separates).filter(|word| !word.is_empty()).collect();
    let value = |name: &str| {
        let at = words.iter().position(|word| word.eq_ignore_ascii_case(name))?;
        words.get(at + 1)?.parse().ok()
    };
    let [fx, fy, cx, cy] = PARAMETERS.map(value);
    Some([fx?, fy?, cx?, cy?])
}

/// Returns the file with the color camera's matrix.
pub(super) fn find_color_file(folder: &FolderListing) -> Option<Utf8PathBuf> {
    folder.first_file(&NAMES)
}

/// Reads the color camera. Matrices without a size apply to the size of the first color picture.
pub(super) fn read_color_intrinsics(
    folder: &FolderListing,
    picture: &Utf8Path,
) -> Result<Intrinsics, IngestError> {
    match find_color_file(folder) {
        Some(file) => read_intrinsics(&folder.root, &file, picture),
        None => Err(IngestError::MissingIntrinsics { file: NAMES[0].into() }),
    }
}

/// Reads a 3x3 or 4x4 matrix, four numbers `fx fy cx cy` with or without their names, or JSON with
/// Open3D's matrix or with these names. Without a size of its own, the picture's size is used.
pub(super) fn read_intrinsics(
    root: &TextFiles,
    file: &Utf8Path,
    picture: &Utf8Path,
) -> Result<Intrinsics, IngestError> {
    if file.extension() == Some("json") {
        let text = root.read_text(file, MAX_JSON_BYTES)?;
        let camera: JsonCamera = serde_json::from_str(&text).map_err(|_| {
            IngestError::malformed(
                file,
                "expected width, height and intrinsic_matrix (9 numbers, column by column), or fx, fy, cx and cy",
            )
        })?;
        let Open3d { width, height, intrinsic_matrix } = match camera {
            JsonCamera::Matrix(camera) => camera,
            JsonCamera::Named(NamedParameters { width, height, fx, fy, cx, cy }) => {
                let own =
                    intrinsics_from_values(root, file, &[fx, fy, cx, cy].map(f64::from), picture)?;
                return Ok(match (width, height) {
                    (Some(width), Some(height)) => Intrinsics { width, height, ..own },
                    _ => own,
                });
            }
        };
        return match intrinsic_matrix[..] {
            [fx, _, _, _, fy, _, cx, cy, _] => Ok(Intrinsics { width, height, fx, fy, cx, cy }),
            _ => Err(IngestError::malformed(
                file,
                format!("intrinsic_matrix has {} numbers, 9 are expected", intrinsic_matrix.len()),
            )),
        };
    }
    let text = root.read_text(file, MAX_JSON_BYTES)?;
    if let Some(values) = named_parameters(&text) {
        return intrinsics_from_values(root, file, &values, picture);
    }
    let values = parse(&text)
        .map_err(|word| IngestError::malformed(file, format!("{word:?} is not a number")))?;
    intrinsics_from_values(root, file, &values, picture)
}

/// Builds the same from given numbers.
pub(super) fn intrinsics_from_values(
    root: &TextFiles,
    file: &Utf8Path,
    values: &[f64],
    picture: &Utf8Path,
) -> Result<Intrinsics, IngestError> {
    // A camera matrix has zeros below its diagonal. If they are beside it, it is written column by
    // column.
    let by_columns = |beside: [usize; 2], below: [usize; 2]| {
        beside.iter().all(|&i| values[i] == 0.0) && below.iter().all(|&i| values[i] != 0.0)
    };
    let at = match values.len() {
        9 if by_columns([2, 5], [6, 7]) => [0, 4, 6, 7],
        9 => [0, 4, 2, 5],
        16 if by_columns([2, 6], [8, 9]) => [0, 5, 8, 9],
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
pub(super) fn read_pincam(root: &TextFiles, file: &Utf8Path) -> Result<Intrinsics, IngestError> {
    let text = root.read_text(file, MAX_JSON_BYTES)?;
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
