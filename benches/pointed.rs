//! Objects segmented from a point, or from their box, in a photograph: `make bench-pointed`, or
//! `cargo bench --bench pointed -- [--all] [--models DIR] [FOLDER]`.
//!
//! For every annotated object that no instance of any level covers (box IoU below .25), or for all
//! of them, a point is taken in the middle of the photograph that shows most of it. The box is that
//! of its pixels there, with each side off by a tenth. The segmented instance is compared with the
//! annotated box, for the built-in masks and for the first segmenter among the models. So is what
//! replaces the instance that covers the object best, if anything fits the box better. If there
//! is an encoder, the bench also prints how often the two photographs chosen for the object's name
//! show the object, compared with two random ones.

#![allow(missing_docs, clippy::unwrap_used)] // a bench that can not set up has nothing to measure

use camino::{Utf8Path, Utf8PathBuf};
use comfy_table::{Table, presets};
use std::time::Instant;
use uniground::config::{AUTO, ModelsConfig};
use uniground_core::geometry::boxes::Aabb;
use uniground_core::parsing::checkpoints::Checkpoints;
use uniground_core::parsing::masks::rgbd::RgbdMasks;
use uniground_core::parsing::masks::{IdImage, MaskSource};
use uniground_core::parsing::model_clock::PictureEncoder;
use uniground_core::parsing::pointed::{
    PhotographPoint, PixelArea, PointedObjectFinder, find_identical,
};
use uniground_core::parsing::{self, ParsingSettings, Perception, frame_appearance};
use uniground_core::progress::Progress;
use uniground_core::scene::{Frame, FrameIndex, Instance};
use uniground_evaluation::annotated::{AnnotatedMasks, AnnotatedRoom};
use uniground_evaluation::annotations::Annotations;

/// Objects with fewer points are ignored, as in the bench of stage 1.
const MIN_POINTS: u32 = 200;
const COVERED: f32 = 0.25;

