//! Where in a sentence the thing asked for may be named. People say what they do before they name a
//! thing ("pop two slices in the toaster"), and why ("my back hurts, I'll take the old wooden
//! chair"): later beginnings are read as well, and the scene tells which of them it bears
//! out (`uniground_grounding::settled`).

use super::pieces::longest_noun;
use super::tokens::BREAK;
use super::words::{self, Meaning as Word};
use super::{Meaning, ParsedQuery, With, affordances, zones};
use uniground_models::attributes::WordNet;

/// So many beginnings are read: each costs a reading.
const MOST_READINGS: usize = 6;

/// What is done with one thing to another: "chuck the peel in the bin" asks for the bin unless a
/// peel is in it already.
const DESTINED: [&str; 40] = [
    "put", "pop", "place", "stick", "chuck", "throw", "toss", "drop", "dump", "scrape", "pour",
    "tip", "hang", "lay", "set", "leave", "store", "pack", "load", "shove", "slide", "stow",
    "empty", "plug", "pin", "wipe", "spread", "press", "stack", "sort", "lock", "write", "draw",
    "sit", "lie", "climb", "go", "goes", "belongs", "lives",
];

/// Where that other thing is told.
const DESTINATIONS: [&str; 10] =
    ["in", "into", "inside", "on", "onto", "to", "over", "off", "under", "at"];

/// The likeliest reading of a sentence, and what it says if the thing is named later, in order.
pub(super) fn readings(
    tokens: &[String],
    read: impl Fn(&[String]) -> ParsedQuery,
) -> (ParsedQuery, Vec<ParsedQuery>) {
    let first = read(tokens);
    // Of food and drink, what holds it may be meant: "the milk is in the larger fridge".
    let is_held = ["food", "beverage", "foodstuff", "nutriment"]
        .iter()
        .any(|kind| WordNet::get().is_a(&first.target.head, kind));
    let Beginnings { at_once, objects, others } = Beginnings::of(tokens, is_held);
    let starts = objects.iter().chain(&others).take(MOST_READINGS);
    let mut later: Vec<ParsedQuery> =
        starts.map(|&start| from(tokens, start, &read)).filter(tells_a_thing).collect();
    // "finished with today's newspaper": what was taken for a thing is what somebody does.
    if let (Meaning::Unknown, [With { phrase, .. }]) =
        (first.target.meaning(), &first.target.with[..])
    {
        later.push(ParsedQuery { target: phrase.clone(), ..ParsedQuery::default() });
    }
    later.retain(|reading| reading.target != first.target);
    let begins_later = if objects.is_empty() { !tells_a_thing(&first) } else { !at_once };
    if !begins_later || later.is_empty() {
        return (first, later);
    }
    let likeliest = later.remove(0);
    later.push(first);
    (likeliest, later)
}

/// What a sentence says from a word on. How somebody stands and looks was told before: that holds
/// for what follows. What was passed over is told.
fn from(tokens: &[String], start: usize, read: impl Fn(&[String]) -> ParsedQuery) -> ParsedQuery {
    let is_kept =
        |clause: &&[String]| clause.ends_with(&[BREAK.to_owned()]) && tells_a_view(clause);
    let (looks, passed): (Vec<&[String]>, Vec<&[String]>) =
        tokens[..start].split_inclusive(|token| token == BREAK).partition(is_kept);
    let carries_nothing = |word: &&String| *word == BREAK || words::longest(&[word]).is_some();
    let passed_over =
        passed.into_iter().flatten().filter(|word| !carries_nothing(word)).cloned().collect();
    let rest: Vec<String> = looks.into_iter().flatten().chain(&tokens[start..]).cloned().collect();
    ParsedQuery { passed_over, ..read(&rest) }
}

fn tells_a_view(clause: &[String]) -> bool {
    let words: Vec<&str> = clause.iter().map(String::as_str).collect();
    (0..words.len()).any(|i| {
        matches!(
            words::longest(&words[i..]),
            Some((Word::View(_) | Word::Seated | Word::Entering, _))
        )
    })
}

