//! Questions in plain words to a [`ParsedQuery`]: target, attributes, anchors, relations (METHOD section 3).
//!
//! Built in: a tokeniser that knows the lexicon and a grammar of noun phrases joined by relation words. English only.

mod grammar;
mod words;

use crate::geometry::colour::ColourName;
use crate::models::attributes::{Lexicon, Noun};
use crate::scene::Structure;
pub use grammar::parse;

/// A query, understood as far as the words go. Every word is used, is filler, or is listed in `not_understood`.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct ParsedQuery {
    pub target: Phrase,
    pub relations: Vec<Relation>,
    /// "the largest", "the second from the left".
    pub superlative: Option<Superlative>,
    /// "facing the window": left and right are those of somebody who looks at it.
    pub viewpoint: Option<Phrase>,
    pub not_understood: Vec<String>,
}

/// A noun phrase.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Phrase {
    /// The noun as the query says it; empty when the phrase has none ("the red one").
    pub head: String,
    pub colours: Vec<ColourName>,
    /// Colours it must not have: "not red".
    pub other_than: Vec<ColourName>,
    pub sizes: Vec<SizeWord>,
    /// Words in front of the noun that nothing here can check: "leather", "patterned".
    pub unchecked: Vec<String>,
    /// What the phrase's own object has: "the table with the book on it".
    pub with: Vec<With>,
}

/// Something an object carries or lacks.
#[derive(Debug, Clone, PartialEq)]
pub struct With {
    pub phrase: Phrase,
    pub absent: bool,
}

/// What a phrase's head may stand for.
#[derive(Debug, Clone, PartialEq)]
pub enum Meaning {
    /// "thing", "one", or no noun at all.
    Anything,
    Structure(Structure),
    /// Nouns of the lexicon, the direct one first.
    Nouns(Vec<&'static Noun>),
    /// A word the lexicon does not have.
    Unknown,
}

impl Phrase {
    #[must_use]
    pub fn meaning(&self) -> Meaning {
        match self.head.as_str() {
            head if words::is_anything(head) => Meaning::Anything,
            "wall" | "walls" => Meaning::Structure(Structure::Wall),
            "floor" | "ground" => Meaning::Structure(Structure::Floor),
            "ceiling" => Meaning::Structure(Structure::Ceiling),
            head => match Lexicon::get().find_all(head) {
                nouns if nouns.is_empty() => Meaning::Unknown,
                nouns => Meaning::Nouns(nouns),
            },
        }
    }

    /// The phrase in words: "small red chair".
    #[must_use]
    pub fn text(&self) -> String {
        let sizes = self.sizes.iter().map(|s| s.word());
        let colours = self.other_than.iter().flat_map(|c| ["not", c.word()]).chain(self.colours.iter().map(|c| c.word()));
        let head = if self.head.is_empty() { "thing" } else { &self.head };
        sizes
            .chain(colours)
            .chain(self.unchecked.iter().map(String::as_str))
            .chain([head])
            .collect::<Vec<_>>()
            .join(" ")
    }

    fn is_empty(&self) -> bool {
        *self == Self::default()
    }
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum SizeWord {
    Large,
    Small,
    Tall,
    Low,
    Long,
}

impl SizeWord {
    #[must_use]
    pub fn word(self) -> &'static str {
        match self {
            Self::Large => "large",
            Self::Small => "small",
            Self::Tall => "tall",
            Self::Low => "low",
            Self::Long => "long",
        }
    }
}

/// A relation of the target to one or more anchors.
#[derive(Debug, Clone, PartialEq)]
pub struct Relation {
    pub kind: RelationKind,
    /// As the query says it.
    pub text: String,
    pub anchors: Vec<Phrase>,
    /// "not the one by the door".
    pub negated: bool,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum RelationKind {
    Near,
    Far,
    Closest,
    Farthest,
    LeftOf,
    RightOf,
    InFrontOf,
    Behind,
    Above,
    Below,
    On,
    Inside,
    Between,
    AgainstWall,
    InCorner,
}

/// The extreme of a kind: `rank` 1 is the extreme itself, 2 the second from it.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Superlative {
    pub measure: Measure,
    pub rank: u32,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Measure {
    Largest,
    Smallest,
    Tallest,
    Shortest,
    Highest,
    Lowest,
    Leftmost,
    Rightmost,
    Frontmost,
    Backmost,
}
