//! Stage 1 against annotated rooms (figures are printed), and its behavior on cancelled, rotated or
//! unusual scans.

use crate::shared_scenes::shared_scene;
use crate::test_scans::Scan;
use camino::Utf8Path;
use std::sync::atomic::{AtomicUsize, Ordering};
use tokio_util::sync::CancellationToken;
use uniground_core::geometry::Point3;
use uniground_core::ingest;
use uniground_core::ingest::archive::{ArchiveKind, UnpackLimits, unpack};
use uniground_core::parsing::checkpoints::Checkpoints;
use uniground_core::parsing::masks::rgbd::RgbdMasks;
use uniground_core::parsing::masks::{IdImage, MaskSource};
use uniground_core::parsing::pointed::{PhotographPoint, PointedObjectFinder};
use uniground_core::parsing::{self, ParseError, ParsingSettings, Perception, superpoints};
use uniground_core::progress::Progress;
use uniground_core::scene::{
    Frame, FrameIndex, ImportReport, Instance, Level, ParsedScene, PointCloud, PoseConvention,
    SceneBundle, Structure,
};
use uniground_evaluation::annotated::AnnotatedRoom;
use uniground_evaluation::segmentation::{InstanceScore, score_instances, score_superpoints};
use uniground_types::settings::ImportSettings;

/// Objects with fewer points do not count for recall.
const MIN_POINTS: u32 = 200;

/// Loads an annotated room and runs `test` on it. Prints a line if the rooms are missing.
fn with_room(name: &str, test: impl FnOnce(AnnotatedRoom)) {
    let Some(folder) = shared_scene(&format!("{name}.zip")) else { return };
    let scratch = tempfile::tempdir().unwrap();
    test(AnnotatedRoom::load(&folder, name, Utf8Path::from_path(scratch.path()).unwrap()).unwrap());
}

/// Returns the default settings, with all frames: the masks of these tests cost nothing.
fn all_frames() -> ParsingSettings {
    let mut settings = ParsingSettings::default();
    settings.frame_sampling.views_per_part = None;
    settings
}

fn parse(bundle: SceneBundle, masks: &dyn MaskSource) -> ParsedScene {
    parsing::parse(
        bundle,
        &Perception::with_masks(masks),
        &all_frames(),
        &Checkpoints::disabled(),
        &Progress::silent(),
    )
    .unwrap()
}

fn score(room: &AnnotatedRoom, masks: &dyn MaskSource) -> InstanceScore {
    let parsed = parse(room.bundle.clone(), masks);
    score_instances(
        &parsed.instances,
        &parsed.instance_of_point,
        &room.objects(MIN_POINTS),
        &room.truth,
    )
}

fn print_score(what: &str, score: &InstanceScore) {
    let ([box_25, box_50], [point_25, point_50]) = (score.box_recall(), score.point_recall());
    println!(
        "{what}: {} instances, box recall {box_25:.3} / {box_50:.3}, point recall {point_25:.3} / {point_50:.3}, AP50 {:.3} over {} objects",
        score.instances, score.ap50, score.objects
    );
}

#[test]
fn superpoints_respect_objects() {
    with_room("room1", |room| {
        let found = superpoints::compute(
            &room.bundle.cloud,
            &ParsingSettings::default().superpoints,
            &Progress::silent(),
        )
        .unwrap();
        let score = score_superpoints(&found.of_point, &room.truth);
        println!("room1: {score:?}");
        // For comparison, PCL's VCCS at 0.05 / 0.2 reaches 0.970 and 0.871; at 0.02 / 0.2, in six
        // times the time, 0.988 and 0.947.
        assert!(score.purity >= 0.98 && score.achievable_iou >= 0.93, "{score:?}");
    });
}

/// Thresholds slightly below the measured figures (benches/README.md); the targets are .72 / .45 on
/// room1 and .62 / .32 on room2.
#[test]
fn instances_without_a_model_cover_the_annotated_objects() {
    for (name, floors) in [("room1", [0.83, 0.70]), ("room2", [0.79, 0.50])] {
        with_room(name, |room| {
            let score = score(&room, &RgbdMasks::default());
            print_score(name, &score);
            let recall = score.box_recall();
            assert!(recall[0] >= floors[0] && recall[1] >= floors[1], "{name}: {recall:?}");
        });
    }
}