fn main() {
    let mut folder = Utf8PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("../shared/scenes");
    let mut models = ModelsConfig::builtin();
    let mut least_covered = COVERED;
    let mut args = std::env::args().skip(1).filter(|a| a != "--bench");
    while let Some(arg) = args.next() {
        match arg.as_str() {
            "--models" => {
                models.masks = AUTO.into();
                models.encoder = AUTO.into();
                models.bundles.models = args.next().unwrap().into();
            }
            "--all" => least_covered = f32::INFINITY,
            other => folder = other.into(),
        }
    }
    let loaded = models.load().unwrap().models;
    let mut table = Table::new();
    table.load_preset(presets::ASCII_MARKDOWN);
    table.set_header([
        "room",
        "object",
        "best instance",
        "built-in masks, point",
        "box",
        "segmenter, point",
        "box",
        "an instance already",
        "built-in masks, replaced by box",
        "segmenter, replaced by box",
        "seconds",
    ]);
    let mut replaced = [[0; 2]; 3];
    let (mut missed, mut found, mut offered) = (0, [[0; 2]; 4], PhotographChoice::default());
    for name in room_names(&folder) {
        let scratch = tempfile::tempdir().unwrap();
        let room =
            AnnotatedRoom::load(&folder, &name, Utf8Path::from_path(scratch.path()).unwrap())
                .unwrap();
        let settings = ParsingSettings::default();
        let rgbd = RgbdMasks { settings: settings.rgbd_masks };
        let perception = Perception::with_masks(&rgbd);
        let parsed = parsing::parse(
            room.bundle.clone(),
            &perception,
            &settings,
            &Checkpoints::disabled(),
            &Progress::silent(),
        )
        .unwrap();
        let covered =
            |aabb: &Aabb| parsed.instances.iter().map(|i| i.aabb.iou(aabb)).fold(0.0, f32::max);
        let objects: Vec<_> = room
            .objects(MIN_POINTS)
            .into_iter()
            .filter(|o| covered(&o.aabb) < least_covered)
            .collect();
        let ids: Vec<u32> = objects.iter().map(|o| o.id).collect();
        let shown = ObjectViews::of(&room, &room.masks(), &ids);
        if let Some(encoder) = &loaded.encoder {
            let seen = frame_appearance::embed_frames(
                &room.bundle.frames,
                &PictureEncoder::new(encoder),
                &settings.appearance,
                &Progress::silent(),
            )
            .unwrap()
            .unwrap();
            for (object, at) in objects.iter().zip(0..).filter(|(_, at)| shown.best[*at].is_some())
            {
                let vector = encoder.embed_name(&object.name).unwrap().vector.unwrap();
                offered.count(&room, &shown, at, object.id, &seen.nearest(&vector, 2));
            }
        }
        for (object, place) in objects.iter().zip(&shown.best) {
            let Some(place) = *place else { continue };
            missed += 1;
            let start = Instant::now();
            let (cloud, frames) = (&parsed.cloud, &room.bundle.frames[..]);
            let built_in =
                PointedObjectFinder { cloud, frames, segmenter: None, settings: &settings };
            let by_segmenter = loaded
                .segmenters
                .first()
                .map(|segmenter| PointedObjectFinder { segmenter: Some(segmenter), ..built_in });
            let find = |finder: &PointedObjectFinder, place: PhotographPoint| {
                finder.find_at(place, &parsed.instances, &[]).unwrap()
            };
            let iou = |found: &Option<Instance>| {
                found.as_ref().map_or(0.0, |found| found.aabb.iou(&object.aabb))
            };
            let only_point = PhotographPoint { area: None, ..place };
            let (ours, by_box) = (find(&built_in, only_point), find(&built_in, place));
            let theirs = by_segmenter
                .as_ref()
                .map(|finder| [only_point, place].map(|place| iou(&find(finder, place))));
            let [by_point, of_box] = theirs.unwrap_or_default();
            let ious = [iou(&ours), iou(&by_box), by_point, of_box];
            for (found, iou) in found.iter_mut().zip(ious) {
                found[0] += u32::from(iou >= COVERED);
                found[1] += u32::from(iou >= 0.5);
            }
            eprintln!("{name} {}: {ious:.2?}", object.name);
            let known = ours
                .as_ref()
                .and_then(|ours| find_identical(&parsed.instances, ours))
                .map_or("", |_| "yes");
            let may_be_taken = |i: &&Instance| i.structure.is_none() && !i.dismissed;
            let covers = |i: &Instance| i.aabb.iou(&object.aabb);
            let taken = parsed.instances.iter().filter(may_be_taken);
            let taken = taken.max_by(|a, b| covers(a).total_cmp(&covers(b))).unwrap();
            let after = |finder: &PointedObjectFinder| {
                let better = finder.find_better(place, &parsed.instances, taken.id);
                better.unwrap().map_or(covers(taken), |better| covers(&better))
            };
            let replaced_by_segmenter = by_segmenter.as_ref().map(after);
            let after =
                [covers(taken), after(&built_in), replaced_by_segmenter.unwrap_or_default()];
            for (replaced, iou) in replaced.iter_mut().zip(after) {
                replaced[0] += u32::from(iou >= COVERED);
                replaced[1] += u32::from(iou >= 0.5);
            }
            table.add_row([
                name.clone(),
                object.name.clone(),
                format!("{:.2}", covered(&object.aabb)),
                format!("{:.2}", ious[0]),
                format!("{:.2}", ious[1]),
                theirs.map_or_else(|| "-".to_owned(), |_| format!("{:.2}", ious[2])),
                theirs.map_or_else(|| "-".to_owned(), |_| format!("{:.2}", ious[3])),
                known.to_owned(),
                format!("{:.2}", after[1]),
                replaced_by_segmenter.map_or_else(|| "-".to_owned(), |iou| format!("{iou:.2}")),
                format!("{:.1}", start.elapsed().as_secs_f32()),
            ]);
        }
    }
    println!(
        "{table}\n\nof {missed}, at IoU {COVERED} and .5: built-in masks by point {:?}, by box {:?}; segmenter by point {:?}, by box {:?}",
        found[0], found[1], found[2], found[3]
    );
    println!(
        "best instance at IoU {COVERED} and .5: {:?}; replaced by what fits the box better: built-in masks {:?}, segmenter {:?}",
        replaced[0], replaced[1], replaced[2]
    );
    if loaded.encoder.is_some() {
        println!("{offered}");
    }
}

/// Where objects appear in photographs.
struct ObjectViews {
    /// For each object its center in the photograph that shows most of it.
    best: Vec<Option<PhotographPoint>>,
    /// For each object the share of photographs that show it.
    share: Vec<f64>,
}

/// Pixels of a depth image that an object needs to count as visible.
const SEEN_PX: usize = 100;

