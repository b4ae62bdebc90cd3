//! Instances and tiny networks for the unit tests of the other crates. A dev-dependency only.

#![warn(missing_docs)]
// A panic with the cause fails the test.
#![allow(clippy::expect_used, clippy::missing_panics_doc)]

use camino::{Utf8Path, Utf8PathBuf};
use image::{ImageBuffer, Luma};
use std::sync::Arc;
use uniground_geometry::boxes::Aabb;
use uniground_geometry::color::ColorHistogram;
use uniground_geometry::scene::{
    FrameIndex, FrameRef, Instance, InstanceId, Intrinsics, Optics, Support,
};
use uniground_geometry::{Isometry3, Point3, Vector3};
use uniground_models::neural::{DualEncoder, Models, OnnxRuntime, RuntimeSettings, Segmenter};

/// Returns an object whose box has this size (x, y, z in meters) and whose underside is `base`
/// meters above the floor at height 0.
#[must_use]
pub fn thing(
    id: u32,
    center_xy: [f32; 2],
    size: [f32; 3],
    base: f32,
    support: Support,
    rgb: [u8; 3],
) -> Instance {
    let aabb = Aabb {
        center: Point3::new(center_xy[0], center_xy[1], base + size[2] / 2.0),
        size: Vector3::from(size),
    };
    Instance {
        point_count: 1000,
        mean_rgb: rgb,
        colors: ColorHistogram::from_colors([rgb]),
        planarity: 0.3,
        support,
        height_above_floor_m: base,
        ..Instance::from_box(InstanceId(id), aabb)
    }
}

/// Returns the path of a tiny bundle of random weights, such as `tiny-dual-encoder`.
#[must_use]
pub fn bundle(name: &str) -> Utf8PathBuf {
    Utf8Path::new(env!("CARGO_MANIFEST_DIR")).join("../uniground-models/tests/data").join(name)
}

/// Loads the library that `uniground models fetch onnxruntime` downloads, or the one named by
/// `ORT_DYLIB_PATH`.
#[must_use]
pub fn engine() -> OnnxRuntime {
    let named = std::env::var("ORT_DYLIB_PATH").is_ok();
    let library = (!named).then(|| {
        Utf8Path::new(env!("CARGO_MANIFEST_DIR")).join("../../.onnxruntime/libonnxruntime.so")
    });
    let settings = RuntimeSettings { library, threads: Some(2), ..RuntimeSettings::default() };
    OnnxRuntime::load(&settings).expect("uniground models fetch onnxruntime fetches the library")
}

/// Loads the bundle `tiny-dual-encoder`.
#[must_use]
pub fn tiny_encoder() -> Arc<DualEncoder> {
    Models::default()
        .with_encoder(&engine(), &bundle("tiny-dual-encoder"))
        .expect("the bundle loads")
        .encoder
        .expect("it has an encoder")
}

/// Loads a tiny bundle with a segmenter.
#[must_use]
pub fn tiny_segmenter(name: &str) -> Arc<Segmenter> {
    Models::default()
        .with_segmenter(&engine(), &bundle(name))
        .expect("the bundle loads")
        .segmenters
        .remove(0)
}

/// Returns a frame at the origin that looks along +Z and measured `depth_m` meters everywhere. Its
/// depth picture is written into `folder`; it has no color picture.
///
/// # Panics
/// Panics if the picture cannot be written.
#[must_use]
pub fn flat_frame(folder: &Utf8Path, index: u32, camera: Intrinsics, depth_m: f32) -> FrameRef {
    let depth = folder.join(format!("{index}.png"));
    let millimeters = Luma([(depth_m * 1e3) as u16]);
    let picture =
        ImageBuffer::<Luma<u16>, Vec<u16>>::from_pixel(camera.width, camera.height, millimeters);
    picture.save(&depth).expect("the folder is writable");
    FrameRef {
        index: FrameIndex(index),
        time_s: None,
        color: Utf8PathBuf::new(),
        depth,
        color_intrinsics: camera,
        depth_intrinsics: camera,
        depth_scale_m: 0.001,
        camera_to_world: Isometry3::identity(),
        optics: Optics::default(),
    }
}
