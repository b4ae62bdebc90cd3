//! An index of the names that a person or a vision-language model gave the instances: free phrases
//! ("lime green bean bag chair"), parsed by the grammar once and compared with the requested
//! object.

use super::kinds::kind_fit;
use uniground_geometry::color::ColorName;
use uniground_geometry::scene::{Instance, Structure};
use uniground_language::{self, Meaning, Phrase};
use uniground_models::attributes::{Lexicon, WordNet};

/// The names of a scene's instances.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct NameIndex {
    /// By instance index; `None` for those without a name.
    of: Vec<Option<GivenName>>,
}

impl NameIndex {
    /// Parses the names that the instances were given.
    #[must_use]
    pub fn of(instances: &[Instance]) -> Self {
        if instances.iter().all(|i| i.given_name.is_none()) {
            return Self::default();
        }
        Self {
            of: instances
                .iter()
                .map(|i| i.given_name.as_deref().and_then(GivenName::read))
                .collect(),
        }
    }

    /// Returns the name of the instance at an index.
    #[must_use]
    pub fn get(&self, index: usize) -> Option<&GivenName> {
        self.of.get(index)?.as_ref()
    }

    /// Returns whether no instance has a name.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.of.is_empty()
    }
}

/// The kind of object that a name describes.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Kind {
    Thing,
    /// "part of a bed": not the bed itself.
    Part,
    /// A piece of the building.
    Structure(Structure),
    /// Noise of the scan.
    NotAThing,
}

/// A parsed name.
#[derive(Debug, Clone, PartialEq)]
pub struct GivenName {
    kind: Kind,
    /// What it names; for a part, the object it belongs to.
    phrase: Phrase,
    /// The words that name the object itself, in the singular, before any that lead elsewhere ("on
    /// the desk").
    words: Vec<String>,
}

/// Fit of a part to a question for the object it belongs to.
const PART: f32 = 0.35;
/// Fit of a name that has all requested words, its noun among them.
const SAME_WORDS: f32 = 0.9;
/// Fit of a name that has all requested words beside its noun: a "bean bag chair" for "bean bag".
const WORDS_BESIDE_ITS_NOUN: f32 = 0.6;
/// Words after which a name describes other objects.
const ELSEWHERE: [&str; 17] = [
    "with", "under", "on", "in", "near", "next", "behind", "beside", "above", "below", "against",
    "at", "by", "beneath", "of", "from", "holding",
];
/// Words for a stretch of a wall, a floor or a ceiling.
const STRETCH: [&str; 14] = [
    "section", "panel", "corner", "area", "surface", "edge", "patch", "piece", "portion", "trim",
    "segment", "strip", "part", "fragment",
];
const NOTHING: [&str; 7] =
    ["not a thing", "nothing", "no object", "noise", "artifact", "artefact", "empty"];
const UNCLEAR: [&str; 7] = [
    "unclear",
    "unknown",
    "unidentified",
    "unidentifiable",
    "unrecognizable",
    "unrecognisable",
    "n/a",
];

impl GivenName {
    /// Parses a name; `None` where it says that the object could not be recognized.
    #[must_use]
    pub fn read(text: &str) -> Option<Self> {
        let text = text.trim().trim_end_matches('.').to_lowercase();
        if text.is_empty() || UNCLEAR.iter().any(|word| text.starts_with(word)) {
            return None;
        }
        if NOTHING.iter().any(|word| text.starts_with(word)) {
            return Some(Self {
                kind: Kind::NotAThing,
                phrase: Phrase::default(),
                words: Vec::new(),
            });
        }
        let (kind, text) = match text.strip_prefix("part of ") {
            Some(whole) => (Kind::Part, whole.to_owned()),
            None => (Kind::Thing, text),
        };
        let named = text
            .strip_prefix("structure")
            .map_or(text.as_str(), |rest| rest.trim_start_matches([':', ' ', '-']));
        let words: Vec<String> = main_words(named);
        // "chest of drawers" has no singular within.
        let in_singular = |(i, word): (usize, &String)| match i.checked_sub(1).map(|i| &words[i]) {
            Some(before) if before == "of" => word.clone(),
            _ => singular(word).to_owned(),
        };
        let words: Vec<String> = words.iter().enumerate().map(in_singular).collect();
        let kind = structure_in(&words).map_or(kind, Kind::Structure);
        Some(Self { kind, phrase: uniground_language::parse(named).target, words })
    }

    /// Returns how well the name fits the requested noun, `0..=1`.
    #[must_use]
    pub fn fit(&self, asked: &Phrase, meaning: &Meaning) -> f32 {
        match (self.kind, meaning) {
            (Kind::Structure(own), Meaning::Structure(wanted)) => {
                f32::from(u8::from(own == *wanted))
            }
            // The id decides, not the name.
            (Kind::NotAThing | Kind::Structure(_), _)
            | (_, Meaning::Structure(_) | Meaning::Instance(_)) => 0.0,
            (Kind::Part, Meaning::Anything) => PART,
            (Kind::Thing, Meaning::Anything) => 1.0,
            (Kind::Part, _) => PART * self.noun_fit(asked, meaning),
            (Kind::Thing, _) => self.noun_fit(asked, meaning),
        }
    }

    fn noun_fit(&self, asked: &Phrase, meaning: &Meaning) -> f32 {
        let by_noun = self.noun().map_or(0.0, |noun| kind_fit(&noun, asked, meaning));
        if by_noun > 0.0 { by_noun } else { self.fit_by_words(asked) }
    }

