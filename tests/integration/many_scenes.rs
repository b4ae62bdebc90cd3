//! Questions across many scenes, and labels that select among them.

use crate::test_scans::{EIGHTHS, Scan, THINGS};
use crate::test_server::{TestServer, expect_problem, serve_config};
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

fn to_labels(labels: &[(&str, &str)]) -> Labels {
    labels.iter().map(|(name, value)| ((*name).to_owned(), (*value).to_owned())).collect()
}

async fn set_name_and_labels(client: &Client, scene: &Scene, name: &str, labels: &[(&str, &str)]) {
    let change = SceneChange {
        name: Some(name.into()),
        labels: Some(to_labels(labels)),
        ..SceneChange::default()
    };
    let changed = client.change_scene(&scene.id, &change).await.unwrap();
    assert_eq!((changed.name.as_str(), &changed.labels), (name, &to_labels(labels)));
}

#[tokio::test(flavor = "multi_thread")]
async fn the_scene_with_the_target_is_ranked_first() {
    let server = TestServer::start().await;
    let client = &server.client;
    // One scene has the green box; both have the floor and the red sofa.
    let with = server.upload_and_parse(Scan::of_room(&THINGS, &EIGHTHS).zip()).await;
    let without = server.upload_and_parse(Scan::of_room(&THINGS[..2], &EIGHTHS).zip()).await;
    set_name_and_labels(client, &with, "office", &[("building", "A"), ("floor", "2")]).await;
    set_name_and_labels(client, &without, "hall", &[("building", "A"), ("floor", "1")]).await;
    let asked = client.ground_many(&ManyGroundRequest::new("the green trash can")).await.unwrap();
    assert_eq!(
        (asked.looked_into, asked.answers.len(), &asked.not_asked[..]),
        (2, 2, &[][..]),
        "{asked:?}"
    );
    let best = &asked.answers[0];
    assert_eq!((best.scene_name.as_str(), &best.answer.scene_id), ("office", &with.id));
    assert_ne!(best.answer.status, Status::NoMatch);
    assert_eq!(best.labels, to_labels(&[("building", "A"), ("floor", "2")]));
    // The answer is stored and equals the scene's own answer.
    assert_eq!(client.answer(&best.answer.id).await.unwrap(), best.answer);

    // Restricted to some scenes, with a limit on answers.
    let one = ManyGroundRequest { top_k: 1, ..ManyGroundRequest::new("the red sofa") };
    assert_eq!(client.ground_many(&one).await.unwrap().answers.len(), 1);
    let on_the_first = ManyGroundRequest { labels: to_labels(&[("floor", "1")]), ..one.clone() };
    let asked = client.ground_many(&on_the_first).await.unwrap();
    assert_eq!((asked.looked_into, asked.answers[0].scene_name.as_str()), (1, "hall"));
    let named = ManyGroundRequest { scenes: Some(vec![with.id.clone()]), ..one.clone() };
    assert_eq!(client.ground_many(&named).await.unwrap().answers[0].answer.scene_id, with.id);
    let nowhere = ManyGroundRequest { labels: to_labels(&[("building", "B")]), ..one.clone() };
    let asked = client.ground_many(&nowhere).await.unwrap();
    assert_eq!((asked.looked_into, asked.answers.len()), (0, 0));

    // A scene that is not parsed is reported and blocks nothing.
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

/// With more scenes than can be scanned, those that probably contain the target are scanned, also
/// by a name from a correction.
#[tokio::test(flavor = "multi_thread")]
async fn only_likely_scenes_are_scanned_among_many() {
    let server = TestServer::start().await;
    let client = &server.client;
    let with = server.upload_and_parse(Scan::of_room(&THINGS, &EIGHTHS).zip()).await;
    let without = Scan::of_room(&THINGS[..2], &EIGHTHS).zip();
    server.upload_and_parse(without.clone()).await;
    for _ in 0..1000 {
        // The same room many times: it is parsed once.
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
    // A name from a correction enters the index a little later.
    let named = client.instances(&with.id, 100).await.unwrap().instances;
    let thing = named.iter().find(|i| i.structure.is_none()).unwrap().id;
    client
        .correct(&with.id, &Change::Rename { instance_id: thing, name: "theremin".into() })
        .await
        .unwrap();
    assert!(found("the theremin", &with.id).await);
    let elsewhere = ManyGroundRequest {
        labels: to_labels(&[("floor", "9")]),
        ..ManyGroundRequest::new("the theremin")
    };
    assert_eq!(client.ground_many(&elsewhere).await.unwrap().looked_into, 0);
    server.stop().await;
}

#[tokio::test]
async fn the_latest_labels_apply() {
    let server = TestServer::start().await;
    let client = &server.client;
    let scene = server.upload_and_parse(Scan::neutral().zip()).await;
    assert_eq!(scene.labels, Labels::new());
    set_name_and_labels(client, &scene, "den", &[("building", "A"), ("floor", "2")]).await;
    // Renaming a scene changes nothing else.
    assert_eq!(client.rename_scene(&scene.id, "study").await.unwrap().labels.len(), 2);
    let listed = async |labels: &str| {
        client.scenes_with_labels(labels, 10, None).await.map(|page| page.scenes.len())
    };
    assert_eq!(listed("building=A").await.unwrap(), 1);
    assert_eq!(listed("building=A,floor=2").await.unwrap(), 1);
    assert_eq!(listed("building=A,floor=3").await.unwrap(), 0);
    assert_eq!(expect_problem(listed("building").await).code, "invalid_request");
    set_name_and_labels(client, &scene, "study", &[]).await;
    assert_eq!(listed("building=A").await.unwrap(), 0);
    let wrong =
        SceneChange { labels: Some(to_labels(&[("two words", "x")])), ..SceneChange::default() };
    assert_eq!(
        expect_problem(client.change_scene(&scene.id, &wrong).await).code,
        "invalid_request"
    );
    server.stop().await;
}

#[tokio::test]
async fn invalid_many_scene_requests_are_refused() {
    let server = TestServer::start().await;
    let client = &server.client;
    let asked = || ManyGroundRequest::new("the red sofa");
    let refused =
        async |request: ManyGroundRequest| expect_problem(client.ground_many(&request).await).code;
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
    // A search over no scenes is not an error: the target is not found.
    let nowhere = client.ground_many(&asked()).await.unwrap();
    assert_eq!((nowhere.looked_into, nowhere.answers.len()), (0, 0));
    server.stop().await;
}

#[tokio::test]
async fn a_vector_index_requires_a_capable_database() {
    let data = tempfile::tempdir().unwrap();
    let mut config = serve_config(Utf8Path::from_path(data.path()).unwrap());
    config.database.vectors = Vectors::Pgvector;
    let told = format!("{:#}", app::start(&config).await.err().unwrap());
    assert!(
        told.contains("--vectors pgvector")
            && (told.contains("SQLite") || told.contains("CREATE EXTENSION")),
        "{told}"
    );
}
