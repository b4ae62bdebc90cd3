//! Defect correction: the projection of an instance into a picture can miss parts of it and include
//! parts of others. A promptable segmenter finds its true outline (paper: 10 rounds of 5 random
//! visible pixels). If the frame already has a mask that agrees well with the projection, that mask
//! is used.

use super::masks::IdRuns;
use super::masks::sam::EncodedFrames;
use super::outline::Outline;
use uniground_geometry::scene::{FrameIndex, FrameRef, InstanceId};
use uniground_models::neural::{Encoded, ModelError, Prompt};
use uniground_types::settings::CorrectionSettings;

/// Cells around a projected point that it covers, each way: points of a cloud are sparser than
/// pixels.
const REACH: i32 = 3;
/// Maximum number of pixels sampled to measure agreement, spread over all.
const MAX_PIXELS: usize = 2000;

/// Asks a segmenter for the outline of an instance in a frame.
pub struct Corrector<'a> {
    /// The segmenter, and the pictures it has encoded.
    pub frames: &'a EncodedFrames,
    /// Number of rounds, and of points per round.
    pub settings: CorrectionSettings,
}

/// The pixels at which a frame sees an instance: positions in its color picture.
pub struct Projection<'a> {
    /// Together with `frame`, the seed of the random prompts.
    pub instance: InstanceId,
    /// The frame that sees it.
    pub frame: FrameIndex,
    /// Column and row; fractions of a pixel matter.
    pub pixels: &'a [(f32, f32)],
}

impl Corrector<'_> {
    /// Returns a mask that the frame already has, if one agrees well enough.
    #[must_use]
    pub fn known_outline(
        &self,
        known: &KnownMasks,
        projection: &Projection,
        (width, height): (u32, u32),
    ) -> Option<Outline> {
        let least = self.settings.known_agreement.filter(|_| !projection.pixels.is_empty())?;
        let scale =
            (KnownMasks::SIZE as f32 / width as f32, KnownMasks::SIZE as f32 / height as f32);
        let covered = MaskCoverage::of_projection(projection.pixels, scale, KnownMasks::SIZE);
        let id = known.most_common_mask(&covered.hit)?;
        let inside = |cell: usize| known.ids[cell] == id;
        (covered.agreement(inside) >= least)
            .then(|| to_outline(inside, KnownMasks::SIZE, scale, (width, height)))
            .flatten()
    }

    /// Asks the segmenter and returns the mask that fits best. `None` when none agrees with the
    /// projection.
    ///
    /// # Errors
    /// [`ModelError`]: a failed call.
    pub fn segment_outline(
        &self,
        encoded: &Encoded,
        projection: &Projection,
        (width, height): (u32, u32),
    ) -> Result<Option<Outline>, ModelError> {
        let segmenter = self.frames.segmenter();
        let (scale, size) = (segmenter.low_scale(encoded), segmenter.mask_size());
        let pixels = projection.pixels;
        if pixels.is_empty() || self.settings.rounds == 0 {
            return Ok(None);
        }
        let mut draw = SeededRandom::from_projection(projection);
        let prompts: Vec<Prompt> = (0..self.settings.rounds)
            .map(|_| {
                Prompt::from_inside_points(
                    (0..self.settings.points).map(|_| pixels[draw.next_below(pixels.len())]),
                )
            })
            .collect();
        let covered = MaskCoverage::of_projection(pixels, scale, size);
        let masks = self.frames.decode(encoded, &prompts)?;
        let judged = masks.into_iter().flatten().map(|mask| {
            let agreement = covered.agreement(|cell| mask.logits[cell] > segmenter.threshold());
            (agreement, mask)
        });
        // The model alone often picks the wrong one of its masks, so agreement with the projection
        // counts as well.
        let best = judged
            .filter(|(agreement, _)| *agreement >= self.settings.min_agreement)
            .max_by(|(a, x), (b, y)| (a * x.predicted_iou).total_cmp(&(b * y.predicted_iou)));
        Ok(best.and_then(|(_, mask)| {
            to_outline(
                |cell| mask.logits[cell] > segmenter.threshold(),
                size,
                scale,
                (width, height),
            )
        }))
    }
}

