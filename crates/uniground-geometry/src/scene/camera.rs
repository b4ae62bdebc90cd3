//! Pinhole cameras in the OpenCV convention.

use crate::{Isometry3, Point3};
use serde::{Deserialize, Serialize};

/// Pinhole intrinsics in pixels; pixel (0, 0) is the center of the top-left pixel.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Intrinsics {
    /// Columns of the picture.
    pub width: u32,
    /// Rows of the picture.
    pub height: u32,
    /// Focal length along x.
    pub fx: f32,
    /// Focal length along y.
    pub fy: f32,
    /// Column where the optical axis crosses the picture.
    pub cx: f32,
    /// Row where the optical axis crosses the picture.
    pub cy: f32,
}

impl Intrinsics {
    /// Returns the intrinsics of the same camera at another resolution.
    #[must_use]
    pub fn scaled_to(&self, width: u32, height: u32) -> Self {
        let (sx, sy) = (width as f32 / self.width as f32, height as f32 / self.height as f32);
        // Coordinates refer to pixel centers, not corners: shift by half a pixel around the
        // scaling.
        let center = |c: f32, s: f32| (c + 0.5) * s - 0.5;
        Self {
            width,
            height,
            fx: self.fx * sx,
            fy: self.fy * sy,
            cx: center(self.cx, sx),
            cy: center(self.cy, sy),
        }
    }

    /// Returns the pixel coordinates of a point in camera axes (meters), or `None` behind the
    /// camera or outside the image.
    #[must_use]
    #[inline]
    pub fn project(&self, p: &Point3<f32>) -> Option<Pixel> {
        if p.z <= 0.0 || p.z.is_nan() {
            return None;
        }
        let pixel =
            Pixel { u: self.fx * p.x / p.z + self.cx, v: self.fy * p.y / p.z + self.cy, z_m: p.z };
        let inside = pixel.u > -0.5
            && pixel.v > -0.5
            && pixel.u < self.width as f32 - 0.5
            && pixel.v < self.height as f32 - 0.5;
        inside.then_some(pixel)
    }

    /// Returns the point at depth `z_m` along the ray through pixel `(u, v)`, camera axes, meters.
    #[must_use]
    pub fn unproject(&self, u: f32, v: f32, z_m: f32) -> Point3<f32> {
        Point3::new((u - self.cx) / self.fx * z_m, (v - self.cy) / self.fy * z_m, z_m)
    }
}

/// A projected point: pixel coordinates and depth along the optical axis.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Pixel {
    /// Column, growing to the right; 0 is the center of the first.
    pub u: f32,
    /// Row, growing downward; 0 is the center of the first.
    pub v: f32,
    /// Depth, meters, always above 0.
    pub z_m: f32,
}

impl Pixel {
    /// Returns the column and row of the pixel that contains this position.
    #[must_use]
    #[inline]
    pub fn cell(&self) -> (u32, u32) {
        ((self.u + 0.5) as u32, (self.v + 0.5) as u32)
    }
}

/// Intrinsics and pose of a camera.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Camera {
    /// Intrinsics at the resolution of the pixels that [`project`](Self::project) returns.
    pub intrinsics: Intrinsics,
    world_to_own: Isometry3<f32>,
    center: Point3<f32>,
}

impl Camera {
    /// Creates a camera. `camera_to_world` is the pose: OpenCV camera axes to the world frame (Z
    /// up), meters.
    #[must_use]
    pub fn new(intrinsics: Intrinsics, camera_to_world: &Isometry3<f32>) -> Self {
        Self {
            intrinsics,
            world_to_own: camera_to_world.inverse(),
            center: Point3::from(camera_to_world.translation.vector),
        }
    }

    /// Projects a world point into pixel coordinates of this camera.
    ///
    /// `p` is in meters, world frame (Z up). Returns `None` behind the camera (`z <= 0`) or outside
    /// the image; ignores depth.
    #[must_use]
    #[inline]
    pub fn project(&self, p: &Point3<f32>) -> Option<Pixel> {
        self.intrinsics.project(&(self.world_to_own * p))
    }