/// With the annotated masks as input, only grouping and boxes can be wrong.
#[test]
fn annotated_masks_give_near_perfect_instances() {
    for (name, floors) in [("room1", [0.97, 0.86]), ("room2", [0.92, 0.75])] {
        with_room(name, |room| {
            let score = score(&room, &room.masks());
            print_score(&format!("{name}, annotated masks"), &score);
            let recall = score.box_recall();
            assert!(recall[0] >= floors[0] && recall[1] >= floors[1], "{name}: {recall:?}");
        });
    }
}

/// The order of the points does not change the result. A rotated world changes it only through
/// other voxel borders: by one or two objects of 37.
#[test]
fn rotation_and_point_order_do_not_change_the_result() {
    with_room("room1", |room| {
        let masks = RgbdMasks::default();
        let as_is = score(&room, &masks);
        print_score("as is", &as_is);
        for (what, other) in [
            ("shuffled", room.shuffled()),
            ("turned by 90", room.rotated(90.0)),
            ("turned by 33", room.rotated(33.0)),
        ] {
            let score = score(&other, &masks);
            print_score(what, &score);
            let differs = |a: [f32; 2], b: [f32; 2]| (a[0] - b[0]).abs().max((a[1] - b[1]).abs());
            let limit = if what == "shuffled" { 0.03 } else { 0.06 };
            assert!(differs(score.point_recall(), as_is.point_recall()) < limit, "{what}");
            assert!((score.box_recall()[0] - as_is.box_recall()[0]).abs() < limit, "{what}");
        }
    });
}

#[test]
fn floor_and_walls_are_structure_and_furniture_is_not() {
    for name in ["room1", "room2"] {
        with_room(name, |room| {
            let parsed = parse(room.bundle.clone(), &RgbdMasks::default());
            let has = |structure| parsed.instances.iter().any(|i| i.structure == Some(structure));
            assert!(has(Structure::Floor) && has(Structure::Wall), "{name}");
            for object in room.objects(1000) {
                let best = parsed
                    .instances
                    .iter()
                    .max_by(|a, b| a.aabb.iou(&object.aabb).total_cmp(&b.aabb.iou(&object.aabb)))
                    .unwrap();
                let wrong = best.aabb.iou(&object.aabb) > 0.5 && best.structure.is_some();
                let part_of_a_wall = ["door", "window", "curtain", "rug", "picture", "whiteboard"]
                    .contains(&object.name.as_str());
                assert!(
                    !wrong || part_of_a_wall,
                    "{name}: the {} is classified as {:?}",
                    object.name,
                    best.structure
                );
            }
        });
    }
}

/// Counts frames and cancels after a number of them.
struct CountingMasks {
    frames: AtomicUsize,
    stop_after: usize,
    stop: CancellationToken,
}

impl CountingMasks {
    fn new(stop_after: usize, stop: CancellationToken) -> Self {
        Self { frames: AtomicUsize::new(0), stop_after, stop }
    }

    fn seen(&self) -> usize {
        self.frames.load(Ordering::SeqCst)
    }
}

impl MaskSource for CountingMasks {
    fn name(&self) -> &'static str {
        "watched"
    }

    fn masks(&self, frame: &Frame, progress: &Progress) -> Result<Vec<IdImage>, ParseError> {
        if self.frames.fetch_add(1, Ordering::SeqCst) + 1 == self.stop_after {
            self.stop.cancel();
        }
        RgbdMasks::default().masks(frame, progress)
    }
}

fn sample_scan(folder: &Utf8Path) -> SceneBundle {
    let archive = Utf8Path::new(env!("CARGO_MANIFEST_DIR")).join("examples/living_room.zip");
    unpack(&archive, ArchiveKind::Zip, folder, &UnpackLimits::default()).unwrap();
    ingest::load(&ingest::open(folder).unwrap(), &ImportSettings::default(), &Progress::silent())
        .unwrap()
}

