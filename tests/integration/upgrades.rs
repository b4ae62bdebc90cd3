//! Data folders of earlier versions, opened by this one. `scripts/data-fixture.sh` makes them.

use crate::test_server::{TestServer, ask};
use camino::Utf8Path;
use serde_json::Value;
use sqlx::migrate::{Migration, MigrationType, Migrator};
use sqlx::sqlite::{SqliteConnectOptions, SqliteConnection};
use sqlx::{AssertSqlSafe, Connection, SqlSafeStr};
use std::fs;
use std::process::Command;
use uniground::config::{LimitsConfig, ModelsConfig, VlmConfig};
use uniground_client::Client;
use uniground_storage::{BlobHome, Location, Store};
use uniground_types::answer::{Answer, SixFields, Status};
use uniground_types::batch::{BatchResult, BatchState};
use uniground_types::geometry::up_axis::UpAxis;
use uniground_types::job::JobState;
use uniground_types::scenes::{Scene, SceneStatus};

/// A data folder of an earlier version, and what its server returned: `scene.json`,
/// `instances.json`, `answers.jsonl`, `scan.zip`.
struct OldFolder {
    data: tempfile::TempDir,
    told: tempfile::TempDir,
}

impl OldFolder {
    fn unpack(name: &str) -> Self {
        let file = fs::File::open(
            Utf8Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/fixtures").join(name),
        )
        .unwrap();
        let told = tempfile::tempdir().unwrap();
        tar::Archive::new(zstd::Decoder::new(file).unwrap()).unpack(told.path()).unwrap();
        let data = tempfile::tempdir().unwrap();
        fs::remove_dir(data.path()).unwrap();
        fs::rename(told.path().join("data"), data.path()).unwrap();
        Self { data, told }
    }

    fn told(&self, file: &str) -> Vec<u8> {
        fs::read(self.told.path().join(file)).unwrap()
    }
}

