//! Migration of a data folder to another folder and another database, and back. Clients see no
//! difference.

use crate::scripted_model::Script;
use crate::test_scans::Scan;
use crate::test_server::{
    Process, assert_contains, database_location, open_database, serve_command, wait_for_job,
};
use crate::vlm::six_field_reply;
use camino::{Utf8Path, Utf8PathBuf};
use reqwest::{Method, RequestBuilder, StatusCode};
use serde_json::{Value, json};
use sqlx::Connection;
use sqlx::sqlite::SqliteConnection;
use std::fs;
use std::io::{BufRead, BufReader};
use std::process::{Command, Output, Stdio};
use uniground_client::Client;
use uniground_storage::Location;
use uniground_types::batch::BatchState;
use uniground_types::corrections::Change;
use uniground_types::job::JobState;
use uniground_types::keys::{NewKey, Scope};
use uniground_types::scenes::SceneStatus;
use uniground_types::uploads::Upload;

/// The operator's key, which all servers of a test accept.
const KEY: &str = "a key of the operator's";
const SQLITE: &str = "sqlite";

/// Data folders and a model that every server on them calls.
struct TestFolders {
    root: tempfile::TempDir,
    model: String,
}

impl TestFolders {
    async fn new() -> Self {
        let model =
            Script::default().serve(vec![six_field_reply(2, "2 -> red sofa", true, 4)]).await;
        Self { root: tempfile::tempdir().unwrap(), model }
    }

    fn at(&self, name: &str) -> Utf8PathBuf {
        Utf8PathBuf::try_from(self.root.path().join(name)).unwrap()
    }

    fn server(&self, data: &Utf8Path, database: &str) -> Server {
        let mut command = serve_command(data, "127.0.0.1:0");
        command
            .args(["--vlm-url", &self.model, "--vlm-model", "scripted", "--vlm-prompt-usd", "2"])
            .envs([
                ("UNIGROUND_DATABASE", database),
                ("UNIGROUND_API_KEY", KEY),
                ("UNIGROUND_BLOBS", "folder"),
            ]);
        let process = Process::spawn(command.stderr(Stdio::null()));
        let url = process.client.request(Method::GET, "").build().unwrap().url().to_string();
        Server { client: Client::new(&url, Some(KEY.into())).unwrap(), process }
    }
}

struct Server {
    client: Client,
    process: Process,
}

impl Server {
    fn stop(self) {
        assert_eq!(self.process.terminate(), Some(0));
    }

    /// A question that pays for a model call, under an idempotency key.
    fn asked_once(&self, scene: &str) -> RequestBuilder {
        let request = self.client.request(Method::POST, &format!("v1/scenes/{scene}/ground"));
        request.header("idempotency-key", "look").json(&json!({"query": "the red sofa"}))
    }
}

/// Returns another place for a folder's rows: PostgreSQL if the tests have one.
fn other_database(data: &Utf8Path) -> String {
    match database_location(data) {
        Location::Postgres(url) => url.with_password().to_owned(),
        _ => SQLITE.to_owned(),
    }
}

fn migrate_command(from: (&Utf8Path, &str), to: (&Utf8Path, &str)) -> Command {
    let mut command = Command::new(env!("CARGO_BIN_EXE_uniground"));
    command.args(["migrate", "--from", from.0.as_str(), "--from-database", from.1]);
    command.args(["--to", to.0.as_str(), "--to-database", to.1, "--json"]);
    command
}

fn migrate(from: (&Utf8Path, &str), to: (&Utf8Path, &str)) -> Value {
    let output = migrate_command(from, to).output().unwrap();
    assert!(output.status.success(), "{}", output_text(&output));
    serde_json::from_slice(&output.stdout).unwrap()
}

fn migrate_error(from: (&Utf8Path, &str), to: (&Utf8Path, &str)) -> String {
    let output = migrate_command(from, to).output().unwrap();
    assert!(!output.status.success(), "{}", output_text(&output));
    output_text(&output)
}

/// Returns the error of a server that refuses to start.
fn startup_error(data: &Utf8Path, database: &str) -> String {
    let output = serve_command(data, "127.0.0.1:0")
        .envs([("UNIGROUND_DATABASE", database), ("UNIGROUND_BLOBS", "folder")])
        .output()
        .unwrap();
    assert!(!output.status.success(), "{}", output_text(&output));
    output_text(&output)
}

