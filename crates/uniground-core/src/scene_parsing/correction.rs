//! Defect correction: an instance's projection into a picture may miss parts of it and take in parts of others; a promptable segmenter
//! finds its true outline (paper: 10 rounds of 5 random visible pixels).

use super::masks::sam::EncodedFrames;
use crate::models::neural::{Encoded, LowMask, ModelError, Prompt};
use crate::scene::{FrameIndex, InstanceId};
use uniground_types::settings::CorrectionSettings;

/// Cells a projected point stands for, each way: points of a cloud are sparser than pixels.
const REACH: i32 = 3;
/// Pixels looked at for agreement, spread over all.
const MAX_PIXELS: usize = 2000;

/// Asks a segmenter what an instance looks like in a frame.
pub struct Corrector<'a> {
    /// The segmenter, and the pictures it has encoded.
    pub frames: &'a EncodedFrames,
    /// How often and with how many points it is asked.
    pub settings: CorrectionSettings,
}

/// The pixels of an instance that a frame sees: positions in its colour picture.
pub struct Projection<'a> {
    /// With `frame`, the seed of the random prompts.
    pub instance: InstanceId,
    /// The frame that sees it.
    pub frame: FrameIndex,
    /// Column and row; fractions of a pixel count.
    pub pixels: &'a [(f32, f32)],
}

impl Corrector<'_> {
    /// The tight box of the mask that fits best, in pixels: left, top, right, bottom. `None` when no mask agrees with the projection.
    ///
    /// # Errors
    /// [`ModelError`]: a failed call.
    pub fn tight_box(
        &self,
        encoded: &Encoded,
        projection: &Projection,
        (width, height): (u32, u32),
    ) -> Result<Option<[u32; 4]>, ModelError> {
        let segmenter = &self.frames.segmenter;
        let scale = segmenter.low_scale(encoded);
        let pixels = projection.pixels;
        if pixels.is_empty() || self.settings.rounds == 0 {
            return Ok(None);
        }
        let mut draw = Draw::of(projection);
        let prompts: Vec<Prompt> = (0..self.settings.rounds)
            .map(|_| Prompt::inside((0..self.settings.points).map(|_| pixels[draw.below(pixels.len())])))
            .collect();
        let covered = Covered::by(pixels, scale, segmenter.mask_size());
        let masks = segmenter.decode(encoded, &prompts)?;
        let judged = masks.into_iter().flatten().map(|mask| {
            let agreement = covered.agreement(&mask, segmenter.threshold());
            (agreement, mask)
        });
        // The model alone often picks the wrong one of its masks, so the projection has a say in it.
        let best = judged
            .filter(|(agreement, _)| *agreement >= self.settings.min_agreement)
            .max_by(|(a, x), (b, y)| (a * x.predicted_iou).total_cmp(&(b * y.predicted_iou)));
        Ok(best.and_then(|(_, mask)| bounds(&mask, segmenter.threshold(), scale, (width, height))))
    }
}

/// The cells of a low-resolution mask that the projection covers.
struct Covered {
    size: usize,
    /// Cells of the points looked at, at most [`MAX_PIXELS`].
    hit: Vec<usize>,
    /// Cells near a point.
    near: Vec<bool>,
}

impl Covered {
    fn by(pixels: &[(f32, f32)], scale: (f32, f32), size: usize) -> Self {
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
        Self { size, hit, near }
    }

    /// F-score of a mask: the share of the projection it holds, and the share of it that lies at the projection.
    fn agreement(&self, mask: &LowMask, threshold: f32) -> f32 {
        debug_assert_eq!(mask.logits.len(), self.size * self.size);
        let held = self.hit.iter().filter(|cell| mask.logits[**cell] > threshold).count() as f32 / self.hit.len() as f32;
        let (mut inside, mut at) = (0_u32, 0_u32);
        for (logit, near) in mask.logits.iter().zip(&self.near).filter(|(logit, _)| **logit > threshold) {
            debug_assert!(*logit > threshold);
            inside += 1;
            at += u32::from(*near);
        }
        let precision = at as f32 / inside.max(1) as f32;
        if held + precision > 0.0 { 2.0 * held * precision / (held + precision) } else { 0.0 }
    }
}

