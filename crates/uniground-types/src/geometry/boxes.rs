//! Axis-aligned and yaw-oriented boxes in the Z-up world.

use super::{Point2, Point3, Vector3};
use serde::{Deserialize, Serialize};

/// Axis-aligned box in the world frame (meters, Z up): the benchmark's `(cx, cy, cz, dx, dy, dz)`.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct Aabb {
    /// Center; meters, world frame (Z up).
    #[cfg_attr(feature = "openapi", schema(value_type = [f32; 3]))]
    pub center: Point3<f32>,
    /// Full extent along X, Y and Z, meters.
    #[cfg_attr(feature = "openapi", schema(value_type = [f32; 3]))]
    pub size: Vector3<f32>,
}

impl Aabb {
    /// Returns the box between two opposite corners, meters.
    #[must_use]
    #[inline]
    pub fn from_corners(min: Point3<f32>, max: Point3<f32>) -> Self {
        Self { center: nalgebra::center(&min, &max), size: max - min }
    }

    /// Returns the tightest box around `points`, or `None` without points.
    pub fn around<'a>(points: impl IntoIterator<Item = &'a Point3<f32>>) -> Option<Self> {
        let mut points = points.into_iter();
        let first = *points.next()?;
        let (min, max) = points.fold((first, first), |(lo, hi), p| (lo.inf(p), hi.sup(p)));
        Some(Self::from_corners(min, max))
    }

    /// Returns the corner with the smallest X, Y and Z, meters.
    #[must_use]
    #[inline]
    pub fn min(&self) -> Point3<f32> {
        self.center - self.size / 2.0
    }

    /// Returns the corner with the largest X, Y and Z, meters.
    #[must_use]
    #[inline]
    pub fn max(&self) -> Point3<f32> {
        self.center + self.size / 2.0
    }

    /// Returns whether the box contains a point. Points on a face count.
    #[must_use]
    #[inline]
    pub fn contains(&self, point: &Point3<f32>) -> bool {
        let away = (point - self.center).abs();
        (0..3).all(|axis| away[axis] <= self.size[axis] / 2.0)
    }

    /// Returns the volume, cubic meters.
    #[must_use]
    #[inline]
    pub fn volume(&self) -> f32 {
        self.size.x * self.size.y * self.size.z
    }

    /// Returns the eight corners. Bit 0 of the index selects max X, bit 1 max Y, bit 2 max Z.
    #[must_use]
    #[inline]
    pub fn corners(&self) -> [Point3<f32>; 8] {
        let (lo, hi) = (self.min(), self.max());
        std::array::from_fn(|i| {
            Point3::new(
                if i & 1 == 0 { lo.x } else { hi.x },
                if i & 2 == 0 { lo.y } else { hi.y },
                if i & 4 == 0 { lo.z } else { hi.z },
            )
        })
    }

    /// Returns the intersection over union of two boxes, in `0..=1`. 0 for boxes without volume.
    #[must_use]
    #[inline]
    pub fn iou(&self, other: &Self) -> f32 {
        let shared = self.shared_volume(other);
        if shared > 0.0 { shared / (self.volume() + other.volume() - shared) } else { 0.0 }
    }

    /// Returns the volume of the intersection, cubic meters.
    #[must_use]
    #[inline]
    pub fn shared_volume(&self, other: &Self) -> f32 {
        let overlap = self.max().inf(&other.max()) - self.min().sup(&other.min());
        if overlap.iter().all(|&edge| edge > 0.0) { overlap.product() } else { 0.0 }
    }

    /// Returns the shortest distance between two boxes, meters. 0 if they touch or overlap.
    #[must_use]
    #[inline]
    pub fn gap(&self, other: &Self) -> f32 {
        self.gap_per_axis(other).map(|g| g.max(0.0)).norm()
    }

    /// Returns the signed gap along each axis: positive if apart, negative by the depth of the
    /// overlap.
    #[must_use]
    #[inline]
    pub fn gap_per_axis(&self, other: &Self) -> Vector3<f32> {
        (other.center - self.center).abs() - (self.size + other.size) / 2.0
    }

    /// Returns the share of this box's XY footprint that overlaps the other's, in `0..=1`.
    #[must_use]
    #[inline]
    pub fn footprint_overlap(&self, other: &Self) -> f32 {
        let gap = self.gap_per_axis(other);
        if gap.x >= 0.0 || gap.y >= 0.0 {
            return 0.0;
        }
        let shared = (-gap.x).min(self.size.x).min(other.size.x)
            * (-gap.y).min(self.size.y).min(other.size.y);
        shared / (self.size.x * self.size.y).max(f32::EPSILON)
    }
}

