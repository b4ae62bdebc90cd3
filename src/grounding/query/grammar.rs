//! Words to phrases: a left-to-right reading with one phrase open at a time.

use super::words::{self, Meaning};
use super::{Measure, ParsedQuery, Phrase, Relation, RelationKind, Superlative, With};
use crate::models::attributes::Lexicon;

/// One piece of the query.
#[derive(Debug, Clone, PartialEq)]
enum Piece {
    Word(Meaning, String),
    Noun(String),
    Unknown(String),
    /// A comma or the end of a sentence.
    Break,
}

/// Where the phrase being read will go.
#[derive(Debug, Clone, PartialEq)]
enum Slot {
    Target,
    Anchor,
    Viewpoint,
    With { absent: bool, of_anchor: bool },
}

/// Reads a query. Never fails: what is not understood is listed.
#[must_use]
pub fn parse(query: &str) -> ParsedQuery {
    let mut reader = Reader::default();
    let pieces = pieces(query);
    for (i, piece) in pieces.iter().enumerate() {
        reader.read(piece, &pieces[i + 1..]);
    }
    reader.close();
    reader.query
}

fn pieces(query: &str) -> Vec<Piece> {
    let tokens = tokens(query);
    let mut pieces = Vec::new();
    let mut at = 0;
    while at < tokens.len() {
        if tokens[at] == "," {
            pieces.push(Piece::Break);
            at += 1;
            continue;
        }
        // Nothing in the tables spans a break.
        let run: Vec<&str> = tokens[at..].iter().map(String::as_str).take_while(|t| *t != ",").collect();
        let noun = longest_noun(&run);
        let word = words::longest(&run);
        let taken = match (noun, word) {
            (Some(length), word) if word.is_none_or(|(_, w)| length >= w) => {
                pieces.push(Piece::Noun(run[..length].join(" ")));
                length
            }
            (_, Some((meaning, length))) => {
                pieces.push(Piece::Word(meaning, run[..length].join(" ")));
                length
            }
            _ => {
                pieces.push(Piece::Unknown(run[0].to_owned()));
                1
            }
        };
        at += taken;
    }
    pieces
}

/// Lower-case words; sentence marks become ",".
fn tokens(query: &str) -> Vec<String> {
    let mut tokens = Vec::new();
    let mut word = String::new();
    let end = |word: &mut String, tokens: &mut Vec<String>| {
        let bare = word.trim_matches('\'').trim_end_matches("'s").to_owned();
        if !bare.is_empty() {
            tokens.push(bare);
        }
        word.clear();
    };
    for c in query.chars().flat_map(char::to_lowercase) {
        match c {
            c if c.is_alphanumeric() => word.push(c),
            '\'' | '\u{2019}' => word.push('\''),
            '.' | ',' | ';' | ':' | '?' | '!' | '\n' => {
                end(&mut word, &mut tokens);
                tokens.push(",".into());
            }
            _ => end(&mut word, &mut tokens),
        }
    }
    end(&mut word, &mut tokens);
    tokens
}

/// Length in words of the longest noun at the start.
fn longest_noun(run: &[&str]) -> Option<usize> {
    let lexicon = Lexicon::get();
    (1..=lexicon.longest_words().min(run.len())).rev().find(|&n| {
        let candidate = run[..n].join(" ");
        let phrase = Phrase { head: candidate, ..Phrase::default() };
        !matches!(phrase.meaning(), super::Meaning::Unknown)
    })
}

#[derive(Default)]
struct Reader {
    query: ParsedQuery,
    open: Phrase,
    slot: Option<Slot>,
    negated: bool,
    ordinal: Option<u32>,
    /// Words since the last noun that nothing explains.
    unknown: Vec<String>,
    target_read: bool,
}

impl Reader {
    fn slot(&self) -> Slot {
        self.slot.clone().unwrap_or(Slot::Target)
    }

    fn read(&mut self, piece: &Piece, rest: &[Piece]) {
        match piece {
            Piece::Noun(head) => self.noun(head),
            Piece::Unknown(word) => self.unknown.push(word.clone()),
            Piece::Break => self.pause(),
            Piece::Word(meaning, text) => self.word(*meaning, text, rest),
        }
    }

    fn noun(&mut self, head: &str) {
        // "not" speaks of the word that follows: a colour or a relation. "Not the chair" is nothing that can be used.
        if std::mem::take(&mut self.negated) {
            self.query.not_understood.push("not".into());
        }
        // "computer desk": in English the last noun is the head.
        if !self.open.head.is_empty() && !words::is_anything(&self.open.head) {
            let modifier = std::mem::take(&mut self.open.head);
            self.open.unchecked.push(modifier);
        }
        self.open.unchecked.append(&mut self.unknown);
        head.clone_into(&mut self.open.head);
    }

