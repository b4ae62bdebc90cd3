//! What a data folder keeps, what it lets go of, and how damage in it is found and mended.

use crate::archives::Scan;
use crate::server::{
    Process, TestServer, ask, blobs, finished, in_places, location, parsed, problem, rows,
};
use camino::{Utf8Path, Utf8PathBuf};
use sqlx::Connection;
use std::fs;
use std::process::{Command, Output};
use uniground::config::{LimitsConfig, ModelsConfig, RetentionConfig, VlmConfig};
use uniground_service::{Dependencies, Services};
use uniground_storage::{JobState, Location, Store};
use uniground_types::corrections::Change;

fn doctor(data: &Utf8Path, more: &[&str]) -> Output {
    let program = Command::new(env!("CARGO_BIN_EXE_uniground"))
        .args(["doctor", "--data-dir", data.as_str()])
        .args(more)
        .envs(in_places(data))
        .output();
    program.unwrap()
}

fn told(output: &Output) -> String {
    format!(
        "{}{}",
        String::from_utf8_lossy(&output.stdout),
        String::from_utf8_lossy(&output.stderr)
    )
}

fn only(folder: &Utf8Path) -> Utf8PathBuf {
    folder.read_dir_utf8().unwrap().next().unwrap().unwrap().into_path()
}

/// A folder nobody knows is set aside, not removed; one that is older than the database is not even
/// touched.
#[tokio::test]
async fn what_no_record_speaks_of_goes_to_the_quarantine() {
    let server = TestServer::start().await;
    let scene = server.parsed(Scan::neutral().zip()).await;
    let data = server.give_back().await;
    let folder = Utf8Path::from_path(data.path()).unwrap();
    fs::create_dir(folder.join("blobs/parses/stranger")).unwrap();
    fs::write(folder.join("blobs/parses/stranger/cloud.ply"), "points").unwrap();
    let server = TestServer::start_on(
        data,
        LimitsConfig::default(),
        VlmConfig::default(),
        ModelsConfig::builtin(),
    )
    .await;
    assert!(!server.stored("blobs/parses").contains(&"stranger".to_owned()));
    let day = only(&server.data().join("quarantine"));
    assert_eq!(fs::read_to_string(day.join("parses/stranger/cloud.ply")).unwrap(), "points");

    // A database that is restored, or comes from elsewhere, has not seen what is older than its
    // coming.
    let data = server.give_back().await;
    let folder = Utf8Path::from_path(data.path()).unwrap();
    fs::create_dir(folder.join("blobs/parses/another")).unwrap();
    let mut rows = rows(folder).await;
    sqlx::query("UPDATE data_folder SET id = 'elsewhere'").execute(&mut rows).await.unwrap();
    rows.close().await.unwrap();
    // A server's database can be named with any folder: it is not believed at all.
    if let Location::Postgres(_) = location(folder) {
        let refused = doctor(folder, &[]);
        assert!(
            !refused.status.success() && told(&refused).contains("do not belong together"),
            "{}",
            told(&refused)
        );
        return;
    }
    let server = TestServer::start_on(
        data,
        LimitsConfig::default(),
        VlmConfig::default(),
        ModelsConfig::builtin(),
    )
    .await;
    assert!(server.stored("blobs/parses").contains(&"another".to_owned()));
    assert_eq!(server.client.scene(&scene.id).await.unwrap().id, scene.id);
    server.stop().await;
}

