//! What a room is known by among many: what its things are called, and their colours. Little enough
//! to be kept of a million rooms, it tells which of them are worth a look; what is in those, their
//! instances tell.

use super::names::GivenName;
use super::readings::Readings;
use std::collections::BTreeMap;
use uniground_geometry::colour::ColourName;
use uniground_geometry::scene::{Instance, Level};
use uniground_language::{ME, Meaning, Phrase, parse};
use uniground_models::attributes::colour_fit;

/// Of guesses so many count: later ones tell what a thing might be mistaken for.
const GUESSES: usize = 3;
/// A guess that is believed less says nothing.
const LEAST_GUESS: f32 = 0.05;
/// Something of any size is among the parts and wholes of a room.
const NOT_A_THING: f32 = 0.55;
/// A colour that describes a thing less is none of its own.
const LEAST_COLOUR: f32 = 0.2;
/// Nor is one that describes it so much less than another: those are its kin.
const OF_THE_BEST: f32 = 0.6;
/// What carries the thing that is asked for, as far as its name says.
const CARRIES: f32 = 0.6;
/// What is left of a fit where the colour is another, or not known.
const OTHER_COLOUR: f32 = 0.4;
/// What is left of a room in which what stands beside the thing was not found, or the thing itself.
const WITHOUT_ANCHOR: f32 = 0.3;
const WITHOUT_TARGET: f32 = 0.02;

/// Things of a room that have a name and a colour in common.
#[derive(Debug, Clone, PartialEq)]
pub struct Entry {
    /// In lower case, as somebody gave it or the naming guessed it.
    pub name: String,
    /// One that describes it; `None` where no colour does.
    pub colour: Option<ColourName>,
    /// How much the best of them is believed to be called so, `0..=1`.
    pub weight: f32,
}

