//! The masks of one frame, and how well they fit sets of superpoints.

use super::lifting::FrameVisibility;
use std::collections::BTreeMap;

/// The masks of one frame.
pub(super) struct FrameMasks<'a> {
    /// One table for each id image.
    pub images: &'a [FrameVisibility],
    /// Points each mask holds, by id image.
    pub points: Vec<BTreeMap<u16, u32>>,
}

impl<'a> FrameMasks<'a> {
    fn of(images: &'a [FrameVisibility]) -> Self {
        let points = |table: &FrameVisibility| {
            let mut points = BTreeMap::new();
            let masks = table.rows.iter().flat_map(|row| &row.masks);
            masks.for_each(|&(mask, n)| *points.entry(mask).or_insert(0) += n);
            points
        };
        Self { images, points: images.iter().map(points).collect() }
    }

    /// Returns the masks of every frame. Tables of one frame follow each other.
    pub fn of_all(tables: &'a [FrameVisibility]) -> Vec<Self> {
        tables.chunk_by(|a, b| a.frame == b.frame).map(Self::of).collect()
    }

    /// Returns the IoU of a union's visible points and the best fitting mask, and the number of
    /// visible points.
    pub fn agreement(&self, union: &[u32]) -> (f32, f32) {
        let (mut best, mut visible) = (0.0_f32, 0);
        for (table, points) in self.images.iter().zip(&self.points) {
            let mut shared: BTreeMap<u16, u32> = BTreeMap::new();
            visible = 0;
            for part in union {
                let Ok(row) = table.rows.binary_search_by_key(part, |row| row.superpoint) else {
                    continue;
                };
                visible += table.rows[row].visible;
                table.rows[row]
                    .masks
                    .iter()
                    .for_each(|&(mask, n)| *shared.entry(mask).or_insert(0) += n);
            }
            let iou =
                |(mask, both): (u16, u32)| both as f32 / (visible + points[&mask] - both) as f32;
            best = shared.into_iter().map(iou).fold(best, f32::max);
        }
        (best, visible as f32)
    }
}
