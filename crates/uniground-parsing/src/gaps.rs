//! Gaps: superpoints that are neighbors without touching, and what cameras saw between them.
//!
//! A scan has holes where nothing could be measured: on black, shiny or thin surfaces. So
//! superpoints count as neighbors over small gaps too. But where frames measured something behind
//! the gap, there is a depth edge: both surfaces end there, so the two are treated as different
//! things.

use super::ParseError;
use super::superpoints::{Superpoints, WIDEST_RING};
use rayon::prelude::*;
use std::collections::BTreeSet;
use uniground_geometry::boxes::Aabb;
use uniground_geometry::progress::Progress;
use uniground_geometry::scene::{Camera, DepthImage, FrameRef, PointCloud, stream_frames};
use uniground_geometry::voxels::VoxelGrid;
use uniground_geometry::{Point3, Vector3};

/// A measurement this far behind the middle of a gap is behind it, not part of its surroundings;
/// meters.
const BEHIND_M: f32 = 0.05;

/// A gap between two neighbors that do not touch.
struct DepthGap {
    pair: (u32, u32),
    /// The midpoint between their nearest points, meters, world frame.
    middle: Point3<f32>,
}

/// Returns the pairs of neighbors, without those over a gap that more frames see through than
/// measure something in. `voxel_m` is the edge of the voxels that superpoints were made of: two
/// superpoints touch where two of their voxels meet. `depth_tolerance` is relative, as in
/// [`Visibility::new`](super::visibility::Visibility::new).
///
/// # Errors
/// [`ParseError`]: an unreadable frame, or cancellation.
pub fn remove_pairs_across_gaps(
    cloud: &PointCloud,
    superpoints: &Superpoints,
    voxel_m: f32,
    frames: &[FrameRef],
    depth_tolerance: f32,
    progress: &Progress,
) -> Result<Vec<(u32, u32)>, ParseError> {
    progress.check()?;
    let gaps = gaps(cloud, superpoints, voxel_m);
    let mut seen_through = vec![0_i32; gaps.len()];
    stream_frames(
        frames,
        |frame| {
            progress.check()?;
            let (camera, depth) = (frame.depth_camera(), frame.decode_depth()?);
            Ok::<_, ParseError>(
                gaps.iter()
                    .map(|gap| vote(&gap.middle, &camera, &depth, depth_tolerance))
                    .collect::<Vec<_>>(),
            )
        },
        |_, votes| {
            seen_through.iter_mut().zip(votes).for_each(|(sum, vote)| *sum += vote);
            Ok(())
        },
    )?;
    let apart: BTreeSet<(u32, u32)> = gaps
        .iter()
        .zip(seen_through)
        .filter(|(_, votes)| *votes > 0)
        .map(|(gap, _)| gap.pair)
        .collect();
    Ok(superpoints.adjacent.iter().copied().filter(|pair| !apart.contains(pair)).collect())
}

/// Returns 1 where a frame sees through at a point, -1 where it measured something there, 0 where
/// it has no evidence.
fn vote(point: &Point3<f32>, camera: &Camera, depth: &DepthImage, tolerance: f32) -> i32 {
    let Some(pixel) = camera.project(point) else { return 0 };
    let depth_m = depth.at(pixel.cell());
    let behind_m = depth_m - pixel.z_m;
    match depth_m > 0.0 {
        true if behind_m > BEHIND_M + tolerance * depth_m => 1,
        true if behind_m.abs() <= tolerance * depth_m => -1,
        _ => 0,
    }
}

/// Finds the neighbors whose voxels do not meet.
fn gaps(cloud: &PointCloud, superpoints: &Superpoints, voxel_m: f32) -> Vec<DepthGap> {
    let grid = VoxelGrid::new(&cloud.positions, voxel_m);
    // A voxel belongs to one superpoint; in a scene that has grown, to that of its last point.
    let mut superpoint_of = vec![0; grid.len()];
    let mut sums = vec![(Vector3::zeros(), 0.0); grid.len()];
    for ((p, &voxel), &superpoint) in
        cloud.positions.iter().zip(&grid.of_point).zip(&superpoints.of_point)
    {
        superpoint_of[voxel as usize] = superpoint;
        let (sum, points) = &mut sums[voxel as usize];
        (*sum, *points) = (*sum + p.coords, *points + 1.0);
    }
    let around = grid.neighbors();
    let meeting = |(voxel, &own): (usize, &u32)| {
        let others = around
            .neighbors_of(voxel as u32)
            .iter()
            .map(|&near| superpoint_of[near as usize])
            .filter(move |other| *other > own);
        others.map(move |other| (own, other)).collect::<Vec<_>>()
    };
    let mut touching: Vec<(u32, u32)> =
        superpoint_of.par_iter().enumerate().flat_map_iter(meeting).collect();
    touching.par_sort_unstable();
    touching.dedup();

    let mut places: Vec<Vec<Point3<f32>>> = vec![Vec::new(); superpoints.patches.len()];
    for (&superpoint, (sum, points)) in superpoint_of.iter().zip(sums) {
        places[superpoint as usize].push((sum / points).into());
    }
    let reach_m = (WIDEST_RING + 1) as f32 * voxel_m;
    let gap = |&pair: &(u32, u32)| {
        let middle = midpoint_between(&places[pair.0 as usize], &places[pair.1 as usize], reach_m)?;
        Some(DepthGap { pair, middle })
    };
    superpoints
        .adjacent
        .par_iter()
        .filter(|pair| touching.binary_search(pair).is_err())
        .filter_map(gap)
        .collect()
}

