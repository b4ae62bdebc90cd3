//! Rewrites clauses that give a viewer's position and direction to the few that the tables have:
//! "if I'm sitting over there on the sofa and look at the TV" becomes "when you stand at the sofa
//! when you face the TV".

use super::tokens::BREAK;
use uniground_models::attributes::Lexicon;

/// The action of a viewer.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Act {
    Be,
    Look,
    Walk,
}

const BE: [&str; 13] = [
    "stand",
    "standing",
    "stood",
    "sit",
    "sitting",
    "seated",
    "sat",
    "lie",
    "lying",
    "laying",
    "lay",
    "lounging",
    "positioned",
];
const LOOK: [&str; 12] = [
    "look", "looking", "face", "facing", "watch", "watching", "view", "viewing", "stare",
    "staring", "gaze", "gazing",
];
const WALK: [&str; 12] = [
    "walk", "walking", "come", "coming", "enter", "entering", "step", "stepping", "go", "going",
    "get", "getting",
];
const OPENERS: [&str; 12] = [
    "if", "when", "as", "while", "once", "whenever", "imagine", "suppose", "assume", "assuming",
    "pretend", "say",
];
const SUBJECTS: [&str; 10] =
    ["i", "you", "we", "one", "someone", "somebody", "your", "he", "they", "people"];
const SUBJECTS_WITH_BE: [&str; 8] =
    ["i'm", "im", "you're", "youre", "we're", "they're", "he's", "she's"];
const AUXILIARIES: [&str; 14] = [
    "are", "am", "were", "is", "was", "be", "to", "just", "first", "now", "would", "had", "have",
    "that",
];
const PARTICLES: [&str; 15] = [
    "square",
    "close",
    "up",
    "down",
    "back",
    "out",
    "over",
    "right",
    "straight",
    "directly",
    "there",
    "here",
    "just",
    "around",
    "comfortably",
];
/// Longest first.
const IN_FRONT: [&[&str]; 4] = [
    &["directly", "in", "front", "of"],
    &["right", "in", "front", "of"],
    &["in", "front", "of"],
    &["opposite"],
];
const AT: [&[&str]; 14] = [
    &["next", "to"],
    &["close", "to"],
    &["in", "the", "middle", "of"],
    &["on", "top", "of"],
    &["on"],
    &["at"],
    &["in"],
    &["by"],
    &["near"],
    &["beside"],
    &["inside"],
    &["behind"],
    &["against"],
    &["under"],
];
const TOWARDS: [&str; 10] =
    ["of", "at", "to", "toward", "towards", "into", "onto", "across", "over", "through"];
const THROUGH: [&str; 9] = ["in", "into", "inside", "through", "by", "from", "via", "at", "to"];
const ROOMS: [&str; 9] =
    ["room", "kitchen", "office", "bedroom", "bathroom", "place", "apartment", "house", "garage"];

/// Rewrites the clauses of a query.
pub(super) fn rewrite_viewpoints(tokens: &[String]) -> Vec<String> {
    let mut out: Vec<String> = Vec::with_capacity(tokens.len());
    // Whether this clause has mentioned a viewer: "and look ..." then continues it.
    let mut somebody = false;
    let mut i = 0;
    while i < tokens.len() {
        let starts = out.last().is_none_or(|last| last == BREAK);
        if let Some((said, length)) = parse_clause(&tokens[i..], starts, somebody) {
            out.extend(said.iter().map(|word| (*word).to_owned()));
            i += length;
            somebody = true;
        } else {
            somebody &= tokens[i] != BREAK;
            out.push(tokens[i].clone());
            i += 1;
        }
    }
    out
}