    fn word(&mut self, meaning: Meaning, text: &str, rest: &[Piece]) {
        match meaning {
            Meaning::Relation(kind) => {
                let negated = std::mem::take(&mut self.negated);
                self.close();
                let relation = Relation { kind, text: text.to_owned(), anchors: Vec::new(), negated };
                self.query.relations.push(relation);
                self.slot = Some(Slot::Anchor);
                if matches!(kind, RelationKind::AgainstWall | RelationKind::InCorner) {
                    self.slot = None;
                }
            }
            Meaning::With { absent } => {
                let of_anchor = self.slot() == Slot::Anchor;
                self.close();
                self.slot = Some(Slot::With { absent, of_anchor });
            }
            Meaning::Facing => {
                self.close();
                self.slot = Some(Slot::Viewpoint);
            }
            Meaning::Superlative(measure) => self.superlative(measure, text, rest),
            Meaning::Ordinal(rank) => self.ordinal = Some(rank),
            Meaning::Colour(colour) => match std::mem::take(&mut self.negated) {
                true => self.open.other_than.push(colour),
                false => self.open.colours.push(colour),
            },
            Meaning::Size(size) => self.open.sizes.push(size),
            Meaning::Not => self.negated = true,
            Meaning::And => match self.slot() {
                // "between the sofa and the desk", "with a lamp and a book".
                Slot::Anchor if !self.open.is_empty() => {
                    self.close();
                    self.slot = Some(Slot::Anchor);
                }
                Slot::With { absent, of_anchor } => {
                    self.close();
                    self.slot = Some(Slot::With { absent, of_anchor });
                }
                _ => {}
            },
            // "the bookcase just to the left of it": the viewpoint, or else nothing new.
            Meaning::Pronoun => {
                if self.slot() == Slot::Anchor
                    && self.open.is_empty()
                    && let Some(viewpoint) = self.query.viewpoint.clone()
                {
                    self.open = viewpoint;
                }
            }
            Meaning::Determiner | Meaning::Filler => {
                if text == "from the left" || text == "from the right" {
                    let measure = if text == "from the left" { Measure::Leftmost } else { Measure::Rightmost };
                    self.query.superlative = Some(Superlative { measure, rank: self.ordinal.take().unwrap_or(1) });
                }
            }
        }
    }

    /// "the tallest bookcase", "the one on the left": an extreme; with "of" behind it, the sides become relations.
    fn superlative(&mut self, measure: Measure, text: &str, rest: &[Piece]) {
        let followed_by_of = matches!(rest.first(), Some(Piece::Word(Meaning::Filler, of)) if of == "of");
        let side = match measure {
            Measure::Leftmost => Some(RelationKind::LeftOf),
            Measure::Rightmost => Some(RelationKind::RightOf),
            _ => None,
        };
        match side {
            Some(kind) if followed_by_of => self.word(Meaning::Relation(kind), text, rest),
            _ => self.query.superlative = Some(Superlative { measure, rank: self.ordinal.take().unwrap_or(1) }),
        }
    }

    /// A comma or full stop. After it a new phrase may begin; "it" and relations go on about the target.
    fn pause(&mut self) {
        self.close();
        self.slot = None;
        self.negated = false;
    }

    /// Puts the open phrase where it belongs.
    fn close(&mut self) {
        let mut phrase = std::mem::take(&mut self.open);
        let unknown = std::mem::take(&mut self.unknown);
        // A phrase without a known noun ends in a noun nobody knows: "the theremin".
        if phrase.head.is_empty() && !unknown.is_empty() && !(self.slot().is_target() && self.target_read) {
            let mut unknown = unknown;
            phrase.head = unknown.pop().unwrap_or_default();
            phrase.unchecked.append(&mut unknown);
        } else {
            self.query.not_understood.extend(unknown);
        }
        if !phrase.head.is_empty() && phrase.meaning() == super::Meaning::Unknown {
            self.query.not_understood.push(phrase.head.clone());
        }
        self.query.not_understood.extend(phrase.unchecked.iter().cloned());
        if phrase.is_empty() {
            self.slot = None;
            return;
        }
        match self.slot.take().unwrap_or(Slot::Target) {
            Slot::Target if self.target_read => {
                // A later sentence adds to the target: "it is brown".
                self.query.target.colours.extend(phrase.colours);
                self.query.target.other_than.extend(phrase.other_than);
                self.query.target.sizes.extend(phrase.sizes);
                if self.query.target.head.is_empty() {
                    self.query.target.head = phrase.head;
                }
            }
            Slot::Target => {
                self.query.target = phrase;
                self.target_read = true;
            }
            Slot::Anchor => {
                if let Some(relation) = self.query.relations.last_mut() {
                    relation.anchors.push(phrase);
                }
            }
            Slot::Viewpoint => self.query.viewpoint = Some(phrase),
            Slot::With { absent, of_anchor } => {
                let anchor = self.query.relations.last_mut().and_then(|r| r.anchors.last_mut()).filter(|_| of_anchor);
                anchor.unwrap_or(&mut self.query.target).with.push(With { phrase, absent });
            }
        }
    }
}

