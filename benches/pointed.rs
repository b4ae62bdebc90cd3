//! Things that stage 1 misses, pointed at in a photograph: `make bench-pointed`, or `cargo bench --bench pointed -- [--models DIR] [FOLDER]`.
//!
//! Every annotated object that no instance of any level covers (box IoU under .25) is pointed at in the middle of the photograph that shows
//! most of it, and what is cut out there is held against its annotated box: by the built-in masks, and by the segmenters among the models.

#![allow(missing_docs, clippy::unwrap_used)] // a bench that can not set up has nothing to measure

use camino::{Utf8Path, Utf8PathBuf};
use comfy_table::{Table, presets};
use std::time::Instant;
use uniground::config::{AUTO, ModelsConfig};
use uniground::evaluation::annotated::{AnnotatedMasks, AnnotatedRoom};
use uniground::evaluation::annotations::Annotations;
use uniground_core::geometry::boxes::Aabb;
use uniground_core::models::neural::Segmenter;
use uniground_core::progress::Progress;
use uniground_core::scene::Instance;
use uniground_core::scene_parsing::checkpoints::Checkpoints;
use uniground_core::scene_parsing::masks::rgbd::RgbdMasks;
use uniground_core::scene_parsing::masks::{IdImage, MaskSource};
use uniground_core::scene_parsing::pointed::{Place, Pointing, known_as};
use uniground_core::scene_parsing::{self, ParsingSettings, Perception};

/// Objects with fewer points are left out, as in the bench of stage 1.
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
                models.bundles.models = args.next().unwrap().into();
            }
            other => folder = other.into(),
        }
    }
    let loaded = models.load().unwrap().models;
    let mut table = Table::new();
    table.load_preset(presets::ASCII_MARKDOWN);
    table.set_header(["room", "missed", "best instance", "built-in masks", "segmenter", "an instance already", "seconds"]);
    let (mut missed, mut found) = (0, [0, 0]);
    for name in rooms(&folder) {
        let scratch = tempfile::tempdir().unwrap();
        let room = AnnotatedRoom::load(&folder, &name, Utf8Path::from_path(scratch.path()).unwrap()).unwrap();
        let settings = ParsingSettings::default();
        let rgbd = RgbdMasks { settings: settings.rgbd_masks };
        let perception = Perception::with_masks(&rgbd);
        let parsed = scene_parsing::parse(room.bundle.clone(), &perception, &settings, &Checkpoints::none(), &Progress::silent()).unwrap();
        let covered = |aabb: &Aabb| parsed.instances.iter().map(|i| i.aabb.iou(aabb)).fold(0.0, f32::max);
        let objects: Vec<_> = room.objects(MIN_POINTS).into_iter().filter(|o| covered(&o.aabb) < COVERED).collect();
        let ids: Vec<u32> = objects.iter().map(|o| o.id).collect();
        for (object, place) in objects.iter().zip(places(&room, &room.masks(), &ids)) {
            let Some(place) = place else { continue };
            missed += 1;
            let start = Instant::now();
            let find = |segmenter: Option<&Segmenter>| {
                let pointing = Pointing { cloud: &parsed.cloud, frames: &room.bundle.frames, segmenter, settings: &settings };
                pointing.find(place, &parsed.instances, &[]).unwrap()
            };
            let iou = |found: &Option<Instance>| found.as_ref().map_or(0.0, |found| found.aabb.iou(&object.aabb));
            let ours = find(None);
            let theirs = loaded.segmenters.first().map(|segmenter| find(Some(segmenter)));
            found[0] += u32::from(iou(&ours) >= COVERED);
            found[1] += u32::from(theirs.as_ref().is_some_and(|theirs| iou(theirs) >= COVERED));
            eprintln!("{name} {}: {:.2} {:.2}", object.name, iou(&ours), theirs.as_ref().map_or(0.0, iou));
            let known = ours.as_ref().and_then(|ours| known_as(&parsed.instances, ours)).map_or("", |_| "yes");
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
}

/// For each object the middle of it in the photograph that shows most of it.
fn places(room: &AnnotatedRoom, masks: &AnnotatedMasks, ids: &[u32]) -> Vec<Option<Place>> {
    /// Frames that are looked into, spread over all: looking pixels up in the annotations takes its time.
    const FRAMES: usize = 15;
    let mut best: Vec<(usize, Option<Place>)> = vec![(0, None); ids.len()];
    for frame in room.bundle.frames.iter().step_by(room.bundle.frames.len().div_ceil(FRAMES)) {
        let decoded = frame.decode().unwrap();
        let image = masks.masks(&decoded, &Progress::silent()).unwrap().remove(0);
        for (id, best) in ids.iter().zip(&mut best) {
            let pixels = image.ids.iter().filter(|of| u32::from(**of) == *id).count();
            if pixels > best.0 {
                let (u, v) = innermost(&image, *id as u16);
                *best = (pixels, Some(Place { frame: frame.index, at: decoded.colour_position(u as f32, v as f32) }));
            }
        }
    }
    best.into_iter().map(|(_, place)| place).collect()
}

/// The pixel of a mask that is farthest from its rim: what is left when it is peeled as often as it can be.
fn innermost(image: &IdImage, id: u16) -> (u32, u32) {
    let mut left: Vec<(u32, u32)> = (0..image.height)
        .flat_map(|v| (0..image.width).map(move |u| (u, v)))
        .filter(|&at| image.at(at) == id)
        .collect();
    loop {
        let inside: std::collections::HashSet<(u32, u32)> = left.iter().copied().collect();
        let is_inner = |&&(u, v): &&(u32, u32)| {
            u > 0 && v > 0 && [(u - 1, v), (u + 1, v), (u, v - 1), (u, v + 1)].iter().all(|near| inside.contains(near))
        };
        let inner: Vec<(u32, u32)> = left.iter().filter(is_inner).copied().collect();
        if inner.is_empty() {
            return left[left.len() / 2];
        }
        left = inner;
    }
}

/// Names of the annotated rooms in a folder, sorted.
fn rooms(folder: &Utf8Path) -> Vec<String> {
    let entries = folder.read_dir_utf8().map(|entries| entries.flatten().collect::<Vec<_>>()).unwrap_or_default();
    let zips = entries.iter().filter_map(|entry| entry.file_name().strip_suffix(".zip"));
    let mut names: Vec<String> = zips.filter(|name| Annotations::file_of(folder, name).is_some()).map(str::to_owned).collect();
    names.sort_unstable();
    names
}
