//! Selects few frames that together show every part of a room several times, from near and not at a
//! grazing angle. Segmenting a frame takes most of the time of a parse, and neighboring frames of a
//! video show the same.

use crate::superpoints::Patch;
use rayon::prelude::*;
use uniground_geometry::Point3;
use uniground_geometry::scene::{Camera, FrameRef, Pixel, PointCloud};

/// Size of the depth buffer in which parts are hidden by what is nearer, cells.
const COLUMNS: usize = 64;
const ROWS: usize = 48;
/// Points that are drawn into it at most.
const DRAWN: usize = 60_000;
/// How far behind the nearest point of a cell something is still visible: a share of its depth,
/// and meters. A cell covers a slanted surface over some depth.
const TOLERANCE: (f32, f32) = (0.05, 0.05);
/// A view along a surface counts like one at this cosine.
const LEAST_COSINE: f32 = 0.1;
/// The selection ends when it reaches this share of what all frames together show.
const ENOUGH: f64 = 0.98;
/// Frames this near to a selected one show nothing else: meters, plus radians between the views.
const SAME_VIEW: f32 = 0.1;

/// Returns the frames to use, in order. Each part of the scan, such as a superpoint, counts as seen
/// `views` times if its views are as good as the best one.
#[must_use]
pub fn select_frames(
    frames: &[FrameRef],
    cloud: &PointCloud,
    parts: &[Patch],
    views: u32,
) -> Vec<FrameRef> {
    let mut seen: Vec<Vec<(u32, f32)>> =
        frames.par_iter().map(|frame| visible_parts(frame, cloud, parts)).collect();
    let mut best = vec![0.0_f32; parts.len()];
    for (part, quality) in seen.iter().flatten() {
        let best = &mut best[*part as usize];
        *best = best.max(*quality);
    }
    // From here on, the quality is relative to the part's best view.
    for (part, quality) in seen.iter_mut().flatten() {
        *quality /= best[*part as usize];
    }
    let wanted = f64::from(views.max(1));
    let mut possible = vec![0.0_f64; parts.len()];
    for (part, quality) in seen.iter().flatten() {
        possible[*part as usize] += f64::from(*quality);
    }
    let possible: f64 = possible.iter().map(|sum| sum.min(wanted)).sum();
    let mut reached = vec![0.0_f64; parts.len()];
    let mut total = 0.0;
    let mut left: Vec<usize> = (0..frames.len()).collect();
    let mut chosen: Vec<usize> = Vec::new();
    let gain = |frame: usize, reached: &[f64]| -> f64 {
        let gains = seen[frame].iter().map(|(part, quality)| {
            let before = reached[*part as usize];
            (before + f64::from(*quality)).min(wanted) - before
        });
        gains.sum()
    };
    while total < ENOUGH * possible {
        let gains: Vec<f64> = left.par_iter().map(|frame| gain(*frame, &reached)).collect();
        // The first of equal frames.
        let best = (0..left.len()).rev().max_by(|a, b| gains[*a].total_cmp(&gains[*b]));
        let Some(best) = best.filter(|best| gains[*best] > 0.0) else { break };
        let frame = left[best];
        total += gains[best];
        for (part, quality) in &seen[frame] {
            let reached = &mut reached[*part as usize];
            *reached = (*reached + f64::from(*quality)).min(wanted);
        }
        chosen.push(frame);
        left.retain(|other| distance(&frames[frame], &frames[*other]) > SAME_VIEW);
    }
    chosen.sort_unstable();
    chosen.into_iter().map(|frame| frames[frame].clone()).collect()
}

/// Returns the distance between two views: meters between the cameras, plus radians between their
/// orientations.
pub(crate) fn distance(a: &FrameRef, b: &FrameRef) -> f32 {
    let step = a.camera_to_world.inverse() * b.camera_to_world;
    step.translation.vector.norm() + step.rotation.angle()
}

/// Returns the parts whose centers a frame shows, with the pixels per meter at which it shows them.
fn visible_parts(frame: &FrameRef, cloud: &PointCloud, parts: &[Patch]) -> Vec<(u32, f32)> {
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
    let eye: Point3<f32> = frame.camera_to_world.translation.vector.into();
    let focal = frame.color_intrinsics.fx;
    let quality = |(number, part): (u32, &Patch)| {
        let (cell, depth) = cell_of(&part.center)?;
        let (share, meters) = TOLERANCE;
        let is_visible = depth <= nearest[cell] * (1.0 + share) + meters;
        let towards = (eye - part.center).normalize();
        let cosine = towards.dot(&part.normal).abs().max(LEAST_COSINE);
        is_visible.then_some((number, focal / depth * cosine))
    };
    (0..).zip(parts).filter_map(quality).collect()
}
