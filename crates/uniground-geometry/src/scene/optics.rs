//! Converts the picture files of a frame to pinhole pictures seen from one camera: removes lens
//! distortion, reprojects separate depth cameras, applies confidence. Applied once, when a frame is
//! decoded. Other code sees only pinhole pictures.

use super::{DepthImage, Intrinsics};
use crate::{Isometry3, Point3};
use camino::Utf8PathBuf;
use image::RgbImage;
use serde::{Deserialize, Serialize};

/// The corrections for a frame's pictures; empty for most scans.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct Optics {
    /// Lens of the color camera. `None`: the picture is rectified already.
    #[serde(rename = "colour_lens")]
    pub color_lens: Option<Lens>,
    /// Lens of the depth camera. `None`: the picture is rectified already.
    pub depth_lens: Option<Lens>,
    /// A depth camera beside the color camera. `None`: both pictures have the same pose.
    pub depth_sensor: Option<DepthSensor>,
    /// Confidence of the depth, pixel by pixel.
    pub confidence: Option<Confidence>,
}

/// Distortion of a lens in OpenCV's form: radial
/// `(1 + k1 r2 + k2 r4 + k3 r6) / (1 + k4 r2 + k5 r4 + k6 r6)` and tangential `p1`, `p2`, in
/// coordinates on the plane at depth 1.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
#[allow(missing_docs)]
pub struct Lens {
    pub k1: f32,
    pub k2: f32,
    pub p1: f32,
    pub p2: f32,
    pub k3: f32,
    pub k4: f32,
    pub k5: f32,
    pub k6: f32,
}

/// A depth camera with a pose of its own.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct DepthSensor {
    /// Intrinsics of the depth picture in the file, pixels.
    pub intrinsics: Intrinsics,
    /// Transform from the depth camera's axes to the color camera's (both OpenCV), meters.
    #[serde(rename = "depth_to_colour")]
    pub depth_to_color: Isometry3<f32>,
}

/// A confidence picture of a depth picture.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Confidence {
    /// 8-bit gray, of any size with the same aspect ratio.
    pub file: Utf8PathBuf,
    /// Minimum confidence: depth below it counts as no measurement.
    pub at_least: u8,
}

impl Lens {
    /// Returns the lens, unless it has no distortion.
    #[must_use]
    pub fn reject_identity(self) -> Option<Self> {
        (self != Self::default()).then_some(self)
    }

    /// Returns whether all coefficients are finite and in the range of real lenses.
    #[must_use]
    pub fn is_plausible(&self) -> bool {
        let Self { k1, k2, p1, p2, k3, k4, k5, k6 } = *self;
        [k1, k2, p1, p2, k3, k4, k5, k6].iter().all(|k| k.is_finite() && k.abs() < 1e3)
    }

    /// Returns where the lens projects the ray through `(x, y)`, both on the plane at depth 1.
    #[must_use]
    pub fn distort(&self, x: f32, y: f32) -> (f32, f32) {
        let Self { k1, k2, p1, p2, k3, k4, k5, k6 } = *self;
        let r2 = x * x + y * y;
        let radial =
            (1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))) / (1.0 + r2 * (k4 + r2 * (k5 + r2 * k6)));
        (
            x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x),
            y * radial + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y,
        )
    }

    /// Returns the pixel of the distorted picture that corresponds to `(u, v)` of the pinhole
    /// picture.
    fn distorted_pixel(&self, camera: &Intrinsics, u: u32, v: u32) -> (f32, f32) {
        let (x, y) =
            self.distort((u as f32 - camera.cx) / camera.fx, (v as f32 - camera.cy) / camera.fy);
        (x * camera.fx + camera.cx, y * camera.fy + camera.cy)
    }

    /// Rectifies a color picture with the same intrinsics, bilinear. Pixels outside of the original
    /// are black.
    #[must_use]
    pub fn rectify(&self, picture: &RgbImage, camera: &Intrinsics) -> RgbImage {
        let (width, height) = picture.dimensions();
        RgbImage::from_fn(width, height, |u, v| {
            let (x, y) = self.distorted_pixel(camera, u, v);
            image::imageops::interpolate_bilinear(picture, x, y).unwrap_or(image::Rgb([0; 3]))
        })
    }

    /// Rectifies a depth picture by nearest pixel, because depths of two surfaces must not be
    /// mixed.
    #[must_use]
    pub fn rectify_depth(&self, depth: &DepthImage, camera: &Intrinsics) -> DepthImage {
        let pixels = (0..depth.height).flat_map(|v| (0..depth.width).map(move |u| (u, v)));
        let depth_m = pixels
            .map(|(u, v)| {
                let (x, y) = self.distorted_pixel(camera, u, v);
                let inside = x > -0.5
                    && y > -0.5
                    && x < depth.width as f32 - 0.5
                    && y < depth.height as f32 - 0.5;
                if inside { depth.at(((x + 0.5) as u32, (y + 0.5) as u32)) } else { 0.0 }
            })
            .collect();
        DepthImage { width: depth.width, height: depth.height, depth_m }
    }
}

