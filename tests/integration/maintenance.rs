//! Maintenance of a data folder: orphans, old answers, disk space, and how damage is found and
//! repaired.

use crate::test_scans::Scan;
use crate::test_server::{
    Process, TestServer, ask, blobs_config, database_location, expect_problem, open_database,
    open_database_unchecked, storage_env, upload_and_parse, wait_for_job,
};
use camino::{Utf8Path, Utf8PathBuf};
use sqlx::Connection;
use std::fs;
use std::process::{Command, Output};
use uniground::config::{LimitsConfig, ModelsConfig, RetentionConfig, VlmConfig};
use uniground_service::{Dependencies, Services};
use uniground_storage::{JobState, Location, Store};
use uniground_types::corrections::Change;

fn run_doctor(data: &Utf8Path, more: &[&str]) -> Output {
    let program = Command::new(env!("CARGO_BIN_EXE_uniground"))
        .args(["doctor", "--data-dir", data.as_str()])
        .args(more)
        .envs(storage_env(data))
        .output();
    program.unwrap()
}

fn output_text(output: &Output) -> String {
    format!(
        "{}{}",
        String::from_utf8_lossy(&output.stdout),
        String::from_utf8_lossy(&output.stderr)
    )
}

fn only_entry(folder: &Utf8Path) -> Utf8PathBuf {
    folder.read_dir_utf8().unwrap().next().unwrap().unwrap().into_path()
}

