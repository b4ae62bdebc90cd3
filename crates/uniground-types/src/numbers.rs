//! Checks of numbers in requests. Each check rejects values that are not finite and names the
//! field.
//!
//! Query parameters and the command line accept `NaN` and `inf` as numbers, and a large number in
//! JSON becomes an infinite `f32`.

use crate::problem::FieldError;
use std::fmt::Display;
use std::ops::RangeInclusive;

/// Maximum absolute value of a coordinate, in any unit.
const FARTHEST: f64 = 1e9;

/// Checks that a number is in a range.
///
/// # Errors
/// Returns a [`FieldError`] that names the field.
pub fn check_in_range<T: PartialOrd + Display>(
    pointer: &str,
    value: T,
    range: RangeInclusive<T>,
) -> Result<(), FieldError> {
    match range.contains(&value) {
        true => Ok(()),
        false => {
            Err(FieldError::new(pointer, format!("must be {} to {}", range.start(), range.end())))
        }
    }
}

/// Checks that a number is above zero and at most `most`.
///
/// # Errors
/// Returns a [`FieldError`] that names the field.
pub fn check_above_zero<T: PartialOrd + Display + Default>(
    pointer: &str,
    value: T,
    most: T,
) -> Result<(), FieldError> {
    match value > T::default() && value <= most {
        true => Ok(()),
        false => Err(FieldError::new(pointer, format!("must be above 0 and at most {most}"))),
    }
}

/// Checks that a number is finite and not negative.
///
/// # Errors
/// Returns a [`FieldError`] that names the field.
pub fn check_zero_or_more(pointer: &str, value: f64) -> Result<(), FieldError> {
    match value.is_finite() && value >= 0.0 {
        true => Ok(()),
        false => Err(FieldError::new(pointer, "must be 0 or more")),
    }
}

/// Checks that a number is finite.
///
/// # Errors
/// Returns a [`FieldError`] that names the field.
pub fn check_finite(pointer: &str, value: f64) -> Result<(), FieldError> {
    match value.is_finite() {
        true => Ok(()),
        false => Err(FieldError::new(pointer, "must be a finite number")),
    }
}

/// Checks that coordinates lie within a billion units of the origin.
///
/// # Errors
/// Returns a [`FieldError`] that names the field.
pub fn check_coordinates(pointer: &str, values: &[f64]) -> Result<(), FieldError> {
    match values.iter().all(|value| value.abs() <= FARTHEST) {
        true => Ok(()),
        false => Err(FieldError::new(pointer, "must be within a billion of the origin")),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_that_are_not_finite_or_out_of_range_are_rejected() {
        for value in [f64::NAN, f64::INFINITY, f64::NEG_INFINITY, -1.0] {
            assert!(check_zero_or_more("/x", value).is_err(), "{value}");
            assert!(check_above_zero("/x", value, f64::MAX).is_err(), "{value}");
            assert!(check_in_range("/x", value, 0.0..=f64::MAX).is_err(), "{value}");
        }
        for value in [f64::NAN, f64::INFINITY, 1e10] {
            assert!(check_coordinates("/x", &[0.0, value]).is_err(), "{value}");
        }
        assert!(
            check_finite("/x", f64::from(f32::INFINITY)).is_err()
                && check_finite("/x", -1e300).is_ok()
        );
        assert!(
            check_above_zero("/x", 0.0, 1.0).is_err() && check_above_zero("/x", 1.0, 1.0).is_ok()
        );
        assert_eq!(check_in_range("/x", 3, 1..=2).unwrap_err().to_string(), "/x: must be 1 to 2");
    }
}
