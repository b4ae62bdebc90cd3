//! Rewrites ends, corners and sides of objects and of the room to the few forms that the tables
//! have.

use super::tokens::BREAK;
use super::words::{self, Meaning};
use uniground_models::attributes::Lexicon;

/// Rewrites a query's words.
pub(super) fn rewrite(tokens: &mut Vec<String>) {
    rewrite_utmost(tokens);
    join_orientation(tokens);
    rewrite_corners(tokens);
    rewrite_room_sides(tokens);
    rewrite_ends(tokens);
    reduce_two_sides(tokens);
    rewrite_side_of_another(tokens);
}

/// Rewrites "on the window side of the bed" to next to the bed, closest to the window.
fn rewrite_side_of_another(tokens: &mut Vec<String>) {
    let word = |i: usize| tokens.get(i).map_or("", String::as_str);
    let told = |&i: &usize| {
        matches!(word(i), "on" | "at")
            && word(i + 1) == "the"
            && Lexicon::get().is_known(word(i + 2))
            && word(i + 3) == "side"
            && word(i + 4) == "of"
    };
    let Some(at) = (0..tokens.len()).find(told) else { return };
    let other = tokens[at + 2].clone();
    let is_end = |&i: &usize| {
        word(i) == BREAK
            || matches!(words::longest_match(&[word(i)]), Some((Meaning::Relation(_), _)))
            || word(i) == "there"
    };
    let end = (at + 5..tokens.len()).find(is_end).unwrap_or(tokens.len());
    tokens.splice(end..end, ["closest".to_owned(), "to".to_owned(), "the".to_owned(), other]);
    tokens.splice(at..at + 5, ["next".to_owned(), "to".to_owned()]);
}

/// Rewrites "the left - most table" to the leftmost. Points of the compass are unknown.
fn rewrite_utmost(tokens: &mut Vec<String>) {
    let mut i = 1;
    while i < tokens.len() {
        let whole = match (tokens[i - 1].as_str(), tokens[i].as_str()) {
            ("left" | "lefter", "most") => "leftmost",
            ("right", "most") => "rightmost",
            ("front", "most") => "frontmost",
            ("back" | "rear", "most") => "backmost",
            ("top" | "upper", "most") => "topmost",
            ("bottom" | "lower", "most") => "bottommost",
            _ => {
                i += 1;
                continue;
            }
        };
        tokens.splice(i - 1..=i, [whole.to_owned()]);
    }
}

/// Joins the orientation of an object to one word that cannot be checked: "it is facing left". A
/// box does not show it.
fn join_orientation(tokens: &mut Vec<String>) {
    const WAYS: [&str; 15] = [
        "left",
        "right",
        "up",
        "down",
        "forward",
        "forwards",
        "backward",
        "backwards",
        "inward",
        "inwards",
        "outward",
        "north",
        "south",
        "east",
        "west",
    ];
    let mut i = 0;
    while i < tokens.len() {
        let mut end = i + 1;
        while tokens
            .get(end)
            .is_some_and(|word| matches!(word.as_str(), "to" | "towards" | "the" | "directly"))
        {
            end += 1;
        }
        let turns = tokens[i] == "facing"
            && tokens.get(end).is_some_and(|word| WAYS.contains(&word.as_str()));
        // "facing the left wall" gives a viewer.
        let alone = tokens
            .get(end + 1)
            .is_none_or(|next| next == BREAK || matches!(next.as_str(), "and" | "side"));
        if turns && alone {
            let both = tokens.get(end + 1).is_some_and(|next| next == "and")
                && tokens.get(end + 2).is_some_and(|word| WAYS.contains(&word.as_str()));
            let end = end + 1 + if both { 2 } else { 0 };
            let said = tokens.drain(i..end).collect::<Vec<_>>().join(" ");
            tokens.insert(i, said);
        }
        i += 1;
    }
}

/// Returns the words for beside an object, or on it at that side, by the preposition.
fn at_a_side<'a>(preposition: &str, side: &'a str) -> Vec<&'a str> {
    match preposition {
        "on" | "at" | "in" => vec!["on", "the", side, "side", "of"],
        _ => vec!["to", "the", side, "of"],
    }
}

/// Rewrites "at the far left end of the counter" to on its left side.
fn rewrite_ends(tokens: &mut Vec<String>) {
    let mut i = 0;
    while i < tokens.len() {
        if matches!(tokens[i].as_str(), "end" | "edge" | "side" | "half" | "part")
            && tokens.get(i + 1).is_some_and(|next| next == "of")
            && let Some((start, Some(side))) = before(tokens, i)
        {
            let end = i + 2;
            let new = at_a_side(&tokens[start], side);
            i = start + new.len();
            tokens.splice(start..end, new.iter().map(|word| (*word).to_owned()));
        } else {
            i += 1;
        }
    }
}

/// Reduces two sides to left or right: "on the back right", "in the far bottom left".
fn reduce_two_sides(tokens: &mut Vec<String>) {
    let mut i = 2;
    while i < tokens.len() {
        let is_side = matches!(tokens[i].as_str(), "left" | "right");
        let goes_on =
            tokens.get(i + 1).is_some_and(|next| WHICH.contains(&next.as_str()) || next == "of");
        let a_noun = tokens.get(i + 1).is_some_and(|next| {
            Lexicon::get().is_known(next) || matches!(next.as_str(), "corner" | "wall" | "one")
        });
        if is_side
            && !goes_on
            && !a_noun
            && matches!(
                tokens[i - 1].as_str(),
                "back" | "front" | "top" | "bottom" | "upper" | "lower" | "rear"
            )
            && let Some((start, Some(side))) = before(tokens, i + 1)
        {
            tokens.splice(start..=i, ["on", "the", side].map(str::to_owned));
            i = start + 2;
        }
        i += 1;
    }
}

