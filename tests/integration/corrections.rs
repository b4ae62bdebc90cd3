//! Corrections of a parse by people.

use crate::test_scans::Scan;
use crate::test_server::{TestServer, ask, expect_problem};
use serde_json::json;
use uniground::config::{LimitsConfig, ModelsConfig, VlmConfig};
use uniground_core::geometry::boxes::Aabb;
use uniground_core::grounding::Status;
use uniground_core::scene::{InstanceId, Level};
use uniground_evaluation::annotations::Annotations;
use uniground_types::corrections::Change;
use uniground_types::instances::Levels;

#[tokio::test]
async fn answers_use_corrections() {
    let server = TestServer::start().await;
    let scene = server.upload_and_parse(Scan::neutral().zip()).await;
    let client = &server.client;
    let chosen = async |query: &str| client.ground(&scene.id, &ask(query)).await.unwrap();
    let before = chosen("the red sofa").await;
    let sofa = before.answer.predicted_id.unwrap();
    let bin = chosen("the green trash can").await.answer.predicted_id.unwrap();

    // A name.
    let name = "Grandma's bench";
    let renamed = client
        .correct(&scene.id, &Change::Rename { instance_id: sofa, name: name.into() })
        .await
        .unwrap();
    let told = client
        .all_instances(&scene.id, Levels::Things)
        .await
        .unwrap()
        .into_iter()
        .find(|i| i.id == sofa)
        .unwrap();
    assert_eq!((told.label.as_str(), told.given_name.as_deref()), (name, Some(name)));
    let answer = chosen("the bench").await;
    assert_eq!(
        (answer.status, answer.answer.predicted_id),
        (Status::Grounded, Some(sofa)),
        "{answer:?}"
    );
    assert!(answer.targets[0].name.contains(name), "{answer:?}");
    let truth: serde_json::Value = serde_json::from_slice(
        &client.bytes(&format!("v1/scenes/{}/annotations", scene.id)).await.unwrap(),
    )
    .unwrap();
    let entry =
        truth["objects"].as_array().unwrap().iter().find(|o| o["id"] == sofa.0).unwrap().clone();
    assert_eq!((entry["name"].as_str(), entry["corrected"].as_bool()), (Some(name), Some(true)));

    // A dismissed instance is neither an answer nor an anchor and is missing from lists.
    let junk =
        client.correct(&scene.id, &Change::Dismiss { instance_ids: vec![bin] }).await.unwrap();
    let answer = chosen("the green trash can").await;
    assert_ne!(answer.answer.predicted_id, Some(bin), "{answer:?}");
    assert!(
        answer.candidates.unwrap().iter().all(|c| c.id != bin),
        "the dismissed instance is a candidate"
    );
    let listed = client.all_instances(&scene.id, Levels::Things).await.unwrap();
    assert!(listed.iter().all(|i| i.id != bin && !i.dismissed), "the dismissed instance is listed");
    assert!(
        client
            .all_instances(&scene.id, Levels::All)
            .await
            .unwrap()
            .iter()
            .any(|i| i.id == bin && i.dismissed)
    );

    // Undoing restores the earlier state; the corrections stay readable.
    for correction in [&junk, &renamed] {
        assert!(
            client.undo_correction(&scene.id, &correction.id).await.unwrap().undone_at.is_some()
        );
    }
    let again = chosen("the red sofa").await;
    assert_eq!((again.answer.clone(), again.aabb), (before.answer.clone(), before.aabb));
    assert_eq!(chosen("the green trash can").await.answer.predicted_id, Some(bin));
    let said = client.corrections(&scene.id).await.unwrap().corrections;
    assert_eq!(
        said.iter().map(|c| (c.id.as_str(), c.undone_at.is_some())).collect::<Vec<_>>(),
        [(&*junk.id, true), (&*renamed.id, true)]
    );
    server.stop().await;
}

