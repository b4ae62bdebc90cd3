//! Draws pictures of a parsed scene, on the CPU and deterministic: splatted points, boxes, labels.

#![warn(missing_docs)]

mod building;
mod camera;
mod candidates;
mod close_up;
mod collage;
mod combined;
mod directions;
mod insets;
mod jpeg;
mod marks;
mod outline;
mod overlay;
mod render_scene;
mod shot;
mod text;
mod visible_instances;

pub use camera::Orbit;
pub use candidates::{GlobalView, Subjects};
pub use close_up::close_ups;
pub use collage::{Area, Collage, Tile, draw_mosaic, mosaic_tiles};
pub use combined::{CombinedPicture, combine_pictures};
pub use directions::DirectionWord;
use image::{Pixel as _, Rgb, RgbImage};
pub use jpeg::encode_jpeg;
pub use marks::{Mark, draw_marks};
pub use outline::{Surroundings, draw_outline, outline_reach};
pub use overlay::{BoxStyle, LabeledBox};
use render_scene::Splats;
pub use render_scene::{Cutaway, RenderScene};
pub use shot::{Shot, crop_area, cut_out_area, to_area_shares};
use uniground_geometry::Point3;
use uniground_geometry::boxes::Aabb;
use uniground_geometry::scene::Camera;
pub use visible_instances::{FrameContent, FrameContents, VisibleInstance, middle_of_mask};

const BACKGROUND: Rgb<u8> = Rgb([250, 250, 250]);
/// Default view of a whole room: from the south, well above. Left is -X, right is +X, the
/// far wall +Y.
pub const ROOM_VIEW: Orbit = Orbit { width: 1024, height: 768, azimuth_deg: -90.0, tilt_deg: 35.0 };

/// Draws the cloud's colors over a frame, half transparent. `camera` is the frame's own.
#[must_use]
pub fn draw_frame_overlay(
    frame: &RgbImage,
    camera: &Camera,
    render_scene: &RenderScene,
) -> RgbImage {
    let mut picture = frame.clone();
    for (under, over) in
        picture.pixels_mut().zip(render_scene.draw_with_ceiling(camera).picture.pixels())
    {
        let [r, g, b, alpha] = over.0;
        if alpha > 0 {
            under.0 = [
                u8::midpoint(under.0[0], r),
                u8::midpoint(under.0[1], g),
                u8::midpoint(under.0[2], b),
            ];
        }
    }
    picture
}

/// Draws the scene from an orbit camera with boxes on top. The inside of the room is visible: see
/// [`Cutaway::Building`].
#[must_use]
pub fn draw_scene(
    render_scene: &RenderScene,
    extent: &Aabb,
    orbit: &Orbit,
    boxes: &[LabeledBox],
) -> RgbImage {
    let camera = orbit.camera(extent);
    let subjects: Vec<Aabb> = boxes.iter().map(|b| b.aabb).collect();
    let drawn = render_scene.draw_from_outside(&camera, Cutaway::Building, &subjects);
    let mut picture = over_background(&drawn);
    overlay::draw(&mut picture, &drawn, &camera, boxes, Vec::new());
    picture
}

/// Returns the drawn points over the background.
fn over_background(drawn: &Splats) -> RgbImage {
    let mut picture =
        RgbImage::from_pixel(drawn.picture.width(), drawn.picture.height(), BACKGROUND);
    for (under, over) in
        picture.pixels_mut().zip(drawn.picture.pixels()).filter(|(_, over)| over.0[3] > 0)
    {
        *under = over.to_rgb();
    }
    picture
}

/// Renders what a camera at `eye` that looks at `at` would see of the cloud, ceilings included.
/// Returns the camera (640 x 480), its picture, and the depth of every pixel in meters.
#[must_use]
pub fn render_frame(
    scene: &RenderScene,
    eye: &Point3<f32>,
    at: &Point3<f32>,
) -> (Camera, image::RgbaImage, Vec<f32>) {
    let camera = Camera::new(camera::default_intrinsics(640, 480), &camera::look_at(eye, at, 0.0));
    let Splats { picture, depth_m, .. } = scene.draw_with_ceiling(&camera);
    (camera, picture, depth_m)
}
