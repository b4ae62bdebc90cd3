//! Determines what each instance rests on: the floor, another instance, or a wall.

use super::columns::Columns;
use rayon::prelude::*;
use uniground_geometry::boxes::{Aabb, OrientedBox};
use uniground_geometry::progress::{Cancelled, Progress};
use uniground_geometry::scene::{InstanceId, Structure, Support};

/// Gap below which two surfaces count as touching, meters: a few voxels.
pub(super) const CONTACT_M: f32 = 0.06;
/// Share of the footprint that must lie over a supporter.
const MIN_OVERLAP: f32 = 0.3;
/// Minimum share of the footprint's rim at which the supporter must be seen at the height where
/// this thing begins. This prevents a chair under a table from counting as supported by it.
const MIN_RIM: f32 = 0.2;
/// Minimum width of a thing with legs, meters: chairs and tables have legs, mugs and fragments of
/// shelves do not.
const MIN_LEGGED_WIDTH_M: f32 = 0.25;
/// Maximum depth of a thing that hangs on a wall, as shelves do, meters. Deeper things stand before
/// the wall.
const MIN_DEPTH_BESIDE_WALL_M: f32 = 0.3;
/// Maximum length of table legs, meters.
const MAX_LEGS_M: f32 = 0.8;
/// Maximum length of legs as a multiple of the width of what they carry.
const LEGS_PER_WIDTH: f32 = 1.5;
/// A thing that hangs from the ceiling ends at least this high, about head height: meters above the
/// floor.
const MIN_HANGING_M: f32 = 1.4;
/// Maximum distance of a hanging thing below the ceiling, meters.
const MAX_CORD_M: f32 = 1.5;

/// The position and extent of a thing.
#[derive(Debug, Clone)]
pub struct Body {
    /// Meters, world frame (Z up).
    pub aabb: Aabb,
    /// The part of the box that it fills.
    pub columns: Columns,
}

impl Body {
    /// Builds a body from a box of which nothing else is known.
    #[must_use]
    pub fn from_box(aabb: Aabb, oriented_box: &OrientedBox) -> Self {
        Self { aabb, columns: Columns::from_box(oriented_box) }
    }

    fn bottom_z(&self) -> f32 {
        self.aabb.min().z
    }

    fn top_z(&self) -> f32 {
        self.aabb.max().z
    }

    fn is_over(&self, other: &Self) -> bool {
        self.aabb.footprint_overlap(&other.aabb) > 0.0
            && self.columns.share_over(&other.columns) >= MIN_OVERLAP
    }

    fn is_beside(&self, other: &Self) -> bool {
        self.aabb.gap(&other.aabb) < 2.0 * CONTACT_M
            && self.columns.is_beside(&other.columns, 2.0 * CONTACT_M)
    }
}

/// Returns the support of every thing, by index; instance ids are index + 1. `floor_z` in meters,
/// world frame (Z up).
///
/// # Errors
/// [`Cancelled`].
pub fn find_supports(
    bodies: &[Body],
    structures: &[Option<Structure>],
    floor_z: f32,
    progress: &Progress,
) -> Result<Vec<Support>, Cancelled> {
    let of = |i| progress.check().map(|()| find_support(i, bodies, structures, floor_z));
    (0..bodies.len()).into_par_iter().map(of).collect()
}

