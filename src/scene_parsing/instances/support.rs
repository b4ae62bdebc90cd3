//! What each instance rests on: the floor, another instance, or a wall.

use super::Shape;
use crate::progress::{Cancelled, Progress};
use crate::scene::{InstanceId, Structure, Support};
use rayon::prelude::*;

/// Gap under which two surfaces count as touching, metres: a few voxels.
const CONTACT_M: f32 = 0.06;
/// Share of the footprint that must lie over a supporter.
const MIN_OVERLAP: f32 = 0.3;

/// Support of every shape, by index; instance ids are index + 1.
pub(super) fn all(
    shapes: &[Shape],
    structures: &[Option<Structure>],
    floor_z: f32,
    progress: &Progress,
) -> Result<Vec<Support>, Cancelled> {
    let of = |i| progress.check().map(|()| of(i, shapes, structures, floor_z));
    (0..shapes.len()).into_par_iter().map(of).collect()
}

fn of(i: usize, shapes: &[Shape], structures: &[Option<Structure>], floor_z: f32) -> Support {
    let shape = &shapes[i];
    let bottom = shape.aabb.min().z;
    if bottom < floor_z + 2.0 * CONTACT_M {
        return Support::Floor;
    }
    let below = (0..shapes.len())
        .filter(|&j| j != i && structures[j].is_none_or(|s| s == Structure::Floor) && shapes[j].aabb.min().z < bottom)
        .filter(|&j| shape.aabb.footprint_overlap(&shapes[j].aabb) >= MIN_OVERLAP)
        // The supporter ends where this begins, or reaches around it (a shelf): its top is not far below.
        .filter(|&j| shapes[j].aabb.max().z > bottom - CONTACT_M)
        .min_by(|&a, &b| {
            let gap = |j: usize| (shapes[j].aabb.max().z - bottom).abs();
            gap(a).total_cmp(&gap(b)).then(a.cmp(&b))
        });
    if let Some(j) = below {
        return Support::Instance { id: InstanceId(j as u32 + 1) };
    }
    let behind = (0..shapes.len())
        .filter(|&j| structures[j] == Some(Structure::Wall) && shape.aabb.gap(&shapes[j].aabb) < 2.0 * CONTACT_M)
        .min_by(|&a, &b| shape.aabb.gap(&shapes[a].aabb).total_cmp(&shape.aabb.gap(&shapes[b].aabb)).then(a.cmp(&b)));
    behind.map_or(Support::Nothing, |j| Support::Wall { id: InstanceId(j as u32 + 1) })
}
