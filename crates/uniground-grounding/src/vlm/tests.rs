use super::*;
use crate::NoMatchReason;
use crate::direction::Observer;
use crate::{Grounding, NameIndex, Question, SceneView, Status, ground_with_context};
use std::fmt::Write;
use std::time::Duration;
use uniground_geometry::boxes::Aabb;
use uniground_geometry::scene::{FrameIndex, Instance, InstanceId, Support};
use uniground_geometry::{Point3, Vector3};
use uniground_models::attributes;
use uniground_models::chat::{Part, Tokens};
use uniground_testing::thing;

/// Returns a sofa on either side, a dining table with two mugs, four chairs around it.
pub fn room() -> Vec<Instance> {
    let on_table = Support::Instance { id: uniground_geometry::scene::InstanceId(3) };
    let mut instances = vec![
        thing(1, [-2.0, 0.0], [2.1, 0.9, 0.8], 0.0, Support::Floor, [180, 40, 40]),
        thing(2, [2.0, 0.0], [2.0, 0.9, 0.8], 0.0, Support::Floor, [40, 60, 170]),
        thing(3, [0.0, 1.5], [1.5, 0.8, 0.74], 0.0, Support::Floor, [110, 75, 45]),
        thing(4, [-0.5, 1.5], [0.11, 0.09, 0.1], 0.74, on_table, [200, 30, 30]),
        thing(5, [0.5, 1.5], [0.11, 0.09, 0.1], 0.74, on_table, [30, 60, 180]),
    ];
    let chairs = [[-0.8, 1.5], [0.8, 1.5], [0.0, 2.2], [0.0, 0.8]];
    instances.extend(
        chairs
            .iter()
            .zip(6..)
            .map(|(at, id)| thing(id, *at, [0.45, 0.45, 0.9], 0.0, Support::Floor, [30, 30, 30])),
    );
    instances.iter_mut().for_each(|i| i.names = attributes::name_guesses(i));
    instances
}

fn asked(query: &str, observer: Option<Observer>) -> (Grounding, PromptContext) {
    let instances = room();
    let extent = Aabb { center: Point3::new(0.0, 0.0, 1.3), size: Vector3::new(7.0, 5.0, 2.6) };
    let question = Question { observer, ..Question::of(query) };
    let scene = SceneView {
        instances: &instances,
        extent,
        names: &NameIndex::of(&instances),
        appearance: None,
    };
    ground_with_context(scene, &question, uniground_language::parse(query), Duration::ZERO)
}

const QUERY: &str = "the black chair to the left of the table";

fn evidence(context: &PromptContext) -> VisualEvidence {
    let picture =
        |name: String, width, height| Picture { name, jpeg: Vec::new().into(), width, height };
    VisualEvidence {
        global: Some(picture("global".into(), 2048, 680)),
        collages: context
            .candidates
            .iter()
            .map(|c| (c.id.0, picture(format!("candidate-{}", c.id), 1023, 512)))
            .collect(),
        sheets: Vec::new(),
        photographs: Vec::new(),
    }
}

fn first_request(
    context: &PromptContext,
    options: Options,
    names: BTreeMap<u32, String>,
) -> ChatRequest {
    let evidence = evidence(context);
    Conversation { context, evidence: &evidence, options, names, unnamed: None }.first_request()
}

/// Returns a request as one text, in the order in which the model gets it.
fn written(request: &ChatRequest) -> String {
    let mut text = format!("system: {}\n", request.system);
    for part in &request.user {
        let _ = match part {
            Part::Text(words) => writeln!(text, "user text:\n{words}"),
            Part::Picture(p) => {
                writeln!(text, "user picture: {} ({} x {})", p.name, p.width, p.height)
            }
        };
    }
    if let Some((name, schema)) = &request.schema {
        let _ = writeln!(text, "schema {name}: {schema}");
    }
    text
}

fn matches_snapshot(name: &str, text: &str) {
    insta::with_settings!({snapshot_path => "../../tests/data/prompts", prepend_module_to_snapshot => false, omit_expression => true}, {
        insta::assert_snapshot!(name, text);
    });
}

