use super::*;
use crate::answer::NOTHING_CLEARLY;
use crate::direction::{DirectionConvention, Observer};
use crate::{Grounding, NameIndex, Question, SceneView, SixFields, Timings, ground};
use uniground_geometry::boxes::Aabb;
use uniground_geometry::scene::{Instance, InstanceId, NameGuess, Structure, Support};
use uniground_geometry::{Point3, Vector3};
use uniground_models::attributes;
use uniground_testing::thing;

/// Returns a small room: two sofas, a table with two mugs, a rug.
fn room() -> Vec<Instance> {
    let on_table = Support::Instance { id: InstanceId(3) };
    let mut instances = vec![
        thing(1, [-2.0, 0.0], [2.1, 0.9, 0.8], 0.0, Support::Floor, [180, 40, 40]),
        thing(2, [2.0, 0.0], [2.0, 0.9, 0.8], 0.0, Support::Floor, [40, 60, 170]),
        thing(3, [0.0, 1.5], [1.25, 0.8, 0.74], 0.0, Support::Floor, [110, 75, 45]),
        thing(4, [-0.5, 1.5], [0.11, 0.09, 0.1], 0.74, on_table, [200, 30, 30]),
        thing(5, [0.5, 1.5], [0.11, 0.09, 0.1], 0.74, on_table, [30, 60, 180]),
        thing(6, [0.0, -0.5], [2.0, 1.4, 0.01], 0.0, Support::Floor, [120, 60, 60]),
    ];
    instances.iter_mut().for_each(|i| i.names = attributes::name_guesses(i));
    instances
}

fn ask_with(query: &str, convention: DirectionConvention, observer: Option<Observer>) -> Grounding {
    let instances = room();
    let extent = Aabb { center: Point3::new(0.0, 0.0, 1.3), size: Vector3::new(7.0, 5.0, 2.6) };
    let question = Question { convention, observer, ..Question::of(query) };
    ground(
        SceneView { instances: &instances, extent, names: &NameIndex::default(), appearance: None },
        &question,
    )
}

fn ask(query: &str) -> Grounding {
    ask_with(query, DirectionConvention::Paper, None)
}

#[test]
fn names_attributes_and_relations_pick_the_right_instance() {
    for (query, expected) in [
        ("the rug", 6),
        ("the red sofa", 1),
        ("the blue mug on the table", 5),
        ("the mug closest to the red sofa", 4),
        ("the sofa nearest to the blue mug", 2),
        ("the mug farthest from the red sofa", 5),
        ("the sofa that is not red", 2),
        ("the mug that is not blue on the table", 4),
        ("the table with two mugs", 3),
        ("the mug closest to the table and the red sofa", 4),
        ("the second closest mug to the blue sofa", 4),
        ("standing at the blue sofa, the nearest mug", 5),
        ("as seen from the table, the sofa on the left", 2),
        ("something to sit on that is blue", 2),
        ("the sofa, but not the red one", 2),
    ] {
        let answer = ask(query);
        assert_eq!(
            answer.answer.predicted_id,
            Some(InstanceId(expected)),
            "{query}: {}",
            answer.answer.explanation
        );
        assert_eq!(answer.status, Status::Grounded);
        assert!(answer.aabb.is_some() && answer.oriented_box.is_some());
    }
}

#[test]
fn answer_reports_anchor_and_relation() {
    let answer = ask("the blue mug on the table").answer;
    assert_eq!(
        (answer.anchor_id, answer.relation_used.as_deref()),
        (Some(InstanceId(3)), Some("on the table"))
    );
    assert!(answer.explanation.contains("instance 3"), "{}", answer.explanation);
}

