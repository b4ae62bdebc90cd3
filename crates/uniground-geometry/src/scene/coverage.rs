//! Which part of a room the cameras of a scan have seen.
//!
//! The room is the upright box around its points, from the floor to [`MAX_HEIGHT_M`] above it,
//! turned like its walls and divided into coarse voxels. A voxel is seen if it holds a point, or if
//! a frame measured depth at its center or behind it. A voxel that is not seen belongs to the room
//! if it is connected to seen free space without a surface or a slit of one voxel in between. Insides
//! of furniture and what lies behind walls are left out, unless an opening leads there.
//!
//! The share that was seen is relative to the extent of the points: what lies beyond a wall that no
//! frame shows is unknown.

use super::{Camera, DepthImage};
use crate::Point3;
use crate::boxes::Aabb;
use crate::statistics::quantile;
use crate::voxels::typical_spacing_m;
use rayon::prelude::*;
use serde::{Deserialize, Serialize};
use std::f32::consts::FRAC_PI_2;

/// Edge of a voxel, meters. Doubled where points lie further apart, or the room is too large.
const VOXEL_M: f32 = 0.15;
/// Edge of a voxel in multiples of the point spacing. Smaller voxels would leave holes in walls.
const SPACINGS_PER_VOXEL: f32 = 1.5;
/// Maximum number of voxels: a hall of 24 x 24 m at 15 cm.
const MAX_VOXELS: usize = 400_000;
/// What lies higher above the floor is left out, meters: scans rarely show the space under the
/// ceiling, and few objects are there.
pub const MAX_HEIGHT_M: f32 = 2.0;
/// The lowest voxels begin this far below the floor, meters, so that they hold the floor's points.
const BELOW_FLOOR_M: f32 = 0.05;
/// Share of the points that is left out on every side as strays.
const STRAY_SHARE: f32 = 0.002;
/// Number of points that the extent is computed from, and the direction of the walls.
const EXTENT_SAMPLE: usize = 50_000;
const DIRECTION_SAMPLE: usize = 3_000;
/// Directions of walls that are tried within a quarter turn.
const DIRECTIONS: u32 = 90;
/// Regions with a larger horizontal side are split, meters.
const MAX_REGION_M: f32 = 2.0;
/// Smaller regions are left out of lists, cubic meters. They count for the share.
const MIN_REGION_M3: f32 = 0.05;
/// Maximum number of regions.
const MAX_REGIONS: usize = 8;

/// What is known about a voxel.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(into = "u8", try_from = "u8")]
enum VoxelState {
    /// No part of the room, as far as is known.
    Outside,
    /// Seen by a camera.
    Seen,
    /// Part of the room that no camera saw.
    Unseen,
}

impl From<VoxelState> for u8 {
    fn from(state: VoxelState) -> Self {
        match state {
            VoxelState::Outside => 0,
            VoxelState::Seen => 1,
            VoxelState::Unseen => 2,
        }
    }
}

impl TryFrom<u8> for VoxelState {
    type Error = String;

    fn try_from(state: u8) -> Result<Self, String> {
        match state {
            0 => Ok(Self::Outside),
            1 => Ok(Self::Seen),
            2 => Ok(Self::Unseen),
            other => Err(format!("{other} is no state of a voxel")),
        }
    }
}

/// The voxels of a room, turned about the vertical axis.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
struct Grid {
    /// Angle from the world's X axis to the grid's, radians.
    yaw_rad: f32,
    /// Corner with the smallest coordinates, meters, along the grid's axes.
    origin: [f32; 3],
    voxel_m: f32,
    /// Number of voxels along each axis. The index of a voxel grows along X, then Y, then Z.
    size: [usize; 3],
}

