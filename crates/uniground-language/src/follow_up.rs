//! Follow-up questions: "and the blue one?", "how big is it?", "no, the other
//! one". They are rewritten to questions that stand alone, with ids for what they point at.

use super::forms::words::{is_place, singular};
use super::forms::{
    Aspect, Bound, Claim, ComparedBy, Comparison, Dimension, Form, Limit, Reference,
};
use super::pieces::longest_noun;
use super::tokens::{BREAK, tokenize};
use super::words;
use super::{Meaning, Phrase, parse};
use uniground_geometry::scene::InstanceId;
use uniground_models::attributes::Lexicon;

/// The answer that a follow-up question refers to.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Earlier {
    /// Its question, in a form that stands alone.
    pub query: String,
    /// The instance that was its answer.
    pub instance: Option<InstanceId>,
    /// The name of that instance.
    pub name: Option<String>,
    /// The other object that its question names.
    pub anchor: Option<InstanceId>,
    /// All instances that were its answer: "which of them are red".
    pub targets: Vec<InstanceId>,
}

/// Maximum number of instances that "them" stands for one by one.
const MOST_OF_THEM: usize = 100;

/// Words with which a question goes on.
const GOES_ON: [&[&str]; 9] = [
    &["and", "what", "about"],
    &["and", "how", "about"],
    &["what", "about"],
    &["how", "about"],
    &["and", "is", "there"],
    &["and"],
    &["no", BREAK],
    &["no"],
    &["not", "that", "one", BREAK],
];

/// Returns a question that needs no context. `selected` is the instance that "this" means. Returns
/// the question unchanged where it refers to nothing.
#[must_use]
pub fn resolve(query: &str, earlier: Option<&Earlier>, selected: Option<InstanceId>) -> String {
    let tokens = tokenize(query);
    let mut words: Vec<String> =
        tokens.strip_suffix(&[BREAK.to_owned()]).unwrap_or(&tokens).to_vec();
    let before = words.clone();
    let goes_on = GOES_ON.iter().find(|run| starts_with(&words, run)).filter(|_| earlier.is_some());
    let is_more_than_lead = |run: &&&[&str]| words.len() > run.len();
    let lead = goes_on.filter(is_more_than_lead).map_or(0, |run| run.len());
    let elliptic = lead > 0 && !is_question(&words[lead..]);
    words.drain(..lead);
    if let Some(earlier) = earlier {
        replace_group_pronouns(&mut words, earlier);
    }
    let noun = earlier.and_then(noun_of);
    if let Some(instance) = earlier.and_then(|earlier| earlier.instance)
        && let Some(noun) = &noun
        && let Some((start, end)) = other_one(&words, singular(noun))
    {
        words.splice(
            start..end,
            owned(&["the", singular(noun), "that", "is", "not", &reference(instance)]),
        );
    }
    if let Some(noun) = &noun {
        for i in 0..words.len() {
            let is_head = matches!(words[i].as_str(), "one" | "ones")
                && (i > 0 && words[i - 1] != "no" && words[i - 1] != "this")
                && !matches!(words.get(i + 1).map(String::as_str), Some("of" | "and"));
            if is_head {
                words[i] = if words[i] == "one" { singular(noun).to_owned() } else { noun.clone() };
            }
        }
    }
    if let Some(noun) = noun.as_ref().filter(|noun| Lexicon::get().is_plural(noun)) {
        replace_plural_pronouns(&mut words, noun);
    }
    let meant = selected.or_else(|| earlier.and_then(|earlier| earlier.instance));
    if let Some(meant) = meant {
        replace_pronouns(&mut words, &reference(meant), selected.is_some());
    }
    match earlier {
        Some(earlier) if elliptic => {
            let mut object = words.join(" ");
            // "and on the shelf?" after "how many books are on the desk"
            let of_a_kind = noun.filter(|_| !is_list_of_anything(earlier));
            if let Some(noun) =
                of_a_kind.filter(|_| is_place(&object.split(' ').collect::<Vec<_>>()))
            {
                object = format!("{noun} {object}");
            }
            asked_again(earlier, &object).unwrap_or(object)
        }
        _ if words == before => query.to_owned(),
        _ => words.join(" "),
    }
}