fn output_text(output: &Output) -> String {
    format!(
        "{}{}",
        String::from_utf8_lossy(&output.stdout),
        String::from_utf8_lossy(&output.stderr)
    )
}

/// A data folder with rows in every table, and the URLs of everything in it.
struct PopulatedFolder {
    scene: String,
    upload: String,
    paths: Vec<String>,
}

async fn populate(server: &Server) -> PopulatedFolder {
    let client = &server.client;
    let created = client
        .create_scene_once(&[("name", "kitchen")], "application/zip", Scan::neutral().zip(), "room")
        .await
        .unwrap();
    let scene = created.scene.id;
    let job = wait_for_job(client, &created.job.unwrap().id).await;
    assert_eq!(job.error, None);
    let filed = json!({"labels": {"building": "A"}, "scene_to_map": {"rotation": [0.0, 0.0, 0.6, 0.8], "translation_m": [1.0, 2.0, 0.1]}});
    let change = client
        .request(Method::PATCH, &format!("v1/scenes/{scene}"))
        .json(&filed)
        .send()
        .await
        .unwrap();
    assert_eq!(change.status(), 200, "{}", change.text().await.unwrap());

    let asked: Value = server.asked_once(&scene).send().await.unwrap().json().await.unwrap();
    assert!(asked["usage"]["vlm_calls"].as_u64() > Some(0), "{asked}");
    let odd = json!({"query": "the \"blue\" box, \\u{1F9F8}\n\u{1f9f8} für die Küche", "reasoner": "builtin"});
    let other: Value = client
        .request(Method::POST, &format!("v1/scenes/{scene}/ground"))
        .json(&odd)
        .send()
        .await
        .unwrap()
        .json()
        .await
        .unwrap();
    let instance_id = client.instances(&scene, 1).await.unwrap().instances[0].id;
    client
        .correct(&scene, &Change::Rename { instance_id, name: "Grandma's bench".into() })
        .await
        .unwrap();
    let junk =
        client.correct(&scene, &Change::Dismiss { instance_ids: vec![instance_id] }).await.unwrap();
    client.undo_correction(&scene, &junk.id).await.unwrap();

    let mut batches = Vec::new();
    for (bounds, key) in [
        (json!({}), None),
        (json!({"max_cost_usd": 0.1, "concurrency": 2, "label": "monday"}), Some("list")),
    ] {
        let items: Vec<_> = ["the red sofa", "the fridge", ""]
            .map(|query| json!({"query": query, "reasoner": "builtin"}))
            .to_vec();
        let mut request = json!({"items": items, "defaults": {"scene_id": scene}});
        request.as_object_mut().unwrap().extend(bounds.as_object().unwrap().clone());
        let batch =
            client.create_batch(&serde_json::from_value(request).unwrap(), key).await.unwrap();
        wait_for_job(client, batch.job_id.as_deref().unwrap()).await;
        assert_eq!(client.batch(&batch.id).await.unwrap().state, BatchState::Succeeded);
        batches.push(batch.id);
    }
    for daily_usd in [None, Some(1.1)] {
        let key = NewKey {
            name: "robot".into(),
            scope: Scope::Read,
            expires_at: None,
            requests_per_minute: Some(9),
            max_scenes: None,
            daily_usd,
        };
        client.create_key(&key).await.unwrap();
    }
    // The first half of another scan.
    let scan = Scan::neutral().with("note.txt", "another").zip();
    let upload = client
        .request(Method::POST, "v1/uploads")
        .header("upload-length", scan.len())
        .header("tus-resumable", "1.0.0");
    let upload = upload
        .header("content-type", "application/offset+octet-stream")
        .body(scan[..scan.len() / 2].to_vec())
        .send()
        .await
        .unwrap();
    assert_eq!(upload.status(), 201);
    let upload = upload.headers()["location"].to_str().unwrap().trim_start_matches('/').to_owned();

    let of_scene = [
        "",
        "/instances",
        "/cloud.ply",
        "/instances.ply",
        "/points.bin",
        "/thumbnail.jpg",
        "/report",
        "/graph",
        "/corrections",
        "/annotations",
        "/frames",
        "/instances/1/views/0.jpg",
        "/export?format=glb",
    ];
    let mut paths: Vec<String> =
        of_scene.iter().map(|path| format!("v1/scenes/{scene}{path}")).collect();
    paths.extend(
        ["scenes", "scenes?labels=building=A", "answers", "batches", "keys", "jobs", "audit"]
            .map(|list| format!("v1/{list}")),
    );
    for answer in [&asked, &other] {
        paths.push(format!("v1/answers/{}", answer["id"].as_str().unwrap()));
    }
    paths.extend(
        ["prompt", "reply"]
            .map(|part| format!("v1/answers/{}/{part}", asked["id"].as_str().unwrap())),
    );
    paths.extend(
        batches
            .iter()
            .flat_map(|id| [format!("v1/batches/{id}"), format!("v1/batches/{id}/results")]),
    );
    paths.extend([format!("v1/jobs/{}", job.id), upload.clone()]);
    PopulatedFolder { scene, upload, paths }
}

