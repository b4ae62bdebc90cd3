//! Restates questions whose words refer to each other, so that the patterns of forms match: "the
//! yellow toaster, what is next to it" asks what is next to the yellow toaster.

use super::words::{after, is_article, is_place, owned};
use crate::pieces::longest_noun;
use crate::tokens::BREAK;

/// How a question begins that goes on about an object named before.
const ASKS: [&str; 9] = ["what", "how", "is", "are", "which", "where", "describe", "does", "can"];

/// Replaces "it" by the object that the words before the question name: "the yellow toaster, what
/// is next to it".
pub(super) fn refer_to_named_object(tokens: &mut Vec<String>) {
    let Some(end) = tokens.iter().position(|token| token == BREAK) else { return };
    let words: Vec<&str> = tokens.iter().map(String::as_str).collect();
    let (named, question) = (&words[..end], &words[end + 1..]);
    let is_object = named.first().is_some_and(|word| is_article(word))
        && !named.iter().any(|word| matches!(*word, "is" | "are" | "has" | "have"))
        && (1..named.len()).any(|i| longest_noun(&named[i..]).is_some());
    let asks = question.first().is_some_and(|word| ASKS.contains(word));
    let Some(it) = question.iter().position(|word| *word == "it").filter(|_| is_object && asks)
    else {
        return;
    };
    // "the table, is the lamp on it" and "the table, what is the lamp on it for" name two objects.
    if (0..it).any(|i| longest_noun(&question[i..it]).is_some()) {
        return;
    }
    *tokens = [owned(&question[..it]), owned(named), owned(&question[it + 1..])].concat();
}

/// Puts the purpose that the sentence before gives into the question: "I'd like to make toast, is
/// there something for that" asks for something to make toast.
pub(super) fn use_purpose_before(tokens: &mut Vec<String>) {
    let Some(end) = tokens.iter().position(|token| token == BREAK) else { return };
    let words: Vec<&str> = tokens.iter().map(String::as_str).collect();
    let Some(purpose) = after(
        &words[..end],
        &[
            "i would like to",
            "i'd like to",
            "i want to",
            "i need to",
            "i have to",
            "i am going to",
            "i'm going to",
            "we would like to",
            "we'd like to",
            "we want to",
            "we need to",
            "we have to",
        ],
    )
    .filter(|purpose| !purpose.is_empty()) else {
        return;
    };
    let question = words[end + 1..].strip_suffix(&[BREAK]).unwrap_or(&words[end + 1..]);
    let Some(asked) = [
        &["for", "that"][..],
        &["for", "this"],
        &["for", "it"],
        &["to", "do", "that"],
        &["to", "do", "it"],
        &["to", "do", "that", "with"],
        &["to", "do", "it", "with"],
    ]
    .into_iter()
    .find_map(|run| question.strip_suffix(run)) else {
        return;
    };
    // "is there something here"
    let asked = asked.strip_suffix(&["here"]).unwrap_or(asked);
    *tokens = [owned(asked), owned(&["to"]), owned(purpose)].concat();
}

/// Measures distances from an object where the question names its edge: "the distance from the door
/// to the nearest edge of the rug". Distances are those between the nearest sides.
pub(super) fn measure_from_objects(tokens: &mut Vec<String>) {
    const EDGES: [&str; 7] = ["edge", "rim", "border", "side", "surface", "end", "point"];
    let measures = tokens.iter().any(|word| matches!(word.as_str(), "distance" | "far" | "gap"));
    if !measures {
        return;
    }
    let mut i = 0;
    while i < tokens.len() {
        let at = |k: usize| tokens.get(i + k).map_or("", String::as_str);
        let article = usize::from(at(0) == "the");
        let nearest = usize::from(matches!(at(article), "nearest" | "closest" | "near" | "nearer"));
        let edge = article + nearest;
        // Without "nearest", only words that mean the outline.
        let is_outline = EDGES.contains(&at(edge)) && (nearest == 1 || at(edge) != "end");
        if is_outline && at(edge + 1) == "of" {
            tokens.drain(i..i + edge + 2);
        }
        i += 1;
    }
}

/// Rewrites "on the same desk as the laptop" to "on the desk with the laptop".
pub(super) fn rewrite_same_as(tokens: &mut Vec<String>) {
    let words: Vec<&str> = tokens.iter().map(String::as_str).collect();
    let found = (1..words.len()).find_map(|i| {
        let noun = longest_noun(&words[i + 1..]).filter(|_| words[i - 1..=i] == ["the", "same"])?;
        (words.get(i + 1 + noun) == Some(&"as")).then_some((i, i + 1 + noun))
    });
    if let Some((same, as_)) = found {
        "with".clone_into(&mut tokens[as_]);
        tokens.remove(same);
    }
}

/// Drops "pieces of" before what is counted or listed, and an enumeration of what belongs to it:
/// "how many pieces of furniture are there: chairs, tables, all of it".
pub(super) fn count_pieces(tokens: &mut Vec<String>) {
    let words: Vec<&str> = tokens.iter().map(String::as_str).collect();
    let Some(at) = (1..words.len().saturating_sub(2))
        .find(|&i| matches!(words[i], "pieces" | "piece" | "items") && words[i + 1] == "of")
    else {
        return;
    };
    let lists = words[..at].ends_with(&["many"]) || words[..at].ends_with(&["all", "the"]);
    let end = words.iter().position(|word| *word == BREAK).filter(|end| *end > at);
    if !lists || is_place(&words[at + 2..]) {
        return;
    }
    if let Some(end) = end {
        tokens.truncate(end);
    }
    tokens.drain(at..at + 2);
    if tokens[at] == "seating" {
        "seats".clone_into(&mut tokens[at]);
    }
}

#[cfg(test)]
mod tests {
    use super::super::Form;
    use crate::{RelationKind, parse};

    #[test]
    fn pronouns_mean_the_object_named_before_the_question() {
        for (said, meant) in [
            (
                "the yellow toaster, what is standing next to it?",
                "what is next to the yellow toaster",
            ),
            ("The sofa, how wide is it?", "how wide is the sofa"),
        ] {
            let (said, meant) = (parse(said), parse(meant));
            assert_eq!((&said.form, &said.target), (&meant.form, &meant.target));
        }
    }

    #[test]
    fn purposes_are_taken_from_the_sentence_before() {
        let asked = parse("I'd like to make some toast, is there something here for that?");
        assert_eq!(asked.form, Form::Exists);
        assert_eq!(asked.target.uses, ["toast bread"]);
    }

    #[test]
    fn distances_to_edges_are_those_to_objects() {
        let said = parse("distance from the door to the nearest edge of the red rug");
        assert_eq!(said, parse("distance from the door to the red rug"));
    }

    #[test]
    fn the_same_support_is_the_one_with_the_other_object() {
        let said = parse("is the stapler on the same desk as the laptop?").target;
        let [on] = &said.relations[..] else { panic!("{said:?}") };
        assert_eq!(on.kind, RelationKind::On);
        assert_eq!(on.anchors[0].head, "desk");
        assert_eq!(on.anchors[0].with[0].phrase.head, "laptop");
    }

    #[test]
    fn pieces_of_a_kind_are_counted() {
        let said = parse("how many pieces of furniture are there: chairs, sofas, all of it?");
        assert_eq!((said.form, said.target.head.as_str()), (Form::Count, "furniture"));
        let seats = parse("how many pieces of seating are there?");
        assert_eq!(seats, parse("how many seats are there?"));
    }
}