fn starts_with(words: &[String], run: &[&str]) -> bool {
    words.len() >= run.len() && words.iter().zip(run).all(|(word, said)| word == said)
}

/// Returns a phrase in words, with the objects that it carries: "the desk with the laptop".
fn with_carried(phrase: &Phrase) -> String {
    let carried = phrase.with.iter().filter(|with| !with.absent);
    let carried: Vec<String> =
        carried.map(|with| format!(" with the {}", with.phrase.text())).collect();
    format!("the {}{}", phrase.text(), carried.concat())
}

/// Returns whether words are a whole question or command rather than the name of an object.
fn is_question(words: &[String]) -> bool {
    words.first().is_some_and(|word| {
        matches!(
            word.as_str(),
            "what"
                | "what's"
                | "whats"
                | "where"
                | "where's"
                | "wheres"
                | "how"
                | "how's"
                | "is"
                | "are"
                | "which"
                | "does"
                | "do"
                | "can"
                | "list"
        )
    })
}

fn owned(words: &[&str]) -> Vec<String> {
    words.iter().flat_map(|word| word.split(' ')).map(str::to_owned).collect()
}

fn reference(id: InstanceId) -> String {
    format!("#{id}")
}

/// Returns the noun of an earlier answer: that of its question, or the instance's name.
fn noun_of(earlier: &Earlier) -> Option<String> {
    let target = parse(&earlier.query).target;
    match target.meaning() {
        Meaning::Anything | Meaning::Instance(_) => earlier.name.clone(),
        _ if target.head.is_empty() => earlier.name.clone(),
        _ => Some(target.head),
    }
}

/// Returns whether an earlier question asked for things of any kind: "what is on the desk".
fn is_list_of_anything(earlier: &Earlier) -> bool {
    let parsed = parse(&earlier.query);
    parsed.form == Form::List && parsed.target.meaning() == Meaning::Anything
}

/// Returns where words say "the other one".
fn other_one(words: &[String], noun: &str) -> Option<(usize, usize)> {
    // "the other sofa"
    let named = (0..words.len().saturating_sub(1)).find(|&i| {
        let rest: Vec<&str> = words[i + 1..].iter().map(String::as_str).collect();
        words[i] == "other"
            && longest_noun(&rest).is_some_and(|length| rest[..length].join(" ") == noun)
    });
    if let Some(other) = named {
        let article = usize::from(other > 0 && words[other - 1] == "the");
        return Some((other - article, other + 1 + noun.split(' ').count()));
    }
    const RUNS: [&[&str]; 5] = [
        &["the", "other", "one"],
        &["another", "one"],
        &["a", "different", "one"],
        &["not", "that", "one"],
        &["not", "this", "one"],
    ];
    (0..words.len()).find_map(|i| {
        let run = RUNS.iter().find(|run| starts_with(&words[i..], run))?;
        Some((i, i + run.len()))
    })
}

/// Replaces "it", and "this" and "that" where no noun follows them.
fn replace_pronouns(words: &mut Vec<String>, reference: &str, is_selected: bool) {
    let mut i = 0;
    while i < words.len() {
        let next = words.get(i + 1).map(String::as_str);
        let ends = !is_named(&words[i + 1..]);
        let length = match (words[i].as_str(), next) {
            ("it", next) if means_own_noun(&words[..i], next) => 0,
            ("this" | "that", Some("one" | "thing" | "object" | "item")) => 2,
            // "that is on the table" goes on about an object named before.
            ("that", Some("is" | "are")) if i > 0 && !is_selected => 0,
            ("it" | "this", _) if ends => 1,
            ("that", _) if ends && (i + 1 == words.len() || is_selected) => 1,
            // "how far is that from the stove"
            ("that", _) if ends && i > 0 && matches!(words[i - 1].as_str(), "is" | "does") => 1,
            // "is it there", "where is it exactly"
            ("it", _) => 1,
            _ => 0,
        };
        if length > 0 {
            words.splice(i..i + length, [reference.to_owned()]);
        }
        i += 1;
    }
}

