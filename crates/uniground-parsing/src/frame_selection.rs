//! Selects the frames that a parse uses: few frames, spread evenly along the camera path, that
//! together show every part of the scan several times. Segmenting a frame takes most of the time of
//! a parse, and neighboring frames of a video show the same.
//!
//! A greedy choice of the frames that show most finds fewer objects than the same number of evenly
//! spread frames (docs/METHOD.md), so only their number depends on what they show. A blurred frame
//! is replaced with a sharper one that was taken shortly before or after it.

use crate::frame_sampling::{sample_frames, spread_along_path};
use crate::masks::{self, MaskSource};
use crate::sharpness::Sharpness;
use crate::superpoints::Patch;
use rayon::prelude::*;
use std::ops::Range;
use uniground_geometry::Point3;
use uniground_geometry::scene::{Camera, FrameRef, Pixel, PointCloud};
use uniground_types::settings::FrameSamplingSettings;

/// Size of the depth buffer in which parts are hidden by what is nearer, cells.
const COLUMNS: usize = 64;
const ROWS: usize = 48;
/// Points that are drawn into it at most.
const DRAWN: usize = 60_000;
/// How far behind the nearest point of a cell something is still visible: a share of its depth,
/// and meters. A cell covers a slanted surface over some depth.
const TOLERANCE: (f32, f32) = (0.05, 0.05);
/// The selection shows at least this share of what is wanted.
const ENOUGH: f64 = 0.9;

/// Fewest frames that are selected for a segmentation model, which takes seconds per frame.
const LEAST_FRAMES: usize = 8;
/// Fewest frames that are selected for built-in masks, which take a tenth of a second.
const LEAST_FRAMES_BUILTIN: usize = 100;

/// Number of frames, including the selected one, among which a sharper one is looked for.
const SHARPEST_OF: usize = 5;
/// A frame is blurred if another one, taken shortly before or after it, is sharper by this factor.
/// The squared Laplacian of equally sharp neighbors differs less.
const SHARPER: f32 = 1.5;

/// Returns the frames of which a parse uses the masks: sampled as the settings say, of which as
/// many are selected as show the parts of the scan, such as superpoints, often enough. For a
/// segmentation model, blurred ones are replaced with sharper neighbors.
#[must_use]
pub fn choose_frames(
    frames: &[FrameRef],
    cloud: &PointCloud,
    parts: &[Patch],
    masks: &dyn MaskSource,
    settings: &FrameSamplingSettings,
) -> Vec<FrameRef> {
    let sampled = sample_frames(frames, settings);
    let is_builtin = masks::is_builtin(masks.name());
    let least = if is_builtin { LEAST_FRAMES_BUILTIN } else { LEAST_FRAMES };
    let Some(views) = settings.views_per_part else { return sampled };
    let mut selected = select_frames(&sampled, cloud, parts, views, least);
    // Built-in masks take less time than to measure the sharpness of other frames.
    if !is_builtin {
        selected = prefer_sharp(&sampled, &selected);
    }
    selected.into_iter().map(|frame| sampled[frame].clone()).collect()
}

/// Returns the positions of the frames to use, in order: at least `least`, if there are so many.
/// Each part of the scan, such as a superpoint, is wanted in `views` frames, or in as many as there
/// are.
fn select_frames(
    frames: &[FrameRef],
    cloud: &PointCloud,
    parts: &[Patch],
    views: u32,
    least: usize,
) -> Vec<usize> {
    if frames.len() <= least {
        return (0..frames.len()).collect();
    }
    let seen: Vec<Vec<u32>> =
        frames.par_iter().map(|frame| visible_parts(frame, cloud, parts)).collect();
    let shown = |frames: &mut dyn Iterator<Item = usize>| -> f64 {
        let mut counts = vec![0_u32; parts.len()];
        frames.flat_map(|frame| &seen[frame]).for_each(|part| counts[*part as usize] += 1);
        counts.iter().map(|count| f64::from((*count).min(views))).sum()
    };
    let wanted = ENOUGH * shown(&mut (0..frames.len()));
    let mut number = least.max(1);
    while number < frames.len() {
        let chosen = spread_along_path(frames, number);
        if shown(&mut chosen.iter().copied()) >= wanted {
            return chosen;
        }
        number += number.div_ceil(16);
    }
    (0..frames.len()).collect()
}