#[tokio::test]
async fn a_folder_without_record_versions_is_served_completely() {
    let left = OldFolder::unpack("data-2026-11-20.tar.zst");
    let (scene_told, scan): (Value, Vec<u8>) =
        (serde_json::from_slice(&left.told("scene.json")).unwrap(), left.told("scan.zip"));
    let mut instances_told: Value = serde_json::from_slice(&left.told("instances.json")).unwrap();
    for instance in instances_told["instances"].as_array_mut().unwrap() {
        instance["level"] = "thing".into();
        instance["things"] = Value::Array(Vec::new());
        // That version had no corrections.
        (instance["given_name"], instance["dismissed"], instance["merged_from"]) =
            (Value::Null, false.into(), Value::Array(Vec::new()));
        // That version had no added frames.
        instance["gone"] = false.into();
        // That version did not read the times of frames.
        instance["last_seen"] = Value::Null;
    }
    let answers_told = String::from_utf8(left.told("answers.jsonl")).unwrap();
    let OldFolder { data, told: _told } = left;
    let server = TestServer::start_on(
        data,
        LimitsConfig::default(),
        VlmConfig::default(),
        ModelsConfig::builtin(),
    )
    .await;
    let get = async |path: &str| server.client.bytes(path).await.unwrap();

    let scenes = server.client.scenes(10, None).await.unwrap().scenes;
    let [scene]: [Scene; 1] = scenes.try_into().unwrap();
    assert_eq!(
        (scene.name.as_str(), scene.status, scene.parse_version),
        ("A block", SceneStatus::Ready, 1)
    );
    // Every setting of that time, under today's names.
    let mut expected = scene_told.clone();
    uniground_types::settings::rename_deprecated_settings(&mut expected["settings"]);
    // That version did not have these stages.
    expected["settings"]["parsing"]["merging"]["keep_planes_apart"] = false.into();
    expected["settings"]["parsing"]["merging"]["split_at_depth_edges"] = false.into();
    expected["settings"]["parsing"]["refine_borders"] = false.into();
    expected["settings"]["parsing"]["sam_masks"]["prompts"] = "grid".into();
    expected["settings"]["parsing"]["sam_masks"]["wholes"] = false.into();
    expected["settings"]["parsing"]["correction"]["known_agreement"] = Value::Null;
    expected["settings"]["parsing"]["appearance"]["frames"] = 0.into();
    expected["settings"]["parsing"]["instances"]["min_agreement"] = 0.0.into();
    expected["settings"]["parsing"]["instances"]["min_points"] = 0.into();
    expected["settings"]["parsing"]["instances"]["parts_and_wholes"] = 0.0.into();
    expected["settings"]["parsing"]["frame_sampling"]["views_per_part"] = Value::Null;
    expected["quality"] = "full".into();
    expected["scene_to_map"] = Value::Null;
    expected["map_frame_id"] = Value::Null;
    expected["labels"] = serde_json::json!({});
    expected["import"]["levelling"] = Value::Null;
    expected["import"]["findings"] = serde_json::json!([]);
    expected["import"]["source_to_scene"] = Value::Null;
    expected["import"]["viewing_distance_m"] = Value::Null;
    expected["report"]["dropped"] = 0.into();
    expected["report"]["specks"] = 0.into();
    expected["report"]["parts_and_wholes"] = 0.into();
    expected["settings"]["import"]["fusion"]["truncation_voxels"] = 5.0.into();
    let path = format!("v1/scenes/{}", scene.id);
    assert_eq!(serde_json::from_slice::<Value>(&get(&path).await).unwrap(), expected);
    assert_eq!(
        serde_json::from_slice::<Value>(&get(&format!("{path}/instances")).await).unwrap(),
        instances_told
    );
    for answer in answers_told.lines() {
        let told: Answer = serde_json::from_str(answer).unwrap();
        let stored = get(&format!("v1/answers/{}", told.id)).await;
        assert_eq!(String::from_utf8(stored).unwrap(), answer, "a stored answer has changed");
        let picture = get(&format!("v1/answers/{}/evidence/global.jpg", told.id)).await;
        image::load_from_memory(&picture).unwrap();
        // The same question gets the same answer, except for ids, times, versions and fields that
        // are new.
        let again = server.client.ground(&scene.id, &ask(&told.query)).await.unwrap();
        let (id, timings_ms, evidence, models) =
            (told.id.clone(), told.timings_ms, told.evidence.clone(), told.models.clone());
        if told.status == Status::NoMatch {
            // That version denied objects by guessed names.
            assert_eq!(again.status, Status::Uncertain, "{}", told.query);
            continue;
        }
        assert_eq!(again.targets.first().map(|target| target.id), told.answer.predicted_id);
        assert_eq!(again.no_match_reason, None);
        let ranks = |answer: &Answer| {
            answer.candidates.iter().flatten().map(|c| (c.rank, c.id)).collect::<Vec<_>>()
        };
        assert_eq!(ranks(&again), ranks(&told));
        // Confidence, the status that follows from it, and the note on guessed names depend on the
        // version.
        let (status, confidence, candidates) =
            (told.status, told.confidence, told.candidates.clone());
        let explanation = told.answer.explanation.clone();
        assert!(again.answer.explanation.starts_with(&explanation), "{again:?}");
        let again = Answer {
            id,
            timings_ms,
            evidence,
            models,
            status,
            answer: SixFields { explanation, ..again.answer },
            confidence,
            candidates,
            targets: Vec::new(),
            no_match_reason: None,
            text: told.text.clone(),
            ..again
        };
        assert_eq!(again, told);
    }
    for file in [
        "cloud.ply",
        "instances.ply",
        "report",
        "report/superpoints.jpg",
        "instances/1/views/0.jpg",
    ] {
        assert!(!get(&format!("{path}/{file}")).await.is_empty(), "{file}");
    }
    let job = server.client.job(scene.job_id.as_deref().unwrap()).await.unwrap();
    assert_eq!((job.kind.as_str(), job.error), ("parse", None));
    // The idempotency key is still known, the scan is stored, and the scene can be deleted.
    let created = server
        .client
        .create_scene_once(&[("name", "x")], "application/zip", scan, "block")
        .await
        .unwrap();
    assert_eq!(created.scene.id, scene.id);
    let reparse =
        server.client.parse(&scene.id, &serde_json::json!({"preset": "paper"})).await.unwrap();
    let reparse = server.client.follow_job(&reparse.id, |_| {}).await.unwrap();
    assert_eq!(reparse.error, None);
    let parsed = server.client.scene(&scene.id).await.unwrap();
    assert_eq!(
        (parsed.parse_version, parsed.settings.unwrap().import.up.map(UpAxis::name)),
        (2, Some("z"))
    );
    server.client.delete_scene(&scene.id).await.unwrap();
    assert_eq!(server.list_folder("blobs/contents"), Vec::<String>::new());
    server.stop().await;
}

