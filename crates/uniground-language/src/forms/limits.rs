//! Measures and distances compared with a given length: "is the door wider than 90 cm".

use super::comparisons::{COMPARATIVES, FIRST_SUPERLATIVE};
use super::measures::DIMENSIONS;
use super::patterns::{Found, PatternReader};
use super::words::{Quantifier, after, before, owned, pair_with_nouns, split_pair};
use super::{Bound, ComparedBy, Dimension, Form, Limit, Reference};
use crate::distances;

/// Words in front of a length.
const BOUNDS: [(&str, Bound); 22] = [
    ("no more than", Bound::Below),
    ("not more than", Bound::Below),
    ("no less than", Bound::Above),
    ("not less than", Bound::Above),
    ("no wider than", Bound::Below),
    ("no taller than", Bound::Below),
    ("more than", Bound::Above),
    ("less than", Bound::Below),
    ("fewer than", Bound::Below),
    ("at least", Bound::Above),
    ("at most", Bound::Below),
    ("greater than", Bound::Above),
    ("longer than", Bound::Above),
    ("shorter than", Bound::Below),
    ("over", Bound::Above),
    ("above", Bound::Above),
    ("under", Bound::Below),
    ("below", Bound::Below),
    ("exactly", Bound::About),
    ("about", Bound::About),
    ("around", Bound::About),
    ("roughly", Bound::About),
];

/// Words behind a length, and what they measure.
const ADJECTIVES: [(&str, Dimension); 14] = [
    ("wide", Dimension::Width),
    ("across", Dimension::Width),
    ("in width", Dimension::Width),
    ("long", Dimension::Length),
    ("in length", Dimension::Length),
    ("tall", Dimension::Height),
    ("high", Dimension::Height),
    ("in height", Dimension::Height),
    ("deep", Dimension::Depth),
    ("thick", Dimension::Depth),
    ("in depth", Dimension::Depth),
    ("above the floor", Dimension::Elevation),
    ("off the floor", Dimension::Elevation),
    ("from the floor", Dimension::Elevation),
];

/// Maximum number of words for the other object of a distance: more of them say something else too.
const MOST_WORDS: usize = 8;

