//! What one candidate looks like: up to three close crops with the whole photographs beneath, and a tag with its id (paper: candidate
//! visual evidence). Outlines are drawn after shrinking: lines of a large photograph would be thinner than a pixel.

use super::outline::{Around, draw_outline, outline_reach};
use super::shot::Shot;
use super::text;
use fast_image_resize::images::Image;
use fast_image_resize::{FilterType, PixelType, ResizeAlg, ResizeOptions, Resizer};
use image::{Rgb, RgbImage, imageops};

/// How large collages are. 1024 x 512 pixels are two of the tiles providers charge for.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Collage {
    /// Most pixels a collage of three shots has; ones with fewer shots are narrower.
    pub max_pixels: u32,
    /// Paper: 3.
    pub max_shots: usize,
}

impl Default for Collage {
    fn default() -> Self {
        Self { max_pixels: 1024 * 512, max_shots: 3 }
    }
}

const SHEET: Rgb<u8> = Rgb([245; 3]);
const RED: Rgb<u8> = Rgb([230, 20, 20]);
const TAG: Rgb<u8> = Rgb([20, 30, 60]);
/// Height of the tag, as a share of the sheet's.
const TAG_SHARE: f32 = 0.0625;
const CROP_SHARE: f32 = 0.5;
const GAP_PX: u32 = 4;

impl Collage {
    /// Draws a collage; without shots only the tag, which says so.
    #[must_use]
    pub fn draw(&self, id: u32, shots: &[Shot]) -> RgbImage {
        let height = ((self.max_pixels as f32 / 2.0).sqrt() as u32).clamp(64, 4096);
        let shots = &shots[..shots.len().min(self.max_shots)];
        let cell = match shots.len() {
            0 | 1 => height,
            2 => height * 3 / 4,
            count => height * 2 / count as u32,
        };
        let mut sheet = RgbImage::from_pixel(cell * shots.len().max(1) as u32, height, SHEET);
        let tag_height = ((height as f32 * TAG_SHARE) as u32).max(18);
        let tag = if shots.is_empty() { format!("ID {id}: no photograph shows it") } else { format!("ID {id}") };
        self::tag(&mut sheet, (0, 0), tag_height, &tag);
        let crop_height = ((height - tag_height) as f32 * CROP_SHARE) as u32;
        for (i, shot) in shots.iter().enumerate() {
            let x = i as u32 * cell;
            place_crop(&mut sheet, shot, (x, tag_height), (cell - GAP_PX, crop_height - GAP_PX));
            let top = tag_height + crop_height;
            let (left, upper, fitted) = place(&mut sheet, &shot.frame, (x, top), (cell - GAP_PX, height - top));
            let at = |share: f32, length: u32| share * length as f32;
            let [l, t, r, b] = shot.place;
            let area = (left, upper, fitted.0, fitted.1);
            // The box leaves room for the outline.
            let mut room = 0.0;
            if let Some((mask, _)) = &shot.mask {
                draw_outline(&mut sheet, area, mask, shot.place, Around::Kept);
                room = outline_reach(fitted.0, fitted.1) as f32;
            }
            let corner = |x: f32, y: f32, room: f32| (left as f32 + at(x, fitted.0) + room, upper as f32 + at(y, fitted.1) + room);
            red_box(&mut sheet, area, corner(l, t, -room), corner(r, b, room));
        }
        sheet
    }
}

/// Many candidates on one sheet, one crop each, to be named together.
#[must_use]
pub fn mosaic(tiles: &[(u32, &Shot)], columns: u32, tile_px: u32) -> RgbImage {
    let rows = (tiles.len() as u32).div_ceil(columns.max(1)).max(1);
    let mut sheet = RgbImage::from_pixel(columns * tile_px, rows * tile_px, SHEET);
    let tag_height = (tile_px / 7).max(14);
    for (i, (id, shot)) in tiles.iter().enumerate() {
        let (x, y) = (i as u32 % columns * tile_px, i as u32 / columns * tile_px);
        place_crop(&mut sheet, shot, (x, y + tag_height), (tile_px - GAP_PX, tile_px - tag_height - GAP_PX));
        tag(&mut sheet, (x, y), tag_height, &format!("ID {id}"));
    }
    sheet
}

/// White letters on dark, left aligned.
fn tag(sheet: &mut RgbImage, (x, y): (u32, u32), height: u32, words: &str) {
    let size_px = height as f32 * 0.78;
    let width = (text::width(words, size_px) as u32 + 12).min(sheet.width() - x);
    for (u, v) in (x..x + width).flat_map(|u| (y..y + height).map(move |v| (u, v))) {
        sheet.put_pixel(u, v, TAG);
    }
    text::draw(sheet, words, x as f32 + 6.0, y as f32 + height as f32 * 0.04, size_px, Rgb([255; 3]));
}

