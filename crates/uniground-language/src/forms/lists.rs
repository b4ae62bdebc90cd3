//! Lists of objects, and whether an object exists.

use super::Form;
use super::patterns::Found;
use super::words::{
    after, before, is_comparing_place, is_one_of, is_place, is_plural, owned, skip_placed,
};
use crate::words::{self, Meaning};

/// Words for things of any kind.
const THINGS: [&str; 12] = [
    "things",
    "objects",
    "items",
    "thing",
    "object",
    "item",
    "stuff",
    "else",
    "all",
    "other",
    "everything",
    "something",
];

pub(super) const PEOPLE: [&str; 13] = [
    "i", "we", "you", "they", "he", "she", "somebody", "someone", "anybody", "anyone", "people",
    "one", "who",
];
/// Verbs of putting, keeping and finding.
pub(super) const PUTS: [&str; 15] = [
    "leave", "left", "put", "see", "seen", "keep", "kept", "place", "placed", "set", "drop",
    "store", "find", "have", "hang",
];

/// "what is on the desk", "everything on the desk", "which chairs are there"
pub(super) fn list(words: &[&str], is_first: bool) -> Found {
    let things = |place: &[&str]| {
        let target: Vec<&str> = std::iter::once("things").chain(place.iter().copied()).collect();
        Some((Form::List, owned(&target)))
    };
    let commands = [
        "list",
        "name",
        "enumerate",
        "show me",
        "show",
        "give me",
        "find me",
        "find",
        "tell me",
        "get",
        "what about",
        "give me a list of",
        "make a list of",
    ];
    let commanded = after(words, &["make a list of", "give me a list of", "give me"])
        .or_else(|| after(words, &commands));
    let listed =
        after(words, &["list", "enumerate", "name", "make a list of", "give me a list of"])
            .map(|rest| after(rest, &["all of the", "all the", "all", "the"]).unwrap_or(rest))
            .filter(|rest| !rest.is_empty() && is_first);
    let rest = commanded.unwrap_or(words);
    let rest = after(rest, &["me"]).unwrap_or(rest);
    let everything = after(
        rest,
        &[
            "everything that is",
            "everything you see",
            "everything which is",
            "everything",
            "all the things that are",
            "all things that are",
            "all the things",
            "all things",
            "all the objects",
            "all objects",
            "all the items",
            "all items",
            "every object",
            "every item",
            "every thing",
            "all the stuff",
            "all of the things",
            "all of the objects",
            "the things",
            "the objects",
            "the items",
            "things",
            "objects",
            "items",
        ],
    )
    .map(skip_placed);
    if let Some(place) = everything.filter(|rest| is_first && !rest.is_empty()) {
        if is_room(place) {
            return things(&[]);
        }
        return is_place(place).then(|| things(place)).flatten();
    }
    if let Some(listed) = listed {
        let target: Vec<&str> = std::iter::once("all").chain(listed.iter().copied()).collect();
        return Some((Form::List, owned(&target)));
    }
    let (rest, which) = match words {
        ["what", rest @ ..] => (rest, false),
        ["which", rest @ ..] => (rest, true),
        _ => return None,
    };
    // "what does the desk have on it", "what is the desk carrying"
    if let Some(holder) = after(rest, &["does", "do"])
        && let Some(holder) = before(holder, &["have on it", "carry", "hold", "have on top"])
    {
        let place: Vec<&str> = std::iter::once("on").chain(holder.iter().copied()).collect();
        return things(&place);
    }
    // "what did somebody leave on the armchair"
    if let ["did" | "do" | "does" | "have" | "has" | "can" | "could", who, verb, place @ ..] = rest
        && PEOPLE.contains(who)
        && PUTS.contains(verb)
        && is_place(place)
    {
        return things(place);
    }
    let rest = after(rest, &["has been", "have been", "is being", "all is", "all"]).unwrap_or(rest);
    let mut rest = rest;
    let mut noun = Vec::new();
    while let Some(word) = rest.first().filter(|word| THINGS.contains(word)) {
        noun.push(*word);
        rest = &rest[1..];
    }
    if noun.is_empty()
        && let Some(be) = rest.iter().position(|word| matches!(*word, "are" | "do" | "can"))
        && be > 0
        && is_plural(&rest[..be])
    {
        noun.extend(&rest[..be]);
        rest = &rest[be..];
    }
    let of_a_kind = noun.last().is_some_and(|word| !THINGS.contains(word));
    if which && noun.is_empty() {
        return None;
    }
    let seen = after(
        rest,
        &[
            "do you see",
            "can you see",
            "do we have",
            "do i have",
            "can i see",
            "can i find",
            "can be found",
            "can be seen",
            "do you find",
            "have we got",
            "do i see",
            "can we see",
        ],
    );
    let rest = seen.or_else(|| after(rest, &["is", "are", "was"])).unwrap_or(rest);
    let rest = skip_placed(rest);
    let rest = before(rest, &["there"]).unwrap_or(rest);
    let target = |place: &[&str]| {
        if of_a_kind {
            let target: Vec<&str> =
                std::iter::once("all").chain(noun.iter().chain(place).copied()).collect();
            Some((Form::List, owned(&target)))
        } else {
            things(place)
        }
    };
    if rest.is_empty() || matches!(rest, ["there" | "here"]) || is_room(rest) {
        return (of_a_kind || seen.is_some() || is_room(rest)).then(|| target(&[])).flatten();
    }
    // "what is not on the floor"
    let place = rest.strip_prefix(&["not"]).unwrap_or(rest);
    (is_place(place) && !is_comparing_place(place)).then(|| target(rest)).flatten()
}

