use super::*;
use crate::direction::Observer;
use crate::{NameIndex, Region, Unit, ground};
use uniground_geometry::boxes::Aabb;
use uniground_geometry::scene::{Structure, Support};
use uniground_geometry::{Point3, Vector3};
use uniground_testing::thing;

fn named(
    id: u32,
    name: &str,
    at: [f32; 2],
    size: [f32; 3],
    base: f32,
    support: Support,
) -> Instance {
    let instance = thing(id, at, size, base, support, [90; 3]);
    Instance { given_name: Some(name.into()), ..instance }
}

/// Returns a desk with a laptop and two mugs, a sofa of 2 m with a stool of 0.4 m next to it, a
/// lamp of 1.5 m, and the floor.
fn room() -> Vec<Instance> {
    let on_desk = Support::Instance { id: InstanceId(1) };
    let floor = named(8, "floor", [0.0, 0.0], [6.0, 5.0, 0.1], -0.1, Support::Nothing);
    vec![
        named(1, "desk", [-2.0, 0.0], [1.4, 0.7, 0.75], 0.0, Support::Floor),
        named(2, "laptop", [-2.0, 0.0], [0.3, 0.2, 0.2], 0.75, on_desk),
        named(3, "red mug", [-2.5, 0.1], [0.1, 0.1, 0.1], 0.75, on_desk),
        named(4, "blue mug", [-1.5, 0.1], [0.1, 0.1, 0.1], 0.75, on_desk),
        named(5, "sofa", [2.0, 0.0], [2.0, 0.9, 0.8], 0.0, Support::Floor),
        named(6, "stool", [2.0, 1.0], [0.4, 0.4, 0.4], 0.0, Support::Floor),
        named(7, "floor lamp", [0.0, -2.0], [0.3, 0.3, 1.5], 0.0, Support::Floor),
        Instance { structure: Some(Structure::Floor), ..floor },
    ]
}

fn ask_with(question: &Question) -> Grounding {
    ask_in(&room(), question)
}

fn ask_in(instances: &[Instance], question: &Question) -> Grounding {
    let names = NameIndex::of(instances);
    let extent = Aabb { center: Point3::new(0.0, 0.0, 1.2), size: Vector3::new(6.0, 5.0, 2.5) };
    let scene = SceneView { instances, extent, names: &names, appearance: None };
    ground(scene, question)
}

fn ask(query: &str) -> Grounding {
    ask_with(&Question::of(query))
}

fn targets(answer: &Grounding) -> Vec<u32> {
    answer.targets.iter().map(|target| target.id.0).collect()
}

#[track_caller]
fn yes(query: &str) -> Option<bool> {
    let answer = ask(query);
    assert_eq!(answer.kind, AnswerKind::YesNo, "{query}: {answer:?}");
    answer.value.and_then(|value| value.yes)
}

#[test]
fn lists_have_what_is_at_the_place_and_nothing_else() {
    let answer = ask("what is on the desk?");
    assert_eq!(answer.kind, AnswerKind::List);
    assert_eq!(targets(&answer), [2, 3, 4]);
    assert_eq!(answer.count, Some(3));
    assert!(answer.text.starts_with("On the desk: "), "{}", answer.text);
    assert_eq!(targets(&ask("everything on the desk except the laptop")), [3, 4]);
    assert_eq!(targets(&ask("all mugs")).len(), 2);
    let answer = ask("what is on the sofa?");
    assert_eq!(answer.status, Status::NoMatch);
    assert_eq!(answer.text, "I found nothing on the sofa.");
    let answer = ask("what is on the piano?");
    assert_eq!((answer.status, answer.text.as_str()), (Status::NoMatch, "I found no piano."));
}

#[test]
fn a_list_asks_which_anchor_is_meant_if_several_have_something() {
    let nightstand = |id, x| named(id, "nightstand", [x, 0.0], [0.4; 3], 0.0, Support::Floor);
    let on = |id, name, x, holder| {
        named(id, name, [x, 0.0], [0.1; 3], 0.4, Support::Instance { id: InstanceId(holder) })
    };
    let mut instances = vec![nightstand(1, 0.0), nightstand(2, 3.0), on(3, "lamp", 0.0, 1)];
    let question = Question::of("what is on the nightstand?");
    assert_eq!(targets(&ask_in(&instances, &question)), [3]);
    instances.push(on(4, "mug", 3.0, 2));
    let answer = ask_in(&instances, &question);
    assert_eq!((answer.status, answer.alternatives.len()), (Status::Ambiguous, 2));
    assert!(answer.text.ends_with("Which one do you mean?"), "{}", answer.text);
    let all = ask_in(&instances, &Question::of("what is on the nightstands?"));
    assert_eq!(targets(&all), [3, 4]);
}

