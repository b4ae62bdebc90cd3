//! Rewrites different wordings to the one that the tables have.

use super::pieces::longest_noun;
use super::sides;
use super::tokens::{BREAK, correct_small_word};
use super::words::{self, Meaning};
use super::{affordances, clauses};
use uniground_models::attributes::Lexicon;

/// Rewrites a query's words.
pub(super) fn rewrite(mut tokens: Vec<String>) -> Vec<String> {
    correct_slips(&mut tokens);
    clauses::rewrite(&mut tokens);
    rewrite_its(&mut tokens);
    rewrite_of_several(&mut tokens);
    rewrite_one_for(&mut tokens);
    rewrite_thing_you_use(&mut tokens);
    clauses::remove_use_clause(&mut tokens);
    rewrite_which_is(&mut tokens);
    rewrite_stranded_preposition(&mut tokens);
    remove_intensifiers(&mut tokens);
    remove_over(&mut tokens);
    remove_circumstances(&mut tokens);
    remove_owner_of_count(&mut tokens);
    rewrite_nearest_place(&mut tokens);
    remove_choice_of_sides(&mut tokens);
    rewrite_on_parts(&mut tokens);
    join_purposes(&mut tokens);
    remove_leading_verb(&mut tokens);
    rewrite_in_front_of_me(&mut tokens);
    sides::rewrite(&mut tokens);
    rewrite_shades(&mut tokens);
    tokens
}

/// Corrects misspelled function words and contractions: "somethng", "theres".
fn correct_slips(tokens: &mut Vec<String>) {
    const LEFT_OUT: [(&str, &str); 17] = [
        ("u", "you"),
        ("ur", "your"),
        ("thru", "through"),
        ("pls", "please"),
        ("theres", "there's"),
        ("thats", "that's"),
        ("youre", "you're"),
        ("im", "i'm"),
        ("whats", "what's"),
        ("wheres", "where's"),
        ("isnt", "isn't"),
        ("id", "i'd"),
        ("cant", "can't"),
        ("dont", "don't"),
        ("wont", "won't"),
        ("infront", "in front"),
        ("ontop", "on top"),
    ];
    // "the the"
    tokens.dedup_by(|a, b| a == b && a != BREAK);
    for token in tokens.iter_mut() {
        let meant = LEFT_OUT.iter().find(|(slip, _)| slip == token).map(|(_, meant)| *meant);
        if let Some(meant) = meant.or_else(|| correct_small_word(token)) {
            meant.clone_into(token);
        }
    }
    for i in 1..tokens.len() {
        // "closes to the door", "it's got"
        match (tokens[i - 1].as_str(), tokens[i].as_str()) {
            ("closes" | "closet", "to") => "closest".clone_into(&mut tokens[i - 1]),
            ("it's" | "that's" | "it" | "that", "got") => "has".clone_into(&mut tokens[i]),
            // "the fridge whose doors are wide"
            (thing, "whose") if longest_noun(&[thing]).is_some() => {
                "with".clone_into(&mut tokens[i]);
            }
            (thing, "got") if longest_noun(&[thing]).is_some() => "has".clone_into(&mut tokens[i]),
            _ => {}
        }
    }
    *tokens = tokens.iter().flat_map(|token| token.split(' ')).map(str::to_owned).collect();
}

/// Rewrites "which sofa is the teddy sitting on" to "sofa with the teddy".
fn rewrite_which_is(tokens: &mut Vec<String>) {
    let end = tokens.iter().position(|t| t == BREAK).unwrap_or(tokens.len());
    let is_verb = |i: &usize| matches!(tokens[*i].as_str(), "is" | "are");
    let (Some(verb), true) = (
        (1..end).find(is_verb),
        tokens.first().is_some_and(|t| matches!(t.as_str(), "which" | "what")),
    ) else {
        return;
    };
    // "which beanbag is the ball next to"
    for words in [["next", "to"], ["close", "to"], ["closest", "to"], ["nearest", "to"]] {
        if verb > 1 && end > verb + 3 && tokens[end - 2..end] == words {
            tokens.drain(end - 2..end);
            tokens.splice(verb..=verb, words.map(str::to_owned));
            return;
        }
    }
    let carries = end > verb + 2
        && matches!(tokens[end - 1].as_str(), "on" | "in" | "under" | "at")
        && verb > 1;
    if carries {
        let last = if tokens[end - 2].ends_with("ing") { end - 2 } else { end - 1 };
        tokens.drain(last..end);
        "with".clone_into(&mut tokens[verb]);
    }
}