/// Replaces blurred frames among the selected ones with sharper ones: at most a quarter of the way
/// to the selected frames before and after, so that the frames stay spread evenly.
fn prefer_sharp(frames: &[FrameRef], selected: &[usize]) -> Vec<usize> {
    let sharpness = |frame: usize| {
        frames[frame].decode_color().map_or(0.0, |picture| {
            let (width, height) = picture.dimensions();
            Sharpness::measure(&picture).within([0, 0, width, height])
        })
    };
    let sharpest = |at: usize| {
        let frame = selected[at];
        let others = spread_over(&neighborhood(selected, at, frames.len()), frame);
        if others.is_empty() {
            return frame;
        }
        let own = sharpness(frame);
        others
            .into_iter()
            .map(|other| (sharpness(other), other))
            .filter(|(sharp, _)| *sharp > SHARPER * own)
            .max_by(|a, b| a.0.total_cmp(&b.0).then(b.1.cmp(&a.1)))
            .map_or(frame, |(_, other)| other)
    };
    (0..selected.len()).into_par_iter().map(sharpest).collect()
}

/// Returns the frames that can replace a selected one: up to a quarter of the way to its neighbors.
fn neighborhood(selected: &[usize], at: usize, count: usize) -> Range<usize> {
    let frame = selected[at];
    let before = at.checked_sub(1).map_or(0, |before| selected[before] + 1);
    let after = selected.get(at + 1).copied().unwrap_or(count);
    frame - (frame - before) / 4..frame + (after - frame - 1) / 4 + 1
}

/// Returns frames of a range other than `frame`, evenly spread.
fn spread_over(range: &Range<usize>, frame: usize) -> Vec<usize> {
    let others: Vec<usize> = range.clone().filter(|other| *other != frame).collect();
    let count = others.len().min(SHARPEST_OF - 1);
    (0..count).map(|i| others[i * others.len() / count]).collect()
}