/// A box rotated about the vertical axis.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct OrientedBox {
    /// Center; meters, world frame (Z up).
    #[cfg_attr(feature = "openapi", schema(value_type = [f32; 3]))]
    pub center: Point3<f32>,
    /// Full extent along the box's own X and Y and the world's Z, meters.
    #[cfg_attr(feature = "openapi", schema(value_type = [f32; 3]))]
    pub size: Vector3<f32>,
    /// Rotation from the world's X axis to the box's X axis about +Z, radians, in `-pi/4..=pi/4`.
    pub yaw_rad: f32,
}

impl From<Aabb> for OrientedBox {
    #[inline]
    fn from(Aabb { center, size }: Aabb) -> Self {
        Self { center, size, yaw_rad: 0.0 }
    }
}

impl OrientedBox {
    /// Returns the eight corners. Bit 0 of the index selects the larger X of the box's own axes,
    /// bit 1 the larger Y, bit 2 the larger Z.
    #[must_use]
    #[inline]
    pub fn corners(&self) -> [Point3<f32>; 8] {
        let (sin, cos) = self.yaw_rad.sin_cos();
        let upright = Aabb { center: Point3::origin(), size: self.size };
        upright
            .corners()
            .map(|p| self.center + Vector3::new(cos * p.x - sin * p.y, sin * p.x + cos * p.y, p.z))
    }

    /// Returns the minimum-area rectangle of the XY points, extruded over `z_range` (meters).
    /// Returns `None` without points.
    ///
    /// Uses rotating calipers over the convex hull: the best rectangle shares an edge with the
    /// hull.
    #[must_use]
    #[inline]
    pub fn min_area(footprint: &[Point2<f32>], z_range: (f32, f32)) -> Option<Self> {
        let hull = convex_hull(footprint);
        let first = *hull.first()?;
        let mut best = (f32::INFINITY, 0.0_f32, first, super::Vector2::zeros());
        let edges = (0..hull.len()).map(|i| hull[(i + 1) % hull.len()] - hull[i]);
        for edge in edges.chain([super::Vector2::x()]) {
            if edge.norm_squared() < 1e-12 {
                continue;
            }
            // A quarter turn does not change a rectangle, so the yaw nearest to zero is used.
            let quarter = std::f32::consts::FRAC_PI_2;
            let yaw = edge.y.atan2(edge.x);
            let yaw = yaw - (yaw / quarter).round() * quarter;
            let (sin, cos) = yaw.sin_cos();
            let (mut lo, mut hi) = (
                Point2::new(f32::INFINITY, f32::INFINITY),
                Point2::new(f32::NEG_INFINITY, f32::NEG_INFINITY),
            );
            for p in &hull {
                let turned = Point2::new(cos * p.x + sin * p.y, cos * p.y - sin * p.x);
                lo = lo.inf(&turned);
                hi = hi.sup(&turned);
            }
            let extent = hi - lo;
            let area = extent.x * extent.y;
            if area < best.0 - 1e-6 {
                let mid = nalgebra::center(&lo, &hi);
                best = (
                    area,
                    yaw,
                    Point2::new(cos * mid.x - sin * mid.y, sin * mid.x + cos * mid.y),
                    extent,
                );
            }
        }
        let (_, yaw_rad, center, extent) = best;
        Some(Self {
            center: Point3::new(center.x, center.y, f32::midpoint(z_range.0, z_range.1)),
            size: Vector3::new(extent.x, extent.y, z_range.1 - z_range.0),
            yaw_rad,
        })
    }
}

