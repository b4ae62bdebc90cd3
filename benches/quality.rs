//! Stage 1 against annotated rooms: `make bench-quality`, or `cargo bench --bench quality --
//! [--settings FILE] [--models DIR] [--misses] [--losses] [--brief] [--rooms room1,room2] [FOLDER]`.
//!
//! The rooms (all archives with annotations) are in `../shared/scenes` or in the given folder. A
//! single run varies by an object or two, so every figure is also averaged over several rotations
//! about Z. The table of stage losses shows what is still recoverable after each step. `--brief` is
//! for work on stage 1: instances only, without rotation and averaged over six runs, five of which
//! omit a fifth of the frames; boxes are the annotated ones, which is not possible in a rotated
//! world. `--losses` adds the table of stage losses to it, and with `--misses` the steps at which
//! single objects are lost. With `--brief`, `--models` takes the masks of the first segmenter in a
//! folder of models instead of the built-in ones, and stores them in `target/masks`.

#![allow(missing_docs, clippy::unwrap_used)] // a bench that can not set up has nothing to measure

use camino::{Utf8Path, Utf8PathBuf};
use comfy_table::{Table, presets};
use std::hash::{DefaultHasher, Hash, Hasher};
use uniground::config::{AUTO, ModelsConfig};
use uniground_core::models::attributes::Lexicon;
use uniground_core::models::neural::Role;
use uniground_core::parsing::checkpoints::Checkpoints;
use uniground_core::parsing::masks::MaskSource;
use uniground_core::parsing::masks::rgbd::RgbdMasks;
use uniground_core::parsing::masks::sam::{EncodedFrames, SamMasks};
use uniground_core::parsing::{self, ParsingSettings, Perception, superpoints};
use uniground_core::progress::Progress;
use uniground_core::scene::{Instance, ParsedScene};
use uniground_evaluation::annotated::AnnotatedRoom;
use uniground_evaluation::annotations::{Annotations, SceneObject};
use uniground_evaluation::cached_masks::CachedMasks;
use uniground_evaluation::segmentation::{
    InstanceScore, score_instances, score_structure, score_superpoints,
};
use uniground_evaluation::stage_losses::{self, StageLoss};
use uniground_evaluation::systems::{NamedBy, instances_of};

/// Objects with fewer points are ignored, as in the published tables.
const MIN_POINTS: u32 = 200;
const TURNS_DEG: [f32; 6] = [0.0, 10.0, 23.0, 45.0, 67.0, 90.0];

/// Where the masks of segmenters are stored.
const MASKS: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/target/masks");

struct Options {
    folder: Utf8PathBuf,
    settings: ParsingSettings,
    models: Option<Utf8PathBuf>,
    misses: bool,
    losses: bool,
    brief: bool,
    rooms: Option<Vec<String>>,
}

fn options() -> Options {
    let mut options = Options {
        folder: Utf8PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("../shared/scenes"),
        settings: ParsingSettings::default(),
        models: None,
        misses: false,
        losses: false,
        brief: false,
        rooms: None,
    };
    let mut args = std::env::args().skip(1).filter(|a| a != "--bench");
    while let Some(arg) = args.next() {
        match arg.as_str() {
            "--settings" => {
                options.settings =
                    serde_json::from_str(&std::fs::read_to_string(args.next().unwrap()).unwrap())
                        .unwrap();
            }
            "--models" => options.models = Some(args.next().unwrap().into()),
            "--misses" => options.misses = true,
            "--losses" => options.losses = true,
            "--brief" => options.brief = true,
            "--rooms" => {
                options.rooms = Some(args.next().unwrap().split(',').map(str::to_owned).collect());
            }
            folder => options.folder = folder.into(),
        }
    }
    options
}

fn main() {
    let options = options();
    let mut rooms = rooms(&options.folder);
    rooms.retain(|room| options.rooms.as_ref().is_none_or(|wanted| wanted.contains(room)));
    if rooms.is_empty() {
        println!("skipped: no annotated rooms in {}", options.folder);
        return;
    }
    assert!(options.brief || options.models.is_none(), "--models needs --brief");
    match options.brief {
        true => run_brief(&rooms, &options),
        false => run_full(&rooms, &options),
    }
}