#[test]
fn distances_limit_lists_and_are_returned_with_them() {
    let answer = ask("what is within 50 cm of the sofa?");
    assert_eq!(targets(&answer), [6], "{}", answer.text);
    assert!(answer.text.starts_with("Within 0.5 m of the sofa"), "{}", answer.text);
    let beside = ask("what is within 50 cm of #5?");
    assert!(beside.text.starts_with("Within 0.5 m of the grey sofa"), "{}", beside.text);
    let distance = answer.targets[0].distance_m.unwrap();
    assert!((distance - 0.35).abs() < 1e-3, "{distance}");
}

#[test]
fn counts_are_numbers() {
    let answer = ask("how many mugs are there?");
    assert_eq!(answer.kind, AnswerKind::Count);
    assert_eq!(answer.value.unwrap().number, Some(2.0));
    let answer = ask("how many pianos are there?");
    assert_eq!(answer.value.unwrap().number, Some(0.0));
}

#[test]
fn sizes_come_from_the_box() {
    let value = |query: &str| ask(query).value.unwrap();
    let big = value("how big is the sofa?");
    assert_eq!(big.size, Some([2.0, 0.9, 0.8]));
    assert_eq!((big.number, big.unit), (Some(2.0), Some(Unit::Meters)));
    assert!(big.error.unwrap() > 0.0);
    assert_eq!(value("how tall is the floor lamp?").number, Some(1.5));
    assert_eq!(value("how wide is the sofa").number, Some(2.0));
    assert_eq!(value("how deep is the sofa").number, Some(0.9));
    assert_eq!(value("how high above the floor is the laptop").number, Some(0.75));
    assert_eq!(value("how much space does the sofa take up").unit, Some(Unit::SquareMeters));
}

#[test]
fn distances_are_between_the_nearest_sides() {
    let answer = ask("how far is the stool from the sofa?");
    let value = answer.value.unwrap();
    assert!((value.number.unwrap() - 0.35).abs() < 1e-3, "{value:?}");
    assert_eq!(value.instances, [InstanceId(6), InstanceId(5)]);
    let [from, to] = value.line.unwrap();
    assert!((from[1] - 0.8).abs() < 1e-3 && (to[1] - 0.45).abs() < 1e-3, "{from:?} {to:?}");
    assert_eq!(answer.answer.anchor_id, Some(InstanceId(5)));
    // Without an observer, the distance to "me" is unknown.
    let question = Question::of("how far is the sofa from me?");
    let answer = ask_with(&question);
    assert!(answer.value.is_none() && answer.text.contains("observer"), "{}", answer.text);
    let observer = Some(Observer { position: [0.0, 0.0, 0.4], yaw_rad: 0.0 });
    let value = ask_with(&Question { observer, ..question }).value.unwrap();
    assert!((value.number.unwrap() - 1.0).abs() < 1e-3, "{value:?}");
}

#[test]
fn yes_or_no_follows_from_the_room() {
    assert_eq!(yes("is there a sofa?"), Some(true));
    assert_eq!(yes("is there a piano?"), Some(false));
    assert_eq!(yes("is there anything on the desk?"), Some(true));
    assert_eq!(yes("is there anything on the stool?"), Some(false));
    assert_eq!(yes("is the laptop on the desk?"), Some(true));
    assert_eq!(yes("is the laptop on the sofa?"), Some(false));
    assert_eq!(yes("is the laptop on the floor?"), Some(false));
    assert_eq!(yes("is #3 a mug?"), Some(true));
    assert_eq!(yes("is #5 a mug?"), Some(false));
    assert_eq!(yes("is the sofa longer than the desk?"), Some(true));
    assert_eq!(yes("is the sofa taller than the floor lamp?"), Some(false));
    assert_eq!(yes("is the stool closer to the sofa than the desk?"), Some(true));
    assert_eq!(yes("does the stool fit under the desk?"), Some(true));
    assert_eq!(yes("does the sofa fit under the desk?"), Some(false));
    assert_eq!(yes("does the laptop fit on the stool?"), Some(true));
    assert_eq!(yes("does the sofa fit in the desk?"), Some(false));
    assert_eq!(yes("would the stool fit through the desk?"), Some(true));
    // The gap of 2.3 m between desk and sofa; the free space under a sofa is unknown.
    assert_eq!(yes("would a robot 60 cm wide fit between the desk and the sofa?"), Some(true));
    assert_eq!(
        yes("could a 3 m wide cart drive through between the desk and the sofa?"),
        Some(false)
    );
    assert_eq!(yes("would a robot 15 cm high fit under the sofa?"), None);
    assert_eq!(yes("would a robot 2 m high fit under the sofa?"), Some(false));
}

