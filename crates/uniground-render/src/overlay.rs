//! Draws boxes and labels over a picture: hidden edges are dashed, and labels never cover each
//! other.

use super::render_scene::Splats;
use super::text;
use image::{Rgb, RgbImage};
use tiny_skia::{
    Color, LineCap, Paint, Path, PathBuilder, Pixmap, Rect, Stroke, StrokeDash, Transform,
};
use uniground_geometry::boxes::{Aabb, OrientedBox};
use uniground_geometry::scene::Camera;
use uniground_geometry::{Point2, Point3};

/// The style of a box.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum BoxStyle {
    /// The chosen instance: green, the thickest lines.
    Answer,
    /// An object that the answer is related to: red.
    Anchor,
    /// Any other candidate: blue, the thinnest lines.
    Candidate,
}

/// A box in the world with a tag.
#[derive(Debug, Clone, PartialEq)]
pub struct LabeledBox {
    /// Axis-aligned, meters, world frame (Z up). Selects what the render cuts away.
    pub aabb: Aabb,
    /// The box that is drawn: along the object's own axes, or the same as `aabb`.
    pub drawn: OrientedBox,
    /// One line of text on the tag: "22", "7 anchor".
    pub label: String,
    /// Selects color and width of its lines.
    pub style: BoxStyle,
}

impl LabeledBox {
    /// Returns a box that is drawn along the axes of the world.
    #[must_use]
    pub fn axis_aligned(aabb: Aabb, label: impl Into<String>, style: BoxStyle) -> Self {
        Self { aabb, drawn: aabb.into(), label: label.into(), style }
    }
}

impl BoxStyle {
    fn line_color(self) -> [u8; 3] {
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
            Self::Candidate => 2.0,
        }
    }
}

/// Font sizes tried for a label: smaller ones if there is no space.
const LABEL_PX: [f32; 3] = [18.0, 14.0, 11.0];
const PADDING_PX: f32 = 4.0;
const FOOTING: [u8; 3] = [120; 3];
const FOOTING_PX: f32 = 1.5;
/// An edge counts as hidden when a surface is nearer by this much: meters, and a share of the
/// depth.
const HIDDEN_BY_M: f32 = 0.03;
const HIDDEN_BY_SHARE: f32 = 0.01;
/// Nothing nearer to the camera than this is drawn, meters.
const NEAR_M: f32 = 0.05;

/// Draws the boxes in order, later ones on top, then the labels. `taken` are areas that are already
/// occupied.
pub(super) fn draw(
    picture: &mut RgbImage,
    drawn: &Splats,
    camera: &Camera,
    boxes: &[LabeledBox],
    taken: Vec<Rect>,
) {
    let Some(mut layer) = Pixmap::new(picture.width(), picture.height()) else { return };
    draw_footings(&mut layer, drawn, camera);
    for labeled in boxes {
        draw_edges(&mut layer, drawn, camera, labeled);
    }
    let places = place_labels(picture.dimensions(), camera, boxes, taken);
    for (labeled, LabelSpot { rect, home, .. }) in
        boxes.iter().zip(&places).filter_map(|(b, place)| Some((b, place.as_ref()?)))
    {
        draw_leader(&mut layer, labeled.style, rect, *home);
    }
    for (labeled, LabelSpot { rect, .. }) in
        boxes.iter().zip(&places).filter_map(|(b, place)| Some((b, place.as_ref()?)))
    {
        let mut paint = Paint::default();
        let [r, g, b] = labeled.style.line_color();
        paint.set_color_rgba8(r, g, b, 255);
        layer.fill_rect(*rect, &paint, Transform::identity(), None);
    }
    blend(picture, &layer);
    for (labeled, LabelSpot { rect, size_px, .. }) in
        boxes.iter().zip(&places).filter_map(|(b, place)| Some((b, place.as_ref()?)))
    {
        text::draw(
            picture,
            &labeled.label,
            rect.left() + PADDING_PX,
            rect.top() + PADDING_PX,
            *size_px,
            Rgb([255; 3]),
        );
    }
}

/// Returns the position in the picture, possibly outside of it, and depth; `None` behind the
/// camera.
pub(super) fn position(camera: &Camera, point: &Point3<f32>) -> Option<(Point2<f32>, f32)> {
    let p = camera.world_to_camera() * point;
    let i = &camera.intrinsics;
    (p.z > NEAR_M).then(|| (Point2::new(i.fx * p.x / p.z + i.cx, i.fy * p.y / p.z + i.cy), p.z))
}

