//! Runs of words that make questions, and the objects between them.

use crate::RelationKind;
use crate::pieces::longest_noun;
use crate::tokens::BREAK;
use crate::words::{self, Meaning};
use uniground_models::attributes::Lexicon;

/// Politeness and commands before a question.
pub(super) const LEADS: [&str; 38] = [
    "please",
    "hey",
    "robot",
    "hi",
    "hello",
    "ok",
    "okay",
    "and",
    "so",
    "then",
    "now",
    "can you please tell me",
    "can you tell me",
    "could you please tell me",
    "could you tell me",
    "can you say",
    "please tell me",
    "tell me",
    "do you know",
    "i want to know",
    "i would like to know",
    "i'd like to know",
    "i need to know",
    "i wonder",
    "let me know",
    "check",
    "check if",
    "check whether",
    "could you check if",
    "can you check if",
    "if",
    "whether",
    "exactly",
    "roughly",
    "about",
    "approximately",
    "around",
    "any idea",
];

/// Words after a question that say nothing about the object.
pub(super) const TAILS: [&str; 29] = [
    "in the whole room",
    "in the entire room",
    "in the room",
    "in total",
    "altogether",
    "please",
    "exactly",
    "right now",
    "now",
    "at the moment",
    "somewhere",
    "anywhere",
    "in here",
    "around here",
    "lying around",
    "in this room",
    "in this bedroom",
    "in this kitchen",
    "in this living room",
    "in this apartment",
    "in this office",
    "in this place",
    "without moving anything",
    "without moving things",
    "do we have",
    "do we own",
    "do you see",
    "can you see",
    "do you think",
];

/// Verbs and participles that place an object.
pub(super) const PLACED: [&str; 28] = [
    "being",
    "around",
    "standing",
    "sitting",
    "lying",
    "laying",
    "hanging",
    "placed",
    "located",
    "stored",
    "kept",
    "resting",
    "left",
    "put",
    "stacked",
    "mounted",
    "positioned",
    "situated",
    "directly",
    "right",
    "just",
    "stands",
    "sits",
    "lies",
    "hangs",
    "rests",
    "currently",
    "there",
];

/// Words that say of how many objects something is claimed.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Quantifier {
    /// "all", "every", "both"
    All,
    /// "none of"
    None,
}

impl Quantifier {
    /// Splits a quantifier off the beginning of the words for an object: "all of the chairs are"
    /// leaves "the chairs are".
    pub fn split<'b>(words: &[&'b str]) -> (Option<Self>, Vec<&'b str>) {
        const ALL: [&str; 10] = [
            "all of the",
            "each of the",
            "each one of the",
            "every one of the",
            "both of the",
            "all the",
            "both the",
            "all of my",
            "all my",
            "both my",
        ];
        const BARE: [&str; 6] = ["all of these", "all these", "all", "every", "each", "both"];
        const NONE: [&str; 3] = ["none of the", "none of my", "no"];
        let with_the = |rest: &[&'b str]| ["the"].into_iter().chain(rest.iter().copied()).collect();
        let found = |runs: &[&str], quantifier| {
            let rest = after(words, runs).filter(|rest| !rest.is_empty())?;
            Some((Some(quantifier), with_the(rest)))
        };
        found(&ALL, Self::All)
            .or_else(|| found(&NONE, Self::None))
            .or_else(|| found(&BARE, Self::All))
            .unwrap_or_else(|| (None, words.to_vec()))
    }
}

/// Returns what follows the first of some runs of words with which `words` begin.
pub(super) fn after<'a, 'b>(words: &'a [&'b str], runs: &[&str]) -> Option<&'a [&'b str]> {
    runs.iter().find_map(|run| {
        let length = run.split(' ').count();
        let begins = words.get(..length)?.iter().copied().eq(run.split(' '));
        begins.then(|| &words[length..])
    })
}

/// Returns what precedes the first of some runs of words with which `words` end.
pub(super) fn before<'a, 'b>(words: &'a [&'b str], runs: &[&str]) -> Option<&'a [&'b str]> {
    runs.iter().find_map(|run| {
        let rest = words.len().checked_sub(run.split(' ').count())?;
        let ends = words[rest..].iter().copied().eq(run.split(' '));
        ends.then(|| &words[..rest])
    })
}

pub(super) fn is_one_of(word: Option<&&str>, words: &[&str]) -> bool {
    word.is_some_and(|word| words.contains(word))
}

pub(super) fn owned(words: &[&str]) -> Vec<String> {
    words.iter().map(|word| (*word).to_owned()).collect()
}