#[test]
fn negated_claims_are_answered_as_they_are_asked() {
    for (query, expected, text) in [
        ("is the laptop not on the desk?", false, "No. The grey laptop is on the desk."),
        (
            "is the laptop not on the sofa?",
            true,
            "Yes. The grey laptop is not on the sofa; it is on",
        ),
        ("isn't the laptop on the desk?", true, "Yes. The grey laptop is on the desk."),
        (
            "isn't the laptop on the sofa?",
            false,
            "No. The grey laptop is not on the sofa; it is on",
        ),
    ] {
        let answer = ask(query);
        assert_eq!(answer.value.and_then(|value| value.yes), Some(expected), "{query}");
        assert!(answer.text.starts_with(text), "{query}: {}", answer.text);
    }
}

#[test]
fn claims_about_all_objects_name_the_exceptions() {
    let mut instances = room();
    instances.push(named(
        9,
        "white mug",
        [2.0, 1.0],
        [0.1; 3],
        0.4,
        Support::Instance { id: InstanceId(6) },
    ));
    for (query, expected, text, shown) in [
        (
            "are all mugs on the desk?",
            false,
            "No. 2 of the 3 mugs are on the desk: all but the white mug (9).",
            vec![9],
        ),
        (
            "is every mug on the floor?",
            false,
            "No. None of the 3 mugs are on the floor.",
            vec![3, 4, 9],
        ),
        (
            "are none of the mugs on the floor?",
            true,
            "Yes. None of the 3 mugs are on the floor.",
            vec![3, 4, 9],
        ),
        (
            "are all mugs red?",
            false,
            "No. 1 of the 3 mugs is red: only the red mug (3).",
            vec![4, 9],
        ),
    ] {
        let answer = ask_in(&instances, &Question::of(query));
        assert_eq!(
            answer.value.as_ref().and_then(|value| value.yes),
            Some(expected),
            "{query}: {}",
            answer.text
        );
        assert!(answer.text.starts_with(text), "{query}: {}", answer.text);
        let mut ids = targets(&answer);
        ids.sort_unstable();
        assert_eq!(ids, shown, "{query}");
    }
    let answer = ask("do both mugs stand on the desk?");
    assert_eq!(answer.text, "Yes. Both mugs are on the desk.");
}

#[test]
fn measures_are_compared_with_the_length_of_the_question() {
    assert_eq!(yes("is the sofa wider than 1.5 m?"), Some(true));
    assert_eq!(yes("is the sofa wider than 2.5 m?"), Some(false));
    assert_eq!(yes("is the sofa 2 m long?"), Some(true));
    assert_eq!(yes("is the sofa 3 m long?"), Some(false));
    assert_eq!(yes("is the lamp at most 2 m tall?"), Some(true));
    assert_eq!(yes("is the gap between the desk and the sofa wider than 2 m?"), Some(true));
    assert_eq!(yes("is the gap between the desk and the sofa wider than 3 m?"), Some(false));
    assert_eq!(yes("is the stool within 50 cm of the sofa?"), Some(true));
    assert_eq!(yes("are both mugs wider than 50 cm"), Some(false));
    assert_eq!(yes("are all mugs within 1 m of the laptop"), Some(true));
    let far = ask("is the stool more than 1 m from the desk?");
    assert!(far.text.starts_with("Yes. The grey stool is 3.13 m ± "), "{}", far.text);
    assert_eq!(yes("are the mugs narrower than 50 cm"), Some(true));
    let answer = ask("is the sofa wider than 1.5 m?");
    assert!(answer.text.starts_with("Yes. The grey sofa is 2.00 m ± "), "{}", answer.text);
    // Within the error of the measurement it is a guess.
    let close = ask("is the sofa wider than 1.99 m?");
    assert!(close.text.ends_with("That is within the error of the measurement."), "{}", close.text);
    assert!(close.confidence < answer.confidence, "{} {}", close.confidence, answer.confidence);
}

