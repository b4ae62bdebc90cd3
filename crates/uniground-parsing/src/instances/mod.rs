//! Turns regions into instances: boxes, colors, support, structure, and which regions to drop.
//! Class-agnostic.

mod bounds;
mod columns;
mod single;
mod structure;
mod support;

use crate::labels::{Compound, Labels};
use crate::planes::Planes;
use crate::relief::FlatRelief;
use crate::superpoints::Superpoints;
use crate::views::{InstanceViews, Sighting};
use columns::Columns;
use rayon::prelude::*;
pub use single::{build_from_points, merge_points};
use std::collections::BTreeMap;
pub use support::{Body, find_supports};
use uniground_geometry::boxes::{Aabb, OrientedBox};
use uniground_geometry::color::ColorHistogram;
use uniground_geometry::least_axis::least_axis;
use uniground_geometry::moments::Moments;
use uniground_geometry::progress::{Cancelled, Progress};
use uniground_geometry::scene::{
    Instance, InstanceId, Level, PointCloud, Structure, Support, View,
};
use uniground_geometry::statistics::{median, quantile};
use uniground_geometry::{Point3, Vector3};
use uniground_types::settings::InstanceSettings;

/// The things, parts, wholes and parts of the building that stage 1 found.
pub struct BuiltInstances<'a> {
    /// Sorted by id.
    pub instances: Vec<Instance>,
    /// The instances each point belongs to.
    pub labels: Labels<'a>,
    /// Sightings of the instances, with their final ids.
    pub sightings: Vec<Sighting>,
    /// Number of regions dropped because masks show something else.
    pub dropped: u32,
    /// Number of regions dropped as too small.
    pub specks: u32,
}

