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
    let decimal_commas = has_decimal_commas(text);
    let separates =
        |c: char| c.is_whitespace() || ";[](){}".contains(c) || (c == ',' && !decimal_commas);
    let words = text.split(separates).filter(|word| !word.is_empty());
    let value = |word: &str| match decimal_commas {
        true => word.replace(',', ".").parse(),
        false => word.parse(),
    };
    words.map(|word| value(word).map_err(|_| word)).collect()
}

/// Returns whether commas separate decimals: there are no points, at most one comma in a word, and
/// more digits behind a comma than sizes of pictures have.
fn has_decimal_commas(text: &str) -> bool {
    const MIN_DIGITS: usize = 5;
    let words = || text.split_whitespace().map(|word| word.trim_matches(['[', ']', ';']));
    let decimals = |word: &str| {
        let (_, decimals) = word.split_once(',')?;
        Some(decimals.bytes().take_while(u8::is_ascii_digit).count())
    };
    !text.contains('.')
        && words().all(|word| word.matches(',').count() <= 1 && !word.ends_with(','))
        && words().filter_map(decimals).any(|digits| digits >= MIN_DIGITS)
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn commas_separate_numbers_or_decimals() {
        assert_eq!(parse("585,320, 240").unwrap(), [585.0, 320.0, 240.0]);
        assert_eq!(parse("0.25,1 [2; 3]").unwrap(), [0.25, 1.0, 2.0, 3.0]);
        assert_eq!(parse("-0,123456 1,5\n2 3,25e1").unwrap(), [-0.123_456, 1.5, 2.0, 32.5]);
        assert_eq!(parse("1 two"), Err("two"));
    }
}
