//! Removes what people say about themselves before the question: "my hands are dirty and the tap
//! drips, where can I wash them?" asks for a place to wash.

use super::affordances;
use super::tokens::BREAK;
use super::words::{self, Meaning};
use uniground_models::attributes::Lexicon;

/// Words with which people refer to themselves, and exclamations.
const OF_THEMSELVES: &[&str] = &[
    "i",
    "i'm",
    "i've",
    "i'll",
    "i'd",
    "im",
    "ive",
    "u",
    "my",
    "we",
    "we're",
    "we've",
    "our",
    "it's",
    "it",
    "oh",
    "oops",
    "ugh",
    "hm",
    "hmm",
    "ok",
    "okay",
    "hey",
    "hi",
    "hello",
    "excuse",
    "sorry",
    "wow",
    "ah",
    "um",
    "uh",
    "well",
    "so",
    "alright",
    "right",
    "damn",
    "dear",
    "goodness",
    "gosh",
    "somebody",
    "someone",
    "he",
    "she",
    "they",
    "everybody",
    "mom",
    "dad",
];
/// How a question or a wish begins.
const ASKS: [&str; 24] = [
    "where", "which", "what", "find", "show", "bring", "get", "give", "take", "point", "fetch",
    "locate", "pick", "grab", "hand", "pass", "can", "could", "would", "please", "is", "are", "do",
    "go",
];
/// Words of a wish that names its target itself: "I need the chair", "I'm looking for the lamp".
const WISHES: [&str; 12] = [
    "need",
    "want",
    "like",
    "looking",
    "search",
    "searching",
    "find",
    "see",
    "mean",
    "meant",
    "am",
    "sit",
];

/// Returns the query from its first question or wish on, if people speak about themselves before
/// it.
pub(super) fn drop_situation(mut tokens: Vec<String>) -> Vec<String> {
    let starts: Vec<usize> = std::iter::once(0)
        .chain((0..tokens.len()).filter(|&i| tokens[i] == BREAK).map(|i| i + 1))
        .collect();
    let clause = |k: usize| {
        let end = starts.get(k + 1).map_or(tokens.len(), |next| next - 1);
        &tokens[starts[k].min(end)..end]
    };
    let first = (0..starts.len()).take_while(|&k| is_of_themselves(clause(k))).count();
    // "can we keep it" names nothing.
    let is_noun = |word: &String| Lexicon::get().is_known(word) && word != "can";
    let names = |rest: &[String]| rest.iter().any(is_noun) || affordances::find(rest).is_some();
    if (1..starts.len()).contains(&first)
        && is_request(clause(first))
        && names(&tokens[starts[first]..])
    {
        tokens.drain(..starts[first]);
    }
    tokens
}

fn is_of_themselves(clause: &[String]) -> bool {
    let word = |i: usize| clause.get(i).map_or("", String::as_str);
    // "my red mug, please" is a wish.
    let owns = matches!(word(0), "my" | "our");
    let describes = |word: &String| {
        let known = words::longest_match(&[word]).map(|(meaning, _)| meaning);
        matches!(known, Some(Meaning::Determiner | Meaning::Color(_) | Meaning::Trait(_)))
            || Lexicon::get().is_known(word)
    };
    let speaks = clause.is_empty()
        || OF_THEMSELVES.contains(&word(0)) && !(owns && clause.iter().all(describes));
    // A viewpoint is part of the question, and so is a wish.
    let tells = clause.iter().take(4).any(|word| WISHES.contains(&word.as_str()))
        || clause.iter().any(|word| {
            matches!(words::longest_match(&[word]), Some((Meaning::View(_) | Meaning::Seated, _)))
        })
        || clause.iter().any(|word| {
            matches!(word.as_str(), "standing" | "sitting" | "facing" | "looking" | "stand")
        });
    speaks && !tells
}

fn is_request(clause: &[String]) -> bool {
    // "it is a window. Is directly above the bed" is a statement, not a question.
    let tells = matches!(clause, [is, next, ..] if is == "is" && matches!(words::longest_match(&[next]), Some((Meaning::Relation(_) | Meaning::Filler, _))) && next != "there");
    !tells && clause.first().is_some_and(|word| ASKS.contains(&word.as_str()))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::tokens::tokenize;

    #[test]
    fn statements_before_the_question_are_removed() {
        for (said, left) in [
            (
                "My hands are dirty and the tap drips. Where can I wash my hands?",
                "where can i wash my hands ,",
            ),
            ("Oh goodness, it's dark. Which lamp is by the bed?", "which lamp is by the bed ,"),
            ("Oh no, I spilled my tea on the sofa, where is a towel", "where is a towel"),
            ("I'm on the sofa, what's on my left", "i'm on the sofa , what's on my left"),
            ("I need the chair by the door, please", "i need the chair by the door , please"),
            (
                "I'm looking at the window, find the lamp on the left",
                "i'm looking at the window , find the lamp on the left",
            ),
            ("it's the one by the door", "it's the one by the door"),
            ("the chair by the door, find it", "the chair by the door , find it"),
            ("My chair is by the door, where is it?", "my chair is by the door , where is it ,"),
            ("I am cold", "i am cold"),
            (
                "It is a window. Is directly above the bed",
                "it is a window , is directly above the bed",
            ),
        ] {
            assert_eq!(drop_situation(tokenize(said)).join(" "), left, "{said}");
        }
    }
}
