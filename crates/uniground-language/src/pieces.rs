//! Splits tokens into pieces: nouns of the lexicon, words of the grammar, and the rest.

use super::tokens::{BREAK, join_words};
use super::words::{self, Meaning};
use super::{Measure, cost, distances, zones};
use uniground_models::attributes::Lexicon;

/// One piece of the query.
#[derive(Debug, Clone, PartialEq)]
pub(super) enum Piece {
    Word(Meaning, String),
    Noun(String),
    Unknown(String),
    /// A comma or the end of a sentence.
    Break,
}

/// Returns how many tokens address the robot: "hey robot, ".
pub(super) fn address(tokens: &[String]) -> usize {
    const CALLED: [&str; 6] = ["robot", "assistant", "hey", "hello", "hi", "ok"];
    let called = tokens.iter().take_while(|token| CALLED.contains(&token.as_str())).count();
    match tokens.get(called) {
        Some(pause) if called > 0 && pause == BREAK => called + 1,
        _ => 0,
    }
}

pub(super) fn pieces(tokens: &[String]) -> Vec<Piece> {
    let words: Vec<&str> = tokens.iter().map(String::as_str).collect();
    let mut pieces = Vec::new();
    let (mut at, mut end) = (0, 0);
    while at < words.len() {
        if words[at] == BREAK {
            pieces.push(Piece::Break);
            at += 1;
            continue;
        }
        // No entry of the tables spans a break.
        if at >= end {
            end = (at..words.len()).find(|&i| words[i] == BREAK).unwrap_or(words.len());
        }
        let run = &words[at..end];
        if let [first, second, ..] = *run
            && let Some(noun) = join_words(first, second)
        {
            pieces.push(Piece::Noun(noun.to_owned()));
            at += 2;
            continue;
        }
        let noun = longest_noun(run);
        let word = match (run[0], words::longest_match(run)) {
            // "the right monitor", "the one on the right": "right" alone before a noun is a side,
            // elsewhere it means "directly".
            ("left" | "right", Some((Meaning::Filler, 1)) | None)
                if run.len() == 1 || noun_follows(&run[1..]) =>
            {
                let side = if run[0] == "left" { Measure::Leftmost } else { Measure::Rightmost };
                Some((Meaning::Superlative(side), 1))
            }
            ("top" | "bottom" | "center" | "centre", None) if noun_follows(&run[1..]) => {
                let end = match run[0] {
                    "top" => Measure::Highest,
                    "bottom" => Measure::Lowest,
                    _ => Measure::Middle,
                };
                Some((Meaning::Superlative(end), 1))
            }
            // "the monitor on the right desk" is on a desk.
            ("on" | "in" | "at", Some((Meaning::Superlative(_), length)))
                if run[1] == "the" && noun_follows(&run[length..]) =>
            {
                words::longest_match(&run[..1])
            }
            (_, word) => word,
        };
        // "the lamp stands by the door", "the can", "what you can see": a noun only where one is
        // possible.
        let several =
            matches!(pieces.last(), Some(Piece::Noun(noun)) if Lexicon::get().is_plural(noun));
        let a_verb = WORDS_AND_NOUNS.contains(&run[0])
            && word.is_some_and(|(_, length)| length == 1)
            && !awaits_noun(pieces.last())
            || run[0] == "stand" && several;
        at += match (noun.filter(|&length| length > 1 || !a_verb), word) {
            (Some(length), word) if word.is_none_or(|(_, w)| length >= w) => {
                pieces.push(Piece::Noun(run[..length].join(" ")));
                length
            }
            (_, Some((meaning, length))) => {
                let text =
                    distances::joined_words(run[0]).unwrap_or_else(|| run[..length].join(" "));
                pieces.push(Piece::Word(meaning, text));
                length
            }
            _ => {
                pieces.push(Piece::Unknown(run[0].to_owned()));
                1
            }
        };
    }
    pieces
}

/// Nouns that are as often a verb or carry no meaning.
const WORDS_AND_NOUNS: [&str; 3] = ["can", "stands", "present"];

/// Returns whether a noun may follow a piece: "the", "red".
fn awaits_noun(piece: Option<&Piece>) -> bool {
    matches!(
        piece,
        None | Some(
            Piece::Unknown(_)
                | Piece::Word(
                    Meaning::Determiner
                        | Meaning::Color(_)
                        | Meaning::Trait(_)
                        | Meaning::Number(_)
                        | Meaning::Ordinal(_)
                        | Meaning::Superlative(_),
                    _
                )
        )
    )
}

/// Returns whether a noun follows, with or without colors and traits before it.
fn noun_follows(run: &[&str]) -> bool {
    let describes = |word: &&&str| {
        matches!(words::longest_match(&[word]), Some((Meaning::Color(_) | Meaning::Trait(_), 1)))
    };
    let described = run.iter().take_while(describes).count();
    longest_noun(&run[described..]).is_some()
}

/// Returns the length in words of the longest noun at the start.
pub(super) fn longest_noun(run: &[&str]) -> Option<usize> {
    let names_instances =
        |word: &&str| super::instance_in(word).is_some() || super::instances_in(word).is_some();
    if run.first().is_some_and(names_instances) {
        return Some(1);
    }
    let lexicon = Lexicon::get();
    let is_noun = |n: usize| {
        cost::count();
        let candidate = run[..n].join(" ");
        let thing = (words::is_anything(&candidate) && n == 1)
            || is_structural(&candidate)
            || lexicon.is_known(&candidate);
        thing || zones::nouns_of_zone(&candidate).is_some()
    };
    (1..=lexicon.longest_words().max(zones::LONGEST).min(run.len())).rev().find(|&n| is_noun(n))
}

/// Returns whether a word names a part of the building.
pub(super) fn is_structural(word: &str) -> bool {
    super::structure_of(word).is_some()
}

/// Returns whether a noun phrase without an article follows: "closest chair", not "closest the
/// chair".
pub(super) fn is_bare_noun(rest: &[Piece]) -> bool {
    rest.iter()
        .find(|p| !matches!(p, Piece::Word(Meaning::Color(_) | Meaning::Trait(_), _)))
        .is_some_and(|p| matches!(p, Piece::Noun(_)))
}

/// Returns whether more description and then its noun follow: "a square, wooden table".
pub(super) fn has_noun_ahead(rest: &[Piece]) -> bool {
    let describes = |p: &&Piece| {
        matches!(
            p,
            Piece::Unknown(_)
                | Piece::Word(Meaning::Color(_) | Meaning::Trait(_) | Meaning::And, _)
        )
    };
    rest.iter().find(|p| !describes(p)).is_some_and(|p| matches!(p, Piece::Noun(_)))
}

/// Returns whether a piece has no meaning by itself.
pub(super) fn is_filler(piece: &Piece) -> bool {
    matches!(
        piece,
        Piece::Word(Meaning::Filler | Meaning::Determiner | Meaning::OfLast | Meaning::OfTarget, _)
    )
}