#[test]
fn answers_use_the_unit_of_the_question() {
    for (query, text) in [
        ("how wide is the sofa in inches?", "78.7 inches wide"),
        ("how wide is the sofa in feet?", "6.6 feet wide"),
        ("how many centimeters wide is the sofa?", "200 cm wide"),
        ("how far is the stool from the sofa in mm", "350 mm from"),
        ("how much space does the sofa take up in square feet?", "19.4 square feet"),
    ] {
        let answer = ask(query);
        assert!(answer.text.contains(text), "{query}: {}", answer.text);
        // Values are in meters.
        assert!(answer.value.and_then(|value| value.number).unwrap() < 3.0);
    }
}

#[test]
fn questions_about_earlier_objects_are_about_these_only() {
    assert_eq!(targets(&ask("which of the mugs #3 and #4 are red")), [3]);
    assert_eq!(targets(&ask("which of the things #2, #3 and #6 is closest to the sofa")), [6]);
    assert_eq!(targets(&ask("how many of the things #2, #3 and #6 are on the desk")).len(), 2);
    assert_eq!(yes("are the things #2, #3 and #4 on the desk"), Some(true));
}

#[test]
fn excluded_materials_are_checked_by_names_and_said_where_they_cannot_be() {
    let chair = |id, name, x| named(id, name, [x, 0.0], [0.5, 0.5, 0.9], 0.0, Support::Floor);
    let instances = vec![chair(1, "wooden chair", 0.0), chair(2, "metal chair", 2.0)];
    let answer = ask_in(&instances, &Question::of("the chair that is not wooden"));
    assert_eq!(targets(&answer), [2], "{}", answer.text);
    let answer = ask_in(&instances, &Question::of("all chairs that are not metal"));
    assert_eq!(targets(&answer), [1], "{}", answer.text);
    let answer = ask_in(&instances, &Question::of("all chairs that are not plastic"));
    assert_eq!(targets(&answer), [1, 2]);
    let note = "A scan does not show whether they are plastic.";
    assert!(answer.text.ends_with(note), "{}", answer.text);
}

#[test]
fn a_thing_of_another_color_is_not_called_by_the_requested_one() {
    let mut instances = room();
    for instance in &mut instances {
        instance.given_name = None;
    }
    instances.iter_mut().for_each(|i| i.names = uniground_models::attributes::name_guesses(i));
    let answer = ask_in(&instances, &Question::of("the green sofa"));
    if answer.status != Status::NoMatch {
        assert!(
            answer.text.starts_with("I found nothing that is clearly a green sofa"),
            "{}",
            answer.text
        );
        assert!(
            answer.answer.explanation.contains("is grey, not green"),
            "{}",
            answer.answer.explanation
        );
        assert!(answer.confidence < 0.5, "{}", answer.confidence);
    }
}

#[test]
fn a_wall_is_no_answer_to_another_word() {
    let mut instances = room();
    let wall = thing(9, [0.0, 2.5], [1.2, 0.02, 1.3], 0.9, Support::Floor, [230; 3]);
    instances.push(Instance { structure: Some(Structure::Wall), ..wall });
    let answer = ask_in(&instances, &Question::of("the window"));
    assert_eq!((answer.status, targets(&answer)), (Status::NoMatch, vec![]), "{}", answer.text);
    let answer = ask_in(&instances, &Question::of("the wall"));
    assert_eq!(targets(&answer), [9]);
    instances.push(named(10, "window", [0.0, 2.4], [0.5, 0.1, 0.5], 1.0, Support::Nothing));
    let answer = ask_in(&instances, &Question::of("the window"));
    assert_eq!(targets(&answer), [10]);
}

/// What is not found is not there, and what stands elsewhere is not carried.
#[test]
fn what_an_object_has_must_be_seen_on_it() {
    assert_eq!(yes("does the desk have a laptop?"), Some(true));
    assert_eq!(yes("does the desk have a stool?"), Some(false));
    let answer = ask("does the desk have a piano?");
    assert_eq!(answer.value.unwrap().yes, Some(false));
    assert_eq!(answer.text, "No. I found no piano.");
    let answer = ask("does the desk have a blorp?");
    assert!(answer.value.is_none() && answer.text.contains("do not know"), "{}", answer.text);
}