/// Draws thin lines at the foot of walls that were left out, where nothing hides them.
fn draw_footings(layer: &mut Pixmap, drawn: &Splats, camera: &Camera) {
    let (mut seen, mut hidden) = (PathBuilder::new(), PathBuilder::new());
    for [a, b] in &drawn.footings {
        add_edge(drawn, camera, (a, b), &mut seen, &mut hidden);
    }
    let Some(path) = seen.finish() else { return };
    let mut paint = Paint { anti_alias: true, ..Paint::default() };
    let [r, g, b] = FOOTING;
    paint.set_color_rgba8(r, g, b, 255);
    layer.stroke_path(
        &path,
        &paint,
        &Stroke { width: FOOTING_PX, ..Stroke::default() },
        Transform::identity(),
        None,
    );
}

fn draw_edges(layer: &mut Pixmap, drawn: &Splats, camera: &Camera, labeled: &LabeledBox) {
    let (mut seen, mut hidden) = (PathBuilder::new(), PathBuilder::new());
    let corners = labeled.drawn.corners();
    for i in 0..8_usize {
        for bit in [1, 2, 4].into_iter().filter(|bit| i & bit == 0) {
            add_edge(drawn, camera, (&corners[i], &corners[i | bit]), &mut seen, &mut hidden);
        }
    }
    let [r, g, b] = labeled.style.line_color();
    let width = labeled.style.width_px();
    let mut line = |path: &Path, color: Color, width: f32, dash: Option<StrokeDash>| {
        let mut paint = Paint { anti_alias: true, ..Paint::default() };
        paint.set_color(color);
        let cap = if dash.is_some() { LineCap::Butt } else { LineCap::Round };
        let stroke = Stroke { width, line_cap: cap, dash, ..Stroke::default() };
        layer.stroke_path(path, &paint, &stroke, Transform::identity(), None);
    };
    if let Some(path) = hidden.finish() {
        line(
            &path,
            Color::from_rgba8(r, g, b, 190),
            width * 0.75,
            StrokeDash::new(vec![5.0, 4.0], 0.0),
        );
    }
    if let Some(path) = seen.finish() {
        // A pale outline keeps the line readable on any background.
        line(&path, Color::from_rgba8(255, 255, 255, 160), width + 2.0, None);
        line(&path, Color::from_rgba8(r, g, b, 255), width, None);
    }
}

/// Adds the visible stretches of an edge to one path and the hidden ones to another.
fn add_edge(
    drawn: &Splats,
    camera: &Camera,
    (a, b): (&Point3<f32>, &Point3<f32>),
    seen: &mut PathBuilder,
    hidden: &mut PathBuilder,
) {
    const MAX_STEPS: usize = 200;
    let (Some((from, _)), Some((to, _))) = (position(camera, a), position(camera, b)) else {
        return;
    };
    let steps = (((to - from).norm() / 3.0).ceil() as usize).clamp(1, MAX_STEPS);
    let is_hidden = |share: f32| {
        position(camera, &nalgebra::Point3::from(a.coords.lerp(&b.coords, share))).is_some_and(
            |(at, z_m)| drawn.depth_at(at.x, at.y) < z_m - HIDDEN_BY_M - HIDDEN_BY_SHARE * z_m,
        )
    };
    let at = |step: usize| {
        position(
            camera,
            &nalgebra::Point3::from(a.coords.lerp(&b.coords, step as f32 / steps as f32)),
        )
        .map(|(at, _)| at)
    };
    let mut begun: Option<(bool, usize)> = None;
    for step in 0..=steps {
        let state = (step < steps).then(|| is_hidden((step as f32 + 0.5) / steps as f32));
        if let Some((was, start)) = begun
            && state != Some(was)
            && let (Some(p), Some(q)) = (at(start), at(step))
        {
            let path = if was { &mut *hidden } else { &mut *seen };
            path.move_to(p.x, p.y);
            path.line_to(q.x, q.y);
            begun = None;
        }
        if begun.is_none() {
            begun = state.map(|state| (state, step));
        }
    }
}

/// Draws a line between a box and its label, if the label did not fit at the box.
fn draw_leader(layer: &mut Pixmap, style: BoxStyle, rect: &Rect, home: Point2<f32>) {
    const TOUCHING_PX: f32 = 14.0;
    let nearest = Point2::new(
        home.x.clamp(rect.left(), rect.right()),
        home.y.clamp(rect.top(), rect.bottom()),
    );
    let mut path = PathBuilder::new();
    path.move_to(nearest.x, nearest.y);
    path.line_to(home.x, home.y);
    if (nearest - home).norm() < TOUCHING_PX {
        return;
    }
    let Some(path) = path.finish() else { return };
    let mut paint = Paint { anti_alias: true, ..Paint::default() };
    let [r, g, b] = style.line_color();
    paint.set_color_rgba8(r, g, b, 220);
    layer.stroke_path(
        &path,
        &paint,
        &Stroke { width: 1.5, ..Stroke::default() },
        Transform::identity(),
        None,
    );
}

