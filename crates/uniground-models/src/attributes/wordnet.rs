//! Kinds of things and English words, from `WordNet`'s noun graph: what is a kind of what, how
//! usual it is, and which words are no misspellings.
//!
//! `wordnet.tsv` is made by `scripts/wordnet.py`; `wordnet-license.txt` is its licence.

use super::lexicon::singulars;
use std::collections::HashMap;
use std::sync::LazyLock;

/// How two words for things are related.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Kinship {
    /// Two words for one thing: "trash can", "dustbin".
    Same,
    /// The first is a kind of the second, so many steps up.
    Narrower(u32),
    /// The second is a kind of the first, so many steps up.
    Broader(u32),
}

/// A kind of things.
struct Kind {
    parent: Option<u32>,
    /// How often tagged texts speak of it.
    spoken_of: u32,
    /// How many kinds it has, itself included.
    size: u32,
}

/// The graph.
pub struct WordNet {
    kinds: Vec<Kind>,
    /// The kinds a word may name, the most usual first.
    of_word: HashMap<&'static str, Vec<u32>>,
    /// Sorted.
    english: Vec<&'static str>,
}

/// A kind with this many kinds below it says nothing of a thing: "furniture" does,
/// "instrumentality" does not.
const TOO_GENERAL: u32 = 400;
/// Further up, a word is seldom used for the thing.
const MOST_STEPS: u32 = 3;
/// What a kind counts that texts never speak of, against those they often do.
const EXOTIC: f32 = 0.9;

impl WordNet {
    /// The one graph of the process.
    #[must_use]
    pub fn get() -> &'static Self {
        static WORDNET: LazyLock<WordNet> =
            LazyLock::new(|| WordNet::read(include_str!("wordnet.tsv")));
        &WORDNET
    }

    /// How `a` is related to `b`, by the nearest of their meanings; `None` if neither is a kind of
    /// the other. Plurals are understood, and what describes a thing is passed over: a "folding
    /// step stool" is a step stool.
    #[must_use]
    pub fn kinship(&self, a: &str, b: &str) -> Option<Kinship> {
        self.kinship_of(self.kinds_of(a), self.kinds_of(b))
    }

    /// The same for the kinds that two words name.
    #[must_use]
    pub fn kinship_of(&self, a: &[u32], b: &[u32]) -> Option<Kinship> {
        let pairs = || a.iter().flat_map(|&a| b.iter().map(move |&b| (a, b)));
        if pairs().any(|(a, b)| a == b) {
            return Some(Kinship::Same);
        }
        let narrower = pairs().filter_map(|(a, b)| self.steps(a, b)).min().map(Kinship::Narrower);
        narrower
            .or_else(|| pairs().filter_map(|(a, b)| self.steps(b, a)).min().map(Kinship::Broader))
    }

    /// Whether what a word most usually means is a kind of another, any number of steps up.
    #[must_use]
    pub fn is_a(&self, word: &str, above: &str) -> bool {
        let above = self.kinds_of(above);
        let mut up = std::iter::successors(self.kinds_of(word).first().copied(), |&kind| {
            self.kinds[kind as usize].parent
        });
        up.any(|kind| above.contains(&kind))
    }

    /// How usual the kind is that a name most usually means, from [`EXOTIC`] to 1: people seldom
    /// say "seat" and mean a pew.
    #[must_use]
    pub fn commonness(&self, name: &str) -> f32 {
        let spoken_of =
            self.kinds_of(name).first().map_or(0, |&kind| self.kinds[kind as usize].spoken_of);
        1.0 - (1.0 - EXOTIC) / (1.0 + spoken_of as f32)
    }

    /// Whether a name is known as a whole.
    #[must_use]
    pub fn names(&self, name: &str) -> bool {
        singulars(name).iter().any(|word| self.of_word.contains_key(word.as_str()))
    }

    /// Whether a word is English in some form, so that it is hardly another one misspelt. Short
    /// words are not known.
    #[must_use]
    pub fn is_english(&self, word: &str) -> bool {
        let known = |stem: &str| self.english.binary_search(&stem).is_ok();
        let forms = |suffix: &str, endings: &[&str]| {
            word.strip_suffix(suffix).is_some_and(|stem| {
                endings.iter().any(|ending| known(&format!("{stem}{ending}")))
                    || known(undoubled(stem))
            })
        };
        known(word)
            || forms("s", &[""])
            || forms("es", &[""])
            || forms("ies", &["y"])
            || forms("ed", &["", "e"])
            || forms("ing", &["", "e"])
            || forms("er", &["", "e"])
            || forms("est", &["", "e"])
            || forms("ier", &["y"])
            || forms("iest", &["y"])
    }

    /// The kinds a word names; of a longer name, those of its last words that are known.
    #[must_use]
    pub fn kinds_of(&self, name: &str) -> &[u32] {
        let words: Vec<&str> = name.split_whitespace().collect();
        (0..words.len())
            .find_map(|start| {
                singulars(&words[start..].join(" "))
                    .iter()
                    .find_map(|word| self.of_word.get(word.as_str()))
            })
            .map_or(&[], Vec::as_slice)
    }

    /// How many steps `above` is up from `kind`; `None` if it is not, too far or too general.
    fn steps(&self, kind: u32, above: u32) -> Option<u32> {
        if self.kinds[above as usize].size > TOO_GENERAL {
            return None;
        }
        let mut at = kind;
        (1..=MOST_STEPS).find(|_| {
            self.kinds[at as usize].parent.is_some_and(|parent| {
                at = parent;
                at == above
            })
        })
    }

    fn read(text: &'static str) -> Self {
        let (kinds, english) = text.split_once("\n\n").unwrap_or((text, ""));
        let mut of_word: HashMap<&'static str, Vec<u32>> = HashMap::new();
        let mut read: Vec<Kind> = Vec::new();
        for (line, i) in kinds.lines().zip(0_u32..) {
            let mut columns = line.split('\t');
            let mut column = || columns.next().unwrap_or_default();
            let (parent, spoken_of, words) = (column(), column(), column());
            read.push(Kind {
                parent: parent.parse().ok().filter(|p| *p < i),
                spoken_of: spoken_of.parse().unwrap_or(0),
                size: 1,
            });
            for word in words.split(',').filter(|word| !word.is_empty()) {
                let (word, usual) =
                    word.strip_prefix('~').map_or((word, true), |word| (word, false));
                let meanings = of_word.entry(word).or_default();
                if usual { meanings.insert(0, i) } else { meanings.push(i) }
            }
        }
        // Parents come before their children.
        for i in (0..read.len()).rev() {
            if let Some(parent) = read[i].parent {
                read[parent as usize].size += read[i].size;
            }
        }
        Self { kinds: read, of_word, english: english.split_whitespace().collect() }
    }
}