/// Words with which the thing asked for may begin, by index.
struct Beginnings {
    /// The sentence begins with it: an article, what describes the thing, or its noun.
    at_once: bool,
    /// Articles of what somebody does something to: "straighten the picture".
    objects: Vec<usize>,
    /// Clauses, and where somebody puts a thing.
    others: Vec<usize>,
}

impl Beginnings {
    fn of(tokens: &[String], is_held: bool) -> Self {
        let words: Vec<&str> = tokens.iter().map(String::as_str).collect();
        let mut found = Self { at_once: true, objects: Vec::new(), others: Vec::new() };
        let mut at = affordances::find(tokens).map_or(0, |affordance| affordance.taken);
        let (mut clause, mut sentence) =
            (Clause { destined: is_held, ..Clause::default() }, at > 0);
        let mut end = 0;
        while at < words.len() {
            if at >= end {
                end = (at..words.len()).find(|&i| words[i] == BREAK).unwrap_or(words.len());
            }
            let run = &words[at..end];
            if run.is_empty() {
                at += 1;
                // How somebody stands and looks was told: the thing is still to come.
                sentence &= !clause.looks;
                // "chuck this away for me, in the bin"
                let it_is = usize::from(words.get(at) == Some(&"it's"));
                let goes_on = words.get(at + it_is).is_some_and(|next| DESTINATIONS.contains(next));
                clause = if goes_on { Clause { led: false, ..clause } } else { Clause::default() };
                if names_something(&words[at..]) {
                    found.others.push(at);
                }
                continue;
            }
            clause.destined |= DESTINED.contains(&run[0]);
            let noun = longest_noun(run);
            let (meaning, length) = match (noun, words::longest(run)) {
                // "in that basket", but not "the basket that".
                _ if run[0] == "that" && !clause.at_noun => (Some(Word::Determiner), 1),
                (Some(noun), word) if word.is_none_or(|(_, length)| noun >= length) => (None, noun),
                (_, Some((meaning, length))) => (Some(meaning), length),
                _ => (None, 1),
            };
            match meaning {
                // "vacuum the rug": a noun right before an article is what somebody does, as is a
                // word that nobody knows.
                None => {
                    let is_thing =
                        noun.is_some() && run.get(length).is_none_or(|next| !is_article(next));
                    found.at_once &= sentence || is_thing;
                    clause.named |= is_thing || clause.determined;
                    (clause.said, clause.led) = (true, false);
                }
                Some(Word::Determiner) if clause.to_another && !clause.looks => {
                    found.others.push(at)
                }
                // "wait by the door", "careful with the pot": no thing was named that could be
                // there.
                Some(Word::Determiner)
                    if clause.said && !(clause.led && clause.named) && !clause.looks =>
                {
                    found.objects.push(at)
                }
                // "it's on the table", "it won't go through the door" speak of what was named
                // before.
                Some(Word::OfTarget | Word::Pronoun)
                    if !clause.said
                        || run.get(length).is_some_and(|next| matches!(*next, "is" | "was")) =>
                {
                    clause.looks = true;
                }
                Some(Word::ThereIs) => clause.named = true,
                Some(Word::View(_) | Word::Seated | Word::Entering) => clause.looks = true,
                Some(
                    Word::Relation(_)
                    | Word::With { .. }
                    | Word::Of
                    | Word::And
                    | Word::Not
                    | Word::As,
                ) => clause.led = true,
                Some(_) => {}
            }
            clause.at_noun = meaning.is_none();
            clause.determined |= meaning == Some(Word::Determiner);
            clause.to_another = clause.destined && clause.said && DESTINATIONS.contains(&run[0]);
            sentence |= meaning != Some(Word::Filler);
            at += length;
        }
        found
    }
}