impl Grid {
    /// Returns the grid around points; `None` without any.
    fn around(positions: &[Point3<f32>], floor_z_m: f32) -> Option<Self> {
        let finite = |most: usize| {
            let step = positions.len().div_ceil(most).max(1);
            let sample = positions.iter().step_by(step);
            sample.filter(|p| p.iter().all(|c| c.is_finite())).copied().collect::<Vec<_>>()
        };
        let yaw_rad = wall_direction(&finite(DIRECTION_SAMPLE));
        let sample = finite(EXTENT_SAMPLE);
        let turned = |axis: usize| sample.iter().map(move |p| turn(p, -yaw_rad)[axis]);
        let [x, y, z] = [0, 1, 2].map(|axis| bounds(turned(axis).collect()));
        let ([left, right], [front, back], [_, top]) = (x?, y?, z?);
        let bottom = floor_z_m - BELOW_FLOOR_M;
        let extent = [
            right - left,
            back - front,
            (top - bottom).clamp(BELOW_FLOOR_M, MAX_HEIGHT_M + BELOW_FLOOR_M),
        ];
        let size = |voxel_m: f32| extent.map(|m| ((m / voxel_m).ceil() as usize).max(1));
        let fits = |[x, y, z]: [usize; 3]| x.saturating_mul(y).saturating_mul(z) <= MAX_VOXELS;
        let mut voxel_m = VOXEL_M;
        let least = SPACINGS_PER_VOXEL * typical_spacing_m(positions);
        while voxel_m < least || !fits(size(voxel_m)) {
            voxel_m *= 2.0;
        }
        let size = size(voxel_m);
        // Centered, because the last voxels reach beyond the points.
        let origin = [(left, 0), (front, 1)]
            .map(|(low, axis)| low - (size[axis] as f32 * voxel_m - extent[axis]) / 2.0);
        Some(Self { yaw_rad, origin: [origin[0], origin[1], bottom], voxel_m, size })
    }

    fn len(&self) -> usize {
        self.size.iter().product()
    }

    fn is_valid(&self) -> bool {
        let finite = self.origin.iter().chain([&self.yaw_rad, &self.voxel_m]);
        self.size.iter().all(|&n| (1..=MAX_VOXELS).contains(&n))
            && self.size.iter().try_fold(1_usize, |all, &n| all.checked_mul(n)).is_some_and(|all| {
                all <= MAX_VOXELS && finite.clone().all(|v| v.is_finite()) && self.voxel_m > 0.0
            })
    }

    /// Returns the voxel of a point, world frame; `None` outside.
    fn voxel(&self, p: &Point3<f32>) -> Option<usize> {
        let p = turn(p, -self.yaw_rad);
        let mut place = [0; 3];
        for axis in 0..3 {
            let at = ((p[axis] - self.origin[axis]) / self.voxel_m).floor();
            if !(at >= 0.0 && at < self.size[axis] as f32) {
                return None;
            }
            place[axis] = at as usize;
        }
        Some(self.index(place))
    }

    fn index(&self, [x, y, z]: [usize; 3]) -> usize {
        (z * self.size[1] + y) * self.size[0] + x
    }

    fn place(&self, voxel: usize) -> [usize; 3] {
        let [width, depth, _] = self.size;
        [voxel % width, voxel / width % depth, voxel / (width * depth)]
    }

    /// Returns the center of a voxel, meters, world frame.
    fn center(&self, voxel: usize) -> Point3<f32> {
        let place = self.place(voxel);
        let along = |axis: usize| self.origin[axis] + (place[axis] as f32 + 0.5) * self.voxel_m;
        turn(&Point3::new(along(0), along(1), along(2)), self.yaw_rad)
    }

    /// Returns whether a voxel lies between two occupied ones: a slit between boards or in a sparse
    /// surface, behind which the inside of furniture begins.
    fn is_slit(&self, voxel: usize, occupied: &[bool]) -> bool {
        let (place, steps) = (self.place(voxel), [1, self.size[0], self.size[0] * self.size[1]]);
        (0..3).any(|axis| {
            let inner = 0 < place[axis] && place[axis] + 1 < self.size[axis];
            inner && occupied[voxel - steps[axis]] && occupied[voxel + steps[axis]]
        })
    }

    /// Returns the voxels that share a face with this one.
    fn neighbors(&self, voxel: usize) -> impl Iterator<Item = usize> + use<> {
        let (place, size) = (self.place(voxel), self.size);
        let steps = [1, size[0], size[0] * size[1]];
        (0..3).flat_map(move |axis| {
            let down = (place[axis] > 0).then(|| voxel - steps[axis]);
            let up = (place[axis] + 1 < size[axis]).then(|| voxel + steps[axis]);
            [down, up].into_iter().flatten()
        })
    }
}

