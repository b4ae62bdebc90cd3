//! An instance as relations use it: an upright box with a yaw, and distances that do not depend on
//! the orientation of the world.

use uniground_geometry::boxes::{Aabb, OrientedBox};
use uniground_geometry::scene::Instance;
use uniground_geometry::{Point2, Point3, Vector2, Vector3};

/// An upright box. Meters, world frame (Z up).
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Solid {
    /// Center of the box.
    pub center: Point3<f32>,
    /// Extents along the box's own two horizontal axes, and up.
    pub size: [f32; 3],
    /// The horizontal corners, counter-clockwise.
    pub corners: [Point2<f32>; 4],
    /// The box's own first horizontal axis, unit length.
    pub axis: Vector2<f32>,
    /// Z of the underside.
    pub bottom: f32,
    /// Z of the upper side.
    pub top: f32,
}

impl From<&Instance> for Solid {
    fn from(instance: &Instance) -> Self {
        Self::from(instance.oriented_box)
    }
}

impl From<Aabb> for Solid {
    fn from(aabb: Aabb) -> Self {
        Self::from(OrientedBox::from(aabb))
    }
}

impl From<OrientedBox> for Solid {
    fn from(OrientedBox { center, size, yaw_rad }: OrientedBox) -> Self {
        let (sin, cos) = yaw_rad.sin_cos();
        let axis = Vector2::new(cos, sin);
        let (along, across) = (axis * (size.x / 2.0), Vector2::new(-sin, cos) * (size.y / 2.0));
        let middle = center.xy();
        Self {
            center,
            size: [size.x, size.y, size.z],
            corners: [
                middle - along - across,
                middle + along - across,
                middle + along + across,
                middle - along + across,
            ],
            axis,
            bottom: center.z - size.z / 2.0,
            top: center.z + size.z / 2.0,
        }
    }
}

impl Solid {
    /// Returns the length of the footprint's diagonal, meters.
    #[must_use]
    pub fn diagonal(&self) -> f32 {
        self.size[0].hypot(self.size[1])
    }

    /// Returns the area of the footprint, square meters.
    #[must_use]
    pub fn area(&self) -> f32 {
        self.size[0] * self.size[1]
    }

    /// Returns the volume in cubic meters; 0 for a flat box.
    #[must_use]
    pub fn volume(&self) -> f32 {
        self.area() * self.size[2]
    }

    /// Returns the long and the short side of the footprint, meters.
    #[must_use]
    pub fn sides(&self) -> (f32, f32) {
        (self.size[0].max(self.size[1]), self.size[0].min(self.size[1]))
    }

    /// Returns the direction of the longer side, unit length.
    #[must_use]
    pub fn along(&self) -> Vector2<f32> {
        if self.size[0] >= self.size[1] {
            self.axis
        } else {
            Vector2::new(-self.axis.y, self.axis.x)
        }
    }

    /// Returns the range that the footprint covers along a horizontal direction (unit), meters from
    /// the world's origin.
    #[must_use]
    pub fn span(&self, direction: &Vector2<f32>) -> (f32, f32) {
        let along = self.corners.map(|p| p.coords.dot(direction));
        (
            along.iter().copied().fold(f32::INFINITY, f32::min),
            along.iter().copied().fold(f32::NEG_INFINITY, f32::max),
        )
    }

    /// Returns how far a point is from the middle towards the end of the footprint along
    /// `direction` (unit): 0 at the middle and beyond it on the other side, 1 from half of the way
    /// on.
    #[must_use]
    pub fn share_along(&self, point: &Point3<f32>, direction: &Vector3<f32>) -> f32 {
        let along = |p: &Point2<f32>| (p - self.center.xy()).dot(&direction.xy());
        let half = self.corners.iter().map(along).fold(1e-3, f32::max);
        (2.0 * along(&point.xy()) / half).clamp(0.0, 1.0)
    }

    /// Returns the shortest distance between the surfaces, meters; 0 when they touch or overlap.
    #[must_use]
    pub fn gap(&self, other: &Self) -> f32 {
        self.horizontal_gap(other).hypot(self.vertical_gap(other).max(0.0))
    }

    /// Returns whether the gap is certainly larger than a distance in meters. A quick test by the
    /// centers: `false` does not mean that the gap is smaller.
    #[must_use]
    pub fn is_beyond(&self, other: &Self, distance_m: f32) -> bool {
        // Half of the sum of the sides is at least half of the diagonal.
        let halves = 0.5 * (self.size[0] + self.size[1] + other.size[0] + other.size[1]);
        let limit = distance_m + halves;
        (self.center - other.center).xy().norm_squared() > limit * limit
    }

    /// Returns the vertical distance between the two, meters; negative by the depth of the overlap.
    #[must_use]
    pub fn vertical_gap(&self, other: &Self) -> f32 {
        (self.bottom - other.top).max(other.bottom - self.top)
    }

