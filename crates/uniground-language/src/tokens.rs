//! Splits text into words, and corrects misspelled words.

use super::{cost, words};
use uniground_models::attributes::{Lexicon, WordNet};

/// Token for a comma or the end of a sentence.
pub(super) const BREAK: &str = ",";

/// Words whose 's means "is"; after others it marks an owner.
const WITH_IS: [&str; 9] = ["it", "that", "there", "he", "she", "what", "where", "here", "who"];

/// Returns lower-case words; sentence marks become [`BREAK`].
pub(super) fn tokenize(query: &str) -> Vec<String> {
    let mut tokens = Vec::new();
    let mut word = String::new();
    let end = |word: &mut String, tokens: &mut Vec<String>| {
        let said = std::mem::take(word);
        let bare = said.trim_matches('\'');
        match (bare.strip_suffix("'s"), tokens.last_mut()) {
            // Some people write "it 's".
            _ if said == "'s" => {
                if let Some(last) =
                    tokens.last_mut().filter(|last| WITH_IS.contains(&last.as_str()))
                {
                    last.push_str("'s");
                }
            }
            (Some(owner), _) if !WITH_IS.contains(&owner) => tokens.push(owner.to_owned()),
            _ if bare.is_empty() => {}
            _ => tokens.push(bare.to_owned()),
        }
    };
    let mut characters = query.chars().flat_map(char::to_lowercase).peekable();
    while let Some(c) = characters.next() {
        let in_number = word.ends_with(|c: char| c.is_ascii_digit())
            && characters.peek().is_some_and(char::is_ascii_digit);
        match c {
            c if c.is_alphanumeric() => word.push(c),
            // "1,000 mm"
            ',' if in_number
                && is_thousands(&word, &characters.clone().take(4).collect::<String>()) => {}
            // "1.5 m", "1,5 m"
            '.' | ',' if in_number => word.push('.'),
            // "#12": the instance with this id.
            '#' if word.is_empty() && characters.peek().is_some_and(char::is_ascii_digit) => {
                word.push('#');
            }
            '\'' | '\u{2019}' => word.push('\''),
            '.' | ',' | ';' | ':' | '?' | '!' | '\n' | '(' | ')' => {
                end(&mut word, &mut tokens);
                // "chair?!", "...": one pause.
                if tokens.last().is_none_or(|last| last != BREAK) {
                    tokens.push(BREAK.into());
                }
            }
            _ => end(&mut word, &mut tokens),
        }
    }
    end(&mut word, &mut tokens);
    tokens
}

/// Returns whether a comma between a number and what follows separates thousands: three digits come
/// after it, and no fourth.
fn is_thousands(before: &str, next: &str) -> bool {
    let digits = next.chars().take_while(char::is_ascii_digit).count();
    digits == 3 && before.len() <= 3 && before.chars().all(|c| c.is_ascii_digit()) && before != "0"
}

/// Shorter words have too many similar words to correct them safely.
const MIN_SLIP_CHARS: usize = 5;
/// Minimum length of a word for which two wrong letters are corrected.
const TWO_SLIPS_FROM_CHARS: usize = 8;

/// Returns the noun of the lexicon for a misspelled word: "refridgerator". `None` when no single
/// one is similar.
pub(super) fn correct_spelling(word: &str) -> Option<&'static str> {
    let length = word.chars().count();
    if !word.is_ascii() || WordNet::get().is_english(word) {
        return None;
    }
    if length < MIN_SLIP_CHARS {
        return double_letter(word);
    }
    let allowed = if length >= TWO_SLIPS_FROM_CHARS { 2 } else { 1 };
    let near = |known: &'static str| {
        (known.len().abs_diff(word.len()) <= allowed && known.as_bytes()[0] == word.as_bytes()[0])
            .then(|| (distance(word, known), known))
            .filter(|(distance, _)| *distance <= allowed)
    };
    let mut found: Vec<(usize, &str)> =
        Lexicon::get().words().filter(|w| w.len() >= MIN_SLIP_CHARS - 1).filter_map(near).collect();
    found.sort_unstable();
    found.first().map(|(_, known)| *known)
}

