//! Whether something fits through, under, in, on or between objects.

use super::sentences::{be, meters, size};
use super::{AnswerValue, Grounding, Writer, value_of};
use crate::solid::Solid;
use uniground_language::{Passage, Way};

/// Free share of the height of a table or desk that stands on the floor.
const FREE_BELOW: f32 = 0.9;
/// An object whose underside is at least this high leaves free space below, meters.
const HANGS_M: f32 = 0.1;
/// Furniture with free space below: the last words of its names.
const WITH_FREE_SPACE: [&str; 4] = ["table", "desk", "bench", "stool"];
/// Confidence in whether something fits: boxes show neither handles nor legs.
const FIT_CONFIDENCE: f32 = 0.75;

/// Whether something fits, and the measures that tell it.
struct Fits {
    /// `None` if the boxes cannot tell it.
    yes: Option<bool>,
    measures: String,
}

/// What has to fit: an object of the room, or a given size.
enum Guest {
    Object(usize, Solid),
    Size(f32),
}

impl Writer<'_> {
    /// "Does the chair fit under the desk"
    pub(super) fn fit(&mut self, passage: &Passage, grounding: &mut Grounding) {
        let found = self.resolve(&passage.place);
        let Some(place) = found.index else {
            return Self::choose_nothing_without(&passage.place, &found, grounding);
        };
        let mut confidence = found.confidence;
        let guest = if let Some(given) = passage.given_m {
            Guest::Size(given)
        } else {
            let target = self.parsed.target.clone();
            let guest = self.resolve_target(&target);
            let Some(index) = guest.index else {
                return Self::choose_nothing_without(&target, &guest, grounding);
            };
            confidence = confidence.min(guest.confidence);
            Guest::Object(index, self.assessor.solids[index])
        };
        let mut second = None;
        if let Some(phrase) = &passage.second {
            let mut found = self.resolve(phrase);
            if found.index == Some(place) {
                found.index = found.next_to(place);
            }
            let Some(index) = found.index else {
                return Self::choose_nothing_without(phrase, &found, grounding);
            };
            confidence = confidence.min(found.confidence);
            second = Some((index, self.spoken_name(phrase, index)));
        }
        let place_name = self.spoken_name(&passage.place, place);
        let space = self.assessor.solids[place];
        let fits = match (passage.way, &second) {
            (_, Some((other, name))) => {
                let gap = space.horizontal_gap(&self.assessor.solids[*other]);
                fit_between(&guest, gap, &format!("{place_name} and {name}"))
            }
            (Way::Under, None) => fit_under(&guest, self.free_below(place), &space, &place_name),
            (Way::Through, None) => fit_through(&guest, &space, &place_name),
            (Way::In | Way::On | Way::Between, None) => {
                fit_into(&guest, passage.way, &space, &place_name)
            }
        };
        let shown = if let Guest::Object(index, _) = guest { index } else { place };
        let certainty = if fits.yes.is_some() { FIT_CONFIDENCE } else { 0.0 };
        let phrase = if shown == place { &*passage.place } else { &self.parsed.target };
        self.choose(shown, phrase, confidence.min(certainty), grounding);
        let id = |index: usize| self.instances()[index].id;
        let mut ids = vec![id(shown)];
        ids.extend((shown != place).then(|| id(place)));
        ids.extend(second.as_ref().map(|(other, _)| id(*other)));
        grounding.answer.anchor_id = ids.get(1).copied();
        grounding.value = fits.yes.map(|yes| AnswerValue { yes: Some(yes), ..value_of(&ids) });
        let measures = fits.measures;
        grounding.text = match fits.yes {
            Some(true) => format!("Yes, it should fit: {measures}."),
            Some(false) => format!("No: {measures}."),
            None => format!("I cannot tell: {measures}, but its box does not show the free space."),
        };
    }

    /// Returns the height of the free space below an object, meters; `None` where its box does not
    /// tell it.
    fn free_below(&self, index: usize) -> Option<f32> {
        let solid = &self.assessor.solids[index];
        let hangs = solid.bottom - self.floor_m();
        if hangs > HANGS_M {
            return Some(hangs);
        }
        let name = self.instances()[index].label();
        let is_table = WITH_FREE_SPACE.iter().any(|word| name.ends_with(word));
        is_table.then(|| FREE_BELOW * solid.size[2])
    }
}

fn fit_between(guest: &Guest, gap: f32, names: &str) -> Fits {
    let (needed, said) = match guest {
        Guest::Size(given) => (*given, String::new()),
        Guest::Object(_, solid) => {
            let short = solid.sides().1;
            (short, format!("it is at least {} wide, and ", meters(short)))
        }
    };
    Fits {
        yes: Some(needed < gap),
        measures: format!("{said}there are {} between {names}", meters(gap)),
    }
}

fn fit_under(guest: &Guest, free: Option<f32>, space: &Solid, name: &str) -> Fits {
    let (height, said) = match guest {
        Guest::Size(given) => (*given, String::new()),
        Guest::Object(_, solid) => {
            let height = solid.size[2];
            (height, format!("it is {} high, and ", meters(height)))
        }
    };
    match free {
        Some(free) => Fits {
            yes: Some(height < free),
            measures: format!("{said}there are about {} under {name}", meters(free)),
        },
        None => Fits {
            yes: (height >= space.size[2]).then_some(false),
            measures: format!("{said}{name} {} {} high", be(name), meters(space.size[2])),
        },
    }
}

fn fit_through(guest: &Guest, space: &Solid, name: &str) -> Fits {
    let (width, height) = (space.sides().0, space.size[2]);
    let (yes, said) = match guest {
        Guest::Size(given) => (*given < width, String::new()),
        Guest::Object(_, solid) => {
            let (short, tall) = (solid.sides().1, solid.size[2]);
            let said = format!("it is {} wide and {} high, and ", meters(short), meters(tall));
            (short < width && tall < height, said)
        }
    };
    let be = be(name);
    Fits {
        yes: Some(yes),
        measures: format!("{said}{name} {be} {} wide and {} high", meters(width), meters(height)),
    }
}

fn fit_into(guest: &Guest, way: Way, space: &Solid, name: &str) -> Fits {
    let (long, short) = space.sides();
    let (yes, said) = match guest {
        Guest::Size(given) => (*given < long, String::new()),
        Guest::Object(_, solid) => {
            let (own_long, own_short) = solid.sides();
            let is_low = way != Way::In || solid.size[2] < space.size[2];
            (own_long < long && own_short < short && is_low, format!("it is {}, and ", size(solid)))
        }
    };
    Fits { yes: Some(yes), measures: format!("{said}{name} {} {}", be(name), size(space)) }
}