/// Rewrites "the seat that a teddy has been put on" to "the seat with a teddy", and "the table the
/// bin stands under" to "the table above the bin".
fn rewrite_stranded_preposition(tokens: &mut Vec<String>) {
    const INVERSE: [(&[&str], &str); 16] = [
        (&["on", "top", "of"], "with"),
        (&["in", "front", "of"], "behind"),
        (&["next", "to"], "next to"),
        (&["close", "to"], "next to"),
        (&["on"], "with"),
        (&["in"], "with"),
        (&["inside"], "with"),
        (&["under"], "above"),
        (&["underneath"], "above"),
        (&["beneath"], "above"),
        (&["above"], "below"),
        (&["behind"], "in front of"),
        (&["beside"], "next to"),
        (&["by"], "next to"),
        (&["near"], "next to"),
        (&["against"], "next to"),
    ];
    /// Maximum number of verbs: "has been put", "is now lying".
    const MOST_VERBS: usize = 4;
    let mut end = tokens.len();
    while end > 0 {
        let start = tokens[..end].iter().rposition(|token| token == BREAK).map_or(0, |at| at + 1);
        let clause: Vec<&str> = tokens[start..end].iter().map(String::as_str).collect();
        let told = INVERSE.iter().find(|(words, _)| clause.ends_with(words));
        let found = told.and_then(|(words, inverse)| {
            let stop = clause.len() - words.len();
            let (that, thing) = (0..stop).find_map(|i| relative_clause(&clause[..stop], i))?;
            let verbs = (thing + 2..stop)
                .find(|&i| is_verb_of_place(clause[i]) && clause[i - 1] != "to")?;
            (stop - verbs <= MOST_VERBS).then_some((that, thing, verbs, *inverse))
        });
        if let Some((that, thing, verbs, inverse)) = found {
            tokens.drain(start + verbs..end);
            tokens.splice(start + that..start + thing, inverse.split(' ').map(str::to_owned));
        }
        end = start.saturating_sub(1);
    }
}

/// Returns where a clause about the noun at an index begins, and the article of the object it
/// mentions: "the desk [that] [the] printer is on".
fn relative_clause(clause: &[&str], i: usize) -> Option<(usize, usize)> {
    let that = i + longest_noun(&clause[i..])?;
    let thing = that + usize::from(matches!(clause.get(that), Some(&("that" | "which"))));
    let is_article =
        matches!(words::longest_match(clause.get(thing..=thing)?), Some((Meaning::Determiner, 1)));
    is_article.then_some((that, thing))
}

/// Returns whether a word is part of a verb of place: "is", "has been put", "lies".
fn is_verb_of_place(word: &str) -> bool {
    const PLACED: [&str; 27] = [
        "is", "are", "was", "were", "has", "have", "had", "got", "gets", "sits", "sit", "stands",
        "stand", "lies", "lie", "hangs", "hang", "rests", "rest", "leans", "lean", "sleeps",
        "lives", "goes", "sat", "stood", "lay",
    ];
    PLACED.contains(&word)
        || word.len() > 5 && word.ends_with("ing") && !Lexicon::get().is_known(word)
}

/// Rewrites "its the one by the door" to "it's the one by the door".
fn rewrite_its(tokens: &mut [String]) {
    for i in 1..tokens.len() {
        let follows = matches!(
            words::longest_match(&[&tokens[i]]),
            Some((Meaning::Determiner | Meaning::Relation(_), _))
        );
        if tokens[i - 1] == "its" && follows {
            "it's".clone_into(&mut tokens[i - 1]);
        }
    }
}

