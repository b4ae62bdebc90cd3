//! Reads objects that are named by their purpose: "something to sit on", "what you would grab to
//! put out a fire".
//!
//! The uses are those of the lexicon; `uses.tsv` has other words for them.

use super::cost;
use super::tokens::{BREAK, stem};
use super::words::{self, Meaning};
use std::collections::{BTreeSet, HashMap};
use std::sync::LazyLock;
use uniground_models::attributes::Lexicon;

/// A clause at the start that says what the target is for.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct Affordance {
    /// The uses of the lexicon that fit the words best; several where they fit equally well.
    pub uses: Vec<String>,
    /// The clause's words: "pour wine from" fits wine bottles better than teapots.
    pub words: Vec<String>,
    /// Tokens within the clause that describe the object: "something soft and green to sink into".
    pub described: std::ops::Range<usize>,
    /// Number of tokens of the clause; the rest of the query follows.
    pub taken: usize,
}

/// How such a clause begins.
const OPENERS: &[&str] = &[
    "something",
    "anything",
    "somewhere",
    "someplace",
    "a place",
    "some place",
    "a spot",
    "a thing",
    "an object",
    "the object",
    "the thing",
    "an item",
    "the item",
    "the place",
    "a device",
    "the device",
    "things",
    "what you",
    "what would",
    "what can",
    "what could",
    "what do",
    "what one",
    "what to",
    "what i",
    "what people",
    "what someone",
    "what somebody",
    "what should",
    "what will",
    "what",
    "where can",
    "where do",
    "where could",
    "where to",
    "where you",
    "where would",
    "where i",
    "where should",
    "where people",
    "i want to",
    "i need to",
    "i would like to",
    "i'd like to",
    "i have to",
    "i wish to",
    "how can i",
    "how do i",
    "i need something",
    "is there anything",
    "is there something",
    "is there a thing",
    "do you have anything",
    "do you have something",
    "do we have anything",
    "do we have something",
    "got anything",
    "got something",
    "any idea what",
];

/// Words that end the clause and begin the circumstances.
const CIRCUMSTANCES: [&str; 4] = ["while", "when", "whilst", "without"];

/// Particles distinguish uses ("write on", "write with"), but are not uses themselves.
const PARTICLES: [&str; 16] = [
    "on", "in", "at", "by", "from", "with", "to", "for", "into", "out", "away", "up", "off", "the",
    "a", "of",
];

/// One wording of a use: the required stems, and the particles that support it.
struct Wording {
    needed: Vec<String>,
    particles: Vec<String>,
}

static WORDINGS: LazyLock<HashMap<&'static str, Vec<Wording>>> = LazyLock::new(|| {
    let mut wordings: HashMap<&'static str, Vec<Wording>> = HashMap::new();
    for noun in Lexicon::get().nouns() {
        for spoken in &noun.uses {
            wordings.entry(spoken).or_insert_with(|| vec![Wording::of(spoken)]);
        }
    }
    for line in include_str!("uses.tsv").lines().filter(|line| !line.starts_with('#')) {
        if let Some((spoken, others)) = line.split_once('\t')
            && let Some(known) = wordings.get_mut(spoken)
        {
            known.extend(others.split(',').map(|other| Wording::of(other.trim())));
        }
    }
    wordings
});

impl Wording {
    fn of(text: &str) -> Self {
        let (particles, needed): (Vec<&str>, Vec<&str>) =
            text.split(' ').partition(|word| PARTICLES.contains(word));
        Self {
            needed: needed.into_iter().map(stem).collect(),
            particles: particles.into_iter().map(str::to_owned).collect(),
        }
    }

    /// Returns how well the words match this use: twice the number of required words and particles
    /// that match, so that "drink from" counts like "drink water". One less if the use has particles
    /// and none matches: "something to read" is a book rather than a lamp to read by. Returns `None`
    /// if a required word is missing.
    fn fit(&self, words: &BTreeSet<&str>, stems: &BTreeSet<String>) -> Option<usize> {
        cost::count();
        let said = !self.needed.is_empty() && self.needed.iter().all(|stem| stems.contains(stem));
        let particles = self.particles.iter().filter(|p| words.contains(p.as_str())).count();
        let is_other = !self.particles.is_empty() && particles == 0;
        (said && (particles > 0 || !self.is_light()))
            .then(|| 2 * (self.needed.len() + particles) - usize::from(is_other))
    }