/// Turns a point about the vertical axis through the origin.
fn turn(p: &Point3<f32>, by_rad: f32) -> Point3<f32> {
    let (sin, cos) = by_rad.sin_cos();
    Point3::new(cos * p.x - sin * p.y, sin * p.x + cos * p.y, p.z)
}

/// Returns the range of values without strays.
fn bounds(mut values: Vec<f32>) -> Option<[f32; 2]> {
    Some([quantile(&mut values, STRAY_SHARE)?, quantile(&mut values, 1.0 - STRAY_SHARE)?])
}

/// Returns the direction in which the upright box around points has the smallest ground plan,
/// radians, `0..PI/2`.
fn wall_direction(points: &[Point3<f32>]) -> f32 {
    let area = |yaw_rad: f32| {
        let side = |axis: usize| {
            let along = points.iter().map(|p| turn(p, -yaw_rad)[axis]).collect();
            bounds(along).map_or(0.0, |[low, high]| high - low)
        };
        side(0) * side(1)
    };
    let yaw = |step: u32| step as f32 / DIRECTIONS as f32 * FRAC_PI_2;
    let areas: Vec<f32> = (0..DIRECTIONS).into_par_iter().map(|step| area(yaw(step))).collect();
    let smallest = (0..DIRECTIONS as usize).min_by(|&a, &b| areas[a].total_cmp(&areas[b]));
    yaw(smallest.unwrap_or_default() as u32)
}

/// Collects what the frames of a scan see. Memory and the time per frame are bounded by
/// the number of voxels.
pub struct CoverageBuilder {
    grid: Grid,
    occupied: Vec<bool>,
    /// Voxels without points that no frame has seen so far, ascending.
    unseen: Vec<u32>,
}

impl CoverageBuilder {
    /// Starts with the points of a scan, meters, world frame (Z up). `floor_z_m` is the height of
    /// the floor. Returns `None` without points.
    #[must_use]
    pub fn new(positions: &[Point3<f32>], floor_z_m: f32) -> Option<Self> {
        let grid = Grid::around(positions, floor_z_m)?;
        let mut occupied = vec![false; grid.len()];
        for voxel in positions.iter().filter_map(|p| grid.voxel(p)) {
            occupied[voxel] = true;
        }
        let unseen = (0..).zip(&occupied).filter(|(_, held)| !**held).map(|(i, _)| i).collect();
        Some(Self { grid, occupied, unseen })
    }

    /// Adds what a frame sees. The order of frames does not matter.
    pub fn add_frame(&mut self, camera: &Camera, depth: &DepthImage) {
        let Self { grid, unseen, .. } = self;
        let margin_m = grid.voxel_m / 2.0;
        let sees = |voxel: u32| {
            camera.project(&grid.center(voxel as usize)).is_some_and(|pixel| {
                let measured_m = depth.at(pixel.cell());
                measured_m > 0.0 && pixel.z_m <= measured_m + margin_m
            })
        };
        *unseen = unseen.par_iter().copied().filter(|voxel| !sees(*voxel)).collect();
    }

    /// Returns the coverage: divides what no frame saw into parts of the room and the rest. Returns
    /// `None` if no frame saw free space.
    #[must_use]
    pub fn finish(self) -> Option<RoomCoverage> {
        let Self { grid, occupied, unseen } = self;
        let mut states = vec![VoxelState::Seen; grid.len()];
        unseen.iter().for_each(|&voxel| states[voxel as usize] = VoxelState::Outside);
        let is_free = |voxel: usize| states[voxel] == VoxelState::Seen && !occupied[voxel];
        let mut open: Vec<usize> = (0..grid.len()).filter(|&voxel| is_free(voxel)).collect();
        if open.is_empty() {
            return None;
        }
        while let Some(voxel) = open.pop() {
            for next in grid.neighbors(voxel) {
                if states[next] == VoxelState::Outside && !grid.is_slit(next, &occupied) {
                    states[next] = VoxelState::Unseen;
                    open.push(next);
                }
            }
        }
        Some(RoomCoverage::new(grid, states))
    }
}

