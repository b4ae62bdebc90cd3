//! Questions in plain words to a [`ParsedQuery`]: target, attributes, anchors, relations (METHOD section 3).
//!
//! Built in: a tokeniser that knows the lexicon and a grammar of noun phrases joined by relation words. English only. A chat model
//! may read instead ([`VlmParser`]): one call, checked, with the grammar to fall back on.

mod affordances;
mod grammar;
mod parsers;
mod pieces;
mod tokens;
mod vlm;
mod words;

use crate::geometry::colour::ColourName;
use crate::models::attributes::{Lexicon, Noun};
use crate::scene::Structure;
pub use grammar::parse;
pub use parsers::{BuiltinParser, QueryParser, Reading, VlmParser};

/// A query, understood as far as the words go. Every word is used, is filler, or is listed in `not_understood`.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct ParsedQuery {
    pub target: Phrase,
    /// The target once more, where the words allow another reading: in "the cup on the table by the door" either may be by the door.
    pub other_reading: Option<Phrase>,
    /// Left, right, front and back are those of somebody who looks like this.
    pub viewpoint: Option<Viewpoint>,
    /// Where that somebody stands, if the words tell: "standing at the door", "from the sofa". What is "nearest" is nearest to it.
    pub standpoint: Option<Phrase>,
    pub not_understood: Vec<String>,
}

/// How somebody looks at the room.
#[derive(Debug, Clone, PartialEq)]
pub struct Viewpoint {
    pub look: Look,
    pub anchor: Phrase,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Look {
    /// "facing the window"
    Facing,
    /// "from the door", "as you walk in"
    From,
    /// "with your back to the window"
    BackTo,
}

impl Look {
    pub const ALL: [Self; 3] = [Self::Facing, Self::From, Self::BackTo];

    /// Its name in data.
    #[must_use]
    pub fn word(self) -> &'static str {
        match self {
            Self::Facing => "facing",
            Self::From => "from",
            Self::BackTo => "back_to",
        }
    }

    /// Between "somebody" and "the window".
    #[must_use]
    pub fn phrase(self) -> &'static str {
        match self {
            Self::Facing => "facing",
            Self::From => "looking from",
            Self::BackTo => "with the back to",
        }
    }
}

/// A noun phrase, with all that is said of the thing it names.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Phrase {
    /// The noun as the query says it; empty when the phrase has none ("the red one").
    pub head: String,
    /// What it is for: "something to sit on". Words of the lexicon.
    pub uses: Vec<String>,
    /// Nouns it must not be: "the table that is not the dining table".
    pub other_things: Vec<String>,
    /// The words the use was said in: "wine" of "something to pour wine from".
    pub purpose: Vec<String>,
    pub colours: Vec<ColourName>,
    /// Colours it must not have: "not red".
    pub other_than: Vec<ColourName>,
    pub traits: Vec<Trait>,
    /// Words in front of the noun that nothing here can check: "leather", "patterned".
    pub unchecked: Vec<String>,
    /// "two monitors": how many of them there are.
    pub count: Option<u32>,
    /// What the phrase's own object has: "the table with the book on it".
    pub with: Vec<With>,
    pub relations: Vec<Relation>,
    /// "the largest", "the second from the left".
    pub superlative: Option<Superlative>,
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
            head if words::is_anything(head) && !self.uses.is_empty() => Meaning::Nouns(Lexicon::get().of_uses(&self.uses)),
            head if words::is_anything(head) => Meaning::Anything,
            head => match (structure_of(head), Lexicon::get().find_all(head)) {
                (Some(structure), _) => Meaning::Structure(structure),
                (None, nouns) if nouns.is_empty() => Meaning::Unknown,
                (None, nouns) => Meaning::Nouns(nouns),
            },
        }
    }

    /// The phrase in words: "small red chair".
    #[must_use]
    pub fn text(&self) -> String {
        let traits = self.traits.iter().map(|s| s.word());
        let colours = self.other_than.iter().flat_map(|c| ["not", c.word()]).chain(self.colours.iter().map(|c| c.word()));
        let head = match (&self.head, self.uses.is_empty()) {
            (head, true) if head.is_empty() => "thing".to_owned(),
            (head, true) => head.clone(),
            (_, false) => format!("something to {}", self.uses.join(" or ")),
        };
        traits
            .chain(colours)
            .chain(self.unchecked.iter().map(String::as_str))
            .chain([head.as_str()])
            .collect::<Vec<_>>()
            .join(" ")
    }

    fn is_empty(&self) -> bool {
        *self == Self::default()
    }
}

/// The part of the building a word names.
fn structure_of(word: &str) -> Option<Structure> {
    match word {
        "wall" | "walls" => Some(Structure::Wall),
        "floor" | "ground" => Some(Structure::Floor),
        "ceiling" => Some(Structure::Ceiling),
        _ => None,
    }
}

