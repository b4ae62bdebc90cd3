//! What each instance rests on: the floor, another instance, or a wall.

use crate::geometry::boxes::Aabb;
use crate::progress::{Cancelled, Progress};
use crate::scene::{InstanceId, Structure, Support};
use rayon::prelude::*;

/// Gap under which two surfaces count as touching, metres: a few voxels.
const CONTACT_M: f32 = 0.06;
/// Share of the footprint that must lie over a supporter.
const MIN_OVERLAP: f32 = 0.3;

/// Support of every box, by index; instance ids are index + 1. `floor_z` in metres, world frame (Z up).
///
/// # Errors
/// [`Cancelled`].
pub fn supports(boxes: &[Aabb], structures: &[Option<Structure>], floor_z: f32, progress: &Progress) -> Result<Vec<Support>, Cancelled> {
    let of = |i| progress.check().map(|()| of(i, boxes, structures, floor_z));
    (0..boxes.len()).into_par_iter().map(of).collect()
}

fn of(i: usize, boxes: &[Aabb], structures: &[Option<Structure>], floor_z: f32) -> Support {
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