/// Returns the meaning of the clause at the start of `tokens`, and the number of tokens before the
/// object it refers to.
fn parse_clause(
    tokens: &[String],
    starts: bool,
    somebody: bool,
) -> Option<(&'static [&'static str], usize)> {
    let word = |i: usize| tokens.get(i).map_or("", String::as_str);
    let mut i = 0;
    let mut opened = false;
    while OPENERS.contains(&word(i)) {
        (opened, i) = (true, i + 1);
    }
    // "they are under the counter" is about objects.
    if !opened && matches!(word(i), "he" | "he's" | "they" | "they're") {
        return None;
    }
    let with_be = SUBJECTS_WITH_BE.contains(&word(i));
    let subject = with_be || SUBJECTS.contains(&word(i));
    i += usize::from(subject);
    let goes_on = somebody && !subject && matches!(word(i), "and" | "then");
    while goes_on && matches!(word(i), "and" | "then") {
        i += 1;
    }
    let verb = i;
    while subject && AUXILIARIES.contains(&word(i)) {
        i += 1;
    }
    let be = with_be || i > verb;
    let act = match word(i) {
        w if BE.contains(&w) => Act::Be,
        w if LOOK.contains(&w) => Act::Look,
        w if WALK.contains(&w) => Act::Walk,
        // "I'm on the sofa"
        _ if subject && be && (opened || starts) => {
            return viewpoint_at(tokens, i).filter(|_| word(i) != "to");
        }
        _ => return None,
    };
    let told = goes_on || if subject { opened || starts && be } else { starts };
    // "the chair facing the window", "find me" do not give a viewer.
    if !told || opened && !subject && !word(i).ends_with("ing") {
        return None;
    }
    // "look for", "get me", "come here", "go to" are requests.
    if starts && !opened && !subject && !goes_on && (act != Act::Be && !word(i).ends_with("ing")) {
        return None;
    }
    let sits = word(i).starts_with("sit") || matches!(word(i), "seated" | "sat");
    let plain = matches!(word(i), "face" | "facing" | "watch" | "watching" | "view" | "viewing");
    i += 1;
    while PARTICLES.contains(&word(i)) {
        i += 1;
    }
    match act {
        // A person at a table faces it; a person on a sofa has it behind.
        Act::Be if sits && word(i) == "at" => Some((&["when", "you", "sit", "at"], i + 1)),
        // "standing in the middle of the room" gives no particular position.
        Act::Be if viewpoint_at(tokens, i).is_some_and(|(_, length)| is_room(tokens, length)) => {
            let length = viewpoint_at(tokens, i).map_or(i, |(_, length)| length);
            Some((&[], length + if ROOMS.contains(&word(length)) { 1 } else { 2 }))
        }
        Act::Be => viewpoint_at(tokens, i)
            .or((LOOK.contains(&word(i)) || word(i) == "and" && LOOK.contains(&word(i + 1)))
                .then_some((&[][..], i))),
        Act::Look if plain && !TOWARDS.contains(&word(i)) => Some((&["when", "you", "face"], i)),
        Act::Look if word(i) == "from" => Some((&["when", "you", "stand", "at"], i + 1)),
        Act::Look => {
            let start = i;
            while TOWARDS.contains(&word(i)) || PARTICLES.contains(&word(i)) {
                i += 1;
            }
            let room = usize::from(matches!(word(i), "the" | "this")) + i;
            if ROOMS.contains(&word(room)) {
                return Some((&[], room + 1));
            }
            (i > start).then_some((&["when", "you", "face"], i))
        }
        Act::Walk => {
            while THROUGH.contains(&word(i)) || PARTICLES.contains(&word(i)) {
                i += 1;
            }
            let room = usize::from(matches!(word(i), "the" | "this")) + i;
            match word(i) {
                _ if ROOMS.contains(&word(room))
                    && !matches!(word(room + 1), "door" | "by" | "through" | "from") =>
                {
                    Some((&["as", "you", "walk", "in"], room + 1))
                }
                // "come in by the kitchen door"
                _ if ROOMS.contains(&word(room)) && word(room + 1) != "door" => {
                    Some((&["when", "you", "come", "in", "through"], room + 2))
                }
                "the" | "a" | "that" | "this" | "your" | "my" => {
                    Some((&["when", "you", "come", "in", "through"], i))
                }
                _ => Some((&["as", "you", "walk", "in"], i)),
            }
        }
    }
}

/// Returns whether the room itself is named at `i`, and not a door or wall of it.
fn is_room(tokens: &[String], i: usize) -> bool {
    let word = |i: usize| tokens.get(i).map_or("", String::as_str);
    let room = i + usize::from(matches!(word(i), "the" | "this"));
    ROOMS.contains(&word(room)) && !Lexicon::get().is_known(word(room + 1))
}

/// Returns the viewer's position by the preposition at `i`. A viewer in front of an object looks at
/// it.
fn viewpoint_at(tokens: &[String], i: usize) -> Option<(&'static [&'static str], usize)> {
    let begins = |words: &&[&str]| {
        tokens[i.min(tokens.len())..]
            .iter()
            .map(String::as_str)
            .take(words.len())
            .eq(words.iter().copied())
    };
    if let Some(words) = IN_FRONT.iter().copied().find(|words| begins(words)) {
        return Some((&["when", "you", "face"], i + words.len()));
    }
    AT.iter()
        .copied()
        .find(|words| begins(words))
        .map(|words| (&["when", "you", "stand", "at"][..], i + words.len()))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::tokens::tokenize;

    #[test]
    fn viewer_clauses_are_rewritten_to_standard_forms() {
        for (said, meant) in [
            (
                "if i sit on the sofa and look across the room the lamp",
                "when you stand at the sofa the lamp",
            ),
            ("if you're standing in front of the tv, the box", "when you face the tv , the box"),
            (
                "im on the red chair facing the desk",
                "when you stand at the red chair facing the desk",
            ),
            (
                "when youre watching the big tv, the left speaker",
                "when you face the big tv , the left speaker",
            ),
            (
                "right when you come in by the red door, the crate",
                "right when you come in through the red door , the crate",
            ),
            (
                "as you walk into the room, the lamp on the left",
                "as you walk in , the lamp on the left",
            ),
            (
                "coming in through the door, the first desk",
                "when you come in through the door , the first desk",
            ),
            ("stand in front of the dresser, the photo", "when you face the dresser , the photo"),
            ("if you stand facing the two desks", "when you face the two desks"),
            (
                "sitting at the desk, the lamp on the left",
                "when you sit at the desk , the lamp on the left",
            ),
            (
                "standing at the door and looking at the radiators",
                "when you stand at the door when you face the radiators",
            ),
            ("the chair facing the window", "the chair facing the window"),
            (
                "standing in the middle of the room this table is on the right",
                "this table is on the right",
            ),
            (
                "there are cabinets. they are under the counter",
                "there are cabinets , they are under the counter",
            ),
            ("the cat sitting on the sofa", "the cat sitting on the sofa"),
            ("look for the chair", "look for the chair"),
            ("i need the chair at the table", "i need the chair at the table"),
            ("go to the chair by the window", "go to the chair by the window"),
            ("get me the mug on the table", "get me the mug on the table"),
        ] {
            assert_eq!(rewrite_viewpoints(&tokenize(said)).join(" "), meant, "{said}");
        }
    }
}
