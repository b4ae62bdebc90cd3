//! Evidence pictures for people: for every view a crop, and the full frame with a red box; the
//! instance is outlined in both (paper: candidate visual evidence). Few of them are ever looked at,
//! so each is drawn on request. Models get collages, whose outlines are drawn at their own size:
//! [`uniground_render::Shot::from_view`].

use image::{Rgb, RgbImage};
use uniground_geometry::scene::{CellMask, View};
use uniground_render::{
    Surroundings, crop_area, cut_out_area, draw_outline, encode_jpeg, outline_reach, to_area_shares,
};

/// Selects one of the two pictures of a view.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Picture {
    /// The instance with a small margin: outlined, its surroundings dimmed.
    Crop,
    /// The whole photograph, with a red box around the outlined instance.
    Frame,
}

const RED: Rgb<u8> = Rgb([230, 20, 20]);

/// Draws one evidence picture of a view from its photograph, as JPEG.
#[must_use]
pub fn draw_picture(color: &RgbImage, seen: &View, picture: Picture) -> Vec<u8> {
    let mask = seen.mask.as_ref().and_then(CellMask::from_view_mask);
    let (area, around) = match picture {
        Picture::Crop => (crop_area(seen.box_px, color.dimensions()), Surroundings::Dimmed),
        Picture::Frame => ([0, 0, color.width(), color.height()], Surroundings::Kept),
    };
    let mut drawn = cut_out_area(color, area);
    let whole = (0, 0, drawn.width(), drawn.height());
    if let Some(mask) = &mask {
        draw_outline(&mut drawn, whole, mask, to_area_shares(seen.box_px, area), around);
    }
    if picture == Picture::Frame {
        // Enlarges the box so that the outline fits inside.
        let room = if mask.is_some() { outline_reach(whole.2, whole.3) } else { 0 };
        let [left, top, right, bottom] = seen.box_px;
        let boxed = [
            left.saturating_sub(room),
            top.saturating_sub(room),
            (right + room).min(whole.2),
            (bottom + room).min(whole.3),
        ];
        draw_box(&mut drawn, boxed);
    }
    encode_jpeg(&drawn)
}

/// Draws a red outline just outside the box, three pixels wide, clipped to the picture.
fn draw_box(image: &mut RgbImage, [left, top, right, bottom]: [u32; 4]) {
    const WIDTH: i64 = 3;
    let (w, h) = (i64::from(image.width()), i64::from(image.height()));
    let [l, t, r, b] = [left, top, right, bottom].map(i64::from);
    let mut put = |x: i64, y: i64| {
        if (0..w).contains(&x) && (0..h).contains(&y) {
            image.put_pixel(x as u32, y as u32, RED);
        }
    };
    for k in 1..=WIDTH {
        for x in l - k..r + k {
            // At the picture's border the outline moves inside, so that it stays visible.
            put(x, (t - k).max(WIDTH - k));
            put(x, (b - 1 + k).min(h - 1 - (WIDTH - k)));
        }
        for y in t - k..b + k {
            put((l - k).max(WIDTH - k), y);
            put((r - 1 + k).min(w - 1 - (WIDTH - k)), y);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use uniground_geometry::scene::FrameIndex;

    #[test]
    fn frame_has_a_red_box_and_both_pictures_outline_the_object() {
        let color = RgbImage::from_pixel(400, 300, Rgb([90, 90, 90]));
        let mask = CellMask::from_fn(8, 8, |column, row| column + row < 8).to_view_mask();
        let seen = View {
            frame: FrameIndex(0),
            visible_points: 9,
            box_px: [100, 100, 180, 180],
            mask: Some(mask),
        };
        let decoded =
            |of| image::load_from_memory(&draw_picture(&color, &seen, of)).unwrap().into_rgb8();
        let (crop, frame) = (decoded(Picture::Crop), decoded(Picture::Frame));
        assert_eq!((crop.dimensions(), frame.dimensions()), ((224, 224), (400, 300)));
        let reddish = |p: &Rgb<u8>| p.0[0] > 150 && p.0[1] < 110;
        let yellowish = |p: &&Rgb<u8>| p.0[0] > 150 && p.0[1] > 150 && p.0[2] < 130;
        assert!(
            reddish(frame.get_pixel(94, 140))
                && reddish(frame.get_pixel(140, 94))
                && !reddish(frame.get_pixel(120, 120))
        );
        assert!(
            frame.pixels().filter(yellowish).count() > 80
                && crop.pixels().filter(yellowish).count() > 80
        );
        assert!(
            crop.pixels().all(|p| !reddish(p)) && crop.get_pixel(2, 2).0[0] < 70,
            "surroundings are dimmed"
        );
    }

    #[test]
    fn box_at_the_picture_border_stays_visible() {
        let mut image = RgbImage::new(20, 20);
        draw_box(&mut image, [0, 0, 20, 20]);
        assert_eq!((*image.get_pixel(0, 10), *image.get_pixel(19, 10)), (RED, RED));
        assert_ne!(*image.get_pixel(10, 10), RED);
    }
}
