//! Sentences that begin with what somebody does: of "heading out, I need the umbrella by the door" the umbrella is asked for.

use super::tokens::BREAK;
use super::words::{self, Meaning as Word};
use super::{Meaning, ParsedQuery, Phrase, zones};
use crate::models::attributes::WordNet;

/// So many beginnings are tried: each costs a reading.
const MOST_READINGS: usize = 8;

/// What a later part of the query asks for, where the word that was taken for its target is a verb nobody listed; its clauses come first, then
/// what follows its articles.
pub(super) fn of_a_thing(query: &ParsedQuery, tokens: &[String], read: impl Fn(&[String]) -> ParsedQuery) -> Option<ParsedQuery> {
    let verb = unknown_verb(&query.target, tokens)?;
    let later = &tokens[verb + 1..];
    let clauses = (1..later.len()).filter(|&i| later[i - 1] == BREAK);
    let articles = (0..later.len()).filter(|&i| matches!(words::longest(&[&later[i]]), Some((Word::Determiner, _))));
    let mut readings = clauses.chain(articles).take(MOST_READINGS).map(|start| read(&later[start..]));
    let mut found = readings.find(|reading| tells_a_thing(&reading.target))?;
    found.not_understood.insert(0, tokens[verb].clone());
    Some(found)
}

/// Index of the word that was taken for the target, if it is what somebody does and no thing: "I want to ride", "what could I lounge in".
fn unknown_verb(target: &Phrase, tokens: &[String]) -> Option<usize> {
    let head = target.head.as_str();
    if target.meaning() != Meaning::Unknown || zones::made_of(head).is_some() {
        return None;
    }
    let at = tokens.iter().position(|token| token == head)?;
    let before = at.checked_sub(1).map_or(BREAK, |i| tokens[i].as_str());
    let is_described = !matches!(words::longest(&[before]), None | Some((Word::Filler | Word::And, _)));
    let of_somebody = matches!(before, "to" | "i" | "you" | "we" | "they" | "one");
    let is_thing = !WordNet::get().kinds_of(head).is_empty();
    (!is_described && (!is_thing || of_somebody || head.ends_with("ing"))).then_some(at)
}

/// Whether a phrase tells its thing from others.
fn tells_a_thing(phrase: &Phrase) -> bool {
    match phrase.meaning() {
        Meaning::Anything => !phrase.colours.is_empty() || !phrase.with.is_empty() || !phrase.relations.is_empty(),
        Meaning::Nouns(_) | Meaning::Structure(_) => true,
        Meaning::Unknown => !phrase.could_be.is_empty(),
    }
}
