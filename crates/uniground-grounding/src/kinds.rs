//! Scores how well one noun matches another: synonyms, broader and narrower words, objects that
//! serve the same use.

use uniground_language::{Meaning, Phrase};
use uniground_models::attributes::{Kinship, Lexicon, Noun, WordNet};

/// Fit of a broader word ("seat" for a sofa): a little less than that of the object's own name.
const BROADER_WORD: f32 = 0.9;
/// How much less a rare kind fits a broader word than a common one.
const EXOTIC: f32 = 0.125;
/// Fit of an object whose given name is broader than the requested one: it may be meant.
pub(super) const BROADER_NAME: f32 = 0.5;
/// The same where the name is the last word of the requested one: "stool" for a bar stool.
const ITS_LAST_WORD: f32 = 0.7;
/// The same where the name states another purpose: a "salad bowl" for a dog bowl; "picture frame"
/// and "photo frame" may be one.
const OTHER_COMPOUND: f32 = 0.3;
/// Fit of a synonym of the given name.
const SYNONYM: f32 = 0.95;
/// Fit of an object that serves a use like others; an object named after the use has 1.
const SERVES_ALIKE: f32 = 0.93;

/// Returns the weight of the `i`-th meaning of a phrase's noun: 1 for the object of that name, less
/// for its narrower kinds, and less the rarer they are. Objects that serve a use weigh the same,
/// except those named after it: tea is poured from a teapot.
pub(super) fn breadth(phrase: &Phrase, noun: &Noun, i: usize) -> f32 {
    let names =
        || std::iter::once(&noun.name).chain(&noun.synonyms).flat_map(|name| name.split(' '));
    match phrase.uses.is_empty() {
        true if i == 0 => 1.0,
        true => BROADER_WORD * (1.0 - EXOTIC * (1.0 - noun.prior)),
        false if names().any(|word| phrase.purpose.iter().any(|said| said == word)) => 1.0,
        false => SERVES_ALIKE,
    }
}

/// Returns how well an object's noun fits the requested noun: a synonym fits fully, a broader word
/// a little less.
pub(super) fn kind_fit(given: &str, phrase: &Phrase, meaning: &Meaning) -> f32 {
    // "kitchen chair" may be given as one name.
    if phrase.unchecked.iter().any(|before| {
        given.strip_suffix(&phrase.head).and_then(|rest| rest.strip_suffix(' ')) == Some(before)
    }) {
        return 1.0;
    }
    let fit = match (meaning, Lexicon::get().find(given)) {
        (Meaning::Nouns(asked), Some(own)) => {
            match asked.iter().position(|noun| noun.name == own.name) {
                // The exact word takes precedence over its synonyms.
                Some(i) => {
                    breadth(phrase, own, i)
                        * if i > 0
                            || !phrase.uses.is_empty()
                            || given == phrase.head
                            || own.name == phrase.head
                        {
                            1.0
                        } else {
                            SYNONYM
                        }
                }
                // The given name is "table" and the question says "side table": it may be one.
                None if phrase.uses.is_empty()
                    && asked.first().is_some_and(|noun| noun.kinds.contains(&own.name)) =>
                {
                    match given.contains(' ') && phrase.head.contains(' ') {
                        _ if is_last_word(given, phrase) => ITS_LAST_WORD,
                        // A salad bowl is hardly a dog bowl.
                        true => OTHER_COMPOUND,
                        false => BROADER_NAME,
                    }
                }
                None => 0.0,
            }
        }
        _ => f32::from(u8::from(last(given) == last(&phrase.head))),
    };
    if fit > 0.0 || phrase.head.is_empty() || !phrase.uses.is_empty() {
        fit
    } else {
        kinship_fit(given, &phrase.head)
    }
}

fn is_last_word(given: &str, phrase: &Phrase) -> bool {
    let singular = Lexicon::get().find(&phrase.head).map_or(&phrase.head, |noun| &noun.name);
    singular.strip_suffix(given).is_some_and(|before| before.ends_with(' '))
}

fn last(words: &str) -> Option<&str> {
    words.split_whitespace().next_back()
}

/// Returns the fit by `WordNet` kinship, for words that the lexicon does not relate.
fn kinship_fit(given: &str, asked: &str) -> f32 {
    // Of a compound that the lexicon distinguishes from others, the last word alone is not enough:
    // a high chair is no dining chair.
    if Lexicon::get().is_known(asked) && !WordNet::get().names(asked) {
        return 0.0;
    }
    match WordNet::get().relation_between(given, asked) {
        Some(Kinship::Same) => SYNONYM,
        Some(Kinship::Narrower(steps)) => {
            (BROADER_WORD - 0.1 * steps as f32) * WordNet::get().commonness(given)
        }
        Some(Kinship::Broader(steps)) => BROADER_NAME - 0.1 * steps as f32,
        None => 0.0,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_are_matched_by_kind_not_by_their_last_word() {
        let fit = |given: &str, asked: &str| {
            let phrase = Phrase { head: asked.into(), ..Phrase::default() };
            kind_fit(given, &phrase, &phrase.meaning())
        };
        assert_eq!(
            (fit("stool", "bar stool"), fit("stool", "bar stools"), fit("chair", "bar stool")),
            (ITS_LAST_WORD, ITS_LAST_WORD, BROADER_NAME)
        );
        assert!(
            fit("trash can", "dustbin") >= SYNONYM
                && fit("acoustic guitar", "musical instrument") > 0.5
        );
        // Of equally close kinds, the more common one comes first.
        assert!(
            fit("fedora", "hat") > 1.02 * fit("deerstalker", "hat"),
            "{}",
            fit("deerstalker", "hat")
        );
        for (given, asked) in [
            ("high chair", "dining chair"),
            ("coffee table", "dining table"),
            ("washing machine", "fridge"),
        ] {
            assert_eq!(fit(given, asked), 0.0, "{given} {asked}");
        }
    }
}
