//! Finds up in a cloud without cameras.
//!
//! Rooms are boxes: judged by the walls alone, any side could be the floor. These clues separate
//! the sides: floors are wide and rooms are low; objects stand on the floor and not on the ceiling;
//! chairs and open doors are rotated about up and about no other axis.

use super::describe;
use super::gravity::{UpFit, measure, refine};
use super::surfaces::SurfacePatch;
use crate::IngestError;
use std::collections::BTreeSet;
use uniground_geometry::scene::PointCloud;
use uniground_geometry::statistics::quantile;
use uniground_geometry::up_axis::UpAxis;
use uniground_geometry::voxels::VoxelKey;
use uniground_geometry::{Point3, Vector3};

/// A candidate for the up direction, with its evidence.
#[derive(Debug, Clone, Copy)]
pub(super) struct UpCandidate {
    /// How well the surfaces fit the direction.
    pub fit: UpFit,
    /// Sum of the evidence for it. Only differences are meaningful.
    pub score: f32,
    /// Distance from the lowest to the highest point, meters.
    pub height_m: f32,
    /// The narrowest side of the footprint, meters.
    pub width_m: f32,
}

/// Minimum width and height of a room, and its maximum height, meters. A smaller cloud is a partial
/// view: in it, a wall with a picture looks as much like a floor as any other surface.
const ROOM_WIDTH_M: f32 = 2.2;
const ROOM_HEIGHT_M: std::ops::Range<f32> = 1.5..8.0;
/// Minimum lead of the best direction.
const AHEAD: f32 = 0.25;
/// Minimum lead for a cloud that is not a room. Only Z is accepted then, the up axis of most files.
const FAR_AHEAD: f32 = 0.6;

/// Returns the up direction if it is clear, and how clearly it leads, `0.5..1`.
///
/// # Errors
/// Returns [`IngestError::UpUnknown`] with the two best directions.
pub(super) fn choose_up(candidates: &[UpCandidate]) -> Result<(&UpCandidate, f32), IngestError> {
    let Some(best) = candidates.first() else {
        return Err(IngestError::UpUnknown {
            reason: "it has no flat surfaces".into(),
            choice: "up=z, or another axis".into(),
        });
    };
    let lead = best.score - candidates.get(1).map_or(0.0, |next| next.score);
    let is_room = best.width_m >= ROOM_WIDTH_M && ROOM_HEIGHT_M.contains(&best.height_m);
    if best.score >= AHEAD
        && ((is_room && lead >= AHEAD) || (is_z_up(&best.fit.up) && lead >= FAR_AHEAD))
    {
        return Ok((best, 1.0 / (1.0 + (-lead / AHEAD).exp())));
    }
    let axis = |c: &UpCandidate| UpAxis::nearest(&c.fit.up).name();
    // Directions between two axes are named by the nearest one.
    let other = candidates.iter().find(|c| axis(c) != axis(best));
    let likeliest: Vec<&UpCandidate> = std::iter::once(best).chain(other).collect();
    let reading = |c: &UpCandidate| {
        let UpCandidate { fit, height_m, .. } = c;
        format!("with {} up it is {height_m:.1} m high and {}", axis(c), describe(fit))
    };
    let readings: Vec<String> = likeliest.iter().map(|c| reading(c)).collect();
    let choices: Vec<String> = likeliest.iter().map(|c| format!("up={}", axis(c))).collect();
    let part = if is_room { "" } else { "it is not a whole room; " };
    Err(IngestError::UpUnknown {
        reason: format!("{part}{}", readings.join("; ")),
        choice: choices.join(" or "),
    })
}

/// Maximum number of directions that are examined.
const MAX_DIRECTIONS: usize = 6;
/// Directions closer to each other than this are merged, degrees.
const SAME_DEG: f32 = 15.0;
/// Maximum number of points that are examined.
const MAX_POINTS: usize = 200_000;
/// Size of the cells for measuring areas, meters.
const CELL_M: f32 = 0.1;
/// Maximum distance of a floor or a ceiling from the end of the cloud, meters.
const END_M: f32 = 0.25;
/// Height range above a floor in which standing objects are expected, meters.
const STANDING_M: std::ops::Range<f32> = 0.15..1.1;