    /// Returns whether its particle says more than its verb: "get out", but not "get some fruit".
    fn is_light(&self) -> bool {
        matches!(&self.needed[..], [only] if matches!(only.as_str(), "get" | "go"))
            && !self.particles.is_empty()
    }
}

/// Maximum number of clauses that begin like a purpose but are not one, before the search ends.
/// Real questions have fewer.
const MAX_ATTEMPTS: usize = 8;

/// Finds the clause at the start of a query, or after clauses that name nothing: "it's getting
/// dark, is there anything to read by". Takes time linear in the number of words.
pub(super) fn find(tokens: &[String]) -> Option<Affordance> {
    let words: Vec<&str> = tokens.iter().map(String::as_str).collect();
    let named = words.iter().position(|word| Lexicon::get().is_known(word)).unwrap_or(words.len());
    let pauses = (0..named).filter(|&i| words[i] == BREAK);
    let (mut looked_at, mut attempts) = (0, 0);
    for start in std::iter::once(0).chain(pauses.map(|i| i + 1)) {
        // A start within the words of an earlier attempt leads to the same word.
        if start < looked_at {
            continue;
        }
        match find_opener(&words, start) {
            Ok(found) => {
                looked_at = found.end;
                if let Some(affordance) = parse_clause(&words, found.end) {
                    return Some(affordance);
                }
                attempts += 1;
                if attempts == MAX_ATTEMPTS {
                    return None;
                }
            }
            Err(stopped) => looked_at = stopped + 1,
        }
    }
    None
}

/// Returns the words that begin the clause at or after `start`, if only words without content are
/// between; otherwise the index of the word at which the search ended.
fn find_opener(words: &[&str], mut start: usize) -> Result<std::ops::Range<usize>, usize> {
    loop {
        let rest = &words[start.min(words.len())..];
        if let Some(length) = opener_at(rest) {
            return if has_purpose_clause(rest, length) {
                Ok(start..start + length)
            } else {
                Err(start)
            };
        }
        // "please bring me", "find": before the opener, only words without content are allowed.
        match words::longest_match(rest) {
            Some((Meaning::Filler | Meaning::Determiner | Meaning::And, length)) => start += length,
            _ if start > 0 && rest.first() == Some(&BREAK) => start += 1,
            _ => return Err(start),
        }
    }
}

/// Returns the purpose that the clause from `begin` on, after its opener, states; `None` if the
/// lexicon has no such use.
fn parse_clause(words: &[&str], begin: usize) -> Option<Affordance> {
    let purpose = (begin..words.len())
        .find(|&i| is_purpose(words[i]))
        .filter(|_| is_thing(words[begin - 1]))
        .unwrap_or(begin);
    let describes = |word: &&str| {
        matches!(
            words::longest_match(&[word]),
            Some((Meaning::Color(_) | Meaning::Trait(_) | Meaning::And, _))
        ) || !Lexicon::get().is_known(word)
    };
    let described =
        begin..if words[begin..purpose].iter().all(describes) { purpose } else { begin };
    let begin = described.end;
    let end = (begin..words.len()).find(|&i| ends_clause(words, i)).unwrap_or(words.len());
    let clause: BTreeSet<&str> = words[begin..end].iter().copied().collect();
    let stems: BTreeSet<String> = clause.iter().map(|word| stem(word)).collect();
    let mut found: Vec<(usize, &str)> = WORDINGS
        .iter()
        .filter_map(|(spoken, wordings)| {
            Some((wordings.iter().filter_map(|w| w.fit(&clause, &stems)).max()?, *spoken))
        })
        .collect();
    if found.is_empty() {
        found = uses_with_same_verb(&words[begin..end]);
    }
    found.sort_unstable_by(|a, b| b.0.cmp(&a.0).then(a.1.cmp(b.1)));
    let best = found.first()?.0;
    let uses = found
        .into_iter()
        .take_while(|(fit, _)| *fit == best)
        .map(|(_, spoken)| spoken.to_owned())
        .collect();
    let words = clause
        .iter()
        .filter(|word| !PARTICLES.contains(word))
        .map(|word| (*word).to_owned())
        .collect();
    Some(Affordance { uses, words, described, taken: end })
}