/// Which part of a room the cameras of a scan have seen.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(into = "StoredCoverage", try_from = "StoredCoverage")]
pub struct RoomCoverage {
    grid: Grid,
    /// By index of the voxel.
    states: Vec<VoxelState>,
    /// Computed once, because many questions need them.
    whole: SeenShare,
    unseen_volumes: Vec<UnseenVolume>,
}

/// How much of a room was seen.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct SeenShare {
    /// Share of the volume that was seen, `0..=1`.
    pub share: f32,
    /// Volume that was not seen, cubic meters.
    pub unseen_m3: f32,
    /// Area of the floor that was not seen, square meters.
    pub unseen_floor_m2: f32,
}

/// A connected part of a room that no camera saw.
#[derive(Debug, Clone, PartialEq)]
pub struct UnseenVolume {
    /// Box around it, meters, world frame.
    pub aabb: Aabb,
    /// Its volume, cubic meters.
    pub volume_m3: f32,
    /// Area of the floor in it, square meters.
    pub floor_m2: f32,
    /// Centers of its voxels, meters, world frame.
    pub points: Vec<Point3<f32>>,
}

impl RoomCoverage {
    fn new(grid: Grid, states: Vec<VoxelState>) -> Self {
        let whole = SeenShare { share: 1.0, unseen_m3: 0.0, unseen_floor_m2: 0.0 };
        let mut coverage = Self { grid, states, whole, unseen_volumes: Vec::new() };
        coverage.whole = coverage.seen_share_within(|_| true).unwrap_or(whole);
        coverage.unseen_volumes = coverage.find_unseen_volumes();
        coverage
    }

    /// Returns how much of the room was seen.
    #[must_use]
    pub fn seen_share(&self) -> SeenShare {
        self.whole
    }

    /// Returns the parts of the room that no camera saw, the largest first. Large ones are split
    /// into parts with sides of at most [`MAX_REGION_M`].
    #[must_use]
    pub fn unseen_volumes(&self) -> &[UnseenVolume] {
        &self.unseen_volumes
    }

    /// Returns how much was seen of the part of the room whose points `is_within` accepts (meters,
    /// world frame). `None` where no part of the room is in it.
    #[must_use]
    pub fn seen_share_within(&self, is_within: impl Fn(&Point3<f32>) -> bool) -> Option<SeenShare> {
        let (mut seen, mut unseen, mut floor) = (0_u32, 0_u32, 0_u32);
        for (voxel, state) in self.states.iter().enumerate() {
            if *state == VoxelState::Outside || !is_within(&self.grid.center(voxel)) {
                continue;
            }
            if *state == VoxelState::Seen {
                seen += 1;
            } else {
                unseen += 1;
                floor += u32::from(self.is_floor(voxel));
            }
        }
        (seen + unseen > 0).then(|| SeenShare {
            share: seen as f32 / (seen + unseen) as f32,
            unseen_m3: unseen as f32 * self.grid.voxel_m.powi(3),
            unseen_floor_m2: floor as f32 * self.grid.voxel_m.powi(2),
        })
    }

    fn find_unseen_volumes(&self) -> Vec<UnseenVolume> {
        let mut is_open: Vec<bool> =
            self.states.iter().map(|state| *state == VoxelState::Unseen).collect();
        let mut parts: Vec<Vec<usize>> = Vec::new();
        for first in 0..is_open.len() {
            if !std::mem::take(&mut is_open[first]) {
                continue;
            }
            let mut part = vec![first];
            let mut next = 0;
            while let Some(&voxel) = part.get(next) {
                next += 1;
                for neighbor in self.grid.neighbors(voxel) {
                    if std::mem::take(&mut is_open[neighbor]) {
                        part.push(neighbor);
                    }
                }
            }
            self.split(part, &mut parts);
        }
        let least = (MIN_REGION_M3 / self.grid.voxel_m.powi(3)).ceil() as usize;
        parts.retain(|part| part.len() >= least);
        parts.sort_by_key(|part| (std::cmp::Reverse(part.len()), part[0]));
        parts.iter().take(MAX_REGIONS).map(|part| self.region(part)).collect()
    }

