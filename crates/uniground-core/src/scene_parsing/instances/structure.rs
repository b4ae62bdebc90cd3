//! Floor, ceiling and walls: large planes at the rim of the room.

use super::Shape;
use crate::geometry::statistics::quantile;
use crate::scene::Structure;

/// The shell of the building: floor, rim and top of the scan, as far as its own planes tell.
pub(super) struct Shell {
    pub floor_z: f32,
    top_z: f32,
    /// Rim of the scan along X and Y: (min, max) each.
    rim: [(f32, f32); 2],
    footprint_m2: f32,
}

/// Share of points on one plane from which an instance counts as flat.
const FLAT: f32 = 0.7;
/// Cosine of 20 degrees: how upright or level a plane must be.
const LEVEL: f32 = 0.94;
/// Slack around the rim within which a plane bounds the room, metres: curtains and shelves stand farther in.
const AT_RIM_M: f32 = 0.15;
/// Strips smaller than this are no walls, square metres.
const MIN_WALL_M2: f32 = 1.0;
/// Share of the room's footprint a floor or ceiling part covers at least.
const MIN_LEVEL_SHARE: f32 = 0.08;
/// Doors and cupboards end below this; walls do not. Metres above the floor.
const WALL_TOP_M: f32 = 2.2;
/// Windows begin above this; walls do not, though furniture may hide the part below.
const WALL_BOTTOM_M: f32 = 0.9;
/// What is wider than this is a wall wherever it begins and ends.
const WALL_WIDTH_M: f32 = 1.8;

impl Shell {
    pub fn of(shapes: &[Shape]) -> Self {
        // Point-weighted quantiles of the boxes' bounds: one stray instance outside the window must not move the rim.
        let weighted = |of: &dyn Fn(&Shape) -> f32, q: f32| {
            let mut values: Vec<f32> = shapes.iter().flat_map(|s| std::iter::repeat_n(of(s), (s.point_count / 100 + 1) as usize)).collect();
            quantile(&mut values, q).unwrap_or(0.0)
        };
        let rim = [0, 1].map(|axis| (weighted(&|s| s.aabb.min()[axis], 0.02), weighted(&|s| s.aabb.max()[axis], 0.98)));
        let top_z = weighted(&|s| s.aabb.max().z, 0.98);
        let lowest_z = weighted(&|s| s.aabb.min().z, 0.01);
        let footprint_m2 = ((rim[0].1 - rim[0].0) * (rim[1].1 - rim[1].0)).max(0.01);
        // The floor is the lowest level plane of some size; without one, the lowest points.
        let level = |s: &&Shape| s.normal.z.abs() > LEVEL && s.planarity > FLAT && area(s) > MIN_LEVEL_SHARE * footprint_m2;
        let floor_z = shapes
            .iter()
            .filter(level)
            .map(|s| s.middle.z)
            .min_by(f32::total_cmp)
            .filter(|z| *z < f32::midpoint(lowest_z, top_z));
        Self { floor_z: floor_z.unwrap_or(lowest_z), top_z, rim, footprint_m2 }
    }

    pub fn structure_of(&self, shape: &Shape) -> Option<Structure> {
        if shape.planarity < FLAT {
            return None;
        }
        if shape.normal.z.abs() > LEVEL {
            if area(shape) < MIN_LEVEL_SHARE * self.footprint_m2 {
                return None;
            }
            return match shape.middle.z {
                z if (z - self.floor_z).abs() < 0.1 => Some(Structure::Floor),
                z if z > self.floor_z + 1.9 && z > self.top_z - 0.3 => Some(Structure::Ceiling),
                _ => None,
            };
        }
        let upright = shape.normal.z.abs() < (1.0 - LEVEL * LEVEL).sqrt();
        let size = shape.oriented_box.size;
        let (bottom, top) = (shape.aabb.min().z - self.floor_z, shape.aabb.max().z - self.floor_z);
        let tall = (top > WALL_TOP_M && bottom < WALL_BOTTOM_M) || size.xy().max() > WALL_WIDTH_M;
        let large = size.z > 0.8 && size.z * size.xy().max() > MIN_WALL_M2;
        (upright && tall && large && self.at_rim(shape)).then_some(Structure::Wall)
    }

    /// A plane bounds the room when its middle lies at either end of the scan's rim along the axis, X or Y, that its normal is closest to.
    fn at_rim(&self, shape: &Shape) -> bool {
        let axis = usize::from(shape.normal.x.abs() <= shape.normal.y.abs());
        let at = shape.middle[axis];
        let oblique = shape.normal[axis].abs() < LEVEL;
        // A wall that is not parallel to the axes cuts a corner off the rim: leave it more slack.
        let slack = if oblique { 0.35 * (self.rim[axis].1 - self.rim[axis].0) } else { AT_RIM_M };
        (at - self.rim[axis].0).abs() < slack || (at - self.rim[axis].1).abs() < slack
    }
}

fn area(shape: &Shape) -> f32 {
    shape.oriented_box.size.x * shape.oriented_box.size.y
}
