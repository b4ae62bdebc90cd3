//! Insets: close-up pictures in the corners of a view, for candidates that are too small in it.

use super::camera::calibrate;
use super::candidates::longer_side;
use super::overlay::{LabeledBox, overlap, projected_bounds};
use image::{Rgb, RgbImage, imageops};
use tiny_skia::Rect;
use uniground_geometry::scene::{Camera, Intrinsics};
use uniground_geometry::{Isometry3, Point3};

/// Side lengths that are tried, as shares of the view's side.
const SIDE_SHARES: [f32; 2] = [0.22, 0.18];
/// Share of an inset left empty around its candidate, per side.
const MARGIN: f32 = 0.27;
/// The same for an inset of several candidates.
const GROUP_MARGIN: f32 = 0.1;
/// Distance to the border of the view, and between the positions that are tried, pixels.
const GAP_PX: f32 = 6.0;
const RIM_PX: u32 = 2;
const RIM: Rgb<u8> = Rgb([60; 3]);
/// Maximum number of insets: more would hide the view.
const MOST: usize = 3;

/// A close-up and its position.
pub(super) struct Inset {
    /// Position in the view, pixels.
    pub rect: Rect,
    /// The view's camera, zoomed in.
    pub camera: Camera,
    /// Indices of the boxes it shows.
    pub boxes: Vec<usize>,
}

/// Creates insets for boxes whose longer side is below `min_px`, where there is free space: not
/// over `taken`, and not over a box. Boxes near each other share an inset.
pub(super) fn place_insets(
    camera: &Camera,
    boxes: &[LabeledBox],
    min_px: f32,
    taken: &[Rect],
) -> Vec<Inset> {
    let size =
        |camera: &Camera, i: usize| longer_side(camera, &boxes[i].drawn).unwrap_or(f32::INFINITY);
    let mut small: Vec<usize> = (0..boxes.len()).filter(|&i| size(camera, i) < min_px).collect();
    // The most important ones are last in the list and must come first here.
    small.reverse();
    let mut taken: Vec<Rect> = taken
        .iter()
        .copied()
        .chain(boxes.iter().filter_map(|b| projected_bounds(camera, &b.drawn)))
        .collect();
    let mut insets = Vec::new();
    while !small.is_empty() && insets.len() < MOST {
        let found = SIDE_SHARES.iter().find_map(|share| {
            let side = (camera.intrinsics.width as f32 * share).round();
            Some((side, free_square(camera.intrinsics, side, &taken)?))
        });
        let Some((side, rect)) = found else { break };
        let mut group = vec![small[0]];
        for &other in &small[1..] {
            let with: Vec<usize> = group.iter().copied().chain([other]).collect();
            let close = zoom_camera(camera, boxes, &with, side as u32);
            if with.iter().all(|&i| size(&close, i) >= min_px) {
                group = with;
            }
        }
        small.retain(|i| !group.contains(i));
        // As in the view, later ones are on top.
        group.sort_unstable();
        taken.push(rect);
        insets.push(Inset {
            rect,
            camera: zoom_camera(camera, boxes, &group, side as u32),
            boxes: group,
        });
    }
    insets
}

/// Returns the view's camera, zoomed in on some boxes.
fn zoom_camera(camera: &Camera, boxes: &[LabeledBox], which: &[usize], side: u32) -> Camera {
    let pose: Isometry3<f32> = camera.world_to_camera().inverse();
    let corners: Vec<Point3<f32>> = which.iter().flat_map(|&i| boxes[i].drawn.corners()).collect();
    let square = Camera::new(Intrinsics { width: side, height: side, ..camera.intrinsics }, &pose);
    Camera::new(
        calibrate(
            &square,
            &corners,
            if which.len() > 1 { GROUP_MARGIN } else { MARGIN },
            f32::INFINITY,
        ),
        &pose,
    )
}

/// Returns a free square in a corner or at the middle of a side. The right side comes first,
/// because titles and axes are on the left.
fn free_square(of: Intrinsics, side: f32, taken: &[Rect]) -> Option<Rect> {
    let (right, bottom) = (of.width as f32 - side - GAP_PX, of.height as f32 - side - GAP_PX);
    let (middle_x, middle_y) = ((of.width as f32 - side) / 2.0, (of.height as f32 - side) / 2.0);
    let places = [
        (right, bottom),
        (right, GAP_PX),
        (GAP_PX, GAP_PX),
        (GAP_PX, bottom),
        (right, middle_y),
        (GAP_PX, middle_y),
        (middle_x, bottom),
        (middle_x, GAP_PX),
    ];
    let mut squares =
        places.into_iter().filter_map(|(x, y)| Rect::from_xywh(x.round(), y.round(), side, side));
    squares.find(|square| taken.iter().all(|other| !overlap(square, other)))
}