/// Returns whether words begin with a noun, with or without a description: "this red chair".
fn is_named(words: &[String]) -> bool {
    let words: Vec<&str> = words.iter().map(String::as_str).collect();
    let describes = |word: &&&str| {
        matches!(
            words::longest_match(&[word]),
            Some((words::Meaning::Color(_) | words::Meaning::Trait(_), 1))
        )
    };
    let described = words.iter().take_while(describes).count();
    match words.get(described) {
        None => false,
        Some(word) if *word == BREAK => false,
        Some(word) => {
            longest_noun(&words[described..]).is_some()
                || words::longest_match(&[word]).is_none() && !word.ends_with("er")
        }
    }
}

/// Returns whether "it" means a noun of the same question: "the table with a lamp on it", "the mug,
/// it is red".
fn means_own_noun(before: &[String], next: Option<&str>) -> bool {
    let said: Vec<&str> = before.iter().map(String::as_str).collect();
    let names = |words: &[&str]| {
        (0..words.len()).any(|i| {
            longest_noun(&words[i..]).is_some_and(|length| {
                !words::is_anything(&words[i..i + length].join(" ")) && !words[i].starts_with('#')
            })
        })
    };
    if !names(&said) {
        return false;
    }
    let clause = said
        .iter()
        .rposition(|word| matches!(*word, BREAK | "with" | "that" | "which" | "has" | "where"));
    clause.is_some_and(|at| names(&said[..at])) || matches!(next, Some("is" | "has" | "stands"))
}

/// Replaces "they" and "them" by the objects of the earlier question: "where are they", "how many
/// of them are on the desk", "how many are there".
fn replace_plural_pronouns(words: &mut Vec<String>, noun: &str) {
    if ["how", "many", "are", "there"].iter().eq(words.iter().take(4)) {
        words.insert(2, noun.to_owned());
        return;
    }
    let of_them = (1..words.len()).find(|&i| words[i] == "them" && words[i - 1] == "of");
    if let Some(i) = of_them {
        words.splice(i - 1..=i, [noun.to_owned()]);
    }
    if let Some(i) = words.iter().position(|word| matches!(word.as_str(), "they" | "them")) {
        words.splice(i..=i, ["the".to_owned(), noun.to_owned()]);
    }
}

/// Replaces "them", "those" and "which ones" by the objects of an earlier answer that had several:
/// "which of the mugs #3, #4 and #5".
fn replace_group_pronouns(words: &mut Vec<String>, earlier: &Earlier) {
    let Earlier { targets, .. } = earlier;
    if targets.len() < 2 || targets.len() > MOST_OF_THEM {
        return;
    }
    let noun = parse(&earlier.query).target;
    let noun = match noun.meaning() {
        Meaning::Nouns(_) if noun.uses.is_empty() => plural_of(&noun.head),
        _ => "things".to_owned(),
    };
    let ids: Vec<String> = targets.iter().map(|id| reference(*id)).collect();
    let Some((last, before)) = ids.split_last() else { return };
    let named: Vec<String> = ["the".to_owned(), noun]
        .into_iter()
        .chain(
            before
                .iter()
                .enumerate()
                .map(|(i, id)| if i + 1 < before.len() { format!("{id},") } else { id.clone() }),
        )
        .chain(["and".to_owned(), last.clone()])
        .collect();
    let is_pronoun = |word: &String| matches!(word.as_str(), "them" | "they" | "those" | "these");
    // "those chairs" names its objects.
    let stands_alone = |i: usize| {
        is_pronoun(&words[i])
            && (matches!(words[i].as_str(), "them" | "they") || !is_named(&words[i + 1..]))
    };
    if let Some(i) = (0..words.len()).find(|&i| stands_alone(i)) {
        words.splice(i..=i, named);
    } else {
        let replaced = match words_of(words)[..] {
            ["which" | "what", "ones", ..] | ["which", "one", ..] => 1..2,
            // "which is closer to the door", but not "which is taller, the lamp or the shelf"
            ["which", "is" | "are", ref rest @ ..] if !rest.contains(&"or") => 1..1,
            _ => return,
        };
        words.splice(replaced, std::iter::once("of".to_owned()).chain(named));
    }
}

