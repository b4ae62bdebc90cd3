//! Computes which part of an object is visible from a position: rays through the columns of the
//! scene.

use super::floor::layers;
use super::occupancy::{Occupancy, Voxel, layer_of};
use super::target::Target;
use uniground_geometry::Point3;

/// The visible part of a target.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Look {
    /// Share of the sampled points that nothing else hides.
    pub visible_share: f32,
    /// The middle of the visible points, world frame; of all points where none is visible.
    pub middle: Point3<f32>,
}

/// Casts rays from a point to a sample of the target.
pub(super) fn look(
    occupancy: &Occupancy,
    target: &Target,
    eye: &Point3<f32>,
    sample: &[Voxel],
) -> Look {
    let (mut seen, mut sum, mut sum_of_all) =
        (0_u32, nalgebra::Vector3::zeros(), nalgebra::Vector3::zeros());
    for &voxel in sample {
        let point = occupancy.center(voxel);
        sum_of_all += point.coords;
        if is_visible(occupancy, target, eye, voxel) {
            seen += 1;
            sum += point.coords;
        }
    }
    let middle = if seen > 0 { sum / seen as f32 } else { sum_of_all / sample.len().max(1) as f32 };
    Look { visible_share: seen as f32 / sample.len().max(1) as f32, middle: Point3::from(middle) }
}

/// Returns whether nothing but the target itself lies between the eye and one of its voxels.
///
/// Neighbors of the voxel do not count: a mug's lowest points share voxels with the table they
/// stand on.
fn is_visible(occupancy: &Occupancy, target: &Target, eye: &Point3<f32>, voxel: Voxel) -> bool {
    let grid = &occupancy.grid;
    let (to, end) = (occupancy.center(voxel), grid.place(voxel.cell()));
    let Some(mut at) = grid.at(eye.x, eye.y) else { return false };
    let (from, along) = (eye, to - eye);
    // Share of the ray at which the next cell border is crossed, and the share between two borders.
    let crossing = |axis: usize, place: usize| {
        let border = grid.origin[axis]
            + (place as f32 + if along[axis] > 0.0 { 1.0 } else { 0.0 }) * grid.cell_m;
        if along[axis] == 0.0 { f32::INFINITY } else { (border - from[axis]) / along[axis] }
    };
    let per_cell = [0, 1].map(|axis| (grid.cell_m / along[axis]).abs());
    let mut next = [crossing(0, at.0), crossing(1, at.1)];
    let height = |share: f32| from.z + along.z * share - occupancy.floor_z_m;
    let near_end = layers(voxel.layer() - 1, voxel.layer() + 1);
    let mut share = 0.0_f32;
    loop {
        let until = next[0].min(next[1]).min(1.0);
        let (a, b) = (layer_of(height(share)), layer_of(height(until)));
        let mut hidden_by = occupancy.columns[at.1 * grid.width + at.0]
            & layers(a.min(b), a.max(b))
            & !target.own_layers(at.0, at.1);
        if at.0.abs_diff(end.0) <= 1 && at.1.abs_diff(end.1) <= 1 {
            hidden_by &= !near_end;
        }
        if hidden_by != 0 {
            return false;
        }
        if at == end || until >= 1.0 {
            return true;
        }
        let axis = usize::from(next[1] < next[0]);
        let place = if axis == 0 { &mut at.0 } else { &mut at.1 };
        // The rim of the grid holds no points, so a ray between two cells of it never leaves it.
        *place = if along[axis] > 0.0 { *place + 1 } else { place.saturating_sub(1) };
        share = until;
        next[axis] += per_cell[axis];
    }
}
