//! Recognizes what a question wants to know of an object: the object itself, all of a kind, a
//! number, a measurement, yes or no, a description, or a place.
//!
//! Only the words that make the question are read here ("how far is … from …"). The grammar reads
//! the objects in between.

mod comparisons;
mod descriptions;
mod limits;
mod lists;
mod measures;
mod patterns;
mod restated;
pub(super) mod words;

use super::distances::LengthUnit;
use super::tokens::BREAK;
use super::words::Meaning;
use super::{ParsedQuery, Phrase};
use std::ops::RangeInclusive;

/// What a question wants to know of its target.
#[derive(Debug, Clone, Default, PartialEq)]
pub enum Form {
    /// The object: "the red mug".
    #[default]
    Object,
    /// All objects that match: "what is on the desk", "all chairs".
    List,
    /// Their number: "how many chairs".
    Count,
    /// A measure of its box: "how tall is the shelf".
    Size(Dimension),
    /// Its distance: "how far is the stool from the door".
    Distance(Reference),
    /// Whether it exists: "is there a piano".
    Exists,
    /// Whether their number is in a range: "are there more than 3 chairs", "are there no chairs".
    Number(RangeInclusive<u32>),
    /// Whether what is said of an object holds: "is the mug on the table". The target of the
    /// question is the object with what is said of it: "the mug on the table".
    Holds(Claim),
    /// Whether a measure of it is within a limit: "is the door wider than 90 cm".
    Limit(Limit),
    /// Whether it is larger, closer and so on than another: "is the sofa longer than the rug".
    Comparison(Comparison),
    /// Which of the two is larger, closer and so on: "which is taller, the lamp or the shelf".
    Choice(Comparison),
    /// How much larger, closer and so on it is than another: "how much taller is the shelf than the
    /// desk".
    Difference(Comparison),
    /// Whether it fits: "does the chair fit under the desk".
    Fit(Passage),
    /// What it is and looks like: "what is the thing on the shelf".
    Description(Aspect),
    /// Where it is: "where is the remote".
    Place,
}

impl Form {
    /// Returns the phrases of the objects other than the target.
    #[must_use]
    pub fn phrases(&self) -> Vec<&Phrase> {
        match self {
            Self::Holds(claim) => vec![&*claim.subject],
            Self::Limit(limit) => limit.by.phrase().into_iter().collect(),
            Self::Distance(reference) => reference.phrase().into_iter().collect(),
            Self::Comparison(comparison)
            | Self::Choice(comparison)
            | Self::Difference(comparison) => {
                std::iter::once(&*comparison.other).chain(comparison.by.phrase()).collect()
            }
            Self::Fit(passage) => {
                std::iter::once(&*passage.place).chain(passage.second.as_deref()).collect()
            }
            Self::Object
            | Self::List
            | Self::Count
            | Self::Size(_)
            | Self::Exists
            | Self::Number(_)
            | Self::Description(_)
            | Self::Place => Vec::new(),
        }
    }
}

/// What a question claims of an object, or of all objects of a kind.
#[derive(Debug, Clone, PartialEq)]
pub struct Claim {
    /// The object: "the mug".
    pub subject: Box<Phrase>,
    /// Whether the question denies it: "is the mug not on the table".
    pub is_negated: bool,
    /// Whether it has to hold of all of them: "are all chairs on the floor".
    pub of_all: bool,
}

/// A limit that a question sets to a measure: "wider than 90 cm".
#[derive(Debug, Clone, PartialEq)]
pub struct Limit {
    /// What is measured.
    pub by: ComparedBy,
    /// The side of the limit that is asked for.
    pub bound: Bound,
    /// The given length, meters.
    pub given_m: f32,
    /// Whether it has to hold of all of them: "are all shelves lower than 2 m".
    pub of_all: bool,
}

/// A side of a limit.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Bound {
    /// "more than", "at least"
    Above,
    /// "less than", "at most"
    Below,
    /// "90 cm wide"
    About,
}

/// What is measured of an object's box.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Dimension {
    /// Width, depth and height.
    All,
    /// Vertical extent.
    Height,
    /// The longer horizontal side.
    Width,
    /// The longer horizontal side, said as length.
    Length,
    /// The shorter horizontal side.
    Depth,
    /// Area of the footprint.
    Area,
    /// Volume of the box.
    Volume,
    /// Height of the underside above the floor.
    Elevation,
}

/// What a distance is measured from.
#[derive(Debug, Clone, PartialEq)]
pub enum Reference {
    /// The person who asks: "how far is the door".
    Observer,
    /// Another object.
    Object(Box<Phrase>),
}

impl Reference {
    fn phrase(&self) -> Option<&Phrase> {
        match self {
            Self::Observer => None,
            Self::Object(phrase) => Some(phrase),
        }
    }
}

