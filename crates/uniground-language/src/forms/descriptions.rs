//! What an object is, where it is, and whether something holds of it.

use super::lists::{PEOPLE, PUTS};
use super::patterns::{Found, PatternReader};
use super::words::{
    PLACED, Quantifier, after, before, is_article, is_comparing_place, is_place, owned,
    skip_placed, skip_trailing_placed,
};
use super::{Aspect, Claim, Form};
use crate::Quantity;
use crate::pieces::longest_noun;
use crate::words::{self, Meaning};

impl PatternReader<'_> {
    /// "is the mug on the table", "are all chairs red", "isn't the lamp on", "does every desk have
    /// a lamp"
    pub(super) fn holds(&mut self, words: &[&str]) -> Found {
        let rest = after(words, &["is", "are"]);
        let done = after(words, &["does", "do"]);
        let asked = rest.or(done)?;
        // "isn't the lamp on the desk" expects a yes.
        let asked = after(asked, &["not"]).unwrap_or(asked);
        // "do any of the chairs have a cushion"
        let any = after(asked, &["any of the", "any of my", "any of these", "any"]);
        if let Some(any) = any.filter(|_| done.is_some()) {
            let any = [&["the"], any].concat();
            return Some((Form::Exists, owned(&claim_with_verb(&any)?)));
        }
        let (quantifier, asked) = Quantifier::split(asked);
        if asked.len() < 2 || !is_article(asked[0]) {
            return None;
        }
        let claimed = if done.is_some() { claim_with_verb(&asked)? } else { asked };
        let rest = &claimed[..];
        let (claim, is_found) = match claim_of(rest) {
            Some(claim) => (claim, true),
            // "is the window open", "are both sofas the same": nothing that a scan shows.
            None => (end_of_object(rest)?, false),
        };
        let (mut subject, mut said) = (&rest[..claim], &rest[claim..]);
        let mut is_negated = quantifier == Some(Quantifier::None);
        let mut of_all = quantifier.is_some();
        if let ["not" | "n't", claimed @ ..] = said {
            (said, is_negated) = (claimed, !is_negated);
        } else if let [before @ .., "not"] = subject {
            (subject, is_negated) = (before, !is_negated);
        }
        // "are the chairs all red"
        if let [before @ .., "all" | "both"] = subject {
            (subject, of_all) = (before, true);
        }
        if let ["all" | "both", claimed @ ..] = said {
            (said, of_all) = (claimed, true);
        }
        let subject = skip_trailing_placed(subject);
        if subject.len() < 2 && !subject.first()?.starts_with('#') || said.is_empty() {
            return None;
        }
        let read = (self.read)(&owned(subject));
        of_all |= read.quantity != Quantity::One;
        self.not_understood.extend(read.not_understood);
        // "is #4 a chair", "is the mug red" and "is the mug on the table" all ask for one object
        // of which the claim holds.
        let target: Vec<&str> = match words::longest_match(said) {
            _ if !is_found => {
                self.not_understood.extend(owned(said));
                subject.to_vec()
            }
            Some((Meaning::Color(_) | Meaning::Trait(_), _)) => {
                subject[..1].iter().chain(said).chain(&subject[1..]).copied().collect()
            }
            _ if is_article(said[0]) => said.to_vec(),
            _ => subject.iter().chain(said).copied().collect(),
        };
        let subject = Box::new(read.target);
        Some((Form::Holds(Claim { subject, is_negated, of_all }), owned(&target)))
    }
}

/// Returns where the words begin that are said of the object before them: "on the table", "red".
fn claim_of(rest: &[&str]) -> Option<usize> {
    // "is the armchair beside the door green": the last word is said of the armchair.
    let adjective = (1..rest.len()).rev().find(|&i| {
        i + 2 >= rest.len()
            && matches!(
                words::longest_match(&rest[i..]),
                Some((Meaning::Color(_) | Meaning::Trait(_), length)) if length == rest.len() - i
            )
    });
    adjective.or_else(|| {
        (1..rest.len()).find(|&i| {
            let run = &rest[i..];
            match words::longest_match(run) {
                Some((
                    Meaning::Relation(_) | Meaning::With { .. } | Meaning::Side(_) | Meaning::Not,
                    _,
                )) => true,
                Some((Meaning::Superlative(_), length)) => length > 1,
                Some((Meaning::Color(_) | Meaning::Trait(_), length)) => {
                    run.len() == length || run[length] == "or" || run[length] == "and"
                }
                _ => is_article(run[0]) && i > 1 || is_article(run[0]) && rest[0].starts_with('#'),
            }
        })
    })
}

/// Returns where the words for an object end, if other words follow that are no part of its
/// description: "the window open".
fn end_of_object(rest: &[&str]) -> Option<usize> {
    let end = (1..rest.len()).find_map(|i| Some(i + longest_noun(&rest[i..])?))?;
    let end = end + (end..rest.len()).map_while(|i| longest_noun(&rest[i..=i])).count();
    (end < rest.len()).then_some(end)
}

