//! Retention periods, and `uniground gc`.

use crate::test_scans::Scan;
use crate::test_server::{TestServer, ask, open_database_unchecked, storage_env, wait_for_job};
use camino::{Utf8Path, Utf8PathBuf};
use serde_json::Value;
use sqlx::{AnyConnection, AssertSqlSafe, Connection};
use std::collections::BTreeMap;
use std::fs::{self, File};
use std::process::{Command, Output};
use std::time::{Duration, SystemTime};
use uniground::config::{LimitsConfig, ModelsConfig, VlmConfig};
use uniground_types::batch::{BatchRequest, BatchState};

/// The prefix of ids from January 2020.
const OLD: &str = "016f5e66-e800-7000-8000-00000000000";
const LONG_AGO: &str = "2020-01-01T00:00:00Z";

async fn execute_sql(rows: &mut AnyConnection, sql: impl Into<String>) {
    let sql = sql.into();
    sqlx::raw_sql(AssertSqlSafe(sql.clone()))
        .execute(rows)
        .await
        .unwrap_or_else(|error| panic!("{sql}: {error}"));
}

async fn query_ids(rows: &mut AnyConnection, sql: &'static str) -> Vec<String> {
    sqlx::query_scalar(sql).fetch_all(rows).await.unwrap()
}

fn run_gc(data: &Utf8Path, more: &[&str]) -> Output {
    let mut command = Command::new(env!("CARGO_BIN_EXE_uniground"));
    command
        .args(["gc", "--data-dir", data.as_str()])
        .envs(storage_env(data))
        .args(more)
        .output()
        .unwrap()
}

/// Returns what was removed, by kind: entries and bytes.
fn removed_by_kind(output: &Output) -> BTreeMap<String, (u64, u64)> {
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let told: Value = serde_json::from_slice(&output.stdout).unwrap();
    let of = |one: &Value| {
        (
            one["kind"].as_str().unwrap().to_owned(),
            (one["entries"].as_u64().unwrap(), one["bytes"].as_u64().unwrap()),
        )
    };
    told["removed"].as_array().unwrap().iter().map(of).collect()
}

/// Returns every file below a folder with its content, and the modification times of files and
/// folders.
fn read_all_files(folder: &Utf8Path) -> BTreeMap<Utf8PathBuf, (SystemTime, Vec<u8>)> {
    let (mut found, mut left) = (BTreeMap::new(), vec![folder.to_owned()]);
    while let Some(path) = left.pop() {
        let entry = fs::metadata(&path).unwrap();
        let content = if entry.is_dir() {
            left.extend(path.read_dir_utf8().unwrap().map(|entry| entry.unwrap().into_path()));
            Vec::new()
        } else {
            fs::read(&path).unwrap()
        };
        found.insert(path, (entry.modified().unwrap(), content));
    }
    found
}

fn set_age(folder: &Utf8Path, days: u64) {
    let then = SystemTime::now() - Duration::from_hours(24 * days);
    for path in read_all_files(folder).into_keys() {
        File::open(path).unwrap().set_modified(then).unwrap();
    }
}