#[test]
fn explanation_says_when_an_anchor_has_another_name() {
    // There is no cabinet: the table has the size of one.
    let answer = ask("the blue mug on the cabinet").answer;
    assert_eq!(
        (answer.predicted_id, answer.anchor_id),
        (Some(InstanceId(5)), Some(InstanceId(3))),
        "{}",
        answer.explanation
    );
    assert!(answer.explanation.contains(", the likeliest \"cabinet\")"), "{}", answer.explanation);
    let as_called = ask("the blue mug on the table").answer.explanation;
    assert!(!as_called.contains("the likeliest"), "{as_called}");
}

#[test]
fn explanation_says_when_the_view_differs_from_the_convention() {
    // By the paper's convention +X is left. For a viewer who faces the table from the middle of
    // the room, +X is on the right.
    for (query, faced) in
        [("the red sofa left of the table", true), ("the red sofa right of the table", false)]
    {
        let SixFields { predicted_id, explanation, .. } = ask(query).answer;
        assert_eq!(predicted_id, Some(InstanceId(1)), "{query}: {explanation}");
        assert_eq!(
            explanation.contains("as who faces it sees it"),
            faced,
            "{query}: {explanation}"
        );
    }
}

/// Returns the answer in a room whose instances have their names from a person.
fn ask_named(query: &str) -> Grounding {
    let mut named = room();
    named.iter_mut().for_each(|instance| instance.given_name = Some(instance.label().into()));
    let extent = Aabb { center: Point3::new(0.0, 0.0, 1.3), size: Vector3::new(7.0, 5.0, 2.6) };
    let names = NameIndex::of(&named);
    let scene = SceneView { instances: &named, extent, names: &names, appearance: None };
    ground(scene, &Question::of(query))
}

#[test]
fn absent_and_unknown_objects_get_no_box() {
    for query in ["the chandelier", "the green sofa", "the theremin", "the green mug on the table"]
    {
        let answer = ask_named(query);
        assert_eq!(
            (answer.status, answer.aabb, answer.answer.predicted_id),
            (Status::NoMatch, None, None),
            "{query}: {answer:?}"
        );
    }
}

#[test]
fn guessed_names_deny_no_object() {
    for query in ["the chandelier", "the green sofa"] {
        let mut answer = ask(query);
        answer.require_confidence(0.7);
        assert_eq!(answer.status, Status::Uncertain, "{query}: {answer:?}");
        assert!(answer.confidence < 0.2, "{query}: {answer:?}");
    }
    // Most things have names: what is not among them is not there.
    let mut named = room();
    named.iter_mut().skip(1).for_each(|it| it.given_name = Some(it.label().into()));
    let extent = Aabb { center: Point3::new(0.0, 0.0, 1.3), size: Vector3::new(7.0, 5.0, 2.6) };
    let names = NameIndex::of(&named);
    let scene = SceneView { instances: &named, extent, names: &names, appearance: None };
    assert_eq!(ground(scene, &Question::of("the chandelier")).status, Status::NoMatch);
    // Nothing is in a missing thing, but the best of its kind is offered.
    let mut answer = ask("the red mug with a chandelier in it");
    answer.require_confidence(0.7);
    assert_eq!(answer.status, Status::Uncertain, "{answer:?}");
    assert!(answer.aabb.is_some() && answer.confidence < 0.7, "{answer:?}");
    // A list may be empty. How sure that is, nobody knows.
    let none = ask("all the chandeliers");
    assert_eq!((none.status, none.count), (Status::NoMatch, Some(0)));
    assert!(none.confidence <= 0.5, "{none:?}");
}

#[test]
fn an_answer_whose_object_has_other_names_is_uncertain() {
    let mut answer = ask("the red mug");
    assert_eq!(answer.status, Status::Grounded, "{answer:?}");
    answer.text = format!("{NOTHING_CLEARLY} a mug.");
    answer.require_confidence(0.0);
    assert_eq!(answer.status, Status::Grounded);
    answer.require_confidence(answer.confidence / 2.0);
    assert_eq!(answer.status, Status::Uncertain);
}