/// Returns instances by the built-in masks.
fn run_brief(rooms: &[String], options: &Options) {
    const FIFTHS: usize = 5;
    let Options { folder, settings, misses, .. } = options;
    let encoded = options.models.as_deref().map(load_segmenter);
    let mut instances = instance_table();
    let mut losses = losses_table();
    for name in rooms {
        let temporary = tempfile::tempdir().unwrap();
        let room =
            AnnotatedRoom::load(folder, name, Utf8Path::from_path(temporary.path()).unwrap())
                .unwrap();
        let rgbd = RgbdMasks { settings: settings.rgbd_masks };
        let segmented = encoded.as_ref().map(|(frames, label)| SamMasks {
            frames,
            settings: settings.sam_masks,
            segments: settings.rgbd_masks,
            name: label.clone(),
        });
        let stored = segmented
            .as_ref()
            .map(|source| CachedMasks { source, folder: masks_folder(source, folder, name) });
        let masks: &dyn MaskSource = stored.as_ref().map_or(&rgbd, |stored| stored);
        let (as_is, seconds) = measure(&room, masks, settings, *misses);
        instances.add_row(row(name, masks.name(), "as is", &as_is, seconds));
        if options.losses {
            let steps = measure_losses(&room, masks, settings);
            add_losses(&mut losses, name, masks, &steps);
            if *misses {
                println!("{}", list_lost_objects(&room, &steps));
            }
        }
        let mut runs = vec![(as_is, seconds)];
        runs.extend((0..FIFTHS).map(|fifth| {
            let mut fewer = room.clone();
            let mut at = 0..;
            fewer.bundle.frames.retain(|_| at.next().is_some_and(|i: usize| i % FIFTHS != fifth));
            measure(&fewer, masks, settings, false)
        }));
        instances.add_row(mean_and_range(name, masks.name(), "six runs", &runs));
    }
    println!("{instances}");
    if options.losses {
        println!("\n{losses}");
    }
}

/// Returns the folder for the masks of a room: another one for other settings, models or scans.
fn masks_folder(source: &SamMasks, rooms: &Utf8Path, room: &str) -> Utf8PathBuf {
    let mut hasher = DefaultHasher::new();
    serde_json::to_string(&(source.settings, source.segments)).unwrap().hash(&mut hasher);
    std::fs::canonicalize(rooms).unwrap().hash(&mut hasher);
    format!("{MASKS}/{}-{room}-{:016x}", source.name(), hasher.finish()).into()
}

/// Returns the first segmenter in a folder of models, with its label.
fn load_segmenter(models: &Utf8Path) -> (EncodedFrames, String) {
    let mut config = ModelsConfig::builtin();
    config.masks = AUTO.into();
    config.bundles.models = models.to_owned();
    let mut models = config.load().unwrap().models;
    let label = models.label(Role::Masks).unwrap();
    (EncodedFrames::new(models.segmenters.remove(0), None, 0).unwrap(), label)
}

fn losses_table() -> Table {
    table(&["room", "masks", "step", "pieces", "box .25", "box .5", "points .25", "points .5"])
}

fn measure_losses(
    room: &AnnotatedRoom,
    masks: &dyn MaskSource,
    settings: &ParsingSettings,
) -> Vec<StageLoss> {
    stage_losses::measure_stage_losses(room, masks, settings, MIN_POINTS).unwrap()
}

fn add_losses(table: &mut Table, name: &str, masks: &dyn MaskSource, steps: &[StageLoss]) {
    for step in steps {
        let (boxes, points) = step.recall();
        let figures = boxes.iter().chain(&points).map(|share| format!("{share:.3}"));
        let head =
            [name.to_owned(), masks.name().to_owned(), step.step.clone(), step.pieces.to_string()];
        table.add_row(head.into_iter().chain(figures));
    }
}

/// Returns the objects without a box of IoU 0.5 at the end: the IoU of their boxes, with the
/// annotated points and at the end, then that of their points after each step.
fn list_lost_objects(room: &AnnotatedRoom, steps: &[StageLoss]) -> Table {
    let end = steps.iter().position(|step| step.step == stage_losses::END).unwrap();
    let head = ["object", "points", "box: cloud", "box: end"].into_iter();
    let head: Vec<&str> = head.chain(steps[1..=end].iter().map(|s| s.step.as_str())).collect();
    let mut lost = table(&head);
    for (i, object) in room.objects(MIN_POINTS).iter().enumerate() {
        let boxes = [steps[0].box_iou[i], steps[end].box_iou[i]];
        if boxes[1] < 0.5 {
            let figures = boxes.into_iter().chain(steps[1..=end].iter().map(|s| s.point_iou[i]));
            let figures = figures.map(|iou| format!("{iou:.2}"));
            let points = room.truth.iter().filter(|id| **id == object.id).count();
            lost.add_row([object.name.clone(), points.to_string()].into_iter().chain(figures));
        }
    }
    lost
}

