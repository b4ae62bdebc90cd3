//! Close-ups of a candidate that no photograph shows, drawn from the cloud with its surroundings.

use super::camera::Distance;
use super::camera::{calibrate, default_intrinsics, eye_position, look_at};
use super::render_scene::{Cutaway, RenderScene};
use super::shot::Shot;
use image::RgbImage;
use rayon::prelude::*;
use uniground_geometry::Vector3;
use uniground_geometry::boxes::Aabb;
use uniground_geometry::scene::Camera;

const SIDE_PX: u32 = 360;
const AZIMUTHS_DEG: [f32; 3] = [-60.0, 60.0, 180.0];
const TILT_DEG: f32 = 50.0;
/// Margin of a shot's frame around the box, meters on every side.
const AROUND_M: f32 = 0.8;
const MARGIN: f32 = 0.08;

/// Draws three shots of the contents of a box.
#[must_use]
pub fn close_ups(render_scene: &RenderScene, aabb: &Aabb) -> Vec<Shot> {
    let surroundings = Aabb { size: aabb.size + Vector3::repeat(2.0 * AROUND_M), ..*aabb };
    AZIMUTHS_DEG
        .par_iter()
        .map(|&azimuth_deg| {
            let distance = Distance { alpha: 1.5, min_radius_m: 0.5, min_height_m: 0.5 };
            let pose = look_at(
                &eye_position(&aabb.center, &surroundings, azimuth_deg, TILT_DEG, distance),
                &aabb.center,
                azimuth_deg.to_radians(),
            );
            let wide = Camera::new(default_intrinsics(SIDE_PX, SIDE_PX), &pose);
            let showing = |subject: &Aabb| {
                Camera::new(calibrate(&wide, &subject.corners(), MARGIN, f32::INFINITY), &pose)
            };
            let (near, far) = (showing(aabb), showing(&surroundings));
            let seen: Vec<_> =
                aabb.corners().iter().filter_map(|corner| far.project(corner)).collect();
            let share = |at: f32| (at / SIDE_PX as f32).clamp(0.0, 1.0);
            let low = |axis: fn(&uniground_geometry::scene::Pixel) -> f32| {
                share(seen.iter().map(axis).fold(f32::INFINITY, f32::min))
            };
            let high = |axis: fn(&uniground_geometry::scene::Pixel) -> f32| {
                share(seen.iter().map(axis).fold(0.0, f32::max))
            };
            Shot {
                crop: draw_subject(render_scene, &near, aabb),
                frame: draw_subject(render_scene, &far, aabb),
                place: [low(|p| p.u), low(|p| p.v), high(|p| p.u), high(|p| p.v)],
                mask: None,
                taken: None,
            }
        })
        .collect()
}

/// Draws things that hang from the ceiling, but not the ceiling above them.
fn draw_subject(render_scene: &RenderScene, camera: &Camera, subject: &Aabb) -> RgbImage {
    super::over_background(&render_scene.draw_from_outside(camera, Cutaway::Building, &[*subject]))
}

#[cfg(test)]
mod tests {
    use super::*;
    use uniground_geometry::Point3;
    use uniground_geometry::scene::PointCloud;

    #[test]
    fn things_that_hang_from_the_ceiling_are_visible() {
        let mut cloud = PointCloud::default();
        for i in 0..100 {
            for j in 0..100 {
                cloud.positions.push(Point3::new(i as f32 * 0.03, j as f32 * 0.03, 0.0));
                cloud.colors.push([120; 3]);
            }
        }
        for i in 0..400 {
            cloud.positions.push(Point3::new(
                1.5 + (i % 20) as f32 * 0.01,
                1.5 + (i / 20) as f32 * 0.01,
                2.4,
            ));
            cloud.colors.push([250, 0, 0]);
        }
        let lamp = Aabb { center: Point3::new(1.6, 1.6, 2.35), size: Vector3::new(0.2, 0.2, 0.1) };
        let red = |shot: &Shot| shot.crop.pixels().filter(|p| p.0 == [250, 0, 0]).count();
        assert!(close_ups(&RenderScene::new(cloud), &lamp).iter().all(|shot| red(shot) > 5000));
    }

    #[test]
    fn crop_shows_the_thing_and_frame_its_place() {
        let mut cloud = PointCloud::default();
        for i in 0..60 {
            for j in 0..60 {
                cloud.positions.push(Point3::new(
                    i as f32 * 0.05 - 1.5,
                    j as f32 * 0.05 - 1.5,
                    0.0,
                ));
                cloud.colors.push([120; 3]);
                cloud.positions.push(Point3::new(
                    i as f32 * 0.01 - 0.3,
                    j as f32 * 0.01 - 0.3,
                    0.4,
                ));
                cloud.colors.push([250, 0, 0]);
            }
        }
        let aabb = Aabb { center: Point3::new(0.0, 0.0, 0.2), size: Vector3::new(0.6, 0.6, 0.4) };
        let shots = close_ups(&RenderScene::new(cloud), &aabb);
        assert_eq!(shots.len(), 3);
        for Shot { crop, frame, place, .. } in shots {
            let red = |picture: &RgbImage| picture.pixels().filter(|p| p.0 == [250, 0, 0]).count();
            assert!(
                red(&crop) > 2 * red(&frame) && red(&frame) > 500,
                "{} {}",
                red(&crop),
                red(&frame)
            );
            let [l, t, r, b] = place.map(|share| (share * SIDE_PX as f32) as u32);
            let inside =
                frame.enumerate_pixels().filter(|(_, _, p)| p.0 == [250, 0, 0]).all(|(x, y, _)| {
                    (l.saturating_sub(3)..=r + 3).contains(&x)
                        && (t.saturating_sub(3)..=b + 3).contains(&y)
                });
            assert!(inside && r < SIDE_PX && place.iter().all(|v| *v > 0.0));
        }
    }
}