/// A comparison of the target with another object.
#[derive(Debug, Clone, PartialEq)]
pub struct Comparison {
    /// What is compared.
    pub by: ComparedBy,
    /// Whether the target has to have more of it ("larger", "farther") or less ("closer").
    pub more: bool,
    /// The word of the question: "taller", "closer to the door".
    pub word: String,
    /// The other object.
    pub other: Box<Phrase>,
}

/// What two objects are compared by, or one with a given length.
#[derive(Debug, Clone, PartialEq)]
pub enum ComparedBy {
    /// A measure of their boxes.
    Dimension(Dimension),
    /// Their distances to a third object or to the person who asks.
    Distance(Reference),
}

impl ComparedBy {
    fn phrase(&self) -> Option<&Phrase> {
        match self {
            Self::Dimension(_) => None,
            Self::Distance(reference) => reference.phrase(),
        }
    }
}

/// Where an object may fit, or a person's or robot's given size.
#[derive(Debug, Clone, PartialEq)]
pub struct Passage {
    /// Through, under, or in.
    pub way: Way,
    /// What it has to pass or go into.
    pub place: Box<Phrase>,
    /// The second object of [`Way::Between`].
    pub second: Option<Box<Phrase>>,
    /// The size in meters where the question gives one ("something 60 cm wide"), instead of the
    /// target's.
    pub given_m: Option<f32>,
}

/// How an object passes or fits.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Way {
    /// Through an opening: height and the shorter side count.
    Through,
    /// Under it, on the floor: the height counts.
    Under,
    /// In or on it: all sides count, or for "on" only the footprint.
    In,
    /// On top of it: the footprint counts.
    On,
    /// Between two objects: the gap and the shorter side count.
    Between,
}

/// What a description has to tell.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Aspect {
    /// Name, color, size and place.
    All,
    /// The colors.
    Color,
    /// The material, which a scan does not show.
    Material,
}

/// A question whose form was recognized.
pub(super) struct Request {
    pub form: Form,
    /// Words that describe the target.
    pub target: Vec<String>,
    /// Objects that a list must not have.
    pub except: Vec<Phrase>,
    /// Words of the other objects that were not understood.
    pub not_understood: Vec<String>,
    /// The unit that the answer has to use.
    pub unit: Option<LengthUnit>,
}

/// Reads words that describe an object.
type ReadObject<'a> = &'a dyn Fn(&[String]) -> ParsedQuery;

/// Recognizes the form of a question. `read` reads the objects within it. A question of no known
/// form asks for an object.
pub(super) fn recognize(mut tokens: Vec<String>, read: ReadObject) -> Request {
    words::expand_contractions(&mut tokens);
    remove_wish_for_a_box(&mut tokens);
    remove_choice_of_colors(&mut tokens);
    remove_what_to_ignore(&mut tokens);
    restated::rewrite_same_as(&mut tokens);
    restated::count_pieces(&mut tokens);
    restated::measure_from_objects(&mut tokens);
    restated::use_purpose_before(&mut tokens);
    restated::refer_to_named_object(&mut tokens);
    refer_to_the_sentence_before(&mut tokens);
    use_given_size(&mut tokens);
    let (tokens, except) = words::split_exceptions(&tokens);
    let mut reader = patterns::PatternReader { read, not_understood: Vec::new(), unit: None };
    let clauses = std::iter::once(0)
        .chain((1..tokens.len()).filter(|&i| tokens[i - 1] == BREAK))
        .filter(|&start| start < tokens.len());
    let mut found = None;
    for start in clauses {
        found = reader.clause(&tokens[start..], start == 0);
        if found.is_some() {
            break;
        }
    }
    let (form, target) = found.unwrap_or((Form::Object, tokens));
    let except = except.map_or_else(Vec::new, |except| reader.objects(&except));
    let patterns::PatternReader { not_understood, unit, .. } = reader;
    Request { form, target, except, not_understood, unit }
}

/// Replaces "it" by what the sentence before names: "there is a desk in the corner. what is on it?"
fn refer_to_the_sentence_before(tokens: &mut Vec<String>) {
    let Some(end) = tokens.iter().position(|token| token == BREAK) else { return };
    let first: Vec<&str> = tokens[..end].iter().map(String::as_str).collect();
    let Some(named) = words::after(
        &first,
        &[
            "there is",
            "there are",
            "i see",
            "i can see",
            "you see",
            "look at",
            "i have",
            "we have",
            "i can't find",
            "i cannot find",
            "i cant find",
            "we can't find",
            "i lost",
            "i have lost",
            "i've lost",
            "i need",
            "i am looking for",
            "i'm looking for",
        ],
    ) else {
        return;
    };
    let article = usize::from(matches!(
        named.first(),
        Some(&("a" | "an" | "the" | "my" | "our" | "your" | "some"))
    ));
    let object: Vec<String> =
        std::iter::once("the").chain(named[article..].iter().copied()).map(str::to_owned).collect();
    if object.len() < 2 {
        return;
    }
    let second = &tokens[end + 1..];
    let asks = second.first().is_some_and(|word| {
        matches!(word.as_str(), "what" | "how" | "is" | "are" | "which" | "where" | "describe")
    });
    let pronoun = |word: &String| matches!(word.as_str(), "it" | "they" | "them");
    let Some(it) = second.iter().position(pronoun).filter(|_| asks) else { return };
    let mut question = second.to_vec();
    question.splice(it..=it, object);
    *tokens = question;
}