#[test]
fn ties_are_reported_as_ambiguous() {
    let answer = ask("the mug");
    assert_eq!((answer.status, answer.aabb), (Status::Ambiguous, None));
    let mut tied: Vec<_> = answer.alternatives.iter().take(2).map(|a| a.id.0).collect();
    tied.sort_unstable();
    assert_eq!(tied, [4, 5]);
}

#[test]
fn left_depends_on_the_viewer() {
    // Mugs 4 (x = -0.5) and 5 (x = 0.5) stand side by side along X.
    let predicted = |answer: Grounding| answer.answer.predicted_id.map(|id| id.0);
    assert_eq!(predicted(ask_with("the leftmost mug", DirectionConvention::Viewer, None)), Some(4));
    // The convention is the default one, and no viewer stands behind the table, where the room
    // ends.
    assert_eq!(predicted(ask_with("the leftmost mug", DirectionConvention::Paper, None)), Some(4));
    let from_behind = Observer { position: [0.0, 4.0, 1.5], yaw_rad: -std::f32::consts::FRAC_PI_2 };
    let answer = ask_with("the leftmost mug", DirectionConvention::Viewer, Some(from_behind));
    assert_eq!(answer.direction_convention, "observer");
    assert_eq!(predicted(answer), Some(5));
    assert_eq!(predicted(ask("facing the table, the mug on the left")), Some(4));
}

#[test]
fn plural_questions_return_all_targets_and_their_count() {
    for (query, ids) in [
        ("how many mugs are there?", vec![4, 5]),
        ("both sofas", vec![1, 2]),
        ("all the mugs on the table", vec![4, 5]),
        ("the red mugs", vec![4]),
        ("the tables", vec![3]),
    ] {
        let answer = ask(query);
        let mut found: Vec<u32> = answer.targets.iter().map(|target| target.id.0).collect();
        found.sort_unstable();
        assert_eq!(
            (answer.status, &found, answer.count),
            (Status::Grounded, &ids, Some(ids.len() as u32)),
            "{query}"
        );
        assert_eq!(answer.answer.predicted_id, answer.targets.first().map(|target| target.id));
    }
    assert_eq!(
        (ask("how many chandeliers do we have").status, ask("the chandeliers").count),
        (Status::NoMatch, Some(0))
    );
    let one = ask("the rug");
    assert_eq!((one.count, one.targets.len(), one.targets[0].id), (None, 1, InstanceId(6)));
}

#[test]
fn hanging_on_the_wall_prefers_wall_supported_instances() {
    let mut instances = room();
    // Books on the table reach higher than the clock on the wall behind them.
    let wall = Instance {
        structure: Some(Structure::Wall),
        ..thing(7, [0.0, 2.1], [6.0, 0.1, 2.6], 0.0, Support::Floor, [200; 3])
    };
    let books = thing(
        8,
        [0.0, 1.9],
        [0.4, 0.25, 1.3],
        0.74,
        Support::Instance { id: InstanceId(3) },
        [90, 60, 40],
    );
    let clock = thing(
        9,
        [1.5, 2.0],
        [0.3, 0.05, 0.3],
        1.4,
        Support::Wall { id: InstanceId(7) },
        [90, 60, 40],
    );
    instances.extend([wall, books, clock]);
    instances.iter_mut().for_each(|i| i.names = attributes::name_guesses(i));
    let extent = Aabb { center: Point3::new(0.0, 0.0, 1.3), size: Vector3::new(7.0, 5.0, 2.6) };
    let scene =
        SceneView { instances: &instances, extent, names: &NameIndex::default(), appearance: None };
    let answer = ground(scene, &Question::of("the highest thing hanging on the wall"));
    assert_eq!(answer.answer.predicted_id, Some(InstanceId(9)), "{}", answer.answer.explanation);
}