/// Puts the crop of a shot into a cell, its object outlined and the surroundings dimmed.
fn place_crop(sheet: &mut RgbImage, shot: &Shot, at: (u32, u32), room: (u32, u32)) {
    let (left, top, (width, height)) = place(sheet, &shot.crop, at, room);
    if let Some((mask, place)) = &shot.mask {
        draw_outline(sheet, (left, top, width, height), mask, *place, Around::Dimmed);
    }
}

/// Puts a picture into the middle of a cell, as large as it fits; returns where it landed and its size there.
fn place(sheet: &mut RgbImage, picture: &RgbImage, (x, y): (u32, u32), (width, height): (u32, u32)) -> (u32, u32, (u32, u32)) {
    /// Tiny crops are not blown up beyond this: there is nothing more to see.
    const MAX_ENLARGED: f32 = 4.0;
    let scale = (width as f32 / picture.width() as f32)
        .min(height as f32 / picture.height() as f32)
        .min(MAX_ENLARGED);
    let side = |length: u32, room: u32| ((length as f32 * scale).round() as u32).clamp(1, room);
    let size = (side(picture.width(), width), side(picture.height(), height));
    let (left, top) = (x + (width - size.0) / 2, y + (height - size.1) / 2);
    imageops::replace(sheet, &resized(picture, size), i64::from(left), i64::from(top));
    (left, top, size)
}

fn resized(picture: &RgbImage, (width, height): (u32, u32)) -> RgbImage {
    if picture.dimensions() == (width, height) {
        return picture.clone();
    }
    let source = Image::from_vec_u8(picture.width(), picture.height(), picture.as_raw().clone(), PixelType::U8x3);
    let mut target = Image::new(width, height, PixelType::U8x3);
    let options = ResizeOptions::new().resize_alg(ResizeAlg::Convolution(FilterType::Bilinear));
    let done = source.ok().and_then(|source| Resizer::new().resize(&source, &mut target, &options).ok());
    done.and_then(|()| RgbImage::from_raw(width, height, target.into_vec()))
        .unwrap_or_else(|| imageops::resize(picture, width, height, imageops::FilterType::Triangle))
}

