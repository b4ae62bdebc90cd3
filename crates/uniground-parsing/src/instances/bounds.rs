//! Boxes that a few stray points can not stretch.

use super::InstanceSettings;
use crate::relief::FlatRelief;
use uniground_geometry::boxes::{Aabb, OrientedBox};
use uniground_geometry::statistics::quantile;
use uniground_geometry::voxels::{NEIGHBOURS_26, VoxelKey, VoxelMap};
use uniground_geometry::{Point2, Point3};

/// Axis-aligned and oriented box of the points that have company. Thin extents shrink by what noise
/// of standard deviation `noise_m` (metres) adds to them; what lies flat is as thick as its relief
/// says.
pub(super) fn robust(
    positions: &[Point3<f32>],
    noise_m: f32,
    relief: Option<&FlatRelief>,
    settings: &InstanceSettings,
) -> (Aabb, OrientedBox) {
    let mut kept = in_company(positions, settings);
    // A sparse thing is all strays: then every point counts.
    if kept.len() * 2 < positions.len() {
        kept = positions.to_vec();
    }
    let noise_m = if relief.is_some() { 0.0 } else { noise_m };
    if let Some(relief) = relief {
        kept = relief.flattened(&kept);
    }
    let bounds: [(f32, f32); 3] = std::array::from_fn(|axis| {
        let mut values: Vec<f32> = kept.iter().map(|p| p[axis]).collect();
        let mut at = |q: f32| quantile(&mut values, q).unwrap_or(0.0);
        let (lo, hi) = (at(settings.stray_share), at(1.0 - settings.stray_share));
        // What noise adds matters where a thing is thin: a picture three times as thick is another
        // box, a sofa is not.
        if hi - lo > settings.thin_sigmas * noise_m {
            return (lo, hi);
        }
        let inset = settings.noise_sigmas * noise_m;
        ((lo + inset).min(at(settings.trim)), (hi - inset).max(at(1.0 - settings.trim)))
    });
    let aabb =
        Aabb::from_corners(Point3::from(bounds.map(|b| b.0)), Point3::from(bounds.map(|b| b.1)));
    let (lo, hi) = (aabb.min(), aabb.max());
    let footprint: Vec<Point2<f32>> = kept
        .iter()
        .map(Point3::xy)
        .filter(|p| (lo.x..=hi.x).contains(&p.x) && (lo.y..=hi.y).contains(&p.y))
        .collect();
    let flat = OrientedBox { center: aabb.center, size: aabb.size, yaw_rad: 0.0 };
    (aabb, OrientedBox::min_area(&footprint, (lo.z, hi.z)).unwrap_or(flat))
}

/// Points whose voxel and its 26 neighbours hold enough other points.
fn in_company(positions: &[Point3<f32>], settings: &InstanceSettings) -> Vec<Point3<f32>> {
    let mut counts: VoxelMap<u32> = VoxelMap::default();
    for p in positions {
        *counts.entry(VoxelKey::of(p, settings.stray_voxel_m)).or_default() += 1;
    }
    let mut company: VoxelMap<bool> = VoxelMap::default();
    for &key in counts.keys() {
        let around: u32 = NEIGHBOURS_26.iter().filter_map(|&d| counts.get(&key.offset(d))).sum();
        company.insert(key, counts[&key] - 1 + around >= settings.stray_neighbours);
    }
    positions
        .iter()
        .filter(|p| company[&VoxelKey::of(p, settings.stray_voxel_m)])
        .copied()
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;
    use uniground_geometry::Vector3;

    fn block() -> Vec<Point3<f32>> {
        (0..20)
            .flat_map(|x| {
                (0..10).flat_map(move |y| {
                    (0..10).map(move |z| Point3::new(x as f32, y as f32, z as f32) * 0.02)
                })
            })
            .collect()
    }

    #[test]
    fn a_stray_point_does_not_stretch_the_box() {
        let clean = robust(&block(), 0.0, None, &InstanceSettings::default()).0;
        let mut stray = block();
        stray.push(Point3::new(3.0, 3.0, 3.0));
        let found = robust(&stray, 0.0, None, &InstanceSettings::default()).0;
        assert!(found.iou(&clean) > 0.98, "{found:?} against {clean:?}");
        assert!((clean.size - Vector3::new(0.38, 0.18, 0.18)).norm() < 0.05, "{clean:?}");
    }

    #[test]
    fn a_thin_thing_keeps_its_thickness_under_noise() {
        // A picture of 2 cm on a wall under noise of 1.7 cm, nearly normal: a sum of four even
        // ones.
        let even = |i: usize| ((i * 7919 + 13) % 1000) as f32 / 1000.0 - 0.5;
        let noise_m = 0.017;
        let noise = |i: usize| {
            (1..=4).map(|k| even(i * (2 * k + 29) + k * 331)).sum::<f32>() * 3_f32.sqrt() * noise_m
        };
        let points: Vec<_> = (0..4000)
            .map(|i| {
                Point3::new(
                    (i % 60) as f32 * 0.01,
                    even(i) * 0.02 + noise(i),
                    (i / 60) as f32 * 0.01,
                )
            })
            .collect();
        let raw = Aabb::around(&points).unwrap().size;
        let (aabb, _) = robust(&points, noise_m, None, &InstanceSettings::default());
        assert!(aabb.size.y < 0.75 * raw.y, "{} from {}", aabb.size.y, raw.y);
        assert!(
            (aabb.size.x - raw.x).abs() < 0.01 && (aabb.size.z - raw.z).abs() < 0.01,
            "only the thin extent: {}",
            aabb.size
        );
    }

    #[test]
    fn lone_points_still_have_a_box() {
        let (aabb, oriented) =
            robust(&[Point3::new(1.0, 2.0, 3.0)], 0.0, None, &InstanceSettings::default());
        assert_eq!((aabb.center, aabb.size), (Point3::new(1.0, 2.0, 3.0), Vector3::zeros()));
        assert_eq!(oriented.size, Vector3::zeros());
    }

    proptest! {
        /// Robust bounds never reach beyond the points.
        #[test]
        fn the_robust_box_lies_inside_the_raw_one(points in prop::collection::vec(prop::array::uniform3(-1.0_f32..1.0), 1..200)) {
            let points: Vec<_> = points.into_iter().map(Point3::from).collect();
            let raw = Aabb::around(&points).unwrap();
            let (aabb, _) = robust(&points, 0.05, None, &InstanceSettings::default());
            prop_assert!((0..3).all(|i| aabb.min()[i] >= raw.min()[i] - 1e-5 && aabb.max()[i] <= raw.max()[i] + 1e-5));
        }
    }
}