#[test]
fn a_claim_about_a_place_holds_of_every_place_that_may_be_meant() {
    let table = |id, x, rgb| {
        let instance = thing(id, [x, 0.0], [0.8, 0.8, 0.5], 0.0, Support::Floor, rgb);
        Instance { given_name: Some("coffee table".into()), ..instance }
    };
    let on = Support::Instance { id: InstanceId(1) };
    let instances = vec![
        table(1, 0.0, [235, 225, 215]),
        table(2, 3.0, [250, 250, 250]),
        named(3, "remote", [0.0, 0.0], [0.2, 0.05, 0.02], 0.5, on),
    ];
    let answer = ask_in(&instances, &Question::of("is the remote on the white coffee table?"));
    assert_eq!(answer.value.unwrap().yes, Some(true), "{}", answer.text);
}

#[test]
fn parts_of_furniture_cannot_be_checked() {
    let answer = ask("does the sofa have a cushion?");
    assert!(answer.value.is_none() && answer.text.contains("cannot check"), "{}", answer.text);
    let answer = ask("do any of the stools have a cushion?");
    assert!(answer.value.is_none() && answer.text.contains("cannot tell"), "{}", answer.text);
}

#[test]
fn lists_and_counts_keep_to_zones_and_distances() {
    let mut instances = room();
    let at = |id, name, x, y| named(id, name, [x, y], [0.5, 0.5, 0.9], 0.0, Support::Floor);
    instances.extend([
        at(9, "stove", -2.5, 2.2),
        at(10, "chair", -1.8, 2.2),
        at(11, "chair", 2.5, -2.0),
    ]);
    let asked = |query: &str| ask_in(&instances, &Question::of(query));
    assert_eq!(targets(&asked("list all chairs in the kitchen")), [10]);
    assert_eq!(targets(&asked("how many chairs are in the kitchen?")), [10]);
    assert_eq!(targets(&asked("all chairs within 1 m of the stove")), [10]);
    assert_eq!(targets(&asked("how many chairs are within 1 m of the stove?")), [10]);
    assert_eq!(asked("how many chairs are there?").count, Some(2));
    let not_on_desk = targets(&asked("what is not on the desk?"));
    assert!(not_on_desk.contains(&10) && !not_on_desk.contains(&3), "{not_on_desk:?}");
    assert_eq!(targets(&asked("all mugs that are not on the desk")), [0_u32; 0]);
    let within = Region { min_z: Some(0.7), ..Region::default() };
    let question =
        Question { within: Some(within), ..Question::of("how many mugs are on the desk") };
    assert_eq!(ask_in(&instances, &question).count, Some(2));
}

#[test]
fn numbers_of_a_question_are_compared_with_the_count() {
    assert_eq!(yes("are there exactly two mugs?"), Some(true));
    assert_eq!(yes("are there exactly 3 mugs?"), Some(false));
    assert_eq!(yes("are there more than 2 mugs?"), Some(false));
    assert_eq!(yes("are there at least 2 mugs?"), Some(true));
    assert_eq!(yes("are there less than 3 mugs?"), Some(true));
    assert_eq!(yes("are there no mugs?"), Some(false));
    assert_eq!(yes("are there no pianos?"), Some(true));
    assert!(ask("are there no mugs?").text.starts_with("No. There are 2"));
}

#[test]
fn nonsense_is_said_to_be_nonsense() {
    let answer = ask("how far is #5 from #5?");
    assert_eq!(
        (answer.status, answer.text.as_str()),
        (Status::Grounded, "Both are the grey sofa.")
    );
    let answer = ask("what is next to it?");
    assert_eq!(answer.status, Status::NoMatch);
    assert!(answer.text.contains("which object you mean"), "{}", answer.text);
    // A floor is no table, also where nothing else is left.
    let low = Region { max_z: Some(0.0), ..Region::default() };
    let answer = ask_with(&Question { within: Some(low), ..Question::of("the table") });
    assert_eq!(answer.status, Status::NoMatch, "{}", answer.text);
}

