//! The words of the grammar, as tables.

use super::{Measure, RelationKind, SizeWord};
use crate::geometry::colour::ColourName;

/// What a word or a run of words contributes.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) enum Meaning {
    Relation(RelationKind),
    /// "with", "that has": what follows belongs to the object.
    With { absent: bool },
    /// "facing": what follows is looked at.
    Facing,
    Superlative(Measure),
    Ordinal(u32),
    Colour(ColourName),
    Size(SizeWord),
    Not,
    /// "and": another anchor of the same relation.
    And,
    /// Stands for the thing spoken of: "it", "one".
    Pronoun,
    /// "the", "a": a noun phrase begins.
    Determiner,
    /// Carries nothing.
    Filler,
}

use Meaning::{And, Colour, Determiner, Facing, Filler, Not, Ordinal, Pronoun, Relation, Size, With};
use RelationKind::{Above, AgainstWall, Behind, Below, Between, Closest, Far, Farthest, InCorner, InFrontOf, Inside, LeftOf, Near, On, RightOf};

/// Runs of words, tried longest first.
const PHRASES: &[(&str, Meaning)] = &[
    ("on the left side of", Relation(LeftOf)), ("to the left side of", Relation(LeftOf)), ("on the left hand side of", Relation(LeftOf)),
    ("to the left of", Relation(LeftOf)), ("on the left of", Relation(LeftOf)), ("left of", Relation(LeftOf)),
    ("on the right side of", Relation(RightOf)), ("to the right side of", Relation(RightOf)), ("on the right hand side of", Relation(RightOf)),
    ("to the right of", Relation(RightOf)), ("on the right of", Relation(RightOf)), ("right of", Relation(RightOf)),
    ("in front of", Relation(InFrontOf)), ("behind", Relation(Behind)), ("in back of", Relation(Behind)), ("at the back of", Relation(Behind)),
    ("right next to", Relation(Near)), ("right beside", Relation(Near)), ("next to", Relation(Near)), ("close to", Relation(Near)), ("near to", Relation(Near)),
    ("beside", Relation(Near)), ("near", Relation(Near)), ("adjacent to", Relation(Near)), ("by", Relation(Near)), ("alongside", Relation(Near)),
    ("at", Relation(Near)), ("around", Relation(Near)), ("at the end of", Relation(Near)), ("at the foot of", Relation(Near)),
    ("far from", Relation(Far)), ("far away from", Relation(Far)), ("away from", Relation(Far)),
    ("closest to", Relation(Closest)), ("nearest to", Relation(Closest)), ("nearest", Relation(Closest)), ("closest", Relation(Closest)),
    ("farthest from", Relation(Farthest)), ("furthest from", Relation(Farthest)), ("farthest away from", Relation(Farthest)),
    ("furthest away from", Relation(Farthest)), ("most distant from", Relation(Farthest)),
    ("above", Relation(Above)), ("over", Relation(Above)), ("higher than", Relation(Above)),
    ("below", Relation(Below)), ("under", Relation(Below)), ("underneath", Relation(Below)), ("beneath", Relation(Below)),
    ("on top of", Relation(On)), ("on", Relation(On)), ("standing on", Relation(On)), ("lying on", Relation(On)), ("sitting on", Relation(On)), ("upon", Relation(On)),
    ("hanging on", Relation(On)), ("mounted on", Relation(On)), ("stacked on", Relation(On)),
    ("inside of", Relation(Inside)), ("inside", Relation(Inside)), ("in", Relation(Inside)), ("within", Relation(Inside)),
    ("between", Relation(Between)), ("in between", Relation(Between)),
    ("against the wall", Relation(AgainstWall)), ("along the wall", Relation(AgainstWall)), ("leaning against the wall", Relation(AgainstWall)),
    ("in the corner of the room", Relation(InCorner)), ("in the corner", Relation(InCorner)), ("in a corner", Relation(InCorner)), ("in the room corner", Relation(InCorner)),
    ("with", With { absent: false }), ("that has", With { absent: false }), ("which has", With { absent: false }), ("having", With { absent: false }), ("it has", With { absent: false }),
    ("without", With { absent: true }), ("that has no", With { absent: true }),
    ("when facing", Facing), ("if you face", Facing), ("facing", Facing), ("when you look at", Facing), ("if you look at", Facing), ("looking at", Facing),
    ("when looking at", Facing), ("as you look at", Facing),
    ("from the left", Filler), ("from the right", Filler),
    ("largest", Meaning::Superlative(Measure::Largest)), ("biggest", Meaning::Superlative(Measure::Largest)), ("widest", Meaning::Superlative(Measure::Largest)),
    ("longest", Meaning::Superlative(Measure::Largest)), ("smallest", Meaning::Superlative(Measure::Smallest)), ("tiniest", Meaning::Superlative(Measure::Smallest)),
    ("tallest", Meaning::Superlative(Measure::Tallest)), ("shortest", Meaning::Superlative(Measure::Shortest)),
    ("highest", Meaning::Superlative(Measure::Highest)), ("topmost", Meaning::Superlative(Measure::Highest)), ("lowest", Meaning::Superlative(Measure::Lowest)),
    ("leftmost", Meaning::Superlative(Measure::Leftmost)), ("rightmost", Meaning::Superlative(Measure::Rightmost)),
    ("on the far left", Meaning::Superlative(Measure::Leftmost)), ("on the far right", Meaning::Superlative(Measure::Rightmost)),
    ("on the left", Meaning::Superlative(Measure::Leftmost)), ("on the right", Meaning::Superlative(Measure::Rightmost)),
    ("to the left", Meaning::Superlative(Measure::Leftmost)), ("to the right", Meaning::Superlative(Measure::Rightmost)),
    ("in front", Meaning::Superlative(Measure::Frontmost)), ("in the back", Meaning::Superlative(Measure::Backmost)), ("at the back", Meaning::Superlative(Measure::Backmost)),
    ("first", Ordinal(1)), ("second", Ordinal(2)), ("third", Ordinal(3)), ("fourth", Ordinal(4)), ("fifth", Ordinal(5)),
    ("black", Colour(ColourName::Black)), ("white", Colour(ColourName::White)), ("grey", Colour(ColourName::Grey)), ("gray", Colour(ColourName::Grey)),
    ("silver", Colour(ColourName::Grey)), ("red", Colour(ColourName::Red)), ("orange", Colour(ColourName::Orange)), ("yellow", Colour(ColourName::Yellow)),
    ("golden", Colour(ColourName::Yellow)), ("green", Colour(ColourName::Green)), ("blue", Colour(ColourName::Blue)), ("purple", Colour(ColourName::Purple)),
    ("violet", Colour(ColourName::Purple)), ("pink", Colour(ColourName::Pink)), ("brown", Colour(ColourName::Brown)), ("beige", Colour(ColourName::Beige)),
    ("tan", Colour(ColourName::Beige)), ("cream", Colour(ColourName::Beige)),
    ("big", Size(SizeWord::Large)), ("large", Size(SizeWord::Large)), ("huge", Size(SizeWord::Large)), ("wide", Size(SizeWord::Large)),
    ("small", Size(SizeWord::Small)), ("little", Size(SizeWord::Small)), ("tiny", Size(SizeWord::Small)), ("tall", Size(SizeWord::Tall)),
    ("high", Size(SizeWord::Tall)), ("short", Size(SizeWord::Low)), ("low", Size(SizeWord::Low)), ("long", Size(SizeWord::Long)),
    ("not", Not), ("isn't", Not), ("and", And),
    ("it", Pronoun), ("them", Pronoun),
    ("the", Determiner), ("a", Determiner), ("an", Determiner), ("my", Determiner), ("your", Determiner), ("our", Determiner),
    ("this is", Filler), ("there is", Filler), ("that is", Filler), ("which is", Filler), ("it is", Filler), ("it's", Filler), ("is", Filler), ("are", Filler), ("that", Filler),
    ("which", Filler), ("there", Filler), ("this", Filler), ("these", Filler), ("those", Filler), ("of", Filler), ("to", Filler), ("in the room", Filler), ("of the room", Filler),
    ("please", Filler), ("can you", Filler), ("could you", Filler), ("find", Filler), ("find me", Filler), ("show me", Filler), ("bring me", Filler), ("bring", Filler),
    ("give me", Filler), ("get me", Filler), ("get", Filler), ("fetch", Filler), ("pick up", Filler), ("grab", Filler), ("go to", Filler), ("where is", Filler), ("where are", Filler),
    ("where's", Filler), ("locate", Filler), ("point to", Filler), ("point at", Filler), ("i want", Filler), ("look for", Filler), ("take", Filler), ("move to", Filler),
    ("standing", Filler), ("sitting", Filler), ("lying", Filler), ("located", Filler), ("placed", Filler), ("hanging", Filler), ("mounted", Filler), ("stands", Filler),
    ("sits", Filler), ("lies", Filler), ("hangs", Filler), ("right", Filler), ("just", Filler), ("directly", Filler), ("very", Filler), ("me", Filler),
    ("two", Filler), ("three", Filler), ("four", Filler), ("some", Filler), ("other", Filler), ("same", Filler), ("when", Filler), ("if", Filler), ("you", Filler),
    ("light", Filler), ("dark", Filler), ("bright", Filler), ("light coloured", Filler), ("dark coloured", Filler), ("colored", Filler), ("coloured", Filler), ("i", Filler),
    ("has", With { absent: false }), ("have", With { absent: false }), ("from", Filler), ("hand", Filler), ("side", Filler), ("most", Filler), ("one of", Filler),
];

/// The longest run of words at the start of `words` that means something, and how many words it takes.
pub(super) fn longest(words: &[&str]) -> Option<(Meaning, usize)> {
    PHRASES
        .iter()
        .filter(|(phrase, _)| {
            let mut at = words.iter();
            phrase.split(' ').all(|w| at.next() == Some(&w))
        })
        .map(|&(phrase, meaning)| (meaning, phrase.split(' ').count()))
        .max_by_key(|(_, length)| *length)
}

/// Nouns that may stand for anything.
pub(super) fn is_anything(head: &str) -> bool {
    matches!(head, "" | "thing" | "object" | "item" | "one" | "something" | "anything" | "ones" | "things" | "objects" | "stuff")
}