/// Replaces the verb of a claim: "the desk have a lamp" is "the desk with a lamp", "the bin stand
/// on the floor" is "the bin on the floor".
fn claim_with_verb<'b>(words: &[&'b str]) -> Option<Vec<&'b str>> {
    const STANDS: [&str; 8] = ["stand", "sit", "lie", "hang", "rest", "lean", "stay", "belong"];
    let verb = (1..words.len())
        .find(|&i| STANDS.contains(&words[i]) || matches!(words[i], "have" | "carry" | "hold"))?;
    let (subject, claim) = (&words[..verb], &words[verb + 1..]);
    if claim.is_empty() {
        return None;
    }
    let said = if STANDS.contains(&words[verb]) {
        claim.to_vec()
    } else {
        // "a lamp on it": the lamp is on what has it.
        let claim = before(claim, &["on it", "on them", "in it", "in them", "on top"]);
        let claim = claim.unwrap_or(&words[verb + 1..]);
        std::iter::once("with").chain(claim.iter().copied()).collect()
    };
    Some(subject.iter().copied().chain(said).collect())
}

pub(super) fn description(words: &[&str]) -> Found {
    let all = |target: &[&str]| Some((Form::Description(Aspect::All), owned(target)));
    if let Some(target) = after(
        words,
        &[
            "describe",
            "tell me more about",
            "tell me about",
            "tell more about",
            "what can you tell me about",
            "what do you know about",
            "give me details about",
        ],
    ) {
        return all(target).filter(|_| !target.is_empty());
    }
    for (asked, aspect) in [
        (
            &["what color", "what colour", "which color", "which colour", "what colors"],
            Aspect::Color,
        ),
        (
            &["what material", "which material", "what fabric", "what wood", "what materials"],
            Aspect::Material,
        ),
    ] {
        if let Some(rest) = after(words, asked) {
            let target = after(rest, &["is", "are", "does", "has"])?;
            let target =
                before(target, &["have", "made of", "made from", "made out of"]).unwrap_or(target);
            return Some((Form::Description(aspect), owned(target)));
        }
    }
    if let Some(target) = after(
        words,
        &[
            "what is the color of",
            "what is the colour of",
            "the color of",
            "the colour of",
            "what are the colors of",
            "what are the colours of",
        ],
    ) {
        return Some((Form::Description(Aspect::Color), owned(target)));
    }
    if let Some(target) = after(words, &["what is the material of", "the material of"]) {
        return Some((Form::Description(Aspect::Material), owned(target)));
    }
    if let Some(rest) = after(words, &["what does", "what do"])
        && let Some(target) = before(rest, &["look like"])
    {
        return all(target);
    }
    if let Some(rest) = after(words, &["what kind of", "what sort of", "what type of"]) {
        let be = rest.iter().position(|word| matches!(*word, "is" | "are"))?;
        return all(&rest[be + 1..]).filter(|_| !is_place(&rest[be + 1..]));
    }
    let rest = after(words, &["what is", "what are", "what was"])?;
    if let Some(target) = before(rest, &["made of", "made from", "made out of"]) {
        return Some((Form::Description(Aspect::Material), owned(target)));
    }
    let rest = skip_placed(rest);
    if is_comparing_place(rest) {
        let target: Vec<&str> = std::iter::once("thing").chain(rest.iter().copied()).collect();
        return all(&target);
    }
    // "what is the lamp standing on" asks for a place.
    let ends_with_place = rest.len() > 2
        && matches!(
            rest.last(),
            Some(&("on" | "in" | "under" | "above" | "behind" | "inside" | "against"))
        );
    if ends_with_place && is_article(rest[0]) {
        let target = &rest[..rest.len() - 1];
        let target = if PLACED.contains(&target[target.len() - 1]) {
            &target[..target.len() - 1]
        } else {
            target
        };
        return Some((Form::Place, owned(target)));
    }
    (rest.first().is_some_and(|first| is_article(first)) && !is_place(rest))
        .then(|| all(rest))
        .flatten()
}

/// "where is the remote"
pub(super) fn place(words: &[&str]) -> Found {
    let named = after(words, &["what is the position of", "what is the location of"]);
    if let Some(target) = named {
        return Some((Form::Place, owned(target)));
    }
    if let Some(rest) = after(words, &["what does", "what do"])
        && let Some(target) = before(
            rest,
            &["stand on", "sit on", "lie on", "hang on", "hang from", "rest on", "stand in"],
        )
    {
        return Some((Form::Place, owned(target)));
    }
    let rest = after(words, &["where"])?;
    // "where did I leave my laptop"
    let left = match rest {
        ["did" | "do" | "does" | "have" | "has" | "could" | "can", who, verb, named @ ..]
            if PEOPLE.contains(who) && PUTS.contains(verb) =>
        {
            Some(named)
        }
        _ => None,
    };
    if let Some(named) = left.filter(|named| !named.is_empty()) {
        return Some((Form::Place, owned(named)));
    }
    let named = after(
        rest,
        &[
            "is",
            "are",
            "can i find",
            "can we find",
            "do i find",
            "do you see",
            "do we keep",
            "do we have",
            "did i leave",
            "did i put",
            "did you put",
            "did you see",
            "was",
            "were",
            "exactly is",
            "does",
        ],
    )?;
    let named =
        before(named, &["located", "placed", "stand", "sit", "lie", "hang"]).unwrap_or(named);
    // "where is a place to sit" and "where is somewhere quiet" are left to the grammar.
    (!named.is_empty()).then(|| (Form::Place, owned(named)))
}
