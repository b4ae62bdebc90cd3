//! Backups of running and stopped servers, and restoring them.

use crate::test_scans::Scan;
use crate::test_server::{TestServer, ask, assert_contains, wait_for_job};
use camino::{Utf8Path, Utf8PathBuf};
use std::fs;
use std::process::{Command, Output};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use uniground::config::{LimitsConfig, ModelsConfig, VlmConfig};
use uniground_client::Client;
use uniground_storage::{BackupReport, BackupSource, BackupTarget, back_up, check, restore};

fn run_uniground(args: &[&str]) -> Output {
    Command::new(env!("CARGO_BIN_EXE_uniground"))
        .args(args)
        .env_remove("UNIGROUND_DATA_DIR")
        .output()
        .unwrap()
}

fn output_text(output: &Output) -> String {
    format!(
        "{}{}",
        String::from_utf8_lossy(&output.stdout),
        String::from_utf8_lossy(&output.stderr)
    )
}

/// Returns the same room with different bytes.
fn room_with_note(number: usize) -> Vec<u8> {
    Scan::neutral().with("note.txt", number.to_string()).zip()
}

struct TempFolders {
    _root: tempfile::TempDir,
    root: Utf8PathBuf,
}

impl TempFolders {
    fn new() -> Self {
        let root = tempfile::tempdir().unwrap();
        Self { root: Utf8PathBuf::try_from(root.path().to_owned()).unwrap(), _root: root }
    }

    fn at(&self, name: &str) -> Utf8PathBuf {
        self.root.join(name)
    }
}

async fn run_backup(data: &Utf8Path, to: &Utf8Path) -> BackupReport {
    let done = back_up(data, BackupTarget::from_path(to)).await.unwrap();
    assert_eq!(done.left_out, Vec::new());
    done
}

/// Starts a server on a restored backup.
async fn start_restored(from: &Utf8Path) -> TestServer {
    let data = tempfile::tempdir().unwrap();
    restore(BackupSource::from_path(from), Utf8Path::from_path(data.path()).unwrap())
        .await
        .unwrap();
    TestServer::start_on(
        data,
        LimitsConfig::default(),
        VlmConfig::default(),
        ModelsConfig::builtin(),
    )
    .await
}

/// Sends questions, uploads and deletions until `stop` is set.
async fn generate_load(client: Client, scene: String, stop: Arc<AtomicBool>) -> usize {
    let mut rounds = 0;
    while !stop.load(Ordering::Relaxed) {
        client.ground(&scene, &ask("the fridge")).await.unwrap();
        let created = client
            .create_scene(None, "application/zip", room_with_note(1000 + rounds))
            .await
            .unwrap();
        if rounds % 2 == 0 {
            assert_eq!(wait_for_job(&client, &created.job.unwrap().id).await.error, None);
        }
        client.delete_scene(&created.scene.id).await.unwrap();
        rounds += 1;
    }
    rounds
}

