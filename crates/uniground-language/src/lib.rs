//! Parses questions in plain words into a [`ParsedQuery`]: target, attributes, anchors, relations
//! (docs/METHOD.md, section 3).
//!
//! Built in: a tokenizer that knows the lexicon, and a grammar of noun phrases joined by relation
//! words. English only. A chat model may parse instead ([`VlmParser`], or [`AutoParser`] where the
//! grammar is in [`Doubt`]): one call, validated, with the grammar as fallback.

#![warn(missing_docs)]

mod affordances;
mod beginnings;
mod clauses;
mod corrections;
mod cost;
mod distances;
mod doubt;
mod follow_up;
mod forms;
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

pub use distances::{LengthUnit, Reach};
pub use doubt::Doubt;
pub use follow_up::{Earlier, plural_of, resolve as resolve_follow_up};
pub use forms::{
    Aspect, Bound, Claim, ComparedBy, Comparison, Dimension, Form, Limit, Passage, Reference, Way,
};
pub use grammar::parse;
pub use parsers::{AutoParser, BuiltinParser, FellBack, QueryParser, Reading, VlmParser};
pub use relation_kinds::RelationKind;
use uniground_geometry::color::ColorName;
use uniground_geometry::scene::{InstanceId, Structure};
use uniground_models::attributes::{Lexicon, Noun};

/// A parsed query. Every word is used, is filler, or is listed in `not_understood` or
/// `passed_over`.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct ParsedQuery {
    /// The requested object.
    pub target: Phrase,
    /// The target under a second reading, where the words allow one: in "the cup on the table by
    /// the door" either may be by the door.
    pub other_reading: Option<Phrase>,
    /// The viewer whose left, right, front and back the question uses; `None` when the words give
    /// no viewer.
    pub viewpoint: Option<Viewpoint>,
    /// The viewer's position, if the words give it: "standing at the door", "from the sofa".
    /// "Nearest" means nearest to it.
    pub standpoint: Option<Phrase>,
    /// Whether the question asks for one object, or for several.
    pub quantity: Quantity,
    /// Whether most words are of another language than English. The other fields mean little then.
    pub foreign: bool,
    /// Words that could not be used or checked, and nouns that the lexicon does not have.
    pub not_understood: Vec<String>,
    /// Words before the target's name that give an action or a reason. They do not describe the
    /// target, and do not lower the confidence.
    pub passed_over: Vec<String>,
    /// Readings with a target that the words name later ("pop two slices in the toaster"), in
    /// order. A scene without the first target may have one of these
    /// (`uniground_grounding::choose_reading`). They have no later readings themselves.
    pub later: Vec<ParsedQuery>,
    /// What the question wants to know of the target.
    pub form: Form,
    /// Objects that a list must not have: "everything on the desk except the laptop".
    pub except: Vec<Phrase>,
    /// The unit that the answer has to use: "how wide is the door in inches".
    pub unit: Option<LengthUnit>,
}

impl ParsedQuery {
    /// Returns the phrases of all objects that the question names: its target, the viewer's, and
    /// those of its form. Their anchors are within them.
    #[must_use]
    pub fn phrases(&self) -> Vec<&Phrase> {
        let mut phrases = vec![&self.target];
        phrases.extend(&self.other_reading);
        phrases.extend(self.viewpoint.as_ref().map(|viewpoint| &viewpoint.anchor));
        phrases.extend(&self.standpoint);
        phrases.extend(self.form.phrases());
        phrases.extend(&self.except);
        phrases
    }
}

/// Head of an anchor that is the observer: "closest to me".
pub const ME: &str = "me";

/// How many objects a question asks for.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub enum Quantity {
    /// "the chair"
    #[default]
    One,
    /// "both chairs", "the three chairs": this many.
    Exactly(u32),
    /// "the chairs", "all the chairs", "how many chairs": all of them.
    All,
}

/// How a viewer looks at the room.
#[derive(Debug, Clone, PartialEq)]
pub struct Viewpoint {
    /// Whether the viewer looks towards the anchor or away from it.
    pub look: Look,
    /// The object that the viewer looks at, looks from, or has behind.
    pub anchor: Phrase,
}

