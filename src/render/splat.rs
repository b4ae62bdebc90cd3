//! Points as z-buffered squares, large enough to close the gaps between them.

use crate::geometry::Point3;
use crate::geometry::voxels::typical_spacing_m;
use crate::scene::{Camera, PointCloud};
use image::{Rgba, RgbaImage};
use rayon::prelude::*;

/// A splat is this much wider than the spacing of the points: seen at a slant, surfaces would tear otherwise.
const OVERLAP: f32 = 1.6;
const MAX_SPLAT_PX: f32 = 24.0;

/// Draws the points that `keep` keeps; transparent where there are none.
pub(super) fn draw(cloud: &PointCloud, camera: &Camera, keep: impl Fn(&Point3<f32>) -> bool + Sync) -> RgbaImage {
    let (width, height) = (camera.intrinsics.width, camera.intrinsics.height);
    let size_m = typical_spacing_m(&cloud.positions) * OVERLAP;
    let splats: Vec<(f32, f32, f32, [u8; 3])> = cloud
        .positions
        .par_iter()
        .zip(&cloud.colours)
        .filter(|(p, _)| keep(p))
        .filter_map(|(p, &colour)| camera.project(p).map(|pixel| (pixel.u, pixel.v, pixel.z_m, colour)))
        .collect();
    let mut picture = RgbaImage::new(width, height);
    let mut depth = vec![f32::INFINITY; (width * height) as usize];
    for (u, v, z_m, colour) in splats {
        let half = (camera.intrinsics.fx * size_m / z_m / 2.0).clamp(0.5, MAX_SPLAT_PX / 2.0);
        let span = |at: f32, len: u32| ((at - half + 0.5).max(0.0) as u32)..((at + half + 0.5).max(0.0) as u32).clamp(1, len);
        for row in span(v, height) {
            for column in span(u, width) {
                let nearest = &mut depth[(row * width + column) as usize];
                if z_m < *nearest {
                    *nearest = z_m;
                    let [r, g, b] = colour;
                    picture.put_pixel(column, row, Rgba([r, g, b, 255]));
                }
            }
        }
    }
    picture
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::{Isometry3, Vector3};
    use crate::scene::Intrinsics;

    #[test]
    fn a_plane_has_no_holes_and_hides_what_is_behind() {
        let mut cloud = PointCloud::default();
        for (z, colour) in [(3.0, [0, 0, 255]), (2.0, [255, 0, 0])] {
            for i in -50..=50 {
                for j in -50..=50 {
                    cloud.positions.push(Point3::new(i as f32 * 0.02, j as f32 * 0.02, z));
                    cloud.colours.push(colour);
                }
            }
        }
        let intrinsics = Intrinsics { width: 200, height: 200, fx: 200.0, fy: 200.0, cx: 99.5, cy: 99.5 };
        let picture = draw(&cloud, &Camera::new(intrinsics, &Isometry3::from(Vector3::zeros())), |_| true);
        let window = picture.enumerate_pixels().filter(|(x, y, _)| (10..190).contains(x) && (10..190).contains(y));
        assert!(window.into_iter().all(|(_, _, p)| *p == Rgba([255, 0, 0, 255])));
    }
}