/// Builds instances from numbered regions, parts and wholes, and their sightings in frames. Regions
/// that are not instances are dropped, and the others are renumbered without gaps.
///
/// A thing has masks of its own. Surface pieces doubled by drifting poses, rims between things and
/// other leftovers are in no mask or in a mask of something else. Their mean agreement over the
/// frames that see them, weighted by visible points, is low.
///
/// Parts of the building are recognized by their planes. A region that no frame sees is not judged,
/// unless it is a speck: too few points, shown on too few pixels, to recognize it. Parts and wholes
/// are judged in the same way, are dropped with their things, and are limited in number by the
/// settings.
///
/// # Errors
/// [`Cancelled`].
pub fn build<'a>(
    cloud: &PointCloud,
    superpoints: &Superpoints,
    planes: &Planes,
    labels: Labels<'a>,
    sighted: InstanceViews,
    settings: &InstanceSettings,
    progress: &Progress,
) -> Result<BuiltInstances<'a>, Cancelled> {
    progress.report("instances", 0.0)?;
    let InstanceViews { sightings, reliefs } = sighted;
    let mut members: Vec<Vec<u32>> = vec![Vec::new(); labels.len()];
    for point in 0..cloud.len() {
        labels
            .instances_of_point(point)
            .for_each(|id| members[id.0 as usize - 1].push(point as u32));
    }
    let noise = SurfaceNoise::of(superpoints);
    let mut shapes: Vec<RegionShape> = members
        .par_iter()
        .map(|points| {
            progress.check().map(|()| {
                RegionShape::measure(cloud, points, noise.noise_around(points), None, settings)
            })
        })
        .collect::<Result<_, Cancelled>>()?;
    let lowest_z = || quantile(&mut cloud.positions.iter().map(|p| p.z).collect::<Vec<_>>(), 0.01);
    let floor_z = planes.floor_z().or_else(lowest_z).unwrap_or(0.0);
    let things = labels.things as usize;
    let mut structures =
        classify_structures(&shapes[..things], &members, superpoints, planes, floor_z);
    let flat = reliefs.iter().map(|(id, relief)| (id.0 as usize - 1, relief));
    for (i, relief) in flat.filter(|(i, _)| structures.get(*i).is_none_or(Option::is_none)) {
        shapes[i] = RegionShape::measure(
            cloud,
            &members[i],
            noise.noise_around(&members[i]),
            Some(relief),
            settings,
        );
    }
    let specks = find_specks(&shapes[..things], &structures, &sightings, settings);
    let mut shown = agreement(labels.len(), &sightings);
    // Color shows a flat thing where masks do not.
    for (points, shown) in members[..things].iter().zip(&mut shown) {
        if is_flat_thing(points, superpoints, planes) {
            *shown = None;
        }
    }
    let new_id = assign_ids(&labels, &structures, &specks, &shown, settings);
    let stays = |i: usize| new_id[i + 1].0 != 0;
    let mut at = 0..;
    shapes.retain(|_| at.next().is_some_and(stays));
    let mut at = 0..;
    structures.retain(|_| at.next().is_some_and(stays));
    let labels = labels.renumber(&new_id);
    let specks = specks.iter().filter(|speck| **speck).count() as u32;
    let dropped = things as u32 - labels.things - specks;

    let mut at = 0..;
    members.retain(|_| at.next().is_some_and(stays));
    let bodies: Vec<Body> = shapes
        .par_iter()
        .zip(&members)
        .take(structures.len())
        .map(|(shape, points)| shape.body(cloud, points))
        .collect();
    let mut supports = find_supports(&bodies, &structures, floor_z, progress)?;
    for (i, support) in supports.iter_mut().enumerate().filter(|(i, _)| structures[*i].is_none()) {
        let held = support::extend_to_support(i, *support, &bodies, &structures, floor_z);
        shapes[i].extend_to(held.from_z, held.to_z);
        *support = held.support;
    }
    for (compound, i) in labels.compounds.iter().zip(structures.len()..) {
        supports.push(support_of_compound(compound, i, &mut shapes, &supports));
    }
    let levels = std::iter::repeat_n((Level::Thing, Vec::new()), structures.len());
    let levels = levels
        .chain(labels.compounds.iter().map(|compound| (compound.level, compound.things.clone())));
    let structures = structures.iter().copied().chain(std::iter::repeat(None));
    let instances = (1..)
        .zip(levels)
        .zip(shapes.into_iter().zip(supports))
        .zip(structures)
        .map(|(((id, (level, things)), (shape, support)), structure)| Instance {
            id: InstanceId(id),
            level,
            things,
            aabb: shape.aabb,
            raw_box: shape.raw_box,
            oriented_box: shape.oriented_box,
            point_count: shape.point_count,
            mean_rgb: shape.mean_rgb,
            colors: shape.colors,
            planarity: shape.planarity,
            structure,
            support,
            height_above_floor_m: shape.aabb.min().z - floor_z,
            views: Vec::new(),
            names: Vec::new(),
            given_name: None,
            found_for: None,
            merged_from: Vec::new(),
            dismissed: false,
            gone: false,
        })
        .collect();
    let renumbered = |sighting: Sighting| Sighting {
        instance: new_id[sighting.instance.0 as usize],
        ..sighting
    };
    let sightings =
        sightings.into_iter().map(renumbered).filter(|sighting| sighting.instance.0 != 0).collect();
    Ok(BuiltInstances { instances, labels, sightings, dropped, specks })
}

/// Fewer pixels than this show nothing recognizable, whatever the camera.
const MIN_PICTURE_PX: u32 = 16 * 16;

/// Returns which regions are specks. A scan without frames has none, since there is no evidence.
fn find_specks(
    shapes: &[RegionShape],
    structures: &[Option<Structure>],
    sightings: &[Sighting],
    settings: &InstanceSettings,
) -> Vec<bool> {
    let mut largest_px = vec![0; shapes.len()];
    for Sighting { instance, view: View { box_px: [left, top, right, bottom], .. }, .. } in
        sightings
    {
        if let Some(largest) = largest_px.get_mut(instance.0 as usize - 1) {
            *largest = (right - left).saturating_mul(bottom - top).max(*largest);
        }
    }
    let few = |(i, shape): (usize, &RegionShape)| {
        shape.point_count < settings.min_points
            && largest_px[i] < MIN_PICTURE_PX
            && structures[i].is_none()
            && !sightings.is_empty()
    };
    shapes.iter().enumerate().map(few).collect()
}