/// The direction in which a viewer looks, relative to an object in the room (the anchor).
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
    /// All three values, to find one by its [`as_str`](Self::as_str).
    pub const ALL: [Self; 3] = [Self::Facing, Self::From, Self::BackTo];

    /// Returns its name in data.
    #[must_use]
    pub fn as_str(self) -> &'static str {
        match self {
            Self::Facing => "facing",
            Self::From => "from",
            Self::BackTo => "back_to",
        }
    }

    /// Returns the words to put between "somebody" and "the window".
    #[must_use]
    pub fn phrase(self) -> &'static str {
        match self {
            Self::Facing => "facing",
            Self::From => "looking from",
            Self::BackTo => "with the back to",
        }
    }
}

/// A noun phrase with all attributes and relations of the object it names.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Phrase {
    /// The noun in the words of the query; empty when the phrase has none ("the red one").
    pub head: String,
    /// Its purpose: "something to sit on". Uses of the lexicon.
    pub uses: Vec<String>,
    /// Other nouns it may have, the likeliest first: from a parser with world knowledge; for an
    /// unknown noun, its container.
    pub could_be: Vec<String>,
    /// Nouns it must not be: "the table that is not the dining table".
    pub other_things: Vec<String>,
    /// The words that gave the use: "wine" of "something to pour wine from".
    pub purpose: Vec<String>,
    /// Words that must not describe it, and that no geometry can check: "not wooden".
    pub excluded: Vec<String>,
    /// The instances it has to be one of: "which of the mugs #3, #4 and #5". Empty for any.
    pub among: Vec<InstanceId>,
    /// Colors it must have. If there are two, they share its surface: each has to be there.
    pub colors: Vec<ColorName>,
    /// Whether the colors are approximate ("pinkish"): a similar color fits too.
    pub roughly: bool,
    /// Colors it must not have: "not red".
    pub other_than: Vec<ColorName>,
    /// Traits: "large", "round".
    pub traits: Vec<Trait>,
    /// Words in front of the noun that cannot be checked: "leather", "patterned".
    pub unchecked: Vec<String>,
    /// Number of objects: "two monitors".
    pub count: Option<u32>,
    /// What the object carries or has: "the table with the book on it".
    pub with: Vec<With>,
    /// Relations, all of which must hold. Their anchors are phrases with relations of their own.
    pub relations: Vec<Relation>,
    /// Whether any such object is meant: "a stand". Set on anchors only.
    pub indefinite: bool,
    /// Rank among objects of the kind: "the largest", "the second from the left".
    pub superlative: Option<Superlative>,
}

/// An object that another object carries or lacks.
#[derive(Debug, Clone, PartialEq)]
pub struct With {
    /// The object that is carried or lacking.
    pub phrase: Phrase,
    /// Whether it must not be there: "without".
    pub absent: bool,
}

/// The meaning of a phrase's head.
#[derive(Debug, Clone, PartialEq)]
pub enum Meaning {
    /// "thing", "one", or no noun at all.
    Anything,
    /// The instance with this id: "#12".
    Instance(InstanceId),
    /// A part of the building: "wall", "floor", "ceiling".
    Structure(Structure),
    /// Nouns of the lexicon, the direct one first.
    Nouns(Vec<&'static Noun>),
    /// A word that the lexicon does not have.
    Unknown,
}

impl Phrase {
    /// Looks up the head: ids of instances and words for anything first, then parts of the building, then the lexicon.
    #[must_use]
    pub fn meaning(&self) -> Meaning {
        match self.head.as_str() {
            head if instance_in(head).is_some() => {
                instance_in(head).map_or(Meaning::Unknown, Meaning::Instance)
            }
            // A zone is an area, not an object.
            head if zones::nouns_of_zone(head).is_some() => Meaning::Unknown,
            head if words::is_anything(head) && !self.uses.is_empty() => {
                Meaning::Nouns(Lexicon::get().nouns_for_uses(&self.uses))
            }
            head if words::is_anything(head) => Meaning::Anything,
            head => match (structure_of(head), Lexicon::get().find_all(head)) {
                (Some(structure), _) => Meaning::Structure(structure),
                (None, nouns) if nouns.is_empty() => match Lexicon::get().related_nouns(head) {
                    akin if akin.is_empty() => Meaning::Unknown,
                    akin => Meaning::Nouns(akin),
                },
                (None, nouns) => Meaning::Nouns(nouns),
            },
        }
    }

