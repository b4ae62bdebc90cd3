//! The cost of reading uploads in child processes: the same task in this process and in a child,
//! alternating. `cargo bench --bench isolation [-- SCAN.zip…]`; without arguments the sample scan.

#![allow(missing_docs, clippy::unwrap_used)] // a bench that can not set up has nothing to time

use camino::{Utf8Path, Utf8PathBuf};
use std::fs;
use std::time::{Duration, Instant};
use uniground_core::ingest::archive::UnpackLimits;
use uniground_core::parsing::checkpoints::Checkpoints;
use uniground_core::progress::Progress;
use uniground_core::scan::{import_scan, load_stored_import};
use uniground_isolation::{ChildProcess, ScanReader, Task, TaskOutcome};
use uniground_types::settings::ImportSettings;

const TURNS: usize = 7;

fn main() {
    let scans: Vec<Utf8PathBuf> = std::env::args()
        .skip(1)
        .filter(|arg| !arg.starts_with('-'))
        .map(Utf8PathBuf::from)
        .collect();
    let scans =
        if scans.is_empty() { vec![Utf8PathBuf::from("examples/living_room.zip")] } else { scans };
    let child = ChildProcess::new(Some(env!("CARGO_BIN_EXE_uniground").into()), 4 << 30);
    let isolated = ScanReader::isolated(child);
    println!(
        "{:<28} {:<34} {:>12} {:>12} {:>8}",
        "scan", "task", "in process", "in a child", "ratio"
    );
    for scan in scans {
        let name = scan.file_name().unwrap_or_default();
        row(
            name,
            "unpack and check",
            || unpack(&scan, &ScanReader::in_process()),
            || unpack(&scan, &isolated),
        );
        // In process: import and load. With a child: the child imports and decodes every image, and
        // the service reads the import.
        row(name, "import", || import_here(&scan), || import_isolated(&scan, &isolated));
    }
}

/// Prints the medians of both, measured alternately.
fn row(
    scan: &str,
    task: &str,
    mut here: impl FnMut() -> Duration,
    mut there: impl FnMut() -> Duration,
) {
    let (mut of_here, mut of_there) = (Vec::new(), Vec::new());
    for turn in 0..TURNS {
        if turn % 2 == 0 {
            of_here.push(here());
            of_there.push(there());
        } else {
            of_there.push(there());
            of_here.push(here());
        }
    }
    let median = |mut times: Vec<Duration>| {
        times.sort_unstable();
        times[TURNS / 2].as_secs_f64()
    };
    let (here, there) = (median(of_here), median(of_there));
    println!(
        "{scan:<28} {task:<34} {:>9.1} ms {:>9.1} ms {:>8.2}",
        here * 1e3,
        there * 1e3,
        there / here
    );
}

fn folder(temporary: &tempfile::TempDir) -> Utf8PathBuf {
    Utf8PathBuf::from_path_buf(temporary.path().to_owned()).unwrap()
}

fn unpacking(scan: &Utf8Path, into: Utf8PathBuf) -> Task {
    Task::Unpack {
        archive: scan.to_owned(),
        file_name: "scan.zip".into(),
        folder: into,
        limits: UnpackLimits::default(),
    }
}

fn unpack(scan: &Utf8Path, reader: &ScanReader) -> Duration {
    let temporary = tempfile::tempdir().unwrap();
    let task = unpacking(scan, folder(&temporary));
    let start = Instant::now();
    let outcome = reader.import(&task, &Progress::silent()).unwrap();
    assert!(matches!(outcome, TaskOutcome::Scan { .. }));
    start.elapsed()
}

/// An unpacked scan and an empty folder for its checkpoints.
fn unpack_scan(scan: &Utf8Path) -> (tempfile::TempDir, Utf8PathBuf, Utf8PathBuf) {
    let temporary = tempfile::tempdir().unwrap();
    let (content, checkpoints) =
        (folder(&temporary).join("content"), folder(&temporary).join("checkpoints"));
    fs::create_dir(&content).unwrap();
    fs::create_dir(&checkpoints).unwrap();
    ScanReader::in_process()
        .import(&unpacking(scan, content.clone()), &Progress::silent())
        .unwrap();
    (temporary, content, checkpoints)
}

fn import_here(scan: &Utf8Path) -> Duration {
    let (_temporary, content, checkpoints) = unpack_scan(scan);
    let start = Instant::now();
    import_scan(
        &content,
        &ImportSettings::default(),
        &Checkpoints::in_folder(&checkpoints, "bench"),
        &Progress::silent(),
    )
    .unwrap();
    start.elapsed()
}

fn import_isolated(scan: &Utf8Path, reader: &ScanReader) -> Duration {
    let (_temporary, content, checkpoints) = unpack_scan(scan);
    let settings = ImportSettings::default();
    let task = Task::Import {
        content: content.clone(),
        settings: settings.clone(),
        checkpoints: checkpoints.clone(),
        origin: "bench".into(),
    };
    let start = Instant::now();
    reader.import(&task, &Progress::silent()).unwrap();
    let scan =
        load_stored_import(&content, &settings, &Checkpoints::in_folder(&checkpoints, "bench"))
            .unwrap();
    assert!(scan.is_some());
    start.elapsed()
}
