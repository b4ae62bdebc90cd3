//! Comparisons of two objects, and choices between them.

use super::patterns::{Found, PatternReader};
use super::words::{
    after, is_one_of, noun_of, owned, pair_with_nouns, singular, split_pair, with_noun,
};
use super::{ComparedBy, Comparison, Dimension, Form, Reference};
use crate::tokens::BREAK;

/// Comparatives, the measure that they compare, and whether more of it is meant.
pub(super) const COMPARATIVES: [(&str, Dimension, bool); 20] = [
    ("bigger", Dimension::Volume, true),
    ("larger", Dimension::Volume, true),
    ("smaller", Dimension::Volume, false),
    ("taller", Dimension::Height, true),
    ("shorter", Dimension::Height, false),
    ("higher", Dimension::Elevation, true),
    ("lower", Dimension::Elevation, false),
    ("wider", Dimension::Width, true),
    ("broader", Dimension::Width, true),
    ("longer", Dimension::Width, true),
    ("narrower", Dimension::Width, false),
    ("deeper", Dimension::Depth, true),
    ("shallower", Dimension::Depth, false),
    ("more tall", Dimension::Height, true),
    ("more wide", Dimension::Width, true),
    ("biggest", Dimension::Volume, true),
    ("largest", Dimension::Volume, true),
    ("smallest", Dimension::Volume, false),
    ("tallest", Dimension::Height, true),
    ("widest", Dimension::Width, true),
];

/// What takes up floor, and whether more of it is meant.
const FLOOR_TAKEN: [(&str, bool); 8] = [
    ("more floor space", true),
    ("more floor area", true),
    ("more floor", true),
    ("more space", true),
    ("more room", true),
    ("less floor space", false),
    ("less space", false),
    ("less room", false),
];

/// Index of the first superlative in [`COMPARATIVES`].
pub(super) const FIRST_SUPERLATIVE: usize = 15;

