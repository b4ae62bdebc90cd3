//! The global render: the scene around the candidates from several sides, stitched (paper: spatial
//! relationship prompt).

use super::camera::{Distance, calibrate, default_intrinsics, eye_position, look_at};
use super::directions::{self, DirectionWord};
use super::insets;
use super::overlay::{self, LabeledBox, projected_bounds};
use super::render_scene::{Cutaway, RenderScene, Splats};
use super::text;
use image::{Rgb, RgbImage, imageops};
use rayon::prelude::*;
use tiny_skia::Rect;
use uniground_geometry::Point3;
use uniground_geometry::boxes::{Aabb, OrientedBox};
use uniground_geometry::scene::Camera;

/// Settings for a picture of several candidates.
#[derive(Debug, Clone, PartialEq)]
pub struct GlobalView {
    /// Side of each square view. Paper: 680.
    pub view_px: u32,
    /// Azimuths of the cameras, degrees about +Z from +X. Paper: 0, 120, 240.
    pub azimuths_deg: Vec<f32>,
    /// Number of views in a row. Paper: 3, which gives a strip. Models scale wide pictures down.
    pub columns: u32,
    /// Angle off the vertical, degrees. Paper: 15.
    pub tilt_deg: f32,
    /// Paper: alpha, distance over the longest side of the scene.
    pub distance: f32,
    /// Paper: `r_min`, meters; the paper gives no value.
    pub min_radius_m: f32,
    /// Paper: `h_min`, meters; the paper gives no value.
    pub min_height_m: f32,
    /// Share of a view left empty around the candidates, per side.
    pub margin: f32,
    /// Maximum zoom relative to the uncalibrated camera, so that candidates close together keep
    /// their surroundings in view.
    pub max_zoom: f32,
    /// How much darker surfaces get that face away, `0..=1`; 0 leaves their colors unchanged.
    pub shading: f32,
    /// Minimum length of a box's longer side in a view, pixels. A view zooms in further for a
    /// smaller box. A box that stays smaller, because the others are far away, is shown again in an
    /// inset. 0 disables both, as in the paper.
    pub min_subject_px: f32,
    /// What is left out so that the picture shows the room from outside.
    pub cutaway: Cutaway,
}

impl Default for GlobalView {
    fn default() -> Self {
        Self {
            view_px: 680,
            azimuths_deg: vec![0.0, 120.0, 240.0],
            columns: 3,
            tilt_deg: 15.0,
            distance: 1.5,
            min_radius_m: 0.5,
            min_height_m: 2.0,
            margin: 0.15,
            max_zoom: 3.5,
            shading: 0.45,
            min_subject_px: 40.0,
            cutaway: Cutaway::Building,
        }
    }
}

/// The subjects of a global render.
#[derive(Debug, Clone, PartialEq)]
pub struct Subjects {
    /// Candidates and anchors; later ones are drawn on top.
    pub boxes: Vec<LabeledBox>,
    /// Direction words drawn at the border of each view.
    pub words: Vec<DirectionWord>,
    /// The point that cameras look at, world frame. Paper: the mean candidate center (Eq. 3);
    /// anchors do not move it.
    pub target: Point3<f32>,
}

/// A box smaller than this before calibration is a point and does not cause further zoom, pixels.
const LEAST_PX: f32 = 0.5;
/// Size of a view's title, and its position, pixels.
const TITLE_PX: f32 = 16.0;
const TITLE_AT: (f32, f32) = (6.0, 4.0);

impl GlobalView {
    /// Returns four views in two rows, each of `view_px`.
    #[must_use]
    pub fn square(view_px: u32) -> Self {
        let azimuths_deg = vec![0.0, 90.0, 180.0, 270.0];
        Self { view_px, azimuths_deg, columns: 2, ..Self::default() }
    }

    /// Returns the camera of one view. The corners of candidates and of anchors are in the picture.
    #[must_use]
    pub fn camera(&self, extent: &Aabb, subjects: &Subjects, azimuth_deg: f32) -> Camera {
        let distance = Distance {
            alpha: self.distance,
            min_radius_m: self.min_radius_m,
            min_height_m: self.min_height_m,
        };
        let eye = eye_position(&subjects.target, extent, azimuth_deg, self.tilt_deg, distance);
        let pose = look_at(&eye, &subjects.target, azimuth_deg.to_radians());
        let wide = Camera::new(default_intrinsics(self.view_px, self.view_px), &pose);
        let corners: Vec<Point3<f32>> =
            subjects.boxes.iter().flat_map(|b| b.drawn.corners()).collect();
        let smallest = subjects
            .boxes
            .iter()
            .filter_map(|b| longer_side(&wide, &b.drawn))
            .fold(f32::INFINITY, f32::min);
        let max_zoom = self.max_zoom.max(self.min_subject_px / smallest.max(LEAST_PX));
        Camera::new(calibrate(&wide, &corners, self.margin, max_zoom), &pose)
    }

