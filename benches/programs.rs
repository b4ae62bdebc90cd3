//! Parsing of sentences that people wrote, compared with the visual programs of ZSVG3D: `make
//! bench-programs PROGRAMS=folder`, or `cargo bench --bench programs -- [--list
//! target|anchor|relation] [--of 4] [--rest 0] FOLDER`.
//!
//! The folder holds `nr3d_val.json` and `scanrefer_val.json` of the public repository
//! `CurryYuan/ZSVG3D`: for each sentence a program that a chat model wrote,
//! `BOX0=LOC(object='chair')`, `TARGET=CLOSEST(targets=BOX0, anchors=BOX1)`. They are for measuring
//! only and not part of this project. Only scenes with an even number from 100 on are read; the
//! others are held out for final evaluation. `--of 4 --rest 2` takes only scenes 4n + 2. The bench
//! compares:
//!
//! - **target**: the noun that the last statement reaches through `targets`;
//! - **anchors**: for each `LOC` used as an anchor on that path, whether the parse has an object of
//!   that noun besides the target;
//! - **relation**: for each operation on the path, whether the parse gives the target one of its
//!   meanings in [`MEANINGS`]. Operations that are not listed there are counted but not compared.
//!
//! Programs are often wrong ("in front of a chair" becomes `RIGHT`), so relations are also counted
//! only where the sentence has a word of the operation ([`OPERATION_WORDS`]).

#![allow(missing_docs, clippy::unwrap_used)] // a bench that can not set up has nothing to measure

use camino::Utf8PathBuf;
use comfy_table::{Table, presets};
use serde::Deserialize;
use std::collections::{BTreeMap, BTreeSet};
use uniground_core::language::{Measure, ParsedQuery, Phrase, RelationKind, Trait, parse};
use uniground_core::models::attributes::Lexicon;

/// Operations, and what a parse may contain for each: a kind of relation, a superlative or a trait.
const MEANINGS: [(&str, &[&str]); 24] = [
    (
        "CLOSEST",
        &["closest", "near", "around", "leaning", "against_wall", "in_corner", "on", "inside"],
    ),
    ("NEAR", &["closest", "near", "around", "leaning", "on", "inside"]),
    ("FARTHEST", &["farthest", "far", "opposite"]),
    ("LEFT", &["left_of", "leftmost"]),
    ("RIGHT", &["right_of", "rightmost"]),
    ("LEFTMOST", &["left_of", "leftmost"]),
    ("RIGHTMOST", &["right_of", "rightmost"]),
    ("FRONT", &["in_front_of", "frontmost", "facing"]),
    ("IN_FRONT_OF", &["in_front_of", "frontmost", "facing"]),
    ("BEHIND", &["behind", "backmost"]),
    ("BETWEEN", &["between", "middle", "around"]),
    ("MID", &["middle", "in_middle", "between"]),
    ("HIGHER", &["above", "on", "highest", "tallest", "tall", "largest"]),
    ("ABOVE", &["above", "on", "highest"]),
    ("ON", &["above", "on", "inside"]),
    ("ON_TOP", &["above", "on", "inside"]),
    ("HIGHEST", &["highest", "tallest", "tall", "above"]),
    ("LOWER", &["below", "lowest", "carrying", "inside", "low", "shortest"]),
    ("UNDER", &["below", "lowest", "carrying"]),
    ("LOWEST", &["lowest", "below", "shortest", "low"]),
    ("MAX", &["largest", "tallest", "large", "tall", "long", "highest", "light"]),
    ("MIN", &["smallest", "shortest", "small", "low", "lowest", "dark"]),
    ("OPPOSITE", &["opposite", "facing", "in_front_of"]),
    ("FACING", &["opposite", "facing", "in_front_of"]),
];

/// Prefixes of words that express an operation in a sentence.
const OPERATION_WORDS: [(&str, &[&str]); 12] = [
    ("LEFT", &["left"]),
    ("RIGHT", &["right"]),
    ("FRONT", &["front"]),
    ("BEHIND", &["behind", "back"]),
    ("BETWEEN", &["between", "middle", "among", "surround"]),
    ("MID", &["middle", "center", "centre", "between"]),
    ("HIGHER", &["above", "over", "top", "upper", "on", "hang", "higher", "tall", "mount"]),
    ("HIGHEST", &["top", "upper", "highest", "high", "tall"]),
    ("LOWER", &["under", "below", "beneath", "lower", "bottom"]),
    ("LOWEST", &["bottom", "lowest", "lower", "short"]),
    ("FARTHEST", &["far", "furth"]),
    (
        "CLOSEST",
        &[
            "close",
            "near",
            "next",
            "by",
            "beside",
            "adjacent",
            "against",
            "at",
            "along",
            "alongside",
            "around",
        ],
    ),
];

#[derive(Deserialize)]
struct Sentence {
    scan_id: String,
    caption: String,
    program: String,
}

impl Sentence {
    /// Returns the scene number: `scene0678_00` is 678.
    fn scene(&self) -> u32 {
        self.scan_id.trim_start_matches("scene").split('_').next().unwrap().parse().unwrap()
    }
}