    /// Returns the shortest distance between the footprints, meters; 0 when they touch or overlap.
    #[must_use]
    pub fn horizontal_gap(&self, other: &Self) -> f32 {
        // Far apart, the gap between the circumscribed circles is exact enough.
        let circles = (self.center - other.center).xy().norm()
            - f32::midpoint(self.diagonal(), other.diagonal());
        if circles > 4.0 * (self.diagonal() + other.diagonal()) {
            return circles;
        }
        if self.overlaps(other) {
            return 0.0;
        }
        let to_edges = |points: &Self, edges: &Self| {
            let distance = |p: &Point2<f32>| {
                (0..4)
                    .map(|i| to_segment(p, &edges.corners[i], &edges.corners[(i + 1) % 4]))
                    .fold(f32::INFINITY, f32::min)
            };
            points.corners.iter().map(distance).fold(f32::INFINITY, f32::min)
        };
        to_edges(self, other).min(to_edges(other, self))
    }

    /// Returns the points of both at which they are nearest, this box's point first; meters, world
    /// frame. Where footprints overlap, the points are above each other at their common middle.
    #[must_use]
    pub fn nearest_points(&self, other: &Self) -> [Point3<f32>; 2] {
        let (a, b) = if self.overlaps(other) {
            let common = self.common_footprint(other);
            let sum = common.iter().fold(Vector2::zeros(), |sum, p| sum + p.coords);
            let middle = if common.is_empty() {
                self.center.xy()
            } else {
                Point2::from(sum / common.len() as f32)
            };
            (middle, middle)
        } else {
            let pairs = |points: &Self, edges: &Self| {
                let mut best = (f32::INFINITY, points.corners[0], edges.corners[0]);
                for p in &points.corners {
                    for i in 0..4 {
                        let q = on_segment(p, &edges.corners[i], &edges.corners[(i + 1) % 4]);
                        let distance = (p - q).norm();
                        if distance < best.0 {
                            best = (distance, *p, q);
                        }
                    }
                }
                best
            };
            let (here, there) = (pairs(self, other), pairs(other, self));
            if here.0 <= there.0 { (here.1, here.2) } else { (there.2, there.1) }
        };
        let (low, high) = (self.bottom.max(other.bottom), self.top.min(other.top));
        let (za, zb) = if low <= high {
            (f32::midpoint(low, high), f32::midpoint(low, high))
        } else if self.bottom > other.top {
            (self.bottom, other.top)
        } else {
            (self.top, other.bottom)
        };
        [Point3::new(a.x, a.y, za), Point3::new(b.x, b.y, zb)]
    }

    /// Returns whether the footprints overlap: no edge of either separates them.
    fn overlaps(&self, other: &Self) -> bool {
        let apart = |a: &Self, b: &Self| {
            [a.axis, Vector2::new(-a.axis.y, a.axis.x)].into_iter().zip(a.size).any(
                |(axis, size)| {
                    let along = |p: &Point2<f32>| (p - a.center.xy()).dot(&axis);
                    let (lo, hi) = b
                        .corners
                        .iter()
                        .map(along)
                        .fold((f32::INFINITY, f32::NEG_INFINITY), |(lo, hi), v| {
                            (lo.min(v), hi.max(v))
                        });
                    lo > size / 2.0 || hi < -size / 2.0
                },
            )
        };
        !apart(self, other) && !apart(other, self)
    }

    /// Returns the share of this footprint that lies over the other's, in `0..=1`.
    #[must_use]
    pub fn footprint_overlap(&self, other: &Self) -> f32 {
        if !self.overlaps(other) {
            return 0.0;
        }
        let polygon = self.common_footprint(other);
        let doubled: f32 = (0..polygon.len())
            .map(|i| polygon[i].coords.perp(&polygon[(i + 1) % polygon.len()].coords))
            .sum();
        (doubled.abs() / 2.0 / self.area().max(f32::EPSILON)).min(1.0)
    }

    /// Returns the corners of the polygon that both footprints cover.
    fn common_footprint(&self, other: &Self) -> Vec<Point2<f32>> {
        // Clipping a quadrilateral four times leaves at most eight corners.
        let mut polygon: Vec<Point2<f32>> = Vec::with_capacity(8);
        polygon.extend(self.corners);
        let mut cut = Vec::with_capacity(8);
        for i in 0..4 {
            let (from, to) = (other.corners[i], other.corners[(i + 1) % 4]);
            let side = |p: &Point2<f32>| (to - from).perp(&(p - from));
            cut.clear();
            for (j, a) in polygon.iter().enumerate() {
                let b = &polygon[(j + 1) % polygon.len()];
                let (sa, sb) = (side(a), side(b));
                if sa >= 0.0 {
                    cut.push(*a);
                }
                if (sa >= 0.0) != (sb >= 0.0) {
                    cut.push(a + (b - a) * (sa / (sa - sb)));
                }
            }
            std::mem::swap(&mut polygon, &mut cut);
        }
        polygon
    }
}

