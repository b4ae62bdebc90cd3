//! Detects whether a question is in English, the only language that the grammar reads.

use super::tokens::{BREAK, correct_small_word, correct_spelling};
use super::words;
use uniground_models::attributes::{Lexicon, WordNet};

/// Function words of other languages that are not English words.
const SMALL: &[&str] = &[
    // German
    "der", "das", "dem", "ein", "eine", "einen", "einem", "ist", "wo", "auf", "neben", "unter",
    "zwischen", "und", "mit", "im", "vom", "zum", "zur", "nicht", "hinter", "links",
    "rechts", // Dutch, Swedish, Danish
    "het", "een", "naast", "bij", "van", "en", "ett", "och", "på", "med", "av", "er",
    "og", // Spanish, Portuguese
    "el", "la", "los", "las", "del", "una", "unos", "esta", "está", "dónde", "donde", "sobre",
    "junto", "al", "con", "que", "de", "da", "os", "na", "ao", "onde", "um", "uma",
    "perto", // French
    "le", "les", "du", "une", "est", "où", "près", "sur", "dans", "avec", "et", "au", "à",
    "côté", // Italian
    "il", "gli", "della", "nel", "sul", "di", "dove", "è", "vicino", "sopra",
];

/// Returns whether most words are of another language: function words of one, unknown words, other
/// scripts.
pub(super) fn is_foreign(tokens: &[String]) -> bool {
    let words: Vec<&str> =
        tokens.iter().map(String::as_str).filter(|token| *token != BREAK).collect();
    let small = words.iter().filter(|word| SMALL.contains(word)).count();
    let other_script = words.iter().filter(|word| word.chars().any(is_of_another_script)).count();
    let strange = words.iter().filter(|word| !SMALL.contains(word) && !is_known(word)).count();
    // One function word may be part of a name: "le corbusier chair".
    (small >= 2 || other_script > 0) && 2 * (small + strange) >= words.len()
}

fn is_known(word: &str) -> bool {
    words::is_known(word)
        || words::is_anything(word)
        || Lexicon::get().is_known(word)
        || WordNet::get().is_english(word)
        || word.chars().all(|c| c.is_ascii_digit())
        || correct_small_word(word).or_else(|| correct_spelling(word)).is_some()
}

/// Returns whether a character is of a script other than Latin, and not a sign that all scripts
/// share.
fn is_of_another_script(c: char) -> bool {
    const LAST_LATIN: char = '\u{24F}';
    c > LAST_LATIN && c.is_alphabetic()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::tokens::tokenize;

    #[test]
    fn other_languages_are_distinguished_from_misspelled_english() {
        for query in [
            "Wo ist der rote Stuhl?",
            "die Tasse auf dem Tisch",
            "la lámpara encima del escritorio",
            "la chaise rouge près de la porte",
            "la sedia vicino alla finestra",
            "de stoel naast het raam",
            "门旁边的椅子",
            "стул у двери",
            "ドアのそばの椅子",
        ] {
            assert!(is_foreign(&tokenize(query)), "{query}");
        }
        for query in [
            "the red chair",
            "wher is teh labtop",
            "the theremin",
            "le corbusier chair",
            "the chaise longue by the étagère",
            "the painting of la gioconda",
            "quux",
            "the lamp in the den",
            "",
            "???",
            "chair de luxe by the window",
        ] {
            assert!(!is_foreign(&tokenize(query)), "{query}");
        }
    }
}
