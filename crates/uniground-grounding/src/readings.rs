//! The nouns that a phrase's target may have: its own noun, and others from a parser with world
//! knowledge ("it wakes me every morning": alarm clock, clock, radio). The scene decides which of
//! them it has.

use super::GivenName;
use uniground_language::{Meaning, Phrase};
use uniground_models::attributes::Noun;

/// Weight of a noun relative to the one before it.
const LATER_NOUN: f32 = 0.95;

/// The nouns and uses that a phrase's target may have, the likeliest first.
pub(super) struct Readings(Vec<Reading>);

/// One of these nouns.
pub(super) struct Reading {
    /// Weight of the noun, `0..=1`.
    pub weight: f32,
    /// Noun, uses and words in front of the noun; nothing else of the phrase.
    pub phrase: Phrase,
    pub meaning: Meaning,
}

impl Readings {
    pub fn of(phrase: &Phrase) -> Self {
        let bare = |head: &str| Phrase {
            head: head.to_owned(),
            unchecked: phrase.unchecked.clone(),
            ..Phrase::default()
        };
        let first = Phrase {
            uses: phrase.uses.clone(),
            purpose: phrase.purpose.clone(),
            ..bare(&phrase.head)
        };
        let others =
            phrase.could_be.iter().filter(|noun| **noun != phrase.head).map(|noun| bare(noun));
        let weights = std::iter::successors(Some(1.0), |weight| Some(weight * LATER_NOUN));
        let reading =
            |(phrase, weight): (Phrase, f32)| Reading { weight, meaning: phrase.meaning(), phrase };
        Self(std::iter::once(first).chain(others).zip(weights).map(reading).collect())
    }

    pub fn iter(&self) -> impl Iterator<Item = &Reading> {
        self.0.iter()
    }

    /// Returns how well a given name fits under any of the nouns, `0..=1`.
    pub fn called(&self, name: &GivenName) -> f32 {
        self.0.iter().map(|reading| reading.fit(name)).fold(0.0, f32::max)
    }

    /// Returns the noun that a given name fits best, the first of equals.
    pub fn best_noun(&self, name: &GivenName) -> &str {
        let best = self
            .0
            .iter()
            .reduce(|best, next| if next.fit(name) > best.fit(name) { next } else { best });
        best.map_or("", |reading| &reading.phrase.head)
    }
}

impl Reading {
    /// Returns the nouns of the lexicon it may mean.
    pub fn nouns(&self) -> &[&'static Noun] {
        if let Meaning::Nouns(nouns) = &self.meaning { nouns } else { &[] }
    }

    fn fit(&self, name: &GivenName) -> f32 {
        self.weight * name.fit(&self.phrase, &self.meaning)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::fit::noun_fits;
    use crate::{NameIndex, SceneView};
    use uniground_geometry::boxes::Aabb;
    use uniground_geometry::scene::{Instance, Support};
    use uniground_geometry::{Point3, Vector3};
    use uniground_testing::thing;

    fn fits(names: &[&str], said: &Phrase) -> Vec<f32> {
        let named = |(id, name): (u32, &&str)| {
            let instance = thing(id, [id as f32, 0.0], [0.2; 3], 0.0, Support::Floor, [90; 3]);
            Instance { given_name: Some((*name).to_owned()), ..instance }
        };
        let instances: Vec<Instance> = (1..).zip(names).map(named).collect();
        let names = NameIndex::of(&instances);
        let extent = Aabb { center: Point3::origin(), size: Vector3::repeat(9.0) };
        noun_fits(
            SceneView { instances: &instances, extent, names: &names, appearance: None },
            said,
        )
    }

    fn noun_phrase(head: &str, could_be: &[&str]) -> Phrase {
        Phrase {
            head: head.into(),
            could_be: could_be.iter().map(|noun| (*noun).to_owned()).collect(),
            ..Phrase::default()
        }
    }

    #[test]
    fn all_possible_nouns_match_and_likelier_ones_weigh_more() {
        let asked = noun_phrase("alarm clock", &["radio"]);
        let found = fits(&["radio", "kettle"], &asked);
        assert!(found[0] > 0.9 && found[1] == 0.0, "{found:?}");
        let found = fits(&["radio", "alarm clock"], &asked);
        // An instance with the first noun comes before one with another noun.
        assert!(found[1] > 0.9 && (0.7..0.9).contains(&found[0]), "{found:?}");
        assert_eq!(fits(&["kettle"], &asked), [0.0]);
        let radio = GivenName::read("old radio").unwrap();
        assert_eq!(Readings::of(&asked).best_noun(&radio), "radio");
        assert!(
            Readings::of(&asked).called(&radio) > 0.9
                && Readings::of(&noun_phrase("kettle", &[])).called(&radio) == 0.0
        );
    }
}