/// What a program states about its target.
#[derive(Debug, Default)]
struct Program {
    target: String,
    anchors: BTreeSet<String>,
    operations: BTreeSet<String>,
}

/// Returns the values of `key=`: one name, or several in brackets.
fn argument<'a>(call: &'a str, key: &str) -> Option<&'a str> {
    let start = call.find(&format!("{key}="))? + key.len() + 1;
    let rest = &call[start..];
    match rest.as_bytes().first()? {
        b'[' => rest[1..].split(']').next(),
        _ => rest.split([',', ')']).next(),
    }
    .map(str::trim)
}

impl Program {
    /// Returns `None` if the last statement does not lead to a located object.
    fn of(text: &str) -> Option<Self> {
        let statements: Vec<(&str, &str)> = text
            .lines()
            .filter_map(|line| line.split_once('=').map(|(name, call)| (name.trim(), call.trim())))
            .collect();
        let mut program = Self::default();
        let last = statements.len().checked_sub(1)?;
        program.follow(&statements, last, false);
        (!program.target.is_empty()).then_some(program)
    }

    fn follow(&mut self, statements: &[(&str, &str)], at: usize, anchor: bool) {
        let call = statements[at].1;
        let operation = call.split('(').next().unwrap_or_default();
        let named =
            |name: &str| statements[..at].iter().rposition(|(said, _)| *said == name.trim());
        if operation == "LOC" {
            let object = call
                .split_once(['\'', '"'])
                .map_or("", |(_, rest)| rest.trim_end_matches([')', '\'', '"']));
            if anchor {
                self.anchors.insert(object.to_owned());
            } else {
                object.clone_into(&mut self.target);
            }
            return;
        }
        if !anchor {
            self.operations.insert(operation.to_owned());
        }
        let targets =
            ["targets", "data", "values", "boxes"].iter().find_map(|key| argument(call, key));
        if let Some(at) = targets.and_then(|names| names.split(',').find_map(named)) {
            self.follow(statements, at, anchor);
        }
        for at in argument(call, "anchors")
            .into_iter()
            .flat_map(|names| names.split(','))
            .filter_map(named)
        {
            self.follow(statements, at, true);
        }
    }
}

/// Returns whether a parse's noun matches the program's phrase: the same word, the same lexicon
/// entry, or the end of the phrase.
fn is_same_noun(head: &str, said: &str) -> bool {
    let meant = parse(said).target;
    let lexicon = Lexicon::get();
    let things = |word: &str| {
        lexicon.find_all(word).iter().map(|noun| noun.name.clone()).collect::<BTreeSet<_>>()
    };
    let one = |word: &str| word.strip_suffix('s').unwrap_or(word).to_owned();
    let same = |a: &str, b: &str| {
        !a.is_empty() && (one(a) == one(b) || !things(a).is_disjoint(&things(b)))
    };
    let last = said.split(' ').next_back().unwrap_or_default();
    same(head, &meant.head)
        || same(head, last)
        || same(head.split(' ').next_back().unwrap_or_default(), last)
}

/// Returns every object that a phrase mentions besides its own.
fn other_nouns<'a>(phrase: &'a Phrase, into: &mut Vec<&'a Phrase>) {
    let carried = phrase.with.iter().map(|with| &with.phrase);
    for other in phrase.relations.iter().flat_map(|relation| &relation.anchors).chain(carried) {
        into.push(other);
        other_nouns(other, into);
    }
}

/// Returns everything that a parse states about its target, in words of [`MEANINGS`].
fn target_statements(read: &ParsedQuery) -> BTreeSet<&'static str> {
    let phrases = [Some(&read.target), read.other_reading.as_ref()];
    let of = |phrase: &Phrase| {
        let relations = phrase.relations.iter().map(|relation| relation.kind.as_str());
        let traits = phrase.traits.iter().map(|seen| seen.as_str());
        relations
            .chain(traits)
            .chain(phrase.superlative.map(|superlative| superlative.measure.as_str()))
            .collect::<Vec<_>>()
    };
    phrases.into_iter().flatten().flat_map(of).collect()
}

/// Formats a count of correct results.
#[derive(Default, Clone, Copy)]
struct Share {
    right: u32,
    of: u32,
}

impl Share {
    fn count(&mut self, right: bool) {
        self.right += u32::from(right);
        self.of += 1;
    }
    fn shown(self) -> String {
        format!("{:.3} of {}", f64::from(self.right) / f64::from(self.of.max(1)), self.of)
    }
}

#[derive(Default)]
struct Agreement {
    target: Share,
    anchors: Share,
    relations: Share,
    relations_said: Share,
    uncompared: BTreeMap<String, u32>,
    by_operation: BTreeMap<&'static str, (Share, Share)>,
}

