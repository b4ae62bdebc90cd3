//! Finds which points of two recordings show the same place, and which things are therefore the
//! same.

use rayon::prelude::*;
use std::collections::{BTreeMap, BTreeSet, HashMap};
use uniground_geometry::progress::{Cancelled, Progress};
use uniground_geometry::scene::InstanceId;
use uniground_geometry::voxels::{NEIGHBORS_26, VoxelKey, VoxelMap};
use uniground_geometry::{Isometry3, Point3};

/// IoU of the points of two things from which they are the same.
const SAME_THING: f32 = 0.33;

/// A thing of which less than this share is left counts as a different one.
const LEFT: f32 = 0.25;

/// For the points of two recordings: the points of the other one at the same place.
pub struct Counterparts {
    of_before: Vec<Option<u32>>,
    of_after: Vec<bool>,
}

impl Counterparts {
    /// Matches the points of a scan that has grown: a point that stayed has bit-identical
    /// coordinates.
    #[must_use]
    pub fn match_identical(before: &[Point3<f32>], after: &[Point3<f32>]) -> Self {
        let bits = |p: &Point3<f32>| [p.x, p.y, p.z].map(f32::to_bits);
        let at: HashMap<[u32; 3], u32> = after.iter().zip(0..).map(|(p, i)| (bits(p), i)).collect();
        Self::new(before.iter().map(|p| at.get(&bits(p)).copied()).collect(), after.len())
    }

    /// Matches the points of two scans: the nearest point within `within_m` meters. `place`
    /// transforms `before` to `after`.
    ///
    /// # Errors
    /// [`Cancelled`].
    pub fn match_nearest(
        before: &[Point3<f32>],
        after: &[Point3<f32>],
        place: &Isometry3<f32>,
        within_m: f32,
        progress: &Progress,
    ) -> Result<Self, Cancelled> {
        // Where a cloud is very dense, a single point has thousands of neighbors.
        let nearest =
            |index: &NearestPoints, p: &Point3<f32>| progress.check().map(|()| index.nearest_to(p));
        // A point can be nearest to no other point and still have one near.
        let placed: Vec<Point3<f32>> = before.iter().map(|p| place * p).collect();
        let (index, back) =
            (NearestPoints::new(after, within_m), NearestPoints::new(&placed, within_m));
        let of_before = placed.par_iter().map(|p| nearest(&index, p)).collect::<Result<_, _>>()?;
        let of_after = after
            .par_iter()
            .map(|p| nearest(&back, p).map(|near| near.is_some()))
            .collect::<Result<_, _>>()?;
        Ok(Self { of_before, of_after })
    }

    fn new(of_before: Vec<Option<u32>>, after: usize) -> Self {
        let mut of_after = vec![false; after];
        of_before.iter().flatten().for_each(|&point| of_after[point as usize] = true);
        Self { of_before, of_after }
    }

    /// Returns the later recording's point at the place of this earlier point.
    #[must_use]
    pub fn counterpart_of(&self, point: usize) -> Option<u32> {
        self.of_before[point]
    }

    /// Returns whether the earlier recording has a point at the place of this later point.
    #[must_use]
    pub fn has_counterpart(&self, point: usize) -> bool {
        self.of_after[point]
    }

    /// Returns the share of the earlier recording's points that have a counterpart.
    #[must_use]
    pub fn share(&self) -> f32 {
        self.of_before.iter().flatten().count() as f32 / self.of_before.len().max(1) as f32
    }
}

/// Looks up the nearest of a set of points.
pub(super) struct NearestPoints<'a> {
    points: &'a [Point3<f32>],
    pub within_m: f32,
    by_voxel: VoxelMap<Vec<u32>>,
}

impl<'a> NearestPoints<'a> {
    pub fn new(points: &'a [Point3<f32>], within_m: f32) -> Self {
        let mut by_voxel: VoxelMap<Vec<u32>> = VoxelMap::default();
        for (p, i) in points.iter().zip(0..) {
            by_voxel.entry(VoxelKey::containing(p, within_m)).or_default().push(i);
        }
        Self { points, within_m, by_voxel }
    }

    /// Returns the point nearest to `p`, if one is within reach.
    pub fn nearest_to(&self, p: &Point3<f32>) -> Option<u32> {
        let key = VoxelKey::containing(p, self.within_m);
        let around = std::iter::once(key).chain(NEIGHBORS_26.iter().map(|&d| key.offset(d)));
        let near = around.filter_map(|key| self.by_voxel.get(&key)).flatten().copied();
        let distance = |i: u32| (self.points[i as usize] - p).norm_squared();
        near.map(|i| (distance(i), i))
            .filter(|(squared, _)| *squared <= self.within_m * self.within_m)
            .min_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)))
            .map(|(_, i)| i)
    }
}