/// Attributes that are seen by comparison, or by the box.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Trait {
    Large,
    Small,
    Tall,
    Low,
    Long,
    Light,
    Dark,
    Round,
    Square,
    Rectangular,
}

impl Trait {
    pub const ALL: [Self; 10] = [
        Self::Large,
        Self::Small,
        Self::Tall,
        Self::Low,
        Self::Long,
        Self::Light,
        Self::Dark,
        Self::Round,
        Self::Square,
        Self::Rectangular,
    ];

    #[must_use]
    pub fn word(self) -> &'static str {
        match self {
            Self::Large => "large",
            Self::Small => "small",
            Self::Tall => "tall",
            Self::Low => "low",
            Self::Long => "long",
            Self::Light => "light",
            Self::Dark => "dark",
            Self::Round => "round",
            Self::Square => "square",
            Self::Rectangular => "rectangular",
        }
    }
}

/// A relation of a thing to one or more anchors.
#[derive(Debug, Clone, PartialEq)]
pub struct Relation {
    pub kind: RelationKind,
    /// As the query says it.
    pub text: String,
    pub anchors: Vec<Phrase>,
    /// "not the one by the door".
    pub negated: bool,
    /// "the second closest": 2. Only comparisons have more than 1.
    pub rank: u32,
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
    /// The other way round: the anchor rests on it.
    Carrying,
    Inside,
    Between,
    Around,
    Opposite,
    Facing,
    Leaning,
    AgainstWall,
    InCorner,
    InMiddle,
}

impl RelationKind {
    pub const ALL: [Self; 21] = [
        Self::Near,
        Self::Far,
        Self::Closest,
        Self::Farthest,
        Self::LeftOf,
        Self::RightOf,
        Self::InFrontOf,
        Self::Behind,
        Self::Above,
        Self::Below,
        Self::On,
        Self::Carrying,
        Self::Inside,
        Self::Between,
        Self::Around,
        Self::Opposite,
        Self::Facing,
        Self::Leaning,
        Self::AgainstWall,
        Self::InCorner,
        Self::InMiddle,
    ];

    /// Its name in data: `left_of`.
    #[must_use]
    pub fn word(self) -> &'static str {
        match self {
            Self::Near => "near",
            Self::Far => "far",
            Self::Closest => "closest",
            Self::Farthest => "farthest",
            Self::LeftOf => "left_of",
            Self::RightOf => "right_of",
            Self::InFrontOf => "in_front_of",
            Self::Behind => "behind",
            Self::Above => "above",
            Self::Below => "below",
            Self::On => "on",
            Self::Carrying => "carrying",
            Self::Inside => "inside",
            Self::Between => "between",
            Self::Around => "around",
            Self::Opposite => "opposite",
            Self::Facing => "facing",
            Self::Leaning => "leaning",
            Self::AgainstWall => "against_wall",
            Self::InCorner => "in_corner",
            Self::InMiddle => "in_middle",
        }
    }

    /// Whether rivals are compared: "closest".
    #[must_use]
    pub fn is_comparison(self) -> bool {
        matches!(self, Self::Closest | Self::Farthest)
    }

    /// Whether it speaks of the room and takes no anchor.
    #[must_use]
    pub fn is_of_the_room(self) -> bool {
        matches!(self, Self::AgainstWall | Self::InCorner | Self::InMiddle)
    }

    /// The relation the anchor stands in to the thing: "there is a lamp on it" says that it carries a lamp.
    #[must_use]
    pub fn inverse(self) -> Self {
        match self {
            Self::LeftOf => Self::RightOf,
            Self::RightOf => Self::LeftOf,
            Self::InFrontOf => Self::Behind,
            Self::Behind => Self::InFrontOf,
            Self::Above => Self::Below,
            Self::Below => Self::Above,
            Self::On | Self::Inside | Self::Leaning => Self::Carrying,
            Self::Carrying => Self::On,
            other => other,
        }
    }
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
    /// In the middle of a row of them.
    Middle,
}

impl Measure {
    pub const ALL: [Self; 11] = [
        Self::Largest,
        Self::Smallest,
        Self::Tallest,
        Self::Shortest,
        Self::Highest,
        Self::Lowest,
        Self::Leftmost,
        Self::Rightmost,
        Self::Frontmost,
        Self::Backmost,
        Self::Middle,
    ];

    #[must_use]
    pub fn word(self) -> &'static str {
        match self {
            Self::Largest => "largest",
            Self::Smallest => "smallest",
            Self::Tallest => "tallest",
            Self::Shortest => "shortest",
            Self::Highest => "highest",
            Self::Lowest => "lowest",
            Self::Leftmost => "leftmost",
            Self::Rightmost => "rightmost",
            Self::Frontmost => "frontmost",
            Self::Backmost => "backmost",
            Self::Middle => "middle",
        }
    }
}
