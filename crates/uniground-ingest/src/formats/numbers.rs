//! Reads numbers, matrices and quaternions from text files.

use crate::IngestError;
use crate::limited_reader::read_text;
use camino::Utf8Path;
use nalgebra::{Matrix4, Quaternion, UnitQuaternion};

/// Maximum size of a matrix file. A matrix of 16 numbers is far shorter.
const MAX_MATRIX_BYTES: u64 = 16 << 10;

/// Reads a short file of numbers, separated as [`parse`] accepts it.
pub(super) fn read_numbers(root: &Utf8Path, file: &Utf8Path) -> Result<Vec<f64>, IngestError> {
    let text = read_text(root, file, MAX_MATRIX_BYTES)?;
    parse(&text).map_err(|word| IngestError::malformed(file, format!("{word:?} is not a number")))
}

/// Parses numbers separated by white space, commas, semicolons or brackets, as programs print
/// matrices. Returns the first invalid word as an error.
pub(super) fn parse(text: &str) -> Result<Vec<f64>, &str> {
    let separates = |c: char| c.is_whitespace() || ",;[](){}".contains(c);
    let words = text.split(separates).filter(|word| !word.is_empty());
    words.map(|word| word.parse().map_err(|_| word)).collect()
}

/// Reads a pose: a row-major 4x4 matrix, a 3x4 matrix without the last row, or a position and a
/// quaternion (`x y z qx qy qz qw`), with or without a time before them.
pub(super) fn read_pose(root: &Utf8Path, file: &Utf8Path) -> Result<Matrix4<f64>, IngestError> {
    let values = read_numbers(root, file)?;
    if let [x, y, z, qx, qy, qz, qw] | [_, x, y, z, qx, qy, qz, qw] = values[..] {
        return Ok(pose_from_quaternion([x, y, z], [qx, qy, qz, qw]));
    }
    matrix_from_values(&values).ok_or_else(|| {
        IngestError::malformed(
            file,
            format!(
                "a pose has 16 numbers (4x4), or 7 (position and quaternion), this file has {}",
                values.len()
            ),
        )
    })
}

/// Builds a matrix from 16 or 12 numbers, row-major.
pub(super) fn matrix_from_values(values: &[f64]) -> Option<Matrix4<f64>> {
    match values.len() {
        16 => Some(Matrix4::from_row_slice(values)),
        12 => Some(Matrix4::from_row_slice(&[values, &[0.0, 0.0, 0.0, 1.0]].concat())),
        _ => None,
    }
}

/// Builds a pose from a position and a quaternion `x y z w`. Returns NaN for a quaternion of length
/// zero: a later check reports it with the frame's name.
pub(super) fn pose_from_quaternion(
    [x, y, z]: [f64; 3],
    [qx, qy, qz, qw]: [f64; 4],
) -> Matrix4<f64> {
    let quaternion = Quaternion::new(qw, qx, qy, qz);
    if !(quaternion.norm() > 0.1 && quaternion.norm() < 10.0) {
        return Matrix4::from_element(f64::NAN);
    }
    let rotation = UnitQuaternion::new_normalize(quaternion).to_homogeneous();
    Matrix4::new_translation(&nalgebra::Vector3::new(x, y, z)) * rotation
}

/// Returns the values of `key` in `key = values` lines, as ScanNet and 3RScan write them.
pub(super) fn find_values<'a>(text: &'a str, key: &str) -> Option<&'a str> {
    text.lines().find_map(|line| {
        let (name, value) = line.split_once('=')?;
        (name.trim() == key).then(|| value.trim())
    })
}
