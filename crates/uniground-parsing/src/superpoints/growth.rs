//! Superpoints of a cloud that has grown. Superpoints of points that stayed do not change, so that
//! what frames saw of them stays valid. New points are divided into new superpoints.

use super::{Patch, Superpoints, coarsen_settings, compute, relabel_pairs};
use uniground_geometry::color::{Lab, srgb_to_lab};
use uniground_geometry::least_axis::least_axis;
use uniground_geometry::progress::{Cancelled, Progress};
use uniground_geometry::scene::{Addition, PointCloud};
use uniground_geometry::voxels::{NEIGHBORS_26, VoxelKey, VoxelMap, typical_spacing_m};
use uniground_geometry::{Matrix3, Point3, Vector3};
use uniground_types::settings::SuperpointSettings;

/// Returns the superpoints after an addition, and the new number of each previous one; `None`: all
/// of its points are gone.
///
/// `cloud` is the cloud after the addition.
///
/// # Errors
/// [`Cancelled`].
pub fn grow_superpoints(
    before: &Superpoints,
    addition: &Addition,
    cloud: &PointCloud,
    settings: &SuperpointSettings,
    progress: &Progress,
) -> Result<(Superpoints, Vec<Option<u32>>), Cancelled> {
    let mut left = vec![0_u32; before.patches.len()];
    for &point in &addition.kept {
        left[before.of_point[point as usize] as usize] += 1;
    }
    let mut count = 0;
    let number: Vec<Option<u32>> = left
        .iter()
        .map(|&points| {
            (points > 0).then(|| {
                count += 1;
                count - 1
            })
        })
        .collect();
    let stays = |superpoint: usize| number[superpoint].is_some();
    let mut of_point: Vec<u32> = addition
        .kept
        .iter()
        .filter_map(|&point| number[before.of_point[point as usize] as usize])
        .collect();
    let mut roughness_m: Vec<f32> =
        (0..left.len()).filter(|&s| stays(s)).map(|s| before.roughness_m[s]).collect();
    let mut patches = shrink_patches(before, &left, &of_point, cloud);
    let mut adjacent: Vec<(u32, u32)> = before
        .adjacent
        .iter()
        .filter_map(|&(a, b)| Some((number[a as usize]?, number[b as usize]?)))
        .collect();
    if !addition.new.is_empty() {
        let new = compute(&addition.new, settings, progress)?;
        of_point.extend(new.of_point.iter().map(|superpoint| superpoint + count));
        patches.extend(new.patches);
        roughness_m.extend(new.roughness_m);
        adjacent.extend(new.adjacent.iter().map(|(a, b)| (a + count, b + count)));
        progress.check()?;
        let voxel_m =
            coarsen_settings(*settings, typical_spacing_m(&addition.new.positions)).voxel_m;
        // A floor continues beyond the gap between new and known points.
        let reach_m = voxel_m.max(REACH * addition.apart_m);
        adjacent.extend(borders(cloud, &of_point, addition.kept.len(), reach_m));
    }
    let same: Vec<u32> = (0..patches.len() as u32).collect();
    Ok((
        Superpoints { of_point, patches, adjacent: relabel_pairs(&adjacent, &same), roughness_m },
        number,
    ))
}

/// Returns the patches that remain; those that lost points are measured again.
fn shrink_patches(
    before: &Superpoints,
    left: &[u32],
    of_kept: &[u32],
    cloud: &PointCloud,
) -> Vec<Patch> {
    let stay = || left.iter().zip(&before.patches).filter(|(left, _)| **left > 0);
    let has_lost: Vec<bool> = stay().map(|(left, patch)| *left < patch.points).collect();
    let mut members: Vec<Vec<u32>> = vec![Vec::new(); has_lost.len()];
    for (point, &superpoint) in (0..).zip(of_kept) {
        if has_lost[superpoint as usize] {
            members[superpoint as usize].push(point);
        }
    }
    stay()
        .zip(&members)
        .map(
            |((_, patch), members)| {
                if members.is_empty() { *patch } else { patch_of(cloud, members) }
            },
        )
        .collect()
}

fn patch_of(cloud: &PointCloud, points: &[u32]) -> Patch {
    let n = points.len() as f64;
    let positions = || points.iter().map(|&point| cloud.positions[point as usize]);
    // Single precision is too coarse far from the origin.
    let sum =
        positions().fold(nalgebra::Vector3::<f64>::zeros(), |sum, p| sum + p.coords.cast::<f64>());
    let center = Point3::from((sum / n).cast::<f32>());
    let scatter = positions()
        .map(|p| p - center)
        .fold(Matrix3::zeros(), |sum, d: Vector3<f32>| sum + d * d.transpose());
    let lab = points
        .iter()
        .map(|&point| srgb_to_lab(cloud.colors[point as usize]))
        .fold(Lab::zeros(), |sum, lab| sum + lab);
    Patch {
        points: points.len() as u32,
        center,
        normal: least_axis(&scatter).1,
        lab: lab / n as f32,
    }
}

