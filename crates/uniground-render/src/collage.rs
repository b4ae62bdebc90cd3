//! A collage of one candidate: up to three close crops with the whole photographs beneath, and a
//! tag with its id (paper: candidate visual evidence). Outlines are drawn after shrinking, because
//! lines of a large photograph would become thinner than a pixel.

use super::outline::{Surroundings, draw_outline, outline_reach};
use super::shot::Shot;
use super::text;
use image::{Rgb, RgbImage, imageops};
use uniground_geometry::resize::{Filter, resize};
use uniground_geometry::scene::FrameIndex;

/// Size limits of collages. 1024 x 512 pixels are two of the tiles that providers charge for.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Collage {
    /// Maximum number of pixels of a collage with three shots; fewer shots make it narrower.
    pub max_pixels: u32,
    /// Maximum number of shots. Paper: 3.
    pub max_shots: usize,
}

impl Default for Collage {
    fn default() -> Self {
        Self { max_pixels: 1024 * 512, max_shots: 3 }
    }
}

pub(super) const SHEET: Rgb<u8> = Rgb([245; 3]);
const RED: Rgb<u8> = Rgb([230, 20, 20]);
const TAG: Rgb<u8> = Rgb([20, 30, 60]);
/// Height of the tag, as a share of the sheet's height.
const TAG_SHARE: f32 = 0.0625;
const CROP_SHARE: f32 = 0.5;
const GAP_PX: u32 = 4;

/// The position of a photograph, or of a piece of one, in a composed picture.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Tile {
    /// Position in the composed picture: left, top, width, height, pixels.
    pub area: Area,
    /// The frame it was taken with.
    pub frame: FrameIndex,
    /// The part of the frame's color picture that it shows: left, top, right, bottom, pixels.
    pub shows: [u32; 4],
}

/// Part of a picture: left, top, width, height, pixels.
pub type Area = (u32, u32, u32, u32);

impl Tile {
    /// Converts a position of the composed picture to column and row of the frame's color picture;
    /// `None` outside of the tile.
    #[must_use]
    pub fn to_photograph(&self, at: (f32, f32)) -> Option<(f32, f32)> {
        let share = self.share(at);
        let inside = (0.0..=1.0).contains(&share.0) && (0.0..=1.0).contains(&share.1);
        inside.then(|| self.at_share(share))
    }

    /// Converts the nearest position of the tile in the same way.
    #[must_use]
    pub fn nearest_in_photograph(&self, at: (f32, f32)) -> (f32, f32) {
        let (x, y) = self.share(at);
        self.at_share((x.clamp(0.0, 1.0), y.clamp(0.0, 1.0)))
    }

    fn share(&self, (x, y): (f32, f32)) -> (f32, f32) {
        let (left, top, width, height) = self.area;
        ((x - left as f32) / width as f32, (y - top as f32) / height as f32)
    }

    fn at_share(&self, (x, y): (f32, f32)) -> (f32, f32) {
        let [l, t, r, b] = self.shows.map(|v| v as f32);
        (l + x * (r - l), t + y * (b - t))
    }
}

/// The positions of all elements on a collage.
struct Layout {
    size: (u32, u32),
    tag_height: u32,
    /// The crop and the photograph of each shot.
    areas: Vec<[Area; 2]>,
}

impl Collage {
    fn layout(&self, shots: &[Shot]) -> Layout {
        let height = ((self.max_pixels as f32 / 2.0).sqrt() as u32).clamp(64, 4096);
        let cell = match shots.len() {
            0 | 1 => height,
            2 => height * 3 / 4,
            count => height * 2 / count as u32,
        };
        let tag_height = ((height as f32 * TAG_SHARE) as u32).max(18);
        let crop_height = ((height - tag_height) as f32 * CROP_SHARE) as u32;
        let top = tag_height + crop_height;
        let areas = |(shot, x): (&Shot, u32)| {
            let crop = fit_area(
                shot.crop.dimensions(),
                (x, tag_height),
                (cell - GAP_PX, crop_height - GAP_PX),
            );
            [crop, fit_area(shot.frame.dimensions(), (x, top), (cell - GAP_PX, height - top))]
        };
        let areas = shots.iter().zip((0..).map(|i| i * cell)).map(areas).collect();
        Layout { size: (cell * shots.len().max(1) as u32, height), tag_height, areas }
    }