/// Returns the uses that begin with the verb of a clause, where the clause matches no use exactly:
/// "heat up my soup".
fn uses_with_same_verb(clause: &[&str]) -> Vec<(usize, &'static str)> {
    /// Verbs that can belong to any use.
    const LIGHT: [&str; 16] = [
        "get", "go", "put", "take", "have", "make", "keep", "do", "see", "know", "look", "check",
        "use", "hold", "find", "be",
    ];
    let verb = clause
        .iter()
        .find(|word| !PARTICLES.contains(word) && !words::is_known(word))
        .map(|word| stem(word));
    let Some(verb) = verb.filter(|verb| !LIGHT.contains(&verb.as_str())) else { return Vec::new() };
    let begins = |wordings: &Vec<Wording>| {
        wordings.iter().any(|wording| wording.needed.len() > 1 && wording.needed[0] == verb)
    };
    WORDINGS
        .iter()
        .filter(|(_, wordings)| begins(wordings))
        .map(|(spoken, _)| (1, *spoken))
        .collect()
}

/// Returns whether a purpose follows soon after the word for an object: "something soft to sit on",
/// not "the thing on the table".
fn has_purpose_clause(words: &[&str], opener: usize) -> bool {
    const SOON: usize = 5;
    // "the object is a chair with ...": a noun says what it is.
    let told = words.get(opener) == Some(&"is");
    !is_thing(words[opener - 1])
        || !told && words[opener..].iter().take(SOON).any(|word| is_purpose(word))
}

/// Returns the words of a purpose that belong to none of the uses found for it: of "put a toddler
/// for lunch", "put on" covers the first only.
pub(super) fn unmatched_words<'a>(uses: &[String], purpose: &'a [String]) -> Vec<&'a String> {
    let wordings = || uses.iter().filter_map(|spoken| WORDINGS.get(spoken.as_str())).flatten();
    let is_said = |word: &&String| {
        words::is_known(word) || wordings().any(|wording| wording.needed.contains(&stem(word)))
    };
    purpose.iter().filter(|word| !is_said(word)).collect()
}

/// Returns whether some use has this verb.
pub(super) fn is_verb_of_a_use(word: &str) -> bool {
    let stem = stem(word);
    WORDINGS.values().flatten().any(|wording| wording.needed.first() == Some(&stem))
}

fn is_thing(word: &str) -> bool {
    matches!(word, "something" | "anything" | "thing" | "things" | "object" | "item" | "device")
}

fn is_purpose(word: &str) -> bool {
    matches!(word, "to" | "that" | "which" | "for" | "i" | "you" | "we" | "used" | "with")
}

/// Returns the number of words of the longest opener that the words begin with.
fn opener_at(words: &[&str]) -> Option<usize> {
    /// Openers by their first word: most words begin none.
    static BY_FIRST_WORD: LazyLock<HashMap<&str, Vec<&str>>> = LazyLock::new(|| {
        let mut openers: HashMap<&str, Vec<&str>> = HashMap::new();
        for &opener in OPENERS {
            let first = opener.split(' ').next().unwrap_or(opener);
            openers.entry(first).or_default().push(opener);
        }
        openers
    });
    cost::count();
    let openers = BY_FIRST_WORD.get(words.first()?)?;
    openers.iter().filter_map(|opener| begins(words, opener)).max()
}

fn begins(words: &[&str], opener: &str) -> Option<usize> {
    cost::count();
    let mut said = words.iter();
    opener.split(' ').all(|wanted| said.next() == Some(&wanted)).then(|| words.len() - said.len())
}