#[tokio::test]
async fn the_doctor_finds_damage_and_the_next_server_mends_it() {
    let data = tempfile::tempdir().unwrap();
    let data = Utf8Path::from_path(data.path()).unwrap();
    let server = Process::start(data);
    let scene = parsed(&server.client, "application/zip", Scan::neutral().zip()).await;
    // What people have said of a parse is said of the one that takes its place.
    let sofa = server
        .client
        .ground(&scene.id, &ask("the red sofa"))
        .await
        .unwrap()
        .answer
        .predicted_id
        .unwrap();
    let block = server
        .client
        .ground(&scene.id, &ask("the blue box"))
        .await
        .unwrap()
        .answer
        .predicted_id
        .unwrap();
    let merge = Change::Merge { instance_ids: vec![sofa, block], name: Some("corner sofa".into()) };
    let made = server.client.correct(&scene.id, &merge).await.unwrap().made;
    let refused = doctor(data, &[]);
    assert!(
        !refused.status.success() && told(&refused).contains("another server"),
        "{}",
        told(&refused)
    );
    assert_eq!(server.terminate(), Some(0));
    let well = doctor(data, &[]);
    assert!(well.status.success() && told(&well).contains("is whole"), "{}", told(&well));

    fs::write(only(&data.join("blobs/parses")).join("cloud.ply"), "ply").unwrap();
    fs::create_dir(data.join("blobs/answers/stranger")).unwrap();
    let ill = doctor(data, &[]);
    assert!(!ill.status.success(), "{}", told(&ill));
    assert!(
        told(&ill).contains("cloud.ply damaged") && told(&ill).contains("blobs/answers/stranger"),
        "{}",
        told(&ill)
    );
    let repaired = doctor(data, &["--repair"]);
    assert!(
        repaired.status.success() && told(&repaired).contains("repaired: 2; 1 parses wait"),
        "{}",
        told(&repaired)
    );

    let server = Process::start(data);
    let job = server.client.scene(&scene.id).await.unwrap().job_id.unwrap();
    assert_eq!(finished(&server.client, &job).await.state, JobState::Succeeded);
    let again = server.client.scene(&scene.id).await.unwrap();
    assert_eq!((again.parse_version, again.counts), (2, scene.counts));
    let answer = server.client.ground(&scene.id, &ask("the corner sofa")).await.unwrap();
    assert_eq!((answer.answer.predicted_id, answer.parse_version), (made, 2));
    assert_eq!(server.terminate(), Some(0));
    assert!(doctor(data, &[]).status.success());

    // A scan can not be made again: that is for people.
    let content = only(&data.join("blobs/contents"));
    fs::remove_file(content.join("pose/3.txt")).unwrap();
    let left = doctor(data, &["--repair"]);
    assert!(
        !left.status.success() && told(&left).contains("upload the scan again"),
        "{}",
        told(&left)
    );
}

#[tokio::test]
async fn old_answers_go_and_new_ones_stay() {
    let server = TestServer::start().await;
    let scene = server.parsed(Scan::neutral().zip()).await;
    let answer = server.client.ground(&scene.id, &ask("the red sofa")).await.unwrap();
    let data = server.give_back().await;
    let folder = Utf8Path::from_path(data.path()).unwrap();
    let mut rows = rows(folder).await;
    // Of January 2020, by id and time.
    let sql = "INSERT INTO answers (id, scene_id, parse_id, body, created_at)
               SELECT '016f5e66-e800-7000-8000-00000000000' || value, scene_id, parse_id, body, '2020-01-01T00:00:00Z' FROM answers, (SELECT '1' AS value UNION ALL SELECT '2' UNION ALL SELECT '3') AS few";
    sqlx::query(sql).execute(&mut rows).await.unwrap();
    let store =
        Store::open(folder, &location(folder), &blobs(folder).blob_home().unwrap()).await.unwrap();
    let limits = LimitsConfig {
        retention: RetentionConfig { keep_answers_days: 30, ..RetentionConfig::default() },
        ..LimitsConfig::default()
    };
    let dependencies = Dependencies::offline(store.clone(), limits.service_limits()).await.unwrap();
    let services = Services::new(dependencies);
    services.maintenance.run_maintenance().await.unwrap();
    let left: Vec<String> =
        sqlx::query_scalar("SELECT id FROM answers").fetch_all(&mut rows).await.unwrap();
    assert_eq!(left, [answer.id]);
    store.close().await;
}