impl PatternReader<'_> {
    /// "which is taller, the lamp or the shelf", "is the sofa longer than the rug"
    pub(super) fn choice(&mut self, words: &[&str]) -> Found {
        let which = after(words, &["which", "what"]).and_then(|rest| {
            // "which one's closer" lost its verb with the apostrophe.
            if let ["one", compared @ ..] = rest
                && is_comparative(compared)
            {
                return Some((&rest[..1], compared));
            }
            const VERBS: [&str; 6] = ["is", "stands", "sits", "takes", "needs", "occupies"];
            let verb = rest.iter().position(|word| VERBS.contains(word))?;
            let compared = &rest[verb + 1..];
            let compared = compared.strip_prefix(&["up"]).unwrap_or(compared);
            (verb <= 5).then(|| (&rest[..verb], compared))
        });
        if let Some((kind, rest)) = which {
            let rest = after(rest, &["the"]).unwrap_or(rest);
            let Some((by, more, word, rest)) = self.comparative(rest, &[BREAK]) else {
                // "which toaster is next to the microwave, the green one or the yellow one": the
                // choice repeats what is asked for.
                let at = words.iter().position(|word| *word == BREAK)?;
                split_pair(&words[at + 1..], "or")?;
                return Some((Form::Object, owned(&words[..at])));
            };
            let pair = rest.strip_prefix(&[BREAK]).unwrap_or(&rest);
            let pair = pair.strip_suffix(&[BREAK]).unwrap_or(pair);
            let (target, other) = split_pair(pair, "or")?;
            let target = target.strip_suffix(&[BREAK]).unwrap_or(target);
            let noun = noun_of(kind).map_or_else(String::new, |noun| noun.join(" "));
            let kind: Vec<&str> = singular(&noun).split_whitespace().collect();
            let (target, other) = if kind.is_empty() {
                pair_with_nouns(target, other)
            } else {
                (with_noun(target, &kind), with_noun(other, &kind))
            };
            let other = Box::new(self.object(&other));
            return Some((Form::Choice(Comparison { by, more, word, other }), owned(&target)));
        }
        let rest = after(words, &["is", "are", "does", "do"])?;
        let at = (1..rest.len()).find(|&i| is_comparative(&rest[i..]))?;
        let (target, compared) = (&rest[..at], &rest[at..]);
        let target = after(target, &["not"]).unwrap_or(target);
        let (by, more, word, left) = self.comparative(compared, &["than", "or"])?;
        if let Some(other) = after(&left, &["than"]) {
            // "is the lamp closer to the door than to the window" compares the two anchors.
            if let (Some(second), ComparedBy::Distance(first)) = (after(other, &["to"]), &by) {
                let Reference::Object(_) = first else { return None };
                let first = after(compared, &[&word]).map_or_else(Vec::new, <[&str]>::to_vec);
                let first = first.split(|word| *word == "than").next().unwrap_or(&[]).to_vec();
                let first = after(&first, &["to", "from"]).unwrap_or(&first).to_vec();
                let by = ComparedBy::Distance(Reference::Object(Box::new(self.object(target))));
                let other = Box::new(self.object(second));
                let found = Comparison { by, more, word, other };
                return Some((Form::Comparison(found), owned(&first)));
            }
            let other = Box::new(self.object(other));
            return Some((Form::Comparison(Comparison { by, more, word, other }), owned(target)));
        }
        // "is the lamp closer to the door or the window"
        if let Some(second) = after(&left, &["or"]) {
            let ComparedBy::Distance(Reference::Object(_)) = &by else { return None };
            let second = after(second, &["to"]).unwrap_or(second);
            let first = after(compared, &[&word])?;
            let first = after(first, &["to", "from"]).unwrap_or(first);
            let first = first.split(|word| *word == "or").next()?;
            let by = ComparedBy::Distance(Reference::Object(Box::new(self.object(target))));
            let other = Box::new(self.object(second));
            return Some((Form::Choice(Comparison { by, more, word, other }), owned(first)));
        }
        // "is the lamp or the shelf taller"
        let (target, other) = split_pair(target, "or").filter(|_| left.is_empty())?;
        let other = Box::new(self.object(other));
        Some((Form::Choice(Comparison { by, more, word, other }), owned(target)))
    }

    /// "how much taller is the shelf than the desk"
    pub(super) fn difference(&mut self, words: &[&str]) -> Found {
        let rest = after(words, &["how much", "by how much"])?;
        let (by, more, word, rest) = self.comparative(rest, &["is", "are"])?;
        let rest = after(&rest, &["is", "are"])?;
        let than = rest.iter().position(|word| *word == "than")?;
        let (target, other) = pair_with_nouns(&rest[..than], &rest[than + 1..]);
        let other = Box::new(self.object(&other));
        let comparison = Comparison { by, more, word, other };
        Some((Form::Difference(comparison), owned(&target)))
    }

    /// Reads a comparative at the beginning: what it compares, whether more of it, its word, and
    /// the words after it. What "closer to" refers to ends at one of `ends`.
    fn comparative<'b>(
        &mut self,
        words: &[&'b str],
        ends: &[&str],
    ) -> Option<(ComparedBy, bool, String, Vec<&'b str>)> {
        for (word, dimension, more) in COMPARATIVES {
            if let Some(rest) = after(words, &[word]) {
                let by = ComparedBy::Dimension(dimension);
                return Some((by, more, word.to_owned(), rest.to_vec()));
            }
        }
        for (run, more) in FLOOR_TAKEN {
            if let Some(rest) = after(words, &[run]) {
                let by = ComparedBy::Dimension(Dimension::Area);
                let word = if more { "larger" } else { "smaller" };
                return Some((by, more, word.to_owned(), rest.to_vec()));
            }
        }
        let (word, rest) = words.split_first()?;
        let is_nearer = matches!(*word, "closer" | "nearer" | "closest" | "nearest");
        if !is_nearer && !matches!(*word, "farther" | "further" | "farthest" | "furthest") {
            return None;
        }
        let more = word.starts_with('f');
        let rest = after(rest, &["away"]).unwrap_or(rest);
        let Some(anchor) = after(rest, &["to", "from"]) else {
            return Some((
                ComparedBy::Distance(Reference::Observer),
                more,
                (*word).to_owned(),
                rest.to_vec(),
            ));
        };
        let end = anchor.iter().position(|word| ends.contains(word)).unwrap_or(anchor.len());
        let by = ComparedBy::Distance(self.reference(&anchor[..end]));
        Some((by, more, (*word).to_owned(), anchor[end..].to_vec()))
    }
}

pub(super) fn is_comparative(words: &[&str]) -> bool {
    COMPARATIVES[..FIRST_SUPERLATIVE].iter().any(|(word, ..)| after(words, &[word]).is_some())
        || is_one_of(words.first(), &["closer", "nearer", "farther", "further"])
}