/// Returns the support of one thing.
pub(super) fn find_support(
    i: usize,
    bodies: &[Body],
    structures: &[Option<Structure>],
    floor_z: f32,
) -> Support {
    let own = &bodies[i];
    let bottom = own.bottom_z();
    if bottom < floor_z + 2.0 * CONTACT_M {
        return Support::Floor;
    }
    let below = (0..bodies.len())
        .filter(|&j| {
            j != i
                && structures[j].is_none_or(|s| s == Structure::Floor)
                && bodies[j].bottom_z() < bottom
        })
        // The supporter ends where this thing begins, or reaches around it as a shelf does: then
        // its top is not far below.
        .filter(|&j| bodies[j].top_z() > bottom - CONTACT_M && own.is_over(&bodies[j]))
        .filter(|&j| own.columns.share_touching(&bodies[j].columns, bottom, CONTACT_M) >= MIN_RIM)
        .min_by(|&a, &b| {
            let gap = |j: usize| (bodies[j].top_z() - bottom).abs();
            gap(a).total_cmp(&gap(b)).then(a.cmp(&b))
        });
    if let Some(j) = below {
        return Support::Instance { id: InstanceId(j as u32 + 1) };
    }
    let gap = |j: usize| own.aabb.gap(&bodies[j].aabb);
    let behind = (0..bodies.len())
        .filter(|&j| structures[j] == Some(Structure::Wall) && own.is_beside(&bodies[j]))
        .min_by(|&a, &b| gap(a).total_cmp(&gap(b)).then(a.cmp(&b)));
    behind.map_or(Support::Nothing, |j| Support::Wall { id: InstanceId(j as u32 + 1) })
}

/// What supports a thing, and the height range that it then spans.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct SupportSpan {
    /// Meters, world frame (Z up).
    pub from_z: f32,
    pub to_z: f32,
    pub support: Support,
}

/// Extends a thing to what supports it, because nothing floats:
///
/// - Something on the floor reaches down to the floor.
/// - Something that no wall or ceiling holds stands on legs too thin for the scan, like a chair of
///   which only seat and back were seen.
/// - The same holds for something beside a wall that is deeper than things that hang on walls.
/// - Something too high for legs hangs from the ceiling, like a lamp from its cord.
pub(super) fn extend_to_support(
    i: usize,
    support: Support,
    bodies: &[Body],
    structures: &[Option<Structure>],
    floor_z: f32,
) -> SupportSpan {
    let own = &bodies[i];
    let (bottom, top) = (own.bottom_z(), own.top_z());
    let as_seen = SupportSpan { from_z: bottom, to_z: top, support };
    let on_legs = |width_m| {
        find_leg_support(i, width_m, bodies, structures, floor_z)
            .map(|(from_z, support)| SupportSpan { from_z, support, ..as_seen })
    };
    let hanging = || {
        find_ceiling_support(i, bodies, structures, floor_z)
            .map(|to_z| SupportSpan { to_z, ..as_seen })
    };
    let [width_m, depth_m] = own.columns.extents();
    let held = match support {
        // A smaller gap is noise.
        Support::Floor if bottom > floor_z + CONTACT_M / 3.0 => {
            Some(SupportSpan { from_z: floor_z, ..as_seen })
        }
        Support::Nothing if width_m >= MIN_LEGGED_WIDTH_M => on_legs(width_m).or_else(hanging),
        Support::Nothing => hanging(),
        Support::Wall { .. } if depth_m >= MIN_DEPTH_BESIDE_WALL_M => on_legs(depth_m),
        _ => None,
    };
    held.unwrap_or(as_seen)
}

/// Returns the height down to which a thing of this width reaches if it stands on unseen legs,
/// meters, and what it then stands on.
fn find_leg_support(
    i: usize,
    width_m: f32,
    bodies: &[Body],
    structures: &[Option<Structure>],
    floor_z: f32,
) -> Option<(f32, Support)> {
    let own = &bodies[i];
    let bottom = own.bottom_z();
    if (0..bodies.len())
        .any(|j| structures[j] == Some(Structure::Ceiling) && own.is_beside(&bodies[j]))
    {
        return None;
    }
    let under = (0..bodies.len())
        .filter(|&j| {
            j != i
                && structures[j].is_none()
                && bodies[j].top_z() <= bottom
                && own.is_over(&bodies[j])
        })
        .max_by(|&a, &b| bodies[a].top_z().total_cmp(&bodies[b].top_z()).then(b.cmp(&a)));
    let instance =
        |j: usize| (bodies[j].top_z(), Support::Instance { id: InstanceId(j as u32 + 1) });
    let (surface_z, support) = under.map_or((floor_z, Support::Floor), instance);
    (bottom - surface_z <= MAX_LEGS_M.min(width_m * LEGS_PER_WIDTH)).then_some((surface_z, support))
}

