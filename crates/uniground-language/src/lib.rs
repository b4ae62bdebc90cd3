//! Questions in plain words to a [`ParsedQuery`]: target, attributes, anchors, relations
//! (docs/METHOD.md, section 3).
//!
//! Built in: a tokeniser that knows the lexicon and a grammar of noun phrases joined by relation
//! words. English only. A chat model may read instead ([`VlmParser`], or [`AutoParser`] where the
//! grammar is in [`Doubt`]): one call, checked, with the grammar to fall back on.

#![warn(missing_docs)]

mod affordances;
mod beginnings;
mod clauses;
mod corrections;
mod cost;
mod doubt;
mod grammar;
mod languages;
mod observers;
mod parsers;
mod pieces;
mod relation_kinds;
mod rewrites;
mod sides;
mod situations;
mod tokens;
mod vlm;
mod words;
pub mod zones;

pub use doubt::Doubt;
pub use grammar::parse;
pub use parsers::{AutoParser, BuiltinParser, FellBack, QueryParser, Reading, VlmParser};
pub use relation_kinds::RelationKind;
use uniground_geometry::colour::ColourName;
use uniground_geometry::scene::Structure;
use uniground_models::attributes::{Lexicon, Noun};

/// A query, understood as far as the words go. Every word is used, is filler, or is listed in
/// `not_understood` or `passed_over`.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct ParsedQuery {
    /// What is asked for.
    pub target: Phrase,
    /// The target once more, where the words allow another reading: in "the cup on the table by
    /// the door" either may be by the door.
    pub other_reading: Option<Phrase>,
    /// Somebody whose left, right, front and back are meant; `None` when the words tell of nobody.
    pub viewpoint: Option<Viewpoint>,
    /// Where that somebody stands, if the words tell: "standing at the door", "from the sofa".
    /// What is "nearest" is nearest to it.
    pub standpoint: Option<Phrase>,
    /// Whether one thing is asked for, or several.
    pub quantity: Quantity,
    /// Most words are of another language than English: what else is here means little.
    pub foreign: bool,
    /// Words that could not be used or checked, and nouns the lexicon does not know.
    pub not_understood: Vec<String>,
    /// Words that tell what somebody does or why, before the thing is named: they tell nothing of
    /// it, and do not make its reading less sure.
    pub passed_over: Vec<String>,
    /// What is asked for if the words name it later ("pop two slices in the toaster"), in order: a
    /// scene without what comes first may have one of these ([`settled`](super::settled)).
    /// They have no later readings themselves.
    pub later: Vec<ParsedQuery>,
}

/// Head of an anchor that is the one who asks: "closest to me".
pub const ME: &str = "me";

/// How many things a question asks for.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub enum Quantity {
    /// "the chair"
    #[default]
    One,
    /// "both chairs", "the three chairs": so many.
    Exactly(u32),
    /// "the chairs", "all the chairs", "how many chairs": all there are.
    All,
}

/// How somebody looks at the room.
#[derive(Debug, Clone, PartialEq)]
pub struct Viewpoint {
    /// Whether they look towards the anchor or away from it.
    pub look: Look,
    /// The thing they look at, look from, or have at their back.
    pub anchor: Phrase,
}

/// Which way somebody looks, told by a thing in the room (the anchor).
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
    /// All three, to find one by its [`word`](Self::word).
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

    /// Words to stand between "somebody" and "the window".
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
    /// Nouns it may be called by as well, the likeliest first: a reader that knows the world says
    /// them; of a noun nobody listed, what holds it.
    pub could_be: Vec<String>,
    /// Nouns it must not be: "the table that is not the dining table".
    pub other_things: Vec<String>,
    /// The words the use was said in: "wine" of "something to pour wine from".
    pub purpose: Vec<String>,
    /// Colours it must have. Two share its surface: each has to be there.
    pub colours: Vec<ColourName>,
    /// The colours are only likened ("pinkish"): one near them may be meant.
    pub roughly: bool,
    /// Colours it must not have: "not red".
    pub other_than: Vec<ColourName>,
    /// "large", "round".
    pub traits: Vec<Trait>,
    /// Words in front of the noun that nothing here can check: "leather", "patterned".
    pub unchecked: Vec<String>,
    /// "two monitors": how many of them there are.
    pub count: Option<u32>,
    /// What the phrase's own object has: "the table with the book on it".
    pub with: Vec<With>,
    /// All of them must hold. Their anchors are phrases with relations of their own.
    pub relations: Vec<Relation>,
    /// "a stand": any such thing, said of anchors only.
    pub indefinite: bool,
    /// "the largest", "the second from the left".
    pub superlative: Option<Superlative>,
}