/// Removes a last sentence that says only how to answer: "give the box".
fn remove_wish_for_a_box(tokens: &mut Vec<String>) {
    const BOXES: [&str; 5] = ["box", "bbox", "boxes", "coordinates", "id"];
    let words: Vec<&str> = tokens.iter().map(String::as_str).collect();
    let words = words.strip_suffix(&[BREAK]).unwrap_or(&words);
    let Some(start) = words.iter().rposition(|word| *word == BREAK) else { return };
    let wish = words::after(
        &words[start + 1..],
        &["give", "give me", "return", "output", "show", "show me", "i need", "send me", "with"],
    );
    let wish = wish.map(|wish| words::after(wish, &["the", "its", "a", "me the"]).unwrap_or(wish));
    let is_wish = wish.is_some_and(|wish| match wish {
        [last] | ["bounding" | "3d", last] => BOXES.contains(last),
        _ => false,
    });
    if is_wish && start > 0 {
        tokens.truncate(start);
    }
}

/// Removes a last sentence about objects that are not meant: "ignore the one on the freezer".
fn remove_what_to_ignore(tokens: &mut Vec<String>) {
    let words: Vec<&str> = tokens.iter().map(String::as_str).collect();
    let words = words.strip_suffix(&[BREAK]).unwrap_or(&words);
    let Some(start) = words.iter().rposition(|word| *word == BREAK).filter(|start| *start > 0)
    else {
        return;
    };
    let ignored = ["ignore", "disregard", "skip", "i do not mean", "i don't mean", "do not take"];
    if words::after(&words[start + 1..], &ignored).is_some() {
        tokens.truncate(start);
    }
}

/// Removes colors to choose from: "the toaster by the stove: green or yellow?" asks for the toaster.
fn remove_choice_of_colors(tokens: &mut Vec<String>) {
    let words: Vec<&str> = tokens.iter().map(String::as_str).collect();
    let words = words.strip_suffix(&[BREAK]).unwrap_or(&words);
    let Some(start) = words.iter().rposition(|word| *word == BREAK).filter(|start| *start > 0)
    else {
        return;
    };
    let is_color = |words: &[&str]| {
        let words = words::after(words, &["the", "a"]).unwrap_or(words);
        let words = words::before(words, &["one"]).unwrap_or(words);
        matches!(super::words::longest_match(words), Some((Meaning::Color(_), length)) if length == words.len())
    };
    // "which is closer, the red one or the blue one" compares the two.
    let compares = |at: usize| comparisons::is_comparative(&words[at..start]);
    if (0..start).any(compares) || matches!(words.first(), Some(&("is" | "are"))) {
        return;
    }
    let pair = words::split_pair(&words[start + 1..], "or");
    if pair.is_some_and(|(first, second)| is_color(first) && is_color(second)) {
        tokens.truncate(start);
    }
}

/// Puts a size that the sentence before gives into a question whether something fits: "I'm 25 cm
/// tall. Do I fit under the sofa?"
fn use_given_size(tokens: &mut Vec<String>) {
    const GUESTS: [&[&str]; 10] = [
        &["i"],
        &["it"],
        &["we"],
        &["he"],
        &["she"],
        &["the", "robot"],
        &["my", "robot"],
        &["the", "base"],
        &["this", "robot"],
        &["that"],
    ];
    let Some(end) = tokens.iter().position(|token| token == BREAK) else { return };
    let words: Vec<&str> = tokens.iter().map(String::as_str).collect();
    let (first, second) = (&words[..end], &words[end + 1..]);
    const ADJECTIVES: [&str; 7] = ["tall", "high", "wide", "long", "deep", "thick", "across"];
    // "I'm 25 cm tall", "a crate 40 cm tall"
    let Some((at, length)) = (1..first.len()).find_map(|at| {
        let (_, length) = super::distances::length_at(&first[at..])?;
        let is_size = first.get(at + length).is_some_and(|word| ADJECTIVES.contains(word));
        is_size.then_some((at, length))
    }) else {
        return;
    };
    let Some(asked) = words::after(second, &["do", "does", "can", "could", "would", "will"]) else {
        return;
    };
    let Some(guest) = GUESTS.iter().find(|guest| asked.starts_with(guest)) else { return };
    let size = &first[at..at + length];
    let question: Vec<String> = ["does", "something"]
        .iter()
        .chain(size)
        .chain(["tall"].iter())
        .chain(&asked[guest.len()..])
        .map(|word| (*word).to_owned())
        .collect();
    if measures::asks_for_space(&question) {
        *tokens = question;
    }
}

#[cfg(test)]
mod tests;
