//! Axes and direction words on a picture: where "left" is, in this view.

use super::overlay::{blend, position};
use super::text;
use image::{Rgb, RgbImage};
use tiny_skia::{FillRule, Paint, PathBuilder, Pixmap, Rect, Stroke, Transform};
use uniground_geometry::scene::Camera;
use uniground_geometry::{Point2, Point3, Vector2, Vector3};

/// A word and the direction it means, world frame (Z up).
#[derive(Debug, Clone, PartialEq)]
pub struct DirectionWord {
    /// As written into the picture: "left (+X)".
    pub word: String,
    /// Unit length.
    pub direction: Vector3<f32>,
}

/// A word at the border of a picture.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct DirectionMark {
    pub word: String,
    pub rect: Rect,
    /// Direction it points to, unit length, picture axes (y down).
    pub towards: Vector2<f32>,
}

const WORD_PX: f32 = 17.0;
const PADDING_PX: f32 = 3.0;
/// Space for the arrow beyond the word.
const ARROW_PX: f32 = 20.0;
const INK: [u8; 3] = [20, 20, 20];
const TRIAD_PX: f32 = 42.0;

/// Returns the position of each word: at the border of the picture, in the direction it means as
/// seen from `target`.
pub(super) fn place_words(
    camera: &Camera,
    target: &Point3<f32>,
    words: &[DirectionWord],
) -> Vec<DirectionMark> {
    let (width, height) = (camera.intrinsics.width as f32, camera.intrinsics.height as f32);
    words
        .iter()
        .filter_map(|DirectionWord { word, direction }| {
            let towards = project_direction(camera, target, direction)?.try_normalize(1e-3)?;
            let size = Vector2::new(
                text::width(word, WORD_PX) + 2.0 * PADDING_PX,
                WORD_PX + 2.0 * PADDING_PX,
            );
            // Moves from the middle until word and arrow touch the border.
            let room =
                Vector2::new(width, height) / 2.0 - size / 2.0 - Vector2::repeat(ARROW_PX + 2.0);
            let reach =
                (room.x / towards.x.abs().max(1e-6)).min(room.y / towards.y.abs().max(1e-6));
            let at = Vector2::new(width, height) / 2.0 + towards * reach - size / 2.0;
            Some(DirectionMark {
                word: word.clone(),
                rect: Rect::from_xywh(at.x, at.y, size.x, size.y)?,
                towards,
            })
        })
        .collect()
}

/// Returns the direction in the picture, pixels per meter at `target`.
fn project_direction(
    camera: &Camera,
    target: &Point3<f32>,
    direction: &Vector3<f32>,
) -> Option<Vector2<f32>> {
    const STEP_M: f32 = 0.1;
    let (a, _) = position(camera, &(target - direction * STEP_M))?;
    let (b, _) = position(camera, &(target + direction * STEP_M))?;
    Some((b - a) / (2.0 * STEP_M))
}

/// Draws the words with their arrows, and the world's axes into a corner without a word. Returns
/// the occupied areas.
pub(super) fn draw(
    picture: &mut RgbImage,
    camera: &Camera,
    target: &Point3<f32>,
    words: &[DirectionWord],
) -> Vec<Rect> {
    let marks = place_words(camera, target, words);
    let Some(mut layer) = Pixmap::new(picture.width(), picture.height()) else { return Vec::new() };
    let mut ink = Paint { anti_alias: true, ..Paint::default() };
    let mut pale = Paint::default();
    pale.set_color_rgba8(255, 255, 255, 225);
    ink.set_color_rgba8(INK[0], INK[1], INK[2], 255);
    for DirectionMark { rect, towards, .. } in &marks {
        layer.fill_rect(*rect, &pale, Transform::identity(), None);
        if let Some(arrow) = arrow_path(rect, *towards) {
            // A pale outline, for dark backgrounds.
            layer.stroke_path(
                &arrow,
                &pale,
                &Stroke { width: 4.0, ..Stroke::default() },
                Transform::identity(),
                None,
            );
            layer.fill_path(&arrow, &ink, FillRule::Winding, Transform::identity(), None);
        }
    }
    let mut taken: Vec<Rect> =
        marks.iter().filter_map(|mark| mark.rect.outset(ARROW_PX, ARROW_PX)).collect();
    let corner = free_corner(picture.dimensions(), &taken);
    if let Some(plate) = corner {
        layer.fill_rect(plate, &pale, Transform::identity(), None);
    }
    let axes =
        corner.map(|corner| draw_axes(&mut layer, camera, target, &corner)).unwrap_or_default();
    taken.extend(corner);
    blend(picture, &layer);
    for DirectionMark { word, rect, .. } in &marks {
        text::draw(
            picture,
            word,
            rect.left() + PADDING_PX,
            rect.top() + PADDING_PX,
            WORD_PX,
            Rgb(INK),
        );
    }
    for (name, at, color) in axes {
        text::draw(picture, name, at.x - 4.0, at.y - 8.0, 14.0, Rgb(color));
    }
    taken
}

