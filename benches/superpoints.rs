//! Superpoints compared with PCL's VCCS on the same cloud, alternating: `make bench-superpoints`,
//! or `cargo bench --bench superpoints -- [--pcl PROGRAM] [FOLDER]` with the program built from
//! `benches/peers/vccs.cpp`.
//!
//! Both are timed from points in memory to labels in memory. The input is `room1` of
//! `../shared/scenes` or of the given folder.

#![allow(missing_docs, clippy::unwrap_used)] // a bench that can not set up has nothing to time

#[path = "peers/vccs.rs"]
mod vccs;

use camino::{Utf8Path, Utf8PathBuf};
use comfy_table::{Table, presets};
use std::time::Instant;
use uniground_core::geometry::statistics::median;
use uniground_core::parsing::superpoints;
use uniground_core::progress::Progress;
use uniground_evaluation::annotated::AnnotatedRoom;
use uniground_evaluation::segmentation::{SuperpointScore, score_superpoints};
use uniground_types::settings::SuperpointSettings;
use vccs::Vccs;

const RUNS: usize = 9;

/// A timed task: seconds and labels of one run.
type Contestant<'a> = (String, Box<dyn Fn() -> (f32, Vec<u32>) + 'a>);

fn main() {
    let mut folder = Utf8PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("../shared/scenes");
    let mut pcl = None;
    let mut args = std::env::args().skip(1).filter(|a| a != "--bench");
    while let Some(arg) = args.next() {
        match arg.as_str() {
            "--pcl" => pcl = args.next(),
            other => folder = other.into(),
        }
    }
    if !folder.join("room1.zip").exists() {
        println!("skipped: no annotated rooms in {folder}");
        return;
    }
    let temporary = tempfile::tempdir().unwrap();
    let scratch = Utf8Path::from_path(temporary.path()).unwrap();
    let room = AnnotatedRoom::load(&folder, "room1", scratch).unwrap();
    let pcl = pcl.map(|program| Vccs::new(&program, &room.bundle.cloud, scratch).unwrap());

    let ours = |settings: SuperpointSettings| {
        let cloud = &room.bundle.cloud;
        Box::new(move || {
            let start = Instant::now();
            let found = superpoints::compute(cloud, &settings, &Progress::silent()).unwrap();
            (start.elapsed().as_secs_f32(), found.of_point)
        })
    };
    let default = SuperpointSettings::default();
    let mut contestants: Vec<Contestant> = vec![
        ("uniground default".into(), ours(default)),
        (
            "uniground .05/.2".into(),
            ours(SuperpointSettings { voxel_m: 0.05, seed_m: 0.2, ..default }),
        ),
    ];
    if let Some(pcl) = &pcl {
        for (voxel, seed) in [(".05", ".2"), (".02", ".2")] {
            contestants.push((
                format!("PCL {voxel}/{seed}"),
                Box::new(move || pcl.run(voxel, seed).unwrap()),
            ));
        }
    }
    let mut seconds = vec![Vec::new(); contestants.len()];
    let mut scores: Vec<Option<SuperpointScore>> = vec![None; contestants.len()];
    for _ in 0..RUNS {
        for (i, (_, run)) in contestants.iter().enumerate() {
            let (took, labels) = run();
            seconds[i].push(took);
            scores[i].get_or_insert_with(|| score_superpoints(&labels, &room.truth));
        }
    }
    let medians: Vec<f32> = seconds.iter_mut().map(|s| median(s).unwrap()).collect();
    let reference = contestants.iter().position(|(name, _)| name == "PCL .05/.2");
    let mut table = Table::new();
    table.load_preset(presets::ASCII_MARKDOWN);
    table.set_header([
        "",
        "median ms",
        "of PCL .05/.2",
        "superpoints",
        "purity",
        "achievable mIoU",
    ]);
    for (i, (name, _)) in contestants.iter().enumerate() {
        let score = scores[i].unwrap();
        table.add_row([
            name.clone(),
            format!("{:.0}", medians[i] * 1000.0),
            reference.map_or_else(|| "-".into(), |r| format!("{:.2}", medians[i] / medians[r])),
            score.superpoints.to_string(),
            format!("{:.3}", score.purity),
            format!("{:.3}", score.achievable_iou),
        ]);
    }
    println!(
        "room1, {} points, {RUNS} runs each, alternating, {} threads\n{table}",
        room.truth.len(),
        rayon::current_num_threads()
    );
    match &pcl {
        Some(pcl) => println!("{}", pcl.version().unwrap_or_default()),
        None => println!("PCL was left out: no --pcl PROGRAM given"),
    }
}