/// Returns the possible up directions, the best first.
pub(super) fn up_candidates(cloud: &PointCloud, surfaces: &[SurfacePatch]) -> Vec<UpCandidate> {
    let points: Vec<Point3<f32>> =
        cloud.positions.iter().step_by(cloud.len().div_ceil(MAX_POINTS).max(1)).copied().collect();
    let axes = candidate_directions(surfaces);
    let shape = CloudShape { points: &points, surfaces };
    let extents: Vec<f32> = axes.iter().map(|axis| shape.extent(axis)).collect();
    let mut all = Vec::new();
    for (i, axis) in axes.iter().enumerate() {
        // The other directions perpendicular to it: the walls' own directions, if it is up.
        let across: Vec<Vector3<f32>> =
            axes.iter().filter(|other| other.dot(axis).abs() < 0.3).copied().collect();
        let narrowest = extents
            .iter()
            .enumerate()
            .filter(|(j, _)| *j != i)
            .map(|(_, e)| *e)
            .fold(f32::INFINITY, f32::min);
        let low = if narrowest.is_finite() {
            (narrowest / extents[i].max(0.01)).ln().clamp(-0.7, 0.7)
        } else {
            0.0
        };
        let turned = shape.unexplained_upright_share(axis, &across);
        for up in [*axis, -*axis] {
            let fit = measure(surfaces, &up);
            let habit = if is_z_up(&up) { 0.2 } else { 0.0 };
            let score = shape.floor_score(&up)
                + 0.8 * low
                + 2.0 * turned
                + shape.standing_score(&up)
                + habit;
            all.push(UpCandidate { fit, score, height_m: extents[i], width_m: shape.width(&up) });
        }
    }
    all.sort_by(|a, b| b.score.total_cmp(&a.score));
    all
}

/// Returns whether up is Z. Most files have Z up, which is weak evidence when others are missing.
fn is_z_up(up: &Vector3<f32>) -> bool {
    up.z > 0.985
}

/// Returns unsigned directions that many surfaces face, each refined with the surfaces that are
/// level and upright to it.
fn candidate_directions(surfaces: &[SurfacePatch]) -> Vec<Vector3<f32>> {
    let close = SAME_DEG.to_radians().cos();
    let step = surfaces.len().div_ceil(400).max(1);
    let guesses = [Vector3::x(), Vector3::y(), Vector3::z()]
        .into_iter()
        .chain(surfaces.iter().step_by(step).map(|s| s.normal));
    let mut weighed: Vec<(f32, Vector3<f32>)> =
        guesses.map(|guess| (measure(surfaces, &guess).level, guess)).collect();
    weighed.sort_by(|a, b| b.0.total_cmp(&a.0));
    let mut found: Vec<Vector3<f32>> = Vec::new();
    for (level, guess) in weighed {
        if found.len() == MAX_DIRECTIONS || level < 0.02 {
            break;
        }
        if found.iter().any(|other| other.dot(&guess).abs() > close) {
            continue;
        }
        let refined = refine(surfaces, &guess, 10.0).up;
        if found.iter().all(|other| other.dot(&refined).abs() < close) {
            found.push(refined);
        }
    }
    found
}

struct CloudShape<'a> {
    points: &'a [Point3<f32>],
    surfaces: &'a [SurfacePatch],
}