/// Rewrites "the green thing you make toast with" to "something green to make toast with".
fn rewrite_thing_you_use(tokens: &mut Vec<String>) {
    let word = |i: usize| tokens.get(i).map_or("", String::as_str);
    let is_thing =
        |i: &usize| matches!(word(*i), "thing" | "one" | "object" | "item" | "device" | "machine");
    let Some(thing) = (1..tokens.len().min(7)).find(is_thing) else { return };
    let that = usize::from(matches!(word(thing + 1), "that" | "which"));
    let people = matches!(
        word(thing + that + 1),
        "you" | "people" | "they" | "one" | "someone" | "somebody" | "we"
    );
    let may = usize::from(matches!(
        word(thing + that + 2),
        "would" | "could" | "can" | "might" | "usually" | "normally" | "just"
    ));
    let verb = word(thing + that + 2 + may);
    let meaning = |i: usize| words::longest_match(&[word(i)]).map(|(meaning, _)| meaning);
    let describes = |i: usize| match meaning(i) {
        Some(meaning) => matches!(
            meaning,
            Meaning::Color(_) | Meaning::Trait(_) | Meaning::Determiner | Meaning::Filler
        ),
        None => !Lexicon::get().is_known(word(i)),
    };
    if people && affordances::is_verb_of_a_use(verb) && (0..thing).all(describes) {
        let described = (0..thing).filter(|&i| meaning(i) != Some(Meaning::Determiner)).map(word);
        let new: Vec<String> =
            ["something"].into_iter().chain(described).chain(["to"]).map(str::to_owned).collect();
        tokens.splice(..thing + that + 2 + may, new);
    }
}

/// Rewrites "the bright one, for sitting" to "something bright to sit".
fn rewrite_one_for(tokens: &mut Vec<String>) {
    let word = |i: usize| tokens.get(i).map_or("", String::as_str);
    let Some(one) = (0..tokens.len()).find(|&i| matches!(word(i), "one" | "thing" | "something"))
    else {
        return;
    };
    let at = one + 1 + usize::from(word(one + 1) == BREAK);
    let verb = word(at + 1).to_owned();
    let described =
        (0..one).all(|i| !Lexicon::get().is_known(word(i)) && word(i) != BREAK && word(i) != "no");
    if word(at) == "for"
        && verb.ends_with("ing")
        && affordances::is_verb_of_a_use(&verb)
        && described
    {
        let before: Vec<String> = tokens.drain(..=at).take(one).collect();
        let describing = before.into_iter().filter(|word| {
            !matches!(
                words::longest_match(&[word]),
                Some((Meaning::Determiner | Meaning::Filler, _))
            )
        });
        let new: Vec<String> = std::iter::once("something".to_owned())
            .chain(describing)
            .chain(["to".to_owned()])
            .collect();
        tokens.splice(..0, new);
    }
}

/// Rewrites "of the green chairs, the one by the door" to "the green chair by the door".
fn rewrite_of_several(tokens: &mut Vec<String>) {
    let word = |i: usize| tokens.get(i).map_or("", String::as_str);
    let begins = match (word(0), word(1)) {
        ("out", "of") => 2,
        ("of" | "among" | "amongst", _) => 1,
        _ => return,
    };
    let Some(pause) = tokens.iter().position(|token| token == BREAK) else { return };
    let one = (pause + 1..tokens.len()).find(|&i| word(i) == "one").filter(|one| *one <= pause + 4);
    let plural =
        Lexicon::get().find(word(pause - 1)).filter(|_| Lexicon::get().is_plural(word(pause - 1)));
    let (Some(one), Some(noun)) = (one, plural) else { return };
    let counted = |word: &&String| {
        matches!(
            words::longest_match(&[word]),
            Some((Meaning::Determiner | Meaning::Number(_) | Meaning::All, _))
        )
    };
    let described = tokens[begins..pause - 1].iter().skip_while(counted).cloned();
    let new: Vec<String> = described.chain(noun.name.split(' ').map(str::to_owned)).collect();
    tokens.splice(one..=one, new);
    tokens.drain(..=pause);
}

/// Removes "over" before a place: "over on my left".
fn remove_over(tokens: &mut Vec<String>) {
    let mut i = 0;
    while i + 1 < tokens.len() {
        let near = matches!(
            tokens[i + 1].as_str(),
            "on" | "in" | "at" | "by" | "near" | "next" | "there" | "here" | "against"
        );
        if tokens[i] == "over" && near {
            tokens.remove(i);
        } else {
            i += 1;
        }
    }
}

/// Removes clauses about when and why the target is needed, because they do not distinguish it:
/// "put the board away before somebody slips on it".
fn remove_circumstances(tokens: &mut Vec<String>) {
    const SUBJECTS: [&str; 13] = [
        "somebody", "someone", "anybody", "anyone", "i", "we", "it", "they", "he", "she", "people",
        "i'm", "you",
    ];
    let begins = |i: &usize| {
        matches!(
            tokens[*i].as_str(),
            "before" | "because" | "since" | "until" | "till" | "cause" | "cos"
        ) && tokens.get(i + 1).is_some_and(|next| SUBJECTS.contains(&next.as_str()))
    };
    if let Some(start) = (1..tokens.len()).find(begins) {
        let end = (start..tokens.len()).find(|&i| tokens[i] == BREAK).unwrap_or(tokens.len());
        tokens.drain(start..end);
    }
}