    fn select_shots<'a>(&self, shots: &'a [Shot]) -> &'a [Shot] {
        &shots[..shots.len().min(self.max_shots)]
    }

    /// Returns the positions of the photographs on the collage of these shots. Only shots taken
    /// with a frame have one.
    #[must_use]
    pub fn tiles(&self, shots: &[Shot]) -> Vec<Tile> {
        let shots = self.select_shots(shots);
        let tiles = |(shot, [crop, whole]): (&Shot, [Area; 2])| {
            let (width, height) = shot.frame.dimensions();
            let both = |(frame, shows)| {
                [
                    Tile { area: crop, frame, shows },
                    Tile { area: whole, frame, shows: [0, 0, width, height] },
                ]
            };
            shot.taken.map(both)
        };
        shots.iter().zip(self.layout(shots).areas).filter_map(tiles).flatten().collect()
    }

    /// Draws a collage. Without shots, it draws only the tag, which states that there are none.
    #[must_use]
    pub fn draw(&self, id: u32, shots: &[Shot]) -> RgbImage {
        let shots = self.select_shots(shots);
        let Layout { size, tag_height, areas } = self.layout(shots);
        let mut sheet = RgbImage::from_pixel(size.0, size.1, SHEET);
        let tag = if shots.is_empty() {
            format!("ID {id}: no photograph shows it")
        } else {
            format!("ID {id}")
        };
        self::draw_tag(&mut sheet, (0, 0), tag_height, &tag);
        for (shot, [crop, area]) in shots.iter().zip(areas) {
            draw_crop(&mut sheet, shot, crop);
            paste(&mut sheet, &shot.frame, area);
            let (left, upper, width, height) = area;
            let at = |share: f32, length: u32| share * length as f32;
            let [l, t, r, b] = shot.place;
            // Space between the box and the object for the outline.
            let mut room = 0.0;
            if let Some((mask, _)) = &shot.mask {
                draw_outline(&mut sheet, area, mask, shot.place, Surroundings::Kept);
                room = outline_reach(width, height) as f32;
            }
            let corner = |x: f32, y: f32, room: f32| {
                (left as f32 + at(x, width) + room, upper as f32 + at(y, height) + room)
            };
            draw_red_box(&mut sheet, area, corner(l, t, -room), corner(r, b, room));
        }
        sheet
    }
}

/// Draws many candidates on one sheet, one crop each, so that they can be named together.
#[must_use]
pub fn draw_mosaic(tiles: &[(u32, &Shot)], columns: u32, tile_px: u32) -> RgbImage {
    let rows = (tiles.len() as u32).div_ceil(columns.max(1)).max(1);
    let mut sheet = RgbImage::from_pixel(columns * tile_px, rows * tile_px, SHEET);
    let tag_height = (tile_px / 7).max(14);
    for ((id, shot), (x, y)) in tiles.iter().zip(cell_corners(columns, tile_px)) {
        draw_crop(&mut sheet, shot, mosaic_area(shot, (x, y), tile_px));
        draw_tag(&mut sheet, (x, y), tag_height, &format!("ID {id}"));
    }
    sheet
}

/// Returns the positions of the photographs on a [`draw_mosaic`] of these shots. Only shots taken with a
/// frame have one.
#[must_use]
pub fn mosaic_tiles(shots: &[&Shot], columns: u32, tile_px: u32) -> Vec<Tile> {
    let tile = |(shot, corner): (&&Shot, (u32, u32))| {
        let (frame, shows) = shot.taken?;
        Some(Tile { area: mosaic_area(shot, corner, tile_px), frame, shows })
    };
    shots.iter().zip(cell_corners(columns, tile_px)).filter_map(tile).collect()
}

