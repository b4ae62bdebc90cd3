//! What each instance rests on: the floor, another instance, or a wall.

use crate::geometry::boxes::Aabb;
use crate::progress::{Cancelled, Progress};
use crate::scene::{InstanceId, Structure, Support};
use rayon::prelude::*;

/// Gap under which two surfaces count as touching, metres: a few voxels.
pub(super) const CONTACT_M: f32 = 0.06;
/// Share of the footprint that must lie over a supporter.
const MIN_OVERLAP: f32 = 0.3;
/// Chairs and tables have legs; mugs and fragments of shelves do not. Metres.
const MIN_LEGGED_WIDTH_M: f32 = 0.25;
/// Legs of tables are no longer, metres.
const MAX_LEGS_M: f32 = 0.8;
/// Legs are seldom longer than this many times the width of what they carry.
const LEGS_PER_WIDTH: f32 = 1.5;

/// Support of every box, by index; instance ids are index + 1. `floor_z` in metres, world frame (Z up).
///
/// # Errors
/// [`Cancelled`].
pub fn supports(boxes: &[Aabb], structures: &[Option<Structure>], floor_z: f32, progress: &Progress) -> Result<Vec<Support>, Cancelled> {
    let of = |i| progress.check().map(|()| of(i, boxes, structures, floor_z));
    (0..boxes.len()).into_par_iter().map(of).collect()
}

/// Support of one of the boxes.
pub(super) fn of(i: usize, boxes: &[Aabb], structures: &[Option<Structure>], floor_z: f32) -> Support {
    let own = &boxes[i];
    let bottom = own.min().z;
    if bottom < floor_z + 2.0 * CONTACT_M {
        return Support::Floor;
    }
    let below = (0..boxes.len())
        .filter(|&j| j != i && structures[j].is_none_or(|s| s == Structure::Floor) && boxes[j].min().z < bottom)
        .filter(|&j| own.footprint_overlap(&boxes[j]) >= MIN_OVERLAP)
        // The supporter ends where this begins, or reaches around it (a shelf): its top is not far below.
        .filter(|&j| boxes[j].max().z > bottom - CONTACT_M)
        .min_by(|&a, &b| {
            let gap = |j: usize| (boxes[j].max().z - bottom).abs();
            gap(a).total_cmp(&gap(b)).then(a.cmp(&b))
        });
    if let Some(j) = below {
        return Support::Instance { id: InstanceId(j as u32 + 1) };
    }
    let behind = (0..boxes.len())
        .filter(|&j| structures[j] == Some(Structure::Wall) && own.gap(&boxes[j]) < 2.0 * CONTACT_M)
        .min_by(|&a, &b| own.gap(&boxes[a]).total_cmp(&own.gap(&boxes[b])).then(a.cmp(&b)));
    behind.map_or(Support::Nothing, |j| Support::Wall { id: InstanceId(j as u32 + 1) })
}

/// The height down to which a thing reaches that seems to float, metres, and what it then stands on. Nothing floats: what no wall or ceiling
/// holds stands on legs too slender for the scan, like a chair of which only seat and back were seen.
pub(super) fn on_legs(i: usize, boxes: &[Aabb], structures: &[Option<Structure>], floor_z: f32) -> Option<(f32, Support)> {
    let own = &boxes[i];
    let (bottom, width) = (own.min().z, own.size.xy().max());
    let held = |j: usize| structures[j].is_some_and(|s| s != Structure::Floor) && own.gap(&boxes[j]) < 2.0 * CONTACT_M;
    if structures[i].is_some() || width < MIN_LEGGED_WIDTH_M || (0..boxes.len()).any(held) {
        return None;
    }
    let under = (0..boxes.len())
        .filter(|&j| j != i && structures[j].is_none() && boxes[j].max().z <= bottom && own.footprint_overlap(&boxes[j]) >= MIN_OVERLAP)
        .max_by(|&a, &b| boxes[a].max().z.total_cmp(&boxes[b].max().z).then(b.cmp(&a)));
    let instance = |j: usize| (boxes[j].max().z, Support::Instance { id: InstanceId(j as u32 + 1) });
    let (surface_z, support) = under.map_or((floor_z, Support::Floor), instance);
    (bottom - surface_z <= MAX_LEGS_M.min(width * LEGS_PER_WIDTH)).then_some((surface_z, support))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::Point3;

    fn spanning(min: [f32; 3], max: [f32; 3]) -> Aabb {
        Aabb::from_corners(Point3::from(min), Point3::from(max))
    }

    /// A seat 40 cm over the floor, nothing near it but what each case adds.
    #[test]
    fn nothing_floats() {
        let seat = spanning([0.0, 0.0, 0.4], [0.5, 0.5, 0.9]);
        let beside = |other: Aabb, structure| on_legs(0, &[seat, other], &[None, structure], 0.0);
        assert_eq!(on_legs(0, &[seat], &[None], 0.0), Some((0.0, Support::Floor)));
        let box_below = spanning([0.1, 0.1, 0.0], [0.5, 0.5, 0.2]);
        assert_eq!(beside(box_below, None), Some((0.2, Support::Instance { id: InstanceId(2) })));
        let wall = spanning([-0.1, -2.0, 0.0], [-0.05, 2.0, 2.5]);
        assert_eq!(beside(wall, Some(Structure::Wall)), None, "it hangs");
        let mug = spanning([0.0, 0.0, 0.4], [0.1, 0.1, 0.5]);
        assert_eq!(on_legs(0, &[mug], &[None], 0.0), None, "too slight for legs");
        let lamp = spanning([0.0, 0.0, 1.5], [0.4, 0.4, 1.8]);
        assert_eq!(on_legs(0, &[lamp], &[None], 0.0), None, "too high for legs");
    }
}