/// Removes a second question about the same objects: "…, and where?", "…, and what color is each
/// one". Answers give places and colors anyway.
pub(super) fn without_second_question<'b>(words: &[&'b str]) -> Vec<&'b str> {
    const SECOND: [&[&str]; 9] = [
        &["and", "if", "so"],
        &["and", "where"],
        &["and", "what", "color"],
        &["and", "what", "colour"],
        &["and", "which", "color"],
        &["and", "what", "are", "they"],
        &["and", "how", "big"],
        &["where", "each"],
        &["and", "which"],
    ];
    let at = (2..words.len()).find(|&i| SECOND.iter().any(|run| words[i..].starts_with(run)));
    let kept = &words[..at.unwrap_or(words.len())];
    kept.strip_suffix(&[BREAK]).unwrap_or(kept).to_vec()
}

/// Replaces "one" by a noun: "the green stool or the orange one".
pub(super) fn with_noun<'b>(words: &[&'b str], noun: &[&'b str]) -> Vec<&'b str> {
    let replaced = words
        .iter()
        .flat_map(|word| if matches!(*word, "one" | "ones") { noun.to_vec() } else { vec![*word] });
    replaced.collect()
}

/// Returns the noun of words that name an object: "the big silver fridge by the door" has "fridge".
pub(super) fn noun_of<'a, 'b>(words: &'a [&'b str]) -> Option<&'a [&'b str]> {
    let end = (1..words.len()).find(|&i| is_place(&words[i..])).unwrap_or(words.len());
    let start = (0..end).find(|&i| {
        longest_noun(&words[i..end]) == Some(end - i) && !words::is_anything(words[i])
    })?;
    Some(&words[start..end])
}

/// Gives both objects of a pair their noun: "the green stool and the orange one", "the green and
/// the purple beanbag".
pub(super) fn pair_with_nouns<'b>(
    first: &[&'b str],
    second: &[&'b str],
) -> (Vec<&'b str>, Vec<&'b str>) {
    let is_bare = |words: &[&str]| {
        noun_of(words).is_none()
            && words.iter().all(|word| {
                is_article(word)
                    || matches!(
                        words::longest_match(&[word]),
                        Some((Meaning::Color(_) | Meaning::Trait(_), 1))
                    )
            })
    };
    match (noun_of(first), noun_of(second)) {
        (Some(noun), None) => (first.to_vec(), with_noun(second, noun)),
        (None, Some(noun)) if is_bare(first) => ([first, noun].concat(), second.to_vec()),
        (None, Some(noun)) => (with_noun(first, noun), second.to_vec()),
        _ => (first.to_vec(), second.to_vec()),
    }
}

/// Splits at the last occurrence of a word.
pub(super) fn split_last<'a, 'b>(
    words: &'a [&'b str],
    at: &str,
) -> Option<(&'a [&'b str], &'a [&'b str])> {
    let i = words.iter().rposition(|word| *word == at)?;
    (i > 0 && i + 1 < words.len()).then(|| (&words[..i], &words[i + 1..]))
}

/// Splits "the sofa and the lamp" at the "and" between the two objects.
pub(super) fn split_pair<'a, 'b>(
    words: &'a [&'b str],
    at: &str,
) -> Option<(&'a [&'b str], &'a [&'b str])> {
    let ands = || (1..words.len().saturating_sub(1)).filter(|&i| words[i] == at);
    let before_article = ands().find(|&i| is_article(words[i + 1]));
    let i = before_article.or_else(|| ands().next())?;
    Some((&words[..i], &words[i + 1..]))
}

pub(super) fn is_article(word: &str) -> bool {
    word.starts_with('#')
        || matches!(words::longest_match(&[word]), Some((Meaning::Determiner, 1)))
        || matches!(word, "it" | "this" | "that" | "them")
}

/// Returns whether words begin with a place: "on the desk", "next to the sofa".
pub(crate) fn is_place(words: &[&str]) -> bool {
    matches!(
        words::longest_match(words),
        Some((
            Meaning::Relation(_)
                | Meaning::Superlative(
                    crate::Measure::Leftmost
                        | crate::Measure::Rightmost
                        | crate::Measure::Frontmost
                        | crate::Measure::Backmost
                        | crate::Measure::Middle
                )
                | Meaning::Side(_),
            _
        ))
    ) || words.first() == Some(&"to") && is_one_of(words.get(1), &["the", "its", "my", "your"])
}

/// Returns whether words begin with "closest to", "farthest from" and the like.
pub(super) fn is_comparing_place(words: &[&str]) -> bool {
    matches!(
        words::longest_match(words),
        Some((Meaning::Relation(RelationKind::Closest | RelationKind::Farthest), _))
    )
}