    /// Returns whether part of a ball can [`project`](Self::project) into the image: `false` only
    /// if no point of it does.
    ///
    /// `center` and `radius_m` are in meters, world frame (Z up).
    #[must_use]
    pub fn can_show(&self, center: &Point3<f32>, radius_m: f32) -> bool {
        let Intrinsics { width, height, fx, fy, cx, cy } = self.intrinsics;
        let c = self.world_to_own * center;
        // Margin for rounding, which grows with the distance.
        let radius = radius_m + 1e-3 + 1e-5 * c.coords.norm();
        // Signed distance to a side of the viewing pyramid: `along` pixels from the optical axis,
        // at focal length `f`.
        let inside =
            |f: f32, across: f32, along: f32| f * across + along * c.z > -radius * f.hypot(along);
        c.z > -radius
            && inside(fx, c.x, cx + 0.5)
            && inside(fx, -c.x, width as f32 - 0.5 - cx)
            && inside(fy, c.y, cy + 0.5)
            && inside(fy, -c.y, height as f32 - 0.5 - cy)
    }

    /// Returns the transform from the world frame to OpenCV camera axes, meters: the inverse of the
    /// pose.
    #[must_use]
    pub fn world_to_camera(&self) -> &Isometry3<f32> {
        &self.world_to_own
    }

    /// Returns the optical center, meters, world frame.
    #[must_use]
    pub fn center(&self) -> Point3<f32> {
        self.center
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Vector3;
    use proptest::prelude::*;

    const VGA: Intrinsics =
        Intrinsics { width: 640, height: 480, fx: 577.87, fy: 577.87, cx: 319.5, cy: 239.5 };

    #[test]
    fn points_in_view_project_to_their_pixel_and_others_to_none() {
        let pixel = VGA.project(&Point3::new(0.5, 0.25, 2.0)).unwrap();
        assert!(
            (pixel.u - (319.5 + 144.4675)).abs() < 1e-3
                && (pixel.v - (239.5 + 72.23375)).abs() < 1e-3
        );
        assert_eq!(VGA.project(&Point3::new(0.0, 0.0, -1.0)), None);
        assert_eq!(VGA.project(&Point3::new(9.0, 0.0, 1.0)), None);
    }

    #[test]
    fn world_up_is_image_up_for_a_camera_facing_world_y() {
        // Columns of camera-to-world: image right = world +X, image down = world -Z, forward =
        // world +Y.
        let matrix = nalgebra::Matrix4::new(
            1., 0., 0., 1., 0., 0., 1., -2., 0., -1., 0., 1.5, 0., 0., 0., 1.,
        );
        let camera = Camera::new(VGA, &crate::pose::rigid(&matrix).unwrap());
        assert!((camera.world_to_camera().inverse() * Vector3::z() - Vector3::y()).norm() < 1e-5);
        let above = camera.project(&Point3::new(1.0, 1.0, 2.0)).unwrap();
        assert!(
            (above.z_m - 3.0).abs() < 1e-5 && (above.u - VGA.cx).abs() < 1e-2 && above.v < VGA.cy,
            "{above:?}"
        );
    }

    proptest! {
        #[test]
        fn can_show_rejects_only_balls_without_visible_points(
            center in prop::array::uniform3(-4.0_f32..4.0),
            radius_m in 0.01_f32..1.0,
            within in prop::array::uniform3(-1.0_f32..1.0),
        ) {
            let camera = Camera::new(VGA, &Isometry3::translation(0.3, -0.2, 0.5));
            let center = Point3::from(center);
            let within = Vector3::from(within);
            let point = center + within * (radius_m / within.norm().max(1.0));
            prop_assert!(camera.project(&point).is_none() || camera.can_show(&center, radius_m));
            // A ball well behind or beside the camera is skipped.
            prop_assert!(!camera.can_show(&Point3::new(0.3, -0.2, 0.4 - radius_m), radius_m * 0.9));
            prop_assert!(!camera.can_show(&Point3::new(5.0, -0.2, 1.5), 1.0));
        }

        #[test]
        fn projecting_an_unprojected_pixel_returns_the_pixel(u in 0.0_f32..639.0, v in 0.0_f32..479.0, z in 0.1_f32..10.0) {
            let pixel = VGA.project(&VGA.unproject(u, v, z)).unwrap();
            prop_assert!((pixel.u - u).abs() < 1e-2 && (pixel.v - v).abs() < 1e-2 && (pixel.z_m - z).abs() < 1e-5);
        }

        /// Halving the resolution halves pixel coordinates (about the pixel corner).
        #[test]
        fn scaled_intrinsics_project_along_the_same_rays(u in 0.0_f32..639.0, v in 0.0_f32..479.0) {
            let half = VGA.scaled_to(320, 240);
            let pixel = half.project(&VGA.unproject(u, v, 2.0));
            prop_assert!(pixel.is_none_or(|p| ((p.u + 0.5) * 2.0 - 0.5 - u).abs() < 1e-2 && ((p.v + 0.5) * 2.0 - 0.5 - v).abs() < 1e-2));
        }
    }
}