/// Returns a triangle beyond a word, in the direction it points to.
fn arrow_path(rect: &Rect, towards: Vector2<f32>) -> Option<tiny_skia::Path> {
    let (half_w, half_h) = (rect.width() / 2.0, rect.height() / 2.0);
    let middle = Vector2::new(rect.left() + half_w, rect.top() + half_h);
    let out = (half_w / towards.x.abs().max(1e-6)).min(half_h / towards.y.abs().max(1e-6));
    let (base, across) =
        (middle + towards * (out + 2.0), Vector2::new(-towards.y, towards.x) * 4.5);
    let (tip, a, b) = (base + towards * (ARROW_PX - 3.0), base + across, base - across);
    let mut path = PathBuilder::new();
    path.move_to(tip.x, tip.y);
    path.line_to(a.x, a.y);
    path.line_to(b.x, b.y);
    path.close();
    path.finish()
}

/// Returns a free corner of the picture, bottom left first.
fn free_corner((width, height): (u32, u32), taken: &[Rect]) -> Option<Rect> {
    let side = 2.0 * TRIAD_PX + 20.0;
    let (right, bottom) = (width as f32 - side, height as f32 - side);
    let corners = [(0.0, bottom), (right, bottom), (0.0, 0.0), (right, 0.0)];
    let mut corners = corners.into_iter().filter_map(|(x, y)| Rect::from_xywh(x, y, side, side));
    corners.find(|corner| taken.iter().all(|other| !super::overlay::overlap(corner, other)))
}

/// Draws the world's axes as seen in this view: X red, Y green, Z blue. Returns the areas of their
/// names.
fn draw_axes(
    layer: &mut Pixmap,
    camera: &Camera,
    target: &Point3<f32>,
    corner: &Rect,
) -> Vec<(&'static str, Point2<f32>, [u8; 3])> {
    let middle =
        Point2::new(corner.left() + corner.width() / 2.0, corner.top() + corner.height() / 2.0);
    let axes = [
        ("X", Vector3::x(), [190, 20, 20]),
        ("Y", Vector3::y(), [0, 120, 0]),
        ("Z", Vector3::z(), [20, 40, 200]),
    ];
    let seen = axes.map(|(name, axis, color)| {
        (name, project_direction(camera, target, &axis).unwrap_or_default(), color)
    });
    let longest = seen.iter().map(|(_, along, _)| along.norm()).fold(1e-6, f32::max);
    seen.into_iter()
        .map(|(name, along, color)| {
            let tip = middle + along / longest * TRIAD_PX;
            let mut path = PathBuilder::new();
            path.move_to(middle.x, middle.y);
            path.line_to(tip.x, tip.y);
            let mut paint = Paint { anti_alias: true, ..Paint::default() };
            paint.set_color_rgba8(color[0], color[1], color[2], 255);
            if let Some(path) = path.finish() {
                layer.stroke_path(
                    &path,
                    &paint,
                    &Stroke { width: 3.0, ..Stroke::default() },
                    Transform::identity(),
                    None,
                );
            }
            let beyond = along.try_normalize(1e-6).unwrap_or_default() * 9.0;
            (name, tip + beyond, color)
        })
        .collect()
}
