//! Decides whether a reading covers the whole question. If it does not, a parser with world
//! knowledge can do better.
//!
//! The judgment depends on the reading alone, not on its words, nor on the scene: the same words
//! always go to the same parser.

use super::{ME, Meaning, ParsedQuery, Phrase, Relation, affordances};
use std::fmt;

/// The part of a question that a reading leaves open.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Doubt {
    /// Most words are of another language than English.
    Foreign,
    /// No noun and no known purpose names the target or its anchor.
    Unnamed,
    /// An object is described by its purpose, and no known use has all of these words.
    Purpose(String),
    /// A relation without an anchor: the anchor was not understood.
    Unanchored(String),
    /// Words that could not be used, and unknown nouns.
    Words(Vec<String>),
}

impl fmt::Display for Doubt {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Foreign => f.write_str("the question is not in English"),
            Self::Unnamed => f.write_str("no noun tells what is meant"),
            Self::Purpose(words) => write!(f, "no use is known that is said as: {words}"),
            Self::Unanchored(words) => write!(f, "\"{words}\" is said of nothing"),
            Self::Words(words) => write!(f, "not understood: {}", words.join(", ")),
        }
    }
}

impl ParsedQuery {
    /// Returns the most serious part that this reading leaves open; `None` where every word was
    /// used.
    #[must_use]
    pub fn doubt(&self) -> Option<Doubt> {
        if self.foreign {
            return Some(Doubt::Foreign);
        }
        let others =
            self.standpoint.iter().chain(self.viewpoint.iter().map(|viewpoint| &viewpoint.anchor));
        let phrases = || std::iter::once(&self.target).chain(others.clone());
        phrases().find_map(Phrase::doubt).or_else(|| {
            let mut excused = self.words_about_asker();
            phrases().for_each(|phrase| phrase.collect_descriptive_words(&mut excused));
            let words: Vec<String> = self
                .not_understood
                .iter()
                .filter(|word| !excused.contains(word))
                .cloned()
                .collect();
            (!words.is_empty()).then_some(Doubt::Words(words))
        })
    }

    /// Returns those of the words not understood that become clear when the request gives the
    /// position of "me".
    #[must_use]
    pub fn words_about_asker(&self) -> Vec<String> {
        let by_me = |relation: &&Relation| relation.anchors.iter().any(|anchor| anchor.head == ME);
        let relations =
            self.target.relations.iter().filter(by_me).map(|relation| relation.text.clone());
        relations.chain([ME.to_owned()]).collect()
    }
}

impl Phrase {
    fn doubt(&self) -> Option<Doubt> {
        self.name_doubt().or_else(|| {
            // For a carried object, "on it" means on its carrier.
            let carried = self
                .with
                .iter()
                .find_map(|with| with.phrase.name_doubt().or_else(|| with.phrase.anchors_doubt()));
            let unanchored = |relation: &&Relation| {
                relation.anchors.is_empty() && !relation.kind.is_of_the_room()
            };
            let lost = self
                .relations
                .iter()
                .find(unanchored)
                .map(|relation| Doubt::Unanchored(relation.text.clone()));
            lost.or(carried).or_else(|| self.anchors_doubt())
        })
    }

    /// Collects words in front of known nouns, such as "leather" and "shabby". They describe, and
    /// cannot be checked by reading alone.
    fn collect_descriptive_words(&self, words: &mut Vec<String>) {
        if matches!(self.meaning(), Meaning::Nouns(_) | Meaning::Structure(_)) {
            words.extend(self.unchecked.iter().cloned());
        }
        let carried = self.with.iter().map(|with| &with.phrase);
        let phrases = self.relations.iter().flat_map(|relation| &relation.anchors).chain(carried);
        phrases.for_each(|phrase| phrase.collect_descriptive_words(words));
    }

    fn anchors_doubt(&self) -> Option<Doubt> {
        self.relations.iter().flat_map(|relation| &relation.anchors).find_map(Self::doubt)
    }

    /// Returns the doubt about the noun or the purpose that names the object.
    fn name_doubt(&self) -> Option<Doubt> {
        if !affordances::unmatched_words(&self.uses, &self.purpose).is_empty() {
            return Some(Doubt::Purpose(self.purpose.join(" ")));
        }
        // "one" and "thing" were chosen by the speaker; a phrase without any word lost its noun.
        (self.head.is_empty() && self.uses.is_empty()).then_some(Doubt::Unnamed)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{RelationKind, parse};

    #[test]
    fn fully_read_questions_have_no_doubt() {
        for query in [
            "the red mug on the coffee table",
            "facing the window, the second chair from the left",
            "something to sit on",
            "the table with the book on it",
            "the crumpled leather armchair",
            "the one by the door",
            "the thing between the sofa and the window",
            "how many chairs are there",
        ] {
            assert_eq!(parse(query).doubt(), None, "{query}: {:?}", parse(query));
        }
    }

    #[test]
    fn doubt_names_the_unread_part() {
        let words =
            |words: &[&str]| Doubt::Words(words.iter().map(|word| (*word).to_owned()).collect());
        for (query, expected) in [
            ("der Becher auf dem Couchtisch", Doubt::Foreign),
            ("the theremin", words(&["theremin"])),
            ("the chair beside the theremin", words(&["theremin"])),
            ("the crumpled theremin", words(&["theremin", "crumpled"])),
            ("the crumpled thing by the door", words(&["crumpled"])),
            ("something to frobnicate with", words(&["frobnicate"])),
            ("something to sit on for walruses", Doubt::Purpose("sit walruses".into())),
            ("the red", Doubt::Unnamed),
        ] {
            assert_eq!(parse(query).doubt(), Some(expected), "{query}: {:?}", parse(query));
        }
    }

    #[test]
    fn relation_without_an_anchor_is_in_doubt() {
        let mut query = parse("the lamp next to the sofa");
        query.target.relations[0].anchors.clear();
        assert_eq!(query.doubt(), Some(Doubt::Unanchored("next to".into())));
        // "in the corner" needs no room.
        query.target.relations[0].kind = RelationKind::InCorner;
        assert_eq!(query.doubt(), None);
        let mut query = parse("the lamp next to the sofa");
        query.target.relations[0].anchors[0].head.clear();
        assert_eq!(query.doubt(), Some(Doubt::Unnamed));
    }

    /// No parser can know the observer's position.
    #[test]
    fn missing_observer_position_is_not_a_doubt() {
        for query in ["the chair closest to me", "the nearest chair"] {
            let read = parse(query);
            assert!(!read.not_understood.is_empty() && read.doubt().is_none(), "{read:?}");
        }
    }
}
