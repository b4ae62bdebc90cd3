//! Cameras that look at a scene from outside (paper: camera orbit of the spatial relationship
//! prompt, visibility-aware calibration).

use nalgebra::{Rotation3, Translation3, UnitQuaternion};
use uniground_geometry::boxes::Aabb;
use uniground_geometry::scene::{Camera, Intrinsics};
use uniground_geometry::{Isometry3, Matrix3, Point3, Vector3};

/// A viewpoint: around the scene's center at an azimuth, tilted off the vertical.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Orbit {
    /// Width of the picture, pixels.
    pub width: u32,
    /// Height of the picture, pixels.
    pub height: u32,
    /// Azimuth of the camera, degrees about +Z from +X.
    pub azimuth_deg: f32,
    /// Angle off the vertical; 0 looks straight down.
    pub tilt_deg: f32,
}

/// Share of the picture left empty around the scene.
const MARGIN: f32 = 0.06;
/// Vertical field of view before calibration, degrees.
const FIELD_OF_VIEW_DEG: f32 = 45.0;

impl Orbit {
    /// Returns the camera that shows the whole extent. OpenCV axes, world frame Z up.
    #[must_use]
    pub fn camera(&self, extent: &Aabb) -> Camera {
        let eye = extent.center
            + view_direction(self.azimuth_deg, self.tilt_deg) * (extent.size.norm().max(0.1) * 1.5);
        let pose = look_at(&eye, &extent.center, self.azimuth_deg.to_radians());
        let camera = Camera::new(default_intrinsics(self.width, self.height), &pose);
        Camera::new(calibrate(&camera, &extent.corners(), MARGIN, f32::INFINITY), &pose)
    }
}

/// The distance of a camera that orbits candidates from its target.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Distance {
    /// Paper: alpha, times the longest side of the scene.
    pub alpha: f32,
    /// Paper: `r >= r_min`, meters in the horizontal.
    pub min_radius_m: f32,
    /// Paper: `h >= h_min`, meters above the target.
    pub min_height_m: f32,
}

/// Returns the camera position `e = c + D d` with `d = R_azim R_tilt (0, 0, 1)` and `D = alpha
/// max(extent)` (paper). Radius and height are `D sin` and `D cos` of the tilt, each at least its
/// bound.
pub(super) fn eye_position(
    target: &Point3<f32>,
    extent: &Aabb,
    azimuth_deg: f32,
    tilt_deg: f32,
    distance: Distance,
) -> Point3<f32> {
    let offset = view_direction(azimuth_deg, tilt_deg) * (distance.alpha * extent.size.max());
    let radius = offset.xy().norm().max(distance.min_radius_m);
    let azimuth = azimuth_deg.to_radians();
    target
        + Vector3::new(
            azimuth.cos() * radius,
            azimuth.sin() * radius,
            offset.z.max(distance.min_height_m),
        )
}

/// Returns `R_azim R_tilt (0, 0, 1)`: straight up, tilted toward +X, then rotated about +Z.
fn view_direction(azimuth_deg: f32, tilt_deg: f32) -> Vector3<f32> {
    let (tilt, azimuth) = (tilt_deg.to_radians(), azimuth_deg.to_radians());
    Vector3::new(tilt.sin() * azimuth.cos(), tilt.sin() * azimuth.sin(), tilt.cos())
}

pub(super) fn default_intrinsics(width: u32, height: u32) -> Intrinsics {
    let focal = height as f32 / 2.0 / (FIELD_OF_VIEW_DEG.to_radians() / 2.0).tan();
    Intrinsics {
        width,
        height,
        fx: focal,
        fy: focal,
        cx: (width as f32 - 1.0) / 2.0,
        cy: (height as f32 - 1.0) / 2.0,
    }
}

/// Returns the camera-to-world pose at `eye` looking at `target`, OpenCV axes: `z = (c - e) / |c -
/// e|`, `x = z x up` normalized, `y = z x x`. The paper's rows are those of a library with x to the
/// left and y up: its `x = up x z` is `-x` here, which gives the same picture.
///
/// Straight down, image-up is the direction away from the azimuth, so nothing is undefined.
pub(super) fn look_at(eye: &Point3<f32>, target: &Point3<f32>, azimuth_rad: f32) -> Isometry3<f32> {
    let forward = (target - eye).try_normalize(1e-9).unwrap_or_else(|| -Vector3::z());
    let fallback = Vector3::new(azimuth_rad.sin(), -azimuth_rad.cos(), 0.0);
    let right = forward.cross(&Vector3::z()).try_normalize(1e-4).unwrap_or(-fallback);
    let down = forward.cross(&right);
    let rotation = Rotation3::from_matrix_unchecked(Matrix3::from_columns(&[right, down, forward]));
    Isometry3::from_parts(
        Translation3::from(eye.coords),
        UnitQuaternion::from_rotation_matrix(&rotation),
    )
}

