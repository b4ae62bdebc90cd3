//! Boxes and labels over a picture.

use super::text;
use crate::geometry::boxes::Aabb;
use crate::scene::Camera;
use image::{Rgb, RgbImage};
use tiny_skia::{Color, LineCap, Paint, PathBuilder, Pixmap, Rect, Stroke, Transform};

/// How a box is drawn.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum BoxStyle {
    Answer,
    Anchor,
    Candidate,
}

/// A box in the world with a tag.
#[derive(Debug, Clone, PartialEq)]
pub struct LabelledBox {
    pub aabb: Aabb,
    pub label: String,
    pub style: BoxStyle,
}

impl BoxStyle {
    fn colour(self) -> [u8; 3] {
        match self {
            Self::Answer => [0, 150, 60],
            Self::Anchor => [210, 30, 30],
            Self::Candidate => [40, 90, 200],
        }
    }

    fn width_px(self) -> f32 {
        match self {
            Self::Answer => 4.0,
            Self::Anchor => 3.0,
            Self::Candidate => 1.5,
        }
    }
}

const LABEL_PX: f32 = 18.0;
const PADDING_PX: f32 = 4.0;

/// Draws the boxes in order, later ones on top, then the labels where they do not cover each other.
pub(super) fn draw(picture: &mut RgbImage, camera: &Camera, boxes: &[LabelledBox]) {
    let Some(mut layer) = Pixmap::new(picture.width(), picture.height()) else { return };
    for labelled in boxes {
        draw_edges(&mut layer, camera, labelled);
    }
    let mut taken: Vec<Rect> = Vec::new();
    let mut texts = Vec::new();
    // The most important labels choose their place first.
    for labelled in boxes.iter().rev() {
        let Some(place) = label_place(picture, camera, labelled, &taken) else { continue };
        let mut paint = Paint::default();
        let [r, g, b] = labelled.style.colour();
        paint.set_color_rgba8(r, g, b, 235);
        layer.fill_rect(place, &paint, Transform::identity(), None);
        taken.push(place);
        texts.push((place.left() + PADDING_PX, place.top() + PADDING_PX, labelled.label.as_str()));
    }
    blend(picture, &layer);
    for (x, y, label) in texts {
        text::draw(picture, label, x, y, LABEL_PX, Rgb([255, 255, 255]));
    }
}

fn draw_edges(layer: &mut Pixmap, camera: &Camera, labelled: &LabelledBox) {
    let corners = labelled.aabb.corners().map(|c| camera.project(&c));
    let mut path = PathBuilder::new();
    for i in 0..8_usize {
        for bit in [1, 2, 4] {
            let (from, to) = (corners[i], corners[i | bit]);
            if i & bit == 0
                && let (Some(a), Some(b)) = (from, to)
            {
                path.move_to(a.u, a.v);
                path.line_to(b.u, b.v);
            }
        }
    }
    let Some(path) = path.finish() else { return };
    let line = |layer: &mut Pixmap, colour: Color, width: f32| {
        let mut paint = Paint { anti_alias: true, ..Paint::default() };
        paint.set_color(colour);
        let stroke = Stroke { width, line_cap: LineCap::Round, ..Stroke::default() };
        layer.stroke_path(&path, &paint, &stroke, Transform::identity(), None);
    };
    let [r, g, b] = labelled.style.colour();
    // A pale rim keeps the line readable on any background.
    line(layer, Color::from_rgba8(255, 255, 255, 160), labelled.style.width_px() + 2.0);
    line(layer, Color::from_rgba8(r, g, b, 255), labelled.style.width_px());
}

/// A free place for the label: above the box, else ever further up or down, always inside the picture.
fn label_place(picture: &RgbImage, camera: &Camera, labelled: &LabelledBox, taken: &[Rect]) -> Option<Rect> {
    let corners: Vec<_> = labelled.aabb.corners().iter().filter_map(|c| camera.project(c)).collect();
    let top = corners.iter().map(|p| p.v).fold(f32::INFINITY, f32::min);
    let middle = corners.iter().map(|p| p.u).sum::<f32>() / corners.len().max(1) as f32;
    if corners.is_empty() {
        return None;
    }
    let (width, height) = (text::width(&labelled.label, LABEL_PX) + 2.0 * PADDING_PX, LABEL_PX + 2.0 * PADDING_PX);
    let left = (middle - width / 2.0).clamp(0.0, (picture.width() as f32 - width).max(0.0));
    let steps = [0.0, -1.0, 1.0, -2.0, 2.0, -3.0, 3.0, 4.0, -4.0, 5.0, 6.0];
    steps
        .into_iter()
        .filter_map(|step| {
            let y = (top - height - 2.0 + step * (height + 2.0)).clamp(0.0, (picture.height() as f32 - height).max(0.0));
            Rect::from_xywh(left, y, width, height)
        })
        .find(|place| taken.iter().all(|other| !overlap(place, other)))
}

fn overlap(a: &Rect, b: &Rect) -> bool {
    a.left() < b.right() && b.left() < a.right() && a.top() < b.bottom() && b.top() < a.bottom()
}

/// Puts a premultiplied layer over the picture.
fn blend(picture: &mut RgbImage, layer: &Pixmap) {
    for (below, above) in picture.pixels_mut().zip(layer.pixels()) {
        let through = 255 - u16::from(above.alpha());
        for (channel, over) in below.0.iter_mut().zip([above.red(), above.green(), above.blue()]) {
            *channel = (u16::from(over) + u16::from(*channel) * through / 255).min(255) as u8;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::{Point3, Vector3};
    use crate::render::Orbit;

    #[test]
    fn labels_never_overlap() {
        let room = Aabb { center: Point3::origin(), size: Vector3::new(6.0, 5.0, 2.5) };
        let camera = Orbit { width: 680, height: 680, azimuth_deg: -90.0, tilt_deg: 30.0 }.camera(&room);
        let picture = RgbImage::new(680, 680);
        let mut taken: Vec<Rect> = Vec::new();
        for i in 0..8 {
            let aabb = Aabb { center: Point3::new(i as f32 * 0.02, 0.0, 0.0), size: Vector3::repeat(0.3) };
            let labelled = LabelledBox { aabb, label: format!("{i} chair"), style: BoxStyle::Candidate };
            if let Some(place) = label_place(&picture, &camera, &labelled, &taken) {
                assert!(taken.iter().all(|other| !overlap(&place, other)));
                taken.push(place);
            }
        }
        assert!(taken.len() >= 6, "only {} of 8 labels found a place", taken.len());
    }
}
