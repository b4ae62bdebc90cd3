//! Numbers on a photograph: a tag on every marked thing where there is room, else beside it with a
//! line to it.

use super::overlay::{blend, candidate_areas, overlap};
use super::text;
use image::{Rgb, RgbImage};
use tiny_skia::{Color, Paint, PathBuilder, Pixmap, Rect, Stroke, Transform};
use uniground_geometry::Point2;

/// A thing to be marked.
#[derive(Debug, Clone, PartialEq)]
pub struct Mark {
    /// The text on the tag, usually an id.
    pub label: String,
    /// A place on the thing: shares of the picture's width and height.
    pub at: [f32; 2],
    /// Distance of that place from the thing's borders, as a share of the picture's width.
    pub margin: f32,
}

/// Height of the digits relative to the picture's longer side.
const TEXT_SHARE: f32 = 0.021;
const LEAST_TEXT_PX: f32 = 11.0;
const PADDING_PX: f32 = 2.0;
/// A tag is placed on a thing whose margin is at least this many times the tag's height.
const ROOM: f32 = 1.6;
const DOT_PX: f32 = 3.0;
const TAG: [u8; 3] = [20, 30, 60];
const INK: Rgb<u8> = Rgb([255, 235, 60]);

/// Draws the marks. Tags never cover each other, nor the marked place of another thing where there
/// is an alternative; a tag that has no space is left out.
pub fn draw_marks(picture: &mut RgbImage, marks: &[Mark]) {
    let (width, height) = picture.dimensions();
    let size_px = (width.max(height) as f32 * TEXT_SHARE).max(LEAST_TEXT_PX);
    let Some(mut layer) = Pixmap::new(width, height) else { return };
    let at = |mark: &Mark| Point2::new(mark.at[0] * width as f32, mark.at[1] * height as f32);
    let tag = |mark: &Mark| {
        (text::width(&mark.label, size_px) + 2.0 * PADDING_PX, size_px + 2.0 * PADDING_PX)
    };
    let is_on = |mark: &Mark| mark.margin * width as f32 >= ROOM * tag(mark).1;
    let mut places: Vec<Option<Rect>> = marks
        .iter()
        .map(|mark| {
            let ((w, h), at) = (tag(mark), at(mark));
            let left = (at.x - w / 2.0).clamp(0.0, (width as f32 - w).max(0.0));
            let top = (at.y - h / 2.0).clamp(0.0, (height as f32 - h).max(0.0));
            Rect::from_xywh(left, top, w, h).filter(|_| is_on(mark))
        })
        .collect();
    for i in 0..marks.len() {
        let taken: Vec<Rect> =
            places.iter().enumerate().filter(|(j, _)| *j != i).filter_map(|(_, r)| *r).collect();
        let is_free = |place: &Rect| taken.iter().all(|other| !overlap(place, other));
        if places[i].is_some_and(|place| is_free(&place)) {
            continue;
        }
        let home = at(&marks[i]);
        let covers_none = |place: &Rect| {
            marks.iter().map(at).all(|at| {
                !(place.left() - DOT_PX..=place.right() + DOT_PX).contains(&at.x)
                    || !(place.top() - DOT_PX..=place.bottom() + DOT_PX).contains(&at.y)
            })
        };
        let candidates = || candidate_areas((width, height), home, tag(&marks[i]));
        places[i] = candidates()
            .find(|place| is_free(place) && covers_none(place))
            .or_else(|| candidates().find(is_free));
    }
    for (mark, place) in marks.iter().zip(&places) {
        let Some(rect) = place else { continue };
        draw_tag(&mut layer, rect, at(mark));
    }
    blend(picture, &layer);
    for (mark, place) in marks.iter().zip(&places) {
        let Some(rect) = place else { continue };
        let (x, y) = (rect.left() + PADDING_PX, rect.top() + PADDING_PX);
        text::draw(picture, &mark.label, x, y, size_px, INK);
    }
}

/// Draws a tag's background; where the tag is beside its thing, a line to a dot on it as well.
fn draw_tag(layer: &mut Pixmap, rect: &Rect, at: Point2<f32>) {
    let [r, g, b] = TAG;
    let mut paint = Paint { anti_alias: true, ..Paint::default() };
    paint.set_color_rgba8(r, g, b, 225);
    let nearest =
        Point2::new(at.x.clamp(rect.left(), rect.right()), at.y.clamp(rect.top(), rect.bottom()));
    if nearest != at {
        let mut line = PathBuilder::new();
        line.move_to(nearest.x, nearest.y);
        line.line_to(at.x, at.y);
        if let Some(line) = line.finish() {
            let mut pale = Paint { anti_alias: true, ..Paint::default() };
            pale.set_color(Color::WHITE);
            let width = |width| Stroke { width, ..Stroke::default() };
            layer.stroke_path(&line, &pale, &width(3.0), Transform::identity(), None);
            layer.stroke_path(&line, &paint, &width(1.5), Transform::identity(), None);
        }
        if let Some(dot) = PathBuilder::from_circle(at.x, at.y, DOT_PX) {
            let mut ink = Paint { anti_alias: true, ..Paint::default() };
            ink.set_color_rgba8(INK.0[0], INK.0[1], INK.0[2], 255);
            let winding = tiny_skia::FillRule::Winding;
            layer.fill_path(&dot, &ink, winding, Transform::identity(), None);
        }
    }
    layer.fill_rect(*rect, &paint, Transform::identity(), None);
}

#[cfg(test)]
mod tests {
    use super::*;

    fn mark(label: &str, at: [f32; 2], margin: f32) -> Mark {
        Mark { label: label.into(), at, margin }
    }

    #[test]
    fn tag_is_on_a_large_thing_and_beside_a_small_one() {
        let gray = RgbImage::from_pixel(640, 480, Rgb([128; 3]));
        let drawn = |margin| {
            let mut picture = gray.clone();
            draw_marks(&mut picture, &[mark("17", [0.5, 0.5], margin)]);
            picture
        };
        let changed = |picture: &RgbImage, x: u32, y: u32| picture.get_pixel(x, y).0 != [128; 3];
        let on = drawn(0.1);
        assert!(changed(&on, 320, 240) && !changed(&on, 320, 215));
        let beside = drawn(0.01);
        // A dot on the thing, the tag above it.
        assert_eq!(beside.get_pixel(320, 240).0, INK.0);
        assert!((200..236).any(|y| changed(&beside, 312, y)));
    }

    #[test]
    fn marks_beyond_the_rim_or_without_space_change_nothing_else() {
        let mut picture = RgbImage::from_pixel(40, 20, Rgb([128; 3]));
        let marks: Vec<Mark> = (0..30).map(|i| mark(&i.to_string(), [0.5, 0.5], 0.0)).collect();
        draw_marks(&mut picture, &marks);
        draw_marks(&mut picture, &[mark("1", [1.5, -0.5], 0.5)]);
        assert_eq!(picture.dimensions(), (40, 20));
    }
}
