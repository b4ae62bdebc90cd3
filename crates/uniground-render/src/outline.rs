//! Highlights the object of a picture: the outline of its mask, and dimmed surroundings.

use image::{Rgb, RgbImage};
use uniground_geometry::scene::CellMask;

/// A light line at the object with a dark one around it: one of them is visible on any background.
const LIGHT: Rgb<u8> = Rgb([255, 240, 40]);
const DARK: Rgb<u8> = Rgb([10, 10, 10]);
/// Remaining brightness of dimmed surroundings.
const DIMMED: f32 = 0.66;
/// Thickness of the light line and of both, in units of a line.
const LIGHT_WIDTH: f32 = 2.0;
const BOTH_WIDTH: f32 = 3.2;
/// Pictures with more pixels than this on their shorter side get thicker lines.
const USUAL_PX: f32 = 480.0;

/// Returns how far the lines reach outside of the object in a picture of this size, pixels.
#[must_use]
pub fn outline_reach(width: u32, height: u32) -> u32 {
    (BOTH_WIDTH * line_unit_px(width, height)).ceil() as u32
}

fn line_unit_px(width: u32, height: u32) -> f32 {
    (width.min(height) as f32 / USUAL_PX).max(1.0)
}

/// How the surroundings of an object are drawn.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Surroundings {
    /// Unchanged.
    Kept,
    /// Darker.
    Dimmed,
}

/// Draws the outline of a mask into the part of a picture at `area` (left, top, width, height,
/// pixels). `place` is the position of the mask's box as shares of that part: left, top, right,
/// bottom. Pixels outside of `area` do not change.
pub fn draw_outline(
    picture: &mut RgbImage,
    (left, top, width, height): (u32, u32, u32, u32),
    mask: &CellMask,
    place: [f32; 4],
    around: Surroundings,
) {
    let [l, t, r, b] = place;
    let share = |at: u32, length: u32, low: f32, high: f32| {
        ((at as f32 + 0.5) / length as f32 - low) / (high - low).max(f32::EPSILON)
    };
    let inside: Vec<bool> = (0..height)
        .flat_map(|y| (0..width).map(move |x| (x, y)))
        .map(|(x, y)| mask.contains((share(x, width, l, r), share(y, height, t, b))))
        .collect();
    let is_inside = |x: i64, y: i64| {
        (0..i64::from(width)).contains(&x)
            && (0..i64::from(height)).contains(&y)
            && inside[(y * i64::from(width) + x) as usize]
    };
    if around == Surroundings::Dimmed {
        for y in 0..height {
            for x in (0..width).filter(|x| !is_inside(i64::from(*x), i64::from(y))) {
                let pixel = picture.get_pixel_mut(left + x, top + y);
                pixel.0 = pixel.0.map(|v| (f32::from(v) * DIMMED) as u8);
            }
        }
    }
    let unit = line_unit_px(width, height);
    let reach = i64::from(outline_reach(width, height));
    let disc: Vec<(i64, i64, f32)> = (-reach..=reach)
        .flat_map(|y| (-reach..=reach).map(move |x| (x, y, ((x * x + y * y) as f32).sqrt())))
        .filter(|(_, _, distance)| *distance > 0.0 && *distance <= BOTH_WIDTH * unit)
        .collect();
    // Distance of each outside pixel to the mask. Only pixels at the mask's border need to be
    // expanded.
    let mut nearest = vec![f32::INFINITY; inside.len()];
    for (x, y) in (0..i64::from(height)).flat_map(|y| (0..i64::from(width)).map(move |x| (x, y))) {
        let at_rim =
            [(1, 0), (-1, 0), (0, 1), (0, -1)].iter().any(|(dx, dy)| !is_inside(x + dx, y + dy));
        if !is_inside(x, y) || !at_rim {
            continue;
        }
        for (dx, dy, distance) in &disc {
            let (u, v) = (x + dx, y + dy);
            if (0..i64::from(width)).contains(&u)
                && (0..i64::from(height)).contains(&v)
                && !is_inside(u, v)
            {
                let known = &mut nearest[(v * i64::from(width) + u) as usize];
                *known = known.min(*distance);
            }
        }
    }
    for (i, distance) in (0..).zip(nearest).filter(|(_, distance)| distance.is_finite()) {
        let line = if distance <= LIGHT_WIDTH * unit { LIGHT } else { DARK };
        picture.put_pixel(left + i % width, top + i / width, line);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Draws a mask over the middle half of a picture of one color.
    fn drawn(ground: [u8; 3], around: Surroundings) -> RgbImage {
        let mut picture = RgbImage::from_pixel(120, 100, Rgb(ground));
        draw_outline(
            &mut picture,
            (10, 0, 100, 100),
            &CellMask::from_fn(8, 8, |_, _| true),
            [0.25, 0.25, 0.75, 0.75],
            around,
        );
        picture
    }

    #[test]
    fn outline_is_visible_on_any_background() {
        for ground in [[0; 3], [255; 3], [255, 240, 40], [128; 3]] {
            let picture = drawn(ground, Surroundings::Kept);
            let differs = |x: u32, y: u32| {
                picture.get_pixel(x, y).0.iter().zip(ground).any(|(a, b)| a.abs_diff(b) > 100)
            };
            for along in 40..80 {
                assert!(
                    (30..36).any(|x| differs(x, along - 10))
                        && (84..90).any(|x| differs(x, along - 10)),
                    "{ground:?} row {along}"
                );
                assert!(
                    (20..26).any(|y| differs(along, y)) && (74..80).any(|y| differs(along, y)),
                    "{ground:?} column {along}"
                );
            }
            assert_eq!(
                (picture.get_pixel(60, 50).0, picture.get_pixel(12, 3).0),
                (ground, ground),
                "pixels inside the mask and far away do not change"
            );
        }
    }

    #[test]
    fn surroundings_are_dimmed_only_within_the_area() {
        let picture = drawn([200; 3], Surroundings::Dimmed);
        assert_eq!(
            [(60, 50), (12, 3), (5, 50), (115, 50)].map(|(x, y)| picture.get_pixel(x, y).0[0]),
            [200, 132, 200, 200]
        );
    }

    #[test]
    fn mask_is_clipped_to_the_area() {
        let mut picture = RgbImage::from_pixel(60, 60, Rgb([90; 3]));
        draw_outline(
            &mut picture,
            (20, 20, 20, 20),
            &CellMask::from_fn(4, 4, |_, _| true),
            [0.5, 0.5, 1.5, 1.5],
            Surroundings::Kept,
        );
        let touched: Vec<_> = picture
            .enumerate_pixels()
            .filter(|(_, _, p)| p.0 != [90; 3])
            .map(|(x, y, _)| (x, y))
            .collect();
        assert!(
            !touched.is_empty()
                && touched.iter().all(|(x, y)| (20..40).contains(x) && (20..40).contains(y)),
            "{touched:?}"
        );
    }
}