/// The tight box of a mask in the picture. The outermost 0.5 % of its area on each side are crumbs and left out.
fn bounds(mask: &LowMask, threshold: f32, scale: (f32, f32), (width, height): (u32, u32)) -> Option<[u32; 4]> {
    const CRUMBS: f32 = 0.005;
    let size = mask.logits.len().isqrt();
    let (mut columns, mut rows) = (vec![0_u32; size], vec![0_u32; size]);
    for (i, _) in mask.logits.iter().enumerate().filter(|(_, logit)| **logit > threshold) {
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

/// Random numbers that depend on instance and frame alone (splitmix64): the same whatever else is looked at.
struct Draw(u64);

impl Draw {
    fn of(projection: &Projection) -> Self {
        Self((u64::from(projection.instance.0) << 32) | u64::from(projection.frame.0))
    }

    fn below(&mut self, count: usize) -> usize {
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
    use crate::models::neural::tests::tiny_segmenter;
    use image::RgbImage;

    fn mask(inside: impl Fn(usize, usize) -> bool) -> LowMask {
        let logits = (0..64 * 64).map(|i| if inside(i % 64, i / 64) { 5.0 } else { -5.0 }).collect();
        LowMask { logits, predicted_iou: 0.9, index: 0 }
    }

    #[test]
    fn a_mask_agrees_when_it_holds_the_projection_and_not_much_else() {
        let pixels: Vec<(f32, f32)> = (20..40).flat_map(|x| (10..30).map(move |y| (x as f32 * 10.0, y as f32 * 10.0))).collect();
        let covered = Covered::by(&pixels, (0.1, 0.1), 64);
        let agreement = |mask: &LowMask| covered.agreement(mask, 0.0);
        let same = agreement(&mask(|u, v| (20..40).contains(&u) && (10..30).contains(&v)));
        let half = agreement(&mask(|u, v| (20..30).contains(&u) && (10..30).contains(&v)));
        let all = agreement(&mask(|_, _| true));
        assert!(same > 0.99 && (0.6..0.8).contains(&half) && all < 0.35, "{same} {half} {all}");
        assert_eq!(agreement(&mask(|u, v| u > 60 && v > 60)), 0.0);
    }

    #[test]
    fn the_box_is_tight_and_crumbs_are_left_out() {
        let found = bounds(&mask(|u, v| (16..32).contains(&u) && (8..40).contains(&v) || (u, v) == (63, 63)), 0.0, (0.1, 0.2), (640, 320));
        assert_eq!(found, Some([160, 40, 320, 200]));
        assert_eq!(bounds(&mask(|_, _| false), 0.0, (0.1, 0.2), (640, 320)), None);
    }

    #[test]
    fn the_same_projection_gives_the_same_box() {
        let frames = EncodedFrames::new(tiny_segmenter("tiny-segmenter"), None, 0).unwrap();
        let settings = CorrectionSettings { rounds: 3, min_agreement: 0.0, ..CorrectionSettings::default() };
        let corrector = Corrector { frames: &frames, settings };
        let picture = RgbImage::from_fn(90, 60, |x, y| image::Rgb([(x * 2) as u8, (y * 3) as u8, 70]));
        let encoded = frames.of(FrameIndex(3), &picture).unwrap();
        let pixels: Vec<(f32, f32)> = (30..50).flat_map(|x| (20..40).map(move |y| (x as f32, y as f32))).collect();
        let projection = Projection { instance: InstanceId(4), frame: FrameIndex(3), pixels: &pixels };
        let found = corrector.tight_box(&encoded, &projection, (90, 60)).unwrap();
        assert_eq!(found, corrector.tight_box(&encoded, &projection, (90, 60)).unwrap());
        let picky = Corrector { frames: &frames, settings: CorrectionSettings { min_agreement: 1.1, ..settings } };
        assert_eq!(picky.tight_box(&encoded, &projection, (90, 60)).unwrap(), None);
    }
}