fn words_of(words: &[String]) -> Vec<&str> {
    words.iter().map(String::as_str).collect()
}

/// Returns the plural of a noun, with the words before it: "red chairs".
#[must_use]
pub fn plural_of(noun: &str) -> String {
    // "chair that is not red"
    if let Some((noun, rest)) = noun.split_once(" that is ") {
        return format!("{} that are {rest}", plural_of(noun));
    }
    match noun {
        noun if Lexicon::get().is_plural(noun) || noun.ends_with('s') => noun.to_owned(),
        noun if noun.contains(" that ") => noun.to_owned(),
        noun if noun.ends_with("ch") || noun.ends_with("sh") || noun.ends_with('x') => {
            format!("{noun}es")
        }
        noun if noun.ends_with("lf") => format!("{}ves", &noun[..noun.len() - 1]),
        noun => format!("{noun}s"),
    }
}

/// Returns the earlier question, asked about another object. `None` where it asked only for an
/// object.
fn asked_again(earlier: &Earlier, object: &str) -> Option<String> {
    let parsed = parse(&earlier.query);
    let other = |phrase: &Phrase| {
        earlier.anchor.map_or_else(|| format!("the {}", phrase.text()), reference)
    };
    Some(match &parsed.form {
        Form::Count => format!("how many {}", object.strip_prefix("the ").unwrap_or(object)),
        Form::Exists | Form::Number(_) => format!("is there {object}"),
        Form::Place => format!("where is {object}"),
        Form::Description(Aspect::All) => format!("describe {object}"),
        Form::Description(Aspect::Color) => format!("what color is {object}"),
        Form::Description(Aspect::Material) => format!("what material is {object}"),
        Form::Size(dimension) => match dimension {
            Dimension::All => format!("how big is {object}"),
            Dimension::Height => format!("how tall is {object}"),
            Dimension::Width => format!("how wide is {object}"),
            Dimension::Length => format!("how long is {object}"),
            Dimension::Depth => format!("how deep is {object}"),
            Dimension::Area => format!("how much space does {object} take up"),
            Dimension::Volume => format!("what is the volume of {object}"),
            Dimension::Elevation => format!("how high above the floor is {object}"),
        },
        Form::Distance(Reference::Observer) => format!("how far is {object}"),
        Form::Distance(Reference::Object(phrase)) => {
            format!("how far is {object} from {}", other(phrase))
        }
        Form::List => match &parsed.target.relations[..] {
            [relation, ..] if parsed.target.meaning() == Meaning::Anything => {
                if is_place(&object.split(' ').collect::<Vec<_>>()) {
                    format!("what is {object}")
                } else {
                    format!("what is {} {object}", relation.text)
                }
            }
            _ => format!("list all {}", object.strip_prefix("the ").unwrap_or(object)),
        },
        Form::Holds(Claim { is_negated, .. }) => {
            let not = if *is_negated { "not " } else { "" };
            let claim = parsed.target.relations.first().map(|relation| {
                let anchors: Vec<String> = relation.anchors.iter().map(with_carried).collect();
                format!("{} {}", relation.text, anchors.join(" and "))
            });
            let color = parsed.target.colors.first().map(|color| color.as_str().to_owned());
            format!("is {object} {not}{}", claim.or(color)?)
        }
        Form::Limit(limit) => asked_of_limit(limit, object, &other),
        Form::Comparison(Comparison {
            by: ComparedBy::Dimension(_), word, other: than, ..
        }) => {
            format!("is {object} {word} than {}", other(than))
        }
        Form::Fit(passage) => {
            let way = match passage.way {
                super::Way::Through => "through",
                super::Way::Under => "under",
                super::Way::In => "in",
                super::Way::On => "on",
                super::Way::Between => "between",
            };
            let second =
                passage.second.as_ref().map(|second| format!(" and the {}", second.text()));
            let second = second.unwrap_or_default();
            format!("does {object} fit {way} {}{second}", other(&passage.place))
        }
        Form::Object | Form::Comparison(_) | Form::Choice(_) | Form::Difference(_) => return None,
    })
}