#[test]
fn a_cancelled_parse_resumes_where_it_stopped() {
    let (scan, kept) = (tempfile::tempdir().unwrap(), tempfile::tempdir().unwrap());
    let bundle = sample_scan(Utf8Path::from_path(scan.path()).unwrap());
    let checkpoints =
        Checkpoints::in_folder(Utf8Path::from_path(kept.path()).unwrap(), "the sample");
    let settings = all_frames();
    let run = |watched: &CountingMasks, settings: &ParsingSettings| {
        let stop = watched.stop.clone();
        let progress = Progress::new(|_, _| {}, move || stop.is_cancelled());
        parsing::parse(
            bundle.clone(),
            &Perception::with_masks(watched),
            settings,
            &checkpoints,
            &progress,
        )
    };
    let reused = |parsed: &ParsedScene| {
        parsed
            .report
            .stages
            .iter()
            .filter(|s| s.reused)
            .map(|s| s.stage.clone())
            .collect::<Vec<_>>()
    };

    let stopped = CountingMasks::new(9, CancellationToken::new());
    assert!(matches!(run(&stopped, &settings), Err(ParseError::Cancelled(_))));
    assert!((9..bundle.frames.len()).contains(&stopped.seen()), "{} frames", stopped.seen());

    let resumed = CountingMasks::new(usize::MAX, CancellationToken::new());
    let parsed = run(&resumed, &settings).unwrap();
    assert_eq!(reused(&parsed), ["superpoints"]);
    assert!(
        resumed.seen() < bundle.frames.len()
            && resumed.seen() + stopped.seen() >= bundle.frames.len(),
        "{} frames",
        resumed.seen()
    );

    let never_stopped =
        parse(bundle.clone(), &CountingMasks::new(usize::MAX, CancellationToken::new()));
    assert_eq!(parsed.instances, never_stopped.instances, "a resumed parse finds other instances");
    assert_eq!(parsed.instance_of_point, never_stopped.instance_of_point);

    // Other merge settings, same masks: no frame is segmented again.
    let again = CountingMasks::new(usize::MAX, CancellationToken::new());
    let mut literal = settings;
    literal.merging.thresholds = vec![0.95, 0.9];
    let parsed = run(&again, &literal).unwrap();
    assert_eq!(
        (again.seen(), reused(&parsed)),
        (0, vec!["superpoints".to_owned(), "masks_and_lifting".to_owned()])
    );
    assert_ne!(parsed.instances.len(), never_stopped.instances.len());
}

/// Saved masks are never used for another frame, whatever happened to the log.
#[test]
fn saved_frames_of_another_scan_are_not_reused() {
    let (scan, kept) = (tempfile::tempdir().unwrap(), tempfile::tempdir().unwrap());
    let mut bundle = sample_scan(Utf8Path::from_path(scan.path()).unwrap());
    let checkpoints =
        Checkpoints::in_folder(Utf8Path::from_path(kept.path()).unwrap(), "the sample");
    let frames_segmented = |bundle: &SceneBundle| {
        let watched = CountingMasks::new(usize::MAX, CancellationToken::new());
        parsing::parse(
            bundle.clone(),
            &Perception::with_masks(&watched),
            &all_frames(),
            &checkpoints,
            &Progress::silent(),
        )
        .unwrap();
        watched.seen()
    };
    let all = bundle.frames.len();
    assert_eq!((frames_segmented(&bundle), frames_segmented(&bundle)), (all, 0));
    bundle.frames.remove(10);
    assert_eq!(frames_segmented(&bundle), all - 11, "ten saved frames are reused");
    assert_eq!(frames_segmented(&bundle), 0, "mismatched frames are replaced");
}

fn cloud_only_bundle(positions: Vec<Point3<f32>>) -> SceneBundle {
    let report = ImportReport {
        format: "test".into(),
        up: uniground_core::geometry::up_axis::UpAxis::Z,
        source_to_scene: None,
        levelling: None,
        pose: PoseConvention::CameraToWorld,
        camera_axes: "opencv".into(),
        frames: 0,
        frames_skipped: 0,
        cloud_points: None,
        reprojection_agreement: None,
        viewing_distance_m: None,
        findings: vec![],
        warnings: Vec::new(),
    };
    let colors = positions.iter().map(|p| [(p.x * 40.0) as u8, 90, 120]).collect();
    SceneBundle {
        cloud: PointCloud { positions, colors },
        frames: Vec::new(),
        report,
        additions: Vec::new(),
    }
}

