//! Guesses the unit of length of a cloud that does not state it. Rooms are some meters across, so a
//! size of hundreds or thousands means centimeters or millimeters.

use super::IngestError;
use camino::Utf8Path;
use uniground_geometry::Point3;
use uniground_geometry::statistics::quantile;
use uniground_types::findings::{Finding, FindingSubject};

/// A unit that clouds come in.
struct LengthUnit {
    name: &'static str,
    meters: f64,
    /// How common it is.
    prior: f64,
}

const UNITS: [LengthUnit; 3] = [
    LengthUnit { name: "meters", meters: 1.0, prior: 0.9 },
    LengthUnit { name: "centimeters", meters: 0.01, prior: 0.03 },
    LengthUnit { name: "millimeters", meters: 0.001, prior: 0.07 },
];
/// Longest side of a typical indoor scan, meters, and the spreads of such sides as factors: most
/// scans lie between a corner of a room and an apartment, and halls are more common than things on
/// a table.
const TYPICAL_M: f64 = 6.0;
const SPREAD_BELOW: f64 = 1.8;
const SPREAD_ABOVE: f64 = 2.5;
/// Minimum probability of a unit. Below it, the caller has to state the unit.
pub(super) const LEAST_SURE: f64 = 0.75;
/// Longest side, meters, that any unit can lead to.
const LONGEST_M: f64 = 500.0;

/// The likeliest unit of a cloud.
struct UnitGuess {
    /// Longest side without outliers, in the cloud's units.
    across: f64,
    unit: &'static LengthUnit,
    /// Probability of the unit.
    sure: f64,
    next: &'static LengthUnit,
}

impl UnitGuess {
    /// Returns `None` if no unit gives a room.
    fn from_points(positions: &[Point3<f32>]) -> Option<Self> {
        let extent = |axis: usize| {
            let mut all: Vec<f32> = positions
                .iter()
                .step_by(positions.len().div_ceil(100_000).max(1))
                .map(|p| p[axis])
                .collect();
            quantile(&mut all, 0.99).unwrap_or(0.0) - quantile(&mut all, 0.01).unwrap_or(0.0)
        };
        let across = f64::from(extent(0).max(extent(1)).max(extent(2)));
        if !(across > 0.0 && across * UNITS[2].meters < LONGEST_M) {
            return None;
        }
        let likelihood = |unit: &LengthUnit| {
            let off = (across * unit.meters / TYPICAL_M).ln();
            let off = off / if off > 0.0 { SPREAD_ABOVE } else { SPREAD_BELOW }.ln();
            unit.prior * (-off * off / 2.0).exp()
        };
        let mut ranked = UNITS.each_ref().map(|unit| (likelihood(unit), unit));
        ranked.sort_by(|a, b| b.0.total_cmp(&a.0));
        let [(best, unit), (_, next), _] = ranked;
        let total = ranked.iter().map(|(likelihood, _)| likelihood).sum::<f64>();
        (total > 0.0).then(|| Self { across, unit, sure: best / total, next })
    }
}

/// Returns meters per unit of the likeliest unit.
pub(super) fn likeliest_meters_per_unit(positions: &[Point3<f32>]) -> f64 {
    UnitGuess::from_points(positions).map_or(1.0, |guess| guess.unit.meters)
}

/// Returns meters per unit of a cloud. Adds a finding, which is a warning if the unit is not meters.
///
/// # Errors
/// Returns [`IngestError::UnitUnknown`] when two units are about equally likely.
pub(super) fn guess_meters_per_unit(
    file: &Utf8Path,
    positions: &[Point3<f32>],
    findings: &mut Vec<Finding>,
) -> Result<f64, IngestError> {
    // An odd size is reported later.
    let Some(UnitGuess { across, unit, sure, next }) = UnitGuess::from_points(positions) else {
        return Ok(1.0);
    };
    if sure < LEAST_SURE {
        let reading = |unit: &LengthUnit| {
            let LengthUnit { name, meters, .. } = unit;
            format!("{:.2} m across with {name} (metres_per_unit={meters})", across * meters)
        };
        return Err(IngestError::UnitUnknown {
            file: file.to_owned(),
            readings: format!("{}, or {}", reading(unit), reading(next)),
        });
    }
    let text = match unit.meters == 1.0 {
        true => {
            format!("{file} does not state its unit: meters are assumed, {across:.2} m across")
        }
        false => format!(
            "the cloud is {across:.0} units across: {} are assumed (metres_per_unit={}); set metres_per_unit=1 if they are meters",
            unit.name, unit.meters
        ),
    };
    let finding = Finding::assumed(FindingSubject::Units, text)
        .in_file(file.as_str())
        .with_confidence(sure as f32)
        .stated_with("metres_per_unit");
    findings.push(if unit.meters == 1.0 { finding.without_warning() } else { finding });
    Ok(unit.meters)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Guesses the unit of a room of 6 x 5 x 2.7 m in another unit.
    fn guess(scale: f32) -> Result<(f64, Vec<Finding>), IngestError> {
        let room: Vec<_> = (0..1000)
            .map(|i| {
                Point3::new(
                    (i % 10) as f32 * 0.6,
                    (i / 10 % 10) as f32 * 0.5,
                    (i / 100) as f32 * 0.27,
                ) * scale
            })
            .collect();
        let mut findings = Vec::new();
        guess_meters_per_unit("room.ply".into(), &room, &mut findings).map(|unit| (unit, findings))
    }

    #[test]
    fn units_are_guessed_from_the_size_of_a_room() {
        for (scale, expected) in [
            (1.0, 1.0),
            (100.0, 0.01),
            (1000.0, 0.001),
            (0.3, 1.0),
            (0.01, 1.0),
            (10.0, 1.0),
            (60.0, 0.01),
        ] {
            let (unit, findings) = guess(scale).unwrap();
            assert_eq!(unit, expected, "{scale}");
            let [finding] = &findings[..] else { panic!("{findings:?}") };
            assert_eq!(finding.warning, expected != 1.0);
            assert!(f64::from(finding.confidence.unwrap()) >= LEAST_SURE);
        }
    }

    #[test]
    fn a_size_that_fits_two_units_is_refused_with_both() {
        let error = guess(26.0).unwrap_err().to_string();
        assert!(
            error.contains("metres_per_unit=1)") && error.contains("metres_per_unit=0.01)"),
            "{error}"
        );
        let error = guess(450.0).unwrap_err().to_string();
        assert!(error.contains("=0.01)") && error.contains("=0.001)"), "{error}");
    }
}
