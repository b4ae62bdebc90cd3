//! The words of the grammar, as tables.

use super::{Look, Measure, RelationKind, Trait, cost, distances};
use std::collections::HashMap;
use std::sync::LazyLock;
use uniground_geometry::color::ColorName;

/// The meaning of a word or a run of words.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) enum Meaning {
    Relation(RelationKind),
    /// "with", "that has": the next phrase belongs to the object.
    With {
        absent: bool,
    },
    /// "the same": other objects at the anchor identify it: "on the same desk as the lamp".
    Same,
    /// "as" after "the same".
    As,
    /// A viewpoint; the object that the viewer looks at or from follows.
    View(Look),
    /// "sitting at": the viewer looks at the next object from a seat at it.
    Seated,
    /// "as you walk in": from the door.
    Entering,
    /// "from the left": an end to count from.
    FromSide(Measure),
    Superlative(Measure),
    Ordinal(u32),
    Number(u32),
    Color(ColorName),
    Trait(Trait),
    Not,
    /// "or", "nor": continues the negation.
    Or,
    /// "with nothing on it"
    Bare,
    /// "to its left": beside the object that the viewer looks at.
    Side(Measure),
    /// "and": another anchor of the same relation.
    And,
    /// "of": "the bowl of fruit".
    Of,
    /// "it is": the next words describe the target.
    OfTarget,
    /// "that is": the next words describe the last object named.
    OfLast,
    /// "there is": a new subject.
    ThereIs,
    /// "it": refers to the object under discussion.
    Pronoun,
    /// "how many", "all": the question means all of them.
    All,
    /// "the", "a": a noun phrase begins.
    Determiner,
    /// Has no meaning of its own.
    Filler,
}

/// A run of words and what it means.
type Run = (Vec<&'static str>, Meaning);

/// The table by first word, longest runs first.
static BY_FIRST_WORD: LazyLock<HashMap<&'static str, Vec<Run>>> = LazyLock::new(|| {
    let mut table: HashMap<&'static str, Vec<Run>> = HashMap::new();
    for (meaning, phrases) in table_lines() {
        // A test checks that every line has a meaning.
        let Some(meaning) = Meaning::from_table_name(meaning) else { continue };
        for phrase in phrases {
            let words: Vec<&str> = phrase.split(' ').collect();
            table.entry(words[0]).or_default().push((words, meaning));
        }
    }
    table
        .values_mut()
        .for_each(|phrases| phrases.sort_by_key(|(words, _)| std::cmp::Reverse(words.len())));
    table
});

/// Lines of `words.tsv`: a meaning and its words.
fn table_lines() -> impl Iterator<Item = (&'static str, Vec<&'static str>)> {
    let lines = include_str!("words.tsv").lines().filter(|line| !line.starts_with('#'));
    lines
        .filter_map(|line| line.split_once('\t'))
        .map(|(meaning, words)| (meaning, words.split(',').collect()))
}

impl Meaning {
    /// Returns the meaning that a line of the table names: "relation near", "colour red".
    fn from_table_name(name: &str) -> Option<Self> {
        let (kind, which) = name.split_once(' ').unwrap_or((name, ""));
        Some(match kind {
            "relation" => {
                Self::Relation(RelationKind::ALL.into_iter().find(|k| k.as_str() == which)?)
            }
            "with" => Self::With { absent: false },
            "without" => Self::With { absent: true },
            "same" => Self::Same,
            "as" => Self::As,
            "view" => Self::View(Look::ALL.into_iter().find(|l| l.as_str() == which)?),
            "seated" => Self::Seated,
            "entering" => Self::Entering,
            "from_side" => Self::FromSide(Measure::ALL.into_iter().find(|m| m.as_str() == which)?),
            "superlative" => {
                Self::Superlative(Measure::ALL.into_iter().find(|m| m.as_str() == which)?)
            }
            "ordinal" => Self::Ordinal(which.parse().ok()?),
            "number" => Self::Number(which.parse().ok()?),
            "colour" => Self::Color(ColorName::ALL.into_iter().find(|c| c.as_str() == which)?),
            "trait" => Self::Trait(Trait::ALL.into_iter().find(|t| t.as_str() == which)?),
            "not" => Self::Not,
            "or" => Self::Or,
            "bare" => Self::Bare,
            "side" => Self::Side(Measure::ALL.into_iter().find(|m| m.as_str() == which)?),
            "and" => Self::And,
            "of" => Self::Of,
            "of_target" => Self::OfTarget,
            "of_last" => Self::OfLast,
            "there_is" => Self::ThereIs,
            "pronoun" => Self::Pronoun,
            "all" => Self::All,
            "determiner" => Self::Determiner,
            "filler" => Self::Filler,
            _ => return None,
        })
    }
}