#[test]
fn degenerate_clouds_become_instances_or_a_clear_error() {
    // Pseudo-random numbers that are the same in every run.
    let hash = |i: u32, k: u32| {
        let mixed = (u64::from(i) << 2 | u64::from(k)).wrapping_mul(0x9e37_79b9_7f4a_7c15);
        let mixed = (mixed ^ mixed >> 29).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        (mixed >> 40) as f32 / (1_u32 << 24) as f32
    };
    let cases: Vec<(&str, Vec<Point3<f32>>)> = vec![
        ("one point", vec![Point3::new(1.0, 2.0, 3.0)]),
        ("one place", vec![Point3::new(1.0, 2.0, 3.0); 5000]),
        ("a line", (0..5000).map(|i| Point3::new(i as f32 * 0.001, 0.0, 0.0)).collect()),
        (
            "a plane",
            (0..40_000)
                .map(|i| Point3::new((i % 200) as f32 * 0.01, (i / 200) as f32 * 0.01, 0.0))
                .collect(),
        ),
        // Every point is near every other: the parse must not connect every pair of superpoints.
        (
            "a cloud of noise",
            (0..200_000)
                .map(|i| Point3::new(hash(i, 1) * 6.0, hash(i, 2) * 5.0, hash(i, 3) * 2.5))
                .collect(),
        ),
        (
            "far apart",
            (0..500).map(|i| Point3::new(hash(i, 1), hash(i, 2), hash(i, 3)) * 9000.0).collect(),
        ),
    ];
    for (what, positions) in cases {
        let points = positions.len();
        let parsed = parse(cloud_only_bundle(positions), &RgbdMasks::default());
        assert!(!parsed.instances.is_empty() && parsed.instance_of_point.len() == points, "{what}");
        assert_eq!(
            parsed.instances.iter().map(|i| i.point_count as usize).sum::<usize>(),
            points,
            "{what}"
        );
        assert!(
            parsed.instances.iter().all(|i| i.aabb.size.iter().all(|s| s.is_finite() && *s >= 0.0)),
            "{what}"
        );
        assert!(parsed.report.warnings.iter().any(|w| w.contains("no frames")), "{what}");
        println!(
            "{what}: {} superpoints, {} instances",
            parsed.report.superpoints, parsed.report.instances
        );
    }
    let nothing = parsing::parse(
        cloud_only_bundle(Vec::new()),
        &Perception::with_masks(&RgbdMasks::default()),
        &ParsingSettings::default(),
        &Checkpoints::disabled(),
        &Progress::silent(),
    );
    assert!(matches!(nothing, Err(ParseError::NoPoints)));
}

/// Frames that look away: the parse succeeds with a warning that names them.
#[test]
fn frames_that_see_no_points_are_reported() {
    let folder = tempfile::tempdir().unwrap();
    let path = Utf8Path::from_path(folder.path()).unwrap();
    let archive = path.join("scan.zip");
    std::fs::write(&archive, Scan::frames_only().zip()).unwrap();
    let content = path.join("content");
    std::fs::create_dir(&content).unwrap();
    unpack(&archive, ArchiveKind::Zip, &content, &UnpackLimits::default()).unwrap();
    let mut bundle = ingest::load(
        &ingest::open(&content).unwrap(),
        &ImportSettings::default(),
        &Progress::silent(),
    )
    .unwrap();
    let blind = bundle.frames.len() - 1;
    bundle.frames[blind].camera_to_world.translation.vector.x += 500.0;
    let number = bundle.frames[blind].index;
    let parsed = parse(bundle, &RgbdMasks::default());
    assert!(
        parsed
            .report
            .warnings
            .iter()
            .any(|w| w.ends_with(&format!("see no point of the cloud: {number}"))),
        "{:?}",
        parsed.report.warnings
    );
}