fn distance(word: &str, known: &str) -> usize {
    cost::count();
    strsim::damerau_levenshtein(word, known)
}

/// Returns the noun that a short word becomes with one letter doubled: "bal".
fn double_letter(word: &str) -> Option<&'static str> {
    (1..=word.len())
        .find_map(|i| Lexicon::get().canonical_word(&format!("{}{}", &word[..i], &word[i - 1..])))
}

/// Returns the noun that two separated words form: "wheel barow". Two English words must match
/// exactly.
pub(super) fn join_words(first: &str, second: &str) -> Option<&'static str> {
    let lexicon = Lexicon::get();
    let of_the_grammar = |word: &str| words::longest_match(&[word]).is_some();
    if of_the_grammar(first)
        || of_the_grammar(second)
        || lexicon.is_known(&format!("{first} {second}"))
    {
        return None;
    }
    let whole = format!("{first}{second}");
    lexicon.canonical_word(&whole).or_else(|| {
        (!WordNet::get().is_english(second) && !lexicon.is_known(second))
            .then(|| correct_spelling(&whole))?
    })
}

/// Returns the word of the grammar for a misspelled word: "somethng". `None` for English words, and
/// for nouns of the lexicon.
pub(super) fn correct_small_word(word: &str) -> Option<&'static str> {
    let length = word.chars().count();
    if length < MIN_SLIP_CHARS
        || !word.is_ascii()
        || WordNet::get().is_english(word)
        || Lexicon::get().is_known(word)
        || words::is_known(word)
    {
        return None;
    }
    let near = |known: &&'static str| {
        known.len() >= MIN_SLIP_CHARS
            && known.as_bytes()[0] == word.as_bytes()[0]
            && distance(word, known) == 1
    };
    words::single_words().filter(near).min()
}

/// Returns the stem of a verb: "sitting" -> "sit", "tells" -> "tell". Exact enough to compare
/// verbs.
pub(super) fn stem(word: &str) -> String {
    let undoubled = |stem: &str| {
        let mut from_the_end = stem.chars().rev();
        match (from_the_end.next(), from_the_end.next()) {
            (Some(last), Some(before)) if last == before && !matches!(last, 'l' | 's' | 'e') => {
                stem[..stem.len() - last.len_utf8()].to_owned()
            }
            _ => stem.to_owned(),
        }
    };
    for suffix in ["ing", "ed", "es", "s"] {
        if let Some(stem) = word.strip_suffix(suffix).filter(|stem| stem.len() >= 3) {
            return undoubled(stem).trim_end_matches('e').to_owned();
        }
    }
    word.trim_end_matches('e').to_owned()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn misspelled_words_are_corrected_but_other_words_are_not() {
        assert_eq!(correct_spelling("refrigeratr"), Some("refrigerator"));
        assert_eq!(correct_spelling("tabel"), Some("table"));
        assert_eq!(correct_spelling("bookcse"), Some("bookcase"));
        assert_eq!(correct_spelling("bal"), Some("ball"));
        assert_eq!(join_words("wheel", "barow"), Some("wheelbarrow"));
        assert_eq!(join_words("book", "case"), None, "the lexicon has \"book case\"");
        for (first, second) in
            [("red", "chair"), ("the", "bed"), ("chair", "table"), ("lamp", "xyzzy")]
        {
            assert_eq!(join_words(first, second), None, "{first} {second}");
        }
        for word in ["theremin", "quaternion", "xyz", "hat", "wine"] {
            assert_eq!(correct_spelling(word), None, "{word}");
        }
    }

    #[test]
    fn verb_forms_have_the_same_stem() {
        for (a, b) in [
            ("sitting", "sit"),
            ("tells", "tell"),
            ("writing", "write"),
            ("throws", "throw"),
            ("washes", "wash"),
        ] {
            assert_eq!(stem(a), stem(b), "{a}");
        }
    }
}