/// An orphan folder is moved to quarantine, not deleted. One that is older than the database is
/// left alone.
#[tokio::test]
async fn orphan_folders_are_quarantined() {
    let server = TestServer::start().await;
    let scene = server.upload_and_parse(Scan::neutral().zip()).await;
    let data = server.stop_and_keep_data().await;
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
    assert!(
        !server.list_folder("blobs/parses").contains(&"stranger".to_owned()),
        "the orphan is still in blobs/parses"
    );
    let day = only_entry(&server.data().join("quarantine"));
    assert_eq!(fs::read_to_string(day.join("parses/stranger/cloud.ply")).unwrap(), "points");

    // A restored or copied database does not know folders that are older than itself.
    let data = server.stop_and_keep_data().await;
    let folder = Utf8Path::from_path(data.path()).unwrap();
    fs::create_dir(folder.join("blobs/parses/another")).unwrap();
    let mut rows = open_database(folder).await;
    sqlx::query("UPDATE data_folder SET id = 'elsewhere'").execute(&mut rows).await.unwrap();
    rows.close().await.unwrap();
    // A database may have been given with the wrong folder, so nothing is collected.
    if let Location::Postgres(_) = database_location(folder) {
        let refused = run_doctor(folder, &[]);
        assert!(
            !refused.status.success() && output_text(&refused).contains("do not belong together"),
            "{}",
            output_text(&refused)
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
    assert!(
        server.list_folder("blobs/parses").contains(&"another".to_owned()),
        "the older folder was removed"
    );
    assert_eq!(server.client.scene(&scene.id).await.unwrap().id, scene.id);
    server.stop().await;
}

#[tokio::test]
async fn the_doctor_finds_damage_and_the_next_start_repairs_it() {
    let data = tempfile::tempdir().unwrap();
    let data = Utf8Path::from_path(data.path()).unwrap();
    let server = Process::start(data);
    let scene = upload_and_parse(&server.client, "application/zip", Scan::neutral().zip()).await;
    // Corrections of a parse apply to the parse that replaces it.
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
    let refused = run_doctor(data, &[]);
    assert!(
        !refused.status.success() && output_text(&refused).contains("another server"),
        "{}",
        output_text(&refused)
    );
    assert_eq!(server.terminate(), Some(0));
    let well = run_doctor(data, &[]);
    assert!(
        well.status.success() && output_text(&well).contains("no problems found"),
        "{}",
        output_text(&well)
    );

    fs::write(only_entry(&data.join("blobs/parses")).join("cloud.ply"), "ply").unwrap();
    fs::create_dir(data.join("blobs/answers/stranger")).unwrap();
    let ill = run_doctor(data, &[]);
    assert!(!ill.status.success(), "{}", output_text(&ill));
    assert!(
        output_text(&ill).contains("cloud.ply damaged")
            && output_text(&ill).contains("blobs/answers/stranger"),
        "{}",
        output_text(&ill)
    );
    let repaired = run_doctor(data, &["--repair"]);
    assert!(
        repaired.status.success()
            && output_text(&repaired).contains("repaired: 2; 1 parses will run"),
        "{}",
        output_text(&repaired)
    );

    let server = Process::start(data);
    let job = server.client.scene(&scene.id).await.unwrap().job_id.unwrap();
    assert_eq!(wait_for_job(&server.client, &job).await.state, JobState::Succeeded);
    let again = server.client.scene(&scene.id).await.unwrap();
    assert_eq!((again.parse_version, again.counts), (2, scene.counts));
    let answer = server.client.ground(&scene.id, &ask("the corner sofa")).await.unwrap();
    assert_eq!((answer.answer.predicted_id, answer.parse_version), (made, 2));
    assert_eq!(server.terminate(), Some(0));
    assert!(run_doctor(data, &[]).status.success());

    // A scan cannot be recomputed: an operator has to restore it.
    let content = only_entry(&data.join("blobs/contents"));
    fs::remove_file(content.join("pose/3.txt")).unwrap();
    let left = run_doctor(data, &["--repair"]);
    assert!(
        !left.status.success() && output_text(&left).contains("upload the scan again"),
        "{}",
        output_text(&left)
    );
}

#[tokio::test]
async fn old_answers_are_removed_and_new_ones_stay() {
    let server = TestServer::start().await;
    let scene = server.upload_and_parse(Scan::neutral().zip()).await;
    let answer = server.client.ground(&scene.id, &ask("the red sofa")).await.unwrap();
    let data = server.stop_and_keep_data().await;
    let folder = Utf8Path::from_path(data.path()).unwrap();
    let mut rows = open_database(folder).await;
    // Dated January 2020, by id and time.
    let sql = "INSERT INTO answers (id, scene_id, parse_id, body, created_at)
               SELECT '016f5e66-e800-7000-8000-00000000000' || value, scene_id, parse_id, body, '2020-01-01T00:00:00Z' FROM answers, (SELECT '1' AS value UNION ALL SELECT '2' UNION ALL SELECT '3') AS few";
    sqlx::query(sql).execute(&mut rows).await.unwrap();
    let store =
        Store::open(folder, &database_location(folder), &blobs_config(folder).blob_home().unwrap())
            .await
            .unwrap();
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

/// A scan that needs too much memory fails its job and does not bring down the server.
#[tokio::test]
async fn a_parse_over_the_memory_limit_is_refused() {
    let limits = LimitsConfig { max_memory_bytes: Some(1 << 20), ..LimitsConfig::default() };
    let server = TestServer::start_with(limits).await;
    let client = &server.client;
    let job = client
        .create_scene(None, "application/zip", Scan::neutral().zip())
        .await
        .unwrap()
        .job
        .unwrap();
    let job = wait_for_job(client, &job.id).await;
    // The job runs twice, because other jobs may have freed memory in between.
    assert_eq!((job.state, job.attempts), (JobState::Failed, 2));
    let error = job.error.unwrap();
    assert_eq!(error.code, "memory_short");
    assert!(error.detail.contains("of its 1 MB"), "{}", error.detail);
    server.stop().await;
}

/// Below the reserve of free disk space new scans are refused, and existing scenes still answer.
#[tokio::test]
async fn a_nearly_full_disk_refuses_new_scans() {
    let server = TestServer::start().await;
    let scene = server.upload_and_parse(Scan::neutral().zip()).await;
    let data = server.stop_and_keep_data().await;
    let limits = LimitsConfig { keep_free_bytes: 1 << 60, ..LimitsConfig::default() };
    let server =
        TestServer::start_on(data, limits, VlmConfig::default(), ModelsConfig::builtin()).await;
    let refused = expect_problem(
        server.client.create_scene(None, "application/zip", Scan::neutral().zip()).await,
    );
    assert_eq!((refused.status, refused.code.as_str()), (507, "storage_full"));
    let parse =
        serde_json::json!({"settings": {"parsing": {"merging": {"keep_planes_apart": false}}}});
    assert_eq!(expect_problem(server.client.parse(&scene.id, &parse).await).code, "storage_full");
    assert!(server.client.ground(&scene.id, &ask("the red sofa")).await.unwrap().stored);
    server.stop().await;
}

/// A batch pauses when its answers would fill the disk, and continues once there is space.
#[tokio::test]
async fn a_batch_waits_for_disk_space() {
    let server = TestServer::start().await;
    let scene = server.upload_and_parse(Scan::neutral().zip()).await.id;
    let line = format!("{}\n", serde_json::json!({"scene_id": scene, "query": "the red sofa"}));
    let batch = server
        .client
        .create_batch_of_lines(line.repeat(600), &[("concurrency", "1".to_owned())], None)
        .await
        .unwrap();
    let paused = server.client.control_batch(&batch.id, "pause").await.unwrap();
    wait_for_job(&server.client, paused.job_id.as_deref().unwrap()).await;
    let before = server.client.batch(&batch.id).await.unwrap().done;
    assert!(before < 600, "{before} items were answered before the disk check");
    let data = server.stop_and_keep_data().await;
    let limits = LimitsConfig { keep_free_bytes: 1 << 60, ..LimitsConfig::default() };
    let server =
        TestServer::start_on(data, limits, VlmConfig::default(), ModelsConfig::builtin()).await;
    let job = server.client.control_batch(&batch.id, "resume").await.unwrap().job_id.unwrap();
    while server.client.job(&job).await.unwrap().attempts < 2 {
        tokio::time::sleep(std::time::Duration::from_millis(50)).await;
    }
    assert_eq!(server.client.batch(&batch.id).await.unwrap().done, before);
    let refused = expect_problem(server.client.create_batch_of_lines(line, &[], None).await);
    assert_eq!((refused.status, refused.code.as_str()), (507, "storage_full"));
    let data = server.stop_and_keep_data().await;
    let server = TestServer::start_on(
        data,
        LimitsConfig::default(),
        VlmConfig::default(),
        ModelsConfig::builtin(),
    )
    .await;
    assert_eq!(wait_for_job(&server.client, &job).await.state, JobState::Succeeded);
    assert_eq!(server.client.batch(&batch.id).await.unwrap().done, 600);
    server.stop().await;
}

#[tokio::test]
async fn the_doctor_finds_and_repairs_dangling_references() {
    let server = TestServer::start().await;
    let scene = server.upload_and_parse(Scan::neutral().zip()).await;
    let data = server.stop_and_keep_data().await;
    let folder = Utf8Path::from_path(data.path()).unwrap();
    if matches!(database_location(folder), Location::Postgres(_)) {
        println!("skipped: PostgreSQL enforces its own references");
        return;
    }
    let mut rows = open_database_unchecked(folder).await;
    let sql =
        "INSERT INTO corrections (id, parse_id, change, author, created_at) VALUES ('c', 'nowhere', '{}', NULL, '2026-01-01T00:00:00Z');
               UPDATE scenes SET parse_id = 'nowhere'";
    sqlx::raw_sql(sql).execute(&mut rows).await.unwrap();
    rows.close().await.unwrap();

    let found = run_doctor(folder, &[]);
    assert!(!found.status.success(), "{}", output_text(&found));
    let told = output_text(&found);
    assert!(
        told.contains("1 rows of scenes refer by parse_id to rows of parses that do not exist"),
        "{told}"
    );
    assert!(told.contains("1 rows of corrections refer by parse_id"), "{told}");
    let repaired = run_doctor(folder, &["--repair"]);
    assert!(repaired.status.success(), "{}", output_text(&repaired));
    assert!(run_doctor(folder, &[]).status.success());

    // The scene has its parse again: the stored one, or a new one.
    let server = Process::start(folder);
    let job = server.client.scene(&scene.id).await.unwrap().job_id.unwrap();
    assert_eq!(wait_for_job(&server.client, &job).await.state, JobState::Succeeded);
    server.client.ground(&scene.id, &ask("the red sofa")).await.unwrap();
    assert_eq!(server.terminate(), Some(0));
}
