//! Questions about many scenes, and labels to choose among them.

use crate::archives::{EIGHTHS, Scan, THINGS};
use crate::server::{TestServer, config, problem};
use camino::Utf8Path;
use reqwest::{Method, StatusCode};
use std::time::Duration;
use tokio::time::sleep;
use uniground::app;
use uniground::config::Vectors;
use uniground_client::Client;
use uniground_core::grounding::Status;
use uniground_types::corrections::Change;
use uniground_types::labels::Labels;
use uniground_types::many::ManyGroundRequest;
use uniground_types::scenes::{Created, Scene, SceneChange};

fn labeled(labels: &[(&str, &str)]) -> Labels {
    labels.iter().map(|(name, value)| ((*name).to_owned(), (*value).to_owned())).collect()
}

async fn filed(client: &Client, scene: &Scene, name: &str, labels: &[(&str, &str)]) {
    let change = SceneChange {
        name: Some(name.into()),
        labels: Some(labeled(labels)),
        ..SceneChange::default()
    };
    let changed = client.change_scene(&scene.id, &change).await.unwrap();
    assert_eq!((changed.name.as_str(), &changed.labels), (name, &labeled(labels)));
}

#[tokio::test(flavor = "multi_thread")]
async fn the_room_that_has_it_comes_first() {
    let server = TestServer::start().await;
    let client = &server.client;
    // The green box stands in one of them, the floor and the red sofa in both.
    let with = server.parsed(Scan::of_room(&THINGS, &EIGHTHS).zip()).await;
    let without = server.parsed(Scan::of_room(&THINGS[..2], &EIGHTHS).zip()).await;
    filed(client, &with, "office", &[("building", "A"), ("floor", "2")]).await;
    filed(client, &without, "hall", &[("building", "A"), ("floor", "1")]).await;
    let asked = client.ground_many(&ManyGroundRequest::new("the green trash can")).await.unwrap();
    assert_eq!(
        (asked.looked_into, asked.answers.len(), &asked.not_asked[..]),
        (2, 2, &[][..]),
        "{asked:?}"
    );
    let best = &asked.answers[0];
    assert_eq!((best.scene_name.as_str(), &best.answer.scene_id), ("office", &with.id));
    assert_ne!(best.answer.status, Status::NoMatch);
    assert_eq!(best.labels, labeled(&[("building", "A"), ("floor", "2")]));
    // It is an answer as any: kept, and the same as that scene's own.
    assert_eq!(client.answer(&best.answer.id).await.unwrap(), best.answer);

    // In some of them only, and no more answers than wanted.
    let one = ManyGroundRequest { top_k: 1, ..ManyGroundRequest::new("the red sofa") };
    assert_eq!(client.ground_many(&one).await.unwrap().answers.len(), 1);
    let on_the_first = ManyGroundRequest { labels: labeled(&[("floor", "1")]), ..one.clone() };
    let asked = client.ground_many(&on_the_first).await.unwrap();
    assert_eq!((asked.looked_into, asked.answers[0].scene_name.as_str()), (1, "hall"));
    let named = ManyGroundRequest { scenes: Some(vec![with.id.clone()]), ..one.clone() };
    assert_eq!(client.ground_many(&named).await.unwrap().answers[0].answer.scene_id, with.id);
    let nowhere = ManyGroundRequest { labels: labeled(&[("building", "B")]), ..one.clone() };
    let asked = client.ground_many(&nowhere).await.unwrap();
    assert_eq!((asked.looked_into, asked.answers.len()), (0, 0));

    // What is not parsed is told of, and stops nobody.
    let stored = client
        .request(Method::POST, "v1/scenes?parse=false")
        .header("content-type", "application/zip");
    let stored: Created =
        stored.body(Scan::neutral().zip()).send().await.unwrap().json().await.unwrap();
    let asked = client.ground_many(&one).await.unwrap();
    assert_eq!((asked.looked_into, asked.answers.len()), (2, 1));
    let codes: Vec<(&str, &str)> =
        asked.not_asked.iter().map(|not| (not.scene_id.as_str(), not.code.as_str())).collect();
    assert_eq!(codes, [(stored.scene.id.as_str(), "scene_not_ready")]);
    server.stop().await;
}