/// A scan of half the size from half the distance is segmented twice as fine: into the same
/// instances, of half the size.
#[test]
fn a_scan_from_close_by_is_segmented_like_a_room() {
    let scratch = tempfile::tempdir().unwrap();
    let room = sample_room(Utf8Path::from_path(scratch.path()).unwrap());
    let mut desk = room.clone();
    desk.report.viewing_distance_m = Some(1.0);
    desk.cloud.positions.iter_mut().for_each(|position| *position *= 0.5);
    for frame in &mut desk.frames {
        frame.camera_to_world.translation.vector *= 0.5;
        frame.depth_scale_m *= 0.5;
    }
    let small = desk.cloud.positions.clone();
    let (room, desk) = (parse(room, &RgbdMasks::default()), parse(desk, &RgbdMasks::default()));
    assert_eq!(desk.cloud.positions, small);
    assert_eq!(desk.extent.size * 2.0, room.extent.size);
    assert_eq!(desk.instance_of_point, room.instance_of_point);
    assert!(desk.instances.len() > 20 && desk.instances.len() == room.instances.len());
    for (half, whole) in desk.instances.iter().zip(&room.instances) {
        assert_eq!(
            (half.aabb.center * 2.0, half.aabb.size * 2.0),
            (whole.aabb.center, whole.aabb.size)
        );
        assert_eq!(half.views, whole.views);
    }
}

fn sample_room(folder: &Utf8Path) -> SceneBundle {
    let sample = Utf8Path::new(concat!(env!("CARGO_MANIFEST_DIR"), "/examples/living_room.zip"));
    unpack(sample, ArchiveKind::Zip, folder, &UnpackLimits::default()).unwrap();
    let scan = ingest::open(folder).unwrap();
    ingest::load(&scan, &ImportSettings::default(), &Progress::silent()).unwrap()
}

/// Instances that the built-in masks found are found again from a point on them, as if they had
/// been missed.
#[test]
fn an_instance_is_segmented_from_a_point() {
    let scratch = tempfile::tempdir().unwrap();
    let bundle = sample_room(Utf8Path::from_path(scratch.path()).unwrap());
    let settings = ParsingSettings::default();
    let parsed = parse(bundle.clone(), &RgbdMasks { settings: settings.rgbd_masks });
    let pointing = PointedObjectFinder {
        cloud: &parsed.cloud,
        frames: &bundle.frames,
        segmenter: None,
        settings: &settings,
    };
    let shown = |i: &&Instance| {
        i.level == Level::Thing
            && i.structure.is_none()
            && i.point_count >= 1000
            && !i.views.is_empty()
    };
    let (mut asked, mut found, mut found_by_box, mut itself) = (0, 0, 0, 0);
    for thing in parsed.instances.iter().filter(shown).take(20) {
        let [left, top, right, bottom] = thing.views[0].box_px;
        let place = PhotographPoint {
            frame: thing.views[0].frame,
            at: ((left + right) as f32 / 2.0, (top + bottom) as f32 / 2.0),
            area: None,
        };
        let known: Vec<Instance> =
            parsed.instances.iter().filter(|i| i.structure.is_some()).cloned().collect();
        let again = pointing.find_at(place, &known, &[]).unwrap();
        asked += 1;
        let is_it = |again: &Option<Instance>| {
            u32::from(again.as_ref().is_some_and(|again| again.aabb.iou(&thing.aabb) >= 0.25))
        };
        found += is_it(&again);
        let boxed = PhotographPoint { area: Some(thing.views[0].box_px.into()), ..place };
        found_by_box += is_it(&pointing.find_at(boxed, &known, &[]).unwrap());
        // A known instance that fills the box is returned itself.
        let known_too = pointing.find_at(boxed, &parsed.instances, &[]).unwrap();
        itself += u32::from(known_too.is_some_and(|found| found.id == thing.id));
        // The same point gives the same instance, with views that show it.
        if asked == 1 {
            assert_eq!(pointing.find_at(place, &known, &[]).unwrap(), again);
        }
        assert!(again.is_none_or(|again| again.id.0 as usize == known.len() + 1
            && again.point_count >= 20
            && !again.views.is_empty()));
    }
    println!(
        "of {asked} instances, {found} are segmented again from a point, {found_by_box} from a box; \
         {itself} known ones are recognized"
    );
    assert!(asked >= 10 && found * 2 >= asked, "{found} of {asked}");
    assert!(found_by_box >= found && found_by_box * 3 >= asked * 2, "{found_by_box} of {asked}");
    assert!(itself * 2 >= asked, "{itself} of {asked}");
    // A point outside of the room yields nothing.
    let nowhere = PhotographPoint { frame: FrameIndex(4711), at: (10.0, 10.0), area: None };
    assert_eq!(pointing.find_at(nowhere, &parsed.instances, &[]).unwrap(), None);
}