/// Returns every schema: its version and the migration that makes it from the one before.
fn migrations() -> Vec<(i64, String)> {
    let folder = Utf8Path::new(env!("CARGO_MANIFEST_DIR")).join("migrations/sqlite");
    let files = folder.read_dir_utf8().unwrap().map(|file| file.unwrap().into_path());
    let mut migrations: Vec<_> = files
        .map(|file| {
            (file.file_name().unwrap()[..4].parse().unwrap(), fs::read_to_string(&file).unwrap())
        })
        .collect();
    migrations.sort();
    migrations
}

/// Rows for tables that are newer than the fixture, each with its table. Ids of the fixture replace
/// `SCENE`, `PARSE` and `ANSWER`. A migration that adds a table adds a row here.
const LATER_ROWS: &[(&str, &str)] = &[
    (
        "instance_names",
        "INSERT INTO instance_names VALUES ('PARSE', 'a-model', 1, 1, 'crate', '2026-11-20T00:00:00Z')",
    ),
    ("name_indexes", "INSERT INTO name_indexes VALUES ('PARSE', 'a-model', 1, '2026-11-20T00:00:00Z')"),
    (
        "corrections",
        "INSERT INTO corrections (id, parse_id, change, author, created_at)
         VALUES ('01a1ff70-0000-7000-8000-000000000004', 'PARSE', '{\"kind\": \"rename\", \"instance_id\": 1, \"name\": \"crate\"}', 'robot', '2026-11-20T00:00:00Z')",
    ),
    (
        "question_keys",
        "INSERT INTO question_keys VALUES ('a-key', 'a-request', 'ANSWER', '2026-11-20T00:00:00Z')",
    ),
    (
        "scene_changes",
        "INSERT INTO scene_changes VALUES ('SCENE', 'PARSE', 'an-older-one', 1, '{}', '2026-11-20T00:00:00Z')",
    ),
    (
        "uploads",
        "INSERT INTO uploads (id, wanted, length, created_at, updated_at)
         VALUES ('01a1ff70-0000-7000-8000-000000000005', '{}', 9, '2026-11-20T00:00:00Z', '2026-11-20T00:00:00Z')",
    ),
    ("spending", "INSERT INTO spending VALUES ('2026-11-20', 0.5)"),
    ("data_folder", "INSERT INTO data_folder VALUES ('a-folder', '2026-11-20T00:00:00Z')"),
    ("reservations", "INSERT INTO reservations (id, day, usd) VALUES ('r', '2026-11-20', 0.25)"),
    ("room_entries", "INSERT INTO room_entries VALUES ('PARSE', 'crate', 'red', 0.5)"),
    ("room_names", "INSERT INTO room_names VALUES ('crate')"),
    ("members", "INSERT INTO members (id, seen_at) VALUES ('a-process-that-is-gone', 0.0)"),
    (
        "batches",
        "INSERT INTO batches (id, label, state, items, created_at, finished_at)
         VALUES ('01a1ff70-0000-7000-8000-000000000001', 'monday', 'succeeded', 1, '2026-11-20T00:00:00Z', '2026-11-20T00:00:00Z')",
    ),
    (
        "batch_items",
        "INSERT INTO batch_items (batch_id, item, scene_id, request, answer_id, status)
         VALUES ('01a1ff70-0000-7000-8000-000000000001', 0, 'SCENE', '{\"query\": \"the red coffee table\"}', 'ANSWER', 'grounded')",
    ),
    (
        "keys",
        "INSERT INTO keys (id, name, prefix, hash, scope, created_at)
         VALUES ('01a1ff70-0000-7000-8000-000000000002', 'robot', 'ug_00000000', '0b9a43e17473bfcb7ebed0b3d5584b13996fe2366a7f9cae2529074faae466f8', 'admin', '2026-11-20T00:00:00Z')",
    ),
    ("key_spending", "INSERT INTO key_spending VALUES ('01a1ff70-0000-7000-8000-000000000002', '2026-11-20', 0.1)"),
    (
        "audit",
        "INSERT INTO audit (id, at, method, path, status)
         VALUES ('01a1ff70-0000-7000-8000-000000000003', '2026-11-20T00:00:00Z', 'POST', '/v1/scenes', 202)",
    ),
    ("announcements", "INSERT INTO announcements (job_id) SELECT id FROM jobs LIMIT 1"),
];
/// The secret of the key in these rows.
const SECRET: &str = "ug_00000000_upgrade";

