//! Determines which points of the cloud a frame shows (paper: visible when it projects inside, in
//! front, and fits the measured depth).
//!
//! A frame shows a small share of a room. Points are stored in clusters of a fixed size, so that
//! most are skipped with one test.

use rayon::prelude::*;
use uniground_geometry::Point3;
use uniground_geometry::boxes::Aabb;
use uniground_geometry::scene::{Camera, DepthImage, PointCloud};
use uniground_geometry::voxels::VoxelKey;

/// Edge of the cubes that contain one cluster each, meters.
const CLUSTER_M: f32 = 0.5;

/// A cloud prepared for look-ups in frames.
pub struct Visibility {
    /// Maximum error of a visible point's depth, as a share of the measured depth.
    depth_tolerance: f32,
    /// Points with their index in the cloud, by cluster.
    points: Vec<(Point3<f32>, u32)>,
    clusters: Vec<PointCluster>,
}

/// Consecutive points within a ball.
struct PointCluster {
    center: Point3<f32>,
    radius_m: f32,
    points: std::ops::Range<usize>,
}

/// What a frame shows at the position of a point that projects into it.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum PointVisibility {
    /// The point fits the measured depth.
    Visible,
    /// Something was measured in front of the point.
    Hidden,
    /// Nothing was measured there, or only something behind the point.
    Unknown,
}

/// A point of the cloud that projects into a frame.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct FramePoint {
    /// Index of the point in the cloud.
    pub point: u32,
    /// Position, meters, world frame (Z up).
    pub position: Point3<f32>,
    /// Column and row of the depth image.
    pub cell: (u32, u32),
    /// Whether the frame shows the point.
    pub sight: PointVisibility,
}

/// One in this many invisible points is reported: they only measure how much of a thing is hidden.
pub const SAMPLED: u32 = 4;

/// Returns whether [`Visibility::around_frame`] also reports this point when it is not visible.
#[must_use]
pub fn is_sampled(point: u32) -> bool {
    point.is_multiple_of(SAMPLED)
}

impl Visibility {
    /// Prepares a cloud. `group_of` has a number for each point, such as its superpoint, by which
    /// [`in_frame`](Self::in_frame) sorts the visible points.
    ///
    /// `depth_tolerance` is relative: a point at depth `z` is visible when `|z - d| <= tolerance *
    /// d`. A hole in the depth is unknown, so nothing is visible there.
    #[must_use]
    pub fn new(cloud: &PointCloud, group_of: &[u32], depth_tolerance: f32) -> Self {
        let positions = &cloud.positions;
        let mut order: Vec<(u32, VoxelKey, u32)> = (0_u32..)
            .zip(positions)
            .zip(group_of)
            .map(|((point, p), &group)| (group, VoxelKey::containing(p, CLUSTER_M), point))
            .collect();
        order.par_sort_unstable();
        let points: Vec<(Point3<f32>, u32)> =
            order.iter().map(|&(_, _, point)| (positions[point as usize], point)).collect();
        let mut start = 0;
        let clusters = order
            .chunk_by(|a, b| (a.0, a.1) == (b.0, b.1))
            .filter_map(|of_cluster| {
                let range = start..start + of_cluster.len();
                start = range.end;
                let around = Aabb::around(points[range.clone()].iter().map(|(p, _)| p))?;
                Some(PointCluster {
                    center: around.center,
                    radius_m: around.size.norm() / 2.0,
                    points: range,
                })
            })
            .collect();
        Self { depth_tolerance, points, clusters }
    }

    /// Returns the points that a frame shows, sorted by group. The order within a group is
    /// unspecified but always the same.
    #[must_use]
    pub fn in_frame(&self, camera: &Camera, depth: &DepthImage) -> Vec<FramePoint> {
        self.collect_points(camera, depth, |_, sight| sight == PointVisibility::Visible)
    }

    /// Returns the same as [`in_frame`](Self::in_frame), plus a sample of the points that are
    /// inside the picture but not visible; see [`is_sampled`].
    #[must_use]
    pub fn around_frame(&self, camera: &Camera, depth: &DepthImage) -> Vec<FramePoint> {
        self.collect_points(camera, depth, |point, sight| {
            sight == PointVisibility::Visible || is_sampled(point)
        })
    }

