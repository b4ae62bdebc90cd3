//! Rewrites clauses that run together, and removes those that do not describe the target: "be a
//! dear and fetch the mug", "the lamp needs a new bulb".

use super::pieces::longest_noun;
use super::tokens::BREAK;
use super::words::{self, Meaning};
use uniground_models::attributes::Lexicon;

/// Rewrites a query's words.
pub(super) fn rewrite(tokens: &mut Vec<String>) {
    remove_finding_clause(tokens);
    remove_request(tokens);
    replace_left_by_put(tokens);
    split_joined_clauses(tokens);
    remove_comparison(tokens);
    remove_bright(tokens);
    remove_lacking_clause(tokens);
    rewrite_look_at(tokens);
    rewrite_where_another_is(tokens);
    remove_rejected_object(tokens);
    repeat_shared_noun(tokens);
    rewrite_bedside(tokens);
    rewrite_what_it_stands_on(tokens);
}

fn meaning(tokens: &[String], i: usize) -> Option<Meaning> {
    words::longest_match(&[tokens.get(i)?]).map(|(meaning, _)| meaning)
}

fn is_article(tokens: &[String], i: usize) -> bool {
    meaning(tokens, i) == Some(Meaning::Determiner)
}

fn is(tokens: &[String], i: usize, words: &[&str]) -> bool {
    tokens.get(i).is_some_and(|token| words.contains(&token.as_str()))
}

/// Returns the index of the end of the clause that a word is in.
fn end_of_clause(tokens: &[String], from: usize) -> usize {
    (from..tokens.len()).find(|&i| tokens[i] == BREAK).unwrap_or(tokens.len())
}

/// Removes clauses about who did what with the target, because they do not distinguish it: "has
/// anybody seen the mug", "where did my son drop his bag".
fn remove_finding_clause(tokens: &mut Vec<String>) {
    const WHO: [&str; 12] = [
        "i",
        "we",
        "you",
        "he",
        "she",
        "they",
        "it",
        "anybody",
        "anyone",
        "somebody",
        "someone",
        "everybody",
    ];
    let starts = |i: usize| {
        i == 0
            || tokens[i - 1] == BREAK
            || is(tokens, i - 1, &["where", "when", "what", "which", "why"])
    };
    let does = |i: &usize| starts(*i) && is(tokens, *i, &["has", "have", "had", "did", "does"]);
    let Some(at) = (0..tokens.len()).find(does) else { return };
    let from = at - usize::from(at > 0 && is(tokens, at - 1, &["where", "when"]));
    if is(tokens, at + 1, &WHO) {
        tokens.drain(from..at + 2);
        return;
    }
    // A person, an action, and an article: the object of the action follows.
    let end = end_of_clause(tokens, at);
    let object = (at + 3..end.min(at + 6)).find(|&i| is_article(tokens, i));
    let related = |i: usize| {
        matches!(
            meaning(tokens, i),
            Some(Meaning::Relation(_) | Meaning::With { .. } | Meaning::Of | Meaning::And)
        )
    };
    match object.filter(|&object| !(at + 1..object).any(related)) {
        _ if !is_article(tokens, at + 1) => {}
        Some(object) => {
            tokens.drain(from..object);
        }
        None => {
            tokens.drain(from..=at);
        }
    }
}

/// Removes the requested action after the target was named: "leave it by the door", "can you see if
/// my keys are there".
fn remove_request(tokens: &mut Vec<String>) {
    const POLITE: [&str; 7] = ["can", "could", "would", "will", "you", "please", "just"];
    const VERBS: [&str; 30] = [
        "leave", "put", "turn", "take", "bring", "hang", "move", "carry", "give", "hand", "pass",
        "throw", "tape", "push", "pull", "open", "close", "shut", "clean", "wipe", "fix", "keep",
        "place", "set", "get", "switch", "drop", "lift", "roll", "wheel",
    ];
    let names = |clause: &[String]| {
        clause.iter().any(|word| {
            longest_noun(&[word.as_str()]).is_some_and(|_| !POLITE.contains(&word.as_str()))
        })
    };
    let mut end = tokens.len();
    while end > 0 {
        let start = tokens[..end].iter().rposition(|token| token == BREAK).map_or(0, |at| at + 1);
        let verb = (start..end).find(|&i| !POLITE.contains(&tokens[i].as_str())).unwrap_or(end);
        let does_it = is(tokens, verb, &VERBS)
            && is(tokens, verb + 1, &["it", "them", "him", "her"])
            && !is_article(tokens, verb + 2);
        let looks_whether = is(tokens, verb, &["see", "check", "look", "tell"])
            && (verb..end.min(verb + 3)).any(|i| is(tokens, i, &["if", "whether"]));
        if verb < end && start > 0 && (does_it || looks_whether) && names(&tokens[..start]) {
            tokens.drain(start..end);
        }
        end = start.saturating_sub(1);
    }
}

