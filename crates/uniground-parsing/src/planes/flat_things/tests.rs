use super::*;
use crate::superpoints::Patch;
use uniground_geometry::color::{Lab, srgb_to_lab};
use uniground_geometry::scene::Structure;

const PAINT: [u8; 3] = [205, 195, 175];
const RED: [u8; 3] = [170, 50, 50];
const BLUE: [u8; 3] = [50, 70, 170];
const SPACING_M: f32 = 0.02;

/// A place on a surface, meters from its corner.
type Place = (f32, f32);

/// Returns whether a place lies within a rectangle.
fn within((a, b): Place, (low_a, low_b): Place, (high_a, high_b): Place) -> bool {
    (low_a..high_a).contains(&a) && (low_b..high_b).contains(&b)
}

/// A level surface of two by two meters in superpoints of a quarter meter, of these colors, and
/// further points. Returns the places of each flat thing: center and number of points.
fn found_on(
    is_plane: bool,
    color: impl Fn(Place) -> [u8; 3],
    height_m: impl Fn(Place) -> f32,
    cameras: &[Point3<f32>],
) -> Vec<(Place, usize)> {
    let (mut cloud, mut of_point) = (PointCloud::default(), Vec::new());
    let steps = (2.0 / SPACING_M) as usize;
    let mut add = |place: Place, z: f32, superpoint: u32| {
        cloud.positions.push(Point3::new(place.0, place.1, z));
        cloud.colors.push(color(place));
        of_point.push(superpoint);
    };
    for i in 0..steps * steps {
        let place = ((i % steps) as f32 * SPACING_M, (i / steps) as f32 * SPACING_M);
        let superpoint = (place.1 * 4.0) as u32 * 8 + (place.0 * 4.0) as u32;
        // What rises from the surface has superpoints of its own.
        match height_m(place) {
            0.0 => add(place, 0.0, superpoint),
            high => add(place, high, 64 + superpoint),
        }
    }
    let mut points = vec![Vec::new(); 128];
    (0..).zip(&of_point).for_each(|(point, &s): (u32, &u32)| points[s as usize].push(point));
    let patch = |points: &Vec<u32>| Patch {
        points: points.len() as u32,
        center: points
            .first()
            .map_or_else(Point3::origin, |&point| cloud.positions[point as usize]),
        normal: Vector3::z(),
        lab: points
            .first()
            .map_or_else(Lab::zeros, |&point| srgb_to_lab(cloud.colors[point as usize])),
    };
    let superpoints = Superpoints {
        of_point,
        patches: points.iter().map(patch).collect(),
        adjacent: (0..64)
            .flat_map(|s: u32| [(s % 8 < 7).then_some((s, s + 1)), (s < 56).then_some((s, s + 8))])
            .flatten()
            .collect(),
        roughness_m: vec![0.0; 128],
    };
    let floor = Plane {
        structure: Structure::Floor,
        normal: Vector3::z(),
        middle: Point3::origin(),
        area_m2: 4.0,
    };
    let planes = match is_plane {
        true => Planes::new(vec![floor], (0..128).map(|s| (s < 64).then_some(0)).collect()),
        false => Planes::new(Vec::new(), vec![None; 128]),
    };
    let things = find(&cloud, &superpoints, &planes, cameras, &Progress::silent()).unwrap();
    let center = |points: &Vec<u32>, axis: usize| {
        let sum: f32 = points.iter().map(|&p| cloud.positions[p as usize][axis]).sum();
        (sum / points.len() as f32 * 10.0).round() / 10.0
    };
    things.iter().map(|points| ((center(points, 0), center(points, 1)), points.len())).collect()
}

fn found_by_color(color: impl Fn(Place) -> [u8; 3]) -> Vec<(Place, usize)> {
    found_on(true, color, |_| 0.0, &[])
}

#[track_caller]
fn assert_found(found: &[(Place, usize)], expected: &[(Place, usize)]) {
    let close = |(a, b): (&(Place, usize), &(Place, usize))| {
        (a.0.0 - b.0.0).hypot(a.0.1 - b.0.1) < 0.15 && a.1.abs_diff(b.1) <= b.1 / 4
    };
    assert!(
        found.len() == expected.len() && found.iter().zip(expected).all(close),
        "{found:?}, expected about {expected:?}"
    );
}

#[test]
fn poster_of_many_colors_is_found_whole() {
    // Red and blue spots on the color of the wall, within a frame.
    let poster = |place: Place| {
        let cell = ((place.0 / 0.06) as u32, (place.1 / 0.06) as u32);
        let spots = [RED, BLUE, PAINT][(cell.0 + cell.1 * 2) as usize % 3];
        if within(place, (0.6, 0.7), (1.2, 1.5)) { spots } else { PAINT }
    };
    assert_found(&found_by_color(poster), &[((0.9, 1.1), 30 * 40)]);
}

#[test]
fn shadows_and_the_edge_of_the_surface_are_no_things() {
    let dimmed = |by: f32| PAINT.map(|v| (f32::from(v) * by) as u8);
    let shadow = |place| if within(place, (0.6, 0.6), (1.2, 1.2)) { dimmed(0.6) } else { PAINT };
    assert_found(&found_by_color(shadow), &[]);
    let edge = |place: Place| if place.0 < 0.2 { RED } else { PAINT };
    assert_found(&found_by_color(edge), &[]);
    let most = |place| if within(place, (0.1, 0.1), (1.7, 1.6)) { RED } else { PAINT };
    assert_found(&found_by_color(most), &[]);
    let small = |place| if within(place, (0.6, 0.6), (0.68, 0.68)) { RED } else { PAINT };
    assert_found(&found_by_color(small), &[]);
}

#[test]
fn things_that_touch_at_a_corner_are_two() {
    let rugs = |place| {
        let red = within(place, (0.3, 0.3), (0.8, 0.8));
        let blue = within(place, (0.76, 0.76), (1.3, 1.3));
        if red {
            RED
        } else if blue {
            BLUE
        } else {
            PAINT
        }
    };
    let mut found = found_by_color(rugs);
    found.sort_by(|a, b| a.0.0.total_cmp(&b.0.0));
    assert_found(&found, &[((0.5, 0.5), 625), ((1.0, 1.0), 729)]);
}

#[test]
fn what_no_camera_sees_is_no_thing() {
    let rug = |place| if within(place, (0.6, 0.6), (1.2, 1.2)) { RED } else { PAINT };
    let above = [Point3::new(1.0, 1.0, 1.5)];
    assert_found(&found_on(true, rug, |_| 0.0, &above), &[((0.9, 0.9), 900)]);
    let below = [Point3::new(1.0, 1.0, -1.5), Point3::new(1.0, 1.0, 0.01)];
    assert_eq!(found_on(true, rug, |_| 0.0, &below).len(), 0);
}

#[test]
fn what_rises_a_little_from_a_top_is_a_thing_and_what_is_tall_is_not() {
    let book =
        |high: f32| move |place| if within(place, (0.6, 0.6), (0.9, 1.0)) { high } else { 0.0 };
    assert_found(&found_on(false, |_| PAINT, book(0.04), &[]), &[((0.75, 0.8), 300)]);
    assert_found(&found_on(false, |_| PAINT, book(0.25), &[]), &[]);
    let laptop = |place| {
        let (base, screen) =
            (within(place, (0.6, 0.6), (0.9, 1.0)), within(place, (0.9, 0.6), (0.94, 1.0)));
        if screen {
            0.25
        } else if base {
            0.03
        } else {
            0.0
        }
    };
    assert_found(&found_on(false, |_| PAINT, laptop, &[]), &[]);
}