/// The position of a label.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct LabelSpot {
    pub rect: Rect,
    pub size_px: f32,
    /// The point of the box that the label refers to: the middle of its upper border.
    home: Point2<f32>,
}

/// Finds a position for every label that has a box in the picture: as near to the box as possible,
/// never over another label, and not over the middle of another box if there is an alternative. The
/// last boxes are the most important, so they choose first.
pub(super) fn place_labels(
    picture: (u32, u32),
    camera: &Camera,
    boxes: &[LabeledBox],
    mut taken: Vec<Rect>,
) -> Vec<Option<LabelSpot>> {
    let middles: Vec<Option<Point2<f32>>> =
        boxes.iter().map(|b| position(camera, &b.drawn.center).map(|(at, _)| at)).collect();
    let mut places = vec![None; boxes.len()];
    for (i, labeled) in boxes.iter().enumerate().rev() {
        let Some(home) = label_anchor(picture, camera, &labeled.drawn) else { continue };
        let others = || {
            middles.iter().enumerate().filter(|(j, _)| *j != i).filter_map(|(_, middle)| *middle)
        };
        let found = LABEL_PX.iter().find_map(|&size_px| {
            let size = (
                text::width(&labeled.label, size_px) + 2.0 * PADDING_PX,
                size_px + 2.0 * PADDING_PX,
            );
            let free = |place: &Rect| taken.iter().all(|other| !overlap(place, other));
            let covers_none = |place: &Rect| others().all(|middle| !rect_contains(place, middle));
            let rect = candidate_areas(picture, home, size)
                .find(|place| free(place) && covers_none(place))
                .or_else(|| candidate_areas(picture, home, size).find(free))?;
            Some(LabelSpot { rect, size_px, home })
        });
        taken.extend(found.iter().map(|place| place.rect));
        places[i] = found;
    }
    places
}

/// Returns the bounds of a box in the picture, possibly outside of it; `None` when it is behind the
/// camera.
pub(super) fn projected_bounds(camera: &Camera, of: &OrientedBox) -> Option<Rect> {
    let corners = of.corners();
    let mut at = corners.iter().filter_map(|corner| position(camera, corner)).map(|(at, _)| at);
    let first = at.next()?;
    let (low, high) = at.fold((first, first), |(low, high), p| (low.inf(&p), high.sup(&p)));
    Rect::from_ltrb(low.x, low.y, high.x, high.y)
}

/// Returns the middle of a box's upper border, moved into the picture; `None` when the box is
/// behind the camera.
fn label_anchor(
    (width, height): (u32, u32),
    camera: &Camera,
    of: &OrientedBox,
) -> Option<Point2<f32>> {
    let corners: Vec<Point2<f32>> =
        of.corners().iter().filter_map(|c| position(camera, c)).map(|(at, _)| at).collect();
    let count = corners.len() as f32;
    let top = corners.iter().map(|p| p.y).fold(f32::INFINITY, f32::min);
    let middle = corners.iter().map(|p| p.x).sum::<f32>() / count;
    (!corners.is_empty()).then(|| {
        Point2::new(middle.clamp(0.0, width as f32 - 1.0), top.clamp(0.0, height as f32 - 1.0))
    })
}

/// Returns the candidate positions for a label: above its box, then in rings around it, all within
/// the picture.
pub(super) fn candidate_areas(
    (width, height): (u32, u32),
    home: Point2<f32>,
    (w, h): (f32, f32),
) -> impl Iterator<Item = Rect> {
    const PER_RING: usize = 12;
    let (width, height) = (width as f32, height as f32);
    let rings = (width.max(height) / h).ceil() as usize;
    (0..=rings * PER_RING).filter_map(move |i| {
        let ring = i.div_ceil(PER_RING) as f32;
        // From straight up, alternating to both sides.
        let turn = i % PER_RING;
        let side = if turn.is_multiple_of(2) { 1.0 } else { -1.0 };
        let angle = side * turn.div_ceil(2) as f32 * std::f32::consts::TAU / PER_RING as f32;
        let (x, y) = (
            home.x - w / 2.0 + ring * (w * 0.6) * angle.sin(),
            home.y - h - 3.0 - ring * h * angle.cos(),
        );
        (x >= 0.0 && y >= 0.0 && x + w <= width && y + h <= height)
            .then(|| Rect::from_xywh(x, y, w, h))
            .flatten()
    })
}

fn rect_contains(rect: &Rect, at: Point2<f32>) -> bool {
    (rect.left()..=rect.right()).contains(&at.x) && (rect.top()..=rect.bottom()).contains(&at.y)
}

pub(super) fn overlap(a: &Rect, b: &Rect) -> bool {
    a.left() < b.right() && b.left() < a.right() && a.top() < b.bottom() && b.top() < a.bottom()
}