/// Returns the server's response to each path, byte for byte.
async fn fetch_all(server: &Server, paths: &[String]) -> Vec<(String, Vec<u8>)> {
    let mut told = Vec::new();
    for path in paths {
        let bytes =
            server.client.bytes(path).await.unwrap_or_else(|error| panic!("{path}: {error}"));
        assert!(!bytes.is_empty(), "{path}");
        told.push((path.clone(), bytes));
    }
    told
}

fn assert_same(told: &[(String, Vec<u8>)], before: &[(String, Vec<u8>)]) {
    for ((path, told), (_, before)) in told.iter().zip(before) {
        let text =
            |bytes: &[u8]| String::from_utf8_lossy(&bytes[..bytes.len().min(2000)]).into_owned();
        assert!(told == before, "{path}: {}\n{}", text(told), text(before));
    }
}

/// Checks that retries and unfinished work carry over: an idempotency key returns its answer, the
/// same bytes find their parse, and half an upload can be completed.
async fn assert_work_continues(
    server: &Server,
    PopulatedFolder { scene, upload, .. }: &PopulatedFolder,
    before: &[(String, Vec<u8>)],
) {
    let again = server.asked_once(scene).send().await.unwrap();
    assert_eq!(
        (again.status(), again.headers()["idempotent-replayed"].to_str().unwrap()),
        (StatusCode::OK, "true")
    );
    let answer: Value = again.json().await.unwrap();
    let path = format!("v1/answers/{}", answer["id"].as_str().unwrap());
    let kept = &before.iter().find(|(known, _)| *known == path).unwrap().1;
    assert_eq!(answer, serde_json::from_slice::<Value>(kept).unwrap());
    let client = &server.client;
    let created = client
        .create_scene_once(&[("name", "kitchen")], "application/zip", Scan::neutral().zip(), "room")
        .await
        .unwrap();
    assert_eq!(&created.scene.id, scene);
    let same = client.create_scene(None, "application/zip", Scan::neutral().zip()).await.unwrap();
    assert_eq!(
        (same.scene.status, same.job.unwrap().state),
        (SceneStatus::Ready, JobState::Succeeded),
        "nothing is parsed again"
    );

    let scan = Scan::neutral().with("note.txt", "another").zip();
    let rest = client
        .request(Method::PATCH, upload)
        .header("upload-offset", scan.len() / 2)
        .header("tus-resumable", "1.0.0");
    let rest = rest
        .header("content-type", "application/offset+octet-stream")
        .body(scan[scan.len() / 2..].to_vec())
        .send()
        .await
        .unwrap();
    assert_eq!(rest.status(), 204, "{}", rest.text().await.unwrap());
    // No job is running when the server is queried next.
    let made: Upload =
        client.request(Method::GET, upload).send().await.unwrap().json().await.unwrap();
    assert_eq!(wait_for_job(client, &made.job_id.unwrap()).await.error, None);
}

/// Asserts that `uniground doctor` finds no damage.
fn assert_whole(data: &Utf8Path, database: &str) {
    let looked = Command::new(env!("CARGO_BIN_EXE_uniground"))
        .args(["doctor", "--data-dir", data.as_str(), "--database", database])
        .output();
    let looked = looked.unwrap();
    assert!(looked.status.success(), "{}", output_text(&looked));
}