/// Superpoints within this many gaps touch.
const REACH: f32 = 1.5;

/// Returns the pairs of previous and new superpoints that touch: with points in the same voxel, or
/// in two adjacent ones. The first `kept` points are the previous ones.
fn borders(cloud: &PointCloud, of_point: &[u32], kept: usize, reach_m: f32) -> Vec<(u32, u32)> {
    let mut near: VoxelMap<Vec<u32>> = VoxelMap::default();
    let mut add = |key: VoxelKey, superpoint: u32| {
        let here = near.entry(key).or_default();
        if !here.contains(&superpoint) {
            here.push(superpoint);
        }
    };
    for (p, &superpoint) in cloud.positions[kept..].iter().zip(&of_point[kept..]) {
        let key = VoxelKey::containing(p, reach_m);
        add(key, superpoint);
        NEIGHBORS_26.iter().for_each(|&d| add(key.offset(d), superpoint));
    }
    let mut pairs: Vec<(u32, u32)> = cloud.positions[..kept]
        .iter()
        .zip(of_point)
        .filter_map(|(p, &old)| Some((old, near.get(&VoxelKey::containing(p, reach_m))?)))
        .flat_map(|(old, new)| new.iter().map(move |&new| (old, new)))
        .collect();
    pairs.sort_unstable();
    pairs.dedup();
    pairs
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Returns a square of one meter in the plane, with a point every centimeter, starting at `x`.
    fn square(x: f32, z: f32, color: [u8; 3]) -> PointCloud {
        let at = (0..100).flat_map(|i| {
            (0..100).map(move |j| Point3::new(x + i as f32 * 0.01, j as f32 * 0.01, z))
        });
        let positions: Vec<Point3<f32>> = at.collect();
        PointCloud { colors: vec![color; positions.len()], positions }
    }

    fn addition(kept: Vec<u32>, new: PointCloud) -> Addition {
        Addition {
            made_of: String::new(),
            frames: Vec::new(),
            kept,
            new,
            apart_m: 0.04,
            frames_skipped: 0,
            findings: Vec::new(),
        }
    }

    fn grow(
        before: &PointCloud,
        addition: &Addition,
    ) -> (Superpoints, Superpoints, Vec<Option<u32>>) {
        let (settings, silent) = (SuperpointSettings::default(), Progress::silent());
        let first = compute(before, &settings, &silent).unwrap();
        let (now, number) =
            grow_superpoints(&first, addition, &addition.apply_to(before), &settings, &silent)
                .unwrap();
        (first, now, number)
    }

    #[test]
    fn empty_addition_changes_nothing() {
        let floor = square(0.0, 0.0, [120; 3]);
        let (first, now, number) =
            grow(&floor, &addition((0..floor.len() as u32).collect(), PointCloud::default()));
        assert_eq!(now, first);
        assert_eq!(number, (0..first.patches.len() as u32).map(Some).collect::<Vec<_>>());
    }

    #[test]
    fn remaining_points_keep_their_superpoints_and_touch_new_ones() {
        let (mut floor, more) = (square(0.0, 0.0, [120; 3]), square(1.0, 0.0, [120; 3]));
        // The red half, nearer to the origin, is removed.
        let reds = floor.positions.iter().zip(&mut floor.colors).filter(|(p, _)| p.x < 0.5);
        reds.for_each(|(_, color)| *color = [200, 40, 40]);
        let kept: Vec<u32> =
            (0..floor.len() as u32).filter(|&i| floor.positions[i as usize].x >= 0.5).collect();
        let (first, now, number) = grow(&floor, &addition(kept.clone(), more));
        for (at, &point) in kept.iter().enumerate() {
            assert_eq!(Some(now.of_point[at]), number[first.of_point[point as usize] as usize]);
        }
        let gone = number.iter().filter(|number| number.is_none()).count();
        assert!(
            gone > 0 && gone < first.patches.len(),
            "{gone} of {} are gone",
            first.patches.len()
        );
        let old = number.iter().flatten().count() as u32;
        assert!(
            now.adjacent.iter().any(|&(a, b)| a < old && b >= old),
            "old and new superpoints touch along their border"
        );
        let mut points = vec![0; now.patches.len()];
        now.of_point.iter().for_each(|&s| points[s as usize] += 1);
        assert_eq!(points, now.patches.iter().map(|patch| patch.points).collect::<Vec<u32>>());
        assert!(
            now.patches.iter().all(|patch| patch.center.x >= 0.5
                && patch.normal.z.abs() > 0.99
                && patch.points > 0)
        );
        assert_eq!(now.roughness_m.len(), now.patches.len());
    }
}