/// Blends a premultiplied layer over the picture.
pub(super) fn blend(picture: &mut RgbImage, layer: &Pixmap) {
    for (below, above) in
        picture.pixels_mut().zip(layer.pixels()).filter(|(_, above)| above.alpha() > 0)
    {
        let through = 255 - u16::from(above.alpha());
        for (channel, over) in below.0.iter_mut().zip([above.red(), above.green(), above.blue()]) {
            *channel = (u16::from(over) + u16::from(*channel) * through / 255).min(255) as u8;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Orbit;
    use crate::render_scene::RenderScene;
    use uniground_geometry::Vector3;
    use uniground_geometry::scene::PointCloud;

    const ROOM: Aabb =
        Aabb { center: Point3::new(0.0, 0.0, 0.0), size: Vector3::new(6.0, 5.0, 2.5) };

    fn camera() -> Camera {
        Orbit { width: 680, height: 680, azimuth_deg: -90.0, tilt_deg: 30.0 }.camera(&ROOM)
    }

    fn boxes(count: usize, spread_m: f32) -> Vec<LabeledBox> {
        let at = |i: usize| Point3::new(i as f32 * spread_m - 0.5, (i % 7) as f32 * spread_m, 0.0);
        (0..count)
            .map(|i| {
                let aabb = Aabb { center: at(i), size: Vector3::repeat(0.3) };
                LabeledBox::axis_aligned(aabb, format!("{}", 100 + i), BoxStyle::Candidate)
            })
            .collect()
    }

    #[test]
    fn every_label_is_placed_and_none_overlap() {
        for (count, spread_m) in [(8, 0.02), (10, 0.3), (100, 0.01)] {
            let places = place_labels((680, 680), &camera(), &boxes(count, spread_m), Vec::new());
            let rects: Vec<Rect> = places.iter().flatten().map(|p| p.rect).collect();
            assert_eq!(rects.len(), count, "{spread_m}");
            for (i, a) in rects.iter().enumerate() {
                assert!(
                    a.left() >= 0.0 && a.top() >= 0.0 && a.right() <= 680.0 && a.bottom() <= 680.0
                );
                assert!(rects[i + 1..].iter().all(|b| !overlap(a, b)), "{count} {spread_m}");
            }
        }
    }

    #[test]
    fn labels_do_not_cover_the_centers_of_other_boxes() {
        let boxes = boxes(5, 0.4);
        let camera = camera();
        let places = place_labels((680, 680), &camera, &boxes, Vec::new());
        for (i, place) in places.iter().enumerate() {
            let rect = place.as_ref().unwrap().rect;
            let hides = |j: usize| {
                rect_contains(&rect, position(&camera, &boxes[j].drawn.center).unwrap().0)
            };
            assert!((0..5).filter(|j| *j != i).all(|j| !hides(j)));
        }
    }

    /// A wall in front of the far half of a box: the line along the box's upper edge is solid where
    /// it is visible and dashed behind the wall.
    #[test]
    fn hidden_edges_are_dashed() {
        let mut cloud = PointCloud::default();
        for i in 0..200 {
            for j in 0..200 {
                cloud.positions.push(Point3::new(i as f32 * 0.01, -1.0, j as f32 * 0.02 - 2.0));
                cloud.colors.push([255; 3]);
            }
        }
        let camera =
            Orbit { width: 400, height: 400, azimuth_deg: -90.0, tilt_deg: 80.0 }.camera(&ROOM);
        let drawn = RenderScene::new(cloud).draw_with_ceiling(&camera);
        let aabb = Aabb { center: Point3::origin(), size: Vector3::new(3.6, 0.2, 1.0) };
        let mut picture = RgbImage::from_pixel(400, 400, Rgb([255; 3]));
        draw(
            &mut picture,
            &drawn,
            &camera,
            &[LabeledBox::axis_aligned(aabb, "7", BoxStyle::Candidate)],
            Vec::new(),
        );
        let (a, b) = (Point3::new(-1.8, -0.1, -0.5), Point3::new(1.8, -0.1, -0.5));
        let inked = |from: f32, to: f32| {
            let dark = |i: i32| {
                let (at, _) = position(
                    &camera,
                    &Point3::from(a.coords.lerp(&b.coords, from + (to - from) * i as f32 / 60.0)),
                )
                .unwrap();
                picture.get_pixel(at.x.round() as u32, at.y.round() as u32).0[0] < 160
            };
            (0..60).filter(|&i| dark(i)).count()
        };
        let (seen, hidden) = (inked(0.02, 0.46), inked(0.54, 0.98));
        assert!(seen >= 58 && (20..50).contains(&hidden), "{seen} {hidden}");
    }
}