/// A scan that is too large is one scan that is not parsed, and not the end of the server.
#[tokio::test]
async fn a_parse_that_wants_too_much_memory_is_not_begun() {
    let limits = LimitsConfig { max_memory_bytes: Some(1 << 20), ..LimitsConfig::default() };
    let server = TestServer::start_with(limits).await;
    let client = &server.client;
    let job = client
        .create_scene(None, "application/zip", Scan::neutral().zip())
        .await
        .unwrap()
        .job
        .unwrap();
    let job = finished(client, &job.id).await;
    // Others may have let go of theirs meanwhile.
    assert_eq!((job.state, job.attempts), (JobState::Failed, 2));
    let error = job.error.unwrap();
    assert_eq!(error.code, "memory_short");
    assert!(error.detail.contains("of its 1 MB"), "{}", error.detail);
    server.stop().await;
}

/// Before the disk is full nothing new is taken, and what is there goes on.
#[tokio::test]
async fn a_disk_that_is_nearly_full_takes_no_more_scans() {
    let server = TestServer::start().await;
    let scene = server.parsed(Scan::neutral().zip()).await;
    let data = server.give_back().await;
    let limits = LimitsConfig { keep_free_bytes: 1 << 60, ..LimitsConfig::default() };
    let server =
        TestServer::start_on(data, limits, VlmConfig::default(), ModelsConfig::builtin()).await;
    let refused =
        problem(server.client.create_scene(None, "application/zip", Scan::neutral().zip()).await);
    assert_eq!((refused.status, refused.code.as_str()), (507, "storage_full"));
    let parse =
        serde_json::json!({"settings": {"parsing": {"merging": {"keep_planes_apart": false}}}});
    assert_eq!(problem(server.client.parse(&scene.id, &parse).await).code, "storage_full");
    assert!(server.client.ground(&scene.id, &ask("the red sofa")).await.unwrap().stored);
    server.stop().await;
}

/// A batch takes room for its answers: it is put off, and goes on once the disk has room.
#[tokio::test]
async fn a_batch_waits_for_room_on_the_disk() {
    let server = TestServer::start().await;
    let scene = server.parsed(Scan::neutral().zip()).await.id;
    let line = format!("{}\n", serde_json::json!({"scene_id": scene, "query": "the red sofa"}));
    let batch = server
        .client
        .create_batch_of_lines(line.repeat(600), &[("concurrency", "1".to_owned())], None)
        .await
        .unwrap();
    let paused = server.client.control_batch(&batch.id, "pause").await.unwrap();
    finished(&server.client, paused.job_id.as_deref().unwrap()).await;
    let before = server.client.batch(&batch.id).await.unwrap().done;
    assert!(before < 600);
    let data = server.give_back().await;
    let limits = LimitsConfig { keep_free_bytes: 1 << 60, ..LimitsConfig::default() };
    let server =
        TestServer::start_on(data, limits, VlmConfig::default(), ModelsConfig::builtin()).await;
    let job = server.client.control_batch(&batch.id, "resume").await.unwrap().job_id.unwrap();
    while server.client.job(&job).await.unwrap().attempts < 2 {
        tokio::time::sleep(std::time::Duration::from_millis(50)).await;
    }
    assert_eq!(server.client.batch(&batch.id).await.unwrap().done, before);
    let refused = problem(server.client.create_batch_of_lines(line, &[], None).await);
    assert_eq!((refused.status, refused.code.as_str()), (507, "storage_full"));
    let data = server.give_back().await;
    let server = TestServer::start_on(
        data,
        LimitsConfig::default(),
        VlmConfig::default(),
        ModelsConfig::builtin(),
    )
    .await;
    assert_eq!(finished(&server.client, &job).await.state, JobState::Succeeded);
    assert_eq!(server.client.batch(&batch.id).await.unwrap().done, 600);
    server.stop().await;
}
