//! A full disk: while the server runs, while it is stopped, and while a batch is created. The file
//! system is mounted by the test, which needs root. Every row checks that the disk is full before
//! it reports a result.

use crate::hostile_uploads::ZIP;
use crate::test_scans::Scan;
use crate::test_server::{Process, ask, expect_problem, serve_command, upload_and_parse};
use crate::{Report, since};
use camino::{Utf8Path, Utf8PathBuf};
use reqwest::Method;
use serde_json::json;
use sqlx::Connection;
use sqlx::sqlite::{SqliteConnectOptions, SqliteConnection};
use std::fs::{self, File, OpenOptions};
use std::io::{BufRead, BufReader, ErrorKind, Write};
use std::process::{Command, Output, Stdio};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::time::{Duration, Instant};
use tokio::time::sleep;
use uniground_client::{Client, ClientError};

/// Large enough that a server becomes ready and creates its reserve file.
const DISK: &str = "size=160m";
/// The disk is smaller than the default of free space to keep.
const NOTHING: &str = "0";

pub async fn run(report: &mut Report) {
    let Some(disk) = Disk::mount() else {
        println!("skipped: a full disk (no file system can be mounted here)");
        return;
    };
    run_while_running(&disk, report).await;
    run_while_stopped(&disk, report).await;
    drop(disk);
    let Some(disk) = Disk::mount() else { return };
    run_batches(&disk, report).await;
}

struct Disk {
    mount: tempfile::TempDir,
    /// A folder on another file system.
    logs: tempfile::TempDir,
}

impl Drop for Disk {
    fn drop(&mut self) {
        let _ = Command::new("umount").arg("-l").arg(self.mount.path()).status();
    }
}

impl Disk {
    fn mount() -> Option<Self> {
        let (mount, logs) = (tempfile::tempdir().unwrap(), tempfile::tempdir().unwrap());
        let mounted = Command::new("mount")
            .args(["-t", "tmpfs", "-o", DISK, "tmpfs"])
            .arg(mount.path())
            .stderr(Stdio::null())
            .status();
        mounted.is_ok_and(|status| status.success()).then_some(Self { mount, logs })
    }

    fn path(&self) -> &Utf8Path {
        Utf8Path::from_path(self.mount.path()).unwrap()
    }

    fn data(&self) -> Utf8PathBuf {
        self.path().join("data")
    }

    fn log(&self) -> Utf8PathBuf {
        Utf8PathBuf::from_path_buf(self.logs.path().join("log")).unwrap()
    }

    fn free_bytes(&self) -> u64 {
        let disk = rustix::fs::statvfs(self.path().as_std_path()).unwrap();
        disk.f_bavail * disk.f_frsize
    }

    /// Returns whether no byte is free and none can be written.
    fn is_full(&self) -> bool {
        let probe = self.path().join("probe");
        let written = fs::write(&probe, "x");
        let _ = fs::remove_file(probe);
        self.free_bytes() == 0 && written.is_err_and(|error| error.kind() == ErrorKind::StorageFull)
    }

    /// Fills the disk to the last byte, again and again until no process frees space any more.
    async fn fill(&self) {
        let mut full_for = 0;
        for _ in 0..600 {
            let mut filler = OpenOptions::new()
                .create(true)
                .append(true)
                .open(self.path().join("filler"))
                .unwrap();
            for bytes in [1 << 20, 4096, 1] {
                while filler.write_all(&vec![1; bytes]).is_ok() {}
            }
            full_for = if self.is_full() { full_for + 1 } else { 0 };
            if full_for == 10 {
                return;
            }
            sleep(Duration::from_millis(50)).await;
        }
        panic!("the disk does not fill: {} bytes are free", self.free_bytes());
    }

    fn empty(&self) {
        fs::remove_file(self.path().join("filler")).unwrap();
    }

    /// Returns the bytes of the reserve file; 0 if there is none.
    fn reserve(&self) -> u64 {
        fs::metadata(self.data().join("reserve")).map_or(0, |file| file.len())
    }