/// Of more rooms than can be looked into one by one those are that are known to have it, also once
/// somebody has said what it is called.
#[tokio::test(flavor = "multi_thread")]
async fn among_a_thousand_rooms_the_likely_ones_are_looked_into() {
    let server = TestServer::start().await;
    let client = &server.client;
    let with = server.parsed(Scan::of_room(&THINGS, &EIGHTHS).zip()).await;
    let without = Scan::of_room(&THINGS[..2], &EIGHTHS).zip();
    server.parsed(without.clone()).await;
    for _ in 0..1000 {
        // The same room again and again: parsed once.
        let upload = client
            .request(Method::POST, "v1/scenes")
            .header("content-type", "application/zip")
            .body(without.clone());
        assert_eq!(upload.send().await.unwrap().status(), StatusCode::ACCEPTED);
    }
    let found = async |query: &str, id: &str| {
        for _ in 0..100 {
            let asked = client
                .ground_many(&ManyGroundRequest { top_k: 1, ..ManyGroundRequest::new(query) })
                .await
                .unwrap();
            assert!(asked.narrowed && asked.looked_into <= 200, "{asked:?}");
            if asked.answers.iter().any(|found| found.answer.scene_id == id) {
                return true;
            }
            sleep(Duration::from_millis(200)).await;
        }
        false
    };
    assert!(found("the green trash can", &with.id).await);
    // What somebody says it is called is known a little later.
    let named = client.instances(&with.id, 100).await.unwrap().instances;
    let thing = named.iter().find(|i| i.structure.is_none()).unwrap().id;
    client
        .correct(&with.id, &Change::Rename { instance_id: thing, name: "theremin".into() })
        .await
        .unwrap();
    assert!(found("the theremin", &with.id).await);
    let elsewhere = ManyGroundRequest {
        labels: labeled(&[("floor", "9")]),
        ..ManyGroundRequest::new("the theremin")
    };
    assert_eq!(client.ground_many(&elsewhere).await.unwrap().looked_into, 0);
    server.stop().await;
}

#[tokio::test]
async fn labels_are_what_was_said_last() {
    let server = TestServer::start().await;
    let client = &server.client;
    let scene = server.parsed(Scan::neutral().zip()).await;
    assert_eq!(scene.labels, Labels::new());
    filed(client, &scene, "den", &[("building", "A"), ("floor", "2")]).await;
    // A name that is given anew changes nothing else.
    assert_eq!(client.rename_scene(&scene.id, "study").await.unwrap().labels.len(), 2);
    let listed = async |labels: &str| {
        client.scenes_labelled(labels, 10, None).await.map(|page| page.scenes.len())
    };
    assert_eq!(listed("building=A").await.unwrap(), 1);
    assert_eq!(listed("building=A,floor=2").await.unwrap(), 1);
    assert_eq!(listed("building=A,floor=3").await.unwrap(), 0);
    assert_eq!(problem(listed("building").await).code, "invalid_request");
    filed(client, &scene, "study", &[]).await;
    assert_eq!(listed("building=A").await.unwrap(), 0);
    let wrong =
        SceneChange { labels: Some(labeled(&[("two words", "x")])), ..SceneChange::default() };
    assert_eq!(problem(client.change_scene(&scene.id, &wrong).await).code, "invalid_request");
    server.stop().await;
}

#[tokio::test]
async fn what_can_not_be_asked_is_named() {
    let server = TestServer::start().await;
    let client = &server.client;
    let asked = || ManyGroundRequest::new("the red sofa");
    let refused =
        async |request: ManyGroundRequest| problem(client.ground_many(&request).await).code;
    assert_eq!(refused(ManyGroundRequest { top_k: 21, ..asked() }).await, "invalid_request");
    assert_eq!(
        refused(ManyGroundRequest { scenes: Some(Vec::new()), ..asked() }).await,
        "invalid_request"
    );
    let nobody = "01a1ff70-0000-7000-8000-000000000001".to_owned();
    assert_eq!(
        refused(ManyGroundRequest { scenes: Some(vec![nobody]), ..asked() }).await,
        "scene_not_found"
    );
    let keyed =
        client.request(Method::POST, "v1/ground").header("idempotency-key", "k").json(&asked());
    assert_eq!(keyed.send().await.unwrap().status(), StatusCode::UNPROCESSABLE_ENTITY);
    // No scene at all is no error: it is nowhere.
    let nowhere = client.ground_many(&asked()).await.unwrap();
    assert_eq!((nowhere.looked_into, nowhere.answers.len()), (0, 0));
    server.stop().await;
}

#[tokio::test]
async fn vectors_want_a_database_that_can_keep_them() {
    let data = tempfile::tempdir().unwrap();
    let mut config = config(Utf8Path::from_path(data.path()).unwrap());
    config.database.vectors = Vectors::Pgvector;
    let told = format!("{:#}", app::start(&config).await.err().unwrap());
    assert!(
        told.contains("--vectors pgvector")
            && (told.contains("SQLite") || told.contains("CREATE EXTENSION")),
        "{told}"
    );
}