/// "sitt" of "sitting" is "sit".
fn undoubled(stem: &str) -> &str {
    let mut from_the_end = stem.chars().rev();
    match (from_the_end.next(), from_the_end.next()) {
        (Some(last), Some(before)) if last == before => &stem[..stem.len() - last.len_utf8()],
        _ => stem,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn words_for_one_thing_and_kinds_of_it_are_known() {
        let of = |a, b| WordNet::get().kinship(a, b);
        assert_eq!(of("trash cans", "dustbin"), Some(Kinship::Same));
        assert_eq!(of("crate", "box"), Some(Kinship::Narrower(1)));
        assert!(matches!(of("musical instrument", "electric guitar"), Some(Kinship::Broader(_))));
        assert!(
            matches!(of("instrument", "acoustic guitar"), Some(Kinship::Broader(_))),
            "{:?}",
            of("instrument", "guitar")
        );
        for (a, b) in [
            ("fridge", "washing machine"),
            ("sofa", "table"),
            ("thing", "chair"),
            ("artifact", "lamp"),
            ("xyzzy", "lamp"),
        ] {
            assert_eq!(of(a, b), None, "{a} {b}");
        }
    }

    #[test]
    fn what_people_speak_of_is_more_common() {
        let common = |name| WordNet::get().commonness(name);
        assert!(
            common("chair") > common("pew") && common("pew") > common("bergere"),
            "{} {}",
            common("chair"),
            common("pew")
        );
        assert_eq!((common("bergere"), common("xyzzy")), (EXOTIC, EXOTIC));
        assert!(common("doors") > 0.99);
    }

    #[test]
    fn english_is_told_from_slips() {
        for word in [
            "tones",
            "bedside",
            "lounge",
            "squiggles",
            "sitting",
            "brewing",
            "carved",
            "stripier",
            "wakes",
        ] {
            assert!(WordNet::get().is_english(word), "{word}");
        }
        for word in
            ["\u{1128a}\u{1128a}ing", "somethng", "refrigeratr", "bookcse", "tabel", "wardorbe"]
        {
            assert!(!WordNet::get().is_english(word), "{word}");
        }
    }
}
