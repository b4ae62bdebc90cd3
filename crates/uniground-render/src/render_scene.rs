//! Draws points as z-buffered squares, large enough to close the gaps between them.

use super::building::{Building, RIM_M, box_contains};
use image::{Rgba, RgbaImage};
use rayon::prelude::*;
use std::sync::Arc;
use uniground_geometry::Point3;
use uniground_geometry::boxes::{Aabb, OrientedBox};
use uniground_geometry::scene::{Camera, Instance, PointCloud};
use uniground_geometry::statistics::quantile;
use uniground_geometry::voxels::typical_spacing_m;

/// Width of a splat relative to the spacing of the points: without overlap, slanted surfaces would
/// show gaps.
const OVERLAP: f32 = 1.6;
const MAX_SPLAT_PX: f32 = 24.0;
/// Points above this height percentile are left out, so that a ceiling does not hide the room
/// (paper: 95th).
const CEILING_PERCENTILE: f32 = 0.95;
/// Minimum height of a scene with a ceiling to leave out, meters.
const CEILING_FROM_M: f32 = 2.0;

/// What is left out of a picture so that it shows a room from outside.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub enum Cutaway {
    /// Leaves out walls and ceilings whose backs face the camera or that hide a subject, with the
    /// things on them. Subjects themselves are always drawn. If no ceiling is known, the highest
    /// points are left out as well.
    #[default]
    Building,
    /// Paper: leaves out points above the 95th height percentile, whatever they are.
    HighestPoints,
}

/// A cloud, prepared for drawing.
#[derive(Debug, Clone)]
pub struct RenderScene {
    /// Every point, including the ceiling.
    pub cloud: Arc<PointCloud>,
    spacing_m: f32,
    /// Points above this Z are left out as the highest; infinite in a low room.
    ceiling_m: f32,
    /// Walls and ceilings, if stage 1 has found some.
    building: Option<Building>,
}

impl RenderScene {
    /// Prepares a cloud of which nothing else is known: one pass over its points.
    #[must_use]
    pub fn new(cloud: impl Into<Arc<PointCloud>>) -> Self {
        Self::with_building(cloud, &[])
    }

    /// Prepares a cloud with known walls and ceilings: several passes over its points. Stores two
    /// bytes per point beside the cloud.
    #[must_use]
    pub fn with_building(cloud: impl Into<Arc<PointCloud>>, instances: &[Instance]) -> Self {
        let cloud = cloud.into();
        let mut heights: Vec<f32> = cloud.positions.iter().map(|p| p.z).collect();
        let (low, high) = heights
            .iter()
            .fold((f32::INFINITY, f32::NEG_INFINITY), |(lo, hi), z| (lo.min(*z), hi.max(*z)));
        let ceiling_m = match high - low > CEILING_FROM_M {
            true => quantile(&mut heights, CEILING_PERCENTILE).unwrap_or(f32::INFINITY),
            false => f32::INFINITY,
        };
        let building = Building::fit(&cloud.positions, instances);
        Self { spacing_m: typical_spacing_m(&cloud.positions), ceiling_m, building, cloud }
    }

    /// Returns the typical distance between neighboring points, meters.
    pub(super) fn spacing_m(&self) -> f32 {
        self.spacing_m
    }

    /// Draws the room from outside, with `subjects` visible.
    #[must_use]
    pub(super) fn draw_from_outside(
        &self,
        camera: &Camera,
        cutaway: Cutaway,
        subjects: &[Aabb],
    ) -> Splats {
        let highest_m = match (&self.building, cutaway) {
            (Some(building), Cutaway::Building) if building.has_ceiling() => f32::INFINITY,
            _ => self.ceiling_m,
        };
        let Cutaway::Building = cutaway else {
            return self.draw_points(camera, |_, p| p.z <= highest_m);
        };
        let Some(building) = &self.building else {
            let kept: Vec<OrientedBox> = subjects.iter().map(|s| (*s).into()).collect();
            return self.draw_points(camera, |_, p| {
                p.z <= highest_m || kept.iter().any(|b| box_contains(b, RIM_M, p))
            });
        };
        let opening = building.opening(&camera.center(), subjects);
        let draws = |i: usize, p: &Point3<f32>| match p.z <= highest_m {
            true => building.is_drawn(i, p, &opening),
            false => opening.is_on_subject(p),
        };
        Splats {
            footings: building.open_wall_footings(&opening),
            ..self.draw_points(camera, draws)
        }
    }