    /// Splits voxels at the middle of their longest horizontal side until both are short.
    fn split(&self, mut part: Vec<usize>, parts: &mut Vec<Vec<usize>>) {
        part.sort_unstable();
        let most = (MAX_REGION_M / self.grid.voxel_m) as usize;
        let along = |axis: usize| part.iter().map(move |&voxel| self.grid.place(voxel)[axis]);
        let range = |axis: usize| (along(axis).min(), along(axis).max());
        let mut longest = (0, 0, 0);
        for axis in 0..2 {
            if let (Some(low), Some(high)) = range(axis)
                && high - low > longest.1
            {
                longest = (axis, high - low, low);
            }
        }
        let (axis, length, low) = longest;
        if length < most.max(1) {
            parts.push(part);
            return;
        }
        let (near, far) =
            part.into_iter().partition(|&voxel| self.grid.place(voxel)[axis] <= low + length / 2);
        self.split(near, parts);
        self.split(far, parts);
    }

    fn region(&self, part: &[usize]) -> UnseenVolume {
        let points: Vec<Point3<f32>> = part.iter().map(|&voxel| self.grid.center(voxel)).collect();
        let floor = part.iter().filter(|&&voxel| self.is_floor(voxel)).count();
        let (sin, cos) = self.grid.yaw_rad.sin_cos();
        let across = (sin.abs() + cos.abs()) * self.grid.voxel_m;
        let mut aabb = Aabb::around(&points)
            .unwrap_or(Aabb { center: Point3::origin(), size: nalgebra::Vector3::zeros() });
        aabb.size += nalgebra::Vector3::new(across, across, self.grid.voxel_m);
        UnseenVolume {
            aabb,
            volume_m3: part.len() as f32 * self.grid.voxel_m.powi(3),
            floor_m2: floor as f32 * self.grid.voxel_m.powi(2),
            points,
        }
    }

    /// Returns whether a voxel is on the floor.
    fn is_floor(&self, voxel: usize) -> bool {
        self.grid.place(voxel)[2] == 0
    }
}

/// The stored form: states as runs of equal ones.
#[derive(Serialize, Deserialize)]
struct StoredCoverage {
    grid: Grid,
    runs: Vec<(VoxelState, u32)>,
}

impl From<RoomCoverage> for StoredCoverage {
    fn from(RoomCoverage { grid, states, .. }: RoomCoverage) -> Self {
        let runs = states.chunk_by(|a, b| a == b).map(|run| (run[0], run.len() as u32)).collect();
        Self { grid, runs }
    }
}

impl TryFrom<StoredCoverage> for RoomCoverage {
    type Error = String;

    fn try_from(StoredCoverage { grid, runs }: StoredCoverage) -> Result<Self, String> {
        let all: u64 = runs.iter().map(|(_, length)| u64::from(*length)).sum();
        if !grid.is_valid() || all != grid.len() as u64 {
            return Err("the grid and its voxels do not agree".into());
        }
        let states = runs
            .into_iter()
            .flat_map(|(state, length)| std::iter::repeat_n(state, length as usize))
            .collect();
        Ok(Self::new(grid, states))
    }
}

#[cfg(test)]
mod tests {
    use super::super::Intrinsics;
    use super::*;
    use crate::Isometry3;
    use nalgebra::{Rotation3, UnitQuaternion, Vector3};
    use proptest::prelude::*;

    const CAMERA: Intrinsics =
        Intrinsics { width: 96, height: 72, fx: 48.0, fy: 48.0, cx: 47.5, cy: 35.5 };
    /// Half of the side of the test room, and its height, meters.
    const HALF_M: f32 = 2.0;
    const HEIGHT_M: f32 = 2.4;

