//! The words of the grammar, as tables.

use super::{Look, Measure, RelationKind, Trait, cost};
use std::collections::HashMap;
use std::sync::LazyLock;
use uniground_geometry::colour::ColourName;

/// What a word or a run of words contributes.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) enum Meaning {
    Relation(RelationKind),
    /// "with", "that has": what follows belongs to the object.
    With {
        absent: bool,
    },
    /// "the same": the anchor is known by what else is at it: "on the same desk as the lamp".
    Same,
    /// "as" after "the same".
    As,
    /// How somebody looks; what they look at or from follows.
    View(Look),
    /// "sitting at": somebody looks at what follows from a seat at it.
    Seated,
    /// "as you walk in": from the door.
    Entering,
    /// "from the left": an end to count from.
    FromSide(Measure),
    Superlative(Measure),
    Ordinal(u32),
    Number(u32),
    Colour(ColourName),
    Trait(Trait),
    Not,
    /// "or", "nor": goes on with what was negated.
    Or,
    /// "with nothing on it"
    Bare,
    /// "to its left": beside what is looked at.
    Side(Measure),
    /// "and": another anchor of the same relation.
    And,
    /// "of": "the bowl of fruit".
    Of,
    /// "it is": what follows is said of the target.
    OfTarget,
    /// "that is": what follows is said of the last thing named.
    OfLast,
    /// "there is": a new subject.
    ThereIs,
    /// Stands for the thing spoken of: "it".
    Pronoun,
    /// "how many", "all": each of them is meant.
    All,
    /// "the", "a": a noun phrase begins.
    Determiner,
    /// Carries nothing.
    Filler,
}

/// A run of words and what it means.
type Run = (Vec<&'static str>, Meaning);

/// The table by first word, longest runs first.
static BY_FIRST_WORD: LazyLock<HashMap<&'static str, Vec<Run>>> = LazyLock::new(|| {
    let mut table: HashMap<&'static str, Vec<Run>> = HashMap::new();
    for (meaning, phrases) in lines() {
        // A test sees to it that every line has a meaning.
        let Some(meaning) = Meaning::of(meaning) else { continue };
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
fn lines() -> impl Iterator<Item = (&'static str, Vec<&'static str>)> {
    let lines = include_str!("words.tsv").lines().filter(|line| !line.starts_with('#'));
    lines
        .filter_map(|line| line.split_once('\t'))
        .map(|(meaning, words)| (meaning, words.split(',').collect()))
}

impl Meaning {
    /// The meaning a line of the table names: "relation near", "colour red".
    fn of(name: &str) -> Option<Self> {
        let (kind, which) = name.split_once(' ').unwrap_or((name, ""));
        Some(match kind {
            "relation" => {
                Self::Relation(RelationKind::ALL.into_iter().find(|k| k.word() == which)?)
            }
            "with" => Self::With { absent: false },
            "without" => Self::With { absent: true },
            "same" => Self::Same,
            "as" => Self::As,
            "view" => Self::View(Look::ALL.into_iter().find(|l| l.word() == which)?),
            "seated" => Self::Seated,
            "entering" => Self::Entering,
            "from_side" => Self::FromSide(Measure::ALL.into_iter().find(|m| m.word() == which)?),
            "superlative" => {
                Self::Superlative(Measure::ALL.into_iter().find(|m| m.word() == which)?)
            }
            "ordinal" => Self::Ordinal(which.parse().ok()?),
            "number" => Self::Number(which.parse().ok()?),
            "colour" => Self::Colour(ColourName::ALL.into_iter().find(|c| c.word() == which)?),
            "trait" => Self::Trait(Trait::ALL.into_iter().find(|t| t.word() == which)?),
            "not" => Self::Not,
            "or" => Self::Or,
            "bare" => Self::Bare,
            "side" => Self::Side(Measure::ALL.into_iter().find(|m| m.word() == which)?),
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

/// The longest run of words at the start of `words` that means something, and how many words it
/// takes.
pub(super) fn longest(words: &[&str]) -> Option<(Meaning, usize)> {
    cost::count();
    let phrases = BY_FIRST_WORD.get(words.first()?)?;
    phrases
        .iter()
        .inspect(|_| cost::count())
        .find(|(phrase, _)| words.starts_with(phrase))
        .map(|(phrase, meaning)| (*meaning, phrase.len()))
}

/// Every single word of the tables, and those for anything.
pub(super) fn small() -> impl Iterator<Item = &'static str> {
    let single = BY_FIRST_WORD
        .iter()
        .filter(|(_, runs)| runs.iter().any(|(words, _)| words.len() == 1))
        .map(|(word, _)| *word);
    single.chain(["something", "anything", "somewhere"])
}

/// Whether some run of words begins with this one.
pub(super) fn is_known(word: &str) -> bool {
    BY_FIRST_WORD.contains_key(word)
}

/// Whether words for a colour only liken it: "pinkish", "salmon coloured".
pub(super) fn is_rough_colour(text: &str) -> bool {
    ["ish", "orangey", "yellowy", "coloured", "colored"].iter().any(|ending| text.ends_with(ending))
}

/// Nouns that may stand for anything.
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

/// Words that measure out what follows "of": "a pair of shoes" are shoes.
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

/// Parts that are seldom found by themselves.
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

/// Parts of things and of rooms: "the back of the chair" is the chair, "the end of the table" the
/// table.
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
    fn every_line_has_a_meaning_and_every_run_of_words_one_line() {
        let mut seen = HashSet::new();
        for (meaning, phrases) in lines() {
            assert!(Meaning::of(meaning).is_some(), "{meaning}");
            for phrase in phrases {
                assert!(!phrase.is_empty() && phrase == phrase.trim(), "{meaning}: {phrase:?}");
                assert!(seen.insert(phrase), "{phrase:?} is listed twice");
            }
        }
        assert!(seen.len() > 500);
    }
}