    /// Starts a server, or returns its error output.
    fn start(&self, keep_free: &str) -> Result<Process, String> {
        let mut command = serve_command(&self.data(), "127.0.0.1:0");
        let log = File::create(self.log()).unwrap();
        let mut child = command
            .args(["--keep-free-bytes", keep_free])
            .stdout(Stdio::piped())
            .stderr(log)
            .spawn()
            .unwrap();
        let mut line = String::new();
        BufReader::new(child.stdout.take().unwrap()).read_line(&mut line).unwrap();
        if let Some(address) = line.trim().strip_prefix("listening on ") {
            Ok(Process { client: Client::new(address, None).unwrap(), child })
        } else {
            child.wait().unwrap();
            Err(self.log_text())
        }
    }

    fn log_text(&self) -> String {
        fs::read_to_string(self.log()).unwrap()
    }

    /// Runs a command on the data folder.
    fn run_command(&self, args: &[&str]) -> (bool, String) {
        let command = Command::new(env!("CARGO_BIN_EXE_uniground"))
            .args(args)
            .args(["--data-dir", self.data().as_str()])
            .output();
        let Output { status, stdout, stderr } = command.unwrap();
        (
            status.success(),
            format!("{}{}", String::from_utf8_lossy(&stdout), String::from_utf8_lossy(&stderr)),
        )
    }

    /// Fills the disk while the server is stopped and its reserve file exists.
    async fn fill_while_stopped(&self) -> u64 {
        self.empty();
        self.start(NOTHING).unwrap().terminate();
        let reserve = self.reserve();
        self.fill().await;
        reserve
    }
}

/// Returns the end of an output, for rows that failed.
fn last_lines(text: &str) -> &str {
    let mut from = text.len().saturating_sub(300);
    while !text.is_char_boundary(from) {
        from += 1;
    }
    text[from..].trim()
}

async fn upload_scan(client: &Client, note: &str) -> String {
    upload_and_parse(client, ZIP, Scan::neutral().with("note.txt", note).zip()).await.id
}

async fn is_ready(client: &Client) -> bool {
    client.request(Method::GET, "readyz").send().await.unwrap().status() == 200
}

async fn is_stored(client: &Client, scene: &str) -> Result<bool, ClientError> {
    client.ground(scene, &ask("the red sofa")).await.map(|answer| answer.stored)
}

/// Fills the disk while a server runs, stops it, and starts it again.
async fn run_while_running(disk: &Disk, report: &mut Report) {
    let process = disk.start(NOTHING).unwrap();
    let client = &process.client;
    let (scene, first, second) = (
        upload_scan(client, "1").await,
        upload_scan(client, "2").await,
        upload_scan(client, "3").await,
    );
    let held = disk.reserve() == 8 << 20 && is_ready(client).await;
    report.row(
        "before the disk is full",
        if held { "ready, with a reserve" } else { "not ready" },
        0.0,
        None,
        "",
        held,
    );
    disk.fill().await;
    let start = Instant::now();
    // Answers are stored as long as the database's log has space.
    let (mut answers, mut failed, mut not_stored) = (0, 0, 0);
    while not_stored < 3 && answers < 2000 {
        answers += 1;
        match is_stored(client, &scene).await {
            Ok(is_stored) => not_stored += u32::from(!is_stored),
            Err(_) => failed += 1,
        }
    }
    let told = format!("{answers} answered, {not_stored} not stored");
    let held = disk.is_full() && failed == 0 && not_stored == 3;
    report.row("questions on a full disk", &told, since(start), None, "", held);
    disk.fill().await;
    let told = expect_problem(
        client
            .create_scene(None, ZIP, Scan::neutral().with("note.txt", "x".repeat(1 << 20)).zip())
            .await,
    );
    report.row(
        "an upload on a full disk",
        &format!("{} {}", told.status, told.code),
        0.0,
        None,
        "",
        told.status == 507,
    );
    disk.fill().await;
    let lines = format!("{}\n", json!({"scene_id": scene, "query": "the red sofa"})).repeat(3000);
    let told = expect_problem(client.create_batch_of_lines(lines, &[], None).await);
    let left = client.batches(10, None).await.unwrap().batches.len();
    let held = told.status == 507 && left == 0;
    report.row(
        "a batch on a full disk",
        &format!("{} {}", told.status, told.code),
        0.0,
        None,
        &format!("{left} batches"),
        held,
    );
    disk.fill().await;
    let ready = is_ready(client).await;
    report.row(
        "readiness on a full disk",
        if ready { "ready" } else { "not ready" },
        0.0,
        None,
        "",
        !ready,
    );
    let start = Instant::now();
    disk.fill().await;
    let deleted = client.delete_scene(&first).await;
    let told = if deleted.is_ok() { "204" } else { "not possible" };
    report.row(
        "DELETE on a full disk",
        told,
        since(start),
        None,
        "space again",
        deleted.is_ok() && disk.free_bytes() > 0,
    );

    // The rest of the reserve is for the next start.
    disk.fill().await;
    process.terminate();
    disk.fill().await;
    let (start, reserve) = (Instant::now(), disk.reserve());
    let (held, told) = starts_and_deletes(disk, &second).await;
    report.row(
        "filled again, then restarted",
        &told,
        since(start),
        None,
        &format!("of {} MB in reserve", reserve >> 20),
        held,
    );
}