async fn open(database: &Utf8Path) -> SqliteConnection {
    SqliteConnection::connect_with(
        &SqliteConnectOptions::new().filename(database).create_if_missing(true),
    )
    .await
    .unwrap()
}

async fn query_texts(rows: &mut SqliteConnection, sql: String) -> Vec<String> {
    sqlx::query_scalar(AssertSqlSafe(sql)).fetch_all(rows).await.unwrap()
}

async fn list_tables(rows: &mut SqliteConnection, of: &str) -> Vec<String> {
    let sql = format!(
        "SELECT name FROM {of}.sqlite_schema WHERE type = 'table' AND name NOT LIKE '!_%' ESCAPE '!' AND name NOT LIKE 'sqlite%'"
    );
    query_texts(rows, sql).await
}

/// Turns the fixture's database into one of another schema, with the fixture's rows and rows in
/// every newer table.
async fn rebuild_with_schema(data: &Utf8Path, schema: &[(i64, String)]) {
    let (old, new) = (data.join("uniground.sqlite"), data.join("new.sqlite"));
    let mut rows = open(&new).await;
    let made = schema.iter().map(|(version, sql)| {
        Migration::new(
            *version,
            "a step".into(),
            MigrationType::Simple,
            AssertSqlSafe(sql.clone()).into_sql_str(),
            false,
        )
    });
    Migrator::with_migrations(made.collect()).run(&mut rows).await.unwrap();
    for sql in ["PRAGMA foreign_keys = OFF".to_owned(), format!("ATTACH '{old}' AS old")] {
        sqlx::raw_sql(AssertSqlSafe(sql)).execute(&mut rows).await.unwrap();
    }
    for table in list_tables(&mut rows, "old").await {
        let shared = format!(
            "SELECT name FROM pragma_table_info('{table}', 'old') INTERSECT SELECT name FROM pragma_table_info('{table}', 'main')"
        );
        let columns = query_texts(&mut rows, shared).await.join(", ");
        if !columns.is_empty() {
            let copy =
                format!("INSERT INTO main.{table} ({columns}) SELECT {columns} FROM old.{table}");
            sqlx::raw_sql(AssertSqlSafe(copy)).execute(&mut rows).await.unwrap();
        }
    }
    let [scene, parse, answer] =
        ["SELECT id FROM scenes", "SELECT id FROM parses", "SELECT min(id) FROM answers"];
    let mut ids = Vec::new();
    for sql in [scene, parse, answer] {
        ids.push(query_texts(&mut rows, sql.to_owned()).await.remove(0));
    }
    for table in list_tables(&mut rows, "main").await {
        if let Some((_, sql)) = LATER_ROWS.iter().find(|(about, _)| *about == table) {
            let sql =
                sql.replace("SCENE", &ids[0]).replace("PARSE", &ids[1]).replace("ANSWER", &ids[2]);
            sqlx::raw_sql(AssertSqlSafe(sql)).execute(&mut rows).await.unwrap();
        }
        let filled = query_texts(&mut rows, format!("SELECT 'x' FROM {table} LIMIT 1")).await;
        assert!(!filled.is_empty(), "{table} has no rows: add one to LATER_ROWS");
    }
    rows.close().await.unwrap();
    for beside in ["-wal", "-shm"] {
        let _ = fs::remove_file(format!("{old}{beside}"));
    }
    fs::rename(&new, &old).unwrap();
}

