//! The cost of importing scans: clouds of ten million points on one core, a check of a thousand
//! frames, and a scan of five thousand frames imported by a service, compared with `cp`. `cargo
//! bench --bench readers [-- clouds|check|import]`

#![allow(missing_docs, clippy::unwrap_used)] // a bench that can not set up has nothing to time

mod readers {
    pub mod clouds;
    pub mod frames;
}

use camino::{Utf8Path, Utf8PathBuf};
use readers::{clouds, frames};
use std::fs;
use std::io::{BufRead, BufReader};
use std::process::{Child, Command, Stdio};
use std::time::Instant;
use uniground_client::Client;
use uniground_core::ingest::read_cloud;
use uniground_types::scenes::ImportRequest;

const POINTS: usize = 10_000_000;
const CHECKED_FRAMES: usize = 1000;
const IMPORTED_FRAMES: usize = 5000;
/// Bytes of each frame. All frames together are five gigabytes if the disk has three times that;
/// `MB=` overrides it.
const IMPORTED_MB: usize = 5000;
const TURNS: usize = 5;
const UNIGROUND: &str = env!("CARGO_BIN_EXE_uniground");

fn main() {
    // cargo adds "--bench".
    let only = std::env::args().skip(1).find(|arg| !arg.starts_with('-'));
    let wanted = |what: &str| only.as_deref().is_none_or(|only| only == what);
    if wanted("clouds") {
        read_clouds();
    }
    if wanted("check") {
        check();
    }
    if wanted("import") {
        import();
    }
}

/// Returns the seconds of the best, the median and the worst run.
fn timed(turns: usize, mut call: impl FnMut()) -> [f64; 3] {
    let mut taken: Vec<f64> = (0..turns)
        .map(|_| {
            let start = Instant::now();
            call();
            start.elapsed().as_secs_f64()
        })
        .collect();
    taken.sort_by(f64::total_cmp);
    [taken[0], taken[turns / 2], taken[turns - 1]]
}

fn read_clouds() {
    let one_core = rayon::ThreadPoolBuilder::new().num_threads(1).build().unwrap();
    for (name, write) in clouds::FORMATS {
        let folder = tempfile::tempdir().unwrap();
        let file = Utf8Path::from_path(folder.path()).unwrap().join(name);
        write(&file, POINTS);
        let megabytes = file.metadata().unwrap().len() >> 20;
        let [best, median, worst] = timed(TURNS, || {
            let cloud = one_core.install(|| read_cloud(&file)).unwrap();
            assert_eq!(cloud.len(), POINTS);
        });
        println!(
            "{name}: {POINTS} points, {megabytes} MB, one core: median {median:.2} s, best {best:.2} s, worst {worst:.2} s"
        );
    }
}

fn check() {
    let folder = tempfile::tempdir().unwrap();
    let root = Utf8Path::from_path(folder.path()).unwrap();
    frames::write(root, CHECKED_FRAMES, 0);
    let [best, median, worst] = timed(TURNS, || {
        let checked =
            Command::new(UNIGROUND).args(["import", root.as_str(), "--check"]).output().unwrap();
        assert!(checked.status.success(), "{}", String::from_utf8_lossy(&checked.stderr));
    });
    println!(
        "import --check of {CHECKED_FRAMES} frames: median {median:.2} s, best {best:.2} s, worst {worst:.2} s"
    );
}

/// Both measurements end on the disk, because a copy in memory is not finished.
fn import() {
    let megabytes = std::env::var("MB").map_or(IMPORTED_MB, |mb| mb.parse().unwrap());
    let folder = tempfile::tempdir().unwrap();
    let root = Utf8Path::from_path(folder.path()).unwrap();
    let scan = root.join("scans/scan");
    frames::write(&scan, IMPORTED_FRAMES, megabytes << 20);
    let copy = root.join("copy");
    let [copied, ..] = timed(2, || {
        let _ = fs::remove_dir_all(&copy);
        sync(root);
        // Deleting is not timed.
        let done = Command::new("cp").args(["-r", scan.as_str(), copy.as_str()]).status().unwrap();
        assert!(done.success());
        sync(root);
    });
    fs::remove_dir_all(&copy).unwrap();
    let (seconds, peak_mb) =
        (0..2).map(|_| import_once(root)).min_by(|a, b| a.0.total_cmp(&b.0)).unwrap();

    println!(
        "{IMPORTED_FRAMES} frames, {megabytes} MB: cp -r and sync {copied:.1} s, imported by a service {seconds:.1} s, \
         {:.2} times as long, peak resident memory {peak_mb:.0} MB",
        seconds / copied
    );
}

fn sync(folder: &Utf8Path) {
    assert!(Command::new("sync").args(["-f", folder.as_str()]).status().unwrap().success());
}

/// Returns the seconds from the request to the stored scene, and the server's peak memory.
fn import_once(root: &Utf8Path) -> (f64, f64) {
    let data = root.join("data");
    sync(root);
    let server = Server::start(&data, &root.join("scans"));
    let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build().unwrap();
    let client = Client::new(&server.address, None).unwrap();
    let request = ImportRequest { parse: false, ..ImportRequest::from_path("scan") };
    let start = Instant::now();
    runtime.block_on(client.import_scene(&request)).unwrap();
    let taken = start.elapsed().as_secs_f64();
    let peak_mb = server.peak_mb();
    drop(server);
    fs::remove_dir_all(data).unwrap();
    (taken, peak_mb)
}

struct Server {
    child: Child,
    address: String,
}

impl Server {
    fn start(data: &Utf8PathBuf, scans: &Utf8Path) -> Self {
        let mut child = Command::new(UNIGROUND)
            .args([
                "serve",
                "--listen",
                "127.0.0.1:0",
                "--masks",
                "builtin",
                "--encoder",
                "builtin",
            ])
            .args(["--data-dir", data.as_str(), "--import-root", scans.as_str()])
            .stdout(Stdio::piped())
            .stderr(Stdio::null())
            .spawn()
            .unwrap();
        let mut line = String::new();
        BufReader::new(child.stdout.take().unwrap()).read_line(&mut line).unwrap();
        let address = line.trim().strip_prefix("listening on ").unwrap().to_owned();
        Self { child, address }
    }

    /// Returns the peak resident memory in MB.
    fn peak_mb(&self) -> f64 {
        let status = fs::read_to_string(format!("/proc/{}/status", self.child.id())).unwrap();
        let line = status.lines().find(|l| l.starts_with("VmHWM:")).unwrap();
        line.split_whitespace().nth(1).unwrap().parse::<f64>().unwrap() / 1024.0
    }
}

impl Drop for Server {
    fn drop(&mut self) {
        // The process may already have ended; there is nothing to do about it here.
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}