impl CloudShape<'_> {
    fn heights(&self, up: &Vector3<f32>) -> Vec<f32> {
        self.points.iter().map(|p| p.coords.dot(up)).collect()
    }

    /// Returns the extent along an axis without a few outliers, meters.
    fn extent(&self, axis: &Vector3<f32>) -> f32 {
        let mut heights = self.heights(axis);
        quantile(&mut heights, 0.995).unwrap_or(0.0) - quantile(&mut heights, 0.005).unwrap_or(0.0)
    }

    /// Returns the smallest width over a few horizontal directions, meters.
    fn width(&self, up: &Vector3<f32>) -> f32 {
        let (a, b) = perpendicular_axes(up);
        let sides = (0..8).map(|k| {
            let (sin, cos) = (k as f32 * std::f32::consts::PI / 8.0).sin_cos();
            self.extent(&(a * cos + b * sin))
        });
        sides.fold(f32::INFINITY, f32::min)
    }

    /// Returns the share of the footprint that level surfaces at the lower end cover, minus half of
    /// the same share for the upper end when there is no floor; `-0.5..=1`.
    fn floor_score(&self, up: &Vector3<f32>) -> f32 {
        let mut heights = self.heights(up);
        let (low, high) = (
            quantile(&mut heights, 0.01).unwrap_or(0.0),
            quantile(&mut heights, 0.99).unwrap_or(0.0),
        );
        let (a, b) = perpendicular_axes(up);
        let cell = |p: &Point3<f32>| {
            VoxelKey::containing(&Point3::new(p.coords.dot(&a), p.coords.dot(&b), 0.0), CELL_M)
        };
        let footprint = self.points.iter().map(&cell).collect::<BTreeSet<_>>().len().max(1) as f32;
        let sheet = |level: f32| {
            let on = self.surfaces.iter().filter(|s| {
                s.normal.dot(up).abs() > 0.97 && (s.at.coords.dot(up) - level).abs() < END_M
            });
            // A surface cell can be wider than a footprint cell, so compares areas, not counts.
            (on.map(|s| s.weight).sum::<f32>() / (footprint * CELL_M * CELL_M)).min(1.0)
        };
        let (floor, ceiling) = (sheet(low), sheet(high));
        floor - if floor < 0.2 { 0.5 * ceiling } else { 0.0 }
    }

    /// Returns how many more level surfaces and points are just above the lower end than just below
    /// the upper end, because objects stand on floors; `-1.4..=1.4`.
    fn standing_score(&self, up: &Vector3<f32>) -> f32 {
        let mut heights = self.heights(up);
        let (low, high) = (
            quantile(&mut heights, 0.01).unwrap_or(0.0),
            quantile(&mut heights, 0.99).unwrap_or(0.0),
        );
        if high - low < 2.0 * STANDING_M.start {
            return 0.0;
        }
        let band = STANDING_M.start..STANDING_M.end.min((high - low) / 2.0);
        // Level surfaces between the ends are seats, tables or shelves. Such objects do not hang
        // from ceilings.
        let (mut standing, mut hanging) = (0.0, 0.0);
        for s in self.surfaces.iter().filter(|s| s.normal.dot(up).abs() > 0.9) {
            let h = s.at.coords.dot(up);
            standing += if band.contains(&(h - low)) { s.weight } else { 0.0 };
            hanging += if band.contains(&(high - h)) { s.weight } else { 0.0 };
        }
        let level = (standing - hanging) / (standing + hanging + 0.3);
        let (mut near, mut far) = (0.0_f32, 0.0_f32);
        for h in heights {
            near += f32::from(u8::from(band.contains(&(h - low))));
            far += f32::from(u8::from(band.contains(&(high - h))));
        }
        0.7 * level + 0.7 * (near - far) / (near + far).max(1.0)
    }

    /// Returns the share of surfaces that are upright to an axis and face none of the walls'
    /// directions.
    fn unexplained_upright_share(&self, axis: &Vector3<f32>, walls: &[Vector3<f32>]) -> f32 {
        let total = self.surfaces.iter().map(|s| s.weight).sum::<f32>().max(f32::MIN_POSITIVE);
        let turned = self.surfaces.iter().filter(|s| {
            s.normal.dot(axis).abs() < 0.12
                && walls.iter().all(|wall| s.normal.dot(wall).abs() < 0.94)
        });
        (turned.map(|s| s.weight).sum::<f32>() / total).min(0.3)
    }
}