#[tokio::test(flavor = "multi_thread")]
async fn a_backup_of_a_busy_server_answers_as_the_server_did() {
    let (folders, server) = (TempFolders::new(), TestServer::start().await);
    let scene = server.upload_and_parse(Scan::neutral().zip()).await;
    let before = server.client.ground(&scene.id, &ask("the red sofa")).await.unwrap();
    let stop = Arc::new(AtomicBool::new(false));
    let busy = tokio::spawn(generate_load(
        Client::new(&server.url(), None).unwrap(),
        scene.id.clone(),
        stop.clone(),
    ));
    // Each backup is consistent, whatever is in progress while it is made.
    for round in 0..5 {
        run_backup(server.data(), &folders.at("backup")).await;
        check(BackupSource::from_path(&folders.at("backup")))
            .await
            .unwrap_or_else(|error| panic!("round {round}: {error}"));
        let archive = folders.at("backup.tar.zst");
        run_backup(server.data(), &archive).await;
        check(BackupSource::from_path(&archive))
            .await
            .unwrap_or_else(|error| panic!("round {round}, archive: {error}"));
    }
    stop.store(true, Ordering::Relaxed);
    assert!(busy.await.unwrap() > 0, "no request was sent during the backups");

    let path = format!("v1/answers/{}", before.id);
    let bytes = server.client.bytes(&path).await.unwrap();
    for from in ["backup", "backup.tar.zst"] {
        let again = start_restored(&folders.at(from)).await;
        let found = again.client.scene(&scene.id).await.unwrap();
        assert_eq!(
            (found.counts, found.extent, found.parse_version),
            (scene.counts.clone(), scene.extent, scene.parse_version)
        );
        assert_eq!(again.client.bytes(&path).await.unwrap(), bytes, "a restored file differs");
        let asked = again.client.ground(&scene.id, &ask("the red sofa")).await.unwrap();
        assert_eq!(
            (&asked.answer, &asked.aabb, &asked.candidates),
            (&before.answer, &before.aabb, &before.candidates)
        );
        let (cloud, same) = (format!("v1/scenes/{}/cloud.ply", scene.id), &server.client);
        assert_eq!(again.client.bytes(&cloud).await.unwrap(), same.bytes(&cloud).await.unwrap());
        let data = again.stop_and_keep_data().await;
        let well = run_uniground(&["doctor", "--data-dir", data.path().to_str().unwrap()]);
        assert!(
            output_text(&well).contains("no problems found")
                || output_text(&well).contains("its scene"),
            "{}",
            output_text(&well)
        );
        assert!(
            !output_text(&well).contains("damaged") && !output_text(&well).contains("missing"),
            "{}",
            output_text(&well)
        );
    }
    server.stop().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn a_second_backup_copies_only_new_files() {
    let (folders, server) = (TempFolders::new(), TestServer::start().await);
    let to = folders.at("backup");
    server.upload_and_parse(room_with_note(1)).await;
    let first = run_backup(server.data(), &to).await;
    assert_eq!(
        (first.scenes, first.folders, first.new_folders),
        (1, 2, 2),
        "only a scan and its parse are new"
    );
    let second = run_backup(server.data(), &to).await;
    assert_eq!((second.folders, second.new_folders, second.new_bytes), (2, 0, 0));
    let scene = server.upload_and_parse(room_with_note(2)).await;
    let third = run_backup(server.data(), &to).await;
    assert_eq!((third.scenes, third.folders, third.new_folders), (2, 4, 2));
    // A deleted scene is missing from the next backup, and a damaged file there is repaired.
    server.client.delete_scene(&scene.id).await.unwrap();
    let parse = to.join("blobs/parses").join(&server.list_folder("blobs/parses")[0]);
    fs::remove_file(parse.join("cloud.ply")).unwrap();
    let last = run_backup(server.data(), &to).await;
    assert_eq!((last.scenes, last.folders, last.new_folders), (1, 2, 1));
    assert_eq!(to.join("blobs/contents").read_dir_utf8().unwrap().count(), 1);
    check(BackupSource::from_path(&to)).await.unwrap();
    // A stopped server's folder is backed up in the same way.
    let data = server.stop_and_keep_data().await;
    let stopped =
        run_uniground(&["backup", to.as_str(), "--data-dir", data.path().to_str().unwrap()]);
    assert!(
        stopped.status.success() && output_text(&stopped).contains("new: 0 folders"),
        "{}",
        output_text(&stopped)
    );
}

#[tokio::test(flavor = "multi_thread")]
async fn a_damaged_backup_is_refused_and_nothing_is_restored() {
    let (folders, server) = (TempFolders::new(), TestServer::start().await);
    server.upload_and_parse(Scan::neutral().zip()).await;
    let (to, archive) = (folders.at("backup"), folders.at("backup.tar"));
    run_backup(server.data(), &to).await;
    run_backup(server.data(), &archive).await;
    let parse = format!("blobs/parses/{}", server.list_folder("blobs/parses")[0]);
    let content = format!("blobs/contents/{}", server.list_folder("blobs/contents")[0]);
    let database = to.read_dir_utf8().unwrap().find_map(|entry| {
        let name = entry.unwrap().file_name().to_owned();
        name.ends_with(".sqlite").then_some(name)
    });
    let refused = |from: &Utf8Path| {
        let place = folders.at("restored");
        let refused = run_uniground(&["restore", from.as_str(), "--data-dir", place.as_str()]);
        assert!(!refused.status.success() && !place.exists(), "{}", output_text(&refused));
        output_text(&refused)
    };
    let files = [
        (format!("{parse}/cloud.ply"), format!("{parse}: cloud.ply damaged")),
        (format!("{content}/pose/3.txt"), format!("{content}: pose/3.txt damaged")),
        (format!("{content}/.sha256sums"), format!("{content}: .sha256sums damaged")),
        (database.clone().unwrap(), format!("{}: damaged", database.unwrap())),
        ("manifest.json".to_owned(), "manifest.json: it".to_owned()),
    ];
    for (file, expected) in &files {
        let whole = fs::read(to.join(file)).unwrap();
        let mut flipped = whole.clone();
        flipped[whole.len() / 2] ^= 1;
        fs::write(to.join(file), flipped).unwrap();
        assert!(refused(&to).contains(expected), "{expected}: {}", refused(&to));
        let checked = run_uniground(&["restore", "--check", to.as_str()]);
        assert!(
            !checked.status.success() && output_text(&checked).contains(expected),
            "{expected}: {}",
            output_text(&checked)
        );
        fs::write(to.join(file), whole).unwrap();
    }
    fs::remove_file(to.join(&files[0].0)).unwrap();
    assert_contains(refused(&to), "cloud.ply missing");
    // An archive that is truncated or has a flipped bit.
    let whole = fs::read(&archive).unwrap();
    fs::write(&archive, &whole[..whole.len() / 2]).unwrap();
    refused(&archive);
    let mut flipped = whole.clone();
    let at = flipped.windows(6).rposition(|bytes| bytes == b"ply\nfo").unwrap();
    flipped[at] ^= 1;
    fs::write(&archive, flipped).unwrap();
    assert_contains(refused(&archive), "damaged");
    fs::write(&archive, whole).unwrap();
    // Restoring never overwrites existing data.
    let full = folders.at("full");
    fs::create_dir(&full).unwrap();
    fs::write(full.join("thesis.tex"), "x").unwrap();
    for refused in [
        run_uniground(&["restore", archive.as_str(), "--data-dir", full.as_str()]),
        run_uniground(&["backup", full.as_str(), "--data-dir", server.data().as_str()]),
    ] {
        assert!(
            !refused.status.success() && output_text(&refused).contains("thesis.tex"),
            "{}",
            output_text(&refused)
        );
    }
    let within = run_uniground(&[
        "backup",
        server.data().join("backup").as_str(),
        "--data-dir",
        server.data().as_str(),
    ]);
    assert!(
        !within.status.success() && output_text(&within).contains("inside the data folder"),
        "{}",
        output_text(&within)
    );
    let good = run_uniground(&[
        "restore",
        archive.as_str(),
        "--data-dir",
        folders.at("restored").as_str(),
    ]);
    assert!(
        good.status.success() && output_text(&good).contains("1 scenes"),
        "{}",
        output_text(&good)
    );
    server.stop().await;
}

/// A backup reports files that were already lost and contains everything else.
#[tokio::test(flavor = "multi_thread")]
async fn a_backup_reports_and_omits_damaged_files() {
    let (folders, server) = (TempFolders::new(), TestServer::start().await);
    let scene = server.upload_and_parse(Scan::neutral().zip()).await;
    let parse = server.list_folder("blobs/parses")[0].clone();
    let cloud = server.data().join("blobs/parses").join(&parse).join("cloud.ply");
    let mut bytes = fs::read(&cloud).unwrap();
    *bytes.last_mut().unwrap() ^= 1;
    fs::write(&cloud, bytes).unwrap();
    let told = run_uniground(&[
        "backup",
        folders.at("backup").as_str(),
        "--data-dir",
        server.data().as_str(),
    ]);
    assert!(
        !told.status.success()
            && output_text(&told).contains(&format!("blobs/parses/{parse}: cloud.ply damaged")),
        "{}",
        output_text(&told)
    );
    server.stop().await;
    // The scan is there, so its parse is made again.
    let again = start_restored(&folders.at("backup")).await;
    let job = again.client.parse(&scene.id, &serde_json::json!({})).await.unwrap();
    assert_eq!(wait_for_job(&again.client, &job.id).await.error, None);
    assert_eq!(again.client.scene(&scene.id).await.unwrap().counts, scene.counts);
    again.stop().await;
}