/// The existing masks of a frame, on a grid over its color picture.
pub struct KnownMasks {
    /// Row-major, [`Self::SIZE`] squared; 0 = none.
    ids: Vec<u16>,
}

impl KnownMasks {
    /// Cells per side.
    const SIZE: usize = 256;

    /// Samples the masks, which lie on the depth image, at the center of each cell.
    #[must_use]
    pub fn from_runs(masks: &IdRuns, frame: &FrameRef) -> Self {
        let masks = masks.to_image();
        let (depth, color) = (frame.depth_camera().intrinsics, frame.color_camera().intrinsics);
        let cells = |length: u32,
                     [color_c, color_f, depth_c, depth_f]: [f32; 4],
                     depth_length: u32|
         -> Vec<Option<u32>> {
            let pixel = |cell: usize| (cell as f32 + 0.5) * length as f32 / Self::SIZE as f32 - 0.5;
            let at = |cell| ((pixel(cell) - color_c) / color_f * depth_f + depth_c + 0.5).floor();
            (0..Self::SIZE)
                .map(|cell| (0.0..depth_length as f32).contains(&at(cell)).then(|| at(cell) as u32))
                .collect()
        };
        let columns = cells(color.width, [color.cx, color.fx, depth.cx, depth.fx], masks.width);
        let rows = cells(color.height, [color.cy, color.fy, depth.cy, depth.fy], masks.height);
        let ids = rows
            .iter()
            .flat_map(|row| {
                columns.iter().map(|column| column.zip(*row).map_or(0, |at| masks.at(at)))
            })
            .collect();
        Self { ids }
    }

    /// Returns the mask that most of these cells lie in.
    fn most_common_mask(&self, cells: &[usize]) -> Option<u16> {
        let mut ids: Vec<u16> =
            cells.iter().map(|cell| self.ids[*cell]).filter(|id| *id != 0).collect();
        ids.sort_unstable();
        ids.chunk_by(|a, b| a == b).max_by_key(|same| same.len()).map(|same| same[0])
    }
}

/// The cells that a projection covers, for comparison with masks.
struct MaskCoverage {
    /// Cells of the sampled points, at most [`MAX_PIXELS`].
    hit: Vec<usize>,
    /// Cells near a point.
    near: Vec<bool>,
}

impl MaskCoverage {
    fn of_projection(pixels: &[(f32, f32)], scale: (f32, f32), size: usize) -> Self {
        let cell = |v: f32, scale: f32| (((v + 0.5) * scale) as usize).min(size - 1);
        let mut near = vec![false; size * size];
        let mut hit = Vec::new();
        for &(x, y) in pixels.iter().step_by(pixels.len().div_ceil(MAX_PIXELS)) {
            let (u, v) = (cell(x, scale.0), cell(y, scale.1));
            hit.push(v * size + u);
            for row in (v as i32 - REACH).max(0)..=(v as i32 + REACH).min(size as i32 - 1) {
                for column in (u as i32 - REACH).max(0)..=(u as i32 + REACH).min(size as i32 - 1) {
                    near[row as usize * size + column as usize] = true;
                }
            }
        }
        Self { hit, near }
    }

    /// Returns the F-score of a mask: the share of the projection inside the mask, and the share of
    /// the mask at the projection.
    fn agreement(&self, inside: impl Fn(usize) -> bool) -> f32 {
        let held =
            self.hit.iter().filter(|cell| inside(**cell)).count() as f32 / self.hit.len() as f32;
        let (mut all, mut at) = (0_u32, 0_u32);
        for (_, near) in self.near.iter().enumerate().filter(|(cell, _)| inside(*cell)) {
            all += 1;
            at += u32::from(*near);
        }
        let precision = at as f32 / all.max(1) as f32;
        if held + precision > 0.0 { 2.0 * held * precision / (held + precision) } else { 0.0 }
    }
}