/// Rewrites "what the telly stands on" to an object with the telly.
fn rewrite_what_it_stands_on(tokens: &mut Vec<String>) {
    const PLACED: [&str; 11] = [
        "is", "stands", "stood", "sits", "sat", "standing", "sitting", "lies", "lying", "hangs",
        "resting",
    ];
    let end = end_of_clause(tokens, 0);
    if !is(tokens, 0, &["what", "what's"]) || !is_article(tokens, 1) {
        return;
    }
    let Some(length) = longest_noun(&run(tokens, 2)) else { return };
    let verbs = (2 + length..end).take_while(|&i| PLACED.contains(&tokens[i].as_str())).count();
    let on = 2 + length + verbs;
    if is(tokens, on, &["on", "in"]) && on + 1 == end {
        tokens.drain(2 + length..end);
        tokens.splice(..1, ["thing", "with"].map(str::to_owned));
    }
}

/// Removes a clause about what people do with the target, if it is not a known use: "the ladder
/// thing you stand on". The clause names no other object.
pub(super) fn remove_use_clause(tokens: &mut Vec<String>) {
    const LONGEST: usize = 4;
    let follows_a_noun = |i: usize| longest_noun(&[tokens[i].as_str()]).is_some();
    let begins = |i: &usize| {
        let end = end_of_clause(tokens, *i);
        is(tokens, *i, &["you", "i", "we", "people", "they"])
            && follows_a_noun(i - 1)
            && (2..=LONGEST).contains(&(end - i))
            && is(tokens, end - 1, &["on", "in", "with", "from", "at", "by", "under", "into"])
    };
    if let Some(start) = (1..tokens.len()).find(begins) {
        let end = end_of_clause(tokens, start);
        tokens.drain(start..end);
    }
}

/// Replaces the verb "left" by "put": "I left it by the lamp" gives no left side.
fn replace_left_by_put(tokens: &mut [String]) {
    const WHO: [&str; 12] =
        ["i", "we", "you", "he", "she", "they", "i've", "somebody", "someone", "who", "be", "was"];
    let mut i = 1;
    while i < tokens.len() {
        if tokens[i] == "left" && is(tokens, i - 1, &WHO) {
            "put".clone_into(&mut tokens[i]);
        }
        i += 1;
    }
}

/// Inserts a break where another clause begins: "so I'll have the chair", "and fetch my mug".
fn split_joined_clauses(tokens: &mut Vec<String>) {
    const WHO: [&str; 16] = [
        "i", "i'll", "i'd", "we", "we'll", "you", "he", "she", "they", "bring", "can", "could",
        "please", "let", "where's", "there's",
    ];
    const WANTED: [&str; 16] = [
        "fetch", "bring", "get", "grab", "take", "find", "show", "give", "hand", "pass", "go",
        "drive", "point", "pick", "put", "tell",
    ];
    // "my mate wants to sit on the beanbag"
    if let Some(i) = (2..tokens.len()).find(|&i| {
        is(tokens, i, &["wants", "needs", "has", "wanted"]) && is(tokens, i + 1, &["to"])
    }) {
        tokens.splice(i..i + 2, [BREAK.to_owned()]);
    }
    for i in 1..tokens.len() {
        let begins = match tokens[i].as_str() {
            "so" | "but" => is(tokens, i + 1, &WHO) || is_article(tokens, i + 1),
            // "and vacuum around it", "and count along that side" name no second object.
            "and" | "then" => {
                let does = is(tokens, i + 1, &WANTED)
                    || meaning(tokens, i + 1).is_none() && is_article(tokens, i + 2);
                let around_it = is(tokens, i + 3, &["it", "them"])
                    && matches!(meaning(tokens, i + 2), Some(Meaning::Relation(_)));
                does || around_it
            }
            _ => false,
        };
        if begins {
            BREAK.clone_into(&mut tokens[i]);
        }
    }
}

