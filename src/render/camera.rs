//! Cameras that orbit a scene (paper: camera orbit of the spatial relationship prompt).

use crate::geometry::boxes::Aabb;
use crate::geometry::{Isometry3, Matrix3, Point3, Vector3};
use crate::scene::{Camera, Intrinsics};
use nalgebra::{Rotation3, Translation3, UnitQuaternion};

/// Where to look from: around the scene's centre at an azimuth, tilted off the vertical.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Orbit {
    pub width: u32,
    pub height: u32,
    /// Direction the camera stands in, degrees about +Z from +X.
    pub azimuth_deg: f32,
    /// Angle off the vertical; 0 looks straight down.
    pub tilt_deg: f32,
}

/// Share of the picture left empty around the scene.
const MARGIN: f32 = 0.06;
/// Vertical field of view, degrees.
const FIELD_OF_VIEW_DEG: f32 = 45.0;

impl Orbit {
    /// The camera that shows the whole extent. OpenCV axes, world frame Z up.
    #[must_use]
    pub fn camera(&self, extent: &Aabb) -> Camera {
        let (tilt, azimuth) = (self.tilt_deg.to_radians(), self.azimuth_deg.to_radians());
        let direction = Vector3::new(tilt.sin() * azimuth.cos(), tilt.sin() * azimuth.sin(), tilt.cos());
        let target = extent.center;
        let focal = self.height as f32 / 2.0 / (FIELD_OF_VIEW_DEG.to_radians() / 2.0).tan();
        let eye = target + direction * (extent.size.norm().max(0.1) * 1.5);
        let wide = Intrinsics {
            width: self.width,
            height: self.height,
            fx: focal,
            fy: focal,
            cx: (self.width as f32 - 1.0) / 2.0,
            cy: (self.height as f32 - 1.0) / 2.0,
        };
        let pose = look_at(&eye, &target, azimuth);
        let camera = Camera::new(wide, &pose);
        Camera::new(calibrated(&camera, &extent.corners()), &pose)
    }
}

/// Camera-to-world pose at `eye` looking at `target`, OpenCV axes: `z = (c - e) / |c - e|`, `x = z x up` normalised, `y = z x x`.
///
/// Straight down, image-up is the direction away from the azimuth, so nothing is undefined.
fn look_at(eye: &Point3<f32>, target: &Point3<f32>, azimuth_rad: f32) -> Isometry3<f32> {
    let forward = (target - eye).normalize();
    let fallback = Vector3::new(azimuth_rad.sin(), -azimuth_rad.cos(), 0.0);
    let right = forward.cross(&Vector3::z()).try_normalize(1e-4).unwrap_or(-fallback);
    let down = forward.cross(&right);
    let rotation = Rotation3::from_matrix_unchecked(Matrix3::from_columns(&[right, down, forward]));
    Isometry3::from_parts(Translation3::from(eye.coords), UnitQuaternion::from_rotation_matrix(&rotation))
}

/// Zooms and shifts the intrinsics so that all points fill the picture up to the margin; the pose stays.
fn calibrated(camera: &Camera, points: &[Point3<f32>]) -> Intrinsics {
    let wide = camera.intrinsics;
    let (mut low, mut high) = ([f32::INFINITY; 2], [f32::NEG_INFINITY; 2]);
    for point in points {
        let p = camera.world_to_camera() * point;
        for (axis, at) in [p.x / p.z, p.y / p.z].into_iter().enumerate() {
            low[axis] = low[axis].min(at);
            high[axis] = high[axis].max(at);
        }
    }
    let room = 1.0 - 2.0 * MARGIN;
    // A scene of one point has no width: some picture of it is better than none.
    let spread = |axis: usize| (high[axis] - low[axis]).max(1e-3);
    let focal = (wide.width as f32 * room / spread(0)).min(wide.height as f32 * room / spread(1));
    let shift = |size: u32, axis: usize| (size as f32 - 1.0) / 2.0 - focal * f32::midpoint(low[axis], high[axis]);
    Intrinsics { fx: focal, fy: focal, cx: shift(wide.width, 0), cy: shift(wide.height, 1), ..wide }
}

#[cfg(test)]
mod tests {
    use super::*;

    const ROOM: Aabb = Aabb { center: Point3::new(1.0, -2.0, 1.2), size: Vector3::new(6.0, 4.0, 2.4) };

    #[test]
    fn every_corner_is_in_the_picture_from_everywhere() {
        for azimuth_deg in [0.0, 120.0, 240.0, -90.0] {
            for tilt_deg in [0.0, 15.0, 60.0] {
                let camera = Orbit { width: 680, height: 480, azimuth_deg, tilt_deg }.camera(&ROOM);
                for corner in ROOM.corners() {
                    assert!(camera.project(&corner).is_some(), "azimuth {azimuth_deg} tilt {tilt_deg} loses {corner}");
                }
            }
        }
    }

    #[test]
    fn from_the_south_east_is_right_and_up_is_up() {
        let camera = Orbit { width: 400, height: 400, azimuth_deg: -90.0, tilt_deg: 45.0 }.camera(&ROOM);
        let at = |p: Point3<f32>| camera.project(&p).unwrap();
        let center = at(ROOM.center);
        assert!(at(ROOM.center + Vector3::x()).u > center.u);
        assert!(at(ROOM.center + Vector3::z() * 0.5).v < center.v);
        assert!(at(ROOM.center + Vector3::y()).v < center.v, "further away is higher in the picture");
    }

    #[test]
    fn straight_down_keeps_the_same_sides() {
        let from = |tilt_deg| Orbit { width: 400, height: 400, azimuth_deg: -90.0, tilt_deg }.camera(&ROOM);
        let (down, tilted) = (from(0.0), from(20.0));
        for camera in [down, tilted] {
            let at = |p: Point3<f32>| camera.project(&p).unwrap();
            assert!(at(ROOM.center + Vector3::x()).u > at(ROOM.center).u + 1.0);
            assert!(at(ROOM.center + Vector3::y()).v < at(ROOM.center).v - 1.0);
        }
    }
}