    fn collect_points(
        &self,
        camera: &Camera,
        depth: &DepthImage,
        keep: impl Fn(u32, PointVisibility) -> bool + Sync,
    ) -> Vec<FramePoint> {
        self.clusters
            .par_iter()
            .with_min_len(64)
            .filter(|cluster| camera.can_show(&cluster.center, cluster.radius_m))
            .flat_map_iter(|cluster| &self.points[cluster.points.clone()])
            .filter_map(|&(position, point)| {
                let pixel = camera.project(&position)?;
                let cell = pixel.cell();
                let depth_m = depth.at(cell);
                let (behind_m, tolerance_m) = (pixel.z_m - depth_m, self.depth_tolerance * depth_m);
                let sight = match depth_m > 0.0 {
                    true if behind_m.abs() <= tolerance_m => PointVisibility::Visible,
                    true if behind_m > tolerance_m => PointVisibility::Hidden,
                    _ => PointVisibility::Unknown,
                };
                keep(point, sight).then_some(FramePoint { point, position, cell, sight })
            })
            .collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;
    use uniground_geometry::Isometry3;
    use uniground_geometry::scene::Intrinsics;

    /// Returns a camera at the origin that looks along +Z at a wall two meters away, with a hole in
    /// its last row.
    fn camera_and_depth() -> (Camera, DepthImage) {
        let intrinsics = Intrinsics { width: 4, height: 4, fx: 4.0, fy: 4.0, cx: 1.5, cy: 1.5 };
        let depth_m = (0..16).map(|i| if i < 12 { 2.0 } else { 0.0 }).collect();
        (
            Camera::new(intrinsics, &Isometry3::identity()),
            DepthImage { width: 4, height: 4, depth_m },
        )
    }

    #[test]
    fn occluded_points_holes_and_points_outside_are_not_visible() {
        let (camera, depth) = camera_and_depth();
        let at = |u: f32, v: f32, z: f32| camera.intrinsics.unproject(u, v, z);
        let outside = [Point3::new(9.0, 0.0, 2.0), Point3::new(0.0, 0.0, -2.0)];
        let positions = vec![
            at(0.0, 0.0, 2.0),
            at(1.0, 0.0, 2.05),
            at(2.0, 0.0, 3.0),
            at(3.0, 3.0, 2.0),
            outside[0],
            outside[1],
        ];
        let cloud = PointCloud { colors: vec![[0; 3]; positions.len()], positions };
        let seen = Visibility::new(&cloud, &[0; 6], 0.05).in_frame(&camera, &depth);
        assert_eq!(
            seen.iter().map(|seen| (seen.point, seen.cell)).collect::<Vec<_>>(),
            [(0, (0, 0)), (1, (1, 0))]
        );
    }

    #[test]
    fn invisible_points_are_reported_as_a_sample() {
        let (camera, depth) = camera_and_depth();
        let at = |u: f32, v: f32, z: f32| camera.intrinsics.unproject(u, v, z);
        let positions = [
            [at(0.0, 0.0, 2.0); 8],
            [at(1.0, 0.0, 3.0); 8],
            [at(2.0, 0.0, 1.0); 8],
            [at(3.0, 3.0, 2.0); 8],
        ]
        .concat();
        let cloud = PointCloud { colors: vec![[0; 3]; positions.len()], positions };
        let seen = Visibility::new(&cloud, &[0; 32], 0.05).around_frame(&camera, &depth);
        let count = |sight, points: std::ops::Range<u32>| {
            seen.iter().filter(|p| p.sight == sight && points.contains(&p.point)).count()
        };
        assert_eq!(
            (
                count(PointVisibility::Visible, 0..8),
                count(PointVisibility::Hidden, 8..16),
                count(PointVisibility::Unknown, 16..32)
            ),
            (8, 2, 4)
        );
        assert_eq!(seen.len(), 14);
    }

    proptest! {
        #[test]
        fn visible_points_are_complete_and_sorted_by_group(
            points in prop::collection::vec((prop::array::uniform3(-3.0_f32..3.0), 0_u32..4), 1..300),
        ) {
            let (camera, depth) = camera_and_depth();
            let (positions, group_of): (Vec<_>, Vec<u32>) = points.into_iter().map(|(p, group)| (Point3::from(p), group)).unzip();
            let expected: Vec<u32> = (0..)
                .zip(&positions)
                .filter(|(_, p)| camera.project(p).is_some_and(|pixel| pixel.v < 2.5 && (pixel.z_m - 2.0).abs() <= 1.0))
                .map(|(i, _)| i)
                .collect();
            let cloud = PointCloud { colors: vec![[0; 3]; positions.len()], positions };
            let seen = Visibility::new(&cloud, &group_of, 0.5).in_frame(&camera, &depth);
            prop_assert!(seen.is_sorted_by_key(|seen| group_of[seen.point as usize]));
            let mut found: Vec<u32> = seen.iter().map(|seen| seen.point).collect();
            found.sort_unstable();
            prop_assert_eq!(found, expected);
        }
    }
}
