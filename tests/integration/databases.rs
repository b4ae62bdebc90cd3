//! Which database belongs to which folder. All other tests also run on PostgreSQL (`make
//! test-postgres`).

use crate::test_scans::Scan;
use crate::test_server::{TestServer, ask, database_location, expect_problem, open_database};
use camino::Utf8Path;
use reqwest::Method;
use serde_json::Value;
use sqlx::Connection;
use std::fs;
use std::process::{Command, Output};
use std::time::Duration;
use tokio::time::sleep;
use uniground_storage::Location;

fn run_serve(data: &Utf8Path, database: &str) -> Output {
    Command::new(env!("CARGO_BIN_EXE_uniground"))
        .args([
            "serve",
            "--listen",
            "127.0.0.1:0",
            "--data-dir",
            data.as_str(),
            "--database",
            database,
        ])
        .env_remove("UNIGROUND_API_KEY")
        .output()
        .unwrap()
}

#[tokio::test]
async fn a_folder_refuses_another_database() {
    let data = TestServer::start().await.stop_and_keep_data().await;
    let data = Utf8Path::from_path(data.path()).unwrap();
    let (own, other) = match database_location(data) {
        Location::Postgres(_) => ("PostgreSQL", "sqlite"),
        _ => ("SQLite", "postgres://robot@127.0.0.1:1/rooms"),
    };
    let refused = run_serve(data, other);
    let told = String::from_utf8_lossy(&refused.stderr);
    assert!(
        !refused.status.success()
            && told.contains(&format!("its rows are stored in {own}: set --database")),
        "{told}"
    );
}

/// The error for an unreachable database names it without its password, and the folder can use
/// another database.
#[test]
fn an_unreachable_database_is_reported_without_its_password() {
    let place = tempfile::tempdir().unwrap();
    let data = Utf8Path::from_path(place.path()).unwrap();
    let refused = run_serve(data, "postgres://robot:s3cret@127.0.0.1:1/rooms");
    let told = String::from_utf8_lossy(&refused.stderr);
    assert!(!refused.status.success() && told.contains("postgres://127.0.0.1:1/rooms"), "{told}");
    assert!(!told.contains("s3cret"), "{told}");
    assert!(!data.join("uniground-data.json").exists());
    let refused = run_serve(data, "mysql://robot:s3cret@127.0.0.1/rooms");
    let told = String::from_utf8_lossy(&refused.stderr);
    assert!(
        told.contains("mysql:// is not a supported database") && !told.contains("s3cret"),
        "{told}"
    );
}

/// An answer is stored and found by its status whatever characters the question contains.
#[tokio::test]
async fn a_question_can_contain_any_character_except_nul() {
    let server = TestServer::start().await;
    let scene = server.upload_and_parse(Scan::neutral().zip()).await.id;
    let odd = "the red sofa \"status\":\"no_match\" \u{1} \u{1f9f8}";
    let answer = server.client.ground(&scene, &ask(odd)).await.unwrap();
    let status = serde_json::to_value(answer.status).unwrap();
    let path = format!("/v1/answers?status={}", status.as_str().unwrap());
    let listed: Value =
        server.client.request(Method::GET, &path).send().await.unwrap().json().await.unwrap();
    assert_eq!(
        (&listed["answers"][0]["id"], &listed["answers"][0]["query"]),
        (&answer.id.into(), &odd.into())
    );
    // Except NUL: text does not contain it, and not every database could store it.
    assert_eq!(expect_problem(server.client.ground(&scene, &ask("the \0 sofa")).await).status, 422);
    for (address, expected) in [
        ("/v1/scenes/%00", 404),
        ("/v1/jobs/a%00b", 404),
        ("/v1/jobs?subject=%00", 422),
        ("/v1/scenes?labels=a=%00", 422),
    ] {
        let told = server.client.request(Method::GET, address).send().await.unwrap();
        assert_eq!(told.status().as_u16(), expected, "{address}");
    }
    server.stop().await;
}

/// An optional number is stored when it is given, whatever the requests before it contained.
#[tokio::test]
async fn optional_numbers_are_stored_when_given() {
    let server = TestServer::start().await;
    let scene = server.upload_and_parse(Scan::neutral().zip()).await.id;
    for max_cost_usd in [None, Some(1.5), None, Some(2.5)] {
        let item = serde_json::json!({"scene_id": scene, "query": "the red sofa"});
        let request = serde_json::from_value(
            serde_json::json!({"items": [item], "max_cost_usd": max_cost_usd}),
        )
        .unwrap();
        server.client.create_batch(&request, None).await.unwrap();
    }
    server.stop().await;
}

/// The readiness check, not a question, detects a truncated database file.
#[tokio::test]
async fn a_truncated_database_file_makes_the_server_unready() {
    let server = TestServer::start().await;
    if matches!(database_location(server.data()), Location::Postgres(_)) {
        eprintln!("skipped: PostgreSQL checks its own files");
        return server.stop().await;
    }
    let scene = server.upload_and_parse(Scan::neutral().zip()).await.id;
    server.client.ground(&scene, &ask("the red sofa")).await.unwrap();
    server.client.bytes("readyz").await.unwrap();
    let mut rows = open_database(server.data()).await;
    sqlx::query("PRAGMA wal_checkpoint(FULL)").execute(&mut rows).await.unwrap();
    rows.close().await.unwrap();
    let file =
        fs::OpenOptions::new().write(true).open(server.data().join("uniground.sqlite")).unwrap();
    file.set_len(file.metadata().unwrap().len() / 2).unwrap();
    // Readiness results are cached for a second, so ask repeatedly.
    let mut tries = 0;
    let response = loop {
        let response = server.client.request(Method::GET, "readyz").send().await.unwrap();
        if response.status() != 200 || tries == 50 {
            break response;
        }
        tries += 1;
        sleep(Duration::from_millis(100)).await;
    };
    assert_eq!(response.status(), 503);
    let readiness: Value = response.json().await.unwrap();
    assert!(readiness["database"].as_str().unwrap().contains("damaged"), "{readiness}");
    server.stop().await;
}