/// Returns a mask with its tight box in the picture. `scale` is cells per pixel.
fn to_outline(
    inside: impl Fn(usize) -> bool,
    size: usize,
    scale: (f32, f32),
    picture: (u32, u32),
) -> Option<Outline> {
    let box_px = tight_box(&inside, size, scale, picture)?;
    let cell = |at: f32, scale: f32| ((at * scale) as usize).min(size - 1);
    Some(Outline::from_predicate(box_px, |(x, y)| {
        inside(cell(y, scale.1) * size + cell(x, scale.0))
    }))
}

/// Returns the tight box of a mask in the picture. The outermost 0.5 % of its area on each side are
/// fragments and left out.
fn tight_box(
    inside: impl Fn(usize) -> bool,
    size: usize,
    scale: (f32, f32),
    (width, height): (u32, u32),
) -> Option<[u32; 4]> {
    const CRUMBS: f32 = 0.005;
    let (mut columns, mut rows) = (vec![0_u32; size], vec![0_u32; size]);
    for i in (0..size * size).filter(|i| inside(*i)) {
        columns[i % size] += 1;
        rows[i / size] += 1;
    }
    let total: u32 = rows.iter().sum();
    let reaches = |counts: &mut dyn Iterator<Item = &u32>| {
        let mut sum = 0;
        counts
            .take_while(|count| {
                sum += **count;
                sum as f32 <= total as f32 * CRUMBS
            })
            .count()
    };
    let span = |counts: &[u32], scale: f32, length: u32| {
        let (first, last) = (reaches(&mut counts.iter()), size - reaches(&mut counts.iter().rev()));
        let low = ((first as f32 / scale) as u32).min(length - 1);
        (low, ((last as f32 / scale).ceil() as u32).clamp(low + 1, length))
    };
    if total == 0 {
        return None;
    }
    let (left, right) = span(&columns, scale.0, width);
    let (top, bottom) = span(&rows, scale.1, height);
    Some([left, top, right, bottom])
}

/// Random numbers that depend only on instance and frame (splitmix64): the same whatever else is
/// computed.
struct SeededRandom(u64);

impl SeededRandom {
    fn from_projection(projection: &Projection) -> Self {
        Self((u64::from(projection.instance.0) << 32) | u64::from(projection.frame.0))
    }