/// Returns the meaning and the length of the longest run of words at the start of `words` that has
/// one.
pub(super) fn longest_match(words: &[&str]) -> Option<(Meaning, usize)> {
    cost::count();
    if distances::joined_words(words.first()?).is_some() {
        return Some((Meaning::Relation(RelationKind::Near), 1));
    }
    let phrases = BY_FIRST_WORD.get(words.first()?)?;
    phrases
        .iter()
        .inspect(|_| cost::count())
        .find(|(phrase, _)| words.starts_with(phrase))
        .map(|(phrase, meaning)| (*meaning, phrase.len()))
}

/// Returns every single word of the tables, and the words for anything.
pub(super) fn single_words() -> impl Iterator<Item = &'static str> {
    let single = BY_FIRST_WORD
        .iter()
        .filter(|(_, runs)| runs.iter().any(|(words, _)| words.len() == 1))
        .map(|(word, _)| *word);
    single.chain(["something", "anything", "somewhere"])
}

/// Returns whether some run of words begins with this one.
pub(super) fn is_known(word: &str) -> bool {
    BY_FIRST_WORD.contains_key(word)
}

/// Returns whether words for a color are approximate: "pinkish", "salmon coloured".
pub(super) fn is_rough_color(text: &str) -> bool {
    ["ish", "orangey", "yellowy", "coloured", "colored"].iter().any(|ending| text.ends_with(ending))
}

/// Returns whether a noun can mean any object.
pub(super) fn is_anything(head: &str) -> bool {
    matches!(
        head,
        "" | "thing"
            | "object"
            | "item"
            | "one"
            | "something"
            | "anything"
            | "everything"
            | "ones"
            | "things"
            | "objects"
            | "stuff"
            | "items"
            | "somewhere"
            | "place"
            | "device"
            | "option"
            | "selection"
            | "choice"
    )
}

/// Returns whether a word measures out what follows "of": "a pair of shoes" are shoes.
pub(super) fn is_measure(head: &str) -> bool {
    matches!(
        head,
        "pair"
            | "set"
            | "row"
            | "pile"
            | "stack"
            | "group"
            | "grouping"
            | "cluster"
            | "line"
            | "bunch"
            | "piece"
            | "couple"
            | "number"
            | "lot"
            | "collection"
            | "kind"
            | "type"
    )
}

/// Returns whether a word is a part that detection seldom finds separately.
pub(super) fn is_part_of_furniture(head: &str) -> bool {
    matches!(
        head,
        "headboard"
            | "footboard"
            | "mantel"
            | "mantelpiece"
            | "armrest"
            | "backrest"
            | "seat"
            | "leg"
            | "lid"
            | "handle"
            | "frame"
            | "door"
            | "drawer"
            | "arm"
            | "knob"
            | "shade"
            | "rim"
            | "lap"
    )
}

/// Returns whether a word names a material, which a scan does not show: "not wooden".
pub(super) fn is_material(word: &str) -> bool {
    matches!(
        word,
        "wooden"
            | "wood"
            | "oak"
            | "pine"
            | "walnut"
            | "bamboo"
            | "rattan"
            | "wicker"
            | "metal"
            | "metallic"
            | "steel"
            | "iron"
            | "aluminum"
            | "aluminium"
            | "brass"
            | "chrome"
            | "plastic"
            | "acrylic"
            | "rubber"
            | "foam"
            | "glass"
            | "ceramic"
            | "porcelain"
            | "stone"
            | "marble"
            | "granite"
            | "concrete"
            | "brick"
            | "leather"
            | "fabric"
            | "cloth"
            | "velvet"
            | "cotton"
            | "wool"
            | "woolen"
            | "upholstered"
            | "paper"
            | "cardboard"
    )
}

/// Returns whether a word is a part of an object or of a room: "the back of the chair" is the
/// chair, "the end of the table" the table.
pub(super) fn is_part(head: &str) -> bool {
    matches!(
        head,
        "end"
            | "side"
            | "front"
            | "back"
            | "top"
            | "bottom"
            | "edge"
            | "middle"
            | "center"
            | "centre"
            | "left"
            | "right"
            | "corner"
            | "head"
            | "foot"
            | "base"
            | "rear"
            | "surface"
            | "outside"
            | "border"
    )
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::collections::HashSet;

    #[test]
    fn every_line_has_a_meaning_and_no_phrase_is_listed_twice() {
        let mut seen = HashSet::new();
        for (meaning, phrases) in table_lines() {
            assert!(Meaning::from_table_name(meaning).is_some(), "{meaning}");
            for phrase in phrases {
                assert!(!phrase.is_empty() && phrase == phrase.trim(), "{meaning}: {phrase:?}");
                assert!(seen.insert(phrase), "{phrase:?} is listed twice");
            }
        }
        assert!(seen.len() > 500);
    }
}