/// Reads a number at the beginning of words, and returns the rest.
fn leading_number<'a, 'b>(words: &'a [&'b str]) -> Option<(u32, &'a [&'b str])> {
    if let Some((Meaning::Number(number), length)) = words::longest_match(words) {
        return Some((number, &words[length..]));
    }
    let (first, rest) = words.split_first()?;
    let number = match *first {
        "zero" => 0,
        "one" => 1,
        number => number.parse().ok()?,
    };
    Some((number, rest))
}

/// "are there more than 3 chairs", "are there no chairs"
fn number(words: &[&str]) -> Found {
    let found = if let ["no", rest @ ..] = words {
        Some((0..=0, rest))
    } else if let Some(rest) = after(words, &["exactly", "only", "just"]) {
        leading_number(rest).map(|(n, rest)| (n..=n, rest))
    } else if let Some(rest) = after(words, &["at least", "a minimum of"]) {
        leading_number(rest).map(|(n, rest)| (n..=u32::MAX, rest))
    } else if let Some(rest) = after(words, &["at most", "no more than", "a maximum of", "up to"]) {
        leading_number(rest).map(|(n, rest)| (0..=n, rest))
    } else if let Some(rest) = after(words, &["more than", "over"]) {
        leading_number(rest).map(|(n, rest)| (n.saturating_add(1)..=u32::MAX, rest))
    } else if let Some(rest) = after(words, &["less than", "fewer than", "under"]) {
        leading_number(rest).map(|(n, rest)| (0..=n.saturating_sub(1), rest))
    } else {
        None
    };
    let (range, named) = found.filter(|(_, named)| !named.is_empty())?;
    let target: Vec<&str> = ["how", "many"].into_iter().chain(named.iter().copied()).collect();
    Some((Form::Number(range), owned(&target)))
}

/// Returns whether words mean the whole room: "in the room", "in here".
fn is_room(words: &[&str]) -> bool {
    matches!(
        words,
        ["in", "the" | "this", "room" | "scene" | "place" | "space" | "apartment" | "office"]
            | ["in" | "around", "here"]
            | ["in", "there"]
            | ["here" | "there"]
    )
}

/// "is there a piano", "do you see a clock"
pub(super) fn exists(words: &[&str]) -> Found {
    let named = after(
        words,
        &[
            "is there",
            "are there",
            "is there still",
            "is not there",
            "are not there",
            "do you see",
            "can you see",
            "do we have",
            "do you have",
            "do i have",
            "have we got",
            "does the room have",
            "does this room have",
            "does the room contain",
            "does the kitchen have",
            "does this kitchen have",
            "does the bathroom have",
            "does the bedroom have",
            "does the living room have",
            "does the office have",
            "does the apartment have",
            "does this apartment have",
            "does the house have",
            "does this house have",
            "does this place have",
            "does it have",
            "can you find",
            "can i find",
            "any",
            "is any",
            "are any",
        ],
    );
    let named = named.or_else(|| {
        // "is a piano in the room"
        let rest = after(words, &["is", "are"])?;
        // "is anything standing on the shelves"
        let first = ["a", "an", "any", "some", "anything", "something", "anyone", "nothing"];
        let rest = is_one_of(rest.first(), &first).then_some(rest)?;
        Some(
            before(rest, &["in the room", "in this room", "in here", "here", "present", "visible"])
                .unwrap_or(rest),
        )
    })?;
    let named = after(named, &["of the", "of my", "of our"]).unwrap_or(named);
    if let Some(found) = number(named) {
        return Some(found);
    }
    let named = after(named, &["not", "also", "still", "already"]).unwrap_or(named);
    let named =
        before(named, &["in the room", "in this room", "in here", "here", "anywhere", "at all"])
            .unwrap_or(named);
    let named = before(named, &["left", "there"]).unwrap_or(named);
    (!named.is_empty()).then(|| (Form::Exists, owned(named)))
}
