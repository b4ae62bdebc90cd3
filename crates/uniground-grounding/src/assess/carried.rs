//! What a thing carries, lacks or has as a part: "with the book on it", "without books", "with the
//! orange seat".

use super::{Assessor, CARRIED, MAX_ANCHORS, unchecked};
use crate::fit::{colours_fit, most_plausible};
use crate::relations;
use uniground_language::{Phrase, With};

/// Share of its score that a thing keeps when it lacks what it should carry.
const NOT_CARRIED: f32 = 0.1;
/// The same for what a thing should carry or have: small things and parts are seldom found.
const SMALL_NOT_FOUND: f32 = 0.6;

/// Parts of things ("the stool with the orange seat" speaks of the stool's own colour), each with
/// the nouns known for it; none: any thing.
const PARTS: &[(&str, &[&str])] = &[
    ("seat", &[]),
    ("back", &[]),
    ("backrest", &[]),
    ("leg", &[]),
    ("arm", &["armchair", "sofa", "office chair"]),
    ("armrest", &["armchair", "sofa", "office chair"]),
    ("handle", &[]),
    ("drawer", &["dresser", "nightstand", "filing cabinet", "desk", "cabinet"]),
    ("wheel", &["office chair", "cart", "suitcase", "bicycle"]),
    ("caster", &["office chair", "cart"]),
    ("top", &[]),
    ("frame", &[]),
    ("cushion", &["sofa", "armchair", "bench"]),
    ("shade", &["floor lamp", "desk lamp"]),
    ("lid", &[]),
    ("base", &[]),
    ("pattern", &[]),
    ("stripe", &[]),
    ("upholstery", &[]),
    ("edge", &[]),
    ("door", &[]),
    ("foot", &[]),
    ("body", &[]),
    ("paint", &[]),
    ("cover", &[]),
    ("rim", &[]),
    ("border", &[]),
    ("trim", &[]),
    ("button", &[]),
    ("cap", &[]),
    ("strap", &[]),
    ("front", &[]),
    ("panel", &[]),
    ("fabric", &[]),
];
/// Share of its score that a thing keeps when a part is asked for that it is not known for.
const ODD_PART: f32 = 0.4;
/// The same where a part has a colour that was not seen on the thing: parts are small.
const PART_OF_OTHER_COLOUR: f32 = 0.25;

impl Assessor<'_> {
    /// "with the book on it", "with four chairs", "without books", "with the orange seat".
    pub(super) fn apply_with(&self, With { phrase, absent }: &With, scores: &mut [f32]) {
        let singular =
            |part: &str| phrase.head == part || phrase.head.strip_suffix('s') == Some(part);
        if let Some((_, of)) = PARTS.iter().find(|(part, _)| singular(part)) {
            let known = |i: usize| of.is_empty() || of.iter().any(|noun| self.is_named(i, noun));
            for (i, score) in scores.iter_mut().enumerate().filter(|(_, s)| **s > 0.0) {
                let fit = colours_fit(self.scene, phrase, i).max(PART_OF_OTHER_COLOUR)
                    * if known(i) { 1.0 } else { ODD_PART };
                *score *= match *absent {
                    true if !of.is_empty() && known(i) => ODD_PART,
                    true => 1.0,
                    false => fit,
                };
            }
            return;
        }
        let found = self.assess(phrase);
        if let Some(share) =
            unchecked(std::slice::from_ref(phrase), std::slice::from_ref(&found), SMALL_NOT_FOUND)
        {
            if !absent {
                scores.iter_mut().for_each(|score| *score *= share);
            }
            return;
        }
        let things = most_plausible(&found.total, MAX_ANCHORS);
        let best = things.iter().map(|t| t.1).fold(f32::EPSILON, f32::max);
        let fit_of = |i: usize| {
            let carried = |&(t, _): &(usize, f32)| {
                let (thing, own) = (&self.solids[t], &self.solids[i]);
                let held = relations::on(thing, own).max(relations::inside(thing, own));
                held.max(0.6 * relations::around(thing, own))
            };
            let others = || things.iter().filter(|(t, _)| *t != i);
            match phrase.count {
                None => others().map(|t| t.1 * carried(t)).fold(0.0, f32::max),
                // What stands around counts when it stands close.
                Some(count) => {
                    let found: f32 = others()
                        .map(|t| t.1 / best * ((carried(t) - 0.3) / 0.2).clamp(0.0, 1.0))
                        .sum();
                    best.min(1.0) / (1.0 + ((found - count as f32) / 0.6).powi(2))
                }
            }
        };
        let fits: Vec<(usize, f32)> =
            most_plausible(scores, usize::MAX).into_iter().map(|(i, _)| (i, fit_of(i))).collect();
        // Where none carries such a thing, it was missed: books on a shelf are seldom found one by
        // one.
        let missed = !absent && fits.iter().all(|(_, fit)| *fit < CARRIED);
        let mut shares = vec![NOT_CARRIED; scores.len()];
        for (i, fit) in fits {
            let fit = NOT_CARRIED + (1.0 - NOT_CARRIED) * fit;
            shares[i] = if *absent {
                1.0 + NOT_CARRIED - fit
            } else {
                fit.max(if missed { SMALL_NOT_FOUND } else { 0.0 })
            };
        }
        scores.iter_mut().zip(shares).for_each(|(score, share)| *score *= share);
    }

    fn is_named(&self, index: usize, noun: &str) -> bool {
        let phrase = || Phrase { head: noun.to_owned(), ..Phrase::default() };
        match self.scene.names.get(index) {
            Some(name) => name.fit(&phrase(), &phrase().meaning()) > 0.0,
            None => self.scene.instances[index].names.iter().any(|guess| guess.name == noun),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use uniground_models::attributes;

    #[test]
    fn things_with_parts_are_names_of_the_lexicon() {
        for noun in PARTS.iter().flat_map(|(_, of)| *of) {
            assert!(
                attributes::Lexicon::get().nouns().iter().any(|known| known.name == *noun),
                "{noun}"
            );
        }
    }
}