#[test]
fn prompts_match_their_snapshots() {
    let (_, context) = asked(QUERY, None);
    let ablated = |ablation| Options { ablation, ..Options::default() };
    for (name, options) in [
        ("full", Options::default()),
        ("no_global", ablated(Ablation::NoGlobal)),
        ("no_candidate", ablated(Ablation::NoCandidate)),
        ("simple_prompt", ablated(Ablation::SimplePrompt)),
        ("json", Options { json: true, ..Options::default() }),
        ("paper", Options { prompt: PromptVersion::Paper, ..Options::default() }),
    ] {
        matches_snapshot(name, &written(&first_request(&context, options, BTreeMap::new())));
    }
    let names = context
        .candidates
        .iter()
        .map(|c| (c.id.0, "black plastic chair".to_owned()))
        .collect::<BTreeMap<_, _>>();
    let cached = Options { evidence: EvidenceMode::CachedNames, ..Options::default() };
    matches_snapshot("cached_names", &written(&first_request(&context, cached, names.clone())));

    let all = evidence(&context);
    let conversation = Conversation {
        context: &context,
        evidence: &all,
        options: Options::default(),
        names: BTreeMap::new(),
        unnamed: None,
    };
    let shown = conversation.shown(&BTreeMap::new());
    for (name, correction) in [
        ("corrected_out_of_set", Correction::OutOfSet { id: 99 }),
        (
            "corrected_unreadable",
            Correction::Unreadable { why: "no \"Predicted ID\" could be read".into() },
        ),
        (
            "corrected_inconsistent",
            Correction::Inconsistent {
                id: 6,
                why: "it is named \"lamp\" and \"chair\" is asked for".into(),
            },
        ),
    ] {
        let shown = conversation.shown_again(&correction, &shown);
        matches_snapshot(
            name,
            &written(&prompt::corrected_request(
                &conversation,
                &shown,
                &BTreeMap::new(),
                &correction,
            )),
        );
    }
    let (_, context) = asked("facing the table, the chair on the left", None);
    matches_snapshot(
        "viewpoint",
        &written(&first_request(&context, Options::default(), BTreeMap::new())),
    );
    let observer = Observer { position: [0.0, -2.0, 1.6], yaw_rad: 1.0 };
    let (_, context) = asked(QUERY, Some(observer));
    matches_snapshot(
        "observer",
        &written(&first_request(&context, Options::default(), BTreeMap::new())),
    );
    let sheet =
        Picture { name: "names-1".into(), jpeg: Vec::new().into(), width: 1024, height: 512 };
    matches_snapshot("naming", &written(&naming::request(sheet, &[1, 2, 3])));
}

#[test]
fn five_candidates_fit_the_token_budget_and_names_replace_pictures() {
    let (_, context) = asked(QUERY, None);
    assert_eq!(context.candidates.len(), 5);
    let full = Tokens::estimate(&first_request(&context, Options::default(), BTreeMap::new()));
    assert!(full.text < 1600 && full.pictures > 3000, "{full:?}");
    let names = context
        .candidates
        .iter()
        .map(|c| (c.id.0, "black plastic dining chair".to_owned()))
        .collect();
    let request = first_request(
        &context,
        Options { evidence: EvidenceMode::CachedNames, ..Options::default() },
        names,
    );
    // Namesakes that stand in different places need no photographs.
    assert_eq!(request.user.iter().filter(|part| matches!(part, Part::Picture(_))).count(), 1);
}

#[test]
fn photographs_are_sent_where_names_do_not_decide() {
    let named = |context: &PromptContext, of: &dyn Fn(u32) -> &'static str| {
        context
            .candidates
            .iter()
            .map(|c| (c.id.0, of(c.id.0).to_owned()))
            .collect::<BTreeMap<_, _>>()
    };
    let needed = |query: &str, of: &dyn Fn(u32) -> &'static str| {
        let (_, context) = asked(query, None);
        consistency::candidates_to_show(&context, &named(&context, of)).len()
    };
    let chairs = |_| "black chair";
    assert_eq!(needed("the chair closest to the red sofa", &chairs), 0, "distinguished by place");
    assert!(needed("the green chair", &chairs) >= 4, "names do not say which one is green");
    assert!(needed("the chair", &chairs) >= 4, "nothing distinguishes them");
    let one_green = |id| if id == 6 { "green plastic chair" } else { "black chair" };
    assert_eq!(needed("the green chair", &one_green), 0, "its name has the color");
    assert_eq!(
        needed("the red sofa", &|id| if id == 1 { "red sofa" } else { "chair" }),
        0,
        "only one has the name"
    );
    assert_eq!(needed("the lamp", &chairs), 3, "no candidate has the name: the best are shown");
}

