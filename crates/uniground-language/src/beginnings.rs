//! Finds where a sentence can name the target. People say what they do before they name an object
//! ("pop two slices in the toaster"), and why ("my back hurts, I'll take the old wooden chair"). So
//! later beginnings are read as well, and the scene decides which of them it supports
//! (`uniground_grounding::choose_reading`).

use super::pieces::longest_noun;
use super::tokens::BREAK;
use super::words::{self, Meaning as Word};
use super::{Meaning, ParsedQuery, Phrase, With, affordances, zones};
use uniground_models::attributes::WordNet;

/// Maximum number of beginnings that are read, because each costs a reading.
const MOST_READINGS: usize = 6;

/// Verbs that move one object to another: "chuck the peel in the bin" asks for the bin unless a
/// peel is in it already.
const DESTINED: [&str; 40] = [
    "put", "pop", "place", "stick", "chuck", "throw", "toss", "drop", "dump", "scrape", "pour",
    "tip", "hang", "lay", "set", "leave", "store", "pack", "load", "shove", "slide", "stow",
    "empty", "plug", "pin", "wipe", "spread", "press", "stack", "sort", "lock", "write", "draw",
    "sit", "lie", "climb", "go", "goes", "belongs", "lives",
];

/// Prepositions of the destination.
const DESTINATIONS: [&str; 10] =
    ["in", "into", "inside", "on", "onto", "to", "over", "off", "under", "at"];

/// Returns the likeliest reading of a sentence, and those with a target that is named later, in
/// order.
pub(super) fn readings(
    tokens: &[String],
    read: impl Fn(&[String]) -> ParsedQuery,
) -> (ParsedQuery, Vec<ParsedQuery>) {
    let first = read(tokens);
    // For food and drink, the question may mean the container: "the milk is in the larger fridge".
    let is_held = ["food", "beverage", "foodstuff", "nutriment"]
        .iter()
        .any(|kind| WordNet::get().is_a(&first.target.head, kind));
    let Beginnings { at_once, objects, others } = Beginnings::of(tokens, is_held);
    let starts = objects.iter().chain(&others).take(MOST_READINGS);
    let mut later: Vec<ParsedQuery> =
        starts.map(|&start| read_from(tokens, start, &read)).filter(is_distinguishing).collect();
    // "finished with today's newspaper": the word taken for the target is an action.
    if let (Meaning::Unknown, [With { phrase, .. }]) =
        (first.target.meaning(), &first.target.with[..])
    {
        later.push(ParsedQuery { target: phrase.clone(), ..ParsedQuery::default() });
    }
    // "the mug from the table": where it is taken from is no target.
    let taken_from: Vec<&Phrase> = first
        .target
        .relations
        .iter()
        .filter(|relation| relation.text == "from")
        .flat_map(|relation| &relation.anchors)
        .collect();
    later
        .retain(|reading| reading.target != first.target && !taken_from.contains(&&reading.target));
    let begins_later = if objects.is_empty() { !is_distinguishing(&first) } else { !at_once };
    if !begins_later || later.is_empty() {
        return (first, later);
    }
    let likeliest = later.remove(0);
    later.push(first);
    (likeliest, later)
}

/// Reads a sentence from a word on. A viewpoint given before it still applies. The words before it
/// are listed as passed over.
fn read_from(
    tokens: &[String],
    start: usize,
    read: impl Fn(&[String]) -> ParsedQuery,
) -> ParsedQuery {
    let is_kept =
        |clause: &&[String]| clause.ends_with(&[BREAK.to_owned()]) && is_viewpoint(clause);
    let (looks, passed): (Vec<&[String]>, Vec<&[String]>) =
        tokens[..start].split_inclusive(|token| token == BREAK).partition(is_kept);
    let carries_nothing =
        |word: &&String| *word == BREAK || words::longest_match(&[word]).is_some();
    let passed_over =
        passed.into_iter().flatten().filter(|word| !carries_nothing(word)).cloned().collect();
    let rest: Vec<String> = looks.into_iter().flatten().chain(&tokens[start..]).cloned().collect();
    ParsedQuery { passed_over, ..read(&rest) }
}

fn is_viewpoint(clause: &[String]) -> bool {
    let words: Vec<&str> = clause.iter().map(String::as_str).collect();
    (0..words.len()).any(|i| {
        matches!(
            words::longest_match(&words[i..]),
            Some((Word::View(_) | Word::Seated | Word::Entering, _))
        )
    })
}