#[test]
fn choices_return_the_winner() {
    let answer = ask("which is taller, the floor lamp or the sofa?");
    assert_eq!((answer.kind, targets(&answer)), (AnswerKind::Box, vec![7]));
    let answer = ask("which is taller, the sofa or the floor lamp?");
    let fields = &answer.answer;
    assert_eq!((fields.predicted_id, fields.anchor_id), (Some(InstanceId(7)), Some(InstanceId(5))));
    assert_eq!(fields.target_name_matches, Some(true));
    assert_eq!(fields.explanation, answer.text);
    let answer = ask("which is closer to the sofa, the desk or the stool?");
    assert_eq!(targets(&answer), [6], "{}", answer.text);
}

#[test]
fn purposes_have_no_article() {
    use super::sentences::{none_of, with_article};
    for (name, one, none) in [
        ("mug", "a mug", "no mug"),
        ("something to sit on", "something to sit on", "nothing to sit on"),
        ("red something to sit on", "something red to sit on", "nothing red to sit on"),
    ] {
        assert_eq!((with_article(name), none_of(name)), (one.to_owned(), none.to_owned()));
    }
}

#[test]
fn differences_are_measured() {
    let answer = ask("how much taller is the floor lamp than the sofa?");
    let value = answer.value.as_ref().unwrap();
    assert_eq!((answer.kind, value.unit), (AnswerKind::Measure, Some(Unit::Meters)));
    assert_eq!(value.instances, [InstanceId(7), InstanceId(5)]);
    let height = |id: usize| room()[id - 1].aabb.size.z;
    assert!((value.number.unwrap() - (height(7) - height(5))).abs() < 1e-3, "{}", answer.text);
    assert!(value.error.unwrap() > 0.0 && answer.text.contains("taller than"), "{}", answer.text);
    // The other way round, the difference is negative.
    let other = ask("how much taller is the sofa than the floor lamp?");
    assert_eq!(other.value.as_ref().unwrap().number, value.number.map(|number| -number));
    assert!(other.text.contains("is not taller than"), "{}", other.text);
    let missing = ask("how much taller is the piano than the sofa?");
    assert_eq!((missing.status, missing.value), (Status::NoMatch, None), "{}", missing.text);
}

#[test]
fn places_and_descriptions_are_sentences() {
    let answer = ask("where is the laptop?");
    assert_eq!(answer.kind, AnswerKind::Relation);
    assert!(answer.text.contains("on the grey desk"), "{}", answer.text);
    let answer = ask("what is #6?");
    assert_eq!(answer.kind, AnswerKind::Description);
    assert!(answer.text.contains("stool") && answer.text.contains("40 cm"), "{}", answer.text);
    let answer = ask("describe the desk");
    assert!(answer.text.contains("On or in it: a grey laptop"), "{}", answer.text);
    let answer = ask("what is the sofa made of?");
    assert!(answer.text.starts_with("A scan does not show"), "{}", answer.text);
    assert!(ask("what is this?").text.contains("Select an object"));
    assert_eq!(ask("the red mug").kind, AnswerKind::Box);
}

#[test]
fn a_region_limits_the_target_and_not_its_anchors() {
    let left = Region {
        polygon: Some(vec![[-3.0, -3.0], [-2.0, -3.0], [-2.0, 3.0], [-3.0, 3.0]]),
        ..Region::default()
    };
    let within = |query: &str, region: &Region| {
        ask_with(&Question { within: Some(region.clone()), ..Question::of(query) })
    };
    assert_eq!(targets(&within("the mug", &left)), [3]);
    assert_eq!(targets(&within("how many mugs are there", &left)), [3]);
    assert_eq!(targets(&within("the mug closest to the sofa", &left)), [3]);
    assert_eq!(within("the sofa", &left).status, Status::NoMatch);
    let high = Region { min_z: Some(0.7), ..Region::default() };
    assert_eq!(targets(&within("what is on the desk", &high)), [2, 3, 4]);
    let higher = Region { min_z: Some(1.0), ..Region::default() };
    assert_eq!(within("what is on the desk", &higher).status, Status::NoMatch);
}

#[test]
fn every_answer_has_a_sentence() {
    for query in [
        "the red mug",
        "the mug",
        "the piano",
        "the theremin",
        "la silla roja de la esquina junto a la ventana",
        "what is on the desk",
        "how far is the piano from the sofa",
        "is the piano taller than the sofa",
        "does the piano fit through the door",
        "where is the piano",
        "😀",
        "is the sofa leather?",
    ] {
        let answer = ask(query);
        assert!(answer.text.len() > 5 && answer.text.ends_with(['.', '?']), "{query}: {answer:?}");
    }
}

