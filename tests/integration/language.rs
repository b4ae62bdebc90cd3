//! Language and geometry alone: questions over annotated objects with their names, without parsing.

use crate::shared_scenes::{development_rooms, shared_scene};
use camino::Utf8Path;
use std::fs;
use uniground::config::BundlesConfig;
use uniground_core::geometry::boxes::Aabb;
use uniground_core::grounding::{NameIndex, Question, SceneView, Status, ground};
use uniground_core::models::attributes::Lexicon;
use uniground_core::scene::{Instance, PointCloud};
use uniground_evaluation::annotations::Annotations;
use uniground_evaluation::configuration::{self, Configuration};
use uniground_evaluation::report::{CellReport, Report, RunFacts};
use uniground_evaluation::run::{RunOptions, run};
use uniground_evaluation::suite::{Suite, SuiteOptions};
use uniground_evaluation::systems::{InProcess, ModelUse, NamedBy, instances_of};

#[derive(serde::Deserialize)]
struct Expression {
    query: String,
    target_id: Option<u32>,
    kind: String,
}

/// A room as its annotations describe it.
struct AnnotatedScene {
    queries: Vec<Expression>,
    annotations: Annotations,
}

fn load_rooms(names: &[&'static str]) -> Option<Vec<(&'static str, AnnotatedScene)>> {
    let folder = shared_scene("room1.zip")?;
    let room = |name: &'static str| {
        let text = fs::read_to_string(folder.join(format!("{name}.queries.json"))).unwrap();
        let (annotations, omissions) =
            Annotations::read(&folder.join(format!("{name}.scene.json")));
        assert!(omissions.is_empty(), "{omissions:?}");
        (name, AnnotatedScene { queries: serde_json::from_str(&text).unwrap(), annotations })
    };
    Some(names.iter().map(|name| room(name)).collect())
}

fn instances(annotations: &Annotations) -> Vec<Instance> {
    instances_of(annotations, &PointCloud::default(), NamedBy::Annotated)
}

/// Returns whether an answer is the annotated one. Instance ids follow the order of the
/// annotations.
fn is_right(known: &Annotations, instances: &[Instance], query: &str, target: Option<u32>) -> bool {
    let corners: Vec<_> = instances.iter().flat_map(|i| i.aabb.corners()).collect();
    let view = SceneView {
        instances,
        extent: Aabb::around(&corners).unwrap(),
        names: &NameIndex::of(instances),
        appearance: None,
    };
    let question = Question::of(query);
    let answer = ground(view, &question);
    let chosen = answer.answer.predicted_id.map(|id| known.objects[id.0 as usize - 1].id);
    match target {
        Some(_) => chosen == target,
        None => answer.status == Status::NoMatch,
    }
}

/// Returns the number of correct answers and of questions, for the selected kinds.
fn score(
    known: &AnnotatedScene,
    annotations: &Annotations,
    words: impl Fn(&str) -> String,
    kinds: impl Fn(&str) -> bool,
) -> (usize, usize) {
    let instances = instances(annotations);
    let asked: Vec<&Expression> = known.queries.iter().filter(|q| kinds(&q.kind)).collect();
    let right = |q: &&&Expression| {
        let right = is_right(annotations, &instances, &words(&q.query), q.target_id);
        if !right {
            println!("  wrong: {}", words(&q.query));
        }
        right
    };
    (asked.iter().filter(right).count(), asked.len())
}

fn ratio((right, of): (usize, usize)) -> f32 {
    right as f32 / of as f32
}

/// Asserts the minimum accuracy of a room: questions with a target, relations and superlatives, and
/// absent objects.
fn assert_accuracy(
    name: &str,
    known: &AnnotatedScene,
    annotations: &Annotations,
    words: impl Fn(&str) -> String,
    skip_views: bool,
) {
    let counts = |kind: &str| kind != "absent" && !(skip_views && kind == "view");
    let present = score(known, annotations, &words, counts);
    let spatial =
        score(known, annotations, &words, |kind| matches!(kind, "relation" | "superlative"));
    let absent = score(known, annotations, &words, |kind| kind == "absent");
    println!(
        "{name}: {present:?} with a target, {spatial:?} relations and superlatives, {absent:?} absent"
    );
    assert!(ratio(present) >= 0.85 && ratio(spatial) >= 0.9 && absent.0 >= 5, "{name}");
}

#[test]
fn questions_about_annotated_rooms_are_answered() {
    for (name, known) in
        load_rooms(&["room1", "room2", "room3", "room4", "room5"]).unwrap_or_default()
    {
        assert_accuracy(name, &known, &known.annotations, str::to_owned, false);
    }
}

/// Only view-dependent questions depend on the direction of X.
#[test]
fn answers_do_not_depend_on_the_orientation_of_the_axes() {
    for (name, known) in load_rooms(&["room1", "room2"]).unwrap_or_default() {
        for deg in [20.0, 45.0, 73.0, 200.0] {
            assert_accuracy(
                &format!("{name} turned by {deg}"),
                &known,
                &known.annotations.rotated(deg),
                str::to_owned,
                true,
            );
        }
    }
}