/// The picture and the prompt use the same direction words, for every convention and every viewer.
#[test]
fn picture_and_prompt_use_the_same_directions() {
    for (query, observer, left) in [
        (QUERY, None, Vector3::x()),
        (
            QUERY,
            Some(Observer { position: [0.0; 3], yaw_rad: std::f32::consts::FRAC_PI_2 }),
            -Vector3::x(),
        ),
        ("facing the table, the chair on the left", None, -Vector3::x()),
    ] {
        let (_, context) = asked(query, observer);
        let words = context.subjects().words;
        assert!(
            (words[0].direction - left).norm() < 1e-4 && words[0].word.starts_with("left"),
            "{query} {words:?}"
        );
        let Part::Text(text) =
            first_request(&context, Options::default(), BTreeMap::new()).user.pop().unwrap()
        else {
            panic!("no text")
        };
        let axis = prompt_context::axis(left).unwrap();
        assert!(text.contains(&format!("left = {axis}, right = ")), "{query}: {text}");
        assert!(words[0].word.ends_with(&format!("({axis})")), "{words:?}");
    }
}

/// "Facing the wardrobe" where there is none: the observer's directions hold, and the prompt says
/// whose they are.
#[test]
fn prompt_names_the_source_of_its_directions() {
    let observer = Observer { position: [0.0; 3], yaw_rad: 0.0 };
    for (query, observer, told) in [
        (
            "facing the table, the chair on the left",
            Some(observer),
            "as seen by somebody facing the table",
        ),
        (
            "facing the theremin, the chair on the left",
            Some(observer),
            "as seen by the observer who asks",
        ),
        (QUERY, None, "by the convention \"paper\""),
    ] {
        assert_eq!(asked(query, observer).1.seen_by, told, "{query}");
    }
}

/// Returns a picture of 800 x 400 pixels without content.
pub(super) fn picture_named(name: &str) -> Picture {
    Picture { name: name.into(), jpeg: Vec::new().into(), width: 800, height: 400 }
}

fn decided(text: &str, context: &PromptContext) -> Decision {
    let mut decision = Decision::default();
    let reply = reply::read(text);
    decision.names.extend(reply.candidate_names.clone());
    let sent = SentPictures::of(["global", "candidate-6"].map(picture_named).to_vec());
    decision.take(reply, context, &sent, PointForm::Thousandths);
    decision.project(context);
    decision
}

#[test]
fn not_listed_object_has_a_picture_position() {
    let (mut grounding, context) = asked(QUERY, None);
    let text = "Predicted ID: not listed\nExplanation: on the wall\nSeen at: image 2, 512, 640, round wall clock";
    let decision = decided(text, &context);
    assert_eq!(decision.outcome, Outcome::NotListed);
    decision.apply(&mut grounding, &context, &room());
    let seen = grounding.seen.unwrap();
    assert_eq!(
        (seen.picture.as_str(), seen.at, seen.name.as_str()),
        ("candidate-6", [0.512, 0.64], "round wall clock")
    );
    assert_eq!(
        (grounding.status, grounding.no_match_reason, grounding.aabb),
        (Status::NoMatch, Some(NoMatchReason::NotListed), None)
    );
    // An image that was not sent gives no position.
    assert_eq!(
        decided("Predicted ID: not listed\nSeen at: image 9, 1, 1, clock", &context).seen,
        None
    );
}

#[test]
fn object_that_differs_from_the_question_has_a_low_confidence() {
    let (mut grounding, context) = asked(QUERY, None);
    let id = context.candidates[0].id;
    let text = format!(
        "Predicted ID: {id}\nExplanation: on the wall\nTarget name matches?: true\nDiffers: **It is black, not white.**"
    );
    let decision = decided(&text, &context);
    decision.apply(&mut grounding, &context, &room());
    assert_eq!(grounding.differs.as_deref(), Some("it is black, not white"));
    assert_eq!(grounding.answer.explanation, "on the wall Difference: it is black, not white.");
    assert_eq!((grounding.answer.predicted_id, grounding.confidence), (Some(id), 0.5));
    // An answer without an object differs from nothing.
    let (mut grounding, context) = asked(QUERY, None);
    decided("Predicted ID: none\nDiffers: it is black", &context).apply(
        &mut grounding,
        &context,
        &room(),
    );
    assert_eq!(grounding.differs, None);
}