fn run_full(rooms: &[String], Options { folder, settings, misses, .. }: &Options) {
    let mut superpoint_table =
        table(&["room", "points", "superpoints", "purity", "achievable mIoU"]);
    let mut instance_table = instance_table();
    let mut losses_table = losses_table();
    let mut structure_table = table(&["room", "masks", "recall", "precision"]);
    let mut naming_table =
        table(&["room", "boxes: first name", "in five", "instances: first name", "in five"]);
    for name in rooms {
        let temporary = tempfile::tempdir().unwrap();
        let room =
            AnnotatedRoom::load(folder, name, Utf8Path::from_path(temporary.path()).unwrap())
                .unwrap();
        let found =
            superpoints::compute(&room.bundle.cloud, &settings.superpoints, &Progress::silent())
                .unwrap();
        let cut = score_superpoints(&found.of_point, &room.truth);
        superpoint_table.add_row([
            name.to_owned(),
            room.truth.len().to_string(),
            cut.superpoints.to_string(),
            format!("{:.3}", cut.purity),
            format!("{:.3}", cut.achievable_iou),
        ]);
        let rgbd = RgbdMasks { settings: settings.rgbd_masks };
        let runs: Vec<_> = TURNS_DEG
            .iter()
            .map(|&deg| measure(&room.rotated(deg), &rgbd, settings, false))
            .collect();
        let parsed = parse(&room, &rgbd, settings);
        let structure = score_structure(
            &parsed.instances,
            &parsed.instance_of_point,
            &room.structures(),
            &room.truth,
        );
        structure_table.add_row([
            name.clone(),
            rgbd.name().to_owned(),
            format!("{:.3}", structure.recall),
            format!("{:.3}", structure.precision),
        ]);
        let (as_is, seconds) = score(&room, &parsed, rgbd.name(), *misses);
        instance_table.add_row(row(name, rgbd.name(), "as is", &as_is, seconds));
        instance_table.add_row(mean_and_range(name, rgbd.name(), "6 turns", &runs));
        naming_table.add_row(score_names(folder, &room, name, settings));
        let annotated = room.masks();
        let (score, seconds) = measure(&room, &annotated, settings, *misses);
        instance_table.add_row(row(name, annotated.name(), "as is", &score, seconds));
        for masks in [&rgbd as &dyn MaskSource, &annotated] {
            let steps = measure_losses(&room, masks, settings);
            add_losses(&mut losses_table, name, masks, &steps);
        }
    }
    println!(
        "{superpoint_table}\n\n{instance_table}\n\n{structure_table}\n\n{losses_table}\n\n{naming_table}"
    );
}

/// Returns the names of the annotated rooms in a folder, sorted.
fn rooms(folder: &Utf8Path) -> Vec<String> {
    let entries = folder
        .read_dir_utf8()
        .map(|entries| entries.flatten().collect::<Vec<_>>())
        .unwrap_or_default();
    let zips = entries.iter().filter_map(|entry| entry.file_name().strip_suffix(".zip"));
    let mut names: Vec<String> = zips
        .filter(|name| Annotations::find_file(folder, name).is_some())
        .map(str::to_owned)
        .collect();
    names.sort_unstable();
    names
}

/// Returns the share of objects whose annotated name is the first, or among the stored ones, of the
/// encoder's names: on annotated boxes, and on instances that cover at least half of them.
fn score_names(
    folder: &Utf8Path,
    room: &AnnotatedRoom,
    name: &str,
    settings: &ParsingSettings,
) -> Vec<String> {
    let (annotations, _) = Annotations::read(&Annotations::find_file(folder, name).unwrap());
    let rgbd = RgbdMasks { settings: settings.rgbd_masks };
    let parsed = parse(room, &rgbd, settings);
    let known = |name: &str| Lexicon::get().find(name).map(|noun| noun.name.clone());
    let objects = || {
        annotations.objects.iter().filter(|o| o.structure().is_none() && known(&o.name).is_some())
    };
    let boxed = instances_of(&annotations, &room.bundle.cloud, NamedBy::Encoder);
    let covering = |object: &SceneObject| {
        parsed
            .instances
            .iter()
            .max_by(|a, b| a.aabb.iou(&object.aabb).total_cmp(&b.aabb.iou(&object.aabb)))
    };
    let on_boxes: Vec<_> =
        objects().map(|o| (o, boxed.iter().find(|i| i.aabb == o.aabb).unwrap())).collect();
    let on_parsed: Vec<_> = objects()
        .map(|o| (o, covering(o).unwrap()))
        .filter(|(o, i)| i.aabb.iou(&o.aabb) >= 0.5)
        .collect();
    let share = |pairs: &[(&SceneObject, &Instance)], kept: usize| {
        let named = |(o, i): &&(&SceneObject, &Instance)| {
            i.names.iter().take(kept).any(|guess| Some(&guess.name) == known(&o.name).as_ref())
        };
        format!(
            "{:.2} of {}",
            pairs.iter().filter(named).count() as f32 / pairs.len() as f32,
            pairs.len()
        )
    };
    vec![
        name.to_owned(),
        share(&on_boxes, 1),
        share(&on_boxes, 5),
        share(&on_parsed, 1),
        share(&on_parsed, 5),
    ]
}

