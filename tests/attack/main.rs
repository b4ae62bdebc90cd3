//! Attacks on the binary. Every case is a small upload, a kill, a full disk or a connection flood,
//! and prints one row of a table: case, result, seconds, peak memory, and files left on the disk.
//!
//! `cargo test --test attack` runs the short form, `make attack` the full one (`ATTACK=full`).

// A helper that fails aborts its case.
#![allow(clippy::unwrap_used, clippy::too_many_lines)]

mod connections;
mod full_disk;
mod growth_kills;
mod hostile_uploads;
mod kills;
mod mutations;
mod responsiveness;
mod storage_faults;
// Some helpers in these two modules are used only by the integration tests.
#[allow(dead_code)]
#[path = "../integration/test_scans.rs"]
mod test_scans;
#[allow(dead_code)]
#[path = "../integration/test_server.rs"]
mod test_server;
mod uploads;

use camino::{Utf8Path, Utf8PathBuf};
use std::fs;
use std::time::Instant;
use test_server::Process;

/// How many attempts are made.
#[derive(Clone, Copy, PartialEq, Eq)]
pub(crate) enum Form {
    Short,
    Full,
}

impl Form {
    /// Returns one value for the short form and another for the full one.
    pub(crate) fn of<T>(self, short: T, full: T) -> T {
        if self == Self::Full { full } else { short }
    }
}

/// The rows so far, and the cases that failed.
#[derive(Default)]
pub(crate) struct Report {
    failed: Vec<String>,
}

impl Report {
    /// Prints one row. `held` says whether the case passed.
    pub(crate) fn row(
        &mut self,
        case: &str,
        answer: &str,
        seconds: f64,
        peak_mb: Option<f64>,
        left: &str,
        held: bool,
    ) {
        let peak = peak_mb.map_or_else(|| "-".into(), |mb| format!("{mb:.0} MB"));
        let verdict = if held { "" } else { "  <-- FAILED" };
        println!("{case:<52} {answer:<34} {seconds:>7.2} s {peak:>8}  {left}{verdict}");
        if !held {
            self.failed.push(case.to_owned());
        }
    }
}

/// A data folder and the server on it.
pub(crate) struct Target {
    pub(crate) data: tempfile::TempDir,
    pub(crate) process: Process,
}

impl Target {
    pub(crate) fn start() -> Self {
        let data = tempfile::tempdir().unwrap();
        let process = Process::start(Utf8Path::from_path(data.path()).unwrap());
        Self { data, process }
    }

    pub(crate) fn folder(&self) -> Utf8PathBuf {
        Utf8PathBuf::from_path_buf(self.data.path().to_owned()).unwrap()
    }

    /// Returns the peak resident memory since the last reset, in MB.
    pub(crate) fn peak_mb(&self) -> f64 {
        let status = fs::read_to_string(format!("/proc/{}/status", self.process.child.id()))
            .unwrap_or_default();
        let line = status.lines().find_map(|line| line.strip_prefix("VmHWM:")).unwrap_or("0 kB");
        line.trim().trim_end_matches(" kB").parse::<f64>().unwrap() / 1024.0
    }

    pub(crate) fn forget_peak(&self) {
        let _ = fs::write(format!("/proc/{}/clear_refs", self.process.child.id()), "5");
    }

    /// Returns the names of entries in the folders of scans and uploads.
    pub(crate) fn left(&self) -> String {
        let count =
            |folder: &str| self.folder().join(folder).read_dir_utf8().map_or(0, Iterator::count);
        format!("contents {}, tmp {}", count("blobs/contents"), count("tmp"))
    }

    /// Stops the server and starts it on the same folder.
    pub(crate) fn again(self) -> Self {
        let Self { data, process } = self;
        process.kill();
        let process = Process::start(Utf8Path::from_path(data.path()).unwrap());
        Self { data, process }
    }
}

/// Returns the seconds since `start`.
pub(crate) fn since(start: Instant) -> f64 {
    start.elapsed().as_secs_f64()
}

fn main() {
    let form = if std::env::var("ATTACK").is_ok_and(|form| form == "full") {
        Form::Full
    } else {
        Form::Short
    };
    let runtime = tokio::runtime::Builder::new_multi_thread().enable_all().build().unwrap();
    let mut report = Report::default();
    println!("{:<52} {:<34} {:>9} {:>8}  left on the disk", "case", "answer", "time", "peak");
    // `ATTACK_ONLY=full_disk` runs a single part.
    let only = std::env::var("ATTACK_ONLY").ok();
    let is_wanted = |part: &str| only.as_deref().is_none_or(|only| only == part);
    runtime.block_on(async {
        if is_wanted("uploads") {
            uploads::run(form, &mut report).await;
        }
        if is_wanted("mutations") {
            mutations::run(form, &mut report).await;
        }
        if is_wanted("storage_faults") {
            storage_faults::run(form, &mut report).await;
        }
        if is_wanted("full_disk") {
            full_disk::run(&mut report).await;
        }
        if is_wanted("kills") {
            kills::run(form, &mut report).await;
        }
        if is_wanted("growth_kills") {
            growth_kills::run(form, &mut report).await;
        }
        if is_wanted("responsiveness") {
            responsiveness::run(form, &mut report).await;
        }
        if is_wanted("connections") {
            connections::run(form, &mut report).await;
        }
    });
    assert!(report.failed.is_empty(), "failed: {}", report.failed.join("; "));
}
