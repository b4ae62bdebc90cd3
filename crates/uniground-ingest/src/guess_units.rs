//! Guesses the unit of length of a cloud that does not state it. Rooms are some meters across, so a
//! size of hundreds or thousands means centimeters or millimeters.

use uniground_geometry::Point3;
use uniground_geometry::statistics::quantile;

/// Largest side of a cloud that is taken to be in meters. Halls and apartments are smaller.
const LARGEST_M: f32 = 150.0;
/// Largest side that is taken to be in centimeters. Above it, millimeters are assumed.
const LARGEST_CM: f32 = 2000.0;
/// Largest side that is taken to be in millimeters. Above it, no unit gives a room.
const LARGEST_MM: f32 = 200_000.0;

/// Returns meters per unit. Adds a warning if the guess is not meters.
pub(super) fn guess_meters_per_unit(positions: &[Point3<f32>], warnings: &mut Vec<String>) -> f64 {
    let extent = |axis: usize| {
        let mut all: Vec<f32> = positions
            .iter()
            .step_by(positions.len().div_ceil(100_000).max(1))
            .map(|p| p[axis])
            .collect();
        quantile(&mut all, 0.99).unwrap_or(0.0) - quantile(&mut all, 0.01).unwrap_or(0.0)
    };
    let across = extent(0).max(extent(1)).max(extent(2));
    let (metres, name) = match across {
        a if a <= LARGEST_M || a > LARGEST_MM => return 1.0,
        a if a <= LARGEST_CM => (0.01, "centimeters"),
        _ => (0.001, "millimeters"),
    };
    warnings.push(format!("the cloud is {across:.0} units across: {name} are assumed (metres_per_unit={metres}); set metres_per_unit=1 if they are meters"));
    metres
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn units_are_guessed_from_the_size_of_a_room() {
        for (scale, expected) in [(1.0, 1.0), (100.0, 0.01), (1000.0, 0.001), (0.3, 1.0)] {
            let room: Vec<_> = (0..1000)
                .map(|i| {
                    Point3::new(
                        (i % 10) as f32 * 0.6,
                        (i / 10 % 10) as f32 * 0.5,
                        (i / 100) as f32 * 0.27,
                    ) * scale
                })
                .collect();
            let mut warnings = Vec::new();
            assert_eq!(guess_meters_per_unit(&room, &mut warnings), expected);
            assert_eq!(warnings.is_empty(), expected == 1.0);
        }
    }
}