/// Something an object carries or lacks.
#[derive(Debug, Clone, PartialEq)]
pub struct With {
    /// The thing carried or lacking.
    pub phrase: Phrase,
    /// "without": it must not be there.
    pub absent: bool,
}

/// What a phrase's head may stand for.
#[derive(Debug, Clone, PartialEq)]
pub enum Meaning {
    /// "thing", "one", or no noun at all.
    Anything,
    /// A part of the building: "wall", "floor", "ceiling".
    Structure(Structure),
    /// Nouns of the lexicon, the direct one first.
    Nouns(Vec<&'static Noun>),
    /// A word the lexicon does not have.
    Unknown,
}

impl Phrase {
    /// Looks the head up: words for anything first, then parts of the building, then the lexicon.
    #[must_use]
    pub fn meaning(&self) -> Meaning {
        match self.head.as_str() {
            // Not a thing but where things are.
            head if zones::made_of(head).is_some() => Meaning::Unknown,
            head if words::is_anything(head) && !self.uses.is_empty() => {
                Meaning::Nouns(Lexicon::get().of_uses(&self.uses))
            }
            head if words::is_anything(head) => Meaning::Anything,
            head => match (structure_of(head), Lexicon::get().find_all(head)) {
                (Some(structure), _) => Meaning::Structure(structure),
                (None, nouns) if nouns.is_empty() => match Lexicon::get().akin(head) {
                    akin if akin.is_empty() => Meaning::Unknown,
                    akin => Meaning::Nouns(akin),
                },
                (None, nouns) => Meaning::Nouns(nouns),
            },
        }
    }

    /// The phrase in words: "small red chair".
    #[must_use]
    pub fn text(&self) -> String {
        let traits = self.traits.iter().map(|s| s.word());
        let colours = self
            .other_than
            .iter()
            .flat_map(|c| ["not", c.word()])
            .chain(self.colours.iter().map(|c| c.word()));
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

/// Attributes that a comparison with others or the shape of the box shows.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Trait {
    /// Large volume of the box, among things of that noun.
    Large,
    /// Small volume of the box, among things of that noun.
    Small,
    /// Large height of the box, among things of that noun.
    Tall,
    /// Small height of the box, among things of that noun; also said as "short".
    Low,
    /// Large longer side of the footprint, among things of that noun.
    Long,
    /// High lightness (CIELAB) of the mean colour, among things of that noun.
    Light,
    /// Low lightness (CIELAB) of the mean colour, among things of that noun.
    Dark,
    /// About as deep as wide; a box can not tell round from square.
    Round,
    /// About as deep as wide.
    Square,
    /// Clearly longer than deep.
    Rectangular,
}

impl Trait {
    /// All ten, to find one by its [`word`](Self::word).
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

    /// Its name in data and in texts.
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
    /// Which geometry is scored.
    pub kind: RelationKind,
    /// As the query says it.
    pub text: String,
    /// Empty for relations to the room. "between" has two, or one that means both; of other kinds
    /// all must hold.
    pub anchors: Vec<Phrase>,
    /// "not the one by the door".
    pub negated: bool,
    /// "the second closest": 2. Only comparisons have more than 1.
    pub rank: u32,
}

/// The extreme of a kind: `rank` 1 is the extreme itself, 2 the second from it.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Superlative {
    /// What things are ranked by.
    pub measure: Measure,
    /// From 1; has no meaning for [`Measure::Middle`].
    pub rank: u32,
}

/// What things of one noun are ranked by. Sides and front are those of the question's directions.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Measure {
    /// Largest volume of the box.
    Largest,
    /// Smallest volume of the box.
    Smallest,
    /// Largest height of the box.
    Tallest,
    /// Smallest height of the box.
    Shortest,
    /// Highest centre above the ground.
    Highest,
    /// Lowest centre above the ground.
    Lowest,
    /// Centre farthest to the left.
    Leftmost,
    /// Centre farthest to the right.
    Rightmost,
    /// Centre farthest to the front, towards the viewer.
    Frontmost,
    /// Centre farthest to the back, away from the viewer.
    Backmost,
    /// In the middle of a row of them.
    Middle,
}

impl Measure {
    /// All eleven, to find one by its [`word`](Self::word).
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

    /// Its name in data and in texts.
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