/// Returns a folder with an old and a new object of every kind, and the ids of the scene, its
/// answer, and the paused batch.
async fn populated_folder() -> (tempfile::TempDir, String, String, String) {
    let server = TestServer::start().await;
    let client = &server.client;
    let created = client
        .create_scene_once(&[("name", "room")], "application/zip", Scan::neutral().zip(), "new key")
        .await
        .unwrap();
    assert_eq!(wait_for_job(client, &created.job.unwrap().id).await.error, None);
    let scene = created.scene.id;
    for preset in ["paper", "default", "paper"] {
        let again = client.parse(&scene, &serde_json::json!({"preset": preset})).await.unwrap();
        assert_eq!(wait_for_job(client, &again.id).await.error, None);
    }
    let answer = client.ground(&scene, &ask("the red sofa")).await.unwrap().id;
    let request =
        serde_json::json!({"items": [{"query": "the red sofa"}], "defaults": {"scene_id": scene}});
    let request: BatchRequest = serde_json::from_value(request).unwrap();
    let mut batches = Vec::new();
    for _ in 0..3 {
        let batch = client.create_batch(&request, None).await.unwrap();
        while client.batch(&batch.id).await.unwrap().state == BatchState::Running {
            tokio::time::sleep(Duration::from_millis(20)).await;
        }
        batches.push(batch.id);
    }
    let data = server.stop_and_keep_data().await;
    let folder = Utf8Path::from_path(data.path()).unwrap();
    let mut rows = open_database_unchecked(folder).await;
    execute_sql(
        &mut rows,
        format!(
            "INSERT INTO answers (id, scene_id, parse_id, body, created_at)
             SELECT '{OLD}' || value, scene_id, parse_id, body, '{LONG_AGO}' FROM answers, (SELECT '1' AS value UNION ALL SELECT '2' UNION ALL SELECT '3') AS few WHERE answers.id = '{answer}';
             -- Asked long after it got its id: its batch was paused.
             INSERT INTO answers (id, scene_id, parse_id, body, created_at)
             SELECT '{OLD}4', scene_id, parse_id, body, created_at FROM answers WHERE id = '{answer}';
             -- A job nobody refers to, one that is not over, the scene's own.
             INSERT INTO jobs (id, kind, subject, payload, state, created_at, finished_at)
             VALUES ('{OLD}5', 'naming', 's', '{{}}', 'failed', '{LONG_AGO}', '{LONG_AGO}'), ('{OLD}6', 'naming', 's', '{{}}', 'queued', '{LONG_AGO}', NULL);
             UPDATE jobs SET id = '{OLD}7', finished_at = '{LONG_AGO}' WHERE id = (SELECT job_id FROM scenes);
             UPDATE scenes SET job_id = '{OLD}7';
             -- Two old batches, one of which is not over, with their jobs.
             UPDATE batches SET id = '{OLD}8', job_id = '{OLD}8', finished_at = '{LONG_AGO}' WHERE id = '{done}';
             UPDATE batches SET id = '{OLD}9', job_id = '{OLD}9', state = 'paused', finished_at = NULL WHERE id = '{paused}';
             UPDATE batch_items SET batch_id = '{OLD}8' WHERE batch_id = '{done}';
             UPDATE batch_items SET batch_id = '{OLD}9' WHERE batch_id = '{paused}';
             UPDATE jobs SET id = '{OLD}8', finished_at = '{LONG_AGO}' WHERE subject = '{done}';
             UPDATE jobs SET id = '{OLD}9', finished_at = '{LONG_AGO}' WHERE subject = '{paused}';
             INSERT INTO idempotency_keys (key, scene_id, created_at) SELECT 'old key', id, '{LONG_AGO}' FROM scenes;
             INSERT INTO question_keys VALUES ('old key', 'asked', '{OLD}1', '{LONG_AGO}'), ('new key', 'asked', '{OLD}4', '2999-01-01T00:00:00Z');
             INSERT INTO audit (id, at, method, path, status) VALUES ('{OLD}1', '{LONG_AGO}', 'POST', '/v1/scenes', 202);
             -- Uploads in parts: nobody goes on with one, somebody just did with another.
             INSERT INTO uploads (id, wanted, length, received, created_at, updated_at)
             VALUES ('{OLD}1', '{{}}', 9, 4, '{LONG_AGO}', '{LONG_AGO}'), ('{OLD}2', '{{}}', 9, 4, '{LONG_AGO}', '2999-01-01T00:00:00Z');
             -- What a scene was made of before it grew.
             INSERT INTO contents (hash, bytes, created_at) VALUES ('outgrown', 9, '{LONG_AGO}');
             UPDATE parses SET superseded_at = '{LONG_AGO}';
             UPDATE parses SET created_at = '{LONG_AGO}';",
            done = batches[0],
            paused = batches[1],
        ),
    )
    .await;
    rows.close().await.unwrap();
    // Evidence of a new answer, of an old answer, and evidence past its retention period.
    for (id, days) in [(answer.as_str(), 1), (&format!("{OLD}1"), 1), (&format!("{OLD}4"), 40)] {
        fs::create_dir(folder.join("blobs/answers").join(id)).unwrap();
        fs::write(folder.join("blobs/answers").join(id).join("prompt.json"), "{}").unwrap();
        set_age(&folder.join("blobs/answers").join(id), days);
    }
    for id in [format!("{OLD}1"), format!("{OLD}2")] {
        fs::write(folder.join("uploads").join(id), "PK..").unwrap();
    }
    fs::create_dir(folder.join("blobs/contents/outgrown")).unwrap();
    fs::write(folder.join("blobs/contents/outgrown/grown.json"), "{}").unwrap();
    set_age(&folder.join("blobs/checkpoints"), 20);
    for day in ["2020-01-01", "2999-01-01"] {
        fs::create_dir_all(folder.join("quarantine").join(day).join("parses/x")).unwrap();
        fs::write(folder.join("quarantine").join(day).join("parses/x/cloud.ply"), "points")
            .unwrap();
    }
    (data, scene, answer, format!("{OLD}9"))
}