/// Returns the parts whose centers a frame shows.
fn visible_parts(frame: &FrameRef, cloud: &PointCloud, parts: &[Patch]) -> Vec<u32> {
    let camera = Camera::new(frame.depth_intrinsics, &frame.camera_to_world);
    let (width, height) =
        (frame.depth_intrinsics.width as f32, frame.depth_intrinsics.height as f32);
    let cell_of = |point: &Point3<f32>| {
        let Pixel { u, v, z_m } = camera.project(point)?;
        let column = ((u + 0.5) / width * COLUMNS as f32) as usize;
        let row = ((v + 0.5) / height * ROWS as f32) as usize;
        (column < COLUMNS && row < ROWS).then_some((row * COLUMNS + column, z_m))
    };
    let mut nearest = vec![f32::INFINITY; COLUMNS * ROWS];
    let stride = (cloud.positions.len() / DRAWN).max(1);
    for point in cloud.positions.iter().step_by(stride) {
        if let Some((cell, depth)) = cell_of(point) {
            nearest[cell] = nearest[cell].min(depth);
        }
    }
    let is_visible = |part: &Patch| {
        let (share, meters) = TOLERANCE;
        cell_of(&part.center)
            .is_some_and(|(cell, depth)| depth <= nearest[cell] * (1.0 + share) + meters)
    };
    (0..).zip(parts).filter(|(_, part)| is_visible(part)).map(|(number, _)| number).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::{Translation3, UnitQuaternion};
    use uniground_geometry::scene::{FrameIndex, Intrinsics, Optics};
    use uniground_geometry::{Isometry3, Vector3};

    /// Returns a camera at `x` that looks along +Y, at a wall two meters away.
    fn frame(index: u32, x: f32) -> FrameRef {
        let intrinsics =
            Intrinsics { width: 64, height: 48, fx: 64.0, fy: 64.0, cx: 31.5, cy: 23.5 };
        // OpenCV axes: the view direction Z becomes +Y, and down Y becomes -Z.
        let turn =
            UnitQuaternion::from_axis_angle(&Vector3::x_axis(), -std::f32::consts::FRAC_PI_2);
        FrameRef {
            index: FrameIndex(index),
            time_s: None,
            color: "c".into(),
            depth: "d".into(),
            color_intrinsics: intrinsics,
            depth_intrinsics: intrinsics,
            depth_scale_m: 0.001,
            camera_to_world: Isometry3::from_parts(Translation3::new(x, 0.0, 1.0), turn),
            optics: Optics::default(),
        }
    }

    fn wall(y: f32, xs: std::ops::Range<i32>) -> Vec<Point3<f32>> {
        let at = |i: i32, k: i32| Point3::new(i as f32 * 0.025, y, k as f32 * 0.025);
        xs.flat_map(|i| (0..80).map(move |k| at(i, k))).collect()
    }

    fn parts(points: &[Point3<f32>]) -> Vec<Patch> {
        let part = |center: &Point3<f32>| Patch {
            points: 1,
            center: *center,
            normal: Vector3::y(),
            lab: nalgebra::Vector3::zeros(),
        };
        points.iter().map(part).collect()
    }

    fn cloud(positions: Vec<Point3<f32>>) -> PointCloud {
        PointCloud { colors: vec![[90; 3]; positions.len()], positions }
    }

    #[test]
    fn a_slow_video_needs_few_frames_and_a_fast_one_nearly_all() {
        let points = wall(2.0, -40..440);
        let cloud = cloud(points.clone());
        // The same ten meters in 200 and in 10 frames.
        let slow: Vec<FrameRef> = (0..200).map(|i| frame(i, i as f32 * 0.05)).collect();
        let fast: Vec<FrameRef> = (0..10).map(|i| frame(i, i as f32)).collect();
        let of_slow = select_frames(&slow, &cloud, &parts(&points), 4, 8);
        assert!((12..40).contains(&of_slow.len()), "{}", of_slow.len());
        assert!(of_slow.windows(2).all(|pair| pair[0] < pair[1]));
        assert!(select_frames(&fast, &cloud, &parts(&points), 4, 8).len() >= 9);
        let more = select_frames(&slow, &cloud, &parts(&points), 8, 8).len();
        assert!(more > of_slow.len(), "{more}");
    }

    #[test]
    fn blurred_frames_are_replaced_with_sharp_neighbors() {
        let folder = tempfile::tempdir().unwrap();
        let sharp = image::RgbImage::from_fn(64, 48, |x, y| {
            image::Rgb([if (x / 4 + y / 4) % 2 == 0 { 220 } else { 30 }; 3])
        });
        let blurred = image::imageops::blur(&sharp, 2.0);
        // A camera that shakes: every second picture is sharp.
        let frames: Vec<FrameRef> = (0..100)
            .map(|i| {
                let path = folder.path().join(format!("{i}.png"));
                if i % 2 == 1 { &sharp } else { &blurred }.save(&path).unwrap();
                let mut frame = frame(i, i as f32 * 0.05);
                frame.color = camino::Utf8PathBuf::from_path_buf(path).unwrap();
                frame
            })
            .collect();
        let selected: Vec<usize> = (0..5).map(|i| 20 * i + 2).collect();
        let better = prefer_sharp(&frames, &selected);
        assert!(better.iter().all(|frame| frame % 2 == 1), "{better:?}");
        assert!(better.iter().zip(&selected).all(|(a, b)| a.abs_diff(*b) <= 5), "{better:?}");
        assert_eq!(prefer_sharp(&frames, &better), better, "sharp frames stay");
        let all: Vec<usize> = (0..100).collect();
        assert_eq!(prefer_sharp(&frames, &all), all, "there is no other frame");
        assert!(prefer_sharp(&[], &[]).is_empty());
    }

    #[test]
    fn parts_behind_a_wall_are_not_visible() {
        let (near, far) = (wall(2.0, -40..40), wall(4.0, -40..40));
        let all = [near.clone(), far].concat();
        let seen = visible_parts(&frame(0, 0.0), &cloud(all.clone()), &parts(&all));
        assert!(seen.len() > 100 && seen.iter().all(|part| (*part as usize) < near.len()));
    }

    #[test]
    fn a_scan_without_frames_or_parts_is_left_as_it_is() {
        let points = wall(2.0, -40..40);
        assert!(select_frames(&[], &cloud(points.clone()), &parts(&points), 4, 8).is_empty());
        let few: Vec<FrameRef> = (0..3).map(|i| frame(i, i as f32)).collect();
        assert_eq!(select_frames(&few, &cloud(points), &[], 4, 8).len(), few.len());
    }
}