    /// Returns the phrase with only what its noun means: without colors, relations and the like.
    #[must_use]
    pub fn noun_alone(&self) -> Self {
        Self {
            head: self.head.clone(),
            uses: self.uses.clone(),
            could_be: self.could_be.clone(),
            purpose: self.purpose.clone(),
            among: self.among.clone(),
            unchecked: self.unchecked.clone(),
            ..Self::default()
        }
    }

    /// Returns the phrase in words: "small red chair".
    #[must_use]
    pub fn text(&self) -> String {
        let head = match (&self.head, self.uses.is_empty()) {
            (head, true) if head.is_empty() => "thing".to_owned(),
            (head, true) => head.clone(),
            (_, false) => format!("something to {}", self.uses.join(" or ")),
        };
        let mut words: Vec<&str> = self.traits.iter().map(|s| s.as_str()).collect();
        words.extend(self.other_than.iter().flat_map(|c| ["not", c.as_str()]));
        words.extend(self.excluded.iter().flat_map(|word| ["not", word.as_str()]));
        words.extend(self.colors.iter().map(|c| c.as_str()));
        words.extend(self.unchecked.iter().map(String::as_str));
        words.push(&head);
        words.join(" ")
    }

    fn is_empty(&self) -> bool {
        *self == Self::default()
    }
}

/// Returns the instance that a word names by its id: "#12".
fn instance_in(word: &str) -> Option<InstanceId> {
    word.strip_prefix('#')?.parse().ok().map(InstanceId)
}

/// Returns the instances that a token names by their ids: "#3+#4+#5".
fn instances_in(word: &str) -> Option<Vec<InstanceId>> {
    word.contains('+').then(|| word.split('+').map(instance_in).collect()).flatten()
}

/// Returns the part of the building that a word names.
fn structure_of(word: &str) -> Option<Structure> {
    match word {
        "wall" | "walls" => Some(Structure::Wall),
        "floor" | "ground" => Some(Structure::Floor),
        "ceiling" => Some(Structure::Ceiling),
        _ => None,
    }
}

/// Attributes that follow from a comparison with others or from the shape of the box.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Trait {
    /// Large volume of the box, among objects of that noun.
    Large,
    /// Small volume of the box, among objects of that noun.
    Small,
    /// Large height of the box, among objects of that noun.
    Tall,
    /// Small height of the box, among objects of that noun; also said as "short".
    Low,
    /// Large longer side of the footprint, among objects of that noun.
    Long,
    /// High lightness (CIELAB) of the mean color, among objects of that noun.
    Light,
    /// Low lightness (CIELAB) of the mean color, among objects of that noun.
    Dark,
    /// About as deep as wide. A box cannot distinguish round from square.
    Round,
    /// About as deep as wide.
    Square,
    /// Clearly longer than deep.
    Rectangular,
}

impl Trait {
    /// All ten values, to find one by its [`as_str`](Self::as_str).
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

    /// Returns its name in data and in texts.
    #[must_use]
    pub fn as_str(self) -> &'static str {
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

/// A relation of an object to one or more anchors.
#[derive(Debug, Clone, PartialEq)]
pub struct Relation {
    /// The kind, which selects the geometry that is scored.
    pub kind: RelationKind,
    /// The words of the query.
    pub text: String,
    /// Empty for relations to the room. "between" has two, or one that means both. For other kinds
    /// the relation must hold for all of them.
    pub anchors: Vec<Phrase>,
    /// Whether it is negated: "not the one by the door".
    pub negated: bool,
    /// "the second closest" has 2. Only comparisons have more than 1.
    pub rank: u32,
}

/// A rank by some measure: `rank` 1 is the extreme itself, 2 the second from it.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Superlative {
    /// The measure by which objects are ranked.
    pub measure: Measure,
    /// Rank from 1; has no meaning for [`Measure::Middle`].
    pub rank: u32,
}

/// Measures by which objects of one noun are ranked. Sides and front follow the question's
/// directions.
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
    /// Highest center above the ground.
    Highest,
    /// Lowest center above the ground.
    Lowest,
    /// Center farthest to the left.
    Leftmost,
    /// Center farthest to the right.
    Rightmost,
    /// Center farthest to the front, towards the viewer.
    Frontmost,
    /// Center farthest to the back, away from the viewer.
    Backmost,
    /// In the middle of a row of them.
    Middle,
}

impl Measure {
    /// All eleven values, to find one by its [`as_str`](Self::as_str).
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

    /// Returns its name in data and in texts.
    #[must_use]
    pub fn as_str(self) -> &'static str {
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