    /// Draws every point.
    #[must_use]
    pub(super) fn draw_with_ceiling(&self, camera: &Camera) -> Splats {
        self.draw_points(camera, |_, _| true)
    }

    fn draw_points(
        &self,
        camera: &Camera,
        keep: impl Fn(usize, &Point3<f32>) -> bool + Sync,
    ) -> Splats {
        draw_splats(&self.cloud, self.spacing_m, camera, keep)
    }
}

/// A drawing: colors, and the depth along the optical axis in meters. Empty pixels are transparent
/// and infinitely deep.
pub(super) struct Splats {
    pub picture: RgbaImage,
    pub depth_m: Vec<f32>,
    /// Where walls that were left out meet the floor, world frame.
    pub footings: Vec<[Point3<f32>; 2]>,
}

impl Splats {
    /// Returns the depth at a pixel position; infinite outside of the picture.
    pub fn depth_at(&self, u: f32, v: f32) -> f32 {
        let (width, height) = self.picture.dimensions();
        let inside = u > -0.5 && v > -0.5 && u < width as f32 - 0.5 && v < height as f32 - 0.5;
        if inside {
            self.depth_m[(v + 0.5) as usize * width as usize + (u + 0.5) as usize]
        } else {
            f32::INFINITY
        }
    }

    /// Darkens surfaces that face away from the camera, by up to `strength`. Normals come from the
    /// drawn depth. A gray chair thus stands out from a gray floor.
    pub fn shade(&mut self, camera: &Camera, strength: f32) {
        let (width, height) = (self.picture.width() as usize, self.picture.height() as usize);
        let intrinsics = camera.intrinsics;
        let at = |column: usize, row: usize| {
            let z_m = self.depth_m[row * width + column];
            z_m.is_finite().then(|| intrinsics.unproject(column as f32, row as f32, z_m))
        };
        // Steps of several pixels: splats are small squares that face the camera, so there is no
        // slope within one.
        const STEP: usize = 3;
        let mut light = vec![1.0_f32; width * height];
        light.par_chunks_mut(width).enumerate().for_each(|(row, of_row)| {
            for (column, light) in of_row.iter_mut().enumerate() {
                let (left, right) = (column.saturating_sub(STEP), (column + STEP).min(width - 1));
                let (up, down) = (row.saturating_sub(STEP), (row + STEP).min(height - 1));
                let here = at(column, row);
                let (Some(l), Some(r), Some(u), Some(d), Some(here)) =
                    (at(left, row), at(right, row), at(column, up), at(column, down), here)
                else {
                    continue;
                };
                if let Some(normal) = (r - l).cross(&(d - u)).try_normalize(1e-12) {
                    *light = 1.0 - strength * (1.0 - normal.dot(&here.coords.normalize()).abs());
                }
            }
        });
        for (pixel, light) in self.picture.pixels_mut().zip(light) {
            for channel in &mut pixel.0[..3] {
                *channel = (f32::from(*channel) * light) as u8;
            }
        }
    }
}

