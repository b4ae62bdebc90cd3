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

const UNITS: [LengthUnit; 6] = [
    LengthUnit { name: "meters", meters: 1.0, prior: 0.9 },
    LengthUnit { name: "millimeters", meters: 0.001, prior: 0.06 },
    LengthUnit { name: "centimeters", meters: 0.01, prior: 0.03 },
    LengthUnit { name: "feet", meters: 0.3048, prior: 0.004 },
    LengthUnit { name: "inches", meters: 0.0254, prior: 0.003 },
    LengthUnit { name: "decimeters", meters: 0.1, prior: 0.003 },
];
/// The longest side of a typical indoor scan: most scans lie between a corner of a room and an
/// apartment, and halls are more common than things on a table.
const LONGEST_SIDE: TypicalLength =
    TypicalLength { typical_m: 6.0, spread_below: 1.8, spread_above: 2.5 };
/// The shortest side, which is mostly the height. Many scans lack the ceiling.
const SHORTEST_SIDE: TypicalLength =
    TypicalLength { typical_m: 2.4, spread_below: 2.5, spread_above: 2.2 };
/// Minimum probability of a unit. Below it, the caller has to state the unit.
pub(super) const LEAST_SURE: f64 = 0.75;
/// Units of at least this probability are named beside the likeliest one.
const WORTH_NAMING: f64 = 0.02;
/// Below this probability, meters are a warning too.
const NEARLY_SURE: f64 = 0.9;
/// Longest side, meters, that any unit can lead to.
const LONGEST_M: f64 = 500.0;

/// A typical length, meters, and how far others are from it, as factors.
struct TypicalLength {
    typical_m: f64,
    spread_below: f64,
    spread_above: f64,
}

impl TypicalLength {
    /// Returns how common a length is, relative to the typical one.
    fn likelihood(&self, length_m: f64) -> f64 {
        let off = (length_m.max(1e-9) / self.typical_m).ln();
        let off = off / if off > 0.0 { self.spread_above } else { self.spread_below }.ln();
        (-off * off / 2.0).exp()
    }
}

/// The units that a cloud can be in.
struct UnitGuess {
    /// Longest and shortest side without outliers, in the cloud's units.
    longest: f64,
    shortest: f64,
    /// The units with their probabilities, the likeliest first.
    ranked: [(f64, &'static LengthUnit); UNITS.len()],
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
            f64::from(
                quantile(&mut all, 0.99).unwrap_or(0.0) - quantile(&mut all, 0.01).unwrap_or(0.0),
            )
        };
        let [x, y, z] = [0, 1, 2].map(extent);
        let (longest, shortest) = (x.max(y).max(z), x.min(y).min(z));
        let smallest = UNITS.iter().map(|unit| unit.meters).fold(f64::INFINITY, f64::min);
        if !(longest > 0.0 && longest * smallest < LONGEST_M) {
            return None;
        }
        let likelihood = |unit: &LengthUnit| {
            unit.prior
                * LONGEST_SIDE.likelihood(longest * unit.meters)
                * SHORTEST_SIDE.likelihood(shortest * unit.meters)
        };
        let mut ranked = UNITS.each_ref().map(|unit| (likelihood(unit), unit));
        ranked.sort_by(|a, b| b.0.total_cmp(&a.0));
        let total = ranked.iter().map(|(likelihood, _)| likelihood).sum::<f64>();
        ranked.iter_mut().for_each(|(likelihood, _)| *likelihood /= total);
        (total > 0.0).then_some(Self { longest, shortest, ranked })
    }

    /// Returns the size of the cloud in a unit, for people.
    fn size_in(&self, unit: &LengthUnit) -> String {
        let LengthUnit { name, meters, .. } = unit;
        let (long_m, short_m) = (self.longest * meters, self.shortest * meters);
        format!(
            "{name} (metres_per_unit={meters}), longest side {long_m:.2} m, shortest {short_m:.2} m"
        )
    }

    /// Returns the sizes in the other units that are worth naming.
    fn others(&self) -> Vec<String> {
        let [_, others @ ..] = &self.ranked;
        let worth = others.iter().filter(|(sure, _)| *sure >= WORTH_NAMING);
        worth.map(|(_, unit)| self.size_in(unit)).collect()
    }
}

/// Returns meters per unit of the likeliest unit.
pub(super) fn likeliest_meters_per_unit(positions: &[Point3<f32>]) -> f64 {
    UnitGuess::from_points(positions).map_or(1.0, |guess| guess.ranked[0].1.meters)
}

/// Returns meters per unit of a cloud. Adds a finding, which is a warning if the unit is not surely
/// meters.
///
/// # Errors
/// Returns [`IngestError::UnitUnknown`] when no unit is likely enough.
pub(super) fn guess_meters_per_unit(
    file: &Utf8Path,
    positions: &[Point3<f32>],
    findings: &mut Vec<Finding>,
) -> Result<f64, IngestError> {
    // An odd size is reported later.
    let Some(guess) = UnitGuess::from_points(positions) else { return Ok(1.0) };
    let (sure, unit) = guess.ranked[0];
    let (this, others) = (guess.size_in(unit), guess.others());
    if sure < LEAST_SURE {
        let readings: Vec<String> = std::iter::once(this).chain(others).collect();
        let readings = readings.join(", or ");
        return Err(IngestError::UnitUnknown { file: file.to_owned(), readings });
    }
    let less_likely = match others.is_empty() {
        true => String::new(),
        false => format!("; less likely: {}", others.join(", or ")),
    };
    let text = format!("{file} does not state its unit; assumed: {this}{less_likely}");
    let finding = Finding::assumed(FindingSubject::Units, text)
        .in_file(file.as_str())
        .with_confidence(sure as f32)
        .stated_with("metres_per_unit");
    let is_usual = unit.meters == 1.0 && sure >= NEARLY_SURE;
    findings.push(if is_usual { finding.without_warning() } else { finding });
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
            (3.0, 1.0),
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
        // A hall of 54 x 24 m, or a room in decimeters.
        let error = guess(10.0).unwrap_err().to_string();
        assert!(
            error.contains("metres_per_unit=1)") && error.contains("metres_per_unit=0.1)"),
            "{error}"
        );
        let error = guess(300.0).unwrap_err().to_string();
        assert!(error.contains("=0.01)") && error.contains("=0.001)"), "{error}");
    }

    /// A room in feet looks like a large hall in meters.
    #[test]
    fn less_common_units_are_named_beside_meters() {
        let (unit, findings) = guess(1.0 / 0.3048).unwrap();
        assert_eq!(unit, 1.0);
        assert!(findings[0].text.contains("feet (metres_per_unit=0.3048)"), "{findings:?}");
        let (_, findings) = guess(1.0).unwrap();
        assert!(!findings[0].text.contains("less likely"), "{findings:?}");
        let error = guess(1.0 / 0.0254).unwrap_err().to_string();
        assert!(error.contains("inches (metres_per_unit=0.0254)"), "{error}");
    }
}
