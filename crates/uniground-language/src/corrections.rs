//! Applies self-corrections: "the brown bag. No, I mean the box" asks for the box.

use super::pieces::longest_noun;
use super::tokens::BREAK;
use super::words::{self, Meaning};

/// Words that withdraw what was said before; longest first.
const TAKEN_BACK: [&[&str]; 14] = [
    &["sorry", "i", "mean"],
    &["sorry", "i", "meant"],
    &["no", "i", "mean"],
    &["no", "i", "meant"],
    &["scratch", "that"],
    &["i", "mean"],
    &["i", "meant"],
    &["or", "rather"],
    &["actually", "no"],
    &["no", "sorry"],
    &["no", "wait"],
    &["wait", "no"],
    &["sorry"],
    &["no"],
];

/// Returns the query after all corrections. "The green one" after "the red chair, sorry" is the
/// green chair.
pub(super) fn apply_corrections(tokens: Vec<String>) -> Vec<String> {
    let Some((at, length)) = (1..tokens.len())
        .rev()
        .find_map(|at| count_withdrawn_words(&tokens, at).map(|length| (at, length)))
    else {
        return tokens;
    };
    let noun = (0..at).find_map(|i| named_object(&tokens[i..at]));
    let (Some(noun), after) = (noun, &tokens[at + length..]) else { return tokens };
    let mut meant: Vec<String> = Vec::with_capacity(after.len() + noun.len());
    // "no, next to the door": the same object in another place.
    let of_the_same = matches!(
        words::longest_match(&run(after)),
        Some((Meaning::Relation(_) | Meaning::With { .. }, _))
    );
    if of_the_same {
        meant.extend(noun.iter().cloned());
    }
    let mut others_are_named = of_the_same;
    for (i, word) in after.iter().enumerate() {
        let stands_for_it = matches!(word.as_str(), "one" | "ones") && !others_are_named;
        others_are_named |= named_object(&after[i..]).is_some();
        if stands_for_it { meant.extend(noun.iter().cloned()) } else { meant.push(word.clone()) }
    }
    meant
}

/// Returns how many words from `at` on withdraw what was said before; pauses between and after them
/// count.
fn count_withdrawn_words(tokens: &[String], at: usize) -> Option<usize> {
    let matched = |words: &&&[&str]| {
        let mut i = at;
        for word in **words {
            while tokens.get(i).is_some_and(|t| t == BREAK) && i > at {
                i += 1;
            }
            if tokens.get(i).is_none_or(|t| t != word) {
                return None;
            }
            i += 1;
        }
        Some(i)
    };
    let (words, mut end) =
        TAKEN_BACK.iter().find_map(|words| matched(&words).map(|end| (words, end)))?;
    // "no" and "sorry" alone count only between two descriptions.
    let alone = words.len() == 1;
    let begins = |word: &str| {
        word == BREAK || matches!(words::longest_match(&[word]), Some((Meaning::Determiner, _)))
    };
    if alone && (tokens[at - 1] != BREAK || !tokens.get(end).is_some_and(|next| begins(next))) {
        return None;
    }
    while tokens.get(end).is_some_and(|t| t == BREAK) {
        end += 1;
    }
    // A new description must follow.
    (end < tokens.len()).then_some(end - at)
}

/// Returns the object named at the start of `tokens`; words such as "thing" name none.
fn named_object(tokens: &[String]) -> Option<Vec<String>> {
    let run = run(tokens);
    let length =
        longest_noun(&run).filter(|&length| !words::is_anything(&run[..length].join(" ")))?;
    Some(tokens[..length].to_vec())
}

fn run(tokens: &[String]) -> Vec<&str> {
    tokens.iter().map(String::as_str).take_while(|t| *t != BREAK).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::tokens::tokenize;

    #[test]
    fn later_correction_replaces_the_earlier_description() {
        for (said, meant) in [
            ("Give me the brown bag. No, I mean the box.", "the box ,"),
            ("the red chair, sorry, the green one", "the green chair"),
            (
                "the coffee table, no, the other one by the door",
                "the other coffee table by the door",
            ),
            ("the chair next to the table, no wait, next to the door", "chair next to the door"),
            (
                "an open book on the desk and another one on the bed, i mean the one on the bed",
                "the book on the bed",
            ),
            (
                "the lamp or rather the one with the mug beside it",
                "the lamp with the mug beside it",
            ),
            ("the mug, I mean the cup, no, the glass", "the glass"),
            ("I mean the white bookshelf", "i mean the white bookshelf"),
            ("sorry, where is the chair?", "sorry , where is the chair ,"),
            ("the table with no mug", "the table with no mug"),
            ("the sofa, not the red one", "the sofa , not the red one"),
            ("is there a bed? no", "is there a bed , no"),
        ] {
            assert_eq!(apply_corrections(tokenize(said)).join(" "), meant, "{said}");
        }
    }
}