#[tokio::test]
async fn instances_can_be_merged() {
    let server = TestServer::start().await;
    let scene = server.upload_and_parse(Scan::neutral().zip()).await;
    let client = &server.client;
    let id_of = async |query: &str| {
        client.ground(&scene.id, &ask(query)).await.unwrap().answer.predicted_id.unwrap()
    };
    let (sofa, block) = (id_of("the red sofa").await, id_of("the blue box").await);
    let before = client.all_instances(&scene.id, Levels::All).await.unwrap();
    let of = |id: InstanceId| before.iter().find(|i| i.id == id).unwrap();
    let merge = Change::Merge { instance_ids: vec![sofa, block], name: Some("corner sofa".into()) };
    let merged = client.correct(&scene.id, &merge).await.unwrap();
    let made = merged.made.unwrap();
    assert_eq!(made.0 as usize, before.len() + 1, "no id is another's");
    let after = client.all_instances(&scene.id, Levels::All).await.unwrap();
    let one = after.iter().find(|i| i.id == made).unwrap();
    assert_eq!(
        (one.label.as_str(), one.level, &one.merged_from),
        ("corner sofa", Level::Thing, &vec![sofa, block])
    );
    assert_eq!(one.point_count, of(sofa).point_count + of(block).point_count);
    let around =
        Aabb::around([sofa, block].map(|id| of(id).aabb.corners()).as_flattened()).unwrap();
    assert!(one.aabb.iou(&around) > 0.9, "{:?} {around:?}", one.aabb);
    let member = after.iter().find(|i| i.id == sofa).unwrap();
    assert_eq!((member.level, member.things.as_slice()), (Level::Part, [made].as_slice()));
    let answer = client.ground(&scene.id, &ask("the corner sofa")).await.unwrap();
    assert_eq!(answer.answer.predicted_id, Some(made), "{answer:?}");
    let view = answer.candidates.unwrap().into_iter().find(|c| c.id == made).unwrap().view.unwrap();
    assert!(
        image::load_from_memory(&client.bytes(&view).await.unwrap()).is_ok(),
        "the picture is rendered on request"
    );

    let refused =
        expect_problem(client.correct(&scene.id, &Change::Split { instance_id: made }).await);
    assert_eq!((refused.status, refused.code.as_str()), (409, "was_merged"));

    // The merged instances are no longer listed, and what stands on them keeps its support.
    let refused = expect_problem(
        client
            .correct(&scene.id, &Change::Merge { instance_ids: vec![sofa, made], name: None })
            .await,
    );
    assert_eq!((refused.status, refused.code.as_str()), (409, "not_a_thing"));
    let bin = client
        .ground(&scene.id, &ask("the green trash can"))
        .await
        .unwrap()
        .answer
        .predicted_id
        .unwrap();
    let larger = client
        .correct(&scene.id, &Change::Merge { instance_ids: vec![made, bin], name: None })
        .await
        .unwrap();
    let all = client.all_instances(&scene.id, Levels::Things).await.unwrap();
    let larger_one = all.iter().find(|i| Some(i.id) == larger.made).unwrap();
    assert_eq!(larger_one.point_count, one.point_count + of(bin).point_count);
    let refused = expect_problem(client.undo_correction(&scene.id, &merged.id).await);
    assert_eq!((refused.status, refused.code.as_str()), (409, "correction_in_use"), "{refused:?}");
    for correction in [&larger, &merged] {
        client.undo_correction(&scene.id, &correction.id).await.unwrap();
    }
    assert_eq!(
        client.all_instances(&scene.id, Levels::Things).await.unwrap(),
        before.into_iter().filter(|i| i.level == Level::Thing).collect::<Vec<_>>()
    );

    // Corrections survive a restart.
    let again = client.correct(&scene.id, &merge).await.unwrap().made.unwrap();
    let data = server.stop_and_keep_data().await;
    let server = TestServer::start_on(
        data,
        LimitsConfig::default(),
        VlmConfig::default(),
        ModelsConfig::builtin(),
    )
    .await;
    let answer = server.client.ground(&scene.id, &ask("the corner sofa")).await.unwrap();
    assert_eq!(answer.answer.predicted_id, Some(again));
    server.stop().await;
}

#[tokio::test]
async fn an_instance_can_be_split_into_its_parts() {
    let server = TestServer::start().await;
    let scene = server.upload_and_parse(uniground_service::sample::LIVING_ROOM.to_vec()).await;
    let client = &server.client;
    let before = client.all_instances(&scene.id, Levels::All).await.unwrap();
    let parts_of = |id: InstanceId| {
        before
            .iter()
            .filter(move |i| i.level == Level::Part && i.things == [id])
            .collect::<Vec<_>>()
    };
    let several = before
        .iter()
        .find(|i| parts_of(i.id).len() >= 2)
        .expect("no instance of the living room has two parts");
    let parts: Vec<InstanceId> = parts_of(several.id).iter().map(|part| part.id).collect();
    let split =
        client.correct(&scene.id, &Change::Split { instance_id: several.id }).await.unwrap();
    let things = client.all_instances(&scene.id, Levels::Things).await.unwrap();
    assert!(
        things.iter().all(|i| i.id != several.id)
            && parts.iter().all(|part| things.iter().any(|i| i.id == *part))
    );
    // Two of the parts may belong together; parts have boxes only.
    let merge = Change::Merge { instance_ids: parts[..2].to_vec(), name: None };
    let made = client.correct(&scene.id, &merge).await.unwrap();
    let things = client.all_instances(&scene.id, Levels::Things).await.unwrap();
    let one = things.iter().find(|i| Some(i.id) == made.made).unwrap();
    let around = Aabb::around(
        parts_of(several.id)[..2]
            .iter()
            .flat_map(|part| part.raw_box.corners())
            .collect::<Vec<_>>()
            .iter(),
    )
    .unwrap();
    assert!(
        one.point_count > 0 && one.raw_box.shared_volume(&around) > 0.99 * one.raw_box.volume(),
        "{one:?} {around:?}"
    );
    let refused = expect_problem(client.undo_correction(&scene.id, &split.id).await);
    assert_eq!(refused.code, "correction_in_use", "the merge refers to the parts");
    for correction in [&made, &split] {
        client.undo_correction(&scene.id, &correction.id).await.unwrap();
    }
    let after = client.all_instances(&scene.id, Levels::All).await.unwrap();
    assert_eq!(after[..before.len()], before[..]);
    server.stop().await;
}