/// Returns the top left corners of the cells of a mosaic, row by row.
fn cell_corners(columns: u32, tile_px: u32) -> impl Iterator<Item = (u32, u32)> {
    (0..).map(move |i: u32| (i % columns.max(1) * tile_px, i / columns.max(1) * tile_px))
}

fn mosaic_area(shot: &Shot, (x, y): (u32, u32), tile_px: u32) -> Area {
    let tag_height = (tile_px / 7).max(14);
    fit_area(
        shot.crop.dimensions(),
        (x, y + tag_height),
        (tile_px - GAP_PX, tile_px - tag_height - GAP_PX),
    )
}

/// Draws white letters on dark, left aligned.
pub(super) fn draw_tag(sheet: &mut RgbImage, (x, y): (u32, u32), height: u32, words: &str) {
    let size_px = height as f32 * 0.78;
    let width = (text::width(words, size_px) as u32 + 12).min(sheet.width() - x);
    for (u, v) in (x..x + width).flat_map(|u| (y..y + height).map(move |v| (u, v))) {
        sheet.put_pixel(u, v, TAG);
    }
    text::draw(
        sheet,
        words,
        x as f32 + 6.0,
        y as f32 + height as f32 * 0.04,
        size_px,
        Rgb([255; 3]),
    );
}

/// Draws the crop of a shot into an area, with its object outlined and the surroundings dimmed.
fn draw_crop(sheet: &mut RgbImage, shot: &Shot, area: Area) {
    paste(sheet, &shot.crop, area);
    if let Some((mask, place)) = &shot.mask {
        draw_outline(sheet, area, mask, *place, Surroundings::Dimmed);
    }
}

pub(super) fn paste(sheet: &mut RgbImage, picture: &RgbImage, (left, top, width, height): Area) {
    imageops::replace(
        sheet,
        &resize(picture, (width, height), Filter::Bilinear),
        i64::from(left),
        i64::from(top),
    );
}

/// Returns the largest centered area of a cell in which a picture of this size fits.
fn fit_area(picture: (u32, u32), (x, y): (u32, u32), (width, height): (u32, u32)) -> Area {
    /// Maximum enlargement of tiny crops: they have no more detail to show.
    const MAX_ENLARGED: f32 = 4.0;
    let scale =
        (width as f32 / picture.0 as f32).min(height as f32 / picture.1 as f32).min(MAX_ENLARGED);
    let side = |length: u32, room: u32| ((length as f32 * scale).round() as u32).clamp(1, room);
    let size = (side(picture.0, width), side(picture.1, height));
    (x + (width - size.0) / 2, y + (height - size.1) / 2, size.0, size.1)
}