fn compare(sentence: &Sentence, list: Option<&str>, agreement: &mut Agreement) {
    let Some(program) = Program::of(&sentence.program) else { return };
    let read = parse(&sentence.caption);
    let disagreed = |class: &str, what: &str| {
        if list == Some(class) {
            let anchors: Vec<String> = {
                let mut all = Vec::new();
                other_nouns(&read.target, &mut all);
                all.iter().map(|phrase| phrase.text()).collect()
            };
            println!(
                "{what}\t{}\t[{}] {anchors:?} {:?} ?{:?}",
                sentence.caption,
                read.target.text(),
                target_statements(&read),
                read.not_understood
            );
        }
    };
    let target = is_same_noun(&read.target.head, &program.target);
    agreement.target.count(target);
    if !target {
        disagreed("target", &program.target);
    }
    let mut named: Vec<&Phrase> = Vec::new();
    other_nouns(&read.target, &mut named);
    if let Some(other) = &read.other_reading {
        other_nouns(other, &mut named);
    }
    let seen_from =
        read.viewpoint.iter().map(|viewpoint| &viewpoint.anchor).chain(&read.standpoint);
    named.extend(seen_from);
    for anchor in &program.anchors {
        let found = named.iter().any(|phrase| is_same_noun(&phrase.head, anchor));
        agreement.anchors.count(found);
        if !found {
            disagreed("anchor", anchor);
        }
    }
    let said = target_statements(&read);
    let words = sentence.caption.to_lowercase();
    for operation in &program.operations {
        let Some((operation, meant)) = MEANINGS.iter().find(|(known, _)| known == operation) else {
            *agreement.uncompared.entry(operation.clone()).or_default() += 1;
            continue;
        };
        let right = meant.iter().any(|word| said.contains(word));
        let (all, told) = agreement.by_operation.entry(operation).or_default();
        agreement.relations.count(right);
        all.count(right);
        let is_said = OPERATION_WORDS.iter().find(|(known, _)| known == operation).is_none_or(
            |(_, beginnings)| {
                words
                    .split(|c: char| !c.is_alphanumeric())
                    .any(|word| beginnings.iter().any(|beginning| word.starts_with(beginning)))
            },
        );
        if is_said {
            agreement.relations_said.count(right);
            told.count(right);
            if !right {
                disagreed("relation", operation);
            }
        }
    }
}

fn main() {
    // A word of `MEANINGS` that no parse can contain would always count as wrong.
    let known: Vec<&str> = RelationKind::ALL
        .iter()
        .map(|kind| kind.as_str())
        .chain(Measure::ALL.iter().map(|measure| measure.as_str()))
        .chain(Trait::ALL.iter().map(|seen| seen.as_str()))
        .collect();
    assert!(MEANINGS.iter().flat_map(|(_, words)| *words).all(|word| known.contains(word)));
    let (mut folder, mut list, mut of, mut rest) = (None, None, 2, 0);
    let mut args = std::env::args().skip(1).filter(|arg| arg != "--bench");
    while let Some(arg) = args.next() {
        match arg.as_str() {
            "--read" => {
                println!("{:#?}", parse(&args.next().unwrap()));
                return;
            }
            "--list" => list = args.next(),
            "--of" => of = args.next().unwrap().parse().unwrap(),
            "--rest" => rest = args.next().unwrap().parse().unwrap(),
            path => folder = Some(Utf8PathBuf::from(path)),
        }
    }
    let Some(folder) = folder else {
        println!(
            "skipped: no folder with nr3d_val.json and scanrefer_val.json was given (make bench-programs PROGRAMS=folder)"
        );
        return;
    };
    let mut table = Table::new();
    table.load_preset(presets::ASCII_MARKDOWN);
    table.set_header(["sentences", "target", "anchors", "relation", "relation, where it is said"]);
    let mut by_operation = Table::new();
    by_operation.load_preset(presets::ASCII_MARKDOWN);
    by_operation.set_header(["sentences", "operation", "agrees", "agrees if stated"]);
    for file in ["nr3d_val", "scanrefer_val"] {
        let sentences: Vec<Sentence> = serde_json::from_str(
            &std::fs::read_to_string(folder.join(format!("{file}.json"))).unwrap(),
        )
        .unwrap();
        let open = sentences.iter().filter(|sentence| {
            sentence.scene() >= 100
                && sentence.scene().is_multiple_of(2)
                && sentence.scene() % of == rest
        });
        let mut agreement = Agreement::default();
        open.for_each(|sentence| compare(sentence, list.as_deref(), &mut agreement));
        let Agreement {
            target,
            anchors,
            relations,
            relations_said,
            uncompared,
            by_operation: operations,
        } = agreement;
        table.add_row([
            file.to_owned(),
            target.shown(),
            anchors.shown(),
            relations.shown(),
            relations_said.shown(),
        ]);
        for (operation, (all, told)) in operations {
            by_operation.add_row([file, operation, &all.shown(), &told.shown()]);
        }
        println!(
            "{file}, not compared: {}",
            uncompared.iter().map(|(name, n)| format!("{name} {n}")).collect::<Vec<_>>().join(", ")
        );
    }
    println!("{table}\n{by_operation}");
}
