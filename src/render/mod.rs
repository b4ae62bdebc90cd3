//! Pictures of a parsed scene, on the CPU and deterministic: splatted points, boxes, labels.

mod camera;
mod jpeg;
mod overlay;
mod splat;
mod text;

use crate::geometry::boxes::Aabb;
use crate::geometry::statistics::quantile;
use crate::scene::Camera;
use crate::scene::PointCloud;
pub use camera::Orbit;
use image::{Pixel, Rgb, RgbImage};
pub use jpeg::jpeg;
pub use overlay::{BoxStyle, LabelledBox};

const BACKGROUND: Rgb<u8> = Rgb([250, 250, 250]);
/// Points above this height percentile are left out, so that a ceiling does not hide the room (paper: 95th).
const CEILING_PERCENTILE: f32 = 0.95;
/// Only a scene taller than this has a ceiling to leave out, metres.
const CEILING_FROM_M: f32 = 2.0;

/// How a whole room is shown: from the south, well above. Left is -X, right is +X, the far wall +Y.
pub const ROOM_VIEW: Orbit = Orbit { width: 1024, height: 768, azimuth_deg: -90.0, tilt_deg: 35.0 };

/// A frame with the cloud's colours laid over it, half transparent. `camera` is the frame's own.
#[must_use]
pub fn frame_overlay(frame: &RgbImage, camera: &Camera, cloud: &PointCloud) -> RgbImage {
    let mut picture = frame.clone();
    for (under, over) in picture.pixels_mut().zip(splat::draw(cloud, camera, |_| true).pixels()) {
        let [r, g, b, alpha] = over.0;
        if alpha > 0 {
            under.0 = [u8::midpoint(under.0[0], r), u8::midpoint(under.0[1], g), u8::midpoint(under.0[2], b)];
        }
    }
    picture
}

/// Draws the scene from an orbit camera with boxes on top.
#[must_use]
pub fn scene_picture(cloud: &PointCloud, extent: &Aabb, orbit: &Orbit, boxes: &[LabelledBox]) -> RgbImage {
    let camera = orbit.camera(extent);
    let ceiling = (extent.size.z > CEILING_FROM_M)
        .then(|| quantile(&mut cloud.positions.iter().map(|p| p.z).collect::<Vec<_>>(), CEILING_PERCENTILE))
        .flatten()
        .unwrap_or(f32::INFINITY);
    let splats = splat::draw(cloud, &camera, |p| p.z <= ceiling);
    let mut picture = RgbImage::from_pixel(orbit.width, orbit.height, BACKGROUND);
    for (under, over) in picture.pixels_mut().zip(splats.pixels()).filter(|(_, over)| over.0[3] > 0) {
        *under = over.to_rgb();
    }
    overlay::draw(&mut picture, &camera, boxes);
    picture
}