/// Zooms and shifts the intrinsics so that all points fill the picture up to `margin` on every side
/// (paper: `s = 2 / max(p_max - p_min)`, `f' = s f`, `c' = s c - s m`, Eq. 10 and 11); no zoom is
/// larger than `max_zoom`. The pose stays.
pub(super) fn calibrate(
    camera: &Camera,
    points: &[Point3<f32>],
    margin: f32,
    max_zoom: f32,
) -> Intrinsics {
    /// Nothing nearer to the camera than this is shown, meters.
    const NEAR_M: f32 = 0.05;
    let wide = camera.intrinsics;
    let (mut low, mut high) = ([f32::INFINITY; 2], [f32::NEG_INFINITY; 2]);
    for p in points.iter().map(|point| camera.world_to_camera() * point).filter(|p| p.z > NEAR_M) {
        for (axis, at) in [p.x / p.z, p.y / p.z].into_iter().enumerate() {
            low[axis] = low[axis].min(at);
            high[axis] = high[axis].max(at);
        }
    }
    if low[0] > high[0] {
        return wide;
    }
    let room = 1.0 - 2.0 * margin;
    // A scene of one point has no width but still gets a picture.
    let spread = |axis: usize| (high[axis] - low[axis]).max(1e-3);
    let focal = (wide.width as f32 * room / spread(0))
        .min(wide.height as f32 * room / spread(1))
        .min(wide.fx * max_zoom);
    let shift = |size: u32, axis: usize| {
        (size as f32 - 1.0) / 2.0 - focal * f32::midpoint(low[axis], high[axis])
    };
    Intrinsics { fx: focal, fy: focal, cx: shift(wide.width, 0), cy: shift(wide.height, 1), ..wide }
}

#[cfg(test)]
mod tests {
    use super::*;

    const ROOM: Aabb =
        Aabb { center: Point3::new(1.0, -2.0, 1.2), size: Vector3::new(6.0, 4.0, 2.4) };

    #[test]
    fn every_corner_of_the_scene_is_in_the_picture() {
        for azimuth_deg in [0.0, 120.0, 240.0, -90.0] {
            for tilt_deg in [0.0, 15.0, 60.0] {
                let camera = Orbit { width: 680, height: 480, azimuth_deg, tilt_deg }.camera(&ROOM);
                for corner in ROOM.corners() {
                    assert!(
                        camera.project(&corner).is_some(),
                        "azimuth {azimuth_deg} tilt {tilt_deg} loses {corner}"
                    );
                }
            }
        }
    }

    #[test]
    fn view_from_the_south_has_east_right_and_up_at_the_top() {
        let camera =
            Orbit { width: 400, height: 400, azimuth_deg: -90.0, tilt_deg: 45.0 }.camera(&ROOM);
        let at = |p: Point3<f32>| camera.project(&p).unwrap();
        let center = at(ROOM.center);
        assert!(at(ROOM.center + Vector3::x()).u > center.u);
        assert!(at(ROOM.center + Vector3::z() * 0.5).v < center.v);
        assert!(
            at(ROOM.center + Vector3::y()).v < center.v,
            "farther points are higher in the picture"
        );
    }

    #[test]
    fn straight_down_view_keeps_the_orientation() {
        let from = |tilt_deg| {
            Orbit { width: 400, height: 400, azimuth_deg: -90.0, tilt_deg }.camera(&ROOM)
        };
        let (down, tilted) = (from(0.0), from(20.0));
        for camera in [down, tilted] {
            let at = |p: Point3<f32>| camera.project(&p).unwrap();
            assert!(at(ROOM.center + Vector3::x()).u > at(ROOM.center).u + 1.0);
            assert!(at(ROOM.center + Vector3::y()).v < at(ROOM.center).v - 1.0);
        }
    }

