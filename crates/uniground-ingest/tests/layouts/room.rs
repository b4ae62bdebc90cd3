//! Renders a small room by ray casting: the content of every layout.

use image::{DynamicImage, ImageBuffer, ImageFormat, Luma, Rgb, RgbImage};
use nalgebra::{
    Isometry3, Matrix3, Matrix4, Point3, Rotation3, Translation3, UnitQuaternion, Vector3,
};
use std::io::Cursor;
use uniground_geometry::scene::Intrinsics;

/// The room's walls (seen from within) and boxes in it: low corner, high corner, color. Meters, Z
/// up.
const INSIDE: ([f32; 3], [f32; 3]) = ([-2.6, -2.1, 0.0], [2.6, 2.1, 2.5]);
const THINGS: [([f32; 3], [f32; 3], [u8; 3]); 4] = [
    ([-2.6, -1.0, 0.0], [-1.7, 1.0, 0.8], [190, 30, 30]),
    ([0.8, -0.9, 0.0], [1.3, -0.5, 0.4], [30, 60, 190]),
    ([-0.5, 0.6, 0.0], [0.6, 1.3, 0.7], [30, 150, 50]),
    ([1.9, 1.2, 0.0], [2.6, 2.1, 1.6], [160, 140, 60]),
];
pub const FRAMES: usize = 12;
/// The camera of most layouts.
pub const CAMERA: Intrinsics =
    Intrinsics { width: 160, height: 120, fx: 120.0, fy: 120.0, cx: 79.5, cy: 59.5 };

/// Returns the camera-to-world pose (OpenCV, Z up, meters) of a frame near the center that looks
/// outwards and down.
pub fn pose(frame: usize) -> Isometry3<f64> {
    let angle = frame as f64 / FRAMES as f64 * std::f64::consts::TAU;
    let eye =
        Vector3::new(0.9 * angle.cos() + 0.1, -0.5 * angle.sin(), 1.45 + 0.1 * (3.0 * angle).sin());
    let target = Vector3::new(-1.4 * angle.cos(), 1.2 * angle.sin(), 0.6);
    let forward = (target - eye).normalize();
    let right = forward.cross(&Vector3::z()).normalize();
    let rotation = Matrix3::from_columns(&[right, forward.cross(&right), forward]);
    let rotation =
        UnitQuaternion::from_rotation_matrix(&Rotation3::from_matrix_unchecked(rotation));
    Isometry3::from_parts(Translation3::from(eye), rotation)
}

/// Formats a matrix as row-major text.
pub fn rows(matrix: &Matrix4<f64>) -> String {
    matrix
        .row_iter()
        .map(|r| format!("{:.9} {:.9} {:.9} {:.9}\n", r[0], r[1], r[2], r[3]))
        .collect()
}

/// Returns the conversion between OpenCV and OpenGL camera axes.
pub fn opengl() -> Matrix4<f64> {
    Matrix4::from_diagonal(&nalgebra::Vector4::new(1.0, -1.0, -1.0, 1.0))
}

/// Returns the conversion from the Z-up world to a Y-up one.
pub fn y_up() -> Matrix4<f64> {
    Matrix4::new(1., 0., 0., 0., 0., 0., 1., 0., 0., -1., 0., 0., 0., 0., 0., 1.)
}

/// Returns the depth along the optical axis in meters and the color of a pixel.
fn cast_ray(camera: &Intrinsics, pose: &Isometry3<f64>, u: u32, v: u32) -> (f32, [u8; 3]) {
    let origin = pose.translation.vector.cast::<f32>();
    let ray =
        Vector3::new((u as f32 - camera.cx) / camera.fx, (v as f32 - camera.cy) / camera.fy, 1.0);
    let ray = pose.rotation.cast::<f32>() * ray;
    let slab = |low: &[f32; 3], high: &[f32; 3]| {
        let (mut near, mut far, mut sides) = (0.0_f32, f32::INFINITY, [0, 0]);
        for i in 0..3 {
            let (a, b) = ((low[i] - origin[i]) / ray[i], (high[i] - origin[i]) / ray[i]);
            if a.min(b) > near {
                (near, sides[0]) = (a.min(b), i);
            }
            if a.max(b) < far {
                (far, sides[1]) = (a.max(b), i);
            }
        }
        (near, far, sides)
    };
    let shade =
        |rgb: [u8; 3], side: usize| rgb.map(|c| (f32::from(c) * [0.8, 0.9, 1.0][side]) as u8);
    let (_, wall, sides) = slab(&INSIDE.0, &INSIDE.1);
    let mut best = (wall, shade([200, 195, 180], sides[1]));
    for (low, high, rgb) in &THINGS {
        let (near, far, sides) = slab(low, high);
        if near < far && near > 0.0 && near < best.0 {
            best = (near, shade(*rgb, sides[0]));
        }
    }
    best
}