fn table(header: &[&str]) -> Table {
    let mut table = Table::new();
    table.load_preset(presets::ASCII_MARKDOWN).set_header(header);
    table
}

fn parse(room: &AnnotatedRoom, masks: &dyn MaskSource, settings: &ParsingSettings) -> ParsedScene {
    parsing::parse(
        room.bundle.clone(),
        &Perception::with_masks(masks),
        settings,
        &Checkpoints::disabled(),
        &Progress::silent(),
    )
    .unwrap()
}

fn measure(
    room: &AnnotatedRoom,
    masks: &dyn MaskSource,
    settings: &ParsingSettings,
    misses: bool,
) -> (InstanceScore, f32) {
    score(room, &parse(room, masks, settings), masks.name(), misses)
}

fn score(
    room: &AnnotatedRoom,
    parsed: &ParsedScene,
    masks: &str,
    misses: bool,
) -> (InstanceScore, f32) {
    let objects = room.objects(MIN_POINTS);
    let score =
        score_instances(&parsed.instances, &parsed.instance_of_point, &objects, &room.truth);
    for (i, object) in objects.iter().enumerate().filter(|(i, _)| misses && score.box_iou[*i] < 0.5)
    {
        println!(
            "{} {:>3} {:<18} box {:.2} points {:.2}",
            masks, object.id, object.name, score.box_iou[i], score.point_iou[i]
        );
    }
    (score, parsed.report.stages.iter().map(|s| s.seconds).sum())
}

fn instance_table() -> Table {
    table(&[
        "room",
        "masks",
        "turned",
        "instances",
        "box .25",
        "box .5",
        "points .25",
        "points .5",
        "AP50",
        "mean box",
        "points",
        "reached .25",
        ".5",
        "mean",
        "seconds",
    ])
}

fn figures(score: &InstanceScore) -> [f32; 10] {
    let ([box_25, box_50], [point_25, point_50]) = (score.box_recall(), score.point_recall());
    let [reached_25, reached_50] = score.reachable_recall();
    let mean = |iou: &[f32]| iou.iter().sum::<f32>() / iou.len().max(1) as f32;
    let [boxes, points, reached] =
        [&score.box_iou, &score.point_iou, &score.reachable_box_iou].map(|iou| mean(iou));
    [box_25, box_50, point_25, point_50, score.ap50, boxes, points, reached_25, reached_50, reached]
}

fn row(room: &str, masks: &str, turned: &str, score: &InstanceScore, seconds: f32) -> Vec<String> {
    let head = [room.to_owned(), masks.to_owned(), turned.to_owned(), score.instances.to_string()];
    head.into_iter()
        .chain(figures(score).map(|v| format!("{v:.3}")))
        .chain([format!("{seconds:.2}")])
        .collect()
}

fn mean_and_range(
    room: &str,
    masks: &str,
    turned: &str,
    runs: &[(InstanceScore, f32)],
) -> Vec<String> {
    let n = runs.len() as f32;
    let figure = |i: usize| {
        let values: Vec<f32> = runs.iter().map(|(score, _)| figures(score)[i]).collect();
        let (lo, hi) =
            values.iter().fold((f32::INFINITY, 0.0_f32), |(lo, hi), v| (lo.min(*v), hi.max(*v)));
        format!("{:.3} ({lo:.2}-{hi:.2})", values.iter().sum::<f32>() / n)
    };
    let instances = runs.iter().map(|(score, _)| score.instances).sum::<usize>() / runs.len();
    let seconds = runs.iter().map(|(_, s)| s).sum::<f32>() / n;
    let head = [room.to_owned(), masks.to_owned(), turned.to_owned(), instances.to_string()];
    head.into_iter().chain((0..10).map(figure)).chain([format!("{seconds:.2}")]).collect()
}