/// Returns the height of the ceiling that a thing hangs from, meters, if a ceiling was found over
/// it.
fn find_ceiling_support(
    i: usize,
    bodies: &[Body],
    structures: &[Option<Structure>],
    floor_z: f32,
) -> Option<f32> {
    let own = &bodies[i];
    let ceilings = (0..bodies.len())
        .filter(|&j| structures[j] == Some(Structure::Ceiling))
        .map(|j| bodies[j].aabb.center.z);
    let over = ceilings.filter(|z| *z > own.top_z()).min_by(f32::total_cmp)?;
    (own.bottom_z() - floor_z >= MIN_HANGING_M && over - own.top_z() <= MAX_CORD_M).then_some(over)
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::Rotation3;
    use uniground_geometry::{Point3, Vector3};

    fn spanning(min: [f32; 3], max: [f32; 3]) -> Body {
        let aabb = Aabb::from_corners(Point3::from(min), Point3::from(max));
        Body::from_box(aabb, &OrientedBox { center: aabb.center, size: aabb.size, yaw_rad: 0.0 })
    }

    /// Returns the points of a block, one every two centimeters, rotated about the world's Z axis.
    fn block(min: [f32; 3], max: [f32; 3], yaw_rad: f32) -> Vec<Point3<f32>> {
        let turn = Rotation3::from_axis_angle(&Vector3::z_axis(), yaw_rad);
        let steps = |axis: usize| {
            (0..=((max[axis] - min[axis]) / 0.02).round() as u32)
                .map(move |k| min[axis] + k as f32 * 0.02)
        };
        let points = steps(0)
            .flat_map(|x| steps(1).flat_map(move |y| steps(2).map(move |z| Point3::new(x, y, z))));
        points.map(|p| turn * p).collect()
    }

    fn body(points: &[Point3<f32>], yaw_rad: f32) -> Body {
        Body {
            aabb: Aabb::around(points).unwrap(),
            columns: Columns::from_points(points.iter().copied(), yaw_rad),
        }
    }

    fn span_of_first(bodies: &[Body], structures: &[Option<Structure>]) -> (f32, f32, Support) {
        let SupportSpan { from_z, to_z, support } =
            extend_to_support(0, find_support(0, bodies, structures, 0.0), bodies, structures, 0.0);
        (from_z, to_z, support)
    }

    /// A seat 40 cm above the floor, with different neighbors.
    #[test]
    fn things_extend_to_the_floor_a_supporter_or_a_wall() {
        let alone = |thing: &Body| span_of_first(std::slice::from_ref(thing), &[None]);
        let seat = spanning([0.0, 0.0, 0.4], [0.5, 0.5, 0.9]);
        let beside =
            |other: Body, structure| span_of_first(&[seat.clone(), other], &[None, structure]);
        assert_eq!(alone(&seat), (0.0, seat.top_z(), Support::Floor));
        let box_below = spanning([0.1, 0.1, 0.0], [0.5, 0.5, 0.2]);
        assert_eq!(
            beside(box_below.clone(), None),
            (box_below.top_z(), seat.top_z(), Support::Instance { id: InstanceId(2) })
        );
        let wall = spanning([-0.1, -2.0, 0.0], [-0.05, 2.0, 2.5]);
        assert_eq!(
            beside(wall.clone(), Some(Structure::Wall)),
            (0.0, seat.top_z(), Support::Floor),
            "too deep to hang on the wall"
        );
        let shelf = spanning([0.0, 0.0, 0.4], [0.2, 0.5, 0.9]);
        let hanging = (shelf.bottom_z(), shelf.top_z(), Support::Wall { id: InstanceId(2) });
        assert_eq!(span_of_first(&[shelf, wall], &[None, Some(Structure::Wall)]), hanging);
        let mug = spanning([0.0, 0.0, 0.4], [0.1, 0.1, 0.5]);
        assert_eq!(
            alone(&mug),
            (mug.bottom_z(), mug.top_z(), Support::Nothing),
            "too narrow for legs"
        );
        let low = spanning([0.0, 0.0, 0.1], [0.5, 0.5, 0.6]);
        assert_eq!(alone(&low), (0.0, low.top_z(), Support::Floor));
    }

    #[test]
    fn things_too_high_for_legs_hang_from_the_ceiling() {
        let lamp = spanning([0.0, 0.0, 1.5], [0.4, 0.4, 1.8]);
        let as_seen = (lamp.bottom_z(), lamp.top_z(), Support::Nothing);
        assert_eq!(
            span_of_first(std::slice::from_ref(&lamp), &[None]),
            as_seen,
            "no ceiling was found"
        );
        let ceiling = spanning([-2.0, -2.0, 2.5], [2.0, 2.0, 2.54]);
        assert_eq!(
            span_of_first(&[lamp.clone(), ceiling], &[None, Some(Structure::Ceiling)]),
            (lamp.bottom_z(), 2.52, Support::Nothing)
        );
    }

    /// A room rotated by 45 degrees: axis-aligned boxes around its walls contain half of it.
    #[test]
    fn rotated_wall_supports_only_things_near_it() {
        const YAW_RAD: f32 = 0.7;
        let wall = body(&block([-2.0, 1.0, 0.0], [2.0, 1.04, 2.4], YAW_RAD), YAW_RAD);
        let table = body(&block([-0.4, -0.4, 0.7], [0.4, 0.4, 0.74], YAW_RAD), YAW_RAD);
        let shelf = body(&block([-0.4, 0.7, 0.7], [0.4, 0.96, 0.74], YAW_RAD), YAW_RAD);
        let (bodies, structures) = ([table, wall, shelf], [None, Some(Structure::Wall), None]);
        assert!(bodies[1].aabb.gap(&bodies[0].aabb) < CONTACT_M, "their boxes touch");
        assert_eq!(find_support(0, &bodies, &structures, 0.0), Support::Nothing);
        assert_eq!(span_of_first(&bodies, &structures).2, Support::Floor);
        assert_eq!(find_support(2, &bodies, &structures, 0.0), Support::Wall { id: InstanceId(2) });
    }

    #[test]
    fn table_supports_a_vase_on_it_but_not_a_chair_under_it() {
        let top = block([-0.6, -0.4, 0.7], [0.6, 0.4, 0.74], 0.0);
        let legs = [(-0.58, -0.38), (0.54, -0.38), (-0.58, 0.34), (0.54, 0.34)];
        let legs =
            legs.iter().flat_map(|(x, y)| block([*x, *y, 0.0], [x + 0.04, y + 0.04, 0.7], 0.0));
        let under_the_vase = |p: &Point3<f32>| p.z > 0.65 && p.xy().coords.norm() < 0.1;
        let table: Vec<_> = top.into_iter().chain(legs).filter(|p| !under_the_vase(p)).collect();
        let chair = body(&block([-0.2, -0.6, 0.4], [0.2, -0.2, 0.44], 0.0), 0.0);
        let vase = body(&block([-0.08, -0.08, 0.75], [0.08, 0.08, 1.0], 0.0), 0.0);
        let bodies = [body(&table, 0.0), chair, vase];
        assert_eq!(find_support(1, &bodies, &[None; 3], 0.0), Support::Nothing);
        assert_eq!(
            find_support(2, &bodies, &[None; 3], 0.0),
            Support::Instance { id: InstanceId(1) }
        );
    }

    #[test]
    fn l_shaped_counter_does_not_support_a_stool_in_its_corner() {
        let arms = [([0.0, 0.0, 0.0], [2.0, 0.6, 0.9]), ([0.0, 0.6, 0.0], [0.6, 2.0, 0.9])];
        let counter: Vec<_> = arms.iter().flat_map(|(min, max)| block(*min, *max, 0.7)).collect();
        let stool = |x: f32| body(&block([x, 1.0, 0.86], [x + 0.3, 1.3, 0.96], 0.7), 0.7);
        let bodies = [body(&counter, 0.7), stool(1.2), stool(0.2)];
        assert_eq!(find_support(1, &bodies, &[None; 3], 0.0), Support::Nothing);
        assert_eq!(
            find_support(2, &bodies, &[None; 3], 0.0),
            Support::Instance { id: InstanceId(1) }
        );
    }
}