#[test]
fn viewpoint_comes_from_seats_and_faced_objects() {
    // Seen from the only seat at the table, which is behind it, +X is on the left.
    let mut instances = room();
    let chair = thing(7, [0.0, 2.3], [0.45, 0.45, 0.9], 0.0, Support::Floor, [90, 60, 40]);
    instances.push(chair);
    instances.iter_mut().for_each(|i| i.names = attributes::name_guesses(i));
    let extent = Aabb { center: Point3::new(0.0, 0.0, 1.3), size: Vector3::new(7.0, 5.0, 2.6) };
    let scene =
        SceneView { instances: &instances, extent, names: &NameIndex::default(), appearance: None };
    let id = |query: &str| ground(scene, &Question::of(query)).answer.predicted_id.map(|id| id.0);
    assert_eq!(id("sitting at the table, the mug on the left"), Some(5));
    assert_eq!(id("facing the table, the mug on the left"), Some(4), "from the middle of the room");
    assert_eq!(id("facing the table, the mug on the left side of the table"), Some(4));
    // There is no piano: the viewer is assumed to face the mugs.
    assert_eq!(id("facing the piano, the mug on the left"), Some(4));
}

#[test]
fn observer_position_resolves_me_and_nearest() {
    let from = |query: &str, x: f32, yaw_rad: f32| {
        ask_with(
            query,
            DirectionConvention::Paper,
            Some(Observer { position: [f64::from(x), 0.5, 1.5], yaw_rad }),
        )
    };
    let predicted = |answer: &Grounding| answer.answer.predicted_id.map(|id| id.0);
    for (query, x, yaw_rad, expected) in [
        ("the sofa closest to me", -1.0, 0.0, 1),
        ("the sofa closest to me", 1.0, 0.0, 2),
        ("the nearest sofa", 1.0, 0.0, 2),
        ("the sofa in front of me", 0.0, 0.0, 2),
        ("the sofa behind me", 0.0, 0.0, 1),
        ("the sofa in front of me", 0.0, std::f32::consts::PI, 1),
    ] {
        let answer = from(query, x, yaw_rad);
        assert_eq!(
            predicted(&answer),
            Some(expected),
            "{query} from {x} along {yaw_rad}: {}",
            answer.answer.explanation
        );
        assert!(
            answer.parsed_query.not_understood.is_empty(),
            "{query}: {:?}",
            answer.parsed_query
        );
    }
    let explained = from("the sofa closest to me", -1.0, 0.0).answer.explanation;
    assert!(explained.contains("; closest to you, "), "{explained}");
    let nowhere = ask("the sofa closest to me");
    assert_eq!(nowhere.parsed_query.not_understood, ["me"]);
    let explained = ask("the red sofa closest to me").answer.explanation;
    let expected = "\"closest to me\" is not checked, as the request has no observer";
    assert!(explained.contains(expected), "{explained}");
}

#[test]
fn no_match_answers_have_a_reason() {
    for (query, reason) in [
        ("the chandelier", NoMatchReason::Absent),
        ("the green sofa", NoMatchReason::Absent),
        ("the quux", NoMatchReason::NotRecognised),
        ("das blaue Sofa neben dem Tisch", NoMatchReason::NotEnglish),
    ] {
        assert_eq!(ask_named(query).no_match_reason, Some(reason), "{query}");
    }
    assert_eq!(ask("the rug").no_match_reason, None);
    // Only names that were given deny a relation.
    let mut named = room();
    named[0].given_name = Some("sofa".into());
    named[1].given_name = Some("sofa".into());
    let extent = Aabb { center: Point3::new(0.0, 0.0, 1.3), size: Vector3::new(7.0, 5.0, 2.6) };
    let names = NameIndex::of(&named);
    let scene = SceneView { instances: &named, extent, names: &names, appearance: None };
    let elsewhere = ground(scene, &Question::of("the sofa on the table"));
    assert_eq!(elsewhere.no_match_reason, Some(NoMatchReason::Elsewhere), "{elsewhere:?}");
    assert_eq!(ask("the sofa on the table").no_match_reason, None);
}