/// Returns two unit vectors perpendicular to a direction and to each other.
fn perpendicular_axes(up: &Vector3<f32>) -> (Vector3<f32>, Vector3<f32>) {
    let least = if up.x.abs() < 0.6 { Vector3::x() } else { Vector3::y() };
    let a = up.cross(&least).normalize();
    (a, up.cross(&a))
}

#[cfg(test)]
mod tests {
    use super::super::surfaces;
    use super::*;
    use proptest::prelude::*;
    use uniground_geometry::Isometry3;

    /// Adds the sides of a block, with a point every four centimeters. `ends` selects whether to
    /// add bottom and top.
    fn block(cloud: &mut PointCloud, low: [f32; 3], high: [f32; 3], ends: [bool; 2]) {
        let steps = |axis: usize| ((high[axis] - low[axis]) / 0.04).round().max(1.0) as u32;
        for x in 0..=steps(0) {
            for y in 0..=steps(1) {
                for z in 0..=steps(2) {
                    let side = x == 0 || x == steps(0) || y == 0 || y == steps(1);
                    if side || (z == 0 && ends[0]) || (z == steps(2) && ends[1]) {
                        let at = |axis: usize, k: u32| {
                            low[axis] + (high[axis] - low[axis]) * k as f32 / steps(axis) as f32
                        };
                        cloud.positions.push(Point3::new(at(0, x), at(1, y), at(2, z)));
                        cloud.colors.push([128; 3]);
                    }
                }
            }
        }
    }

    fn room() -> PointCloud {
        let mut cloud = PointCloud::default();
        block(&mut cloud, [0.0, 0.0, 0.0], [5.0, 3.6, 2.5], [true, false]);
        block(&mut cloud, [1.0, 1.0, 0.0], [2.6, 1.8, 0.72], [false, true]);
        block(&mut cloud, [3.4, 0.6, 0.0], [4.2, 2.6, 0.5], [false, true]);
        block(&mut cloud, [0.3, 2.9, 0.0], [0.9, 3.5, 1.1], [false, true]);
        cloud
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(12))]
        #[test]
        fn up_of_a_room_is_found_at_any_rotation(angles in prop::array::uniform3(-3.0_f32..3.0)) {
            let turn = Isometry3::rotation(Vector3::from(angles));
            let mut cloud = room();
            cloud.positions.iter_mut().for_each(|p| *p = turn * *p);
            let candidates = up_candidates(&cloud, &surfaces::patches_of_cloud(&cloud));
            let chosen = choose_up(&candidates);
            prop_assert!(chosen.is_ok(), "{chosen:?}");
            let up = chosen.unwrap().0.fit.up;
            prop_assert!(up.dot(&(turn * Vector3::z())) > 0.998, "{up}");
        }
    }

    #[test]
    fn two_directions_near_one_axis_are_named_once() {
        let candidate = |x: f32, score: f32| {
            let up = Vector3::new(x, 0.0, 1.0).normalize();
            let fit = UpFit { up, level: 0.5, upright: 0.4, clearness: 0.1 };
            UpCandidate { fit, score, height_m: 1.0, width_m: 1.0 }
        };
        let all = [candidate(0.0, 0.5), candidate(0.3, 0.45), candidate(9.0, 0.4)];
        let message = choose_up(&all).unwrap_err().to_string();
        assert!(message.ends_with("Set up=z or up=x"), "{message}");
    }

    #[test]
    fn a_single_wall_is_not_mistaken_for_a_floor() {
        let mut cloud = PointCloud::default();
        block(&mut cloud, [0.0, 0.0, 0.0], [2.4, 0.02, 2.0], [false, false]);
        block(&mut cloud, [0.5, 0.0, 0.5], [0.8, 0.3, 0.7], [true, true]);
        let candidates = up_candidates(&cloud, &surfaces::patches_of_cloud(&cloud));
        assert!(choose_up(&candidates).is_err(), "{candidates:?}");
    }
}
