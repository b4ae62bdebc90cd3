//! The model first finds the object in photographs whose instances are numbered.

use super::{
    Script, builtin_answer, call_purposes, corrections, count_images, request_by, six_field_reply,
    start_server, user_text, vlm_config,
};
use crate::scripted_model::says;
use crate::test_scans::Scan;
use uniground_core::grounding::Status;
use uniground_types::instances::{InstanceView, Levels};
use uniground_types::question::{EvidenceMode, GroundRequest, ReasonerChoice};
use uniground_types::transcript::PromptPart;

fn photographs_first() -> GroundRequest {
    let evidence = EvidenceMode::Photographs;
    GroundRequest { evidence, ..request_by(ReasonerChoice::Vlm) }
}

#[tokio::test(flavor = "multi_thread")]
async fn the_model_finds_instances_in_numbered_photographs_and_then_decides() {
    let script = Script::default();
    let (server, scene) = start_server(vlm_config(&script.serve(vec![says("-")]).await)).await;
    let plain = builtin_answer(&server, &scene).await;
    let shortlist: Vec<u32> = plain.candidates.as_ref().unwrap().iter().map(|c| c.id.0).collect();
    // A thing that the geometry does not offer, and an anchor of it.
    let things = server.client.all_instances(&scene, Levels::Things).await.unwrap();
    let is_other = |i: &&InstanceView| !shortlist.contains(&i.id.0) && i.structure.is_none();
    let other = things.iter().find(is_other).unwrap().id.0;
    script.next(vec![
        says(&format!("Could be: {other}, 4711\nAnchors: {} -> sofa\nSeen at: none", shortlist[0])),
        six_field_reply(other, &format!("{other} -> red mug"), true, shortlist[0]),
    ]);
    let answer = server.client.ground(&scene, &photographs_first()).await.unwrap();
    assert_eq!(
        (answer.status, answer.answer.predicted_id.map(|id| id.0)),
        (Status::Grounded, Some(other)),
        "{}",
        corrections(&answer)
    );
    assert_eq!(call_purposes(&answer), ["find", "spatial"]);
    let candidates: Vec<u32> = answer.candidates.as_ref().unwrap().iter().map(|c| c.id.0).collect();
    assert!(candidates.contains(&other) && candidates.contains(&shortlist[0]), "{candidates:?}");
    let sent = script.take();
    assert!((1..=8).contains(&count_images(&sent[0])), "{}", count_images(&sent[0]));
    assert!(user_text(&sent[0]).contains("Things in it are numbered"));
    assert!(user_text(&sent[1]).contains(&format!("\"sofa\" -> ID {}", shortlist[0])));

    // Every picture of both calls can be fetched again.
    let prompt = server.client.answer_prompt(&answer.id).await.unwrap();
    assert_eq!(prompt.calls.len(), 2);
    for part in prompt.calls.iter().flat_map(|call| &call.user) {
        if let PromptPart::Picture { href } = part {
            image::load_from_memory(&server.client.bytes(href).await.unwrap()).unwrap();
        }
    }
    // Nothing found, in the other photographs either: the geometry's candidates are shown.
    let nothing = || says("Could be: none\nAnchors: none\nSeen at: none");
    script.next(vec![nothing(), nothing(), six_field_reply(shortlist[1], "", true, 1)]);
    let answer = server.client.ground(&scene, &photographs_first()).await.unwrap();
    assert_eq!(answer.answer.predicted_id.map(|id| id.0), Some(shortlist[1]));
    assert_eq!(call_purposes(&answer), ["find", "find", "spatial"]);
    server.stop().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn a_scan_without_photographs_is_decided_in_one_call() {
    let script = Script::default();
    let model = script.serve(vec![six_field_reply("none", "", false, 1)]).await;
    let (server, _) = start_server(vlm_config(&model)).await;
    let cloud = server.upload_and_parse(Scan::cloud_only().zip()).await.id;
    let answer = server.client.ground(&cloud, &photographs_first()).await.unwrap();
    assert_eq!((answer.status, call_purposes(&answer)), (Status::NoMatch, vec!["spatial".into()]));
    server.stop().await;
}