/// Returns the convex hull in counterclockwise order (Andrew's monotone chain), without repeated or
/// collinear points.
fn convex_hull(points: &[Point2<f32>]) -> Vec<Point2<f32>> {
    let mut sorted = points.to_vec();
    sorted.sort_by(|a, b| a.x.total_cmp(&b.x).then(a.y.total_cmp(&b.y)));
    sorted.dedup();
    if sorted.len() < 3 {
        return sorted;
    }
    let half = |points: &mut dyn Iterator<Item = &Point2<f32>>| {
        let mut chain: Vec<Point2<f32>> = Vec::new();
        for &p in points {
            while let [.., a, b] = chain[..] {
                if (b - a).perp(&(p - a)) > 0.0 {
                    break;
                }
                chain.pop();
            }
            chain.push(p);
        }
        chain.pop();
        chain
    };
    let mut hull = half(&mut sorted.iter());
    hull.extend(half(&mut sorted.iter().rev()));
    hull
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn boxed(min: [f32; 3], max: [f32; 3]) -> Aabb {
        Aabb::from_corners(Point3::from(min), Point3::from(max))
    }

    #[test]
    fn corners_of_a_turned_box_lie_along_its_own_axes() {
        let (center, size) = (Point3::new(1.0, 2.0, 0.5), Vector3::new(2.0, 1.0, 1.0));
        let upright = Aabb { center, size };
        assert_eq!(OrientedBox::from(upright).corners(), upright.corners());
        let turned = OrientedBox { center, size, yaw_rad: std::f32::consts::FRAC_PI_2 };
        let [first, .., last] = turned.corners();
        assert!((first - Point3::new(1.5, 1.0, 0.0)).norm() < 1e-6, "{first}");
        assert!((last - Point3::new(0.5, 3.0, 1.0)).norm() < 1e-6, "{last}");
    }

    #[test]
    fn unit_cubes_shifted_by_half_have_iou_one_third() {
        let a = boxed([0.0; 3], [1.0; 3]);
        let b = boxed([0.5, 0.0, 0.0], [1.5, 1.0, 1.0]);
        assert!((a.iou(&b) - 1.0 / 3.0).abs() < 1e-6);
        assert!((a.footprint_overlap(&b) - 0.5).abs() < 1e-6);
        assert_eq!(a.iou(&boxed([2.0; 3], [3.0; 3])), 0.0);
    }

    #[test]
    fn min_area_returns_the_yaw_of_a_rotated_rectangle() {
        let (sin, cos) = 0.5_f32.sin_cos();
        let corners = [(-2.0, -0.5), (2.0, -0.5), (2.0, 0.5), (-2.0, 0.5)];
        let turned: Vec<_> = corners
            .iter()
            .map(|&(x, y)| Point2::new(cos * x - sin * y + 3.0, sin * x + cos * y - 1.0))
            .collect();
        let found = OrientedBox::min_area(&turned, (0.0, 0.8)).unwrap();
        assert!((found.yaw_rad - 0.5).abs() < 1e-4, "{found:?}");
        assert!((found.size - Vector3::new(4.0, 1.0, 0.8)).norm() < 1e-4, "{found:?}");
        assert!((found.center - Point3::new(3.0, -1.0, 0.4)).norm() < 1e-4, "{found:?}");
    }

    #[test]
    fn degenerate_footprints_still_have_a_box() {
        assert!(OrientedBox::min_area(&[], (0.0, 1.0)).is_none());
        let one = OrientedBox::min_area(&[Point2::new(1.0, 2.0)], (0.0, 1.0)).unwrap();
        assert_eq!(one.size, Vector3::new(0.0, 0.0, 1.0));
        let line =
            OrientedBox::min_area(&[Point2::new(0.0, 0.0), Point2::new(1.0, 1.0)], (0.0, 1.0))
                .unwrap();
        assert!((line.size.x.max(line.size.y) - 2.0_f32.sqrt()).abs() < 1e-4, "{line:?}");
    }

    proptest! {
        /// The oriented box contains every point and is never larger than the axis-aligned one.
        #[test]
        fn the_oriented_box_contains_its_points(points in prop::collection::vec((-5.0_f32..5.0, -5.0_f32..5.0), 1..40)) {
            let points: Vec<_> = points.into_iter().map(|(x, y)| Point2::new(x, y)).collect();
            let found = OrientedBox::min_area(&points, (0.0, 1.0)).unwrap();
            let (sin, cos) = found.yaw_rad.sin_cos();
            for p in &points {
                let d = p - found.center.xy();
                let local = (cos * d.x + sin * d.y, cos * d.y - sin * d.x);
                prop_assert!(local.0.abs() <= found.size.x / 2.0 + 1e-3 && local.1.abs() <= found.size.y / 2.0 + 1e-3);
            }
            let flat: Vec<_> = points.iter().map(|p| Point3::new(p.x, p.y, 0.0)).collect();
            let aligned = Aabb::around(&flat).unwrap();
            prop_assert!(found.size.x * found.size.y <= aligned.size.x * aligned.size.y + 1e-3);
        }

        #[test]
        fn iou_is_symmetric_and_at_most_one(a in prop::array::uniform6(-2.0_f32..2.0), b in prop::array::uniform6(-2.0_f32..2.0)) {
            let make = |v: [f32; 6]| boxed([v[0].min(v[3]), v[1].min(v[4]), v[2].min(v[5])], [v[0].max(v[3]), v[1].max(v[4]), v[2].max(v[5])]);
            let (a, b) = (make(a), make(b));
            prop_assert!((a.iou(&b) - b.iou(&a)).abs() < 1e-6);
            prop_assert!((0.0..=1.0 + 1e-6).contains(&a.iou(&b)));
            prop_assert!((a.gap(&b) > 0.0) <= (a.iou(&b) == 0.0));
        }
    }
}
