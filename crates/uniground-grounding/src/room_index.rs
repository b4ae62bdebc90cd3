//! An index of a room for the search among many rooms: the names and colors of its objects. It is
//! small enough to store for a million rooms, and selects the rooms whose instances are searched.

use super::names::GivenName;
use super::readings::Readings;
use std::collections::BTreeMap;
use uniground_geometry::color::ColorName;
use uniground_geometry::scene::{Instance, Level};
use uniground_language::{ME, Meaning, Phrase, parse};
use uniground_models::attributes::color_fit;

/// Number of guesses that count: later ones are likely mistakes.
const GUESSES: usize = 3;
/// A guess with a lower belief is ignored.
const LEAST_GUESS: f32 = 0.05;
/// Factor for parts and wholes: a room has some of any size.
const NOT_A_THING: f32 = 0.55;
/// A color that fits less than this does not describe the object.
const LEAST_COLOR: f32 = 0.2;
/// The same for a color that fits less than this share of the best: it is only similar to it.
const OF_THE_BEST: f32 = 0.6;
/// Fit of an object whose name says that it carries the requested one.
const CARRIES: f32 = 0.6;
/// Factor of a fit where the color is another, or unknown.
const OTHER_COLOR: f32 = 0.4;
/// Factors of a room in which an anchor of the target was not found, or the target itself.
const WITHOUT_ANCHOR: f32 = 0.3;
const WITHOUT_TARGET: f32 = 0.02;

/// Objects of a room that have a name and a color in common.
#[derive(Debug, Clone, PartialEq)]
pub struct Entry {
    /// The name in lower case, as given or guessed.
    pub name: String,
    /// A color that describes the objects; `None` where no color does.
    pub color: Option<ColorName>,
    /// The highest belief that one of them has this name, `0..=1`.
    pub weight: f32,
}

/// Returns the entries of a room's objects, in order of name and color. The building itself is in
/// every room, so it is left out.
#[must_use]
pub fn entries(instances: &[Instance]) -> Vec<Entry> {
    let mut best: BTreeMap<(String, Option<&'static str>), Entry> = BTreeMap::new();
    for instance in instances.iter().filter(|i| i.structure.is_none() && !i.dismissed && !i.gone) {
        let colors = colors_of(instance);
        for (name, weight) in names_of(instance) {
            for &color in &colors {
                let key = (name.clone(), color.map(ColorName::as_str));
                let entry = best.entry(key).or_insert(Entry { name: name.clone(), color, weight });
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

/// Returns the colors of an instance: at least one entry, which may be `None`.
fn colors_of(instance: &Instance) -> Vec<Option<ColorName>> {
    let fits = ColorName::ALL.map(|color| color_fit(color, instance));
    let least = LEAST_COLOR.max(OF_THE_BEST * fits.into_iter().fold(0.0, f32::max));
    let described = ColorName::ALL.into_iter().zip(fits).filter(|(_, fit)| *fit >= least);
    let colors: Vec<_> = described.map(|(color, _)| Some(color)).collect();
    if colors.is_empty() { vec![None] } else { colors }
}

/// The objects that a question looks for in a room: its target, and the anchors of the target.
pub struct Sought {
    phrases: Vec<SoughtPhrase>,
    /// Whether the first of them is the target itself. False where the target has no noun ("what is
    /// next to the piano").
    has_target: bool,
    /// The target in words, for an encoder.
    pub target: String,
}

struct SoughtPhrase {
    phrase: Phrase,
    readings: Readings,
}

impl Sought {
    /// Reads a question with the grammar.
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

    /// Returns how many objects the question names.
    #[must_use]
    pub fn len(&self) -> usize {
        self.phrases.len()
    }

    /// Returns whether the question names nothing.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.phrases.is_empty()
    }

    /// Returns how well a name fits the object at an index, `0..=1`.
    #[must_use]
    pub fn fit(&self, at: usize, name: &GivenName) -> f32 {
        let SoughtPhrase { phrase, readings } = &self.phrases[at];
        let called = readings.called(name);
        if called == 0.0 && name.carries(phrase, &phrase.meaning()) { CARRIES } else { called }
    }

    /// Returns the colors of the object at an index.
    #[must_use]
    pub fn colors(&self, at: usize) -> &[ColorName] {
        &self.phrases[at].phrase.colors
    }

    /// Returns the weight of a room's entry for the object at an index; `fit` is how well its name
    /// fits.
    #[must_use]
    pub fn weigh_entry(&self, at: usize, fit: f32, color: Option<ColorName>, weight: f32) -> f32 {
        let colors = self.colors(at);
        let has_color = colors.is_empty() || color.is_some_and(|color| colors.contains(&color));
        fit * weight * if has_color { 1.0 } else { OTHER_COLOR }
    }

    /// Returns how likely a room has all sought objects, given the weights of its best entries for
    /// each of them. Only for comparison with other rooms.
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
    fn room_entries_list_names_and_colors() {
        let wall = Instance { structure: Some(Structure::Wall), ..named(4, "wall", [200; 3]) };
        let room = [
            named(1, "Mug", [200, 20, 20]),
            named(2, "mug", [200, 20, 20]),
            named(3, "desk lamp", [20, 20, 200]),
            wall,
        ];
        let known: Vec<_> = entries(&room)
            .into_iter()
            .map(|e| (e.name, e.color.map(ColorName::as_str), e.weight))
            .collect();
        assert_eq!(
            known,
            [("desk lamp".into(), Some("blue"), 1.0), ("mug".into(), Some("red"), 1.0)]
        );
        // A guessed name counts by the belief in the guess.
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
    fn rooms_with_target_and_anchor_rank_first() {
        let sought = Sought::of("the red mug next to the printer");
        assert_eq!(sought.len(), 2);
        let fit = |at: usize, name: &str| sought.fit(at, &GivenName::read(name).unwrap());
        assert!(
            fit(0, "mug") > 0.9
                && fit(0, "coffee cup") > 0.0
                && fit(0, "printer") == 0.0
                && fit(1, "printer") > 0.9
        );
        let mug = |color| sought.weigh_entry(0, 1.0, Some(color), 1.0);
        assert!(mug(ColorName::Red) > mug(ColorName::Blue));
        let rooms =
            [[1.0, 1.0], [1.0, 0.0], [0.0, 1.0], [0.0, 0.0]].map(|found| sought.weigh_room(&found));
        assert!(rooms.is_sorted_by(|a, b| a > b), "{rooms:?}");
        // For a target without a name only its anchors are sought.
        let nameless = Sought::of("what is next to the piano");
        assert!(nameless.len() == 1 && nameless.weigh_room(&[1.0]) > nameless.weigh_room(&[0.0]));
        assert!(Sought::of("the thing").is_empty());
    }
}
