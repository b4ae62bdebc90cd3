//! Objects that stage 1 misses, segmented from a point in a photograph: `make bench-pointed`, or
//! `cargo bench --bench pointed -- [--models DIR] [FOLDER]`.
//!
//! For every annotated object that no instance of any level covers (box IoU below .25), a point is
//! taken in the middle of the photograph that shows most of it. The segmented instance is compared
//! with the annotated box, for the built-in masks and for each segmenter among the models. If there
//! is an encoder, the bench also prints how often the two photographs chosen for the object's name
//! show the object, compared with two random ones.

#![allow(missing_docs, clippy::unwrap_used)] // a bench that can not set up has nothing to measure

use camino::{Utf8Path, Utf8PathBuf};
use comfy_table::{Table, presets};
use std::time::Instant;
use uniground::config::{AUTO, ModelsConfig};
use uniground_core::geometry::boxes::Aabb;
use uniground_core::models::neural::Segmenter;
use uniground_core::parsing::checkpoints::Checkpoints;
use uniground_core::parsing::masks::rgbd::RgbdMasks;
use uniground_core::parsing::masks::{IdImage, MaskSource};
use uniground_core::parsing::model_clock::PictureEncoder;
use uniground_core::parsing::pointed::{PhotographPoint, PointedObjectFinder, find_identical};
use uniground_core::parsing::{self, ParsingSettings, Perception, frame_appearance};
use uniground_core::progress::Progress;
use uniground_core::scene::{FrameIndex, Instance};
use uniground_evaluation::annotated::{AnnotatedMasks, AnnotatedRoom};
use uniground_evaluation::annotations::Annotations;

/// Objects with fewer points are ignored, as in the bench of stage 1.
const MIN_POINTS: u32 = 200;
const COVERED: f32 = 0.25;

fn main() {
    let mut folder = Utf8PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("../shared/scenes");
    let mut models = ModelsConfig::builtin();
    let mut args = std::env::args().skip(1).filter(|a| a != "--bench");
    while let Some(arg) = args.next() {
        match arg.as_str() {
            "--models" => {
                models.masks = AUTO.into();
                models.encoder = AUTO.into();
                models.bundles.models = args.next().unwrap().into();
            }
            other => folder = other.into(),
        }
    }
    let loaded = models.load().unwrap().models;
    let mut table = Table::new();
    table.load_preset(presets::ASCII_MARKDOWN);
    table.set_header([
        "room",
        "missed",
        "best instance",
        "built-in masks",
        "segmenter",
        "an instance already",
        "seconds",
    ]);
    let (mut missed, mut found, mut offered) = (0, [0, 0], PhotographChoice::default());
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
        let objects: Vec<_> =
            room.objects(MIN_POINTS).into_iter().filter(|o| covered(&o.aabb) < COVERED).collect();
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
            let find = |segmenter: Option<&Segmenter>| {
                let pointing = PointedObjectFinder {
                    cloud: &parsed.cloud,
                    frames: &room.bundle.frames,
                    segmenter,
                    settings: &settings,
                };
                pointing.find_at(place, &parsed.instances, &[]).unwrap()
            };
            let iou = |found: &Option<Instance>| {
                found.as_ref().map_or(0.0, |found| found.aabb.iou(&object.aabb))
            };
            let ours = find(None);
            let theirs = loaded.segmenters.first().map(|segmenter| find(Some(segmenter)));
            found[0] += u32::from(iou(&ours) >= COVERED);
            found[1] += u32::from(theirs.as_ref().is_some_and(|theirs| iou(theirs) >= COVERED));
            eprintln!(
                "{name} {}: {:.2} {:.2}",
                object.name,
                iou(&ours),
                theirs.as_ref().map_or(0.0, iou)
            );
            let known = ours
                .as_ref()
                .and_then(|ours| find_identical(&parsed.instances, ours))
                .map_or("", |_| "yes");
            table.add_row([
                name.clone(),
                object.name.clone(),
                format!("{:.2}", covered(&object.aabb)),
                format!("{:.2}", iou(&ours)),
                theirs.map_or_else(|| "-".to_owned(), |theirs| format!("{:.2}", iou(&theirs))),
                known.to_owned(),
                format!("{:.1}", start.elapsed().as_secs_f32()),
            ]);
        }
    }
    println!(
        "{table}\n\nof {missed} missed: {} by the built-in masks, {} by a segmenter, at IoU {COVERED}",
        found[0], found[1]
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