/// What a question says is measured, with the words for the object.
enum Measured<'b> {
    /// A measure of one object's box.
    Size(Dimension, Vec<&'b str>),
    /// The distance of two objects.
    Distance(Vec<&'b str>, Reference),
}

impl PatternReader<'_> {
    /// "is the door wider than 90 cm", "is the desk at least 1.5 m long", "is the gap between the
    /// beds more than 1 m", "are the sofa and the TV 2 m apart"
    pub(super) fn limit(&mut self, words: &[&str]) -> Found {
        if let Some(found) = self.space_between(words) {
            return Some(found);
        }
        let rest = after(words, &["is not", "are not", "is", "are"])?;
        let (quantifier, rest) = Quantifier::split(rest);
        if quantifier == Some(Quantifier::None) {
            return None;
        }
        let rest = &rest[..];
        if let Some(found) = self.distance_limit(rest, quantifier.is_some()) {
            return Some(found);
        }
        let (at, given_m, length) = (1..rest.len()).find_map(|i| {
            let (given_m, length) = distances::length_at(&rest[i..])?;
            Some((i, given_m, length))
        })?;
        let (said, behind) = (&rest[..at], &rest[at + length..]);
        let (measured, bound) = self.measured(said, behind)?;
        let (by, target) = match measured {
            Measured::Size(dimension, target) => (ComparedBy::Dimension(dimension), target),
            Measured::Distance(target, reference) => (ComparedBy::Distance(reference), target),
        };
        if target.is_empty() {
            return None;
        }
        let of_all = quantifier.is_some() || self.is_plural_object(&target);
        Some((Form::Limit(Limit { by, bound, given_m, of_all }), owned(&target)))
    }

    /// "is the bin more than 50 cm from the door"
    fn distance_limit(&mut self, rest: &[&str], of_all: bool) -> Found {
        let at = (1..rest.len()).find(|&i| distances::joined_reach(rest[i]).is_some())?;
        let reach = distances::joined_reach(rest[at])?;
        let (target, other) = (&rest[..at], &rest[at + 1..]);
        // "is the bin not within 1 m of the door" is a claim.
        if other.is_empty() || target.contains(&"not") || other.len() > MOST_WORDS {
            return None;
        }
        let (bound, given_m) = if reach.most.is_infinite() {
            (Bound::Above, reach.least)
        } else if reach.least == 0.0 {
            (Bound::Below, reach.most)
        } else {
            (Bound::About, f32::midpoint(reach.least, reach.most))
        };
        let of_all = of_all || self.is_plural_object(target);
        let by = ComparedBy::Distance(self.reference(other));
        Some((Form::Limit(Limit { by, bound, given_m, of_all }), owned(target)))
    }

    /// Reads the words before and behind a given length.
    fn measured<'b>(
        &mut self,
        said: &[&'b str],
        behind: &[&'b str],
    ) -> Option<(Measured<'b>, Bound)> {
        // "wider than", "higher above the floor than"
        let compared =
            COMPARATIVES[..FIRST_SUPERLATIVE].iter().find_map(|(word, dimension, more)| {
                let subject = before(said, &[&format!("{word} than")])?;
                Some((subject, *dimension, if *more { Bound::Above } else { Bound::Below }))
            });
        if let Some((subject, dimension, bound)) = compared.filter(|_| behind.is_empty()) {
            if let Some(pair) = self.distance_of(subject) {
                return Some((pair, bound));
            }
            // A length is no volume: the longest side counts.
            let dimension = if dimension == Dimension::Volume { Dimension::All } else { dimension };
            return Some((Measured::Size(dimension, subject.to_vec()), bound));
        }
        // "at least as long as"
        if let Some(said) = before(said, &["as"]).filter(|_| behind.is_empty()) {
            let (word, dimension) =
                ADJECTIVES.iter().find(|(word, _)| before(said, &[word]).is_some())?;
            let said = before(said, &[word]).and_then(|said| before(said, &["as"]))?;
            let bound = BOUNDS.iter().find_map(|(words, b)| Some((before(said, &[words])?, *b)));
            let (subject, bound) = bound.unwrap_or((said, Bound::About));
            return Some((Measured::Size(*dimension, subject.to_vec()), bound));
        }
        let bounded =
            BOUNDS.iter().find_map(|(words, bound)| Some((before(said, &[words])?, *bound)));
        let (subject, bound) = bounded.unwrap_or((said, Bound::About));
        if let Some((_, dimension)) =
            ADJECTIVES.iter().find(|(word, _)| behind.iter().copied().eq(word.split(' ')))
        {
            return Some((Measured::Size(*dimension, subject.to_vec()), bound));
        }
        if matches!(
            behind,
            ["apart"] | ["away", "from", "each", "other"] | ["from", "each", "other"]
        ) {
            let (target, other) = match split_pair(subject, "and") {
                Some((first, second)) => pair_with_nouns(first, second),
                // "are the two stools more than 1 m apart"
                None => (subject.to_vec(), subject.to_vec()),
            };
            let other = self.reference(&other);
            return Some((Measured::Distance(target, other), bound));
        }
        if matches!(behind, ["away"] | ["away", "from", "me"]) {
            return Some((Measured::Distance(subject.to_vec(), Reference::Observer), bound));
        }
        if !behind.is_empty() || bounded.is_none() {
            return None;
        }
        // "is the height of the door more than 2 m", "is the gap between … more than 1 m"
        if let Some(pair) = self.distance_of(subject) {
            return Some((pair, bound));
        }
        let named = after(subject, &["the"])?;
        DIMENSIONS.iter().find_map(|(word, dimension)| {
            let target = after(named, &[word]).and_then(|rest| after(rest, &["of"]))?;
            Some((Measured::Size(*dimension, target.to_vec()), bound))
        })
    }

    /// "the gap between A and B", "the distance from A to B"
    fn distance_of<'b>(&mut self, words: &[&'b str]) -> Option<Measured<'b>> {
        let words = after(words, &["the"]).unwrap_or(words);
        let rest = after(words, &["distance", "gap", "space", "spacing", "clearance", "passage"])?;
        let pair = after(rest, &["between"]).and_then(|pair| split_pair(pair, "and"));
        if let Some((first, second)) = pair {
            let (target, other) = pair_with_nouns(first, second);
            let other = self.reference(&other);
            return Some(Measured::Distance(target, other));
        }
        // "the distance between the beds"
        if let Some(both) = after(rest, &["between"]) {
            let other = self.reference(both);
            return Some(Measured::Distance(both.to_vec(), other));
        }
        let (first, second) = after(rest, &["from"]).and_then(|pair| split_pair(pair, "to"))?;
        let other = self.reference(second);
        Some(Measured::Distance(first.to_vec(), other))
    }

    /// "is there more than 1 m between the beds", "is there at least 60 cm of space between A and B"
    fn space_between(&mut self, words: &[&str]) -> Found {
        let rest = after(words, &["is there"])?;
        let joined = rest.first().and_then(|token| distances::joined_reach(token));
        let (bound, given_m, rest) = match joined {
            Some(reach) if reach.most.is_infinite() => (Bound::Above, reach.least, &rest[1..]),
            Some(reach) if reach.least == 0.0 => (Bound::Below, reach.most, &rest[1..]),
            Some(_) => return None,
            None => {
                let bounded =
                    BOUNDS.iter().find_map(|(words, bound)| Some((after(rest, &[words])?, *bound)));
                let (rest, bound) = bounded.unwrap_or((rest, Bound::Above));
                let (given_m, length) = distances::length_at(rest)?;
                (bound, given_m, &rest[length..])
            }
        };
        let rest = after(rest, &["of"]).unwrap_or(rest);
        let rest = after(rest, &["free space", "space", "room", "clearance"]).unwrap_or(rest);
        let between = after(rest, &["left between", "between"])?;
        let (target, other) = match split_pair(between, "and") {
            Some((first, second)) => pair_with_nouns(first, second),
            None => (between.to_vec(), between.to_vec()),
        };
        let by = ComparedBy::Distance(self.reference(&other));
        Some((Form::Limit(Limit { by, bound, given_m, of_all: false }), owned(&target)))
    }

    /// Returns whether words name several objects: "the windows".
    pub(super) fn is_plural_object(&self, words: &[&str]) -> bool {
        (self.read)(&owned(words)).quantity != crate::Quantity::One
    }
}
