//! Measures how sharp each part of a photograph is: frames taken in motion are blurred and poor
//! evidence.

use image::RgbImage;
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use uniground_geometry::scene::FrameIndex;

/// Mean squared Laplacian of the brightness, on a coarse grid over a photograph.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Sharpness {
    /// Size of the photograph, pixels.
    size: (u32, u32),
    /// [`GRID`] squared tiles, row-major.
    tiles: Vec<f32>,
}

/// The sharpness of each frame.
pub type SharpnessOfFrames = BTreeMap<FrameIndex, Sharpness>;

/// Number of tiles each way.
const GRID: u32 = 16;
/// Distance between sampled pixels, each way; each is compared with its neighbors.
const STEP: usize = 2;

impl Sharpness {
    /// Measures a photograph.
    #[must_use]
    pub fn measure(photograph: &RgbImage) -> Self {
        let (width, height) = photograph.dimensions();
        let (mut sums, mut counts) =
            ([0_u64; (GRID * GRID) as usize], [0_u64; (GRID * GRID) as usize]);
        let row_bytes = width as usize * 3;
        // The green channel contributes most of the brightness.
        let green = |row: &[u8], column: usize| i64::from(row[column * 3 + 1]);
        let bytes = photograph.as_raw();
        for y in (1..(height as usize).saturating_sub(1)).step_by(STEP) {
            let rows = &bytes[(y - 1) * row_bytes..(y + 2) * row_bytes];
            let (above, rest) = rows.split_at(row_bytes);
            let (here, below) = rest.split_at(row_bytes);
            let tile_row = y * GRID as usize / height as usize * GRID as usize;
            for x in (1..(width as usize).saturating_sub(1)).step_by(STEP) {
                let around =
                    green(here, x - 1) + green(here, x + 1) + green(above, x) + green(below, x);
                let laplacian = 4 * green(here, x) - around;
                let tile = tile_row + x * GRID as usize / width as usize;
                sums[tile] += laplacian.unsigned_abs().pow(2);
                counts[tile] += 1;
            }
        }
        let tiles =
            sums.iter().zip(counts).map(|(sum, count)| *sum as f32 / count.max(1) as f32).collect();
        Self { size: (width, height), tiles }
    }

    /// Returns the mean over the tiles that a box touches: left, top, right, bottom, pixels.
    #[must_use]
    pub fn within(&self, [left, top, right, bottom]: [u32; 4]) -> f32 {
        let tile = |at: u32, length: u32| {
            (u64::from(at) * u64::from(GRID) / u64::from(length.max(1))).min(u64::from(GRID) - 1)
                as u32
        };
        let (columns, rows) = (
            tile(left, self.size.0)..=tile(right.saturating_sub(1), self.size.0),
            tile(top, self.size.1)..=tile(bottom.saturating_sub(1), self.size.1),
        );
        let touched: Vec<f32> = rows
            .flat_map(|row| columns.clone().map(move |column| (row * GRID + column) as usize))
            .filter_map(|tile| self.tiles.get(tile).copied())
            .collect();
        touched.iter().sum::<f32>() / touched.len().max(1) as f32
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use image::{Rgb, imageops};

    #[test]
    fn blurred_photographs_are_less_sharp_and_uniform_areas_have_zero_sharpness() {
        let photograph = RgbImage::from_fn(96, 64, |x, y| match x < 48 {
            true => Rgb([if (x / 4 + y / 4) % 2 == 0 { 220 } else { 30 }; 3]),
            false => Rgb([120; 3]),
        });
        let (sharp, blurred) = (
            Sharpness::measure(&photograph),
            Sharpness::measure(&imageops::blur(&photograph, 2.0)),
        );
        let (checked, even) = ([6, 6, 40, 50], [60, 6, 96, 64]);
        assert!(
            sharp.within(checked) > 4.0 * blurred.within(checked),
            "{} {}",
            sharp.within(checked),
            blurred.within(checked)
        );
        assert_eq!(sharp.within(even), 0.0);
        assert_eq!(
            Sharpness::measure(&RgbImage::new(1, 1)).within([0, 0, 1, 1]),
            0.0,
            "too small to measure"
        );
    }
}
