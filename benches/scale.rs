//! How the time of stage 1 grows with the scan: `make bench-scale`, or `cargo bench --bench scale
//! -- [FOLDER]`.
//!
//! Places one to eight copies of `room1` of `../shared/scenes` (or of the given folder) side by
//! side, with 75 frames each. Prints seconds, memory and the expectation for n log n, then how long
//! a parse takes to stop when it is cancelled.

// A bench that cannot set up has nothing to time. The parse runs on its own thread so that it can
// be cancelled.
#![allow(missing_docs, clippy::unwrap_used, clippy::disallowed_methods)]

use camino::{Utf8Path, Utf8PathBuf};
use comfy_table::{Table, presets};
use std::sync::mpsc;
use std::time::{Duration, Instant};
use tokio_util::sync::CancellationToken;
use uniground_core::geometry::Vector3;
use uniground_core::parsing::checkpoints::Checkpoints;
use uniground_core::parsing::masks::rgbd::RgbdMasks;
use uniground_core::parsing::{self, ParsingSettings, Perception};
use uniground_core::progress::Progress;
use uniground_core::scene::SceneBundle;
use uniground_evaluation::annotated::AnnotatedRoom;

const FRAMES_PER_ROOM: usize = 75;
/// Distance of the rooms in meters.
const STEP_M: f32 = 8.0;

fn main() {
    let folder = std::env::args().skip(1).find(|a| a != "--bench").map(Utf8PathBuf::from);
    let folder = folder
        .unwrap_or_else(|| Utf8PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("../shared/scenes"));
    if !folder.join("room1.zip").exists() {
        println!("skipped: no annotated rooms in {folder}");
        return;
    }
    let temporary = tempfile::tempdir().unwrap();
    let room =
        AnnotatedRoom::load(&folder, "room1", Utf8Path::from_path(temporary.path()).unwrap())
            .unwrap()
            .bundle;

    let mut table = Table::new();
    table.load_preset(presets::ASCII_MARKDOWN);
    table.set_header([
        "points",
        "frames",
        "instances",
        "seconds",
        "of n log n",
        "peak MB",
        "slowest stages",
    ]);
    let mut first = None;
    for rooms in [1, 2, 4, 8] {
        let bundle = side_by_side(&room, rooms);
        let (points, frames) = (bundle.cloud.len(), bundle.frames.len());
        let parsed = parse(bundle, &Progress::silent()).unwrap();
        let seconds: f32 = parsed.report.stages.iter().map(|s| s.seconds).sum();
        let memory = parsed.report.stages.iter().filter_map(|s| s.peak_memory_mb).max();
        let unit = points as f32 * (points as f32).ln();
        let (first_seconds, first_unit) = *first.get_or_insert((seconds, unit));
        let mut stages = parsed.report.stages.clone();
        stages.sort_by(|a, b| b.seconds.total_cmp(&a.seconds));
        let slowest: Vec<String> =
            stages.iter().take(3).map(|s| format!("{} {:.1} s", s.stage, s.seconds)).collect();
        table.add_row([
            points.to_string(),
            frames.to_string(),
            parsed.report.instances.to_string(),
            format!("{seconds:.1}"),
            format!("{:.2}", seconds / first_seconds / (unit / first_unit)),
            memory.map_or_else(|| "-".into(), |mb| mb.to_string()),
            slowest.join(", "),
        ]);
    }
    println!("{table}");
    let bundle = side_by_side(&room, 4);
    let waits: Vec<f32> =
        (1..20).map(|i| seconds_to_stop(bundle.clone(), i as f32 / 20.0)).collect();
    println!(
        "asked to stop at 5, 10, .. 95 % of {} points: at most {:.2} s until it has",
        bundle.cloud.len(),
        waits.iter().fold(0.0, |a: f32, b| a.max(*b))
    );
}

fn parse(
    bundle: SceneBundle,
    progress: &Progress,
) -> Result<uniground_core::scene::ParsedScene, parsing::ParseError> {
    parsing::parse(
        bundle,
        &Perception::with_masks(&RgbdMasks::default()),
        &ParsingSettings::default(),
        &Checkpoints::disabled(),
        progress,
    )
}

fn side_by_side(room: &SceneBundle, rooms: usize) -> SceneBundle {
    let (cloud, report) = (uniground_core::scene::PointCloud::default(), room.report.clone());
    let mut all = SceneBundle { cloud, frames: Vec::new(), report, additions: Vec::new() };
    for k in 0..rooms {
        let shift = Vector3::new(k as f32 * STEP_M, 0.0, 0.0);
        all.cloud.positions.extend(room.cloud.positions.iter().map(|p| p + shift));
        all.cloud.colors.extend(&room.cloud.colors);
        for mut frame in room.frames.iter().cycle().take(FRAMES_PER_ROOM).cloned() {
            frame.index = uniground_core::scene::FrameIndex(all.frames.len() as u32);
            frame.camera_to_world.translation.vector += shift;
            all.frames.push(frame);
        }
    }
    all
}

/// Cancels when progress reaches `at`, and waits for the parse to end.
fn seconds_to_stop(bundle: SceneBundle, at: f32) -> f32 {
    let (cancel, (reached, waiting)) = (CancellationToken::new(), mpsc::channel());
    let progress = Progress::new(
        move |_, done| {
            if done >= at {
                let _ = reached.send(());
            }
        },
        {
            let cancel = cancel.clone();
            move || cancel.is_cancelled()
        },
    );
    let worker =
        std::thread::spawn(move || parse(bundle, &progress).map(|parsed| parsed.report.instances));
    // Not at the progress report itself, where it would be noticed at once, but a moment later.
    waiting.recv().unwrap();
    std::thread::sleep(Duration::from_millis(5));
    let start = Instant::now();
    cancel.cancel();
    let _ = worker.join().unwrap();
    start.elapsed().as_secs_f32()
}