const PREPOSITIONS: [&str; 8] = ["in", "at", "by", "near", "on", "to", "from", "into"];
/// Words that distinguish corners or sides. Most need a plan of the room or a viewpoint and are
/// passed over.
const WHICH: [&str; 37] = [
    "far",
    "back",
    "front",
    "left",
    "right",
    "hand",
    "top",
    "bottom",
    "upper",
    "lower",
    "near",
    "nearest",
    "other",
    "opposite",
    "same",
    "very",
    "north",
    "south",
    "east",
    "west",
    "northern",
    "southern",
    "eastern",
    "western",
    "northeast",
    "northwest",
    "southeast",
    "southwest",
    "room",
    "lefthand",
    "righthand",
    "furthest",
    "farthest",
    "inside",
    "leftmost",
    "rightmost",
    "absolute",
];

/// Returns where a preposition, an article and words of `WHICH` before `end` start, and the side
/// they give.
fn before(tokens: &[String], end: usize) -> Option<(usize, Option<&'static str>)> {
    let is = |i: usize, words: &[&str]| words.contains(&tokens[i].as_str());
    let mut start = end;
    while start > 0 && is(start - 1, &WHICH) {
        start -= 1;
    }
    let side = tokens[start..end].iter().find_map(|which| match which.as_str() {
        "left" | "lefthand" | "leftmost" => Some("left"),
        "right" | "righthand" | "rightmost" => Some("right"),
        _ => None,
    });
    while start > 0 && is(start - 1, &["the", "a", "an", "one", "that", "this"]) {
        start -= 1;
    }
    (start > 0 && is(start - 1, &PREPOSITIONS)).then(|| (start - 1, side))
}

/// What follows "of" after `at`: nothing, the room (with its end), or another object.
enum Of {
    Nothing,
    Room(usize),
    Thing,
}

fn of(tokens: &[String], at: usize) -> Of {
    let word = |i: usize| tokens.get(i).map_or("", String::as_str);
    match (word(at), word(at + 1), word(at + 2)) {
        (
            "of" | "in",
            "the" | "this",
            "room" | "kitchen" | "office" | "bedroom" | "bathroom" | "space",
        ) => Of::Room(at + 3),
        ("of", ..) => Of::Thing,
        _ => Of::Nothing,
    }
}

/// Rewrites "in the back left corner of the room" to "in the corner on the left", and "on the
/// corner of the desk" to "on the desk".
fn rewrite_corners(tokens: &mut Vec<String>) {
    let mut i = 0;
    while i < tokens.len() {
        if tokens[i] == "corner"
            && let Some((start, side)) = before(tokens, i)
        {
            let (end, mut new): (usize, Vec<&str>) = match of(tokens, i + 1) {
                Of::Thing => (
                    i + 2,
                    side.map_or_else(
                        || vec![if tokens[start] == "on" { "on" } else { "at" }],
                        |side| at_a_side(&tokens[start], side),
                    ),
                ),
                Of::Room(end) => (end, vec!["in", "the", "corner"]),
                Of::Nothing => (i + 1, vec!["in", "the", "corner"]),
            };
            if let Some(side) = side.filter(|_| new.len() == 3) {
                new.extend(["on", "the", side]);
            }
            let length = new.len();
            tokens.splice(start..end, new.into_iter().map(str::to_owned));
            i = start + length;
        } else {
            i += 1;
        }
    }
}

/// Rewrites "on the right side of the room" to "on the right". Removes other sides of the room,
/// because the scene does not define them.
fn rewrite_room_sides(tokens: &mut Vec<String>) {
    let mut i = 0;
    while i < tokens.len() {
        if matches!(tokens[i].as_str(), "side" | "end" | "half")
            && let Some((start, side)) = before(tokens, i)
            && let Of::Room(end) = of(tokens, i + 1)
        {
            let new: Vec<String> =
                side.map_or_else(Vec::new, |side| ["on", "the", side].map(str::to_owned).to_vec());
            let length = new.len();
            tokens.splice(start..end, new);
            i = start + length;
        } else {
            i += 1;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::tokens::tokenize;

    #[test]
    fn ends_corners_and_sides_are_rewritten_to_standard_forms() {
        for (said, meant) in [
            ("the chair in the far left corner of the room", "the chair in the corner on the left"),
            ("the plant in one corner", "the plant in the corner"),
            ("a mug on the corner of the desk", "a mug on the desk"),
            (
                "the monitor on the bottom left corner of the desk",
                "the monitor on the left side of the desk",
            ),
            ("the chair by the corner of the table", "the chair at the table"),
            ("a corner desk", "a corner desk"),
            ("the bed on the right side of the room", "the bed on the right"),
            ("on the other side of the room", ""),
            (
                "the kettle at the far right end of the counter",
                "the kettle on the right side of the counter",
            ),
            ("the kettle at the end of the counter", "the kettle at the end of the counter"),
            ("the one on the right - most table", "the one on the rightmost table"),
            ("the pillow that is on the back right", "the pillow that is on the right"),
            ("the chair is facing to the left", "the chair is facing to the left"),
            ("facing the left wall, the lamp", "facing the left wall , the lamp"),
        ] {
            let mut words = tokenize(said);
            rewrite(&mut words);
            assert_eq!(words.join(" "), meant, "{said}");
        }
        // The orientation is one word.
        let mut words = tokenize("the chair is facing down and right");
        rewrite(&mut words);
        assert_eq!(words.last().map(String::as_str), Some("facing down and right"));
    }
}