    /// Points on the floor and the walls of a square room, turned about the vertical axis. `keeps`
    /// says which of them the scan has.
    fn room(yaw_rad: f32, keeps: impl Fn(&Point3<f32>) -> bool) -> Vec<Point3<f32>> {
        let steps = |from: f32, to: f32| {
            let count = ((to - from) / 0.04).round() as usize;
            (0..=count).map(move |i| from + (to - from) * i as f32 / count as f32)
        };
        let mut points = Vec::new();
        for a in steps(-HALF_M, HALF_M) {
            points.extend(steps(-HALF_M, HALF_M).map(|b| Point3::new(a, b, 0.0)));
            for z in steps(0.0, HEIGHT_M) {
                for side in [-HALF_M, HALF_M] {
                    points.extend([Point3::new(a, side, z), Point3::new(side, a, z)]);
                }
            }
        }
        points.retain(|p| keeps(p));
        points.iter().map(|p| turn(p, yaw_rad)).collect()
    }

    /// A camera in the turned room that looks along a direction.
    fn camera(at: [f32; 3], yaw_rad: f32, pitch_rad: f32) -> Camera {
        // OpenCV axes: right, down, forward as columns of the rotation at yaw 0, looking along +X.
        let level = Rotation3::from_basis_unchecked(&[-Vector3::y(), -Vector3::z(), Vector3::x()]);
        let turned = Rotation3::from_euler_angles(0.0, pitch_rad, yaw_rad) * level;
        let pose = Isometry3::from_parts(
            nalgebra::Translation3::from(Vector3::from(at)),
            UnitQuaternion::from_rotation_matrix(&turned),
        );
        Camera::new(CAMERA, &pose)
    }

    /// The depth that a camera at `at` measures inside of the turned, otherwise empty room.
    fn depth(camera: &Camera, room_yaw_rad: f32) -> DepthImage {
        let to_world = camera.world_to_camera().inverse();
        let origin = turn(&camera.center(), -room_yaw_rad);
        let Intrinsics { width, height, .. } = CAMERA;
        let measure = |i: u32| {
            let ray = CAMERA.unproject((i % width) as f32, (i / width) as f32, 1.0);
            let along = turn(&Point3::from(to_world.rotation * ray.coords), -room_yaw_rad);
            let sides = [HALF_M, HALF_M];
            let mut z_m = f32::INFINITY;
            for axis in 0..2 {
                let reach = sides[axis] * along[axis].signum() - origin[axis];
                z_m = z_m.min(reach / along[axis]);
            }
            let bottom = if along.z < 0.0 { -origin.z / along.z } else { f32::INFINITY };
            z_m.min(bottom)
        };
        DepthImage { width, height, depth_m: (0..width * height).map(measure).collect() }
    }

    /// Four cameras in the middle that look around, and four that look up and down.
    fn views(room_yaw_rad: f32, leave_out: Option<usize>) -> Vec<(Camera, DepthImage)> {
        let all = (0..24).filter(|i| leave_out.is_none_or(|corner| i % 8 / 2 != corner));
        let views = all.map(|i| {
            let yaw = (i % 8) as f32 * FRAC_PI_2 / 2.0 + 0.4 + room_yaw_rad;
            let pitch = [-0.5, 0.2, 0.9][i / 8];
            let camera = camera([0.0, 0.0, 1.2], yaw, pitch);
            (camera, depth(&camera, room_yaw_rad))
        });
        views.collect()
    }

    fn coverage(points: &[Point3<f32>], views: &[(Camera, DepthImage)]) -> RoomCoverage {
        let mut builder = CoverageBuilder::new(points, 0.0).unwrap();
        views.iter().for_each(|(camera, depth)| builder.add_frame(camera, depth));
        builder.finish().unwrap()
    }

    fn share(coverage: &RoomCoverage) -> SeenShare {
        coverage.seen_share()
    }

    #[test]
    fn a_room_that_was_looked_at_from_its_middle_is_seen() {
        let seen = share(&coverage(&room(0.3, |_| true), &views(0.3, None)));
        assert!(seen.share > 0.97 && seen.unseen_floor_m2 < 0.3, "{seen:?}");
    }

    #[test]
    fn scans_without_frames_or_points_have_no_coverage() {
        assert_eq!(CoverageBuilder::new(&room(0.0, |_| true), 0.0).unwrap().finish(), None);
        assert!(CoverageBuilder::new(&[], 0.0).is_none());
        assert!(CoverageBuilder::new(&[Point3::new(f32::NAN, 0.0, 0.0)], 0.0).is_none());
    }