pub fn color(camera: &Intrinsics, pose: &Isometry3<f64>) -> DynamicImage {
    RgbImage::from_fn(camera.width, camera.height, |u, v| Rgb(cast_ray(camera, pose, u, v).1))
        .into()
}

/// Returns the depth in meters, row-major.
pub fn depth_m(camera: &Intrinsics, pose: &Isometry3<f64>) -> Vec<f32> {
    (0..camera.height)
        .flat_map(|v| (0..camera.width).map(move |u| (u, v)))
        .map(|(u, v)| cast_ray(camera, pose, u, v).0)
        .collect()
}

/// Returns 16-bit gray values in units of `scale_m`.
pub fn depth(camera: &Intrinsics, pose: &Isometry3<f64>, scale_m: f32) -> DynamicImage {
    let units = depth_m(camera, pose).into_iter().map(|z| (z / scale_m).round() as u16).collect();
    ImageBuffer::<Luma<u16>, Vec<u16>>::from_raw(camera.width, camera.height, units).unwrap().into()
}

pub fn encoded(picture: &DynamicImage, format: ImageFormat) -> Vec<u8> {
    let mut bytes = Cursor::new(Vec::new());
    picture.write_to(&mut bytes, format).unwrap();
    bytes.into_inner()
}

pub type Points = Vec<(Point3<f64>, [u8; 3])>;

/// Returns points of the room's surfaces, a few centimeters apart, with color.
pub fn cloud() -> Points {
    let mut points = Vec::new();
    let mut block =
        |low: [f32; 3], high: [f32; 3], rgb: [u8; 3], has_top: bool, has_bottom: bool| {
            let steps: [u32; 3] =
                std::array::from_fn(|i| ((high[i] - low[i]) / 0.03).round() as u32);
            for x in 0..=steps[0] {
                for y in 0..=steps[1] {
                    for z in 0..=steps[2] {
                        let side = x == 0 || x == steps[0] || y == 0 || y == steps[1];
                        if side || (z == 0 && has_bottom) || (z == steps[2] && has_top) {
                            let at = |i: usize, k: u32| {
                                f64::from(low[i])
                                    + f64::from(high[i] - low[i]) * f64::from(k)
                                        / f64::from(steps[i])
                            };
                            points.push((Point3::new(at(0, x), at(1, y), at(2, z)), rgb));
                        }
                    }
                }
            }
        };
    block(INSIDE.0, INSIDE.1, [200, 195, 180], false, true);
    THINGS.iter().for_each(|(low, high, rgb)| block(*low, *high, *rgb, true, false));
    points
}

/// Returns the same surfaces as a few vertices and squares.
pub fn mesh() -> (Points, Vec<[usize; 4]>) {
    let (mut corners, mut squares) = (Vec::new(), Vec::new());
    let mut block = |low: [f32; 3], high: [f32; 3], rgb: [u8; 3], lid: usize| {
        let first = corners.len();
        for i in 0..8 {
            let at =
                |axis: usize| f64::from(if i >> axis & 1 == 1 { high[axis] } else { low[axis] });
            corners.push((Point3::new(at(0), at(1), at(2)), rgb));
        }
        // Four walls, and a floor or a top.
        for square in [
            [0, 1, 5, 4],
            [2, 3, 7, 6],
            [0, 2, 6, 4],
            [1, 3, 7, 5],
            [lid, lid + 1, lid + 3, lid + 2],
        ] {
            squares.push(square.map(|i| first + i));
        }
    };
    block(INSIDE.0, INSIDE.1, [200, 195, 180], 0);
    THINGS.iter().for_each(|(low, high, rgb)| block(*low, *high, *rgb, 4));
    (corners, squares)
}