/// A red outline just outside of a box, three pixels wide, clipped to the picture it belongs to.
fn red_box(sheet: &mut RgbImage, (left, top, width, height): (u32, u32, u32, u32), low: (f32, f32), high: (f32, f32)) {
    const WIDTH_PX: i64 = 3;
    let inside_x = |x: f32| (x.round() as i64).clamp(i64::from(left) + WIDTH_PX, i64::from(left + width) - WIDTH_PX);
    let inside_y = |y: f32| (y.round() as i64).clamp(i64::from(top) + WIDTH_PX, i64::from(top + height) - WIDTH_PX);
    let (l, t, r, b) = (inside_x(low.0), inside_y(low.1), inside_x(high.0), inside_y(high.1));
    let mut put = |x: i64, y: i64| {
        if let (Ok(x), Ok(y)) = (u32::try_from(x), u32::try_from(y))
            && x < sheet.width()
            && y < sheet.height()
        {
            sheet.put_pixel(x, y, RED);
        }
    };
    for k in 1..=WIDTH_PX {
        for x in l - k..r + k {
            put(x, t - k);
            put(x, b - 1 + k);
        }
        for y in t - k..b + k {
            put(l - k, y);
            put(r - 1 + k, y);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scene::CellMask;

    fn shot(width: u32, height: u32) -> Shot {
        Shot {
            crop: RgbImage::from_pixel(60, 90, Rgb([90, 140, 90])),
            frame: RgbImage::from_pixel(width, height, Rgb([120, 120, 120])),
            place: [0.25, 0.25, 0.5, 0.75],
            mask: None,
        }
    }

    /// Relative luminance (WCAG).
    fn luminance(p: &Rgb<u8>) -> f32 {
        let linear = |c: u8| {
            let c = f32::from(c) / 255.0;
            if c <= 0.039_28 { c / 12.92 } else { ((c + 0.055) / 1.055).powf(2.4) }
        };
        0.2126 * linear(p.0[0]) + 0.7152 * linear(p.0[1]) + 0.0722 * linear(p.0[2])
    }

    #[test]
    fn sizes_are_bounded_whatever_the_photographs() {
        for (count, width) in [(1, 512), (2, 768), (3, 1023)] {
            for frame in [(640, 480), (1296, 968), (4000, 300)] {
                let shots = vec![shot(frame.0, frame.1); count];
                let collage = Collage::default().draw(22, &shots);
                assert_eq!(collage.dimensions(), (width, 512));
            }
        }
        let small = Collage { max_pixels: 200_000, ..Collage::default() }.draw(22, &vec![shot(640, 480); 5]);
        assert!(small.width() * small.height() <= 200_000, "{:?}", small.dimensions());
        let single = Collage { max_shots: 1, ..Collage::default() }.draw(22, &vec![shot(640, 480); 3]);
        assert_eq!(single.dimensions(), (512, 512));
    }

    /// What the model gets: letters at least 16 pixels tall with a contrast of at least 7 : 1 (WCAG AAA), and a red outline where the
    /// object is, also on a photograph four times as large.
    #[test]
    fn the_label_is_readable_and_the_box_is_there() {
        for frame in [(640, 480), (2560, 1920)] {
            let collage = Collage::default().draw(22, &vec![shot(frame.0, frame.1); 3]);
            let rows: Vec<u32> = (0..32).filter(|&y| (0..90).any(|x| luminance(collage.get_pixel(x, y)) > 0.8)).collect();
            let tall = rows.last().unwrap() - rows.first().unwrap() + 1;
            let ground = luminance(collage.get_pixel(1, 1));
            assert!(tall >= 16 && (1.05) / (ground + 0.05) >= 7.0, "{tall} {ground}");
            let red: Vec<(u32, u32)> = collage.enumerate_pixels().filter(|(_, _, p)| **p == RED).map(|(x, y, _)| (x, y)).collect();
            let of_first: Vec<_> = red.iter().filter(|(x, _)| *x < 341).collect();
            let (low, high) = (of_first.iter().map(|p| p.0).min().unwrap(), of_first.iter().map(|p| p.0).max().unwrap());
            // The frame is 320 x 240 in the cell: a quarter to a half of it, plus the line.
            assert!((high - low).abs_diff(85) <= 10 && red.len() > 1000, "{low} {high} {}", red.len());
        }
    }

    #[test]
    fn a_mosaic_holds_every_tile() {
        let red = Shot { crop: RgbImage::from_pixel(40, 40, Rgb([200, 40, 40])), ..shot(64, 48) };
        let tiles: Vec<(u32, &Shot)> = (1..=7).map(|id| (id, &red)).collect();
        let sheet = mosaic(&tiles, 4, 170);
        assert_eq!(sheet.dimensions(), (680, 340));
        let red = |i: u32| *sheet.get_pixel(i % 4 * 170 + 85, i / 4 * 170 + 95) == Rgb([200, 40, 40]);
        assert!((0..7).all(red) && !red(7));
    }

    /// The crop has the outline where the mask is and dimmed surroundings, the photograph the outline beside its box and no dimming.
    #[test]
    fn an_object_whose_mask_is_known_stands_out() {
        let mask = CellMask::of(4, 4, |column, _| column < 2);
        let shot = Shot { mask: Some((mask, [0.25, 0.25, 0.75, 0.75])), ..shot(640, 480) };
        let collage = Collage { max_shots: 1, ..Collage::default() }.draw(22, std::slice::from_ref(&shot));
        let plain = Collage { max_shots: 1, ..Collage::default() }.draw(22, &[Shot { mask: None, ..shot }]);
        let changed = |rows: std::ops::Range<u32>, is: fn(&Rgb<u8>) -> bool| {
            let pixels = rows.flat_map(|y| (0..collage.width()).map(move |x| (x, y)));
            pixels
                .filter(|&(x, y)| collage.get_pixel(x, y) != plain.get_pixel(x, y) && is(collage.get_pixel(x, y)))
                .count()
        };
        let (crop, frame, dim) = (32..270, 275..512, |p: &Rgb<u8>| p.0 == [59, 92, 59]);
        assert!(changed(crop.clone(), dim) > 10_000 && changed(crop, |p| p.0[0] > 200 && p.0[2] < 90) > 200);
        assert!(changed(frame.clone(), |p| p.0[0] > 200 && p.0[1] > 200 && p.0[2] < 90) > 200);
        assert!(
            frame.flat_map(|y| (0..512).map(move |x| (x, y))).all(|(x, y)| collage.get_pixel(x, y).0 != [79; 3]),
            "nothing is dimmed"
        );
    }

    #[test]
    fn without_photographs_the_tag_says_so() {
        let collage = Collage::default().draw(5, &[]);
        assert!(collage.pixels().any(|p| luminance(p) < 0.05));
    }
}
