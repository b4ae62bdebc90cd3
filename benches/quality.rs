//! Stage 1 against annotated rooms: `cargo bench --bench quality [-- --settings FILE] [-- FOLDER]`.
//!
//! The rooms (`room1`, `room2`) lie in `../shared/scenes` where this project is built, or in the folder given.

#![allow(missing_docs, clippy::unwrap_used)] // a bench that can not set up has nothing to measure

use camino::{Utf8Path, Utf8PathBuf};
use comfy_table::{Table, presets};
use uniground::evaluation::annotated::Annotations;
use uniground::evaluation::segmentation::{InstanceScore, score_instances, score_superpoints};
use uniground::ingest::archive::{ArchiveKind, UnpackLimits, unpack};
use uniground::ingest::{self, ImportSettings};
use uniground::progress::Progress;
use uniground::scene::SceneBundle;
use uniground::scene_parsing::masks::MaskSource;
use uniground::scene_parsing::masks::rgbd::RgbdMasks;
use uniground::scene_parsing::{self, ParsingSettings, superpoints};

const MIN_POINTS: u32 = 200;

fn main() {
    let mut args = std::env::args().skip(1).filter(|a| a != "--bench");
    let (mut folder, mut settings, mut verbose) =
        (Utf8PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("../shared/scenes"), ParsingSettings::default(), false);
    while let Some(arg) = args.next() {
        match arg.as_str() {
            "--settings" => settings = serde_json::from_str(&std::fs::read_to_string(args.next().unwrap()).unwrap()).unwrap(),
            "--misses" => verbose = true,
            other => folder = other.into(),
        }
    }
    let mut superpoint_table = Table::new();
    superpoint_table
        .load_preset(presets::ASCII_MARKDOWN)
        .set_header(["room", "points", "superpoints", "purity", "achievable mIoU"]);
    let mut instance_table = Table::new();
    instance_table.load_preset(presets::ASCII_MARKDOWN).set_header([
        "room",
        "masks",
        "instances",
        "box .25",
        "box .5",
        "points .25",
        "points .5",
        "AP50",
        "seconds",
    ]);
    for room in ["room1", "room2"] {
        let temporary = tempfile::tempdir().unwrap();
        let scan = Utf8Path::from_path(temporary.path()).unwrap();
        unpack(&folder.join(format!("{room}.zip")), ArchiveKind::Zip, scan, &UnpackLimits::default()).unwrap();
        let bundle = ingest::load(&ingest::open(scan).unwrap(), &ImportSettings::default(), &Progress::silent()).unwrap();
        let annotations = Annotations::read(&folder, room).unwrap();
        let truth = annotations.label(&bundle.cloud);

        let found = superpoints::compute(&bundle.cloud, &settings.superpoints, &Progress::silent()).unwrap();
        let score = score_superpoints(&found.of_point, &truth);
        superpoint_table.add_row([
            room.to_owned(),
            bundle.cloud.len().to_string(),
            score.superpoints.to_string(),
            format!("{:.3}", score.purity),
            format!("{:.3}", score.achievable_iou),
        ]);
        let rgbd = RgbdMasks { settings: settings.rgbd_masks };
        let annotated = annotations.masks(&bundle.cloud);
        for masks in [&rgbd as &dyn MaskSource, &annotated] {
            let (score, seconds) = instances(bundle.clone(), masks, &settings, &annotations, &truth, verbose);
            let [box_25, box_50] = score.box_recall();
            let [point_25, point_50] = score.point_recall();
            let figures = [box_25, box_50, point_25, point_50, score.ap50].map(|v| format!("{v:.3}"));
            instance_table.add_row(
                [room.to_owned(), masks.name().to_owned(), score.instances.to_string()]
                    .into_iter()
                    .chain(figures)
                    .chain([format!("{seconds:.2}")]),
            );
        }
    }
    println!("{superpoint_table}\n\n{instance_table}");
}

fn instances(
    bundle: SceneBundle,
    masks: &dyn MaskSource,
    settings: &ParsingSettings,
    annotations: &Annotations,
    truth: &[u32],
    verbose: bool,
) -> (InstanceScore, f32) {
    let parsed = scene_parsing::parse(bundle, masks, settings, &Progress::silent()).unwrap();
    let objects = annotations.objects(MIN_POINTS);
    let score = score_instances(&parsed, &objects, truth);
    if verbose {
        for object in &objects {
            let mut parts = std::collections::BTreeMap::<u32, u32>::new();
            parsed
                .instance_of_point
                .iter()
                .zip(truth)
                .filter(|(_, t)| **t == object.id)
                .for_each(|(i, _)| *parts.entry(i.0).or_default() += 1);
            let mut parts: Vec<_> = parts.into_iter().map(|(i, n)| (n, i)).collect();
            parts.sort();
            parts.reverse();
            let text: Vec<String> = parts
                .iter()
                .take(8)
                .map(|(n, i)| {
                    let ins = &parsed.instances[*i as usize - 1];
                    format!("#{i}:{n}/{} z{:.2}..{:.2}", ins.point_count, ins.aabb.min().z, ins.aabb.max().z)
                })
                .collect();
            println!("PARTS {} {} {}: {}", masks.name(), object.id, object.name, text.join("  "));
        }
        for ((object, box_iou), point_iou) in objects.iter().zip(&score.box_iou).zip(&score.point_iou).filter(|((_, b), _)| **b < 0.5) {
            let best = parsed
                .instances
                .iter()
                .max_by(|a, b| a.aabb.iou(&object.aabb).total_cmp(&b.aabb.iou(&object.aabb)))
                .unwrap();
            println!(
                "{:>10} {:>3} {:<18} box {box_iou:.2} points {point_iou:.2} true {:.2?} {:.2?} best {:.2?} {:.2?} #{}",
                masks.name(),
                object.id,
                object.name,
                object.aabb.min().coords.as_slice(),
                object.aabb.max().coords.as_slice(),
                best.aabb.min().coords.as_slice(),
                best.aabb.max().coords.as_slice(),
                best.id
            );
        }
    }
    (score, parsed.report.stages.iter().map(|s| s.seconds).sum())
}
