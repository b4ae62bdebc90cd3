//! Kinds of questions: lists, numbers, yes or no, follow-ups, and regions.

use crate::test_server::{TestServer, ask, assert_contains, expect_problem, wait_for_job};
use camino::Utf8Path;
use serde_json::json;
use uniground_core::geometry::boxes::Aabb;
use uniground_core::grounding::{Grounding, NameIndex, Question, SceneView, Status, ground};
use uniground_core::scene::{Instance, InstanceId, PointCloud};
use uniground_evaluation::annotations::Annotations;
use uniground_evaluation::systems::{NamedBy, instances_of};
use uniground_types::answer::{AnswerKind, Unit};
use uniground_types::question::{GroundRequest, QuestionContext, Region};

fn sample_scan() -> Vec<u8> {
    uniground_service::sample::LIVING_ROOM.to_vec()
}

#[tokio::test(flavor = "multi_thread")]
async fn follow_up_questions_refer_to_answers_and_instances() {
    let server = TestServer::start().await;
    let (client, scene) = (&server.client, server.upload_and_parse(sample_scan()).await);
    let follow = |query: &str, answer_id: Option<&str>, instance: Option<u32>| GroundRequest {
        context: Some(QuestionContext {
            answer_id: answer_id.map(str::to_owned),
            instance: instance.map(InstanceId),
            ..QuestionContext::default()
        }),
        min_confidence: Some(0.0),
        ..ask(query)
    };
    let sofa = client
        .ground(
            &scene.id,
            &GroundRequest { min_confidence: Some(0.0), ..ask("how big is the sofa?") },
        )
        .await
        .unwrap();
    let value = sofa.value.as_ref().unwrap();
    assert_eq!(
        (sofa.kind, value.unit, value.size.is_some()),
        (AnswerKind::Measure, Some(Unit::Meters), true)
    );
    assert_eq!((&sofa.understood_as, &sofa.query), (&None, &"how big is the sofa?".to_owned()));

    let id = sofa.answer.predicted_id.unwrap();
    let beside = client
        .ground(&scene.id, &follow("What is next to it?", Some(&sofa.id), None))
        .await
        .unwrap();
    assert_eq!(beside.understood_as, Some(format!("what is next to #{id}")));
    assert_eq!((beside.kind, beside.query.as_str()), (AnswerKind::List, "What is next to it?"));
    assert!(beside.targets.iter().all(|target| target.distance_m.is_some()), "{beside:?}");

    // The context of an earlier follow-up counts too.
    let stool =
        client.ground(&scene.id, &follow("and the stool?", Some(&sofa.id), None)).await.unwrap();
    assert_eq!(stool.understood_as.as_deref(), Some("how big is the stool"));
    let tv = client.ground(&scene.id, &follow("and the TV?", Some(&stool.id), None)).await.unwrap();
    assert_eq!(tv.understood_as.as_deref(), Some("how big is the tv"));

    let this = client.ground(&scene.id, &follow("what is this?", None, Some(id.0))).await.unwrap();
    assert_eq!((this.kind, this.answer.predicted_id), (AnswerKind::Description, Some(id)));
    // The answer is stored with its kind.
    assert_eq!(client.answer(&this.id).await.unwrap(), this);

    for (request, pointer) in [
        (follow("what is this?", None, Some(9_999)), "/context/instance"),
        (
            follow("and it?", Some("01a1f829-2f28-76eb-afa7-c7b611e3e457"), None),
            "/context/answer_id",
        ),
        (follow("and it?", None, None), "/context"),
    ] {
        let problem = expect_problem(client.ground(&scene.id, &request).await);
        assert_eq!(problem.code, "invalid_request");
        assert_contains(format!("{:?}", problem.errors), pointer);
    }
    // An answer about another scene is no context.
    let other = server.upload_and_parse(crate::test_scans::Scan::frames_only().zip()).await;
    let problem =
        expect_problem(client.ground(&other.id, &follow("and it?", Some(&sofa.id), None)).await);
    assert_contains(format!("{:?}", problem.errors), "/context/answer_id");
    // Nor is one about another version, whose ids may mean other objects.
    let box_of = client.ground(&other.id, &ask("the box")).await.unwrap();
    let job = client.parse(&other.id, &json!({"preset": "paper"})).await.unwrap();
    wait_for_job(client, &job.id).await;
    let problem =
        expect_problem(client.ground(&other.id, &follow("and it?", Some(&box_of.id), None)).await);
    assert_contains(format!("{:?}", problem.errors), "has version 2 now");
    server.stop().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn regions_limit_the_object_and_are_checked() {
    let server = TestServer::start().await;
    let (client, scene) = (&server.client, server.upload_and_parse(sample_scan()).await);
    let within = |query: &str, region: Region| GroundRequest {
        within: Some(region),
        min_confidence: Some(0.0),
        ..ask(query)
    };
    let all = client
        .ground(
            &scene.id,
            &GroundRequest { min_confidence: Some(0.0), ..ask("how many chairs are there?") },
        )
        .await
        .unwrap();
    // A square around the first chair.
    let [x, y] = [0, 1].map(|axis| f64::from(all.targets[0].aabb.center[axis]));
    let around = [[x - 0.2, y - 0.2], [x + 0.2, y - 0.2], [x + 0.2, y + 0.2], [x - 0.2, y + 0.2]];
    let square = Region { polygon: Some(around.to_vec()), ..Region::default() };
    let some =
        client.ground(&scene.id, &within("how many chairs are there?", square)).await.unwrap();
    let number =
        |answer: &uniground_types::answer::Answer| answer.value.as_ref().unwrap().number.unwrap();
    assert!(number(&some) < number(&all), "{} of {}", number(&some), number(&all));
    assert_eq!(some.targets[0].id, all.targets[0].id);
    let stale = GroundRequest { if_version: Some(scene.parse_version + 1), ..ask("the sofa") };
    let problem = expect_problem(client.ground(&scene.id, &stale).await);
    assert_eq!((problem.status, problem.code.as_str()), (409, "parse_changed"));
    let sky = Region { min_z: Some(50.0), ..Region::default() };
    let none = client.ground(&scene.id, &within("the sofa", sky)).await.unwrap();
    assert_eq!(none.status, Status::NoMatch);
    for (region, pointer) in [
        (Region::default(), "/within"),
        (Region { polygon: Some(vec![[0.0, 0.0]; 2]), ..Region::default() }, "/within/polygon"),
        (Region { min_z: Some(2.0), max_z: Some(1.0), ..Region::default() }, "/within/max_z"),
        (Region { min_z: Some(f64::NAN), ..Region::default() }, "/within"),
    ] {
        let problem = expect_problem(client.ground(&scene.id, &within("the sofa", region)).await);
        assert_contains(format!("{problem:?}"), pointer);
    }
    server.stop().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn agents_get_the_sentence_and_the_value() {
    let server = TestServer::start().await;
    let scene = server.upload_and_parse(sample_scan()).await;
    let call = json!({"jsonrpc": "2.0", "id": 1, "method": "tools/call", "params": {
        "name": "ground", "arguments": {"scene_id": scene.id, "query": "how far is the green stool from the sofa?"}}});
    let reply: serde_json::Value = server
        .client
        .request(reqwest::Method::POST, "mcp")
        .header("accept", "application/json, text/event-stream")
        .json(&call)
        .send()
        .await
        .unwrap()
        .json()
        .await
        .unwrap();
    let answer = &reply["result"]["structuredContent"];
    assert_eq!(answer["kind"], "measure", "{reply:#}");
    assert!(answer["value"]["number"].is_number() && answer["text"].is_string(), "{reply:#}");
    server.stop().await;
}

/// Asks about the annotated boxes and names of the sample room.
fn ask_annotated(query: &str) -> (Grounding, Vec<String>) {
    let file = concat!(env!("CARGO_MANIFEST_DIR"), "/examples/living_room.scene.json");
    let (annotations, omissions) = Annotations::read(Utf8Path::new(file));
    assert!(omissions.is_empty(), "{omissions:?}");
    let instances: Vec<Instance> =
        instances_of(&annotations, &PointCloud::default(), NamedBy::Annotated);
    let corners: Vec<_> = instances.iter().flat_map(|i| i.aabb.corners()).collect();
    let view = SceneView {
        instances: &instances,
        extent: Aabb::around(&corners).unwrap(),
        names: &NameIndex::of(&instances),
        appearance: None,
    };
    let answer = ground(view, &Question::of(query));
    let mut names: Vec<String> = answer
        .targets
        .iter()
        .map(|target| instances[target.id.0 as usize - 1].label().to_owned())
        .collect();
    names.sort_unstable();
    (answer, names)
}

#[test]
fn lists_have_the_annotated_objects() {
    for (query, expected) in [
        ("What's on the coffee table right now?", &["book", "mug"][..]),
        ("everything on the desk", &["desk lamp", "laptop"]),
        ("Have we got a guitar in here somewhere?", &[]),
        ("List the waste bins and where each one stands.", &["trash can", "trash can"]),
        ("what is next to the fridge?", &[]),
    ] {
        let (answer, names) = ask_annotated(query);
        assert_eq!(names, expected, "{query}: {}", answer.text);
    }
}

#[test]
fn numbers_and_claims_agree_with_the_annotations() {
    let number = |query: &str| ask_annotated(query).0.value.unwrap().number.unwrap();
    assert_eq!(number("How many mugs are lying around in here?"), 3.0);
    assert!((0.5..0.8).contains(&number("how far apart are the two round stools?")));
    let yes = |query: &str| ask_annotated(query).0.value.unwrap().yes.unwrap();
    assert!(yes("Is the wine next to the fruit bowl?"));
    assert!(!yes("Is the laptop on the dining table?"));
    assert!(yes("Is the laptop on the desk?"));
    assert!(!yes("Is there a fire extinguisher in this room?"));
    assert!(yes("is the coffee table lower than the bookcase?"));
    let (answer, names) =
        ask_annotated("which one's closer to the TV, the green stool or the orange one?");
    assert_eq!(names.len(), 1, "{}", answer.text);
    assert_contains(&answer.text, "green stool is closer");
    let (answer, _) = ask_annotated("Hey, where did I leave my laptop?");
    assert_eq!(answer.kind, AnswerKind::Relation);
    assert_contains(&answer.text, "desk");
}