/// Words at which the target can begin, by index.
struct Beginnings {
    /// Whether the sentence begins with the target: an article, a description, or its noun.
    at_once: bool,
    /// Articles of the objects of actions: "straighten the picture".
    objects: Vec<usize>,
    /// Beginnings of clauses, and destinations of objects that are moved.
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
                // The words so far gave a viewpoint: the target is still to come.
                sentence &= !clause.looks;
                // "chuck this away for me, in the bin"
                let it_is = usize::from(words.get(at) == Some(&"it's"));
                let goes_on = words.get(at + it_is).is_some_and(|next| DESTINATIONS.contains(next));
                clause = if goes_on { Clause { led: false, ..clause } } else { Clause::default() };
                if is_naming(&words[at..]) {
                    found.others.push(at);
                }
                continue;
            }
            clause.destined |= DESTINED.contains(&run[0]);
            let noun = longest_noun(run);
            let (meaning, length) = match (noun, words::longest_match(run)) {
                // "in that basket", but not "the basket that".
                _ if run[0] == "that" && !clause.at_noun => (Some(Word::Determiner), 1),
                (Some(noun), word) if word.is_none_or(|(_, length)| noun >= length) => (None, noun),
                (_, Some((meaning, length))) => (Some(meaning), length),
                _ => (None, 1),
            };
            match meaning {
                // "vacuum the rug": a noun right before an article is an action, and so is an
                // unknown word.
                None => {
                    let is_thing =
                        noun.is_some() && run.get(length).is_none_or(|next| !is_article(next));
                    found.at_once &= sentence || is_thing;
                    clause.named |= is_thing || clause.determined;
                    (clause.said, clause.led) = (true, false);
                }
                Some(Word::Determiner) if clause.to_another && !clause.looks => {
                    found.others.push(at);
                }
                // "wait by the door", "careful with the pot": no possible target was named.
                Some(Word::Determiner)
                    if clause.said && !(clause.led && clause.named) && !clause.looks =>
                {
                    found.objects.push(at);
                }
                // "it's on the table", "it won't go through the door" describe the object named
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

/// The state of the reader within a clause.
// Each flag records a word whose partner has not been read yet.
#[allow(clippy::struct_excessive_bools)]
#[derive(Default)]
struct Clause {
    /// An object, or an unknown word, was read.
    said: bool,
    /// An object was read: not only unknown words without an article.
    named: bool,
    /// An article was read.
    determined: bool,
    /// The last word was a noun, or an unknown word.
    at_noun: bool,
    /// The last word with content leads to another object: "next to", "with", "of".
    led: bool,
    /// The clause moves an object somewhere.
    destined: bool,
    /// The previous word is a preposition of the destination.
    to_another: bool,
    /// The clause gives a viewpoint, or more about an object named before: it names nothing itself.
    looks: bool,
}

fn is_article(word: &str) -> bool {
    matches!(words::longest_match(&[word]), Some((Word::Determiner, 1)))
}

/// Returns whether a clause begins by naming an object, rather than by saying more of one named
/// before.
fn is_naming(clause: &[&str]) -> bool {
    // "it's the pot with the lid": the object is named once more.
    let once_more = usize::from(
        clause.len() > 1 && matches!(clause[0], "it's" | "that's") && is_article(clause[1]),
    );
    let first = (once_more..clause.len())
        .find(|&i| !matches!(words::longest_match(&clause[i..]), Some((Word::Filler, _))));
    first.is_some_and(|first| {
        clause[first] != BREAK
            && matches!(
                words::longest_match(&clause[first..]),
                None | Some((
                    Word::Determiner
                        | Word::Color(_)
                        | Word::Trait(_)
                        | Word::Number(_)
                        | Word::Ordinal(_)
                        | Word::Superlative(_),
                    _
                ))
            )
    })
}

/// Returns whether a reading distinguishes its target from other objects.
fn is_distinguishing(query: &ParsedQuery) -> bool {
    let target = &query.target;
    match target.meaning() {
        // "the one on the left" says more of an object named before.
        Meaning::Anything if matches!(target.head.as_str(), "one" | "ones") => false,
        Meaning::Anything => {
            !target.colors.is_empty() || !target.with.is_empty() || !target.relations.is_empty()
        }
        Meaning::Nouns(_) | Meaning::Structure(_) | Meaning::Instance(_) => true,
        Meaning::Unknown => {
            let is_thing = !WordNet::get().kinds_of(&target.head).is_empty()
                && zones::nouns_of_zone(&target.head).is_none();
            is_thing || !target.could_be.is_empty()
        }
    }
}

#[cfg(test)]
mod tests {
    use crate::parse;

    /// Returns the heads of the likeliest reading and of the others.
    fn heads(query: &str) -> Vec<String> {
        let read = parse(query);
        std::iter::once(&read)
            .chain(&read.later)
            .map(|reading| reading.target.head.clone())
            .collect()
    }

    #[test]
    fn verbs_of_actions_are_not_read_as_targets() {
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
    fn destinations_and_later_clauses_give_additional_readings() {
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
        // The anchor of the target is not a target.
        for query in [
            "fetch the red mug off the desk",
            "bring me the blue mug from the table",
            "the theremin next to the sofa",
            "pass me the remote, it's on the table",
        ] {
            assert_eq!(heads(query).len(), 1, "{query}: {:?}", heads(query));
        }
    }
}