impl ObjectViews {
    fn of(room: &AnnotatedRoom, masks: &AnnotatedMasks, ids: &[u32]) -> Self {
        /// Number of frames to check, spread over all, because looking up pixels in the annotations
        /// is slow.
        const FRAMES: usize = 15;
        let mut best: Vec<(usize, Option<PhotographPoint>)> = vec![(0, None); ids.len()];
        let (mut showing, mut looked) = (vec![0_u32; ids.len()], 0_u32);
        for frame in room.bundle.frames.iter().step_by(room.bundle.frames.len().div_ceil(FRAMES)) {
            let decoded = frame.decode().unwrap();
            let image = masks.masks(&decoded, &Progress::silent()).unwrap().remove(0);
            looked += 1;
            for ((id, best), showing) in ids.iter().zip(&mut best).zip(&mut showing) {
                let pixels = pixels_of(&image, *id);
                *showing += u32::from(pixels >= SEEN_PX);
                if pixels > best.0 {
                    let (u, v) = innermost_pixel(&image, *id as u16);
                    *best = (
                        pixels,
                        Some(PhotographPoint {
                            frame: frame.index,
                            at: decoded.color_position(u as f32, v as f32),
                            area: Some(inaccurate_area(&decoded, &image, *id as u16)),
                        }),
                    );
                }
            }
        }
        let share = showing
            .into_iter()
            .map(|showing| f64::from(showing) / f64::from(looked.max(1)))
            .collect();
        Self { best: best.into_iter().map(|(_, place)| place).collect(), share }
    }
}

/// Returns the box of a mask's pixels, with each side off by a tenth of its width or height, inwards
/// or outwards in turn.
fn inaccurate_area(frame: &Frame, image: &IdImage, id: u16) -> PixelArea {
    let (mut low, mut high) = ([u32::MAX; 2], [0; 2]);
    for (u, v) in (0..image.height).flat_map(|v| (0..image.width).map(move |u| (u, v))) {
        if image.at((u, v)) == id {
            low = [low[0].min(u), low[1].min(v)];
            high = [high[0].max(u), high[1].max(v)];
        }
    }
    let at = |[u, v]: [u32; 2]| frame.color_position(u as f32, v as f32);
    let ((left, top), (right, bottom)) = (at(low), at(high));
    let (x, y) = ((right - left) / 10.0, (bottom - top) / 10.0);
    let off = |bit: u16| if id >> bit & 1 == 0 { 1.0 } else { -1.0 };
    PixelArea {
        left: left + off(0) * x,
        top: top + off(1) * y,
        right: right + off(2) * x,
        bottom: bottom + off(1) * y,
    }
}

fn pixels_of(image: &IdImage, id: u32) -> usize {
    image.ids.iter().filter(|of| u32::from(**of) == id).count()
}

/// Returns how often the chosen photographs show the object.
#[derive(Default)]
struct PhotographChoice {
    asked: u32,
    shown: u32,
    by_chance: f64,
}

impl PhotographChoice {
    fn count(
        &mut self,
        room: &AnnotatedRoom,
        shown: &ObjectViews,
        at: usize,
        id: u32,
        offered: &[FrameIndex],
    ) {
        let shows = |index: &FrameIndex| {
            let frame = room.bundle.frames.iter().find(|frame| frame.index == *index).unwrap();
            let image = room
                .masks()
                .masks(&frame.decode().unwrap(), &Progress::silent())
                .unwrap()
                .remove(0);
            pixels_of(&image, id) >= SEEN_PX
        };
        self.asked += 1;
        self.shown += u32::from(offered.iter().any(shows));
        self.by_chance += 1.0 - (1.0 - shown.share[at]).powi(2);
    }
}

impl std::fmt::Display for PhotographChoice {
    fn fmt(&self, out: &mut std::fmt::Formatter) -> std::fmt::Result {
        let Self { asked, shown, by_chance } = self;
        write!(
            out,
            "of {asked} missed that a photograph shows, {shown} are in the two photographs offered for their names; by chance {by_chance:.1}"
        )
    }
}

/// Returns the pixel of a mask that is farthest from its border, by repeated erosion.
fn innermost_pixel(image: &IdImage, id: u16) -> (u32, u32) {
    let mut left: Vec<(u32, u32)> = (0..image.height)
        .flat_map(|v| (0..image.width).map(move |u| (u, v)))
        .filter(|&at| image.at(at) == id)
        .collect();
    loop {
        let inside: std::collections::HashSet<(u32, u32)> = left.iter().copied().collect();
        let is_inner = |&&(u, v): &&(u32, u32)| {
            u > 0
                && v > 0
                && [(u - 1, v), (u + 1, v), (u, v - 1), (u, v + 1)]
                    .iter()
                    .all(|near| inside.contains(near))
        };
        let inner: Vec<(u32, u32)> = left.iter().filter(is_inner).copied().collect();
        if inner.is_empty() {
            return left[left.len() / 2];
        }
        left = inner;
    }
}

/// Returns the names of the annotated rooms in a folder, sorted.
fn room_names(folder: &Utf8Path) -> Vec<String> {
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