#[test]
fn a_found_instance_has_its_box_though_others_were_found_meanwhile() {
    let (_, mut context) = asked(QUERY, None);
    let mut instances = room();
    let count = instances.len() as u32;
    let other = Aabb { center: Point3::origin(), size: Vector3::repeat(0.5) };
    let own = Aabb { center: Point3::new(1.0, 1.0, 1.0), size: Vector3::repeat(0.2) };
    for (number, aabb) in [(1, other), (2, other), (3, own)] {
        instances.push(Instance::from_box(InstanceId(count + number), aabb));
    }
    context.update_boxes(&instances);
    let shown = context.with_found_in_photographs(&[InstanceId(count + 3)], &[]);
    assert_eq!(shown.candidates.iter().map(|c| c.aabb).collect::<Vec<_>>(), [own]);
}

#[test]
fn shown_anchors_can_be_chosen_except_with_the_paper_prompt() {
    let (_, context) = asked("the red sofa next to the table", None);
    let anchor = context.anchors[0].id.0;
    let narrowed = context.narrowed_to(&[1]);
    assert!(narrowed.is_candidate(1) && !narrowed.is_candidate(9));
    let shown = PromptContext { shown_anchors: vec![InstanceId(anchor)], ..narrowed };
    assert!(shown.is_candidate(anchor) && !shown.like_the_paper().is_candidate(anchor));
}

#[test]
fn contact_sheets_narrow_the_candidates_down() {
    let (_, context) = asked(QUERY, None);
    let ids: Vec<u32> = context.candidates.iter().map(|c| c.id.0).collect();
    let picture =
        Picture { name: "sheet-1".into(), jpeg: Vec::new().into(), width: 1024, height: 768 };
    let evidence =
        VisualEvidence { sheets: vec![(picture, ids.clone())], ..VisualEvidence::default() };
    matches_snapshot("narrowing", &written(&prompt::narrowing(&context, &evidence)));
    let sheet = Options { evidence: EvidenceMode::Sheet, ..Options::default() };
    let conversation = Conversation {
        context: &context,
        evidence: &evidence,
        options: sheet,
        names: BTreeMap::new(),
        unnamed: None,
    };
    matches_snapshot("sheet", &written(&conversation.first_request()));
    let listed = |text: &str| reply::shortlist(text, |id| context.is_candidate(id));
    assert_eq!(
        listed(&format!("I see.\nShortlist: ID {}, 999, {} and {}", ids[1], ids[0], ids[1])),
        [ids[1], ids[0]]
    );
    assert_eq!(listed("Shortlist: none"), [] as [u32; 0]);
}

fn photograph(number: u32) -> Photograph {
    Photograph {
        frame: FrameIndex(10 * number),
        taken_px: (1280, 960),
        picture: Picture {
            name: format!("photograph-{number}"),
            jpeg: Vec::new().into(),
            width: 768,
            height: 576,
        },
    }
}

#[test]
fn only_shown_alternatives_of_an_anchor_are_listed() {
    let prompt = |query: &str| {
        let (_, context) = asked(query, None);
        written(&first_request(&context, Options::default(), BTreeMap::new()))
    };
    assert!(prompt("the sofa next to the other sofa").contains("; it may also be ID"));
    assert!(!prompt("the mug next to the sofa").contains("it may also be"));
}

#[test]
fn finding_prompts_match_their_snapshots() {
    let (_, context) = asked(QUERY, None);
    let photographs = vec![photograph(1), photograph(2)];
    let marked = MarkedPhotographs { photographs, ..MarkedPhotographs::default() };
    matches_snapshot("finding", &written(&finding::request(&context, &marked, Options::default())));
    matches_snapshot(
        "finding_json",
        &written(&finding::request(
            &context,
            &marked,
            Options { json: true, ..Options::default() },
        )),
    );
}