/// Paraphrases: each noun becomes a synonym, relations are rephrased, and commands become
/// questions.
#[test]
fn paraphrased_questions_are_answered() {
    for (name, known) in load_rooms(&["room1", "room2"]).unwrap_or_default() {
        assert_accuracy(
            &format!("{name} in other words"),
            &known,
            &known.annotations,
            paraphrase,
            false,
        );
        // The inverted order: the anchor comes first.
        assert_accuracy(
            &format!("{name} turned round"),
            &known,
            &known.annotations,
            |query| format!("could you find this for me: {query}"),
            false,
        );
    }
}

fn paraphrase(query: &str) -> String {
    const OTHERWISE: [(&str, &str); 12] = [
        ("this is a ", "it is a "),
        ("find the ", "please locate the "),
        ("bring me the ", "i want the "),
        (" closest to ", " nearest to "),
        (" nearest to ", " closest to "),
        (" farthest from ", " furthest away from "),
        (" next to ", " beside "),
        (" beside ", " next to "),
        (" right beside ", " adjacent to "),
        (" under ", " underneath "),
        (" on top of ", " on "),
        (" tallest ", " tallest "),
    ];
    let mut words = format!(" {query} ");
    for (from, to) in OTHERWISE {
        if words.contains(from) {
            words = words.replace(from, to);
            break;
        }
    }
    // The longest noun of the sentence becomes the first synonym that stands only for it.
    let tokens: Vec<String> = words.split_whitespace().map(str::to_owned).collect();
    for length in (1..=3).rev() {
        for start in 0..tokens.len().saturating_sub(length - 1) {
            let noun = tokens[start..start + length].join(" ");
            let bare = noun.trim_end_matches([',', '.']);
            let Some(known) = Lexicon::get().nouns().iter().find(|n| n.name == bare) else {
                continue;
            };
            // Some words for "table" are narrower (kitchen table). Only words with a single meaning
            // have synonyms here.
            let Some(synonym) =
                known.synonyms.first().filter(|_| Lexicon::get().find_all(bare).len() == 1)
            else {
                continue;
            };
            let mut told = tokens[..start].to_vec();
            told.push(format!("{synonym}{}", &noun[bare.len()..]));
            told.extend_from_slice(&tokens[start + length..]);
            return told.join(" ");
        }
    }
    tokens.join(" ")
}

/// The whole system without a model. The quality gate checks the exact figure, this test a lower
/// bound.
#[test]
fn questions_about_parsed_rooms_are_answered_without_a_model() {
    let Some(rooms) = development_rooms(&["room1", "room2"]) else { return };
    let suite =
        Suite::open(Utf8Path::from_path(rooms.path()).unwrap(), &SuiteOptions::default()).unwrap();
    let out = tempfile::tempdir().unwrap();
    let cells = configuration::expand_matrix("source=parsed", &Configuration::default()).unwrap();
    let options = RunOptions {
        out: Utf8Path::from_path(out.path()).unwrap(),
        cells: &cells,
        concurrency: 1,
        progress: &|_| {},
    };
    let bundles = BundlesConfig::default();
    let results = run(
        &suite,
        &InProcess::new(&bundles.models, bundles.loader(), None, None, ModelUse::default())
            .unwrap(),
        &options,
    )
    .unwrap();
    let facts = RunFacts {
        system: "in process".into(),
        version: String::new(),
        label: None,
        machine: String::new(),
        written_at: String::new(),
        paper_compatible: false,
        seed: 0,
    };
    let report = Report::new(&suite, facts, results);
    let [CellReport { figures, .. }] = &report.cells[..] else { panic!() };
    println!(
        "Acc@0.25 {:?}, first candidate {:?}, absent {:?}",
        figures.complete[0], figures.recall_at[0], figures.abstention
    );
    assert!(figures.complete[0].value >= 0.35, "{:?}", figures.complete);
}

/// Words that name no object never get a box.
#[test]
fn words_that_name_no_object_get_no_box() {
    let Some(rooms) = load_rooms(&["room1", "room2"]) else { return };
    let instances = instances(&rooms[0].1.annotations);
    let corners: Vec<_> = instances.iter().flat_map(|i| i.aabb.corners()).collect();
    let view = SceneView {
        instances: &instances,
        extent: Aabb::around(&corners).unwrap(),
        names: &NameIndex::of(&instances),
        appearance: None,
    };
    for query in [
        "?",
        "the of and",
        "🪑",
        "椅子",
        "'; DROP TABLE scenes; --",
        "the red chair that is not red",
        "the",
    ] {
        let question = Question::of(query);
        let answer = ground(view, &question);
        assert!(answer.status != Status::Grounded && answer.aabb.is_none(), "{query}: {answer:?}");
    }
}
