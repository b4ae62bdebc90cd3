//! Names that a model gives without a question: each is requested once and can be indexed in
//! advance.

use super::{
    QUERY, builtin_answer, call_purposes, count_images, request_by, six_field_reply, start_server,
    user_text, vlm_config,
};
use crate::scripted_model::{Script, Scripted, says};
use crate::test_server::{ask, assert_contains, wait_for_job};
use std::time::Duration;
use uniground::config::NamingChoice;
use uniground::config::VlmConfig;
use uniground_core::grounding::Status;
use uniground_types::instances::{InstanceView, Levels};
use uniground_types::job::{Job, JobState};
use uniground_types::question::{EvidenceMode, GroundRequest, ReasonerChoice};

#[tokio::test(flavor = "multi_thread")]
async fn names_are_requested_once() {
    let script = Script::default();
    let (server, scene) = start_server(vlm_config(&script.serve(vec![says("-")]).await)).await;
    let plain = builtin_answer(&server, &scene).await;
    let ids: Vec<u32> = plain.candidates.as_ref().unwrap().iter().map(|c| c.id.0).collect();
    let named = ids
        .iter()
        .map(|id| format!("{id} -> red thing number {id}"))
        .collect::<Vec<_>>()
        .join("\n");
    let cached = || GroundRequest { evidence: EvidenceMode::CachedNames, ..ask(QUERY) };
    script.next(vec![says(&named), six_field_reply(ids[0], "", true, 1)]);
    let answer = server.client.ground(&scene, &cached()).await.unwrap();
    assert_eq!(call_purposes(&answer), ["naming", "spatial"]);
    let sent = script.take();
    assert!(
        count_images(&sent[0]) == 1 && !user_text(&sent[0]).contains("mug"),
        "the naming prompt must not contain the question"
    );
    assert_contains(user_text(&sent[1]), format!("\"red thing number {}\"", ids[0]));
    assert!(
        count_images(&sent[1]) < 1 + ids.len(),
        "{} images for {} instances",
        count_images(&sent[1]),
        ids.len()
    );
    // The second question requests no names, and the names can be read.
    script.next(vec![six_field_reply(ids[0], "", true, 1)]);
    assert_eq!(call_purposes(&server.client.ground(&scene, &cached()).await.unwrap()), ["spatial"]);
    let instances = server.client.all_instances(&scene, Levels::Things).await.unwrap();
    let of = |id: u32| instances.iter().find(|i| i.id.0 == id).unwrap().model_name.clone();
    assert_eq!(of(ids[0]), Some(format!("red thing number {}", ids[0])));
    assert!(instances.iter().any(|i| i.model_name.is_none()));

    // A job names the rest in the background: things, parts and wholes. From then on answers use
    // the names.
    let theremin = || GroundRequest { reasoner: ReasonerChoice::Builtin, ..ask("the theremin") };
    let before = server.client.ground(&scene, &theremin()).await.unwrap();
    assert_eq!((before.status, before.models.names), (Status::NoMatch, None));
    let instances = server.client.all_instances(&scene, Levels::All).await.unwrap();
    let unnamed = |i: &&InstanceView| i.structure.is_none() && i.model_name.is_none();
    let chosen = instances.iter().find(unnamed).unwrap().id;
    let name = |i: &InstanceView| {
        format!("{}: {}", i.id.0, if i.id == chosen { "small wooden theremin" } else { "grey box" })
    };
    script.next(vec![says(&instances.iter().map(name).collect::<Vec<_>>().join("\n"))]);
    script.take();
    let job =
        wait_for_job(&server.client, &server.client.name_instances(&scene).await.unwrap().id).await;
    assert_eq!((job.kind.as_str(), job.error.clone()), ("naming", None), "{job:?}");
    let (calls, wanted) = (script.calls(), instances.iter().filter(unnamed).count());
    assert!((2..=wanted.div_ceil(12)).contains(&calls), "{calls} calls for {wanted} instances");
    let named = server.client.all_instances(&scene, Levels::All).await.unwrap();
    let of = |id: u32| named.iter().find(|i| i.id.0 == id).unwrap();
    assert_eq!(
        of(ids[0]).model_name,
        Some(format!("red thing number {}", ids[0])),
        "existing names must not change"
    );
    assert_eq!(of(chosen.0).label, "small wooden theremin");
    let after = server.client.ground(&scene, &theremin()).await.unwrap();
    assert_eq!(
        (after.answer.predicted_id, after.models.names.as_deref()),
        (Some(chosen), Some("scripted (naming 2)"))
    );
    assert!(after.targets[0].name.ends_with("small wooden theremin"), "{}", after.targets[0].name);
    let again: Job =
        wait_for_job(&server.client, &server.client.name_instances(&scene).await.unwrap().id).await;
    assert!(
        again.error.is_none() && script.calls() == calls,
        "a second job must not name instances again"
    );
    server.stop().await;
}

/// Returns a name for every id in a naming request.
fn reply_naming_all() -> Scripted {
    says(&(1..=400).map(|id| format!("{id}: grey box")).collect::<Vec<_>>().join("\n"))
}

#[tokio::test(flavor = "multi_thread")]
async fn a_scene_is_named_with_its_parse_or_on_the_first_question() {
    for (names, first) in [(NamingChoice::Parse, "naming"), (NamingChoice::Lazy, "question")] {
        let script = Script::default();
        let url = script.serve(vec![reply_naming_all()]).await;
        let (server, scene) = start_server(VlmConfig { names, ..vlm_config(&url) }).await;
        let namings = || async {
            server.client.jobs(&[("kind", "naming"), ("subject", &scene)]).await.unwrap().jobs
        };
        if first == "naming" {
            let job = loop {
                match namings().await.into_iter().next() {
                    Some(job) => break job,
                    None => tokio::time::sleep(Duration::from_millis(20)).await,
                }
            };
            assert_eq!(wait_for_job(&server.client, &job.id).await.state, JobState::Succeeded);
        } else {
            assert!(namings().await.is_empty(), "no question was asked yet");
        }
        let answer = server.client.ground(&scene, &request_by(ReasonerChoice::Auto)).await.unwrap();
        assert_eq!(answer.models.names.as_deref(), Some("scripted (naming 2)"), "{names:?}");
        assert_eq!(namings().await.len(), 1, "{names:?}: once");
        server.stop().await;
    }
}
