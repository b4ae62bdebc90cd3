//! Sizes and distances.

use super::sentences::{be, capitalized, in_unit, joined};
use super::{AnswerValue, Grounding, Status, Writer};
use crate::Unit;
use crate::solid::Solid;
use uniground_geometry::scene::{Instance, Structure};
use uniground_language::{Dimension, LengthUnit, Reference};

/// Expected error of one end of a measurement, meters: noise of the scan and the box's margin.
const END_ERROR_M: f32 = 0.02;
/// The same for an object that few photographs show, whose sides may be cut off.
const FEW_VIEWS_ERROR_M: f32 = 0.05;
/// Fewer photographs than this are few.
const FEW_VIEWS: usize = 3;
/// Additional error by the length of a side, as a share: occluded ends.
const OCCLUDED_SHARE: f32 = 0.03;

/// Returns the measure of a box in its unit: the longest side for [`Dimension::All`].
pub(super) fn measure(solid: &Solid, dimension: Dimension, floor_m: f32) -> (f32, Unit) {
    let (long, short) = solid.sides();
    match dimension {
        Dimension::All => (long.max(solid.size[2]), Unit::Meters),
        Dimension::Height => (solid.size[2], Unit::Meters),
        Dimension::Width | Dimension::Length => (long, Unit::Meters),
        Dimension::Depth => (short, Unit::Meters),
        Dimension::Area => (solid.area(), Unit::SquareMeters),
        Dimension::Volume => (solid.volume(), Unit::CubicMeters),
        Dimension::Elevation => (solid.bottom - floor_m, Unit::Meters),
    }
}

/// Returns the expected error of a length of an instance's box, meters.
pub(super) fn length_error(instance: &Instance, length: f32) -> f32 {
    2.0 * end_error(instance) + OCCLUDED_SHARE * length
}

fn end_error(instance: &Instance) -> f32 {
    if instance.views.len() < FEW_VIEWS { FEW_VIEWS_ERROR_M } else { END_ERROR_M }
}

/// Rounds to millimeters: digits beyond it would claim more than a scan can tell.
pub(super) fn rounded(value: f32) -> f32 {
    (value * 1e3).round() / 1e3
}

