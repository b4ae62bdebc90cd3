//! Backups of servers that run, and what comes of them.

use crate::archives::Scan;
use crate::server::{TestServer, ask, finished};
use camino::{Utf8Path, Utf8PathBuf};
use std::fs;
use std::process::{Command, Output};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use uniground::config::{LimitsConfig, ModelsConfig, VlmConfig};
use uniground_client::Client;
use uniground_storage::{BackupReport, BackupSource, BackupTarget, back_up, check, restore};

fn uniground(args: &[&str]) -> Output {
    Command::new(env!("CARGO_BIN_EXE_uniground"))
        .args(args)
        .env_remove("UNIGROUND_DATA_DIR")
        .output()
        .unwrap()
}

fn said(output: &Output) -> String {
    format!(
        "{}{}",
        String::from_utf8_lossy(&output.stdout),
        String::from_utf8_lossy(&output.stderr)
    )
}

/// The same room under other bytes.
fn another(number: usize) -> Vec<u8> {
    Scan::neutral().with("note.txt", number.to_string()).zip()
}

struct Folders {
    _root: tempfile::TempDir,
    root: Utf8PathBuf,
}

impl Folders {
    fn new() -> Self {
        let root = tempfile::tempdir().unwrap();
        Self { root: Utf8PathBuf::try_from(root.path().to_owned()).unwrap(), _root: root }
    }

    fn at(&self, name: &str) -> Utf8PathBuf {
        self.root.join(name)
    }
}

async fn backed_up(data: &Utf8Path, to: &Utf8Path) -> BackupReport {
    let done = back_up(data, BackupTarget::from_path(to)).await.unwrap();
    assert_eq!(done.left_out, Vec::new());
    done
}