/// Removes a comparison: in "the taller plant, like a small palm", the palm is not a second object.
fn remove_comparison(tokens: &mut Vec<String>) {
    let begins = |i: &usize| {
        let likened = is(tokens, *i, &["like"]) && is(tokens, i + 1, &["a", "an"])
            || is(tokens, *i, &["looks"]) && is(tokens, i + 1, &["like", "a", "all"]);
        likened && !is(tokens, i - 1, &["i'd", "would", "i", "we", "we'd", "you", "something", "d"])
    };
    if let Some(start) = (1..tokens.len()).find(begins) {
        let end = end_of_clause(tokens, start);
        tokens.drain(start..end);
    }
}

/// Rewrites "bright orange" to "orange".
fn remove_bright(tokens: &mut Vec<String>) {
    let is_shade = |i: &usize| {
        is(tokens, *i, &["bright", "vivid", "deep", "rich", "strong"])
            && matches!(meaning(tokens, i + 1), Some(Meaning::Color(_)))
    };
    if let Some(at) = (0..tokens.len()).find(is_shade) {
        tokens.remove(at);
    }
}

/// Removes what an object needs: in "the lamp needs a new bulb", the bulb is not in the scene.
fn remove_lacking_clause(tokens: &mut Vec<String>) {
    let begins = |i: &usize| {
        is(tokens, *i, &["needs", "wants", "requires", "deserves"])
            && is(tokens, i + 1, &["a", "an", "some", "new", "more"])
    };
    if let Some(start) = (2..tokens.len()).find(begins) {
        let end = end_of_clause(tokens, start);
        tokens.drain(start..end);
    }
}

/// Reads "look at that thing on the wall", where it is the whole question, as a request for the
/// object.
fn rewrite_look_at(tokens: &mut Vec<String>) {
    let starts = |i: usize| i == 0 || tokens[i - 1] == BREAK;
    let Some(at) = (0..tokens.len())
        .find(|&i| starts(i) && is(tokens, i, &["look"]) && is(tokens, i + 1, &["at"]))
    else {
        return;
    };
    let rest = &tokens[end_of_clause(tokens, at)..];
    if rest.iter().all(|token| token == BREAK) {
        tokens.drain(at..at + 2);
    }
}

/// Rewrites "the couch where the teddy is sitting" to a couch with the teddy.
fn rewrite_where_another_is(tokens: &mut Vec<String>) {
    const PLACED: [&str; 11] = [
        "is", "are", "was", "sits", "lies", "stands", "hangs", "sitting", "lying", "standing",
        "hanging",
    ];
    let Some(at) = (1..tokens.len()).find(|&i| tokens[i] == "where") else { return };
    let end = end_of_clause(tokens, at);
    let named = (0..at).any(|i| longest_noun(&[tokens[i].as_str()]).is_some());
    let mut start = at + 1;
    while start < end && PLACED.contains(&tokens[start].as_str()) {
        start += 1;
    }
    let words: Vec<&str> = tokens[start..end].iter().map(String::as_str).collect();
    let article = usize::from(is_article(tokens, start));
    let Some(length) = words.get(article..).and_then(longest_noun).filter(|_| named) else {
        return;
    };
    let thing = start + article + length;
    let verbs = (thing..end).take_while(|&i| PLACED.contains(&tokens[i].as_str())).count();
    if start > at + 1 || verbs > 0 {
        tokens.drain(thing..thing + verbs);
        tokens.splice(at..start, ["with".to_owned()]);
    }
}

/// Removes the rejected object in front of the target: "not the cup by the laptop, the other cup".
fn remove_rejected_object(tokens: &mut Vec<String>) {
    let first = (0..tokens.len()).find(|&i| tokens[i] != BREAK && !is(tokens, i, &["no"]));
    let Some(not) = first.filter(|&i| tokens[i] == "not" && is_article(tokens, i + 1)) else {
        return;
    };
    let end = end_of_clause(tokens, not);
    let is_named = (end + 3..tokens.len().min(end + 6))
        .any(|i| !is(tokens, i, &["one"]) && longest_noun(&run(tokens, i)).is_some());
    if is(tokens, end + 1, &["the"]) && is(tokens, end + 2, &["other"]) && is_named {
        tokens.drain(..=end);
    }
}

