//! Pictures of a parsed scene, on the CPU and deterministic: splatted points, boxes, labels.

mod camera;
mod jpeg;
mod overlay;
mod splat;
mod text;

use crate::geometry::boxes::Aabb;
use crate::geometry::statistics::quantile;
use crate::scene::PointCloud;
pub use camera::Orbit;
use image::RgbImage;
pub use jpeg::jpeg;
pub use overlay::{BoxStyle, LabelledBox};

/// Points above this height percentile are left out, so that a ceiling does not hide the room (paper: 95th).
const CEILING_PERCENTILE: f32 = 0.95;
/// Only a scene taller than this has a ceiling to leave out, metres.
const CEILING_FROM_M: f32 = 2.0;

/// Draws the scene from an orbit camera with boxes on top.
#[must_use]
pub fn scene_picture(cloud: &PointCloud, extent: &Aabb, orbit: &Orbit, boxes: &[LabelledBox]) -> RgbImage {
    let camera = orbit.camera(extent);
    let ceiling = (extent.size.z > CEILING_FROM_M)
        .then(|| quantile(&mut cloud.positions.iter().map(|p| p.z).collect::<Vec<_>>(), CEILING_PERCENTILE))
        .flatten()
        .unwrap_or(f32::INFINITY);
    let mut picture = splat::draw(cloud, &camera, |p| p.z <= ceiling);
    overlay::draw(&mut picture, &camera, boxes);
    picture
}
