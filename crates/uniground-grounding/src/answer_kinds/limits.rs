//! Whether a size or a distance is within a limit that the question gives.

use super::measures::{length_error, measure, rounded};
use super::sentences::{be, capitalized};
use super::{AnswerValue, Grounding, Writer, value_of};
use crate::Unit;
use uniground_geometry::Point3;
use uniground_geometry::scene::{InstanceId, Structure, Support};
use uniground_language::{Bound, ComparedBy, Dimension, Limit, Reference, plural_of};

/// "2 m long" means 2 m plus or minus this share, or the error of the measurement.
const ABOUT: f32 = 0.1;

/// A length that was measured.
struct Length {
    meters: f32,
    error: f32,
    /// What it is in a sentence: "wide", "from the sofa".
    words: String,
    /// The instances it was measured of.
    ids: Vec<InstanceId>,
    line: Option<[Point3<f32>; 2]>,
}

impl Writer<'_> {
    /// "Is the door wider than 90 cm"
    pub(super) fn limit(&mut self, limit: &Limit, grounding: &mut Grounding) {
        let target = self.parsed.target.clone();
        let is_pair = matches!(&limit.by, ComparedBy::Distance(Reference::Object(other)) if **other == target);
        if limit.of_all
            && !is_pair
            && let Some(members) = self.members(&target).filter(|members| members.len() > 1)
        {
            return self.limit_of_all(limit, &members, grounding);
        }
        let found = self.resolve_target(&target);
        let Some(index) = found.index else {
            return Self::choose_nothing_without(&target, &found, grounding);
        };
        let Some((length, confidence)) = self.length(limit, index, grounding) else { return };
        let sure = sure(limit, &length);
        self.choose(
            index,
            &target,
            found.confidence.min(confidence) * (0.5 + 0.5 * sure),
            grounding,
        );
        grounding.answer.anchor_id = length.ids.get(1).copied();
        let yes = is_within(limit, &length);
        grounding.value = Some(AnswerValue {
            yes: Some(yes),
            number: Some(rounded(length.meters)),
            unit: Some(Unit::Meters),
            error: Some(rounded(length.error)),
            line: length.line.map(|line| line.map(Into::into)),
            ..value_of(&length.ids)
        });
        let name = if is_pair { self.names().the(index) } else { self.spoken_name(&target, index) };
        let name = capitalized(&name);
        let answer = if yes { "Yes" } else { "No" };
        let doubt = if sure < 1.0 && limit.bound != Bound::About {
            " That is within the error of the measurement."
        } else {
            ""
        };
        grounding.text = format!(
            "{answer}. {name} {} {} ± {} {}.{doubt}",
            be(&name),
            self.meters(length.meters),
            self.meters(length.error),
            length.words
        );
    }

    /// "Are all shelves lower than 2 m"
    fn limit_of_all(&mut self, limit: &Limit, members: &[(usize, f32)], grounding: &mut Grounding) {
        let target = self.parsed.target.clone();
        let mut lengths = Vec::with_capacity(members.len());
        let mut confidence = 1.0_f32;
        for (index, _) in members {
            let Some((length, found)) = self.length(limit, *index, grounding) else { return };
            confidence = confidence.min(found * (0.5 + 0.5 * sure(limit, &length)));
            lengths.push(length);
        }
        let outside: Vec<(usize, f32)> = members
            .iter()
            .zip(&lengths)
            .filter(|(_, length)| !is_within(limit, length))
            .map(|(member, _)| *member)
            .collect();
        let yes = outside.is_empty();
        self.choose_all(if yes { members } else { &outside }, &target, grounding);
        let belief = members.iter().map(|(_, belief)| *belief).fold(1.0, f32::min);
        grounding.confidence = confidence.min(belief);
        let ids: Vec<InstanceId> =
            members.iter().map(|(index, _)| self.instances()[*index].id).collect();
        grounding.value = Some(AnswerValue { yes: Some(yes), ..value_of(&ids) });
        let words = lengths.first().map_or("", |length| &length.words);
        let (least, most) = lengths
            .iter()
            .map(|length| length.meters)
            .fold((f32::INFINITY, 0.0_f32), |(least, most), m| (least.min(m), most.max(m)));
        let noun = plural_of(&super::sentences::spoken(&target));
        let asked = match limit.bound {
            Bound::Above => "more than",
            Bound::Below => "less than",
            Bound::About => "about",
        };
        let (answer, but) = if yes {
            ("Yes", String::new())
        } else {
            let be = if outside.len() > 1 { "are" } else { "is" };
            let given = self.meters(limit.given_m);
            ("No", format!("; {} {be} not {asked} {given}", self.listed(&outside)))
        };
        grounding.text = format!(
            "{answer}. The {} {noun} are {} to {} {words}{but}.",
            members.len(),
            self.meters(least),
            self.meters(most)
        );
    }

    /// Measures an instance as a limit says. Returns the length and the confidence in the other
    /// object; `None` where that is not found, which the answer then says.
    fn length(
        &mut self,
        limit: &Limit,
        index: usize,
        grounding: &mut Grounding,
    ) -> Option<(Length, f32)> {
        let instance = &self.instances()[index];
        let solid = self.assessor.solids[index];
        let reference = match &limit.by {
            ComparedBy::Dimension(dimension) => {
                let dimension = match (dimension, instance.structure, instance.support) {
                    (Dimension::Height, Some(Structure::Ceiling), _) => Dimension::Elevation,
                    // "The shelf is higher than 2 m": its top, where it stands on the floor.
                    (Dimension::Elevation, None, Support::Floor) => Dimension::Height,
                    (dimension, ..) => *dimension,
                };
                let (meters, _) = measure(&solid, dimension, self.floor_m());
                let error = length_error(instance, meters);
                let words = match dimension {
                    Dimension::All => "at its longest side",
                    Dimension::Height => "high",
                    Dimension::Width => "wide",
                    Dimension::Depth => "deep",
                    Dimension::Elevation => "above the floor",
                    Dimension::Length | Dimension::Area | Dimension::Volume => "long",
                };
                let (words, ids) = (words.to_owned(), vec![instance.id]);
                return Some((Length { meters, error, words, ids, line: None }, 1.0));
            }
            ComparedBy::Distance(reference) => reference,
        };
        let id = instance.id;
        let (other, name, other_id, confidence) = match reference {
            Reference::Observer => {
                let Some(observer) = self.assessor.observer else {
                    grounding.text =
                        "I do not know where you are. Send your position as the observer.".into();
                    return None;
                };
                (observer, "you".to_owned(), None, 1.0)
            }
            Reference::Object(phrase) => {
                let mut found = self.resolve(phrase);
                // "are the two stools more than 1 m apart"
                if found.index == Some(index) {
                    found.index = found.next_to(index);
                }
                let Some(other) = found.index else {
                    Self::choose_nothing_without(phrase, &found, grounding);
                    return None;
                };
                let name = if **phrase == self.parsed.target {
                    self.names().the(other)
                } else {
                    self.spoken_name(phrase, other)
                };
                let id = Some(self.instances()[other].id);
                (self.assessor.solids[other], name, id, found.confidence)
            }
        };
        let [from, to] = solid.nearest_points(&other);
        let length = Length {
            meters: solid.gap(&other),
            error: length_error(&self.instances()[index], 0.0),
            words: format!("from {name}"),
            ids: std::iter::once(id).chain(other_id).collect(),
            line: Some([from, to]),
        };
        Some((length, confidence))
    }
}

fn is_within(limit: &Limit, length: &Length) -> bool {
    match limit.bound {
        Bound::Above => length.meters > limit.given_m,
        Bound::Below => length.meters < limit.given_m,
        Bound::About => {
            (length.meters - limit.given_m).abs() <= length.error.max(ABOUT * limit.given_m)
        }
    }
}

/// Returns how far a length is from the limit, as a share of its error up to 1. Within the error it
/// is a guess.
fn sure(limit: &Limit, length: &Length) -> f32 {
    ((length.meters - limit.given_m).abs() / length.error.max(1e-3)).min(1.0)
}
