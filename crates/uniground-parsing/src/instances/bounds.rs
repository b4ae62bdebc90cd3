//! Robust bounding boxes that a few outliers cannot stretch.

use super::InstanceSettings;
use crate::relief::FlatRelief;
use uniground_geometry::boxes::{Aabb, OrientedBox};
use uniground_geometry::statistics::quantile;
use uniground_geometry::voxels::{NEIGHBORS_26, VoxelKey, VoxelMap};
use uniground_geometry::{Point2, Point3};

/// Computes the axis-aligned and oriented box of the points that have enough neighbors. Thin
/// extents shrink by what noise of standard deviation `noise_m` (meters) adds to them. Something
/// flat on a plane gets the thickness of its relief.
pub(super) fn robust_boxes(
    positions: &[Point3<f32>],
    noise_m: f32,
    relief: Option<&FlatRelief>,
    settings: &InstanceSettings,
) -> (Aabb, OrientedBox) {
    let mut kept = remove_isolated(positions, settings);
    // In a sparse thing every point counts as an outlier. Then all points are used.
    if kept.len() * 2 < positions.len() {
        kept = positions.to_vec();
    }
    let noise_m = if relief.is_some() { 0.0 } else { noise_m };
    if let Some(relief) = relief {
        kept = relief.flatten(&kept);
    }
    let bounds: [(f32, f32); 3] = std::array::from_fn(|axis| {
        let mut values: Vec<f32> = kept.iter().map(|p| p[axis]).collect();
        let mut at = |q: f32| quantile(&mut values, q).unwrap_or(0.0);
        let (lo, hi) = (at(settings.stray_share), at(1.0 - settings.stray_share));
        // Noise matters only where a thing is thin: a picture three times as thick is a different
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
    (aabb, OrientedBox::min_area(&footprint, (lo.z, hi.z)).unwrap_or(aabb.into()))
}

/// Returns the points whose voxel and its 26 neighbors hold enough other points.
fn remove_isolated(positions: &[Point3<f32>], settings: &InstanceSettings) -> Vec<Point3<f32>> {
    let mut counts: VoxelMap<u32> = VoxelMap::default();
    for p in positions {
        *counts.entry(VoxelKey::containing(p, settings.stray_voxel_m)).or_default() += 1;
    }
    let mut company: VoxelMap<bool> = VoxelMap::default();
    for &key in counts.keys() {
        let around: u32 = NEIGHBORS_26.iter().filter_map(|&d| counts.get(&key.offset(d))).sum();
        company.insert(key, counts[&key] - 1 + around >= settings.stray_neighbours);
    }
    positions
        .iter()
        .filter(|p| company[&VoxelKey::containing(p, settings.stray_voxel_m)])
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
    fn outlier_does_not_stretch_the_box() {
        let clean = robust_boxes(&block(), 0.0, None, &InstanceSettings::default()).0;
        let mut stray = block();
        stray.push(Point3::new(3.0, 3.0, 3.0));
        let found = robust_boxes(&stray, 0.0, None, &InstanceSettings::default()).0;
        assert!(found.iou(&clean) > 0.98, "{found:?} against {clean:?}");
        assert!((clean.size - Vector3::new(0.38, 0.18, 0.18)).norm() < 0.05, "{clean:?}");
    }

    #[test]
    fn noise_does_not_inflate_thin_extents() {
        // A picture 2 cm thick with noise of 1.7 cm. The noise is nearly normal: a sum of four
        // uniform values.
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
        let (aabb, _) = robust_boxes(&points, noise_m, None, &InstanceSettings::default());
        assert!(aabb.size.y < 0.75 * raw.y, "{} from {}", aabb.size.y, raw.y);
        assert!(
            (aabb.size.x - raw.x).abs() < 0.01 && (aabb.size.z - raw.z).abs() < 0.01,
            "only the thin extent shrinks: {}",
            aabb.size
        );
    }

    #[test]
    fn single_point_has_a_box_of_zero_size() {
        let (aabb, oriented) =
            robust_boxes(&[Point3::new(1.0, 2.0, 3.0)], 0.0, None, &InstanceSettings::default());
        assert_eq!((aabb.center, aabb.size), (Point3::new(1.0, 2.0, 3.0), Vector3::zeros()));
        assert_eq!(oriented.size, Vector3::zeros());
    }

    proptest! {
        #[test]
        fn robust_box_lies_inside_the_raw_box(points in prop::collection::vec(prop::array::uniform3(-1.0_f32..1.0), 1..200)) {
            let points: Vec<_> = points.into_iter().map(Point3::from).collect();
            let raw = Aabb::around(&points).unwrap();
            let (aabb, _) = robust_boxes(&points, 0.05, None, &InstanceSettings::default());
            prop_assert!((0..3).all(|i| aabb.min()[i] >= raw.min()[i] - 1e-5 && aabb.max()[i] <= raw.max()[i] + 1e-5));
        }
    }

    /// Returns settings that trim nothing: bounds are those of the points.
    fn plain() -> InstanceSettings {
        InstanceSettings {
            stray_share: 0.0,
            thin_sigmas: 0.0,
            noise_sigmas: 0.0,
            trim: 0.0,
            stray_neighbours: 0,
            stray_voxel_m: 1.0,
            ..InstanceSettings::default()
        }
    }

    /// Returns `count` points in the middle of a voxel of one meter.
    fn in_voxel(count: usize, voxel: [f32; 3]) -> Vec<Point3<f32>> {
        vec![Point3::from(voxel.map(|at| at + 0.5)); count]
    }

    /// Returns points at 10, 11, ... 110 meters along an axis.
    fn along(axis: usize) -> Vec<Point3<f32>> {
        let at = |i: u8| {
            let mut point = Point3::origin();
            point[axis] = f32::from(i);
            point
        };
        (10..=110).map(at).collect()
    }

    #[track_caller]
    fn assert_span(found: &Aabb, axis: usize, from: f32, to: f32, what: &str) {
        let (lo, hi) = (found.min()[axis], found.max()[axis]);
        assert!(
            (lo - from).abs() < 1e-3 && (hi - to).abs() < 1e-3,
            "{what}: {lo} to {hi}, expected {from} to {to}"
        );
    }

    #[test]
    fn points_below_the_minimum_number_of_neighbors_are_removed() {
        let settings = InstanceSettings { stray_neighbours: 4, ..plain() };
        let kept = |groups: &[(usize, [f32; 3])]| {
            let points: Vec<_> =
                groups.iter().flat_map(|&(count, voxel)| in_voxel(count, voxel)).collect();
            remove_isolated(&points, &settings).len()
        };
        // A point does not count as its own neighbor.
        assert_eq!(kept(&[(5, [0.0; 3])]), 5, "4 others each");
        assert_eq!(kept(&[(4, [0.0; 3])]), 0, "3 others each");
        // 2 - 1 + 3 = 4 and 3 - 1 + 2 = 4 others.
        assert_eq!(kept(&[(2, [0.0; 3]), (3, [1.0, 0.0, 0.0])]), 5, "in the next voxel");
        assert_eq!(kept(&[(2, [0.0; 3]), (3, [-1.0, 1.0, -1.0])]), 5, "across a corner");
        assert_eq!(kept(&[(2, [0.0; 3]), (2, [1.0, 0.0, 0.0])]), 0, "3 others each");
        assert_eq!(kept(&[(2, [0.0; 3]), (3, [2.0, 0.0, 0.0])]), 0, "two voxels away");
        // The middle point has 1 - 1 + 2 + 2 = 4 others, those around it 2 - 1 + 1 = 2.
        let row = [(2, [0.0; 3]), (1, [1.0, 0.0, 0.0]), (2, [2.0, 0.0, 0.0])];
        assert_eq!(kept(&row), 1, "between two groups");
        assert_eq!(kept(&[]), 0);
    }

    #[test]
    fn points_with_enough_neighbors_are_kept_unchanged() {
        let settings = InstanceSettings { stray_neighbours: 4, ..plain() };
        let group = in_voxel(5, [3.0, -2.0, 7.0]);
        let mut points = in_voxel(4, [9.0; 3]);
        points.extend(&group);
        assert_eq!(remove_isolated(&points, &settings), group);
        let fine = InstanceSettings { stray_voxel_m: 0.1, ..settings };
        let spread: Vec<_> = (0..5).map(|i| Point3::new(0.3 * i as f32, 0.0, 0.0)).collect();
        let kept = remove_isolated(&spread, &fine);
        assert!(kept.is_empty(), "in finer voxels each point is isolated: {kept:?}");
    }

    #[test]
    fn isolated_points_count_when_they_are_the_majority() {
        let settings = InstanceSettings { stray_neighbours: 4, ..plain() };
        let with_strays = |strays: u8| {
            let mut points = in_voxel(5, [0.0; 3]);
            let stray = |i| Point3::new(10.5 * f32::from(i), 0.5, 0.5);
            points.extend((1..=strays).map(stray));
            robust_boxes(&points, 0.0, None, &settings).0
        };
        // 5 points have neighbors. Of 9 and of 10 points they are at least half, and only they
        // count. Of 11 they are less than half.
        assert_span(&with_strays(4), 0, 0.5, 0.5, "4 strays");
        assert_span(&with_strays(5), 0, 0.5, 0.5, "5 strays");
        assert_span(&with_strays(6), 0, 0.5, 63.0, "6 strays");
    }

    #[test]
    fn stray_share_is_trimmed_at_both_ends_of_each_axis() {
        for axis in 0..3 {
            let spans = |stray_share| {
                let settings = InstanceSettings { stray_share, ..plain() };
                robust_boxes(&along(axis), 0.0, None, &settings).0
            };
            assert_span(&spans(0.0), axis, 10.0, 110.0, "nothing trimmed");
            // Of 101 points the 5th from either end: 10 + 5 and 110 - 5.
            assert_span(&spans(0.05), axis, 15.0, 105.0, "5 % trimmed");
            assert_span(&spans(0.05), (axis + 1) % 3, 0.0, 0.0, "no extent");
        }
    }

    #[test]
    fn only_thin_extents_shrink_by_the_noise() {
        let spans = |thin_sigmas, noise_sigmas, trim| {
            let settings = InstanceSettings { thin_sigmas, noise_sigmas, trim, ..plain() };
            robust_boxes(&along(0), 0.5, None, &settings).0
        };
        // The extent is 100: 200 standard deviations of 0.5. It is thin up to there.
        assert_span(&spans(200.0, 3.0, 0.02), 0, 11.5, 108.5, "10 + 3 * 0.5, 110 - 3 * 0.5");
        assert_span(&spans(201.0, 3.0, 0.02), 0, 11.5, 108.5, "below the limit");
        assert_span(&spans(199.0, 3.0, 0.02), 0, 10.0, 110.0, "not thin");
        // At most two of a hundred points are trimmed at either end.
        assert_span(&spans(200.0, 5.0, 0.02), 0, 12.0, 108.0, "12.5 and 107.5 would trim too much");
        assert_span(&spans(200.0, 5.0, 0.0), 0, 10.0, 110.0, "trimming is disabled");
        // A zero extent stays zero.
        assert_span(&spans(200.0, 3.0, 0.02), 1, 0.0, 0.0, "no extent");
    }

    #[test]
    fn extents_shrink_alike_at_negative_coordinates() {
        // From -110 to -10: again 100, 200 standard deviations of 0.5.
        let mirrored: Vec<_> = along(0).iter().map(|p| Point3::new(-p.x, 0.0, 0.0)).collect();
        let spans = |thin_sigmas| {
            let settings =
                InstanceSettings { thin_sigmas, noise_sigmas: 3.0, trim: 0.02, ..plain() };
            robust_boxes(&mirrored, 0.5, None, &settings).0
        };
        assert_span(&spans(200.0), 0, -108.5, -11.5, "thin");
        assert_span(&spans(199.0), 0, -110.0, -10.0, "not thin");
    }

    #[test]
    fn flat_things_get_the_thickness_of_their_relief() {
        // 100 m long, and spread over 50 m along its normal by noise.
        let settings =
            InstanceSettings { thin_sigmas: 200.0, noise_sigmas: 3.0, trim: 0.02, ..plain() };
        let mut points = along(0);
        points.iter_mut().for_each(|p| p.y = p.x * 0.5);
        let relief = FlatRelief {
            normal: Vector3::y(),
            base: Point3::new(7.0, 4.0, -2.0),
            span_m: (0.25, 0.75),
        };
        let (found, _) = robust_boxes(&points, 0.5, Some(&relief), &settings);
        assert_span(&found, 0, 10.0, 110.0, "along the plane");
        // 4 + 0.25 to 4 + 0.75.
        assert_span(&found, 1, 4.25, 4.75, "along the normal");
        let (noisy, _) = robust_boxes(&points, 0.5, None, &settings);
        assert_span(&noisy, 0, 11.5, 108.5, "without relief it is thin");
    }

    #[test]
    fn oriented_box_encloses_only_points_within_the_bounds() {
        // A square of 10 by 10 points, and two far out along one axis each.
        let mut points: Vec<Point3<f32>> = (0..100_u8)
            .map(|i| Point3::new(f32::from(i / 10), f32::from(i % 10), f32::from(i % 3)))
            .collect();
        points.extend([Point3::new(5.0, 50.0, 1.0), Point3::new(50.0, 5.0, 1.0)]);
        // Of 102 points the first from either end: 0 and 9 along x and y.
        let settings = InstanceSettings { stray_share: 0.01, ..plain() };
        let (aabb, turned) = robust_boxes(&points, 0.0, None, &settings);
        assert_span(&aabb, 0, 0.0, 9.0, "x");
        assert_span(&aabb, 1, 0.0, 9.0, "y");
        assert_span(&aabb, 2, 0.0, 2.0, "z");
        assert!((turned.size - Vector3::new(9.0, 9.0, 2.0)).norm() < 1e-3, "{turned:?}");
        assert!((turned.center - Point3::new(4.5, 4.5, 1.0)).norm() < 1e-3, "{turned:?}");
        assert!(turned.yaw_rad.abs() < 1e-3, "{turned:?}");
    }

    #[test]
    fn diagonal_bar_has_a_narrow_oriented_box() {
        // 10 m long at 30 degrees, without width: 10 cos 30 by 10 sin 30 along the axes.
        let angle = std::f32::consts::FRAC_PI_6;
        let (sin, cos) = angle.sin_cos();
        let points: Vec<Point3<f32>> = (0..=100)
            .map(|i| 0.1 * i as f32)
            .map(|at| Point3::new(at * cos, at * sin, 0.0))
            .collect();
        let (aabb, turned) = robust_boxes(&points, 0.0, None, &plain());
        assert_span(&aabb, 0, 0.0, 10.0 * cos, "x");
        assert_span(&aabb, 1, 0.0, 10.0 * sin, "y");
        assert!((turned.size.x - 10.0).abs() < 1e-2 && turned.size.y < 1e-2, "{turned:?}");
        assert!((turned.yaw_rad - angle).abs() < 1e-2, "{turned:?}");
    }

    #[test]
    fn oriented_box_has_zero_yaw_without_points_in_the_bounds() {
        // A plus: of four points along x and along y the middle two are at 0, and none is at both.
        let points =
            [[-9.0, 0.0], [9.0, 0.0], [0.0, -9.0], [0.0, 9.0]].map(|[x, y]| Point3::new(x, y, 3.0));
        let settings = InstanceSettings { stray_share: 0.25, trim: 0.25, ..plain() };
        let (aabb, turned) = robust_boxes(&points, 0.0, None, &settings);
        assert_eq!((aabb.center, aabb.size), (Point3::new(0.0, 0.0, 3.0), Vector3::zeros()));
        assert_eq!(turned, aabb.into());
    }

    #[test]
    fn empty_input_has_a_box_of_zero_size() {
        let (aabb, turned) = robust_boxes(&[], 0.1, None, &InstanceSettings::default());
        assert_eq!((aabb.center, aabb.size), (Point3::origin(), Vector3::zeros()));
        assert_eq!((turned.center, turned.size), (Point3::origin(), Vector3::zeros()));
    }

    proptest! {
        #[test]
        fn box_does_not_depend_on_point_order(
            points in prop::collection::vec(prop::array::uniform3(-0.2_f32..0.2), 1..100),
            turn in 0_usize..100,
        ) {
            let points: Vec<_> = points.into_iter().map(Point3::from).collect();
            let mut others = points.clone();
            others.rotate_left(turn % points.len());
            others.reverse();
            let settings = InstanceSettings::default();
            let (one, other) =
                (robust_boxes(&points, 0.01, None, &settings), robust_boxes(&others, 0.01, None, &settings));
            prop_assert_eq!(one, other);
        }

        #[test]
        fn more_noise_never_enlarges_the_box(
            points in prop::collection::vec(prop::array::uniform3(-0.2_f32..0.2), 1..100),
            noise_m in prop::array::uniform2(0.0_f32..0.1),
        ) {
            let points: Vec<_> = points.into_iter().map(Point3::from).collect();
            let settings = InstanceSettings::default();
            let size = |noise_m| robust_boxes(&points, noise_m, None, &settings).0.size;
            let (less, more) =
                (size(noise_m[0].min(noise_m[1])), size(noise_m[0].max(noise_m[1])));
            prop_assert!((0..3).all(|i| more[i] <= less[i] + 1e-5), "{more} {less}");
        }
    }
}
