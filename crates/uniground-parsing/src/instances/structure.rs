//! Decides which instances are floor, ceiling and walls: those that lie on a plane of the building
//! and are as large as one.

use super::RegionShape;
use crate::planes::Planes;
use uniground_geometry::scene::Structure;

/// Share of an instance's points that must lie on a plane of the building.
const ON_PLANE: f32 = 0.6;
/// Minimum share of its plane that a floor or ceiling covers: a doormat is no floor.
const MIN_LEVEL_SHARE: f32 = 0.08;
/// Strips smaller than this are not walls, square meters.
const MIN_WALL_M2: f32 = 1.0;
/// Doors and cupboards end below this height, walls above it. Meters above the floor.
const WALL_TOP_M: f32 = 2.2;
/// Windows begin above this height, walls below it, though furniture can hide their lower part.
/// Meters above the floor.
const WALL_BOTTOM_M: f32 = 0.9;
/// A plane wider than this is a wall at any height, meters.
const WALL_WIDTH_M: f32 = 1.8;

/// Returns the structure of an instance. `on_plane`: its points per plane of the building.
pub(super) fn classify(
    shape: &RegionShape,
    on_plane: &[(u32, u32)],
    planes: &Planes,
    floor_z: f32,
) -> Option<Structure> {
    let &(plane, points) =
        on_plane.iter().max_by_key(|(plane, points)| (*points, std::cmp::Reverse(*plane)))?;
    if (points as f32) < ON_PLANE * shape.point_count as f32 {
        return None;
    }
    let plane = &planes.planes[plane as usize];
    let size = shape.oriented_box.size;
    let structural = match plane.structure {
        Structure::Floor | Structure::Ceiling => size.x * size.y >= MIN_LEVEL_SHARE * plane.area_m2,
        Structure::Wall => {
            let (bottom, top) = (shape.aabb.min().z - floor_z, shape.aabb.max().z - floor_z);
            let tall =
                (top > WALL_TOP_M && bottom < WALL_BOTTOM_M) || size.xy().max() > WALL_WIDTH_M;
            tall && size.z > 0.8 && size.z * size.xy().max() > MIN_WALL_M2
        }
    };
    structural.then_some(plane.structure)
}