impl Writer<'_> {
    /// Returns a length in words, in the unit that the question asks for: "1.20 m", "47.2 inches".
    pub(super) fn meters(&self, length: f32) -> String {
        in_unit(length, self.parsed.unit)
    }

    /// Returns a measured value in words, in the unit that the question asks for: "1.20 m", "0.80
    /// square meters".
    pub(super) fn spoken(&self, number: f32, unit: Unit) -> String {
        let number = number.max(0.0);
        let (power, said) = match unit {
            Unit::Meters => return self.meters(number),
            Unit::SquareMeters => (2, "square"),
            Unit::CubicMeters => (3, "cubic"),
        };
        match self.parsed.unit.filter(|unit| *unit != LengthUnit::Meters) {
            None => format!("{number:.2} {said} meters"),
            Some(unit) => {
                let number = number / unit.meters().powi(power);
                let digits = usize::from(number < 100.0);
                format!("{number:.digits$} {said} {}", unit.as_str())
            }
        }
    }

    /// "0.85 m wide, 0.40 m deep and 1.20 m high"
    fn sides(&self, solid: &Solid) -> String {
        let (long, short) = solid.sides();
        let [long, short, height] = [long, short, solid.size[2]].map(|side| self.meters(side));
        format!("{long} wide, {short} deep and {height} high")
    }

    /// Returns the height of the floor, meters in the world frame.
    pub(super) fn floor_m(&self) -> f32 {
        let floors = self
            .instances()
            .iter()
            .zip(&self.assessor.solids)
            .filter(|(i, _)| i.structure == Some(Structure::Floor))
            .map(|(_, solid)| solid.top);
        floors.reduce(f32::min).unwrap_or_else(|| self.assessor.scene.extent.min().z)
    }

    pub(super) fn size(&mut self, dimension: Dimension, grounding: &mut Grounding) {
        if grounding.status == Status::Ambiguous && !grounding.alternatives.is_empty() {
            let of_each: Vec<String> = grounding
                .alternatives
                .iter()
                .map(|other| (other.id, &self.assessor.solids[other.id.0 as usize - 1]))
                .map(|(id, solid)| {
                    let (number, unit) = measure(solid, dimension, self.floor_m());
                    let name = self.names().the(id.0 as usize - 1);
                    format!("{name} ({id}) {}", self.spoken(number, unit))
                })
                .collect();
            grounding.text = format!("It depends on which one: {}.", joined(&of_each));
            return;
        }
        if let Some(sentence) = self.without_choice(grounding) {
            grounding.text = sentence;
            return;
        }
        let Some(index) = self.chosen(grounding) else { return };
        if grounding.targets.len() > 1 {
            let of_each: Vec<String> = grounding
                .targets
                .iter()
                .map(|target| {
                    let solid = &self.assessor.solids[target.id.0 as usize - 1];
                    let (number, unit) = measure(solid, dimension, self.floor_m());
                    format!("{} ({}) {}", target.name, target.id, self.spoken(number, unit))
                })
                .collect();
            grounding.text = format!("{}.", capitalized(&joined(&of_each)));
            return;
        }
        // The height of a ceiling is that above the floor, not its thickness.
        let is_ceiling = self.instances()[index].structure == Some(Structure::Ceiling);
        let dimension = match dimension {
            Dimension::Height if is_ceiling => Dimension::Elevation,
            dimension => dimension,
        };
        let (instance, solid) = (&self.instances()[index], &self.assessor.solids[index]);
        let (number, unit) = measure(solid, dimension, self.floor_m());
        let (long, short) = solid.sides();
        let error = match unit {
            Unit::Meters if dimension == Dimension::Elevation => end_error(instance),
            Unit::Meters => length_error(instance, number),
            Unit::SquareMeters => {
                long * length_error(instance, short) + short * length_error(instance, long)
            }
            Unit::CubicMeters => {
                number
                    * [long, short, solid.size[2]]
                        .iter()
                        .map(|side| length_error(instance, *side) / side.max(0.01))
                        .sum::<f32>()
            }
        };
        grounding.value = Some(AnswerValue {
            number: Some(rounded(number)),
            unit: Some(unit),
            error: Some(rounded(error)),
            size: Some([rounded(long), rounded(short), rounded(solid.size[2])]),
            instances: vec![instance.id],
            ..AnswerValue::default()
        });
        let name = capitalized(&self.target_name(index));
        let be = be(&name);
        let plus_minus = self.meters(error);
        grounding.text = match dimension {
            Dimension::All => format!("{name} {be} {}, each ± {plus_minus}.", self.sides(solid)),
            Dimension::Height => {
                let top = solid.top - self.floor_m();
                format!(
                    "{name} {be} {} high ± {plus_minus}; its top is {} above the floor.",
                    self.meters(number),
                    self.meters(top)
                )
            }
            Dimension::Width => format!("{name} {be} {} wide ± {plus_minus}.", self.meters(number)),
            Dimension::Length => {
                format!("{name} {be} {} long ± {plus_minus}.", self.meters(number))
            }
            Dimension::Depth => format!("{name} {be} {} deep ± {plus_minus}.", self.meters(number)),
            Dimension::Area => {
                let (number, error) = (self.spoken(number, unit), self.spoken(error, unit));
                format!("{name} covers {number} ± {error} of the floor.")
            }
            Dimension::Volume => {
                format!(
                    "The box of {} has {} ± {}.",
                    self.target_name(index),
                    self.spoken(number, unit),
                    self.spoken(error, unit)
                )
            }
            Dimension::Elevation => format!(
                "{name} {be} {} above the floor ± {plus_minus}, and its top {}.",
                self.meters(number.max(0.0)),
                self.meters(solid.top - self.floor_m())
            ),
        };
    }

    /// Returns the distances of all objects that the target may be, where several fit.
    fn distances_of_each(
        &mut self,
        reference: &Reference,
        grounding: &Grounding,
    ) -> Option<String> {
        if grounding.status != Status::Ambiguous || grounding.alternatives.is_empty() {
            return None;
        }
        let (other, name) = match reference {
            Reference::Observer => (self.assessor.observer?, "you".to_owned()),
            Reference::Object(phrase) => {
                let index = self.resolve(phrase).index?;
                (self.assessor.solids[index], self.spoken_name(phrase, index))
            }
        };
        let of_each: Vec<String> = grounding
            .alternatives
            .iter()
            .map(|alternative| {
                let index = alternative.id.0 as usize - 1;
                let gap = self.meters(self.assessor.solids[index].gap(&other));
                format!("{} ({}) {gap}", self.names().the(index), alternative.id)
            })
            .collect();
        Some(format!("It depends on which one: {} from {name}.", joined(&of_each)))
    }

    pub(super) fn distance(&mut self, reference: &Reference, grounding: &mut Grounding) {
        if let Some(sentence) = self.distances_of_each(reference, grounding) {
            grounding.text = sentence;
            return;
        }
        if let Some(sentence) = self.without_choice(grounding) {
            grounding.text = sentence;
            return;
        }
        let Some(index) = self.chosen(grounding) else { return };
        let target = self.assessor.solids[index];
        let (other, other_name, other_index) = match reference {
            Reference::Observer => {
                let Some(observer) = self.assessor.observer else {
                    grounding.text = format!(
                        "I know where {} is, but not where you are. Send your position as the observer.",
                        self.target_name(index)
                    );
                    return;
                };
                (observer, "you".to_owned(), None)
            }
            Reference::Object(phrase) => {
                let mut found = self.resolve(phrase);
                // "how far apart are the two stools"
                if found.index == Some(index) {
                    found.index = found.next_to(index);
                    if found.index.is_none() {
                        grounding.text = format!("Both are {}.", self.names().the(index));
                        return;
                    }
                }
                let Some(other) = found.index else {
                    return Self::choose_nothing_without(phrase, &found, grounding);
                };
                grounding.confidence = grounding.confidence.min(found.confidence);
                grounding.answer.anchor_id = Some(self.instances()[other].id);
                let name = if **phrase == self.parsed.target {
                    self.names().the(other)
                } else {
                    self.spoken_name(phrase, other)
                };
                (self.assessor.solids[other], name, Some(other))
            }
        };
        let [from, to] = target.nearest_points(&other);
        let gap = target.gap(&other);
        let error = end_error(&self.instances()[index])
            + other_index.map_or(END_ERROR_M, |other| end_error(&self.instances()[other]));
        let mut instances = vec![self.instances()[index].id];
        instances.extend(other_index.map(|other| self.instances()[other].id));
        grounding.value = Some(AnswerValue {
            number: Some(rounded(gap)),
            unit: Some(Unit::Meters),
            error: Some(rounded(error)),
            instances,
            line: Some([from.into(), to.into()]),
            ..AnswerValue::default()
        });
        let name = capitalized(&self.target_name(index));
        let be = be(&name);
        let between = if other_index.is_some() { ", between their nearest sides" } else { "" };
        grounding.text = if gap < 0.005 {
            format!("{name} touches {other_name}.")
        } else {
            format!(
                "{name} {be} {} from {other_name} ± {}{between}.",
                self.meters(gap),
                self.meters(error)
            )
        };
    }
}