impl Inset {
    /// Draws the close-up at its position, with a border.
    pub fn draw_onto(&self, view: &mut RgbImage, close: &RgbImage) {
        let (x, y) = (self.rect.left() as i64, self.rect.top() as i64);
        let rim =
            RgbImage::from_pixel(close.width() + 2 * RIM_PX, close.height() + 2 * RIM_PX, RIM);
        imageops::replace(view, &rim, x - i64::from(RIM_PX), y - i64::from(RIM_PX));
        imageops::replace(view, close, x, y);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{BoxStyle, GlobalView, Subjects};
    use uniground_geometry::Vector3;
    use uniground_geometry::boxes::Aabb;

    const MIN_PX: f32 = 40.0;

    fn subjects(at: &[[f32; 2]], side: f32) -> Subjects {
        let small = |(i, at): (usize, &[f32; 2])| {
            let center = Point3::new(at[0], at[1], 0.8);
            let aabb = Aabb { center, size: Vector3::repeat(side) };
            LabeledBox::axis_aligned(aabb, i.to_string(), BoxStyle::Candidate)
        };
        let boxes: Vec<LabeledBox> = at.iter().enumerate().map(small).collect();
        let target = Point3::from(
            boxes.iter().map(|b| b.aabb.center.coords).sum::<Vector3<f32>>() / boxes.len() as f32,
        );
        Subjects { boxes, words: Vec::new(), target }
    }

    /// A hall, where a view of the whole leaves only a few pixels for a mug.
    #[test]
    fn every_candidate_is_large_enough_in_the_view_or_in_an_inset() {
        let hall = Aabb { center: Point3::new(0.0, 0.0, 2.0), size: Vector3::new(40.0, 25.0, 4.0) };
        let near = subjects(&[[1.0, 1.0]], 0.1);
        let apart = subjects(&[[-9.0, 2.0], [8.0, -3.0], [8.1, -3.0]], 0.15);
        for view_px in [680, 508] {
            for azimuth_deg in [0.0, 120.0, 240.0] {
                let view = GlobalView { view_px, ..GlobalView::default() };
                let camera = view.camera(&hall, &near, azimuth_deg);
                assert!(longer_side(&camera, &near.boxes[0].drawn).unwrap() >= MIN_PX - 0.1);
                assert!(
                    place_insets(&camera, &near.boxes, MIN_PX - 0.1, &[]).is_empty(),
                    "the view itself is close enough"
                );

                let camera = view.camera(&hall, &apart, azimuth_deg);
                let insets = place_insets(&camera, &apart.boxes, MIN_PX, &[]);
                assert_eq!(
                    insets.iter().map(|inset| inset.boxes.len()).collect::<Vec<_>>(),
                    [2, 1],
                    "neighbors share one inset"
                );
                let all = Rect::from_xywh(0.0, 0.0, view_px as f32, view_px as f32).unwrap();
                for (k, inset) in insets.iter().enumerate() {
                    assert!(
                        inset.boxes.iter().all(|&i| longer_side(
                            &inset.camera,
                            &apart.boxes[i].drawn
                        )
                        .unwrap()
                            >= MIN_PX)
                    );
                    assert!(
                        all.intersect(&inset.rect) == Some(inset.rect),
                        "the inset is within the view"
                    );
                    assert!(insets[..k].iter().all(|other| !overlap(&other.rect, &inset.rect)));
                    assert!(apart.boxes.iter().all(|b| !overlap(
                        &inset.rect,
                        &projected_bounds(&camera, &b.drawn).unwrap()
                    )));
                }
            }
        }
    }

    #[test]
    fn no_inset_is_placed_without_free_space() {
        let apart = subjects(&[[-9.0, 2.0], [8.0, -3.0]], 0.15);
        let hall = Aabb { center: Point3::origin(), size: Vector3::new(40.0, 25.0, 4.0) };
        let camera = GlobalView::default().camera(&hall, &apart, 0.0);
        let all = Rect::from_xywh(0.0, 0.0, 680.0, 680.0).unwrap();
        assert!(place_insets(&camera, &apart.boxes, MIN_PX, &[all]).is_empty());
    }
}