/// Data of every earlier schema is served unchanged.
#[tokio::test(flavor = "multi_thread")]
async fn databases_of_every_schema_are_migrated_without_loss() {
    let migrations = migrations();
    for to in 1..=migrations.len() {
        let (schema, version) = (&migrations[..to], migrations[to - 1].0);
        let left = OldFolder::unpack("data-2026-11-20.tar.zst");
        let (answers, scan) =
            (String::from_utf8(left.told("answers.jsonl")).unwrap(), left.told("scan.zip"));
        let instances: Value = serde_json::from_slice(&left.told("instances.json")).unwrap();
        let OldFolder { data, told: _told } = left;
        let folder = Utf8Path::from_path(data.path()).unwrap();
        rebuild_with_schema(folder, schema).await;
        let server = TestServer::start_on(
            data,
            LimitsConfig::default(),
            VlmConfig::default(),
            ModelsConfig::builtin(),
        )
        .await;
        let client = &Client::new(&server.url(), Some(SECRET.into())).unwrap();
        let [scene]: [Scene; 1] = client.scenes(10, None).await.unwrap().scenes.try_into().unwrap();
        assert_eq!(
            (scene.name.as_str(), scene.status, scene.parse_version),
            ("A block", SceneStatus::Ready, 1),
            "schema {version}"
        );
        let found = client.instances(&scene.id, 1000).await.unwrap().instances.len();
        assert_eq!(found, instances["instances"].as_array().unwrap().len(), "schema {version}");
        for answer in answers.lines() {
            let told: Answer = serde_json::from_str(answer).unwrap();
            let stored = client.bytes(&format!("v1/answers/{}", told.id)).await.unwrap();
            assert_eq!(String::from_utf8(stored).unwrap(), answer, "schema {version}");
        }
        assert_eq!(
            client.job(scene.job_id.as_deref().unwrap()).await.unwrap().state,
            JobState::Succeeded
        );
        // Where API keys exist, each has its own idempotency keys.
        if version < 6 {
            let same = client
                .create_scene_once(&[("name", "x")], "application/zip", scan, "block")
                .await
                .unwrap();
            assert_eq!(same.scene.id, scene.id, "schema {version}: the idempotency key is unknown");
        }
        let batches = client.batches(10, None).await.unwrap().batches;
        assert_eq!(batches.len(), usize::from(version >= 5));
        for batch in batches {
            assert_eq!(
                (batch.state, batch.label.as_deref(), batch.done),
                (BatchState::Succeeded, Some("monday"), 1)
            );
            let mut answered: Vec<BatchResult> = Vec::new();
            let take = |_: &[u8], result| {
                answered.push(result);
                Ok::<(), uniground_client::ClientError>(())
            };
            client.batch_results(&batch.id, 0, false, take).await.unwrap();
            assert!(answered[0].answer.is_some(), "schema {version}");
        }
        let data = server.stop_and_keep_data().await;
        let folder = Utf8Path::from_path(data.path()).unwrap();
        let store = Store::open(folder, &Location::Folder, &BlobHome::Folder).await.unwrap();
        // Money reserved for calls that a killed server left open counts as spent.
        let spent = [(2, 0.5), (4, 0.25)]
            .into_iter()
            .filter(|(since, _)| version >= *since)
            .map(|(_, usd)| usd)
            .sum::<f64>();
        assert_eq!(
            store.spending.spending_on_day("2026-11-20").await.unwrap(),
            spent,
            "schema {version}"
        );
        let parse = &store.parses.all_parses().await.unwrap()[0].id;
        assert_eq!(
            store.names.instance_names(parse, "a-model", 1).await.unwrap().len(),
            usize::from(version >= 2)
        );
        store.close().await;
        drop(store);
        let doctor = Command::new(env!("CARGO_BIN_EXE_uniground"))
            .args(["doctor", "--data-dir", folder.as_str()])
            .output()
            .unwrap();
        assert!(
            doctor.status.success(),
            "schema {version}: {}",
            String::from_utf8_lossy(&doctor.stderr)
        );
    }
}