impl Slot {
    fn is_target(&self) -> bool {
        *self == Self::Target
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::colour::ColourName;
    use crate::grounding::query::SizeWord;
    use proptest::prelude::*;

    /// The query in a compact notation: target; relation(anchors); superlative; viewpoint.
    fn summary(query: &str) -> String {
        let parsed = parse(query);
        let mut parts = vec![parsed.target.text()];
        for with in &parsed.target.with {
            parts.push(format!("{} {}", if with.absent { "without" } else { "with" }, with.phrase.text()));
        }
        for relation in &parsed.relations {
            let not = if relation.negated { "not " } else { "" };
            let anchors: Vec<_> = relation.anchors.iter().map(Phrase::text).collect();
            parts.push(format!("{not}{:?}({})", relation.kind, anchors.join(", ")));
        }
        parts.extend(parsed.superlative.map(|s| format!("{:?} {}", s.measure, s.rank)));
        parts.extend(parsed.viewpoint.map(|v| format!("facing {}", v.text())));
        parts.join("; ")
    }

    #[test]
    fn everyday_questions_are_understood() {
        for (query, expected) in [
            ("the black chair closest to the door", "black chair; Closest(door)"),
            ("find the television", "television"),
            ("this is a teapot. it is standing on the dining table.", "teapot; On(dining table)"),
            ("the stool with the orange seat", "stool; with orange seat"),
            ("the bookcase between the red sofa and the desk", "bookcase; Between(red sofa, desk)"),
            ("a window that sits above the dresser cabinet", "window; Above(dresser cabinet)"),
            ("facing the window, the curtain on the left", "curtain; Leftmost 1; facing window"),
            ("the second chair from the left", "chair; Leftmost 2"),
            ("the small box in the corner", "small box; InCorner()"),
            ("the mug to the left of the laptop", "mug; LeftOf(laptop)"),
            ("the tallest bookcase", "bookcase; Tallest 1"),
            ("where is the backpack?", "backpack"),
            ("the one that is not next to the door", "one; not Near(door)"),
            ("the sofa that is not red near the blue chair", "not red sofa; Near(blue chair)"),
            ("the sofa which isn't red", "not red sofa"),
        ] {
            assert_eq!(summary(query), expected, "{query}");
        }
    }

    #[test]
    fn attributes_belong_to_their_noun() {
        let parsed = parse("the large red chair next to the small white table");
        assert_eq!((parsed.target.colours, parsed.target.sizes), (vec![ColourName::Red], vec![SizeWord::Large]));
        let anchor = &parsed.relations[0].anchors[0];
        assert_eq!((&anchor.colours, &anchor.sizes), (&vec![ColourName::White], &vec![SizeWord::Small]));
    }

    #[test]
    fn what_an_anchor_carries_stays_with_the_anchor() {
        let parsed = parse("the stool in front of the white bookcase without books");
        let anchor = &parsed.relations[0].anchors[0];
        assert_eq!(anchor.head, "bookcase");
        assert!(anchor.with[0].absent && anchor.with[0].phrase.head == "books");
        assert!(parsed.target.with.is_empty());
    }

    #[test]
    fn strange_nouns_are_reported() {
        let parsed = parse("the shiny theremin on the desk");
        assert_eq!(parsed.target.head, "theremin");
        assert_eq!(parsed.not_understood, ["theremin", "shiny"]);
        assert_eq!(parsed.relations[0].anchors[0].head, "desk");
    }

    proptest! {
        #[test]
        fn any_text_is_read_without_panic(query in "\\PC{0,200}") {
            let _ = parse(&query);
        }

        #[test]
        fn any_order_of_known_words_is_read_without_panic(words in prop::collection::vec(prop::sample::select(vec![
            "the", "chair", "red", "between", "and", "on", "it", "is", "not", "facing", ",", "left", "of", "second", "from", "without", "theremin",
        ]), 0..30)) {
            let _ = parse(&words.join(" "));
        }
    }
}