/// Returns whether the last word of a phrase is a plural noun of the lexicon.
pub(super) fn is_plural(words: &[&str]) -> bool {
    words
        .last()
        .is_some_and(|word| Lexicon::get().is_plural(word) || crate::instances_in(word).is_some())
}

/// Removes words before an object that say only how it is there.
pub(super) fn skip_placed<'a, 'b>(mut words: &'a [&'b str]) -> &'a [&'b str] {
    while is_one_of(words.first(), &PLACED) && words.len() > 1 {
        words = &words[1..];
    }
    words
}

/// Writes out the contractions with which a question begins: "what's" is "what is".
pub(super) fn expand_contractions(tokens: &mut Vec<String>) {
    const FORMS: [(&str, &str); 20] = [
        ("what's", "what is"),
        ("whats", "what is"),
        ("where's", "where is"),
        ("wheres", "where is"),
        ("where'd", "where did"),
        ("what'd", "what did"),
        ("how's", "how is"),
        ("which's", "which is"),
        ("one's", "one is"),
        ("isn't", "is not"),
        ("isnt", "is not"),
        ("aren't", "are not"),
        ("doesn't", "does not"),
        ("doesnt", "does not"),
        ("whatre", "what are"),
        ("what're", "what are"),
        ("where're", "where are"),
        ("theres", "there is"),
        ("there's", "there is"),
        ("that's", "that is"),
    ];
    // Elsewhere in a sentence, the grammar's own tables know the contractions.
    let starts: Vec<usize> = std::iter::once(0)
        .chain((1..tokens.len()).filter(|&i| tokens[i - 1] == BREAK))
        .rev()
        .collect();
    for start in starts {
        let asks = tokens.get(start).is_some_and(|word| {
            matches!(word.as_str(), "which" | "tell" | "show" | "list" | "everything" | "all")
        });
        // "which one's closer", "tell me everything that's on the desk"
        let end = if asks { (start + 5).min(tokens.len()) } else { (start + 1).min(tokens.len()) };
        for i in (start..end).rev() {
            if let Some((_, full)) = FORMS.iter().find(|(short, _)| *short == tokens[i]) {
                tokens.splice(i..=i, full.split(' ').map(str::to_owned));
            }
        }
    }
}

/// Splits "everything on the desk except the laptop". Returns the words before, and those of the
/// exception.
pub(super) fn split_exceptions(tokens: &[String]) -> (Vec<String>, Option<Vec<String>>) {
    const WORDS: [&[&str]; 10] = [
        &["except", "for"],
        &["except"],
        &["apart", "from"],
        &["aside", "from"],
        &["excluding"],
        &["besides"],
        &["other", "than"],
        &["but", "not"],
        &["not", "counting"],
        &["without", "counting"],
    ];
    let words: Vec<&str> = tokens.iter().map(String::as_str).collect();
    // "apart from the doormat, which rugs are there"
    let leads = WORDS.iter().find(|run| words.starts_with(run)).map(|run| run.len());
    let pause = words.iter().position(|word| *word == BREAK);
    if let (Some(start), Some(pause)) = (leads, pause)
        && start < pause
        && asks_for_several(&words[pause + 1..])
    {
        return (owned(&words[pause + 1..]), Some(owned(&words[start..pause])));
    }
    let found = (1..words.len()).find_map(|i| {
        let run = WORDS.iter().find(|run| words[i..].starts_with(run))?;
        Some((i, run.len()))
    });
    match found.filter(|&(at, length)| asks_for_several(&words) && at + length < words.len()) {
        Some((at, length)) => {
            let before = words[..at].strip_suffix(&[BREAK]).unwrap_or(&words[..at]);
            (owned(before), Some(owned(&words[at + length..])))
        }
        None => (tokens.to_vec(), None),
    }
}

/// Returns whether words ask for several objects, of which some may be left out.
fn asks_for_several(words: &[&str]) -> bool {
    words.first().is_some_and(|first| {
        matches!(
            *first,
            "everything" | "all" | "list" | "what" | "which" | "show" | "how" | "name" | "anything"
        ) || *first == "is" && words.iter().any(|word| matches!(*word, "anything" | "something"))
    })
}

pub(super) fn skip_trailing_placed<'a, 'b>(mut words: &'a [&'b str]) -> &'a [&'b str] {
    while words.len() > 1 && PLACED.contains(&words[words.len() - 1]) {
        words = &words[..words.len() - 1];
    }
    words
}

/// Returns a noun in singular, if the lexicon knows it.
pub(crate) fn singular(noun: &str) -> &str {
    let known = Lexicon::get().find(noun).filter(|_| Lexicon::get().is_plural(noun));
    known.map_or(noun, |known| &known.name)
}