#[test]
fn explanations_say_when_names_are_guesses() {
    let explained = |instances: &[Instance], query: &str| {
        let extent = Aabb { center: Point3::new(0.0, 0.0, 1.3), size: Vector3::new(7.0, 5.0, 2.6) };
        let names = NameIndex::of(instances);
        let scene = SceneView { instances, extent, names: &names, appearance: None };
        let answer = ground(scene, &Question::of(query));
        (answer.answer.explanation.ends_with(NAMES_ARE_GUESSES), answer.confidence)
    };
    let mut instances = room();
    for query in ["the red sofa", "the mug", "the fridge", "both sofas"] {
        assert!(explained(&instances, query).0, "{query}");
    }
    for query in ["the quux", "the red thing"] {
        assert!(!explained(&instances, query).0, "{query}");
    }
    // A name that a person gave, and a wall that is flat.
    let guessed = explained(&instances, "the red sofa").1;
    instances[0].given_name = Some("sofa".into());
    let (is_guess, given) = explained(&instances, "the red sofa");
    assert!(!is_guess && given > guessed, "{given} and {guessed}");
    instances[0].given_name = None;
    instances[0].structure = Some(Structure::Wall);
    assert!(!explained(&instances, "the wall").0);
    assert!(explained(&instances, "the red sofa").0);
}

#[test]
fn weak_measured_fit_requires_the_noun_as_first_guess() {
    let guess = |name: &str, score: f32| NameGuess { name: name.to_owned(), score };
    let asked = |names: [NameGuess; 2]| {
        let mut instances = room();
        let green = thing(
            7,
            [2.7, 1.4],
            [0.715, 0.616, 0.49],
            0.85,
            Support::Instance { id: InstanceId(3) },
            [40, 140, 50],
        );
        instances.push(Instance { names: names.to_vec(), ..green });
        let extent = Aabb { center: Point3::new(0.0, 0.0, 1.3), size: Vector3::new(7.0, 5.0, 2.6) };
        let scene = SceneView {
            instances: &instances,
            extent,
            names: &NameIndex::default(),
            appearance: None,
        };
        ground(scene, &Question::of("the green fridge"))
    };
    // Measures never deny what may be there, but the answer says that it has another name.
    let plant = asked([guess("plant", 0.5), guess("box", 0.3)]);
    assert_eq!(plant.answer.predicted_id, Some(InstanceId(7)), "{plant:?}");
    assert_eq!(plant.answer.target_name_matches, Some(false), "{plant:?}");
    let text = "I found nothing that is clearly a green fridge. The likeliest is the green plant";
    assert!(plant.text.starts_with(text) && plant.confidence < 0.5, "{plant:?}");
    let fridge = asked([guess("mini fridge", 0.5), guess("plant", 0.3)]);
    assert_eq!(fridge.answer.predicted_id, Some(InstanceId(7)), "{fridge:?}");
}

#[test]
fn unchecked_words_lower_confidence_but_keep_the_answer() {
    let (plain, with_more) =
        (ask("the red sofa"), ask("the red sofa with the brass studs by the quux"));
    assert_eq!(plain.answer.predicted_id, with_more.answer.predicted_id);
    assert!(
        with_more.status == Status::Grounded && with_more.confidence < 0.7 * plain.confidence,
        "{}",
        with_more.confidence
    );
}

#[test]
fn confidence_below_the_minimum_makes_the_answer_uncertain() {
    let sure = ask("the red sofa with the brass studs by the quux");
    let mut answer = sure.clone();
    answer.require_confidence(sure.confidence);
    assert_eq!(answer, sure);
    answer.require_confidence(sure.confidence + 0.01);
    let text = format!("I am not sure. {}", sure.text);
    assert_eq!(answer, Grounding { status: Status::Uncertain, text, ..sure });
}

#[test]
fn the_same_question_gives_the_same_answer() {
    let strip = |mut answer: Grounding| {
        answer.timings_ms = Timings::default();
        answer
    };
    assert_eq!(
        strip(ask("the mug closest to the red sofa")),
        strip(ask("the mug closest to the red sofa"))
    );
}