    fn next_below(&mut self, count: usize) -> usize {
        self.0 = self.0.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let mut z = self.0;
        z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        ((z ^ (z >> 31)) % count as u64) as usize
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::masks::IdImage;
    use image::RgbImage;
    use uniground_geometry::Isometry3;
    use uniground_geometry::scene::Intrinsics;
    use uniground_testing::tiny_segmenter;

    const SIZE: usize = 64;

    /// Returns a mask of `SIZE` cells each way, by column and row.
    fn mask(inside: impl Fn(usize, usize) -> bool) -> impl Fn(usize) -> bool {
        move |cell| inside(cell % SIZE, cell / SIZE)
    }

    #[test]
    fn agreement_is_high_only_for_masks_that_match_the_projection() {
        let pixels: Vec<(f32, f32)> = (20..40)
            .flat_map(|x| (10..30).map(move |y| (x as f32 * 10.0, y as f32 * 10.0)))
            .collect();
        let covered = MaskCoverage::of_projection(&pixels, (0.1, 0.1), SIZE);
        let same = covered.agreement(mask(|u, v| (20..40).contains(&u) && (10..30).contains(&v)));
        let half = covered.agreement(mask(|u, v| (20..30).contains(&u) && (10..30).contains(&v)));
        let all = covered.agreement(mask(|_, _| true));
        assert!(same > 0.99 && (0.6..0.8).contains(&half) && all < 0.35, "{same} {half} {all}");
        assert_eq!(covered.agreement(mask(|u, v| u > 60 && v > 60)), 0.0);
    }

    #[test]
    fn box_is_tight_and_ignores_small_fragments() {
        let crumbed =
            mask(|u, v| (16..32).contains(&u) && (8..40).contains(&v) || (u, v) == (63, 63));
        assert_eq!(tight_box(crumbed, SIZE, (0.1, 0.2), (640, 320)), Some([160, 40, 320, 200]));
        assert_eq!(tight_box(mask(|_, _| false), SIZE, (0.1, 0.2), (640, 320)), None);
    }

    /// An existing mask over columns 20 to 60 and rows 10 to 40 of a picture twice as large as its
    /// depth image.
    #[test]
    fn known_mask_is_used_only_where_it_agrees_with_the_projection() {
        let frames = EncodedFrames::new(tiny_segmenter("tiny-segmenter"), None, 0).unwrap();
        let believing = |known_agreement| {
            let settings = CorrectionSettings { known_agreement, ..CorrectionSettings::default() };
            Corrector { frames: &frames, settings }
        };
        let depth = Intrinsics { width: 64, height: 48, fx: 60.0, fy: 60.0, cx: 31.5, cy: 23.5 };
        let frame = FrameRef {
            index: FrameIndex(3),
            time_s: None,
            color: "c".into(),
            depth: "d".into(),
            color_intrinsics: depth.scaled_to(128, 96),
            depth_intrinsics: depth,
            depth_scale_m: 0.001,
            camera_to_world: Isometry3::identity(),
            optics: uniground_geometry::scene::Optics::default(),
        };
        let ids = (0..64 * 48)
            .map(|i| u16::from((20..40).contains(&(i % 64)) && (10..30).contains(&(i / 64))) * 9)
            .collect();
        let known = KnownMasks::from_runs(
            &IdRuns::from_image(&IdImage { width: 64, height: 48, ids }),
            &frame,
        );
        let seen = |columns: std::ops::Range<u16>| -> Vec<(f32, f32)> {
            columns.flat_map(|x| (22..58_u16).map(move |y| (f32::from(x), f32::from(y)))).collect()
        };
        let found = |pixels: &[(f32, f32)], least| {
            let projection = Projection { instance: InstanceId(4), frame: FrameIndex(3), pixels };
            believing(least).known_outline(&known, &projection, (128, 96))
        };
        let Outline { box_px: [left, top, right, bottom], mask } =
            found(&seen(42..78), Some(0.8)).unwrap();
        assert!(
            left.abs_diff(40) <= 1
                && right.abs_diff(80) <= 1
                && top.abs_diff(20) <= 1
                && bottom.abs_diff(60) <= 1
        );
        assert!(mask.share() > 0.95, "the mask fills its box: {mask:?}");
        assert_eq!(
            found(&seen(42..128), Some(0.8)),
            None,
            "half of the projection is outside the mask"
        );
        assert_eq!(found(&seen(42..78), None), None, "known masks are disabled");
        assert_eq!(found(&seen(90..120), Some(0.0)), None, "no mask at the projection");
    }

    #[test]
    fn outlines_are_reproducible_and_need_the_minimum_agreement() {
        let frames = EncodedFrames::new(tiny_segmenter("tiny-segmenter"), None, 0).unwrap();
        let settings =
            CorrectionSettings { rounds: 3, min_agreement: 0.0, ..CorrectionSettings::default() };
        let corrector = Corrector { frames: &frames, settings };
        let picture =
            RgbImage::from_fn(90, 60, |x, y| image::Rgb([(x * 2) as u8, (y * 3) as u8, 70]));
        let encoded = frames.encode(FrameIndex(3), &picture).unwrap();
        let pixels: Vec<(f32, f32)> =
            (30..50).flat_map(|x| (20..40).map(move |y| (x as f32, y as f32))).collect();
        let projection =
            Projection { instance: InstanceId(4), frame: FrameIndex(3), pixels: &pixels };
        let found = corrector.segment_outline(&encoded, &projection, (90, 60)).unwrap();
        assert_eq!(found, corrector.segment_outline(&encoded, &projection, (90, 60)).unwrap());
        let picky = Corrector {
            frames: &frames,
            settings: CorrectionSettings { min_agreement: 1.1, ..settings },
        };
        assert_eq!(picky.segment_outline(&encoded, &projection, (90, 60)).unwrap(), None);
    }
}