/// Returns pairs of things that are the same in both recordings, by the owners of their points.
/// Each thing has at most one partner; best fitting pairs come first.
#[must_use]
pub fn match_things(
    before: &[InstanceId],
    after: &[InstanceId],
    counterparts: &Counterparts,
) -> Vec<(InstanceId, InstanceId)> {
    let mut shared: BTreeMap<(InstanceId, InstanceId), u32> = BTreeMap::new();
    let (mut sizes_before, mut sizes_after, mut whole) =
        (BTreeMap::new(), BTreeMap::new(), BTreeMap::new());
    for (point, &old) in before.iter().enumerate() {
        *whole.entry(old).or_insert(0_u32) += 1;
        let Some(counterpart) = counterparts.counterpart_of(point) else { continue };
        let new = after[counterpart as usize];
        *sizes_before.entry(old).or_insert(0_u32) += 1;
        *sizes_after.entry(new).or_insert(0_u32) += 1;
        if old.0 != 0 && new.0 != 0 {
            *shared.entry((old, new)).or_insert(0) += 1;
        }
    }
    let iou = |(old, new), both: u32| {
        both as f32 / (sizes_before[&old] + sizes_after[&new] - both) as f32
    };
    let mut scored: Vec<(f32, (InstanceId, InstanceId))> =
        shared.iter().map(|(&pair, &both)| (iou(pair, both), pair)).collect();
    scored.retain(|(iou, (old, _))| {
        *iou >= SAME_THING && sizes_before[old] as f32 >= LEFT * whole[old] as f32
    });
    scored.sort_by(|a, b| b.0.total_cmp(&a.0).then(a.1.cmp(&b.1)));
    let (mut taken_before, mut taken_after) = (BTreeSet::new(), BTreeSet::new());
    let mut found = Vec::new();
    for (_, (old, new)) in scored {
        if !taken_before.contains(&old) && !taken_after.contains(&new) {
            taken_before.insert(old);
            taken_after.insert(new);
            found.push((old, new));
        }
    }
    found.sort_unstable();
    found
}

#[cfg(test)]
mod tests {
    use super::*;

    fn ids(ids: &[u32]) -> Vec<InstanceId> {
        ids.iter().copied().map(InstanceId).collect()
    }

    fn line(x: impl IntoIterator<Item = f32>) -> Vec<Point3<f32>> {
        x.into_iter().map(|x| Point3::new(x, 0.0, 0.0)).collect()
    }

    #[test]
    fn things_match_by_shared_points() {
        let before = line([0.0, 1.0, 2.0, 3.0, 4.0, 5.0]);
        // 5.0 is gone, 6.0 is new.
        let after = line([4.0, 3.0, 2.0, 1.0, 0.0, 6.0]);
        let same = Counterparts::match_identical(&before, &after);
        let found = match_things(&ids(&[1, 1, 1, 2, 2, 3]), &ids(&[9, 8, 7, 7, 7, 3]), &same);
        assert_eq!(
            found,
            [(InstanceId(1), InstanceId(7)), (InstanceId(2), InstanceId(8))],
            "only one half of a split thing matches"
        );
        assert!(same.counterpart_of(5).is_none() && !same.has_counterpart(5));
        assert!((same.share() - 5.0 / 6.0).abs() < 1e-6);
    }

    #[test]
    fn points_of_two_scans_match_within_the_radius() {
        let place = Isometry3::translation(0.0, 1.0, 0.0);
        let (before, after) = (
            line([0.0, 1.0]),
            vec![
                Point3::new(0.04, 1.0, 0.0),
                Point3::new(0.01, 1.0, 0.0),
                Point3::new(1.2, 1.0, 0.0),
            ],
        );
        let near = Counterparts::match_nearest(&before, &after, &place, 0.05, &Progress::silent())
            .unwrap();
        assert_eq!((near.counterpart_of(0), near.counterpart_of(1)), (Some(1), None));
        assert_eq!([0, 1, 2].map(|i| near.has_counterpart(i)), [true, true, false]);
    }

    #[test]
    fn cancellation_stops_the_counterpart_search() {
        // A thousand points in one place: each has a thousand neighbors.
        let (dense, checks) = (
            vec![Point3::origin(); 1000],
            std::sync::Arc::new(std::sync::atomic::AtomicUsize::new(0)),
        );
        let checked = checks.clone();
        let progress = Progress::new(
            |_, _| {},
            move || checked.fetch_add(1, std::sync::atomic::Ordering::Relaxed) >= 10,
        );
        let found =
            Counterparts::match_nearest(&dense, &dense, &Isometry3::identity(), 0.05, &progress);
        assert!(found.is_err());
        assert!(
            checks.load(std::sync::atomic::Ordering::Relaxed) < 1000,
            "every point was checked in spite of the cancellation"
        );
    }
}