/// Returns the new id of every candidate instance, by its old one; 0: dropped.
fn assign_ids(
    labels: &Labels,
    structures: &[Option<Structure>],
    specks: &[bool],
    shown: &[Option<f32>],
    settings: &InstanceSettings,
) -> Vec<InstanceId> {
    let mut new_id = vec![InstanceId(0); labels.len() + 1];
    let mut ids = (1..).map(InstanceId);
    for (i, structure) in structures.iter().enumerate() {
        if structure.is_some()
            || !specks[i] && shown[i].is_none_or(|agreement| agreement >= settings.min_agreement)
        {
            new_id[i + 1] = ids.next().unwrap_or_default();
        }
    }
    let things = new_id.iter().filter(|id| id.0 != 0).count() as f32;
    let is_kept = |(compound, i): &(&Compound, usize)| {
        let whole = compound.things.iter().all(|thing| new_id[thing.0 as usize].0 != 0);
        whole && shown[*i].is_some_and(|agreement| agreement >= settings.min_agreement)
    };
    let compounds = labels.compounds.iter().zip(structures.len()..).filter(is_kept);
    let most = (settings.parts_and_wholes * things) as usize;
    let compounds: Vec<usize> = compounds.map(|(_, i)| i).take(most).collect();
    compounds.into_iter().zip(ids).for_each(|(i, id)| new_id[i + 1] = id);
    new_id
}

/// Returns what the compound at index `i` rests on. A whole rests on what its lowest thing rests
/// on. A part rests on what its thing rests on if it reaches as low, else on the thing. A whole
/// reaches from floor to ceiling if its things do.
fn support_of_compound(
    compound: &Compound,
    i: usize,
    shapes: &mut [RegionShape],
    supports: &[Support],
) -> Support {
    let reach = |i: usize, shapes: &[RegionShape]| (shapes[i].aabb.min().z, shapes[i].aabb.max().z);
    let things = compound.things.iter().map(|thing| thing.0 as usize - 1);
    let Some(lowest) =
        things.clone().min_by(|&a, &b| reach(a, shapes).0.total_cmp(&reach(b, shapes).0))
    else {
        return Support::Nothing;
    };
    let (bottom_z, top_z) = reach(i, shapes);
    let from_z = reach(lowest, shapes).0;
    match compound.level {
        Level::Part if bottom_z > from_z + support::CONTACT_M => {
            Support::Instance { id: InstanceId(lowest as u32 + 1) }
        }
        Level::Whole => {
            let to_z = things.map(|thing| reach(thing, shapes).1).fold(top_z, f32::max);
            shapes[i].extend_to(bottom_z.min(from_z), to_z);
            supports[lowest]
        }
        _ => supports[lowest],
    }
}

/// Returns whether most of these points belong to a flat thing. Merging keeps those apart.
fn is_flat_thing(points: &[u32], superpoints: &Superpoints, planes: &Planes) -> bool {
    let superpoint = |point: u32| superpoints.of_point[point as usize] as usize;
    let flat = points.iter().filter(|p| planes.flat_thing_of[superpoint(**p)].is_some()).count();
    2 * flat > points.len()
}

/// Returns which part of the building each region is, if any.
fn classify_structures(
    shapes: &[RegionShape],
    members: &[Vec<u32>],
    superpoints: &Superpoints,
    planes: &Planes,
    floor_z: f32,
) -> Vec<Option<Structure>> {
    shapes
        .iter()
        .zip(members)
        .map(|(shape, points)| {
            let mut on_plane: BTreeMap<u32, u32> = BTreeMap::new();
            points
                .iter()
                .filter_map(|&p| planes.of_superpoint[superpoints.of_point[p as usize] as usize])
                .for_each(|plane| *on_plane.entry(plane).or_default() += 1);
            structure::classify(shape, &on_plane.into_iter().collect::<Vec<_>>(), planes, floor_z)
        })
        .collect()
}

/// Returns how well masks agree with each of the numbered regions, `0..=1`; `None` where no frame
/// sees it.
fn agreement(count: usize, sightings: &[Sighting]) -> Vec<Option<f32>> {
    let mut sums = vec![(0.0, 0.0); count];
    for Sighting { instance, view, agreement, .. } in sightings {
        let (sum, weight) = &mut sums[instance.0 as usize - 1];
        *sum += view.visible_points as f32 * agreement;
        *weight += view.visible_points as f32;
    }
    sums.into_iter().map(|(sum, weight)| (weight > 0.0).then(|| sum / weight)).collect()
}