/// A server on a restored backup.
async fn restored(from: &Utf8Path) -> TestServer {
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

/// Asks, uploads and deletes until it is told to stop.
async fn keep_busy(client: Client, scene: String, stop: Arc<AtomicBool>) -> usize {
    let mut rounds = 0;
    while !stop.load(Ordering::Relaxed) {
        client.ground(&scene, &ask("the fridge")).await.unwrap();
        let created =
            client.create_scene(None, "application/zip", another(1000 + rounds)).await.unwrap();
        if rounds % 2 == 0 {
            assert_eq!(finished(&client, &created.job.unwrap().id).await.error, None);
        }
        client.delete_scene(&created.scene.id).await.unwrap();
        rounds += 1;
    }
    rounds
}

#[tokio::test(flavor = "multi_thread")]
async fn a_backup_of_a_busy_server_answers_as_the_server_did() {
    let (folders, server) = (Folders::new(), TestServer::start().await);
    let scene = server.parsed(Scan::neutral().zip()).await;
    let before = server.client.ground(&scene.id, &ask("the red sofa")).await.unwrap();
    let stop = Arc::new(AtomicBool::new(false));
    let busy = tokio::spawn(keep_busy(
        Client::new(&server.url(), None).unwrap(),
        scene.id.clone(),
        stop.clone(),
    ));
    // Whatever is under way then, each of them is one whole.
    for round in 0..5 {
        backed_up(server.data(), &folders.at("backup")).await;
        check(BackupSource::from_path(&folders.at("backup")))
            .await
            .unwrap_or_else(|error| panic!("round {round}: {error}"));
        let archive = folders.at("backup.tar.zst");
        backed_up(server.data(), &archive).await;
        check(BackupSource::from_path(&archive))
            .await
            .unwrap_or_else(|error| panic!("round {round}, archive: {error}"));
    }
    stop.store(true, Ordering::Relaxed);
    assert!(busy.await.unwrap() > 0);

    let path = format!("v1/answers/{}", before.id);
    let bytes = server.client.bytes(&path).await.unwrap();
    for from in ["backup", "backup.tar.zst"] {
        let again = restored(&folders.at(from)).await;
        let found = again.client.scene(&scene.id).await.unwrap();
        assert_eq!(
            (found.counts, found.extent, found.parse_version),
            (scene.counts.clone(), scene.extent, scene.parse_version)
        );
        assert_eq!(again.client.bytes(&path).await.unwrap(), bytes, "byte for byte");
        let asked = again.client.ground(&scene.id, &ask("the red sofa")).await.unwrap();
        assert_eq!(
            (&asked.answer, &asked.aabb, &asked.candidates),
            (&before.answer, &before.aabb, &before.candidates)
        );
        let (cloud, same) = (format!("v1/scenes/{}/cloud.ply", scene.id), &server.client);
        assert_eq!(again.client.bytes(&cloud).await.unwrap(), same.bytes(&cloud).await.unwrap());
        let data = again.give_back().await;
        let well = uniground(&["doctor", "--data-dir", data.path().to_str().unwrap()]);
        assert!(
            said(&well).contains("is whole") || said(&well).contains("its scene"),
            "{}",
            said(&well)
        );
        assert!(
            !said(&well).contains("damaged") && !said(&well).contains("missing"),
            "{}",
            said(&well)
        );
    }
    server.stop().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn only_what_is_new_is_copied() {
    let (folders, server) = (Folders::new(), TestServer::start().await);
    let to = folders.at("backup");
    server.parsed(another(1)).await;
    let first = backed_up(server.data(), &to).await;
    assert_eq!((first.scenes, first.folders, first.new_folders), (1, 2, 2), "a scan and its parse");
    let second = backed_up(server.data(), &to).await;
    assert_eq!((second.folders, second.new_folders, second.new_bytes), (2, 0, 0));
    let scene = server.parsed(another(2)).await;
    let third = backed_up(server.data(), &to).await;
    assert_eq!((third.scenes, third.folders, third.new_folders), (2, 4, 2));
    // What is gone is gone from the next backup, and what was damaged there is mended.
    server.client.delete_scene(&scene.id).await.unwrap();
    let parse = to.join("blobs/parses").join(&server.stored("blobs/parses")[0]);
    fs::remove_file(parse.join("cloud.ply")).unwrap();
    let last = backed_up(server.data(), &to).await;
    assert_eq!((last.scenes, last.folders, last.new_folders), (1, 2, 1));
    assert_eq!(to.join("blobs/contents").read_dir_utf8().unwrap().count(), 1);
    check(BackupSource::from_path(&to)).await.unwrap();
    // A server that is stopped is backed up like one that runs.
    let data = server.give_back().await;
    let stopped = uniground(&["backup", to.as_str(), "--data-dir", data.path().to_str().unwrap()]);
    assert!(
        stopped.status.success() && said(&stopped).contains("new: 0 folders"),
        "{}",
        said(&stopped)
    );
}

#[tokio::test(flavor = "multi_thread")]
async fn a_damaged_backup_is_named_and_nothing_is_restored() {
    let (folders, server) = (Folders::new(), TestServer::start().await);
    server.parsed(Scan::neutral().zip()).await;
    let (to, archive) = (folders.at("backup"), folders.at("backup.tar"));
    backed_up(server.data(), &to).await;
    backed_up(server.data(), &archive).await;
    let parse = format!("blobs/parses/{}", server.stored("blobs/parses")[0]);
    let content = format!("blobs/contents/{}", server.stored("blobs/contents")[0]);
    let database = to.read_dir_utf8().unwrap().find_map(|entry| {
        let name = entry.unwrap().file_name().to_owned();
        name.ends_with(".sqlite").then_some(name)
    });
    let refused = |from: &Utf8Path| {
        let place = folders.at("restored");
        let refused = uniground(&["restore", from.as_str(), "--data-dir", place.as_str()]);
        assert!(!refused.status.success() && !place.exists(), "{}", said(&refused));
        said(&refused)
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
        let checked = uniground(&["restore", "--check", to.as_str()]);
        assert!(
            !checked.status.success() && said(&checked).contains(expected),
            "{expected}: {}",
            said(&checked)
        );
        fs::write(to.join(file), whole).unwrap();
    }
    fs::remove_file(to.join(&files[0].0)).unwrap();
    assert!(refused(&to).contains("cloud.ply missing"));
    // An archive that is cut off, or has a bit that fell over.
    let whole = fs::read(&archive).unwrap();
    fs::write(&archive, &whole[..whole.len() / 2]).unwrap();
    refused(&archive);
    let mut flipped = whole.clone();
    let at = flipped.windows(6).rposition(|bytes| bytes == b"ply\nfo").unwrap();
    flipped[at] ^= 1;
    fs::write(&archive, flipped).unwrap();
    assert!(refused(&archive).contains("damaged"));
    fs::write(&archive, whole).unwrap();
    // Nor is anything written over.
    let full = folders.at("full");
    fs::create_dir(&full).unwrap();
    fs::write(full.join("thesis.tex"), "x").unwrap();
    for refused in [
        uniground(&["restore", archive.as_str(), "--data-dir", full.as_str()]),
        uniground(&["backup", full.as_str(), "--data-dir", server.data().as_str()]),
    ] {
        assert!(
            !refused.status.success() && said(&refused).contains("thesis.tex"),
            "{}",
            said(&refused)
        );
    }
    let within = uniground(&[
        "backup",
        server.data().join("backup").as_str(),
        "--data-dir",
        server.data().as_str(),
    ]);
    assert!(
        !within.status.success() && said(&within).contains("in the data folder itself"),
        "{}",
        said(&within)
    );
    let good =
        uniground(&["restore", archive.as_str(), "--data-dir", folders.at("restored").as_str()]);
    assert!(good.status.success() && said(&good).contains("1 scenes"), "{}", said(&good));
    server.stop().await;
}

/// What was lost before is told, and the rest is there.
#[tokio::test(flavor = "multi_thread")]
async fn what_was_damaged_before_is_left_out_and_told() {
    let (folders, server) = (Folders::new(), TestServer::start().await);
    let scene = server.parsed(Scan::neutral().zip()).await;
    let parse = server.stored("blobs/parses")[0].clone();
    let cloud = server.data().join("blobs/parses").join(&parse).join("cloud.ply");
    let mut bytes = fs::read(&cloud).unwrap();
    *bytes.last_mut().unwrap() ^= 1;
    fs::write(&cloud, bytes).unwrap();
    let told =
        uniground(&["backup", folders.at("backup").as_str(), "--data-dir", server.data().as_str()]);
    assert!(
        !told.status.success()
            && said(&told).contains(&format!("blobs/parses/{parse}: cloud.ply damaged")),
        "{}",
        said(&told)
    );
    server.stop().await;
    // The scan is there: its parse is made again.
    let again = restored(&folders.at("backup")).await;
    let job = again.client.parse(&scene.id, &serde_json::json!({})).await.unwrap();
    assert_eq!(finished(&again.client, &job.id).await.error, None);
    assert_eq!(again.client.scene(&scene.id).await.unwrap().counts, scene.counts);
    again.stop().await;
}