/// Returns the midpoint between the nearest pair of points, one of each set; `None` beyond the
/// reach.
fn midpoint_between(
    one: &[Point3<f32>],
    other: &[Point3<f32>],
    reach_m: f32,
) -> Option<Point3<f32>> {
    let (few, many) = if one.len() <= other.len() { (one, other) } else { (other, one) };
    // Of a long wall, only the part beside a small thing can be nearest to it.
    let mut around = Aabb::around(few)?;
    around.size = around.size.add_scalar(2.0 * reach_m);
    let near: Vec<&Point3<f32>> = many.iter().filter(|p| around.contains(p)).collect();
    let pairs = few.iter().flat_map(|p| near.iter().map(move |&q| (p, q)));
    let nearest =
        pairs.min_by(|a, b| (a.0 - a.1).norm_squared().total_cmp(&(b.0 - b.1).norm_squared()));
    nearest.map(|(p, q)| nalgebra::center(p, q))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::superpoints::Patch;
    use camino::Utf8Path;
    use uniground_geometry::Isometry3;
    use uniground_geometry::color::Lab;
    use uniground_geometry::scene::Intrinsics;
    use uniground_testing::flat_frame;

    const CAMERA: Intrinsics =
        Intrinsics { width: 64, height: 48, fx: 40.0, fy: 40.0, cx: 31.5, cy: 23.5 };
    const VOXEL_M: f32 = 0.025;

    /// Returns two squares of 20 cm, one meter before a camera at the origin, `apart_m` apart,
    /// marked as neighbors.
    fn two_squares(apart_m: f32) -> (PointCloud, Superpoints) {
        let square = |left: f32| {
            (0..400_u16).map(move |i| {
                Point3::new(left + f32::from(i % 20) * 0.01, f32::from(i / 20) * 0.01, 1.0)
            })
        };
        let positions: Vec<Point3<f32>> =
            square(-0.2 - apart_m / 2.0).chain(square(apart_m / 2.0)).collect();
        let of_point = (0..800).map(|i| i / 400).collect();
        let patch = Patch {
            points: 400,
            center: Point3::origin(),
            normal: Vector3::z(),
            lab: Lab::zeros(),
        };
        let superpoints = Superpoints {
            of_point,
            patches: vec![patch; 2],
            adjacent: vec![(0, 1)],
            roughness_m: vec![0.0; 2],
        };
        (PointCloud { colors: vec![[90; 3]; positions.len()], positions }, superpoints)
    }

    #[test]
    fn gaps_exist_only_between_near_neighbors_that_do_not_touch() {
        let gaps_of = |apart_m| {
            let (cloud, superpoints) = two_squares(apart_m);
            gaps(&cloud, &superpoints, VOXEL_M)
        };
        let found = gaps_of(0.07);
        assert_eq!(found.len(), 1);
        assert!(
            (found[0].middle.x - -0.005).abs() < 0.02 && (found[0].middle.z - 1.0).abs() < 1e-6,
            "{:?}",
            found[0].middle
        );
        assert!(gaps_of(0.01).is_empty(), "the squares touch");
        assert!(gaps_of(0.5).is_empty(), "too far apart for a gap");
    }

    #[test]
    fn pairs_are_removed_where_most_frames_see_through_the_gap() {
        let folder = tempfile::tempdir().unwrap();
        let folder = Utf8Path::from_path(folder.path()).unwrap();
        let neighbors = |apart_m: f32, depths_m: &[f32]| {
            let (cloud, superpoints) = two_squares(apart_m);
            let frames: Vec<FrameRef> =
                (0..).zip(depths_m).map(|(i, &m)| flat_frame(folder, i, CAMERA, m)).collect();
            remove_pairs_across_gaps(
                &cloud,
                &superpoints,
                VOXEL_M,
                &frames,
                0.02,
                &Progress::silent(),
            )
            .unwrap()
        };
        let (wall, closed) = (2.0, 1.0);
        assert_eq!(neighbors(0.07, &[wall, closed, wall]), []);
        assert_eq!(neighbors(0.07, &[wall, closed]), [(0, 1)], "a tie keeps the pair");
        assert_eq!(neighbors(0.07, &[]), [(0, 1)], "no frames");
        assert_eq!(neighbors(0.01, &[wall, wall]), [(0, 1)], "the squares touch");
    }

    #[test]
    fn vote_depends_on_the_depth_measured_at_the_gap() {
        let camera = Camera::new(CAMERA, &Isometry3::identity());
        let seen = |depth_m: f32, at: Point3<f32>| {
            let depth_m = vec![depth_m; (CAMERA.width * CAMERA.height) as usize];
            vote(
                &at,
                &camera,
                &DepthImage { width: CAMERA.width, height: CAMERA.height, depth_m },
                0.02,
            )
        };
        let middle = Point3::new(0.0, 0.1, 1.0);
        let table = [
            (2.0, 1, "a surface behind the gap"),
            (1.01, -1, "a surface in the gap"),
            (0.6, 0, "a surface in front of the gap"),
            (0.0, 0, "no depth"),
        ];
        for (depth_m, expected, what) in table {
            assert_eq!(seen(depth_m, middle), expected, "{what}");
        }
        assert_eq!(seen(2.0, Point3::new(0.0, 0.0, -1.0)), 0, "behind the camera");
    }
}