/// The measurement noise of surface points.
struct SurfaceNoise<'a> {
    superpoints: &'a Superpoints,
    scene_m: f32,
}

impl<'a> SurfaceNoise<'a> {
    fn of(superpoints: &'a Superpoints) -> Self {
        // Most of a room is flat, so roughness at the median is noise.
        let mut all: Vec<f32> =
            superpoints.of_point.iter().map(|&s| superpoints.roughness_m[s as usize]).collect();
        let scene_m = median(&mut all).unwrap_or(0.0);
        Self { superpoints, scene_m }
    }

    /// Returns the standard deviation of the noise around these points, meters. Distant things are
    /// noisier than the rest of the scene. Leaves of a plant are rough without being noisy, hence
    /// the upper bound.
    fn noise_around(&self, points: &[u32]) -> f32 {
        const FAR_FACTOR: f32 = 2.0;
        let mut here: Vec<f32> = points
            .iter()
            .map(|&p| self.superpoints.roughness_m[self.superpoints.of_point[p as usize] as usize])
            .collect();
        median(&mut here).unwrap_or(0.0).min(FAR_FACTOR * self.scene_m)
    }
}

/// The shape of one region, before it is compared with the others.
struct RegionShape {
    point_count: u32,
    aabb: Aabb,
    raw_box: Aabb,
    oriented_box: OrientedBox,
    mean_rgb: [u8; 3],
    colors: ColorHistogram,
    planarity: f32,
}

impl RegionShape {
    fn measure(
        cloud: &PointCloud,
        members: &[u32],
        noise_m: f32,
        relief: Option<&FlatRelief>,
        settings: &InstanceSettings,
    ) -> Self {
        let positions: Vec<Point3<f32>> =
            members.iter().map(|&i| cloud.positions[i as usize]).collect();
        let colors = || members.iter().map(|&i| cloud.colors[i as usize]);
        let raw_box = Aabb::around(&positions)
            .unwrap_or(Aabb { center: Point3::origin(), size: Vector3::zeros() });
        let (aabb, oriented_box) = bounds::robust_boxes(&positions, noise_m, relief, settings);
        let planarity = planarity(&positions);
        let n = members.len().max(1) as u64;
        let sum =
            colors().fold([0_u64; 3], |sum, c| std::array::from_fn(|i| sum[i] + u64::from(c[i])));
        Self {
            point_count: members.len() as u32,
            aabb,
            raw_box,
            oriented_box,
            mean_rgb: sum.map(|s| ((s + n / 2) / n) as u8),
            colors: ColorHistogram::from_colors(colors()),
            planarity,
        }
    }
}

impl RegionShape {
    fn body(&self, cloud: &PointCloud, members: &[u32]) -> Body {
        // Without outliers, but with what noise adds to thin things.
        let around =
            Aabb { size: self.aabb.size.add_scalar(2.0 * support::CONTACT_M), ..self.aabb };
        let points =
            members.iter().map(|&i| cloud.positions[i as usize]).filter(|p| around.contains(p));
        Body { aabb: self.aabb, columns: Columns::from_points(points, self.oriented_box.yaw_rad) }
    }

    /// Extends the shape to these heights, meters: its legs or its cord were not seen.
    fn extend_to(&mut self, bottom_z: f32, top_z: f32) {
        let (min, max) = (self.aabb.min(), self.aabb.max());
        self.aabb = Aabb::from_corners(
            Point3::new(min.x, min.y, bottom_z),
            Point3::new(max.x, max.y, top_z),
        );
        let OrientedBox { center, size, .. } = &mut self.oriented_box;
        (center.z, size.z) = (f32::midpoint(top_z, bottom_z), top_z - bottom_z);
    }
}

/// Points this close to the best plane count as on it, meters.
const ON_PLANE_M: f32 = 0.03;

