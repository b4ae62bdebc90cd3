//! Paints masks into one id image on the depth grid.

use super::super::IdImage;
use super::{GRID, MaskCandidate, MaskOrder, SamSettings};
use uniground_geometry::scene::Frame;
use uniground_models::neural::{LowMask, Segmenter};

/// Masks larger than this do not cover their parts: they are walls, or several things at once.
/// Share of the picture.
const LARGEST_WHOLE: f32 = 0.25;

/// Paints overlapping masks, sorted best first: in the order of the settings and, if configured, a
/// second time with wholes over their parts.
pub(super) fn paint(
    masks: &[MaskCandidate],
    segmenter: &Segmenter,
    settings: &SamSettings,
    frame: &Frame,
) -> Vec<IdImage> {
    let mut ordered: Vec<&MaskCandidate> = masks.iter().rev().collect();
    if settings.order == MaskOrder::LargerFirst {
        ordered = masks.iter().collect();
        ordered.sort_by_key(|mask| std::cmp::Reverse(mask.area));
    }
    let mut images = vec![paint_image(&ordered, segmenter, frame)];
    if settings.wholes {
        let largest = LARGEST_WHOLE * (GRID * GRID) as f32;
        ordered = masks.iter().filter(|mask| mask.area as f32 <= largest).collect();
        ordered.sort_by_key(|mask| mask.area);
        images.push(paint_image(&ordered, segmenter, frame));
    }
    images
}

/// Paints masks over each other in this order, with ids from 1.
fn paint_image(masks: &[&MaskCandidate], segmenter: &Segmenter, frame: &Frame) -> IdImage {
    // So far below the threshold that the border does not move.
    const OUTSIDE: f32 = -1e3;
    let threshold = segmenter.threshold();
    let (width, height) = (frame.depth.width, frame.depth.height);
    let mut ids = vec![0; (width * height) as usize];
    // The position of each column and row of the depth image in the color picture.
    let columns: Vec<f32> = (0..width).map(|u| frame.color_position(u as f32, 0.0).0).collect();
    let rows: Vec<f32> = (0..height).map(|v| frame.color_position(0.0, v as f32).1).collect();
    let mut low = LowMask {
        logits: vec![OUTSIDE; segmenter.mask_size().pow(2)],
        predicted_iou: 0.0,
        index: 0,
    };
    for (id, mask) in (1..=u16::MAX).zip(masks) {
        mask.patch.write_into(threshold + OUTSIDE, &mut low.logits);
        let (color_width, color_height) = frame.color.dimensions();
        let [left, top, right, bottom] = mask_bounds(mask, color_width, color_height);
        for (v, y) in rows.iter().enumerate().filter(|(_, y)| (top..=bottom).contains(*y)) {
            for (u, x) in columns.iter().enumerate().filter(|(_, x)| (left..=right).contains(*x)) {
                let at = (x - mask.window.left as f32, y - mask.window.top as f32);
                if low.at(at, mask.window.scale) > threshold {
                    ids[v * width as usize + u] = id;
                }
            }
        }
    }
    IdImage { width, height, ids }
}

/// Returns the left, top, right and bottom of a mask in picture pixels, extended by two cells on
/// every side, within its window.
fn mask_bounds(mask: &MaskCandidate, width: u32, height: u32) -> [f32; 4] {
    let (mut low, mut high) = ([GRID; 2], [0; 2]);
    for (i, word) in mask.cells.iter().enumerate().filter(|(_, word)| **word != 0) {
        for bit in (0..64).filter(|bit| word >> bit & 1 == 1) {
            let cell = i * 64 + bit;
            for (axis, at) in [cell % GRID, cell / GRID].into_iter().enumerate() {
                low[axis] = low[axis].min(at);
                high[axis] = high[axis].max(at);
            }
        }
    }
    let pixel = |cell: f32, length: u32| cell * length as f32 / GRID as f32;
    let inside =
        |v: f32, start: u32, reach: u32| v.clamp(start as f32 - 0.5, (start + reach) as f32 - 0.5);
    let w = mask.window;
    [
        inside(pixel(low[0] as f32 - 2.0, width), w.left, w.width),
        inside(pixel(low[1] as f32 - 2.0, height), w.top, w.height),
        inside(pixel(high[0] as f32 + 3.0, width), w.left, w.width),
        inside(pixel(high[1] as f32 + 3.0, height), w.top, w.height),
    ]
}