#[test]
fn photographs_follow_all_other_pictures() {
    let (_, context) = asked(QUERY, None);
    let request = |photographs: Vec<Photograph>, ablation| {
        let evidence = VisualEvidence { photographs, ..evidence(&context) };
        let options = Options { ablation, ..Options::default() };
        Conversation {
            context: &context,
            evidence: &evidence,
            options,
            names: BTreeMap::new(),
            unnamed: None,
        }
        .first_request()
    };
    matches_snapshot(
        "photographs",
        &written(&request(vec![photograph(1), photograph(2)], Ablation::Full)),
    );
    let one = written(&request(vec![photograph(1)], Ablation::Full));
    assert!(
        one.contains(&format!(
            "Image {} is a photograph of the room",
            context.candidates.len() + 2
        )),
        "{one}"
    );
    let without = written(&request(vec![photograph(1)], Ablation::NoCandidate));
    assert!(
        !without.contains("photograph-1") && !without.contains("is a photograph of the room"),
        "{without}"
    );
}

#[test]
fn model_decision_is_applied_to_the_answer() {
    let (grounding, context) = asked(QUERY, None);
    let instances = room();
    let answered = |text: &str| {
        let mut answer = grounding.clone();
        decided(text, &context).apply(&mut answer, &context, &instances);
        answer
    };
    let chosen = answered(
        "Predicted ID: 9\nExplanation: it is nearest\nCandidate Names: 9 -> black chair\nTarget name matches?: true\nAnchor ID: 3\nRelation used: left of",
    );
    assert_eq!(
        (chosen.status, chosen.answer.predicted_id, chosen.answer.anchor_id),
        (Status::Grounded, Some(instances[8].id), Some(instances[2].id))
    );
    assert_eq!(
        (chosen.aabb, chosen.answer.candidate_names[&9].as_str()),
        (Some(instances[8].aabb), "black chair")
    );
    assert!(
        chosen.confidence >= 0.7
            && chosen.alternatives.iter().all(|a| a.id != instances[8].id && a.confidence < 0.3)
    );
    let nothing = answered("Predicted ID: none\nExplanation: no chair is black");
    assert_eq!(
        (nothing.status, nothing.aabb, nothing.answer.predicted_id),
        (Status::NoMatch, None, None)
    );
    // An anchor id without an instance is ignored.
    assert_eq!(answered("Predicted ID: 9\nAnchor ID: 4000").answer.anchor_id, None);
}

#[test]
fn out_of_set_choice_is_projected_to_a_candidate() {
    let (_, context) = asked(QUERY, None);
    let outside = (1..=9).find(|id| !context.is_candidate(*id)).unwrap();
    let projected = decided(&format!("Predicted ID: {outside}"), &context);
    // Neither the box nor a name matches: the geometric answer is kept.
    assert_eq!(projected.outcome, Outcome::Unknown);
    assert!(
        projected.corrections[0].contains("the built-in reasoner answered"),
        "{:?}",
        projected.corrections
    );
    let (grounding, _) = asked(QUERY, None);
    let mut untouched = grounding.clone();
    projected.apply(&mut untouched, &context, &room());
    assert_eq!(untouched, grounding);
    let named = decided(
        &format!(
            "Predicted ID: {outside}\nExplanation: x\nCandidate Names: 8 -> black chair, 7 -> lamp"
        ),
        &context,
    );
    assert_eq!(
        named.outcome,
        Outcome::Projected(uniground_geometry::scene::InstanceId(8)),
        "{:?}",
        named.corrections
    );
    // The same object under another id: its box is a candidate's.
    let mut twice = context.clone();
    twice.boxes[outside as usize - 1] = twice.candidates[2].aabb;
    assert_eq!(
        decided(&format!("Predicted ID: {outside}"), &twice).outcome,
        Outcome::Projected(twice.candidates[2].id)
    );
}

#[test]
fn unknown_noun_still_has_candidates_at_the_stated_place() {
    let (grounding, context) = asked("the theremin on the table", None);
    assert_eq!(grounding.status, Status::NoMatch);
    let first: Vec<u32> = context.candidates.iter().take(2).map(|c| c.id.0).collect();
    assert!(first.contains(&4) && first.contains(&5), "{first:?}");
    assert_eq!(context.candidates.len(), 5);
}