pub(super) fn draw_splats(
    cloud: &PointCloud,
    spacing_m: f32,
    camera: &Camera,
    keep: impl Fn(usize, &Point3<f32>) -> bool + Sync,
) -> Splats {
    let (width, height) = (camera.intrinsics.width, camera.intrinsics.height);
    let size_m = spacing_m * OVERLAP;
    let splats: Vec<(f32, f32, f32, [u8; 3])> = cloud
        .positions
        .par_iter()
        .zip(&cloud.colors)
        .enumerate()
        .filter(|(i, (p, _))| keep(*i, p))
        .filter_map(|(_, (p, &color))| {
            camera.project(p).map(|pixel| (pixel.u, pixel.v, pixel.z_m, color))
        })
        .collect();
    let mut picture = RgbaImage::new(width, height);
    let mut depth_m = vec![f32::INFINITY; (width * height) as usize];
    for (u, v, z_m, color) in splats {
        let half = (camera.intrinsics.fx * size_m / z_m / 2.0).clamp(0.5, MAX_SPLAT_PX / 2.0);
        let span = |at: f32, len: u32| {
            ((at - half + 0.5).max(0.0) as u32)..((at + half + 0.5).max(0.0) as u32).clamp(1, len)
        };
        for row in span(v, height) {
            for column in span(u, width) {
                let nearest = &mut depth_m[(row * width + column) as usize];
                if z_m < *nearest {
                    *nearest = z_m;
                    let [r, g, b] = color;
                    picture.put_pixel(column, row, Rgba([r, g, b, 255]));
                }
            }
        }
    }
    Splats { picture, depth_m, footings: Vec::new() }
}

#[cfg(test)]
mod tests {
    use super::*;
    use uniground_geometry::scene::Intrinsics;
    use uniground_geometry::{Isometry3, Vector3};

    const VIEW: Intrinsics =
        Intrinsics { width: 200, height: 200, fx: 200.0, fy: 200.0, cx: 99.5, cy: 99.5 };

    fn grid(at: impl Fn(f32, f32) -> (Point3<f32>, [u8; 3])) -> PointCloud {
        let mut cloud = PointCloud::default();
        for i in -50..=50 {
            for j in -50..=50 {
                let (position, color) = at(i as f32 * 0.02, j as f32 * 0.02);
                cloud.positions.push(position);
                cloud.colors.push(color);
            }
        }
        cloud
    }

    #[test]
    fn plane_has_no_holes_and_hides_points_behind_it() {
        let mut cloud = grid(|x, y| (Point3::new(x, y, 3.0), [0, 0, 255]));
        let front = grid(|x, y| (Point3::new(x, y, 2.0), [255, 0, 0]));
        cloud.positions.extend(front.positions);
        cloud.colors.extend(front.colors);
        let drawn = RenderScene::new(cloud)
            .draw_with_ceiling(&Camera::new(VIEW, &Isometry3::from(Vector3::zeros())));
        let window = drawn
            .picture
            .enumerate_pixels()
            .filter(|(x, y, _)| (10..190).contains(x) && (10..190).contains(y));
        assert!(window.into_iter().all(|(_, _, p)| *p == Rgba([255, 0, 0, 255])));
        assert!(
            (drawn.depth_at(100.0, 100.0) - 2.0).abs() < 1e-5
                && drawn.depth_at(300.0, 0.0).is_infinite()
        );
    }

    #[test]
    fn surfaces_that_face_away_are_darker() {
        let camera = Camera::new(VIEW, &Isometry3::from(Vector3::zeros()));
        let brightness = |slope: f32| {
            let cloud = grid(|x, y| (Point3::new(x, y, 3.0 + slope * x), [200; 3]));
            let mut drawn = RenderScene::new(cloud).draw_with_ceiling(&camera);
            drawn.shade(&camera, 0.5);
            drawn.picture.get_pixel(100, 100).0[0]
        };
        // 45 degrees: half of 1 - cos 45 is .15.
        assert!(
            brightness(0.0) >= 198 && (160..182).contains(&brightness(1.0)),
            "{} {}",
            brightness(0.0),
            brightness(1.0)
        );
    }

    #[test]
    fn ceiling_is_left_out_only_in_tall_rooms() {
        let room = |height: f32| {
            let mut cloud = grid(|x, y| (Point3::new(x, y, 0.0), [90; 3]));
            cloud.positions.extend((0..200).map(|i| Point3::new(i as f32 * 0.01, 0.0, height)));
            cloud.colors.extend([[255; 3]; 200]);
            RenderScene::new(cloud).ceiling_m
        };
        assert!(room(1.0).is_infinite());
        assert!(room(2.5) < 2.5);
    }
}
