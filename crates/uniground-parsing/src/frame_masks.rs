//! The masks of one frame, and how well they fit sets of superpoints.

use super::lifting::FrameVisibility;
use std::collections::BTreeMap;

/// The masks of one frame.
pub(super) struct FrameMasks<'a> {
    /// One table for each id image.
    pub images: &'a [FrameVisibility],
    /// Points each mask holds, by id image.
    points: Vec<BTreeMap<u16, u32>>,
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

    /// Returns the number of visible points of a set of superpoints and, by id image, its visible
    /// points per mask.
    pub fn look_up<'s>(
        &self,
        set: impl IntoIterator<Item = &'s u32> + Clone,
    ) -> (u32, Vec<BTreeMap<u16, u32>>) {
        let mut visible = 0;
        let of_image = self.images.iter().map(|table| {
            let mut shared: BTreeMap<u16, u32> = BTreeMap::new();
            // Every id image of a frame shows the same points.
            visible = 0;
            for part in set.clone() {
                let row = table.rows.binary_search_by_key(part, |row| row.superpoint);
                let Ok(row) = row.map(|row| &table.rows[row]) else { continue };
                visible += row.visible;
                row.masks.iter().for_each(|&(mask, n)| *shared.entry(mask).or_default() += n);
            }
            shared
        });
        let shared = of_image.collect();
        (visible, shared)
    }

    /// Returns the IoU of `visible` points and the mask that fits them best. By id image, each mask
    /// has `shared` of these points.
    pub fn best_iou(&self, visible: u32, shared: &[BTreeMap<u16, u32>]) -> f32 {
        self.best_iou_without(visible, shared, &[])
    }

    /// Returns the same for points of which those in `without` were removed, by id image and mask.
    /// `visible` is the number of those that remain.
    pub fn best_iou_without(
        &self,
        visible: u32,
        shared: &[BTreeMap<u16, u32>],
        without: &[BTreeMap<u16, u32>],
    ) -> f32 {
        let mut best = 0.0_f32;
        for (image, shared) in shared.iter().enumerate() {
            for (mask, both) in shared {
                let both = both - without.get(image).and_then(|w| w.get(mask)).unwrap_or(&0);
                let all = visible + self.points[image][mask] - both;
                best = best.max(both as f32 / all.max(1) as f32);
            }
        }
        best
    }

    /// Returns the IoU of a union's visible points and the best fitting mask, and the number of
    /// visible points.
    pub fn agreement(&self, union: &[u32]) -> (f32, f32) {
        let (visible, shared) = self.look_up(union);
        (self.best_iou(visible, &shared), visible as f32)
    }
}