/// Returns whether the clause ends before word `i`: at a pause, circumstances, or a relation to an
/// object.
fn ends_clause(words: &[&str], i: usize) -> bool {
    // "something to sit on that is blue": the rest describes the object.
    let describes = matches!(words[i..], ["that" | "which", "is" | "are", ..]);
    if words[i] == BREAK || CIRCUMSTANCES.contains(&words[i]) || describes {
        return true;
    }
    let Some((meaning, length)) = words::longest_match(&words[i..]) else { return false };
    if !matches!(
        meaning,
        Meaning::Relation(_) | Meaning::With { .. } | Meaning::Superlative(_) | Meaning::View(_)
    ) {
        return false;
    }
    // "sit on", "read by": a particle of the verb unless an object follows. In "work on my laptop",
    // the laptop need not be in the scene.
    let next = words.get(i + length).copied().unwrap_or(BREAK);
    if matches!(words[i], "on" | "in" | "with")
        && length == 1
        && matches!(next, "my" | "your" | "our" | "his" | "her" | "their")
    {
        return false;
    }
    match words::longest_match(&words[(i + length).min(words.len())..]) {
        _ if meaning == Meaning::Relation(super::RelationKind::InCorner) => true,
        Some((
            Meaning::Determiner
            | Meaning::Number(_)
            | Meaning::Color(_)
            | Meaning::Trait(_)
            | Meaning::Same
            | Meaning::Ordinal(_),
            _,
        )) => true,
        _ => next != BREAK && Lexicon::get().is_known(next),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::tokens::tokenize;

    #[test]
    fn purpose_clause_ends_before_the_rest_of_the_query() {
        for (query, spoken, rest) in [
            (
                "something to sit on while working on the laptop",
                "sit on",
                "while working on the laptop",
            ),
            ("bring me something to write with", "write with", ""),
            (
                "somewhere to throw away scrap paper while working at the desk",
                "throw away",
                "while working at the desk",
            ),
            ("where can i wash my hands?", "wash hands", ","),
            ("something that tells me the time", "tell time", ""),
            ("something to read by next to the sofa", "read by", "next to the sofa"),
            ("something to read next to the sofa", "read", "next to the sofa"),
            ("i want to lie down", "lie on", ""),
            ("something to sit on that is blue", "sit on", "that is blue"),
            ("could you find this for me: something to sit on", "sit on", ""),
        ] {
            let tokens = tokenize(query);
            let found = find(&tokens).unwrap_or_else(|| panic!("{query}"));
            assert_eq!(
                (found.uses.join("|").as_str(), tokens[found.taken..].join(" ").as_str()),
                (spoken, rest),
                "{query}"
            );
        }
    }

    #[test]
    fn unmatched_words_returns_words_outside_the_known_use() {
        for (query, left) in [
            ("something to sit on", ""),
            ("what you would drink water from", ""),
            ("something to sit on for walruses", "walruses"),
        ] {
            let found = find(&tokenize(query)).unwrap();
            let unsaid: Vec<&str> = unmatched_words(&found.uses, &found.words)
                .into_iter()
                .map(String::as_str)
                .collect();
            assert_eq!(unsaid.join(" "), left, "{query}");
        }
    }

    #[test]
    fn every_line_of_the_table_is_a_use_of_the_lexicon() {
        let known: BTreeSet<&str> = Lexicon::get()
            .nouns()
            .iter()
            .flat_map(|noun| noun.uses.iter().map(String::as_str))
            .collect();
        for line in include_str!("uses.tsv").lines().filter(|line| !line.starts_with('#')) {
            let (spoken, others) = line.split_once('\t').unwrap_or_else(|| panic!("{line}"));
            assert!(known.contains(spoken), "{spoken} is no use of the lexicon");
            assert!(
                others.split(',').all(|other| !Wording::of(other.trim()).needed.is_empty()),
                "{line}"
            );
        }
    }

    #[test]
    fn named_objects_are_not_read_as_purposes() {
        for query in [
            "the chair",
            "find the table to the left",
            "something red",
            "what is on the table",
            "where is the backpack?",
            "the thing in the middle of the dining table",
            "the object is a chair with its back to the camera",
            "",
        ] {
            assert_eq!(find(&tokenize(query)), None, "{query}");
        }
    }
}