/// What a room's things are known by, in order of name and colour. The building itself is in every
/// room and tells nothing.
#[must_use]
pub fn entries(instances: &[Instance]) -> Vec<Entry> {
    let mut best: BTreeMap<(String, Option<&'static str>), Entry> = BTreeMap::new();
    for instance in instances.iter().filter(|i| i.structure.is_none() && !i.dismissed && !i.gone) {
        let colours = colours_of(instance);
        for (name, weight) in names_of(instance) {
            for &colour in &colours {
                let key = (name.clone(), colour.map(ColourName::word));
                let entry = best.entry(key).or_insert(Entry { name: name.clone(), colour, weight });
                entry.weight = entry.weight.max(weight);
            }
        }
    }
    best.into_values().collect()
}

fn names_of(instance: &Instance) -> Vec<(String, f32)> {
    if let Some(given) = &instance.given_name {
        return vec![(given.trim().to_lowercase(), 1.0)];
    }
    let believed = if instance.level == Level::Thing { 1.0 } else { NOT_A_THING };
    let guesses = instance.names.iter().take(GUESSES).filter(|guess| guess.score >= LEAST_GUESS);
    guesses.map(|guess| (guess.name.to_lowercase(), believed * guess.score)).collect()
}

/// Its colours; at least one entry, which may be none.
fn colours_of(instance: &Instance) -> Vec<Option<ColourName>> {
    let fits = ColourName::ALL.map(|colour| colour_fit(colour, instance));
    let least = LEAST_COLOUR.max(OF_THE_BEST * fits.into_iter().fold(0.0, f32::max));
    let described = ColourName::ALL.into_iter().zip(fits).filter(|(_, fit)| *fit >= least);
    let colours: Vec<_> = described.map(|(colour, _)| Some(colour)).collect();
    if colours.is_empty() { vec![None] } else { colours }
}

/// What a question asks a room for: its thing, and what that stands beside.
pub struct Sought {
    phrases: Vec<SoughtPhrase>,
    /// The first of them is the thing itself: not where it is called nothing ("what is next to the
    /// piano").
    has_target: bool,
    /// The thing in words, for an encoder.
    pub target: String,
}

struct SoughtPhrase {
    phrase: Phrase,
    readings: Readings,
}

impl Sought {
    /// Reads a question by the grammar.
    #[must_use]
    pub fn of(query: &str) -> Self {
        let parsed = parse(query);
        let target = &parsed.target;
        let is_called = |phrase: &&Phrase| {
            matches!(phrase.meaning(), Meaning::Nouns(_) | Meaning::Unknown)
                && !phrase.head.is_empty()
        };
        let has_target = is_called(&target);
        let anchors = target
            .relations
            .iter()
            .filter(|relation| !relation.negated)
            .flat_map(|relation| &relation.anchors);
        let anchors = anchors.filter(|anchor| anchor.head != ME);
        let phrases = std::iter::once(target).chain(anchors).filter(is_called);
        let phrases = phrases
            .map(|phrase| SoughtPhrase { readings: Readings::of(phrase), phrase: phrase.clone() })
            .collect();
        Self { phrases, has_target, target: target.text() }
    }

    /// How many things it speaks of by a name.
    #[must_use]
    pub fn len(&self) -> usize {
        self.phrases.len()
    }

    /// Whether it names nothing.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.phrases.is_empty()
    }

    /// How well a name fits the thing at an index, `0..=1`.
    #[must_use]
    pub fn fit(&self, at: usize, name: &GivenName) -> f32 {
        let SoughtPhrase { phrase, readings } = &self.phrases[at];
        let called = readings.called(name);
        if called == 0.0 && name.carries(phrase, &phrase.meaning()) { CARRIES } else { called }
    }

    /// Colours that the thing at an index has.
    #[must_use]
    pub fn colours(&self, at: usize) -> &[ColourName] {
        &self.phrases[at].phrase.colours
    }

    /// What an entry of a room counts for the thing at an index, whose name fits it so well.
    #[must_use]
    pub fn weigh_entry(&self, at: usize, fit: f32, colour: Option<ColourName>, weight: f32) -> f32 {
        let colours = self.colours(at);
        let has_colour =
            colours.is_empty() || colour.is_some_and(|colour| colours.contains(&colour));
        fit * weight * if has_colour { 1.0 } else { OTHER_COLOUR }
    }

    /// How likely a room has it, by what its best entries count for each of the things; only to be
    /// compared with others.
    #[must_use]
    pub fn weigh_room(&self, entries: &[f32]) -> f32 {
        let of = |(at, found): (usize, &f32)| match at {
            0 if self.has_target => found.max(WITHOUT_TARGET),
            _ => WITHOUT_ANCHOR + (1.0 - WITHOUT_ANCHOR) * found,
        };
        entries.iter().enumerate().map(of).product()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use uniground_geometry::scene::{Structure, Support};
    use uniground_testing::thing;

    fn named(id: u32, name: &str, rgb: [u8; 3]) -> Instance {
        let instance = thing(id, [0.0, 0.0], [0.3; 3], 0.0, Support::Floor, rgb);
        Instance { given_name: Some(name.into()), ..instance }
    }

    #[test]
    fn a_room_is_known_by_what_its_things_are_called_and_their_colours() {
        let wall = Instance { structure: Some(Structure::Wall), ..named(4, "wall", [200; 3]) };
        let room = [
            named(1, "Mug", [200, 20, 20]),
            named(2, "mug", [200, 20, 20]),
            named(3, "desk lamp", [20, 20, 200]),
            wall,
        ];
        let known: Vec<_> = entries(&room)
            .into_iter()
            .map(|e| (e.name, e.colour.map(ColourName::word), e.weight))
            .collect();
        assert_eq!(
            known,
            [("desk lamp".into(), Some("blue"), 1.0), ("mug".into(), Some("red"), 1.0)]
        );
        // What only guesses tell is believed as far as they are.
        let guessed = Instance { given_name: None, ..named(1, "", [90; 3]) };
        let guessed =
            Instance { names: uniground_models::attributes::name_guesses(&guessed), ..guessed };
        let known = entries(std::slice::from_ref(&guessed));
        assert!(
            !known.is_empty()
                && known.len() <= GUESSES
                && known.iter().all(|entry| entry.weight < 1.0),
            "{known:?}"
        );
    }

    #[test]
    fn the_room_with_the_thing_and_what_stands_beside_it_is_likelier() {
        let sought = Sought::of("the red mug next to the printer");
        assert_eq!(sought.len(), 2);
        let fit = |at: usize, name: &str| sought.fit(at, &GivenName::read(name).unwrap());
        assert!(
            fit(0, "mug") > 0.9
                && fit(0, "coffee cup") > 0.0
                && fit(0, "printer") == 0.0
                && fit(1, "printer") > 0.9
        );
        let mug = |colour| sought.weigh_entry(0, 1.0, Some(colour), 1.0);
        assert!(mug(ColourName::Red) > mug(ColourName::Blue));
        let rooms =
            [[1.0, 1.0], [1.0, 0.0], [0.0, 1.0], [0.0, 0.0]].map(|found| sought.weigh_room(&found));
        assert!(rooms.is_sorted_by(|a, b| a > b), "{rooms:?}");
        // Of what has no name only what it stands beside is sought.
        let nameless = Sought::of("what is next to the piano");
        assert!(nameless.len() == 1 && nameless.weigh_room(&[1.0]) > nameless.weigh_room(&[0.0]));
        assert!(Sought::of("the thing").is_empty());
    }
}