    /// Computed by hand: a scene 6 m long at alpha 1.5 is seen from 9 m. At 15 degrees that is
    /// 2.3294 m out and 8.6933 m up.
    #[test]
    fn eye_position_follows_the_paper_with_minimum_distances() {
        let far = Distance { alpha: 1.5, min_radius_m: 0.5, min_height_m: 1.0 };
        let target = Point3::new(1.0, 2.0, 0.5);
        let at = |azimuth_deg, distance| {
            eye_position(&target, &ROOM, azimuth_deg, 15.0, distance) - target
        };
        assert!((at(0.0, far) - Vector3::new(2.3294, 0.0, 8.6933)).norm() < 1e-3);
        assert!((at(120.0, far) - Vector3::new(-1.1647, 2.0173, 8.6933)).norm() < 1e-3);
        let near = Distance { alpha: 0.01, min_radius_m: 0.5, min_height_m: 1.0 };
        assert!((at(240.0, near) - Vector3::new(-0.25, -0.4330, 1.0)).norm() < 1e-3);
    }

    /// By hand: 4 m straight above, a square of 2 m spans tangents of +-.25. A picture of 100 px
    /// with a margin of 10 % shows it on 80 px: f = 160. Its middle, .5 m off the axis, moves to
    /// the picture's middle.
    #[test]
    fn calibration_fills_the_picture_within_the_zoom_limit() {
        let pose =
            look_at(&Point3::new(0.0, 0.0, 4.0), &Point3::origin(), -std::f32::consts::FRAC_PI_2);
        let camera = Camera::new(default_intrinsics(100, 100), &pose);
        let square = |x: f32| {
            [(-1.0, -1.0), (1.0, -1.0), (1.0, 1.0), (-1.0, 1.0)]
                .map(|(dx, dy)| Point3::new(x + dx, dy, 0.0))
        };
        let fitted = calibrate(&camera, &square(0.5), 0.1, 10.0);
        assert!((fitted.fx - 160.0).abs() < 1e-2, "{fitted:?}");
        let shown = Camera::new(fitted, &pose);
        let at = |x: f32, y: f32| shown.project(&Point3::new(x, y, 0.0)).unwrap();
        assert!(
            (at(0.5, 0.0).u - 49.5).abs() < 1e-2
                && (at(-0.5, 0.0).u - 9.5).abs() < 1e-2
                && (at(0.5, 1.0).v - 9.5).abs() < 1e-2
        );
        // The zoom is limited: the uncalibrated focal length is 120.7.
        let capped =
            calibrate(&camera, &square(0.5).map(|p| Point3::from(p.coords * 0.01)), 0.1, 2.0);
        assert!((capped.fx - 241.42).abs() < 0.1, "{capped:?}");
        // Without anything to show, the camera does not change.
        assert_eq!(calibrate(&camera, &[Point3::new(0.0, 0.0, 9.0)], 0.1, 2.0), camera.intrinsics);
    }

    /// The world-to-camera rows by the paper's own formulas, in its axes (x left, y up).
    #[test]
    fn look_at_equals_the_paper_matrix_in_other_axes() {
        for (eye, target) in
            [([3.0, 1.0, 4.0], [0.5, -0.5, 0.7]), ([0.0, -2.0, 1.0], [0.0, 2.0, 1.5])]
        {
            let (e, c) = (Point3::from(eye), Point3::from(target));
            let z = (c - e).normalize();
            let x = Vector3::z().cross(&z).normalize();
            let y = z.cross(&x);
            let pose = look_at(&e, &c, 0.0);
            for p in [Point3::new(0.3, 0.2, 0.1), Point3::new(-1.0, 2.0, 0.0)] {
                let ours = pose.inverse() * p;
                let theirs = Vector3::new(x.dot(&(p - e)), y.dot(&(p - e)), z.dot(&(p - e)));
                assert!((ours.coords - Vector3::new(-theirs.x, -theirs.y, theirs.z)).norm() < 1e-4);
            }
        }
        let above = look_at(&Point3::new(1.0, 1.0, 5.0), &Point3::new(1.0, 1.0, 0.0), 0.0);
        assert!(above.to_matrix().iter().all(|v| v.is_finite()));
        assert!(
            look_at(&Point3::origin(), &Point3::origin(), 0.0)
                .to_matrix()
                .iter()
                .all(|v| v.is_finite())
        );
    }
}