/// Starts a server on a full disk, asks a question and deletes a scene.
async fn starts_and_deletes(disk: &Disk, scene: &str) -> (bool, String) {
    if !disk.is_full() {
        return (false, "the disk is not full".into());
    }
    let process = match disk.start(NOTHING) {
        Ok(process) => process,
        Err(told) => return (false, format!("does not start: {}", last_lines(&told))),
    };
    let (answered, deleted) = (
        is_stored(&process.client, scene).await.is_ok(),
        process.client.delete_scene(scene).await.is_ok(),
    );
    let released = disk.log_text().contains("disk full: released the reserve file of");
    process.terminate();
    let told = format!("answered {answered}, deleted {deleted}, told {released}");
    (answered && deleted && released && disk.free_bytes() > 0, told)
}

/// Fills the disk while no server runs.
async fn run_while_stopped(disk: &Disk, report: &mut Report) {
    disk.empty();
    let process = disk.start(NOTHING).unwrap();
    let (mine, other) =
        (upload_scan(&process.client, "4").await, upload_scan(&process.client, "5").await);
    process.terminate();
    disk.fill().await;

    for args in [&["gc"][..], &["doctor"], &["backup"]] {
        let reserve = disk.fill_while_stopped().await;
        let to = tempfile::tempdir().unwrap();
        let to = to.path().join("backup").into_os_string().into_string().unwrap();
        let args = if args == ["backup"] { vec!["backup", &to] } else { args.to_vec() };
        let (start, full) = (Instant::now(), disk.is_full());
        let (done, told) = disk.run_command(&args);
        let held = full
            && reserve == 8 << 20
            && done
            && told.contains("disk full: released the reserve file of 8 MB");
        let answer = if held {
            "works".to_owned()
        } else {
            format!("full {full}, done {done}: {}", last_lines(&told))
        };
        report.row(&format!("4 {} on a full disk", args[0]), &answer, since(start), None, "", held);
    }

    let reserve = disk.fill_while_stopped().await;
    let start = Instant::now();
    let (held, told) = starts_and_deletes(disk, &mine).await;
    let held = held && reserve == 8 << 20;
    report.row(
        "a start on a disk filled while stopped",
        &told,
        since(start),
        None,
        "of 8 MB in reserve",
        held,
    );

    // There is no reserve: removing caches makes space.
    disk.fill_while_stopped().await;
    fs::remove_file(disk.data().join("reserve")).unwrap();
    disk.fill().await;
    let (start, full) = (Instant::now(), disk.is_full());
    let (done, told) = disk.run_command(&["gc"]);
    let answer = if done { "works".to_owned() } else { last_lines(&told).to_owned() };
    report.row(
        "gc on a full disk without a reserve",
        &answer,
        since(start),
        None,
        "",
        full && done,
    );

    disk.empty();
    let process = disk.start(NOTHING).unwrap();
    let stored = is_stored(&process.client, &other).await.is_ok_and(|stored| stored)
        && disk.reserve() == 8 << 20;
    report.row(
        "after freeing space",
        if stored { "stored, with a reserve" } else { "not stored" },
        0.0,
        None,
        "",
        stored,
    );
    process.terminate();
    let (whole, told) = disk.run_command(&["doctor"]);
    report.row(
        "then the doctor",
        if whole { "whole" } else { last_lines(&told) },
        0.0,
        None,
        "",
        whole,
    );
}