/// Removes intensifiers of a side: "at the very left", "all the way to the right".
fn remove_intensifiers(tokens: &mut Vec<String>) {
    let is_side =
        |word: &str| matches!(word, "left" | "right" | "top" | "bottom" | "front" | "back" | "end");
    let mut i = 0;
    while i + 1 < tokens.len() {
        if matches!(tokens[i].as_str(), "very" | "extreme" | "absolute") && is_side(&tokens[i + 1])
        {
            tokens.remove(i);
        }
        if tokens[i..].iter().map(String::as_str).take(3).eq(["all", "the", "way"]) {
            tokens.drain(i..i + 3);
        }
        i += 1;
    }
}

/// Removes the owner from "how many lamps do we have here".
fn remove_owner_of_count(tokens: &mut Vec<String>) {
    let asks = tokens.windows(2).position(|pair| pair[0] == "how" && pair[1] == "many");
    let Some(start) = asks else { return };
    let word = |i: usize| tokens.get(i).map_or("", String::as_str);
    let whose = (start..tokens.len()).find(|&i| {
        matches!(word(i), "do" | "does" | "did" | "can" | "have")
            && matches!(word(i + 1), "i" | "we" | "you" | "they" | "people" | "one")
    });
    if let Some(i) = whose {
        let verbs = usize::from(matches!(
            word(i + 2),
            "have" | "see" | "own" | "find" | "count" | "got" | "keep"
        ));
        tokens.drain(i..i + 2 + verbs);
    }
}

/// Rewrites "the nearest place to sit when you come in" to "something to sit, the nearest, when you
/// come in".
fn rewrite_nearest_place(tokens: &mut Vec<String>) {
    let word = |i: usize| tokens.get(i).map_or("", String::as_str);
    let begins = |&i: &usize| {
        matches!(word(i), "nearest" | "closest")
            && matches!(word(i + 1), "place" | "spot" | "thing")
            && matches!(word(i + 2), "to" | "where" | "i" | "you" | "we")
    };
    let Some(start) = (0..tokens.len()).find(begins) else { return };
    let nearest = word(start).to_owned();
    let is_end = |&i: &usize| matches!(word(i), BREAK | "when" | "while" | "if" | "from" | "as");
    let end = (start + 3..tokens.len()).find(is_end).unwrap_or(tokens.len());
    let from = if start > 0 && word(start - 1) == "the" { start - 1 } else { start };
    tokens.splice(end..end, [BREAK.to_owned(), "the".to_owned(), nearest]);
    tokens.splice(from..start + 2, ["something".to_owned()]);
}

/// Removes a choice of sides: "is the desk on the left or the right?" gives no side.
fn remove_choice_of_sides(tokens: &mut Vec<String>) {
    let small = |word: &str| matches!(word, "on" | "to" | "at" | "the" | "my" | "your");
    let Some(or) = (1..tokens.len().saturating_sub(1)).find(|&i| tokens[i] == "or") else { return };
    let (first, mut second) = (or - 1, or + 1);
    while second + 1 < tokens.len() && small(&tokens[second]) {
        second += 1;
    }
    let mut start = first;
    while start > 0 && small(&tokens[start - 1]) {
        start -= 1;
    }
    if matches!(
        (tokens[first].as_str(), tokens[second].as_str()),
        ("left", "right") | ("right", "left")
    ) {
        tokens.drain(start..=second);
    }
}

/// Rewrites "a chair on wheels" to a chair with wheels.
fn rewrite_on_parts(tokens: &mut [String]) {
    for i in 1..tokens.len() {
        if tokens[i - 1] == "on"
            && matches!(tokens[i].as_str(), "wheels" | "casters" | "castors" | "legs")
        {
            "with".clone_into(&mut tokens[i - 1]);
        }
    }
}