#[tokio::test(flavor = "multi_thread")]
async fn a_data_folder_migrates_and_back_byte_for_byte() {
    let house = TestFolders::new().await;
    let (old, new, back) = (house.at("old"), house.at("new"), house.at("back"));
    let database = other_database(&new);
    let server = house.server(&old, SQLITE);
    let lived = populate(&server).await;
    let before = fetch_all(&server, &lived.paths).await;
    server.stop();

    let moved = migrate((&old, SQLITE), (&new, &database));
    assert_eq!(
        (&moved["rows"]["scenes"], &moved["rows"]["batch_items"], &moved["damaged"]),
        (&json!(1), &json!(6), &json!([]))
    );
    for table in [
        "instances",
        "answers",
        "question_keys",
        "idempotency_keys",
        "corrections",
        "keys",
        "audit",
        "uploads",
        "spending",
    ] {
        assert!(moved["rows"][table].as_u64().unwrap() > 0, "{table}: {moved}");
    }
    assert_whole(&new, &database);
    let server = house.server(&new, &database);
    assert_same(&fetch_all(&server, &lived.paths).await, &before);
    assert_work_continues(&server, &lived, &before).await;
    let later = fetch_all(&server, &lived.paths).await;
    server.stop();
    // The source is unchanged.
    let server = house.server(&old, SQLITE);
    assert_same(&fetch_all(&server, &lived.paths).await, &before);
    server.stop();

    migrate((&new, &database), (&back, SQLITE));
    assert_whole(&back, SQLITE);
    let server = house.server(&back, SQLITE);
    assert_same(&fetch_all(&server, &lived.paths).await, &later);
    server.stop();
    // Two folders stay separate: neither accepts the other's database.
    if database != SQLITE {
        let other = house.at("other");
        migrate((&back, SQLITE), (&other, &other_database(&other)));
        assert_contains(startup_error(&other, &database), "do not belong together");
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn a_folder_can_switch_to_another_database() {
    let house = TestFolders::new().await;
    let data = house.at("data");
    let database = other_database(&data);
    let server = house.server(&data, SQLITE);
    let lived = populate(&server).await;
    let before = fetch_all(&server, &lived.paths).await;
    server.stop();
    if database == SQLITE {
        assert_contains(migrate_error((&data, SQLITE), (&data, SQLITE)), "have the same database");
        return;
    }
    let moved = migrate((&data, SQLITE), (&data, &database));
    assert_eq!(moved["files"], json!([]));
    let aside = moved["set_aside"].as_str().unwrap();
    assert!(Utf8Path::new(aside).is_file() && !data.join("uniground.sqlite").exists(), "{aside}");
    assert_contains(startup_error(&data, SQLITE), "its rows are stored in PostgreSQL");
    let server = house.server(&data, &database);
    assert_same(&fetch_all(&server, &lived.paths).await, &before);
    assert_work_continues(&server, &lived, &before).await;
    let later = fetch_all(&server, &lived.paths).await;
    server.stop();
    // A database with rows is not overwritten, even if it belonged to this folder.
    migrate((&data, &database), (&data, SQLITE));
    let full = migrate_error((&data, SQLITE), (&data, &database));
    assert!(full.contains("is not empty (rows of another data folder: 3 scenes"), "{full}");
    let server = house.server(&data, SQLITE);
    assert_same(&fetch_all(&server, &lived.paths).await, &later);
    server.stop();
}

#[tokio::test(flavor = "multi_thread")]
async fn invalid_targets_are_refused_and_change_nothing() {
    let house = TestFolders::new().await;
    let (data, other, full) = (house.at("data"), house.at("other"), house.at("full"));
    let server = house.server(&data, SQLITE);
    assert!(
        migrate_error((&data, SQLITE), (&other, SQLITE))
            .contains("another server uses this data folder")
    );
    server.stop();
    house.server(&other, SQLITE).stop();
    fs::create_dir(&full).unwrap();
    fs::write(full.join("thesis.tex"), "words").unwrap();
    for (to, why) in [
        (&other, "is not empty"),
        (&full, "is not empty (thesis.tex)"),
        (&data.join("new"), "must not be inside the other"),
    ] {
        let told = migrate_error((&data, SQLITE), (to, SQLITE));
        assert!(told.contains(why), "{to}: {told}");
    }
    let free = house.at("free");
    let told = migrate_error((&house.at("nowhere"), SQLITE), (&free, SQLITE));
    assert!(told.contains("nowhere") && !free.exists(), "{told}");
    let told = migrate_error((&data, "postgres://robot:s3cret@127.0.0.1:1/rooms"), (&free, SQLITE));
    assert!(told.contains("are stored in SQLite: set --from-database"), "{told}");
    let told = migrate_error((&data, SQLITE), (&free, "postgres://robot:s3cret@127.0.0.1:1/rooms"));
    assert!(told.contains("postgres://127.0.0.1:1/rooms") && !told.contains("s3cret"), "{told}");
    let told = migrate_error((&data, SQLITE), (&free, "mysql://robot@127.0.0.1/rooms"));
    assert!(told.contains("mysql:// is not a supported database"), "{told}");
    assert_eq!(fs::read_to_string(full.join("thesis.tex")).unwrap(), "words");
    // A refused migration changes nothing.
    for folder in [&data, &other] {
        house.server(folder, SQLITE).stop();
    }
    migrate((&data, SQLITE), (&free, &other_database(&free)));
}

/// A row with a dangling reference cannot be copied. The partial target is unusable, and once the
/// row is repaired the migration succeeds.
#[tokio::test(flavor = "multi_thread")]
async fn a_failed_migration_is_not_served_and_can_be_repeated() {
    let house = TestFolders::new().await;
    let (old, new) = (house.at("old"), house.at("new"));
    let database = other_database(&new);
    let server = house.server(&old, SQLITE);
    let lived = populate(&server).await;
    let before = fetch_all(&server, &lived.paths).await;
    server.stop();
    let file = format!("sqlite:{}", old.join("uniground.sqlite"));
    let execute = async |sql: &'static str| {
        let mut rows = SqliteConnection::connect(&file).await.unwrap();
        sqlx::raw_sql(sql).execute(&mut rows).await.unwrap();
        rows.close().await.unwrap();
    };
    execute("PRAGMA foreign_keys = OFF; INSERT INTO answers (id, scene_id, parse_id, body, created_at) VALUES ('stray', 'gone', 'gone', '{}', '')").await;
    for _ in 0..2 {
        let told = migrate_error((&old, SQLITE), (&new, &database));
        assert!(told.contains("rows of answers could not be migrated"), "{told}");
        assert_contains(startup_error(&new, &database), "run the same `uniground migrate` again");
    }
    execute("DELETE FROM answers WHERE id = 'stray'").await;
    // If the next run uses another database, the partial rows in the first one are never used.
    let other = other_database(&house.at("other"));
    migrate((&old, SQLITE), (&new, &other));
    let server = house.server(&new, &other);
    assert_same(&fetch_all(&server, &lived.paths).await, &before);
    server.stop();
    if database != SQLITE {
        assert_contains(startup_error(&new, &database), "do not belong together");
    }
}

/// The process is killed while it copies rows.
#[tokio::test(flavor = "multi_thread")]
async fn a_killed_migration_can_be_repeated() {
    const MANY: i64 = 300_000;
    let house = TestFolders::new().await;
    let (old, new) = (house.at("old"), house.at("new"));
    let database = other_database(&new);
    house.server(&old, SQLITE).stop();
    let mut rows_of_old =
        SqliteConnection::connect(&format!("sqlite:{}", old.join("uniground.sqlite")))
            .await
            .unwrap();
    let sql = "WITH RECURSIVE n (i) AS (SELECT 1 UNION ALL SELECT i + 1 FROM n WHERE i < $1)
               INSERT INTO audit (id, at, method, path, status)
               SELECT printf('018f0000-0000-7000-8000-%012x', i), '2026-11-24T00:00:00Z', 'POST', '/v1/scenes', 201 FROM n";
    sqlx::query(sql).bind(MANY).execute(&mut rows_of_old).await.unwrap();
    rows_of_old.close().await.unwrap();

    let mut child = migrate_command((&old, SQLITE), (&new, &database))
        .stderr(Stdio::piped())
        .stdout(Stdio::null())
        .spawn()
        .unwrap();
    let mut lines = BufReader::new(child.stderr.take().unwrap()).lines();
    assert!(lines.any(|line| line.unwrap() == format!("rows of audit: {MANY}")));
    child.kill().unwrap();
    assert!(!child.wait().unwrap().success());
    assert!(
        new.join("uniground-moving.json").exists() && !new.join("uniground-data.json").exists()
    );
    assert_contains(startup_error(&new, &database), "run the same `uniground migrate` again");
    let moved = migrate((&old, SQLITE), (&new, &database));
    assert_eq!(moved["rows"]["audit"], json!(MANY));
    assert!(!new.join("uniground-moving.json").exists());
    house.server(&new, &database).stop();
    let mut kept = open_database(&new).await;
    let count: i64 =
        sqlx::query_scalar("SELECT count(*) FROM audit").fetch_one(&mut kept).await.unwrap();
    assert_eq!(count, MANY);
    kept.close().await.unwrap();
}