fn run(tokens: &[String], from: usize) -> Vec<&str> {
    tokens.iter().skip(from).map(String::as_str).take_while(|token| *token != BREAK).collect()
}

/// Rewrites "the bedside lamp" to a lamp by the bed.
fn rewrite_bedside(tokens: &mut Vec<String>) {
    let lamp =
        |i: &usize| is(tokens, *i, &["bedside"]) && is(tokens, i + 1, &["lamp", "lamps", "light"]);
    if let Some(at) = (0..tokens.len()).find(lamp) {
        tokens.splice(at..at + 2, ["lamp", "by", "the", "bed"].map(str::to_owned));
    }
}

/// Repeats the noun for two objects: "between the blue and the yellow picture" names two pictures.
fn repeat_shared_noun(tokens: &mut Vec<String>) {
    let is_color =
        |i: usize| matches!(meaning(tokens, i), Some(Meaning::Color(_) | Meaning::Trait(_)));
    let Some(and) = (2..tokens.len()).find(|&i| {
        tokens[i] == "and"
            && is_color(i - 1)
            && is_article(tokens, i - 2)
            && is_article(tokens, i + 1)
            && is_color(i + 2)
    }) else {
        return;
    };
    let words = run(tokens, and + 3);
    let Some(length) = longest_noun(&words).filter(|_| !words::is_anything(words[0])) else {
        return;
    };
    let noun: Vec<String> = tokens[and + 3..and + 3 + length].to_vec();
    let one = Lexicon::get()
        .find(&noun.join(" "))
        .map_or(noun, |found| found.name.split(' ').map(str::to_owned).collect());
    tokens.splice(and..and, one);
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::tokens::tokenize;

    #[test]
    fn clauses_that_do_not_describe_the_target_are_removed() {
        for (said, meant) in [
            ("has anybody seen my mug", "seen my mug"),
            ("where did my son drop his bag", "his bag"),
            ("where did i put my laptop", "put my laptop"),
            ("where has the post gone", "the post gone"),
            ("the grey chair, leave it by the door", "the grey chair ,"),
            (
                "somebody's bag by the sofa, can you see if my keys are in it",
                "somebody bag by the sofa ,",
            ),
            ("the grey chair, it is by the door", "the grey chair , it is by the door"),
            ("what the telly's stood on", "thing with the telly"),
            ("the bedside lamp on the left", "the lamp by the bed on the left"),
            ("be a dear and fetch my mug", "be a dear , fetch my mug"),
            ("my back hurts so i'll have the chair", "my back hurts , i'll have the chair"),
            (
                "the shelf with the books and vacuum around it",
                "the shelf with the books , vacuum around it",
            ),
            ("the shelf with the books and the lamp", "the shelf with the books and the lamp"),
            ("the mug i left by the lamp", "the mug i put by the lamp"),
            ("the lamp on the left", "the lamp on the left"),
            ("the taller plant, like a small palm", "the taller plant ,"),
            ("i'd like a chair", "i'd like a chair"),
            ("the lamp with the blue base needs a new bulb", "the lamp with the blue base"),
            ("look at that thing on the wall", "that thing on the wall"),
            ("look at the wall, the thing on the left", "look at the wall , the thing on the left"),
            (
                "go to the couch where the teddy bear is sitting",
                "go to the couch with the teddy bear",
            ),
            ("the sofa where is sitting the teddy bear", "the sofa with the teddy bear"),
            ("where is the teddy bear sitting", "where is the teddy bear sitting"),
            ("not the red cup by the laptop, the other red cup", "the other red cup"),
            (
                "between the blue and the yellow picture",
                "between the blue picture and the yellow picture",
            ),
            ("the blue and yellow picture", "the blue and yellow picture"),
        ] {
            let mut tokens = tokenize(said);
            rewrite(&mut tokens);
            assert_eq!(tokens.join(" "), meant, "{said}");
        }
    }
}