async fn count_batch_rows(disk: &Disk) -> i64 {
    let options = SqliteConnectOptions::new().filename(disk.data().join("uniground.sqlite"));
    let mut database = SqliteConnection::connect_with(&options).await.unwrap();
    let sql = "SELECT (SELECT count(*) FROM batches) + (SELECT count(*) FROM batch_items)";
    let rows = sqlx::query_scalar(sql).fetch_one(&mut database).await.unwrap();
    database.close().await.unwrap();
    rows
}

/// Creates batches that would fill the disk.
async fn run_batches(disk: &Disk, report: &mut Report) {
    const KEPT_FREE: u64 = 100 << 20;
    let process = disk.start(&KEPT_FREE.to_string()).unwrap();
    let client = &process.client;
    let scene = upload_scan(client, "1").await;
    let (least, over) = (Arc::new(AtomicU64::new(u64::MAX)), Arc::new(AtomicBool::new(false)));
    let watch = {
        let (least, over, path) = (least.clone(), over.clone(), disk.path().to_owned());
        tokio::task::spawn_blocking(move || {
            while !over.load(Ordering::Relaxed) {
                let disk = rustix::fs::statvfs(path.as_std_path()).unwrap();
                least.fetch_min(disk.f_bavail * disk.f_frsize, Ordering::Relaxed);
                std::thread::sleep(Duration::from_millis(2));
            }
        })
    };
    // Defaults of 60 kB for 20,000 items would take 1.2 GB as copies.
    let start = Instant::now();
    let before = disk.free_bytes();
    let items = vec![json!({}); 20_000];
    let body =
        json!({"items": items, "defaults": {"scene_id": scene, "query": "a".repeat(60_000)}});
    let batch = client.create_batch(&serde_json::from_value(body).unwrap(), None).await;
    let told = batch
        .as_ref()
        .map_or_else(|error| format!("{error}"), |batch| format!("{} items", batch.items));
    if let Ok(batch) = &batch {
        client.control_batch(&batch.id, "cancel").await.unwrap();
        client.follow_job(batch.job_id.as_deref().unwrap(), |_| {}).await.unwrap();
    }
    let taken = before.saturating_sub(disk.free_bytes()) >> 20;
    let held = batch.is_ok() && taken < 25;
    report.row(
        "a batch of large defaults",
        &told,
        since(start),
        None,
        &format!("{taken} MB"),
        held,
    );

    let start = Instant::now();
    let known = count_batch_rows(disk).await;
    let line = format!("{}\n", json!({"scene_id": scene, "query": "a".repeat(30_000)}));
    let sent = client.create_batch_of_lines(line.repeat(4000), &[], None).await;
    let told = match sent {
        Err(ClientError::Problem(problem)) => format!("{} {}", problem.status, problem.code),
        // A client that is still sending may miss the refusal.
        Err(_) => "cut off".to_owned(),
        Ok(batch) => format!("{} items taken", batch.items),
    };
    let mut left = count_batch_rows(disk).await - known;
    for _ in 0..100 {
        if left == 0 {
            break;
        }
        sleep(Duration::from_millis(100)).await;
        left = count_batch_rows(disk).await - known;
    }
    over.store(true, Ordering::Relaxed);
    watch.await.unwrap();
    let least = least.load(Ordering::Relaxed);
    let log = fs::metadata(disk.data().join("uniground.sqlite-wal")).map_or(0, |file| file.len());
    let held =
        !told.contains("taken") && left == 0 && least > KEPT_FREE - (16 << 20) && log < 1 << 20;
    let rest = format!("{left} rows, log of {log} bytes, least free {} MB", least >> 20);
    report.row("a batch larger than the disk", &told, since(start), None, &rest, held);
    let stored = is_stored(client, &scene).await.is_ok_and(|stored| stored);
    report.row(
        "a question afterwards",
        if stored { "stored" } else { "not stored" },
        0.0,
        None,
        "",
        stored,
    );
    process.terminate();
    let before = fs::metadata(disk.data().join("uniground.sqlite")).unwrap().len();
    let (done, told) = disk.run_command(&["gc"]);
    let after = fs::metadata(disk.data().join("uniground.sqlite")).unwrap().len();
    let answer = if done {
        format!("{} -> {} MB", before >> 20, after >> 20)
    } else {
        last_lines(&told).to_owned()
    };
    report.row(
        "gc frees the space of the refused batch",
        &answer,
        0.0,
        None,
        "",
        done && after < before / 2,
    );
}