/// Asks, and completes the answer again as if a model had chosen this instance and said what
/// differs.
fn ask_with_difference(query: &str, chosen: usize, differs: &str) -> Grounding {
    ask_by_model(query, chosen, Some(differs))
}

/// Asks, and completes the answer again as if a model had chosen this instance.
fn ask_by_model(query: &str, chosen: usize, differs: Option<&str>) -> Grounding {
    let instances = room();
    let question = Question { min_confidence: 0.7, ..Question::of(query) };
    let names = NameIndex::of(&instances);
    let extent = Aabb { center: Point3::new(0.0, 0.0, 1.2), size: Vector3::new(6.0, 5.0, 2.5) };
    let scene = SceneView { instances: &instances, extent, names: &names, appearance: None };
    let parsed = uniground_language::parse(query);
    let mut answer = ground(scene, &question);
    let writer = Writer {
        assessor: assessor_of(scene, &question),
        parsed: &parsed,
        is_as_asked: true,
        chosen_by_model: None,
    };
    writer.choose(chosen, &parsed.target, 0.5, &mut answer);
    answer.differs = differs.map(str::to_owned);
    complete(scene, &question, &parsed, true, &mut answer);
    answer.require_confidence(question.min_confidence);
    answer
}

#[test]
fn an_object_that_differs_is_uncertain_and_the_sentence_says_how() {
    let answer = ask_with_difference("the red laptop", 1, "it is grey, not red");
    assert_eq!((answer.status, targets(&answer)), (Status::Uncertain, vec![2]));
    for part in ["I found nothing that is clearly a red laptop", "it is grey, not red"] {
        assert!(answer.text.to_lowercase().contains(&part.to_lowercase()), "{}", answer.text);
    }
    let answer = ask_with_difference("the mug on the sofa", 2, "it is on the desk");
    assert_eq!((answer.status, targets(&answer)), (Status::Uncertain, vec![3]));
    assert_eq!(
        answer.text,
        "I found nothing that is clearly a mug on the sofa. The closest one differs: it is on the desk. The red mug is on the grey desk, next to the grey laptop."
    );
}

#[test]
fn an_object_that_differs_does_not_exist_and_is_not_counted() {
    let differs = "it is grey, not red";
    let answer = ask_with_difference("is there a red laptop", 1, differs);
    assert_eq!((answer.status, answer.value.unwrap().yes), (Status::NoMatch, Some(false)));
    assert_eq!(
        answer.text,
        "No. I found no red laptop. The closest is the grey laptop: it is grey, not red."
    );
    assert_eq!(answer.alternatives.iter().map(|other| other.id.0).collect::<Vec<_>>(), [2]);
    let answer = ask_with_difference("how many red laptops are there", 1, differs);
    assert_eq!((answer.count, answer.value.unwrap().number), (Some(0), Some(0.0)));
    let answer = ask_with_difference("are there more than two red laptops", 1, differs);
    assert_eq!(answer.value.unwrap().yes, Some(false));
    let answer = ask_with_difference("all red laptops", 1, differs);
    assert_eq!((answer.status, targets(&answer)), (Status::Uncertain, vec![2]), "{}", answer.text);
}

#[test]
fn a_list_keeps_what_a_model_has_chosen() {
    // The geometry knows the stool by another name, and no slippers.
    for query in ["the shoes next to the sofa", "the shoes next to the slippers"] {
        let answer = ask_by_model(query, 5, None);
        assert_eq!((answer.status, targets(&answer)), (Status::Uncertain, vec![6]), "{query}");
    }
}

#[test]
fn of_several_counted_objects_only_the_one_that_differs_is_left_out() {
    let instances = room();
    let question = Question::of("how many mugs are there");
    let names = NameIndex::of(&instances);
    let extent = Aabb { center: Point3::new(0.0, 0.0, 1.2), size: Vector3::new(6.0, 5.0, 2.5) };
    let scene = SceneView { instances: &instances, extent, names: &names, appearance: None };
    let parsed = uniground_language::parse(&question.query);
    let mut answer = ground(scene, &question);
    assert_eq!(answer.count, Some(2));
    answer.answer.predicted_id = Some(InstanceId(3));
    answer.differs = Some("it is a bowl".into());
    complete(scene, &question, &parsed, true, &mut answer);
    assert_eq!((targets(&answer), answer.count, answer.differs), (vec![4], Some(1), None));
}