#[tokio::test(flavor = "multi_thread")]
async fn only_expired_data_is_removed() {
    let (data, scene, answer, paused) = Box::pin(populated_folder()).await;
    let folder = Utf8Path::from_path(data.path()).unwrap();
    let before = read_all_files(folder);
    let announced = removed_by_kind(&run_gc(folder, &["--dry-run", "--json"]));
    assert_eq!(read_all_files(folder), before, "a dry run writes nothing");
    let kept_for_ever = [
        "answers",
        "jobs",
        "batches",
        "idempotency",
        "audit",
        "superseded",
        "checkpoints",
        "uploads",
    ]
    .map(|kind| format!("--keep-{kind}-days=0"));
    let kept_for_ever: Vec<&str> = ["--dry-run", "--json"]
        .into_iter()
        .chain(kept_for_ever.iter().map(String::as_str))
        .collect();
    let little: Vec<String> = removed_by_kind(&run_gc(folder, &kept_for_ever))
        .into_iter()
        .filter(|(_, gone)| gone.0 > 0)
        .map(|(kind, _)| kind)
        .collect();
    assert_eq!(little, ["evidence", "quarantine"]);

    let gone = removed_by_kind(&run_gc(folder, &["--json"]));
    assert_eq!(gone, announced);
    let entries: Vec<(&str, u64)> =
        gone.iter().map(|(kind, (entries, _))| (kind.as_str(), *entries)).collect();
    let expected = [
        ("answers", 3),
        ("audit", 1),
        ("batches", 1),
        ("checkpoints", 1),
        ("evidence", 1),
        ("idempotency keys", 1),
        ("idempotency keys of questions", 1),
        // The old one and the batch's.
        ("jobs", 2),
        ("outgrown scans", 1),
        ("quarantine", 1),
        ("superseded parses", 1),
        ("uploads in parts", 1),
    ];
    assert_eq!(entries, expected);
    assert!(gone.values().all(|(_, bytes)| *bytes > 0), "{gone:?}");

    let mut rows = open_database_unchecked(folder).await;
    let jobs = query_ids(&mut rows, "SELECT id FROM jobs WHERE id < '018' ORDER BY id").await;
    assert_eq!(jobs, ["6", "7", "9"].map(|end| format!("{OLD}{end}")));
    assert!(query_ids(&mut rows, "SELECT id FROM answers").await.contains(&answer));
    assert_eq!(
        query_ids(&mut rows, "SELECT id FROM answers WHERE id < '018'").await,
        [format!("{OLD}4")]
    );
    assert_eq!(query_ids(&mut rows, "SELECT id FROM batches ORDER BY id").await.len(), 2);
    assert_eq!(query_ids(&mut rows, "SELECT key FROM idempotency_keys").await, ["new key"]);
    assert_eq!(query_ids(&mut rows, "SELECT key FROM question_keys").await, ["new key"]);
    assert_eq!(
        query_ids(&mut rows, "SELECT id FROM parses WHERE superseded_at IS NULL").await.len(),
        1,
        "the parse in use"
    );
    assert_eq!(
        query_ids(&mut rows, "SELECT DISTINCT batch_id FROM batch_items ORDER BY 1").await.len(),
        2
    );
    execute_sql(&mut rows, format!("DELETE FROM jobs WHERE id = '{OLD}6'")).await;
    rows.close().await.unwrap();
    let names = |below: &str| {
        folder
            .join(below)
            .read_dir_utf8()
            .unwrap()
            .map(|entry| entry.unwrap().file_name().to_owned())
            .collect::<Vec<_>>()
    };
    assert_eq!((names("blobs/parses").len(), names("uploads")), (1, vec![format!("{OLD}2")]));
    assert_eq!(names("blobs/answers"), std::slice::from_ref(&answer));
    assert_eq!(
        (names("blobs/checkpoints").len(), names("quarantine")),
        (0, vec!["2999-01-01".to_owned()])
    );
    assert!(
        removed_by_kind(&run_gc(folder, &["--json"])).values().all(|gone| gone.0 == 0),
        "a second run must remove nothing"
    );

    let server = TestServer::start_on(
        data,
        LimitsConfig::default(),
        VlmConfig::default(),
        ModelsConfig::builtin(),
    )
    .await;
    assert_eq!(server.client.answer(&answer).await.unwrap().scene_id, scene);
    assert_eq!(server.client.scene(&scene).await.unwrap().job_id, Some(format!("{OLD}7")));
    assert_eq!(server.client.batch(&paused).await.unwrap().state, BatchState::Paused);
    // Removed data is computed again on request.
    let again =
        server.client.parse(&scene, &serde_json::json!({"preset": "default"})).await.unwrap();
    assert_eq!(wait_for_job(&server.client, &again.id).await.error, None);
    assert_eq!(server.list_folder("blobs/parses").len(), 2);
    assert_eq!(server.list_folder("blobs/checkpoints").len(), 1);
    server.stop().await;
}