    #[test]
    fn regions_are_split_and_cover_what_was_not_seen() {
        let is_near = |p: &Point3<f32>| p.x < 0.5;
        let views: Vec<_> = views(0.0, None)
            .into_iter()
            .map(|(camera, depth)| {
                // Cuts off everything beyond x = 0.5: as if a sensor did not measure that far.
                let depth_m = (0..depth.depth_m.len() as u32).map(|i| {
                    let (u, v) = (i % depth.width, i / depth.width);
                    let z = depth.at((u, v));
                    let end = camera.world_to_camera().inverse()
                        * CAMERA.unproject(u as f32, v as f32, z);
                    if is_near(&end) { z } else { 0.0 }
                });
                (camera, DepthImage { depth_m: depth_m.collect(), ..depth })
            })
            .collect();
        // One wall is known from elsewhere.
        let points = room(0.0, |p| is_near(p) || p.x > 1.99);
        let seen = coverage(&points, &views);
        let (total, regions) = (share(&seen), seen.unseen_volumes());
        assert!((0.5..0.8).contains(&total.share), "{total:?}");
        let listed: f32 = regions.iter().map(|region| region.volume_m3).sum();
        assert!((0.95..1.001).contains(&(listed / total.unseen_m3)), "{listed} of {total:?}");
        assert!(regions.len() > 1 && regions.is_sorted_by(|a, b| a.volume_m3 >= b.volume_m3));
        for region in regions {
            assert!(region.aabb.size.max() <= MAX_REGION_M + 0.3, "{:?}", region.aabb);
            assert!(region.points.iter().all(|p| region.aabb.contains(p)));
        }
    }

    #[test]
    fn stored_coverage_is_read_back_and_damaged_ones_are_rejected() {
        let coverage = coverage(&room(0.3, |_| true), &views(0.3, Some(1)));
        let json = serde_json::to_string(&coverage).unwrap();
        assert!(json.len() < 60_000, "{}", json.len());
        assert_eq!(serde_json::from_str::<RoomCoverage>(&json).unwrap(), coverage);
        for (from, to) in [("\"size\":[", "\"size\":[9"), ("\"runs\":[[", "\"runs\":[[1,1],[")] {
            let damaged = json.replacen(from, to, 1);
            assert!(serde_json::from_str::<RoomCoverage>(&damaged).is_err());
        }
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(12))]

        /// Whatever corner no frame shows, and however the room is turned: the share falls, and the
        /// largest region is in that corner.
        #[test]
        fn the_share_falls_where_no_frame_looked(yaw_rad in 0.0_f32..6.2, corner in 0_usize..4) {
            let in_corner = |p: &Point3<f32>| {
                let (x, y) = [(1.0, 1.0), (-1.0, 1.0), (-1.0, -1.0), (1.0, -1.0)][corner];
                p.x * x > 0.6 && p.y * y > 0.6
            };
            let all = share(&coverage(&room(yaw_rad, |_| true), &views(yaw_rad, None)));
            let some = coverage(&room(yaw_rad, |p| !in_corner(p)), &views(yaw_rad, Some(corner)));
            let seen = share(&some);
            prop_assert!(seen.share < all.share - 0.05, "{seen:?}, {all:?}");
            let middle = turn(&some.unseen_volumes()[0].aabb.center, -yaw_rad);
            prop_assert!(in_corner(&middle), "{middle:?}");
        }

        /// More frames never make the seen part smaller, in whatever order they come.
        #[test]
        fn more_frames_see_no_less(order in Just((0..24).collect::<Vec<usize>>()).prop_shuffle(), count in 1_usize..24) {
            let (points, views) = (room(0.2, |_| true), views(0.2, None));
            let pick = |chosen: &[usize]| coverage(&points, &chosen.iter().map(|&i| views[i].clone()).collect::<Vec<_>>());
            let (few, more) = (pick(&order[..count]), pick(&order));
            let is_seen = |of: &RoomCoverage, voxel: usize| of.states[voxel] == VoxelState::Seen;
            prop_assert!((0..few.states.len()).all(|voxel| !is_seen(&few, voxel) || is_seen(&more, voxel)));
            prop_assert_eq!(more, coverage(&points, &views));
        }
    }
}