fn to_segment(p: &Point2<f32>, a: &Point2<f32>, b: &Point2<f32>) -> f32 {
    (p - on_segment(p, a, b)).norm()
}

/// Returns the point of a segment that is nearest to `p`.
fn on_segment(p: &Point2<f32>, a: &Point2<f32>, b: &Point2<f32>) -> Point2<f32> {
    let edge = b - a;
    let along = ((p - a).dot(&edge) / edge.norm_squared().max(f32::MIN_POSITIVE)).clamp(0.0, 1.0);
    a + edge * along
}

#[cfg(test)]
pub(super) mod tests {
    use super::*;
    use proptest::prelude::*;

    pub fn turned(solid: &Solid, by: f32) -> Solid {
        let (sin, cos) = by.sin_cos();
        let c = solid.center;
        let center = Point3::new(cos * c.x - sin * c.y, sin * c.x + cos * c.y, c.z);
        let size = Vector3::from(solid.size);
        Solid::from(OrientedBox { center, size, yaw_rad: solid.axis.y.atan2(solid.axis.x) + by })
    }

    pub fn any_solid() -> impl Strategy<Value = Solid> {
        (prop::array::uniform3(-3.0_f32..3.0), prop::array::uniform3(0.05_f32..2.0), -0.7_f32..0.7)
            .prop_map(|(center, size, yaw_rad)| {
                Solid::from(OrientedBox {
                    center: Point3::from(center),
                    size: Vector3::from(size),
                    yaw_rad,
                })
            })
    }

    #[test]
    fn distances_match_hand_computed_values() {
        let boxed = |x: f32, y: f32, size: f32, yaw_rad: f32| {
            Solid::from(OrientedBox {
                center: Point3::new(x, y, 0.5),
                size: Vector3::new(size, size, 1.0),
                yaw_rad,
            })
        };
        assert!((boxed(0.0, 0.0, 1.0, 0.0).gap(&boxed(3.0, 0.0, 1.0, 0.0)) - 2.0).abs() < 1e-6);
        // A corner towards the other: half a diagonal instead of half a side.
        let corner = boxed(3.0, 0.0, 1.0, std::f32::consts::FRAC_PI_4);
        assert!(
            (boxed(0.0, 0.0, 1.0, 0.0).gap(&corner) - (2.5 - 0.5 * 2.0_f32.sqrt())).abs() < 1e-5
        );
        assert!(
            (boxed(0.0, 0.0, 1.0, 0.0).footprint_overlap(&boxed(0.5, 0.0, 1.0, 0.0)) - 0.5).abs()
                < 1e-6
        );
        assert!(
            (boxed(0.0, 0.0, 1.0, 0.3).footprint_overlap(&boxed(0.0, 0.0, 4.0, 0.0)) - 1.0).abs()
                < 1e-5
        );
        assert_eq!(boxed(0.0, 0.0, 1.0, 0.0).footprint_overlap(&boxed(3.0, 0.0, 1.0, 0.0)), 0.0);
    }

    proptest! {
        #[test]
        fn distances_ignore_rotation(a in any_solid(), b in any_solid(), by in -3.0_f32..3.0) {
            let (ta, tb) = (turned(&a, by), turned(&b, by));
            prop_assert!((a.gap(&b) - ta.gap(&tb)).abs() < 1e-3);
            prop_assert!((a.footprint_overlap(&b) - ta.footprint_overlap(&tb)).abs() < 2e-3);
            prop_assert!((a.gap(&b) - b.gap(&a)).abs() < 1e-4);
        }

        #[test]
        fn boxes_beyond_a_distance_have_a_larger_gap(a in any_solid(), b in any_solid(), distance in 0.0_f32..5.0) {
            prop_assert!(!a.is_beyond(&b, distance) || a.gap(&b) > distance - 1e-4);
            let far = turned(&b, 0.4);
            let far = Solid { center: far.center + Vector3::new(20.0, 0.0, 0.0), corners: far.corners.map(|p| Point2::new(p.x + 20.0, p.y)), ..far };
            prop_assert!(a.is_beyond(&far, distance), "boxes 14 m apart are beyond {} m", distance);
        }

        /// Boxes along the axes have the distances of axis-aligned boxes.
        #[test]
        fn aligned_boxes_match_axis_aligned_distances(a in prop::array::uniform6(0.1_f32..2.0), b in prop::array::uniform6(0.1_f32..2.0)) {
            let make = |v: [f32; 6]| Aabb { center: Point3::new(v[0], v[1], v[2]), size: Vector3::new(v[3], v[4], v[5]) };
            let (a, b) = (make(a), make(b));
            prop_assert!((Solid::from(a).gap(&b.into()) - a.gap(&b)).abs() < 1e-4);
            prop_assert!((Solid::from(a).footprint_overlap(&b.into()) - a.footprint_overlap(&b)).abs() < 1e-4);
        }
    }
}