/// Joins the purpose of a named object to one word that cannot be checked: "a lamp for reading",
/// "the pot to brew tea in". Exception: the two together are an object's name ("tea pot").
fn join_purposes(tokens: &mut Vec<String>) {
    let lexicon = Lexicon::get();
    let mut i = 1;
    while i + 1 < tokens.len() {
        let to = usize::from(tokens[i] == "for" && tokens[i + 1] == "to");
        let verb = tokens.get(i + to + 1).map_or("", String::as_str);
        let said = tokens[i + to] == "to" && affordances::is_verb_of_a_use(verb)
            || tokens[i] == "for" && verb.ends_with("ing");
        let of_a_thing = lexicon.is_known(&tokens[i - 1])
            && !lexicon.is_known(verb)
            && words::longest_match(&[verb]).is_none();
        if !(said && of_a_thing) {
            i += 1;
            continue;
        }
        let ends = |word: &str| {
            word == BREAK
                || matches!(
                    words::longest_match(&[word]),
                    Some((Meaning::Relation(_) | Meaning::With { .. } | Meaning::And, _))
                )
        };
        let end = (i + to + 2..tokens.len()).find(|&k| ends(&tokens[k])).unwrap_or(tokens.len());
        let compound = tokens[i + to + 2..end]
            .iter()
            .map(|word| format!("{word} {}", tokens[i - 1]))
            .find(|name| lexicon.is_known(name) || lexicon.is_known(&name.replace(' ', "")));
        if let Some(name) = compound {
            let name = if lexicon.is_known(&name) { name } else { name.replace(' ', "") };
            tokens.splice(i - 1..end, name.split(' ').map(str::to_owned));
        } else {
            let purpose = tokens.drain(i..end).collect::<Vec<_>>().join(" ");
            tokens.insert(i, purpose);
        }
        i += 1;
    }
}

/// Removes the verb of a sentence without a subject: "The chair. Leans against the wall".
fn remove_leading_verb(tokens: &mut Vec<String>) {
    let is_verb = |word: &str| {
        word.len() > 3
            && word.ends_with('s')
            && words::longest_match(&[word]).is_none()
            && !Lexicon::get().is_known(word)
    };
    let relates = |word: &str| {
        matches!(
            words::longest_match(&[word]),
            Some((Meaning::Relation(_) | Meaning::With { .. }, _))
        )
    };
    let mut i = 1;
    while i + 1 < tokens.len() {
        if tokens[i - 1] == BREAK && is_verb(&tokens[i]) && relates(&tokens[i + 1]) {
            tokens.remove(i);
        }
        i += 1;
    }
}

/// Rewrites "with the window in front of me" to "when you face the window", and "with the door
/// behind me" to "with my back to the door".
fn rewrite_in_front_of_me(tokens: &mut Vec<String>) {
    const AHEAD: [&[&str]; 4] =
        [&["right", "in", "front", "of"], &["in", "front", "of"], &["ahead", "of"], &["before"]];
    const BEHIND: [&[&str]; 1] = [&["behind"]];
    let somebody = |word: Option<&String>| {
        word.is_some_and(|word| matches!(word.as_str(), "me" | "you" | "us"))
    };
    let Some(with) = tokens.iter().position(|token| token == "with") else { return };
    let end = (with..tokens.len()).find(|&i| tokens[i] == BREAK).unwrap_or(tokens.len());
    for (ways, meant) in [
        (&AHEAD[..], &["when", "you", "face"][..]),
        (&BEHIND[..], &["with", "my", "back", "to"][..]),
    ] {
        for words in ways {
            let told = |i: &usize| {
                tokens[*i..].iter().map(String::as_str).take(words.len()).eq(words.iter().copied())
            };
            if let Some(at) =
                (with + 2..end).find(told).filter(|at| somebody(tokens.get(at + words.len())))
            {
                tokens.splice(at..=at + words.len(), [BREAK.to_owned()]);
                tokens.splice(with..=with, meant.iter().map(|word| (*word).to_owned()));
                return;
            }
        }
    }
}