/// Returns a question about a limit, asked about another object.
fn asked_of_limit(limit: &Limit, object: &str, other: &dyn Fn(&Phrase) -> String) -> String {
    let bound = match limit.bound {
        Bound::Above => "more than",
        Bound::Below => "less than",
        Bound::About => "about",
    };
    let given = limit.given_m;
    match &limit.by {
        ComparedBy::Distance(Reference::Observer) => format!("is {object} {bound} {given} m away"),
        ComparedBy::Distance(Reference::Object(phrase)) => {
            format!("is {object} {bound} {given} m from {}", other(phrase))
        }
        ComparedBy::Dimension(dimension) => {
            let measured = match dimension {
                Dimension::Height => "tall",
                Dimension::Depth => "deep",
                Dimension::Elevation => "above the floor",
                Dimension::Width => "wide",
                Dimension::All | Dimension::Length | Dimension::Area | Dimension::Volume => "long",
            };
            format!("is {object} {bound} {given} m {measured}")
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn earlier(query: &str) -> Earlier {
        Earlier {
            query: query.into(),
            instance: Some(InstanceId(12)),
            name: Some("mug".into()),
            anchor: Some(InstanceId(3)),
            targets: Vec::new(),
        }
    }

    #[test]
    fn pronouns_become_the_instance_of_the_earlier_answer() {
        for (query, resolved) in [
            ("how big is it?", "how big is #12"),
            ("What is next to it?", "what is next to #12"),
            ("is it red?", "is #12 red"),
            ("what color is that?", "what color is #12"),
            ("the lamp next to it", "the lamp next to #12"),
            ("how far is it from the door?", "how far is #12 from the door"),
            ("the chair by the window", "the chair by the window"),
            ("is that chair red", "is that chair red"),
            ("the table with a lamp on it", "the table with a lamp on it"),
            ("the plant, it is green", "the plant, it is green"),
            ("is the lamp next to it?", "is the lamp next to #12"),
            ("How far is that from the stove?", "how far is #12 from the stove"),
            (
                "And what's on the green cabinet beside it?",
                "what's on the green cabinet beside #12",
            ),
        ] {
            assert_eq!(resolve(query, Some(&earlier("the red mug")), None), resolved);
        }
    }

    #[test]
    fn this_is_the_selected_instance() {
        let selected = Some(InstanceId(7));
        assert_eq!(resolve("what is this?", None, selected), "what is #7");
        assert_eq!(
            resolve("how far is this from the door?", Some(&earlier("the red mug")), selected),
            "how far is #7 from the door"
        );
        assert_eq!(resolve("what is this?", None, None), "what is this?");
    }

    #[test]
    fn one_has_the_noun_of_the_earlier_question() {
        for (query, resolved) in [
            ("and the blue one?", "the blue mug"),
            ("the one next to it", "the mug next to #12"),
            ("no, the other one", "the mug that is not #12"),
            ("and the other mug?", "the mug that is not #12"),
            ("which one is closest to the door?", "which mug is closest to the door"),
            ("which one has the spoon in it?", "which mug has the spoon in it"),
        ] {
            assert_eq!(resolve(query, Some(&earlier("the red mug")), None), resolved);
        }
    }

    #[test]
    fn the_earlier_question_is_asked_about_another_object() {
        for (before, query, resolved) in [
            ("how tall is the shelf?", "and the lamp?", "how tall is the lamp"),
            (
                "how far is the mug from the TV",
                "and the blue one?",
                "how far is the blue mug from #3",
            ),
            ("what is on the desk?", "what about the shelf", "what is on the shelf"),
            ("where is the mug", "and the remote?", "where is the remote"),
            (
                "is the mug on the desk with the laptop?",
                "what about the stapler?",
                "is the stapler on the desk with the laptop",
            ),
            ("how many chairs are there", "and tables?", "how many tables"),
            ("is there a piano?", "and a clock?", "is there a clock"),
            ("what is on the desk?", "and under the table?", "what is under the table"),
            (
                "how many bottles are on the desk",
                "and on the shelf?",
                "how many bottles on the shelf",
            ),
            ("the red mug", "and what is next to it?", "what is next to #12"),
            ("how many chairs are there", "where are they?", "where are the chairs"),
            ("all chairs", "how many are there?", "how many chairs are there"),
            ("all chairs", "how many of them are red?", "how many chairs are red"),
        ] {
            assert_eq!(resolve(query, Some(&earlier(before)), None), resolved);
        }
    }

    #[test]
    fn them_are_the_objects_of_the_earlier_answer() {
        let targets = vec![InstanceId(3), InstanceId(4), InstanceId(5)];
        for (before, query, resolved) in [
            ("all mugs", "which of them are red?", "which of the mugs #3, #4 and #5 are red"),
            (
                "list every mug on the table",
                "which of those is closest to the door?",
                "which of the mugs #3, #4 and #5 is closest to the door",
            ),
            ("all mugs", "which ones are red", "which of the mugs #3, #4 and #5 are red"),
            (
                "all mugs",
                "which one is the tallest",
                "which of the mugs #3, #4 and #5 is the tallest",
            ),
            (
                "what is on the desk",
                "how many of them are red",
                "how many of the things #3, #4 and #5 are red",
            ),
            ("all mugs", "are they on the desk?", "are the mugs #3, #4 and #5 on the desk"),
            (
                "all mugs",
                "which is taller, the lamp or the shelf",
                "which is taller, the lamp or the shelf",
            ),
            ("all mugs", "are those chairs red", "are those chairs red"),
        ] {
            let earlier = Earlier { targets: targets.clone(), ..earlier(before) };
            assert_eq!(resolve(query, Some(&earlier), None), resolved, "{query}");
        }
        let parsed = parse("which of the mugs #3, #4 and #5 are red");
        assert_eq!((parsed.target.head.as_str(), &parsed.target.among), ("mugs", &targets));
        assert_eq!((&parsed.form, parsed.target.colors.len()), (&Form::List, 1), "{parsed:?}");
        assert!(parsed.not_understood.is_empty(), "{parsed:?}");
        let parsed = parse("which of the mugs #3, #4 and #5 is closest to the door");
        assert_eq!(parsed.quantity, crate::Quantity::One);
        assert_eq!(parsed.target.among, targets);
        let parsed = parse("how far is #3 from #4");
        assert!(parsed.target.among.is_empty(), "{parsed:?}");
    }

    proptest::proptest! {
        #[test]
        fn any_text_is_resolved_without_panic(query in ".{0,80}", before in ".{0,80}") {
            let earlier = earlier(&before);
            let _ = resolve(&query, Some(&earlier), None);
            let _ = resolve(&query, Some(&earlier), Some(InstanceId(1)));
        }

        #[test]
        fn any_order_of_words_is_resolved_without_panic(
            words in proptest::collection::vec(
                proptest::sample::select(vec![
                    "and", "it", "this", "that", "one", "ones", "the", "other", "what", "about",
                    "no", "mug", "mugs", "on", "is", "how", "far", "from", "red", ",", "#3", "which",
                    "or", "than", "closer", "to", "fit", "under", "except", "within", "1", "m",
                ]),
                0..14,
            ),
            before in proptest::sample::select(vec![
                "how far is the mug from the tv", "what is on the desk", "is the mug red",
                "does the stool fit under the desk", "which is taller, the lamp or the shelf",
            ]),
        ) {
            let query = words.join(" ");
            let _ = resolve(&query, Some(&earlier(before)), None);
            let _ = parse(&query);
        }
    }
}