/// Draws a red outline just outside of a box, three pixels wide, clipped to the box's picture.
fn draw_red_box(
    sheet: &mut RgbImage,
    (left, top, width, height): (u32, u32, u32, u32),
    low: (f32, f32),
    high: (f32, f32),
) {
    const WIDTH_PX: i64 = 3;
    let inside_x = |x: f32| {
        (x.round() as i64).clamp(i64::from(left) + WIDTH_PX, i64::from(left + width) - WIDTH_PX)
    };
    let inside_y = |y: f32| {
        (y.round() as i64).clamp(i64::from(top) + WIDTH_PX, i64::from(top + height) - WIDTH_PX)
    };
    let (l, t, r, b) = (inside_x(low.0), inside_y(low.1), inside_x(high.0), inside_y(high.1));
    let mut draw_pixel = |x: i64, y: i64| {
        if let (Ok(x), Ok(y)) = (u32::try_from(x), u32::try_from(y))
            && x < sheet.width()
            && y < sheet.height()
        {
            sheet.put_pixel(x, y, RED);
        }
    };
    for k in 1..=WIDTH_PX {
        for x in l - k..r + k {
            draw_pixel(x, t - k);
            draw_pixel(x, b - 1 + k);
        }
        for y in t - k..b + k {
            draw_pixel(l - k, y);
            draw_pixel(r - 1 + k, y);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use uniground_geometry::scene::{CellMask, View};

    fn shot(width: u32, height: u32) -> Shot {
        Shot {
            crop: RgbImage::from_pixel(60, 90, Rgb([90, 140, 90])),
            frame: RgbImage::from_pixel(width, height, Rgb([120, 120, 120])),
            place: [0.25, 0.25, 0.5, 0.75],
            mask: None,
            taken: None,
        }
    }

    /// Returns the relative luminance (WCAG).
    fn luminance(p: &Rgb<u8>) -> f32 {
        let linear = |c: u8| {
            let c = f32::from(c) / 255.0;
            if c <= 0.039_28 { c / 12.92 } else { ((c + 0.055) / 1.055).powf(2.4) }
        };
        0.2126 * linear(p.0[0]) + 0.7152 * linear(p.0[1]) + 0.0722 * linear(p.0[2])
    }

    #[test]
    fn collage_size_is_bounded_for_any_photographs() {
        for (count, width) in [(1, 512), (2, 768), (3, 1023)] {
            for frame in [(640, 480), (1296, 968), (4000, 300)] {
                let shots = vec![shot(frame.0, frame.1); count];
                let collage = Collage::default().draw(22, &shots);
                assert_eq!(collage.dimensions(), (width, 512));
            }
        }
        let small = Collage { max_pixels: 200_000, ..Collage::default() }
            .draw(22, &vec![shot(640, 480); 5]);
        assert!(small.width() * small.height() <= 200_000, "{:?}", small.dimensions());
        let single =
            Collage { max_shots: 1, ..Collage::default() }.draw(22, &vec![shot(640, 480); 3]);
        assert_eq!(single.dimensions(), (512, 512));
    }

    /// The model's input: letters at least 16 pixels tall with a contrast of at least 7 : 1 (WCAG
    /// AAA), and a red outline at the object, also on a photograph four times as large.
    #[test]
    fn label_is_readable_and_box_is_drawn() {
        for frame in [(640, 480), (2560, 1920)] {
            let collage = Collage::default().draw(22, &vec![shot(frame.0, frame.1); 3]);
            let rows: Vec<u32> = (0..32)
                .filter(|&y| (0..90).any(|x| luminance(collage.get_pixel(x, y)) > 0.8))
                .collect();
            let tall = rows.last().unwrap() - rows.first().unwrap() + 1;
            let ground = luminance(collage.get_pixel(1, 1));
            assert!(tall >= 16 && (1.05) / (ground + 0.05) >= 7.0, "{tall} {ground}");
            let red: Vec<(u32, u32)> = collage
                .enumerate_pixels()
                .filter(|(_, _, p)| **p == RED)
                .map(|(x, y, _)| (x, y))
                .collect();
            let of_first: Vec<_> = red.iter().filter(|(x, _)| *x < 341).collect();
            let (low, high) = (
                of_first.iter().map(|p| p.0).min().unwrap(),
                of_first.iter().map(|p| p.0).max().unwrap(),
            );
            // The frame is 320 x 240 in the cell: a quarter to a half of it, plus the line.
            assert!(
                (high - low).abs_diff(85) <= 10 && red.len() > 1000,
                "{low} {high} {}",
                red.len()
            );
        }
    }

    #[test]
    fn mosaic_contains_every_tile() {
        let red = Shot { crop: RgbImage::from_pixel(40, 40, Rgb([200, 40, 40])), ..shot(64, 48) };
        let tiles: Vec<(u32, &Shot)> = (1..=7).map(|id| (id, &red)).collect();
        let sheet = draw_mosaic(&tiles, 4, 170);
        assert_eq!(sheet.dimensions(), (680, 340));
        let red =
            |i: u32| *sheet.get_pixel(i % 4 * 170 + 85, i / 4 * 170 + 95) == Rgb([200, 40, 40]);
        assert!((0..7).all(red) && !red(7));
    }

    /// The crop has the outline of the mask and dimmed surroundings. The photograph has the outline
    /// and its box, and no dimming.
    #[test]
    fn object_with_a_mask_is_outlined_and_its_surroundings_dimmed() {
        let mask = CellMask::from_fn(4, 4, |column, _| column < 2);
        let shot = Shot { mask: Some((mask, [0.25, 0.25, 0.75, 0.75])), ..shot(640, 480) };
        let collage =
            Collage { max_shots: 1, ..Collage::default() }.draw(22, std::slice::from_ref(&shot));
        let plain =
            Collage { max_shots: 1, ..Collage::default() }.draw(22, &[Shot { mask: None, ..shot }]);
        let changed = |rows: std::ops::Range<u32>, is: fn(&Rgb<u8>) -> bool| {
            let pixels = rows.flat_map(|y| (0..collage.width()).map(move |x| (x, y)));
            pixels
                .filter(|&(x, y)| {
                    collage.get_pixel(x, y) != plain.get_pixel(x, y) && is(collage.get_pixel(x, y))
                })
                .count()
        };
        let (crop, frame, dim) = (32..270, 275..512, |p: &Rgb<u8>| p.0 == [59, 92, 59]);
        assert!(
            changed(crop.clone(), dim) > 10_000
                && changed(crop, |p| p.0[0] > 200 && p.0[2] < 90) > 200
        );
        assert!(changed(frame.clone(), |p| p.0[0] > 200 && p.0[1] > 200 && p.0[2] < 90) > 200);
        assert!(
            frame
                .flat_map(|y| (0..512).map(move |x| (x, y)))
                .all(|(x, y)| collage.get_pixel(x, y).0 != [79; 3]),
            "the photograph is not dimmed"
        );
    }

    /// A mark in a photograph is found again from its position on the collage and on the sheet, in
    /// the crop and in the whole.
    #[test]
    fn positions_on_a_collage_map_back_to_the_photograph() {
        let mut photograph = RgbImage::from_pixel(640, 480, Rgb([120; 3]));
        for (x, y) in (310..330).flat_map(|x| (210..230).map(move |y| (x, y))) {
            photograph.put_pixel(x, y, Rgb([20, 220, 30]));
        }
        let view = View {
            frame: FrameIndex(7),
            visible_points: 9,
            box_px: [250, 180, 400, 300],
            mask: None,
        };
        let shots =
            vec![Shot { taken: None, ..shot(640, 480) }, Shot::from_view(photograph, &view)];
        let collage = Collage::default();
        let marks = |picture: &RgbImage, tiles: &[Tile]| {
            let green = |p: &Rgb<u8>| p.0[1] > 150 && p.0[0] < 80;
            let marked = picture
                .enumerate_pixels()
                .filter(|(_, _, p)| green(p))
                .map(|(x, y, _)| (x as f32 + 0.5, y as f32 + 0.5));
            let found: Vec<(f32, f32)> = marked
                .filter_map(|at| tiles.iter().find_map(|tile| tile.to_photograph(at)))
                .collect();
            assert!(
                found.iter().all(|(x, y)| (x - 320.0).abs() < 16.0 && (y - 220.0).abs() < 16.0),
                "{found:?}"
            );
            found.len()
        };
        let tiles = collage.tiles(&shots);
        assert!(tiles.len() == 2 && tiles.iter().all(|tile| tile.frame.0 == 7));
        assert!(marks(&collage.draw(3, &shots), &tiles) > 500);
        let [first, second] = &shots[..] else { panic!("expected two shots") };
        assert!(
            marks(
                &draw_mosaic(&[(1, first), (2, second)], 1, 170),
                &mosaic_tiles(&[first, second], 1, 170)
            ) > 100
        );
    }

    #[test]
    fn collage_without_photographs_has_a_tag() {
        let collage = Collage::default().draw(5, &[]);
        assert!(collage.pixels().any(|p| luminance(p) < 0.05));
    }
}