    /// Draws all views, row by row.
    #[must_use]
    pub fn draw(&self, render_scene: &RenderScene, extent: &Aabb, subjects: &Subjects) -> RgbImage {
        const GAP_PX: u32 = 4;
        let views: Vec<RgbImage> = self
            .azimuths_deg
            .par_iter()
            .enumerate()
            .map(|(i, &azimuth_deg)| {
                let camera = self.camera(extent, subjects, azimuth_deg);
                let title = format!("view {}", i + 1);
                let mut view =
                    self.draw_view(render_scene, &camera, subjects, text::width(&title, TITLE_PX));
                text::draw(&mut view, &title, TITLE_AT.0, TITLE_AT.1, TITLE_PX, Rgb([90; 3]));
                view
            })
            .collect();
        let columns = self.columns.clamp(1, (views.len() as u32).max(1));
        let rows = (views.len() as u32).div_ceil(columns);
        let length = |count: u32| count * self.view_px + count.saturating_sub(1) * GAP_PX;
        let mut stitched = RgbImage::from_pixel(length(columns), length(rows), Rgb([60; 3]));
        for (i, view) in (0..).zip(&views) {
            let at = |count: u32| i64::from(count * (self.view_px + GAP_PX));
            imageops::replace(&mut stitched, view, at(i % columns), at(i / columns));
        }
        stitched
    }

    fn draw_view(
        &self,
        render_scene: &RenderScene,
        camera: &Camera,
        subjects: &Subjects,
        title_px: f32,
    ) -> RgbImage {
        let drawn = self.draw_from_outside(render_scene, camera, subjects);
        let mut view = super::over_background(&drawn);
        let mut taken = directions::draw(&mut view, camera, &subjects.target, &subjects.words);
        taken.extend(Rect::from_xywh(TITLE_AT.0, TITLE_AT.1, title_px, TITLE_PX));
        let insets = insets::place_insets(camera, &subjects.boxes, self.min_subject_px, &taken);
        taken.extend(insets.iter().map(|inset| inset.rect));
        overlay::draw(&mut view, &drawn, camera, &subjects.boxes, taken);
        for inset in insets {
            let boxes: Vec<LabeledBox> =
                inset.boxes.iter().map(|&i| subjects.boxes[i].clone()).collect();
            let drawn = self.draw_from_outside(render_scene, &inset.camera, subjects);
            let mut close = super::over_background(&drawn);
            overlay::draw(&mut close, &drawn, &inset.camera, &boxes, Vec::new());
            inset.draw_onto(&mut view, &close);
        }
        view
    }

    fn draw_from_outside(
        &self,
        render_scene: &RenderScene,
        camera: &Camera,
        subjects: &Subjects,
    ) -> Splats {
        let boxes: Vec<Aabb> = subjects.boxes.iter().map(|b| b.aabb).collect();
        let mut drawn = render_scene.draw_from_outside(camera, self.cutaway, &boxes);
        if self.shading > 0.0 {
            drawn.shade(camera, self.shading);
        }
        drawn
    }
}