/// What has been read of a clause.
// Each is a word that was heard and waits for the one it speaks of.
#[allow(clippy::struct_excessive_bools)]
#[derive(Default)]
struct Clause {
    /// A thing, or a word that nobody knows.
    said: bool,
    /// A thing: not only words that nobody knows and that have no article.
    named: bool,
    /// An article came.
    determined: bool,
    /// The last word was a noun, or one that nobody knows.
    at_noun: bool,
    /// The last word that carries something leads to another thing: "next to", "with", "of".
    led: bool,
    /// Something is put somewhere.
    destined: bool,
    /// The word before is the way there.
    to_another: bool,
    /// It tells how somebody stands and looks, or more of what was named before: it names nothing
    /// itself.
    looks: bool,
}

fn is_article(word: &str) -> bool {
    matches!(words::longest(&[word]), Some((Word::Determiner, 1)))
}

/// Whether a clause begins as one that names a thing, and tells nothing more of what was named
/// before.
fn names_something(clause: &[&str]) -> bool {
    // "it's the pot with the lid": named once more.
    let once_more = usize::from(
        clause.len() > 1 && matches!(clause[0], "it's" | "that's") && is_article(clause[1]),
    );
    let first = (once_more..clause.len())
        .find(|&i| !matches!(words::longest(&clause[i..]), Some((Word::Filler, _))));
    first.is_some_and(|first| {
        clause[first] != BREAK
            && matches!(
                words::longest(&clause[first..]),
                None | Some((
                    Word::Determiner
                        | Word::Colour(_)
                        | Word::Trait(_)
                        | Word::Number(_)
                        | Word::Ordinal(_)
                        | Word::Superlative(_),
                    _
                ))
            )
    })
}

/// Whether a reading tells its thing from others.
fn tells_a_thing(query: &ParsedQuery) -> bool {
    let target = &query.target;
    match target.meaning() {
        // "the one on the left" says more of what was named before.
        Meaning::Anything if matches!(target.head.as_str(), "one" | "ones") => false,
        Meaning::Anything => {
            !target.colours.is_empty() || !target.with.is_empty() || !target.relations.is_empty()
        }
        Meaning::Nouns(_) | Meaning::Structure(_) => true,
        Meaning::Unknown => {
            let is_thing = !WordNet::get().kinds_of(&target.head).is_empty()
                && zones::made_of(&target.head).is_none();
            is_thing || !target.could_be.is_empty()
        }
    }
}

#[cfg(test)]
mod tests {
    use crate::parse;

    /// Heads of the likeliest reading and of the others.
    fn heads(query: &str) -> Vec<String> {
        let read = parse(query);
        std::iter::once(&read)
            .chain(&read.later)
            .map(|reading| reading.target.head.clone())
            .collect()
    }

    #[test]
    fn what_somebody_does_names_no_thing() {
        for (query, first) in [
            ("vacuum the biggest rug in the room", "rug"),
            ("could you straighten the picture over the bed", "picture"),
            ("push away the beanbag that is closest to the ball", "beanbag"),
            ("if you stand facing the window, draw the curtain on the right", "curtain"),
            ("the red mug on the table", "mug"),
            ("mug on the table", "mug"),
            ("bring me the mug", "mug"),
            ("something to sit on by the window", "something"),
        ] {
            assert_eq!(heads(query)[0], first, "{query}: {:?}", heads(query));
        }
        let read = parse("if you stand facing the window, draw the curtain on the right");
        assert!(
            read.viewpoint.is_some()
                && read.not_understood.is_empty()
                && read.passed_over == ["draw"],
            "{read:?}"
        );
    }

    #[test]
    fn where_a_thing_is_put_and_later_clauses_are_read_as_well() {
        for (query, also) in [
            ("pop two slices in the toaster", "toaster"),
            ("chuck this peel away, in the bin next to the desk", "bin"),
            (
                "I've got a peel in my hand and two kids screaming, where's the bin by the desk?",
                "bin",
            ),
            ("put the milk in the taller of the two fridges", "fridges"),
        ] {
            assert!(heads(query).iter().any(|head| head == also), "{query}: {:?}", heads(query));
        }
        // What a thing is next to is not what is asked for.
        for query in [
            "fetch the red mug off the desk",
            "the theremin next to the sofa",
            "pass me the remote, it's on the table",
        ] {
            assert_eq!(heads(query).len(), 1, "{query}: {:?}", heads(query));
        }
    }
}