/// A parse stays while an answer refers to it, while it was superseded only recently, or after a
/// scene uses it again.
#[tokio::test(flavor = "multi_thread")]
async fn a_referenced_parse_is_not_removed() {
    let server = TestServer::start().await;
    let scene = server.upload_and_parse(Scan::neutral().zip()).await.id;
    let answer = server.client.ground(&scene, &ask("the red sofa")).await.unwrap().id;
    let again = server.client.parse(&scene, &serde_json::json!({"preset": "paper"})).await.unwrap();
    assert_eq!(wait_for_job(&server.client, &again.id).await.error, None);
    let data = server.stop_and_keep_data().await;
    let folder = Utf8Path::from_path(data.path()).unwrap();
    let parses = || folder.join("blobs/parses").read_dir_utf8().unwrap().count();
    let mut rows = open_database_unchecked(folder).await;
    execute_sql(
        &mut rows,
        format!("UPDATE parses SET created_at = '{LONG_AGO}', superseded_at = '{LONG_AGO}'"),
    )
    .await;
    assert_eq!(
        removed_by_kind(&run_gc(folder, &["--json"]))["superseded parses"].0,
        0,
        "an answer refers to the parse"
    );
    execute_sql(&mut rows, format!("DELETE FROM answers WHERE id = '{answer}'")).await;
    assert_eq!(
        removed_by_kind(&run_gc(folder, &["--json"]))["superseded parses"].0,
        0,
        "the parse was superseded only now"
    );
    assert_eq!(
        (
            parses(),
            query_ids(&mut rows, "SELECT id FROM parses WHERE superseded_at IS NOT NULL")
                .await
                .len()
        ),
        (2, 1)
    );
    execute_sql(
        &mut rows,
        format!("UPDATE parses SET superseded_at = '{LONG_AGO}' WHERE superseded_at IS NOT NULL"),
    )
    .await;
    assert_eq!(
        (removed_by_kind(&run_gc(folder, &["--json"]))["superseded parses"].0, parses()),
        (1, 1)
    );
    rows.close().await.unwrap();
}

/// `gc` refuses the folder of a running server and a folder that does not exist.
#[tokio::test(flavor = "multi_thread")]
async fn gc_requires_the_folder_of_a_stopped_server() {
    let server = TestServer::start().await;
    for more in [&["--dry-run"][..], &[]] {
        let refused = run_gc(server.data(), more);
        assert!(
            !refused.status.success()
                && String::from_utf8_lossy(&refused.stderr).contains("another server"),
            "{refused:?}"
        );
        let nothing = server.data().join("nothing");
        let refused = run_gc(&nothing, more);
        assert!(
            !refused.status.success()
                && String::from_utf8_lossy(&refused.stderr).contains("not a uniground data folder"),
            "{refused:?}"
        );
        assert!(!nothing.exists(), "gc created {nothing}");
    }
    server.stop().await;
}