/// Returns the share of the points within 3 cm of their best plane.
#[must_use]
pub fn planarity(positions: &[Point3<f32>]) -> f32 {
    let Moments { mean, covariance } = Moments::from_points(positions);
    let (_, normal) = least_axis(&covariance);
    let on_plane =
        positions.iter().filter(|p| (*p - mean).dot(&normal).abs() <= ON_PLANE_M).count();
    on_plane as f32 / positions.len().max(1) as f32
}

#[cfg(test)]
mod tests {
    use super::*;
    use uniground_geometry::scene::FrameIndex;

    #[test]
    fn agreement_is_weighted_by_visible_points_and_none_when_unseen() {
        let seen = |instance, frame, visible_points, agreement| Sighting {
            instance: InstanceId(instance),
            view: View {
                frame: FrameIndex(frame),
                visible_points,
                box_px: [0, 0, 9, 9],
                mask: None,
            },
            whole: 1.0,
            covered_px: 81.0,
            agreement,
        };
        let found =
            agreement(3, &[seen(1, 0, 300, 0.8), seen(3, 0, 50, 0.0), seen(1, 1, 100, 0.4)]);
        assert_eq!(
            found.iter().map(|a| a.map(|a| (a * 100.0_f32).round())).collect::<Vec<_>>(),
            [Some(70.0), None, Some(0.0)]
        );
    }

    /// Two blocks, a sliver that no mask shows, and a speck of a few points and pixels, seen by one
    /// frame.
    #[test]
    fn slivers_and_specks_are_dropped_and_ids_renumbered() {
        let block = |x: f32, side: u16| {
            (0..side.pow(3)).map(move |i| {
                let at = |k: u16| f32::from(i / side.pow(u32::from(k)) % side) * 0.02;
                Point3::new(x + at(0), at(1), at(2))
            })
        };
        let positions: Vec<Point3<f32>> =
            block(0.0, 10).chain(block(1.0, 8)).chain(block(2.0, 6)).chain(block(3.0, 3)).collect();
        let region_of: Vec<u32> = [(0, 1000), (1, 512), (2, 216), (3, 27)]
            .into_iter()
            .flat_map(|(r, n)| std::iter::repeat_n(r, n))
            .collect();
        let cloud = PointCloud { colors: vec![[90; 3]; positions.len()], positions };
        let superpoints = Superpoints {
            of_point: region_of.clone(),
            patches: Vec::new(),
            adjacent: Vec::new(),
            roughness_m: vec![0.002; 4],
        };
        let planes = Planes::new(Vec::new(), vec![None; 4]);
        let seen = |instance, agreement| Sighting {
            instance: InstanceId(instance),
            view: View {
                frame: FrameIndex(0),
                visible_points: 100,
                box_px: [0, 0, 9, 9],
                mask: None,
            },
            whole: 1.0,
            covered_px: 81.0,
            agreement,
        };
        let sightings = vec![seen(1, 0.9), seen(2, 0.1), seen(3, 0.5), seen(4, 0.9)];
        let settings = InstanceSettings::default();
        let labels = Labels::from_regions(&region_of, &superpoints, Vec::new());
        let sighted = InstanceViews { sightings: sightings.clone(), reliefs: BTreeMap::new() };
        let built =
            build(&cloud, &superpoints, &planes, labels, sighted, &settings, &Progress::silent())
                .unwrap();
        assert_eq!(
            (
                built.dropped,
                built.specks,
                built.instances.iter().map(|i| i.point_count).collect::<Vec<_>>()
            ),
            (1, 1, vec![1000, 216])
        );
        assert_eq!([0, 1200, 1600].map(|i| built.labels.thing_of_point[i].0), [1, 0, 2]);
        assert_eq!(built.sightings.iter().map(|s| s.instance.0).collect::<Vec<_>>(), [1, 2]);
        // Color shows a flat thing where masks do not.
        let mut planes = planes;
        planes.flat_thing_of[1] = Some(0);
        let labels = Labels::from_regions(&region_of, &superpoints, Vec::new());
        let sighted = InstanceViews { sightings, reliefs: BTreeMap::new() };
        let built =
            build(&cloud, &superpoints, &planes, labels, sighted, &settings, &Progress::silent())
                .unwrap();
        assert_eq!((built.dropped, built.specks, built.instances.len()), (0, 1, 3));
    }
}