impl DepthSensor {
    /// Returns the intrinsics of a depth picture seen from the color camera: no finer than the
    /// sensor, so that measurements leave no holes.
    #[must_use]
    pub fn registered_intrinsics(&self, color: &Intrinsics) -> Intrinsics {
        let scale = (self.intrinsics.fx / color.fx).clamp(1e-3, 1.0);
        let size = |pixels: u32| ((pixels as f32 * scale).round() as u32).max(1);
        color.scaled_to(size(color.width), size(color.height))
    }

    /// Reprojects the depth picture into the color camera. Of several surfaces in a pixel, keeps
    /// the nearest.
    #[must_use]
    pub fn register(&self, depth: &DepthImage, target: &Intrinsics) -> DepthImage {
        let mut depth_m = vec![0.0_f32; (target.width * target.height) as usize];
        for (i, &z_m) in depth.depth_m.iter().enumerate().filter(|(_, z)| **z > 0.0) {
            let (u, v) = (i as u32 % depth.width, i as u32 / depth.width);
            let p: Point3<f32> =
                self.depth_to_color * self.intrinsics.unproject(u as f32, v as f32, z_m);
            let Some(pixel) = target.project(&p) else { continue };
            // Fills the pixels on either side: resampling alone would leave gaps.
            for (column, row) in [(0, 0), (1, 0), (0, 1), (1, 1)]
                .map(|(a, b)| (pixel.u.floor() as i64 + a, pixel.v.floor() as i64 + b))
            {
                if (0..i64::from(target.width)).contains(&column)
                    && (0..i64::from(target.height)).contains(&row)
                {
                    let cell = &mut depth_m[(row * i64::from(target.width) + column) as usize];
                    if *cell == 0.0 || pixel.z_m < *cell {
                        *cell = pixel.z_m;
                    }
                }
            }
        }
        DepthImage { width: target.width, height: target.height, depth_m }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    const CAMERA: Intrinsics =
        Intrinsics { width: 64, height: 48, fx: 60.0, fy: 60.0, cx: 31.5, cy: 23.5 };

    #[test]
    fn rectify_removes_lens_distortion() {
        let lens = Lens { k1: -0.2, k2: 0.03, p1: 0.001, ..Lens::default() };
        // Brightness is a function of the ray, so the lens's picture of the pattern can be
        // computed.
        let brightness = |x: f32, y: f32| ((x * 100.0 + 128.0) as u8, (y * 100.0 + 128.0) as u8);
        let straight = RgbImage::from_fn(64, 48, |u, v| {
            let (a, b) = brightness((u as f32 - 31.5) / 60.0, (v as f32 - 23.5) / 60.0);
            image::Rgb([a, b, 0])
        });
        let bent = RgbImage::from_fn(64, 48, |u, v| {
            let (x, y) = ((u as f32 - 31.5) / 60.0, (v as f32 - 23.5) / 60.0);
            // The ray of this pixel: inverts the distortion by iteration.
            let (mut a, mut b) = (x, y);
            for _ in 0..20 {
                let (da, db) = lens.distort(a, b);
                (a, b) = (a + x - da, b + y - db);
            }
            let (a, b) = brightness(a, b);
            image::Rgb([a, b, 0])
        });
        let rectified = lens.rectify(&bent, &CAMERA);
        for (u, v) in [(10, 10), (31, 23), (50, 40), (20, 35)] {
            let (found, expected) = (rectified.get_pixel(u, v).0, straight.get_pixel(u, v).0);
            assert!(
                found.iter().zip(expected).all(|(f, e)| f.abs_diff(e) <= 2),
                "({u}, {v}): {found:?} instead of {expected:?}"
            );
        }
    }

    #[test]
    fn a_flat_wall_stays_flat_after_registration() {
        let sensor = DepthSensor {
            intrinsics: CAMERA,
            depth_to_color: Isometry3::translation(0.05, 0.0, 0.1),
        };
        let depth = DepthImage { width: 64, height: 48, depth_m: vec![2.0; 64 * 48] };
        let color = Intrinsics { width: 128, height: 96, fx: 120.0, fy: 120.0, cx: 63.5, cy: 47.5 };
        let target = sensor.registered_intrinsics(&color);
        assert_eq!((target.width, target.height), (64, 48));
        let seen = sensor.register(&depth, &target);
        for u in 8..56 {
            for v in 6..42 {
                assert!((seen.at((u, v)) - 2.1).abs() < 1e-5, "({u}, {v}): {}", seen.at((u, v)));
            }
        }
    }

    proptest! {
        #[test]
        fn the_default_lens_has_no_distortion(x in -1.0_f32..1.0, y in -1.0_f32..1.0) {
            prop_assert_eq!(Lens::default().distort(x, y), (x, y));
            prop_assert_eq!(Lens::default().reject_identity(), None);
        }
    }
}