/// Returns the longer side of a box in the picture, pixels; `None` behind the camera.
pub(super) fn longer_side(camera: &Camera, of: &OrientedBox) -> Option<f32> {
    projected_bounds(camera, of).map(|rect| rect.width().max(rect.height()))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::BoxStyle;
    use uniground_geometry::Vector3;
    use uniground_geometry::scene::PointCloud;

    const ROOM: Aabb =
        Aabb { center: Point3::new(0.0, 0.0, 1.2), size: Vector3::new(6.0, 5.0, 2.4) };

    fn subjects() -> Subjects {
        let size = Vector3::new(0.6, 0.5, 0.8);
        let at = |x: f32, y: f32, style| {
            LabeledBox::axis_aligned(Aabb { center: Point3::new(x, y, 0.4), size }, "7", style)
        };
        let word =
            |word: &str, direction: Vector3<f32>| DirectionWord { word: word.into(), direction };
        Subjects {
            boxes: vec![
                at(1.0, 0.5, BoxStyle::Candidate),
                at(-1.0, 0.0, BoxStyle::Candidate),
                at(-2.0, 2.0, BoxStyle::Anchor),
            ],
            words: vec![
                word("left (+X)", Vector3::x()),
                word("right (-X)", -Vector3::x()),
                word("front (-Y)", -Vector3::y()),
                word("back (+Y)", Vector3::y()),
            ],
            target: Point3::new(0.0, 0.25, 0.4),
        }
    }

    #[test]
    fn all_boxes_are_in_the_view_at_every_azimuth() {
        let (view, subjects) = (GlobalView::default(), subjects());
        for azimuth in [0.0, 45.0, 120.0, 240.0] {
            let camera = view.camera(&ROOM, &subjects, azimuth);
            let inside = |p: &Point3<f32>| {
                let pixel = camera.project(p).unwrap();
                (90.0..590.0).contains(&pixel.u) && (90.0..590.0).contains(&pixel.v)
            };
            assert!(subjects.boxes.iter().flat_map(|b| b.drawn.corners()).all(|c| inside(&c)));
        }
    }

    /// Picture and words agree: in every view, a colored patch lies on the side of its word. The
    /// positions of the words are also computed by hand: from azimuth a the picture's right is
    /// (-sin a, cos a), its upper border (-cos a, -sin a).
    #[test]
    fn direction_words_are_on_the_side_of_their_direction() {
        let mut cloud = PointCloud::default();
        for (direction, color) in [
            (Vector3::x(), [255, 0, 0]),
            (-Vector3::x(), [0, 255, 0]),
            (Vector3::y(), [0, 0, 255]),
            (-Vector3::y(), [255, 255, 0]),
        ] {
            for i in 0..40 {
                for j in 0..40 {
                    let across = Vector3::new(i as f32 * 0.01 - 0.2, j as f32 * 0.01 - 0.2, 0.0);
                    cloud.positions.push(Point3::from(direction * 0.9 + across));
                    cloud.colors.push(color);
                }
            }
        }
        let color_of = |word: &str| match word.split(' ').next() {
            Some("left") => [255, 0, 0],
            Some("right") => [0, 255, 0],
            Some("back") => [0, 0, 255],
            _ => [255, 255, 0],
        };
        let render_scene = RenderScene::new(cloud);
        let mut subjects = subjects();
        subjects
            .boxes
            .iter_mut()
            .for_each(|b| b.drawn.center = Point3::from(b.drawn.center.coords * 0.5));
        subjects.target = Point3::origin();
        let view = GlobalView { shading: 0.0, ..GlobalView::default() };
        for azimuth_deg in [0.0_f32, 30.0, 120.0, 200.0, 240.0] {
            let camera = view.camera(&ROOM, &subjects, azimuth_deg);
            let drawn =
                render_scene.draw_from_outside(&camera, Cutaway::HighestPoints, &[]).picture;
            let azimuth = azimuth_deg.to_radians();
            let origin = camera.project(&subjects.target).unwrap();
            let marks = directions::place_words(&camera, &subjects.target, &subjects.words);
            assert_eq!(marks.len(), 4);
            for (mark, word) in marks.iter().zip(&subjects.words) {
                let d = word.direction;
                let by_hand = nalgebra::Vector2::new(
                    -d.x * azimuth.sin() + d.y * azimuth.cos(),
                    d.x * azimuth.cos() + d.y * azimuth.sin(),
                );
                assert!(
                    mark.towards.dot(&by_hand.normalize()) > 0.99,
                    "{azimuth_deg} {}: {:?} {by_hand:?}",
                    mark.word,
                    mark.towards
                );
                let of_color = drawn
                    .enumerate_pixels()
                    .filter(|(_, _, p)| p.0 == [color_of(&mark.word), [255; 3]].concat()[..4]);
                let places: Vec<_> = of_color
                    .map(|(x, y, _)| {
                        nalgebra::Vector2::new(x as f32 - origin.u, y as f32 - origin.v)
                    })
                    .collect();
                let middle = places.iter().sum::<nalgebra::Vector2<f32>>() / places.len() as f32;
                let word_at = nalgebra::Vector2::new(
                    f32::midpoint(mark.rect.left(), mark.rect.right()) - 340.0,
                    f32::midpoint(mark.rect.top(), mark.rect.bottom()) - 340.0,
                );
                assert!(
                    places.len() > 100 && middle.normalize().dot(&word_at.normalize()) > 0.9,
                    "{azimuth_deg} {}",
                    mark.word
                );
            }
        }
    }

    #[test]
    fn global_render_is_deterministic() {
        let mut cloud = PointCloud::default();
        cloud.positions.extend(
            (0..500).map(|i| Point3::new((i % 25) as f32 * 0.1, (i / 25) as f32 * 0.1, 0.0)),
        );
        cloud.colors.extend([[120, 90, 60]; 500]);
        let render_scene = RenderScene::new(cloud);
        let picture = GlobalView::default().draw(&render_scene, &ROOM, &subjects());
        assert_eq!(picture.dimensions(), (3 * 680 + 8, 680));
        assert_eq!(picture, GlobalView::default().draw(&render_scene, &ROOM, &subjects()));
    }
}