#[tokio::test]
async fn invalid_corrections_are_refused() {
    let server = TestServer::start().await;
    let scene = server.upload_and_parse(Scan::neutral().zip()).await;
    let refused = async |change: serde_json::Value| {
        let change: Change = serde_json::from_value(change).unwrap();
        let problem = expect_problem(server.client.correct(&scene.id, &change).await);
        (problem.status, problem.code)
    };
    let unknown = |status, code: &str| (status, code.to_owned());
    assert_eq!(
        refused(json!({"kind": "rename", "instance_id": 999, "name": "x"})).await,
        unknown(404, "instance_not_found")
    );
    assert_eq!(
        refused(json!({"kind": "rename", "instance_id": 0, "name": "x"})).await,
        unknown(404, "instance_not_found")
    );
    assert_eq!(
        refused(json!({"kind": "rename", "instance_id": 1, "name": " "})).await,
        unknown(422, "invalid_request")
    );
    assert_eq!(
        refused(json!({"kind": "rename", "instance_id": 1, "name": "two\nlines"})).await,
        unknown(422, "invalid_request")
    );
    assert_eq!(
        refused(json!({"kind": "dismiss", "instance_ids": []})).await,
        unknown(422, "invalid_request")
    );
    assert_eq!(
        refused(json!({"kind": "merge", "instance_ids": [1, 1]})).await,
        unknown(422, "invalid_request")
    );
    let things = server.client.all_instances(&scene.id, Levels::All).await.unwrap();
    let whole = |i: &&uniground_types::instances::InstanceView| {
        things.iter().all(|part| part.level != Level::Part || part.things != [i.id])
    };
    let without_parts = things.iter().filter(|i| i.level == Level::Thing).find(whole).unwrap();
    assert_eq!(
        refused(json!({"kind": "split", "instance_id": without_parts.id})).await,
        unknown(409, "no_parts")
    );
    let gone = expect_problem(
        server.client.undo_correction(&scene.id, "01a1ff70-0000-7000-8000-000000000001").await,
    );
    assert_eq!((gone.status, gone.code.as_str()), (404, "correction_not_found"));
    server.stop().await;
}

#[tokio::test]
async fn exported_ground_truth_is_readable_by_the_evaluation() {
    let server = TestServer::start().await;
    let scene = server.upload_and_parse(Scan::neutral().zip()).await;
    let sofa = server
        .client
        .ground(&scene.id, &ask("the red sofa"))
        .await
        .unwrap()
        .answer
        .predicted_id
        .unwrap();
    server
        .client
        .correct(&scene.id, &Change::Rename { instance_id: sofa, name: "red sofa".into() })
        .await
        .unwrap();
    let folder = tempfile::tempdir().unwrap();
    let folder = camino::Utf8Path::from_path(folder.path()).unwrap();
    let file = folder.join("room.scene.json");
    std::fs::write(
        &file,
        server.client.bytes(&format!("v1/scenes/{}/annotations", scene.id)).await.unwrap(),
    )
    .unwrap();
    let (truth, omissions) = Annotations::read(&file);
    assert!(omissions.is_empty(), "{omissions:?}");
    let read = truth.objects.iter().find(|object| object.id == sofa.0).unwrap();
    let told = server
        .client
        .all_instances(&scene.id, Levels::Things)
        .await
        .unwrap()
        .into_iter()
        .find(|i| i.id == sofa)
        .unwrap();
    assert_eq!(read.name, "red sofa");
    assert!(read.aabb.iou(&told.aabb) > 0.999, "{:?} {:?}", read.aabb, told.aabb);
    server.stop().await;
}