/// Rewrites "in green tones", "in shades of red", "in white" to the object's own color.
fn rewrite_shades(tokens: &mut Vec<String>) {
    const TONES: [&str; 12] = [
        "tone", "tones", "shade", "shades", "hue", "hues", "tint", "tints", "color", "colors",
        "colour", "colours",
    ];
    let color = |tokens: &[String], i: usize| {
        let run: Vec<&str> = tokens[i.min(tokens.len())..]
            .iter()
            .map(String::as_str)
            .take_while(|t| *t != BREAK)
            .collect();
        match words::longest_match(&run) {
            Some((Meaning::Color(_), length)) => Some(length),
            _ => None,
        }
    };
    let is_tone =
        |tokens: &[String], i: usize| tokens.get(i).is_some_and(|t| TONES.contains(&t.as_str()));
    let mut i = 0;
    while i < tokens.len() {
        if tokens[i] != "in" {
            i += 1;
            continue;
        }
        if is_tone(tokens, i + 1)
            && tokens.get(i + 2).is_some_and(|t| t == "of")
            && color(tokens, i + 3).is_some()
        {
            tokens.drain(i..i + 3);
            continue;
        }
        let mut end = i + 1;
        while let Some(length) = color(tokens, end) {
            end += length;
            if tokens.get(end).is_some_and(|t| t == "and") && color(tokens, end + 1).is_some() {
                end += 1;
            }
        }
        let ends_here = tokens.get(end).is_none_or(|t| t == BREAK || t == "and" || t == "with");
        if end > i + 1 && (is_tone(tokens, end) || ends_here) {
            if is_tone(tokens, end) {
                tokens.remove(end);
            }
            tokens.remove(i);
        }
        i += 1;
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::tokens::tokenize;

    #[test]
    fn different_wordings_are_rewritten_to_one_form() {
        for (said, meant) in [
            ("the picture in green tones", "the picture green"),
            ("the one in shades of red", "the one red"),
            ("the cushion in red and white", "the cushion red and white"),
            ("the mug in white cupboards", "the mug in white cupboards"),
            ("how many lamps do we have in here", "how many lamps in here"),
            ("which sofa is the teddy sitting on?", "which sofa with the teddy ,"),
            ("the photo at the very left", "the photo at the left"),
            ("the lamp all the way to the right", "the lamp to the right"),
            ("somethng to sit on, theres one", "something to sit on , there's one"),
            ("its the one near the door", "it's the one near the door"),
            (
                "is the desk on the left or the right, show me the desk",
                "is the desk , show me the desk",
            ),
            (
                "the nearest place to sit when you come in",
                "something to sit , the nearest when you come in",
            ),
            ("the red chair. Leans against the wall", "the red chair , against the wall"),
            ("with the window in front of me the lamp", "when you face the window , the lamp"),
            (
                "the lamp on the left with the door behind me",
                "the lamp on the left with my back to the door ,",
            ),
            ("the sofa with the table in front of it", "the sofa with the table in front of it"),
            ("the shiny thing you sit on", "something shiny to sit on"),
            ("the wooden thing you would climb on", "something wooden to climb on"),
            ("the seat a teddy has been put on", "the seat with a teddy"),
            ("the cabinet the printer is sitting on", "the cabinet with the printer"),
            (
                "the machine that the bread rolls are lying on top of, please",
                "the machine with the bread rolls , please",
            ),
            (
                "of the green slatted chairs, the one by the door",
                "the green slatted chair by the door",
            ),
            ("out of the three stools, the tallest one", "the tallest stool"),
            ("the bright orange plastic one, for sitting", "something orange plastic to sitting"),
            ("the lamp over on my left", "the lamp on my left"),
            ("the lamp over the table", "the lamp over the table"),
            ("put away the board before somebody slips on it", "put away the board"),
            ("the chair before the door", "the chair before the door"),
            ("the table the dog sleeps under", "the table above the dog"),
            (
                "the lamp next to the desk the bin stands behind",
                "the lamp next to the desk in front of the bin",
            ),
            ("the chair the boy likes to sit on", "the chair the boy likes to sit on"),
            ("the mug on the table that is on", "the mug on the table that is on"),
            ("the green thing you sit on", "something green to sit on"),
            ("the thing that people write with", "something to write with"),
            ("all the chairs on wheels", "all the chairs with wheels"),
            ("the pot for brewing tea on the shelf", "the tea pot on the shelf"),
            ("lamp for to read book next the sofa", "lamp|for to read book|next the sofa"),
            ("a lamp for reading", "a lamp|for reading"),
            ("the chair for the desk", "the chair for the desk"),
            ("its shade is orange", "its shade is orange"),
            ("it 's in the corner", "it's in the corner"),
            ("the table closes to the the door", "the table closest to the door"),
            ("it 's got a lamp ontop of it", "it's has a lamp on top of it"),
        ] {
            assert_eq!(rewrite(tokenize(said)).join(" "), meant.replace('|', " "), "{said}");
            // A token can have several words.
            if meant.contains('|') {
                assert!(
                    rewrite(tokenize(said))
                        .iter()
                        .any(|token| Some(token.as_str()) == meant.split('|').nth(1)),
                    "{said}"
                );
            }
        }
    }
}