    /// Returns its noun: the last words that a dictionary knows together, as many as possible; the
    /// grammar's noun where no dictionary knows any.
    fn noun(&self) -> Option<String> {
        let known =
            |words: &String| Lexicon::get().find(words).is_some() || WordNet::get().names(words);
        let runs = (1..=self.words.len())
            .rev()
            .flat_map(|end| (0..end).map(move |from| self.words[from..end].join(" ")));
        runs.into_iter()
            .find(known)
            .or_else(|| Some(self.phrase.head.clone()).filter(|head| !head.is_empty()))
    }

    /// Returns the fit by the words alone, where no dictionary helps.
    fn fit_by_words(&self, asked: &Phrase) -> f32 {
        let wanted: Vec<&str> = asked.head.split_whitespace().map(singular).collect();
        if wanted.is_empty() || !wanted.iter().all(|word| self.words.iter().any(|own| own == word))
        {
            return 0.0;
        }
        if self.words.last().map(String::as_str) == wanted.last().copied() {
            SAME_WORDS
        } else {
            WORDS_BESIDE_ITS_NOUN
        }
    }

    /// Returns whether the name says that the instance carries the requested object: "candlestick
    /// with pink candle".
    #[must_use]
    pub fn carries(&self, asked: &Phrase, meaning: &Meaning) -> bool {
        let carried = self.phrase.with.iter().filter(|with| !with.absent);
        self.kind == Kind::Thing
            && carried.into_iter().any(|with| kind_fit(&with.phrase.head, asked, meaning) > 0.0)
    }

    /// Returns whether it names an object, rather than a stretch of a wall or noise.
    #[must_use]
    pub fn is_thing(&self) -> bool {
        matches!(self.kind, Kind::Thing | Kind::Part)
    }

    /// Returns the colors in the name.
    #[must_use]
    pub fn colors(&self) -> &[ColorName] {
        &self.phrase.colors
    }

    /// Returns whether the name has a word: "leather", "striped".
    #[must_use]
    pub fn has_word(&self, word: &str) -> bool {
        let word = singular(word);
        self.words.iter().any(|own| own == word)
    }
}

/// Returns the part of the building that a name is a stretch of: "beige wall section", "ceiling".
fn structure_in(words: &[String]) -> Option<Structure> {
    let end = words.iter().rposition(|word| !STRETCH.contains(&word.as_str()))?;
    match words[end].as_str() {
        "wall" => Some(Structure::Wall),
        "floor" | "flooring" => Some(Structure::Floor),
        "ceiling" => Some(Structure::Ceiling),
        _ => None,
    }
}

/// Returns the words of a name up to the first that leads to another object. "and" leads to another
/// object, except between colors.
fn main_words(name: &str) -> Vec<String> {
    let is_color = |word: &String| ColorName::ALL.iter().any(|color| color.as_str() == word);
    let all: Vec<String> = name
        .split(|c: char| !c.is_alphanumeric())
        .filter(|word| !word.is_empty())
        .map(str::to_lowercase)
        .collect();
    // "chest of drawers" is one noun.
    let is_within_noun = |at: usize| {
        at > 0
            && all.get(at + 1).is_some()
            && Lexicon::get().is_known(&all[at - 1..=at + 1].join(" "))
    };
    let mut words: Vec<String> = Vec::new();
    for (at, word) in all.iter().enumerate() {
        let word = word.clone();
        match word.as_str() {
            _ if is_within_noun(at) => words.push(word),
            "and" if words.last().is_some_and(is_color) => {}
            "and" => break,
            word if ELSEWHERE.contains(&word) => break,
            _ => words.push(word),
        }
    }
    words
}

pub(crate) fn singular(word: &str) -> &str {
    word.strip_suffix('s').filter(|rest| rest.len() > 2 && !rest.ends_with('s')).unwrap_or(word)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn fit(name: &str, query: &str) -> f32 {
        let asked = uniground_language::parse(query).target;
        GivenName::read(name).map_or(-1.0, |name| name.fit(&asked, &asked.meaning()))
    }

    #[test]
    fn free_form_names_match_the_requested_noun() {
        for (name, query) in [
            ("lime green bean bag chair", "the beanbag"),
            ("white two-door wardrobe", "the wardrobe"),
            ("blue and white abstract framed painting", "the picture on the wall"),
            ("black round digital alarm clock", "the alarm clock"),
            ("brown wooden chest of drawers", "the dresser"),
            ("tall white bookcase with books", "the bookshelf"),
            ("grey metal trash can", "the bin"),
            ("small white lamp on a desk", "the lamp"),
            ("acoustic guitar leaning on wall", "the guitar"),
            ("brown leather sofa", "the couch"),
            ("window with air conditioner", "the window"),
            ("wooden theremin", "the theremin"),
            ("beige wall section", "the wall"),
            ("structure: floor", "the floor"),
        ] {
            assert!(fit(name, query) >= 0.5, "{name} for {query}: {}", fit(name, query));
        }
    }

    #[test]
    fn names_do_not_match_objects_they_only_mention() {
        for (name, query) in [
            ("small white lamp on a desk", "the desk"),
            ("white radiator cabinet under window", "the window"),
            ("beige wall section", "the window"),
            ("not a thing", "the thing next to the bed"),
            ("structure: wall", "the table"),
            ("white washing machine", "the fridge"),
        ] {
            assert_eq!(fit(name, query), 0.0, "{name} for {query}");
        }
        let candle = uniground_language::parse("the candle").target;
        let carries =
            |name: &str| GivenName::read(name).unwrap().carries(&candle, &candle.meaning());
        assert!(
            carries("white candlestick with pink candle") && !carries("white shelf with books")
        );
        assert_eq!(fit("unclear", "the table"), -1.0);
        assert!((0.1..0.5).contains(&fit("part of wooden bed frame", "the bed")));
    }
}
