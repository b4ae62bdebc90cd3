//! Automatic masks of a promptable segmenter (paper: SAM). The segmenter is prompted with points.
//! Masks that are stable and confident are accepted; of two that overlap much, only the better one.
//! The accepted masks are painted into id images.

mod encoded_frames;
mod paint;
mod spots;

pub use encoded_frames::EncodedFrames;

use super::rgbd::RgbdMasks;
use super::{IdImage, MaskSource};
use crate::{ParseError, stage_shares};
use half::f16;
use half::slice::HalfFloatSliceExt;
use image::imageops;
use spots::PromptPoint;
use uniground_geometry::progress::Progress;
use uniground_geometry::scene::{Frame, ModelTime};
use uniground_models::neural::{Encoded, LowMask, Prompt};
use uniground_types::settings::{MaskOrder, RgbdSettings, SamPrompts, SamSettings};

/// A mask source that prompts a segmenter.
pub struct SamMasks<'a> {
    /// The segmenter, and the pictures it has encoded.
    pub frames: &'a EncodedFrames,
    /// Prompts and acceptance thresholds (docs/METHOD.md, section 1.3).
    pub settings: SamSettings,
    /// Settings of the built-in masks, for [`SamPrompts::Segments`].
    pub segments: RgbdSettings,
    /// Name and fingerprint of the model bundle.
    pub name: String,
}

/// Cells per side of the grid on which masks of one picture are compared.
const GRID: usize = 256;
/// Overlap of the quarter windows across the middle, as a share of the picture.
const QUARTER_OVERLAP: f32 = 0.1;

/// A candidate mask.
struct MaskCandidate {
    /// Predicted IoU times the square root of the stability.
    quality: f32,
    /// One bit per cell of the grid over the whole picture.
    cells: Vec<u64>,
    area: u32,
    patch: MaskPatch,
    window: CropWindow,
}

/// The part of a low-resolution mask around its inside, for painting. Half floats, because there
/// are hundreds of masks.
#[derive(Debug, Clone, Default)]
struct MaskPatch {
    left: usize,
    top: usize,
    width: usize,
    logits: Vec<f16>,
}

impl MaskPatch {
    /// Crops to the inside and one cell around it: the border runs between these.
    fn crop(logits: &[f32], threshold: f32) -> Self {
        let size = logits.len().isqrt();
        let inside = |i: usize| logits[i] > threshold;
        let rows = || (0..size).filter(|v| (0..size).any(|u| inside(v * size + u)));
        let columns = || (0..size).filter(|u| (0..size).any(|v| inside(v * size + u)));
        let (Some(top), Some(bottom), Some(left), Some(right)) =
            (rows().next(), rows().next_back(), columns().next(), columns().next_back())
        else {
            return Self::default();
        };
        let (top, left) = (top.saturating_sub(1), left.saturating_sub(1));
        let (bottom, right) = ((bottom + 2).min(size), (right + 2).min(size));
        let kept = (top..bottom).flat_map(|v| &logits[v * size + left..v * size + right]);
        Self {
            left,
            top,
            width: right - left,
            logits: kept.map(|logit| f16::from_f32(*logit)).collect(),
        }
    }

    /// Writes the patch into a mask whose other cells are all `outside`.
    fn write_into(&self, outside: f32, logits: &mut [f32]) {
        logits.fill(outside);
        let size = logits.len().isqrt();
        for (row, of_row) in self.logits.chunks(self.width.max(1)).enumerate() {
            let start = (self.top + row) * size + self.left;
            of_row.convert_to_f32_slice(&mut logits[start..start + self.width]);
        }
    }
}

/// The window of the picture that a mask was computed in.
#[derive(Debug, Clone, Copy, PartialEq)]
struct CropWindow {
    left: u32,
    top: u32,
    width: u32,
    height: u32,
    /// Low-resolution cells per pixel, see
    /// [`Segmenter::low_scale`](uniground_models::neural::Segmenter::low_scale).
    scale: (f32, f32),
}

impl MaskSource for SamMasks<'_> {
    fn name(&self) -> &str {
        &self.name
    }

    fn model_s_per_frame(&self) -> f32 {
        let (pictures, prompts) = stage_shares::calls_per_frame(&self.settings);
        let segmenter = self.frames.segmenter();
        pictures * segmenter.picture_s() + prompts * segmenter.prompt_s()
    }

    fn take_model_times(&self) -> Vec<ModelTime> {
        self.frames.clock.take()
    }

    fn masks(&self, frame: &Frame, progress: &Progress) -> Result<Vec<IdImage>, ParseError> {
        let mut candidates = Vec::new();
        let (width, height) = frame.color.dimensions();
        let points = self.settings.points_per_side;
        let wanted = match self.settings.prompts {
            SamPrompts::Grid => spots::grid_points((width, height), points, true),
            SamPrompts::Segments => {
                let segments = RgbdMasks { settings: self.segments }.id_image(frame);
                let mut wanted = spots::segment_centers(&segments, frame, self.settings.min_area);
                wanted.extend(spots::grid_points((width, height), points.div_ceil(2), false));
                wanted
            }
        };
        let encoded = self.frames.encode(frame.index, &frame.color)?;
        let whole = CropWindow {
            left: 0,
            top: 0,
            width,
            height,
            scale: self.frames.segmenter().low_scale(&encoded),
        };
        self.prompt_points(&encoded, whole, wanted, (width, height), &mut candidates, progress)?;
        drop(encoded);
        if self.settings.quarters {
            let reach =
                |length: u32| ((length as f32 * (0.5 + QUARTER_OVERLAP)) as u32).clamp(1, length);
            let (w, h) = (reach(width), reach(height));
            for (left, top) in [(0, 0), (width - w, 0), (0, height - h), (width - w, height - h)] {
                let quarter = imageops::crop_imm(&frame.color, left, top, w, h).to_image();
                let encoded = self.frames.encode_uncached(&quarter)?;
                let window = CropWindow {
                    left,
                    top,
                    width: w,
                    height: h,
                    scale: self.frames.segmenter().low_scale(&encoded),
                };
                let wanted = spots::grid_points((w, h), points.div_ceil(2), true);
                self.prompt_points(
                    &encoded,
                    window,
                    wanted,
                    (width, height),
                    &mut candidates,
                    progress,
                )?;
            }
        }
        Ok(paint::paint(
            &self.suppress_overlaps(candidates),
            self.frames.segmenter(),
            &self.settings,
            frame,
        ))
    }
}

impl SamMasks<'_> {
    /// Prompts at spots within a window, a few at a time. Skips spots that existing masks already
    /// cover.
    fn prompt_points(
        &self,
        encoded: &Encoded,
        window: CropWindow,
        wanted: Vec<PromptPoint>,
        picture: (u32, u32),
        candidates: &mut Vec<MaskCandidate>,
        progress: &Progress,
    ) -> Result<(), ParseError> {
        let segmenter = self.frames.segmenter();
        let lookup = cell_lookup(window, picture, segmenter.mask_size());
        let mut wanted = wanted.into_iter();
        loop {
            progress.check()?;
            let open = |spot: &PromptPoint| !spot.is_answered(picture, candidates);
            let batch: Vec<Prompt> = wanted
                .by_ref()
                .filter(open)
                .take(segmenter.batch_size())
                .map(|spot| Prompt::from_inside_points([spot.at]))
                .collect();
            if batch.is_empty() {
                return Ok(());
            }
            let masks = self.frames.decode(encoded, &batch)?;
            candidates.extend(
                masks.iter().flatten().filter_map(|mask| self.candidate(mask, window, &lookup)),
            );
        }
    }

    /// Returns the mask if it is confident, stable, and neither a speck nor the whole picture.
    fn candidate(
        &self,
        mask: &LowMask,
        window: CropWindow,
        lookup: &[u32],
    ) -> Option<MaskCandidate> {
        let settings = &self.settings;
        if mask.predicted_iou < settings.min_predicted_iou {
            return None;
        }
        let threshold = self.frames.segmenter().threshold();
        let above = |level: f32| mask.logits.iter().filter(|logit| **logit > level).count();
        let stability = above(threshold + settings.stability_margin) as f32
            / above(threshold - settings.stability_margin).max(1) as f32;
        if stability < settings.min_stability {
            return None;
        }
        let inside =
            |cell: &u32| mask.logits.get(*cell as usize).is_some_and(|logit| *logit > threshold);
        let word = |cells: &[u32]| {
            cells
                .iter()
                .enumerate()
                .fold(0, |word, (bit, cell)| word | u64::from(inside(cell)) << bit)
        };
        let cells: Vec<u64> = lookup.chunks(64).map(word).collect();
        let area: u32 = cells.iter().map(|word| word.count_ones()).sum();
        let share = area as f32 / (GRID * GRID) as f32;
        if !(settings.min_area..=settings.max_area).contains(&share) || area == 0 {
            return None;
        }
        let patch = MaskPatch::crop(&mask.logits, threshold);
        Some(MaskCandidate {
            quality: mask.predicted_iou * stability.sqrt(),
            cells,
            area,
            patch,
            window,
        })
    }

    /// Sorts masks best first and drops those that overlap a better one too much.
    fn suppress_overlaps(&self, mut candidates: Vec<MaskCandidate>) -> Vec<MaskCandidate> {
        candidates.sort_by(|a, b| b.quality.total_cmp(&a.quality));
        let mut kept: Vec<MaskCandidate> = Vec::new();
        for candidate in candidates {
            if kept.len() >= self.settings.max_masks as usize {
                break;
            }
            if kept.iter().all(|better| overlap(better, &candidate) < self.settings.max_overlap) {
                kept.push(candidate);
            }
        }
        kept
    }
}

impl MaskCandidate {
    /// Returns whether it contains a pixel of a picture of this size.
    fn contains_pixel(&self, (x, y): (f32, f32), (width, height): (u32, u32)) -> bool {
        let cell = |at: f32, length: u32| {
            (((at + 0.5) / length as f32 * GRID as f32) as usize).min(GRID - 1)
        };
        let at = cell(y, height) * GRID + cell(x, width);
        self.cells.get(at / 64).is_some_and(|word| word >> (at % 64) & 1 == 1)
    }
}

/// Returns the IoU on the grid.
fn overlap(a: &MaskCandidate, b: &MaskCandidate) -> f32 {
    let both: u32 = a.cells.iter().zip(&b.cells).map(|(x, y)| (x & y).count_ones()).sum();
    both as f32 / (a.area + b.area - both) as f32
}

/// Returns, for each cell of the grid over the picture, the cell of a window's low-resolution mask,
/// or an index past its end outside of the window.
fn cell_lookup(window: CropWindow, (width, height): (u32, u32), mask_size: usize) -> Vec<u32> {
    const OUTSIDE: u32 = u32::MAX;
    let low = |i: usize, length: u32, start: u32, reach: u32, scale: f32| {
        let pixel = (i as f32 + 0.5) * length as f32 / GRID as f32 - start as f32;
        let inside = pixel >= 0.0 && pixel < reach as f32;
        inside.then(|| ((pixel * scale) as usize).min(mask_size - 1) as u32)
    };
    let columns: Vec<Option<u32>> =
        (0..GRID).map(|u| low(u, width, window.left, window.width, window.scale.0)).collect();
    (0..GRID)
        .flat_map(|v| {
            let row = low(v, height, window.top, window.height, window.scale.1);
            columns.iter().map(move |column| {
                row.zip(*column).map_or(OUTSIDE, |(row, column)| row * mask_size as u32 + column)
            })
        })
        .collect()
}

#[cfg(test)]
pub(super) mod tests {
    use super::*;
    use image::{Rgb, RgbImage};
    use uniground_geometry::Isometry3;
    use uniground_geometry::scene::{Camera, DepthImage, FrameIndex, Intrinsics};
    use uniground_testing::tiny_segmenter;

    pub(super) fn frame() -> Frame {
        let intrinsics =
            Intrinsics { width: 96, height: 64, fx: 80.0, fy: 80.0, cx: 47.5, cy: 31.5 };
        let camera = Camera::new(intrinsics, &Isometry3::identity());
        let color = RgbImage::from_fn(96, 64, |x, y| {
            if (30..60).contains(&x) && (20..44).contains(&y) {
                Rgb([220, 30, 30])
            } else {
                Rgb([40, 60, 90])
            }
        });
        let depth = DepthImage { width: 96, height: 64, depth_m: vec![2.0; 96 * 64] };
        Frame { index: FrameIndex(0), color, depth, color_camera: camera, depth_camera: camera }
    }

    fn masks(bundle: &str, settings: SamSettings) -> IdImage {
        let frames = EncodedFrames::new(tiny_segmenter(bundle), None, 0).unwrap();
        SamMasks {
            frames: &frames,
            settings,
            segments: RgbdSettings::default(),
            name: "tiny".into(),
        }
        .masks(&frame(), &Progress::silent())
        .unwrap()
        .remove(0)
    }

    /// Random weights: only the existence, bounds and reproducibility of the masks can be checked.
    #[test]
    fn grid_prompts_give_one_id_image_for_every_family() {
        let open = SamSettings {
            points_per_side: 4,
            min_predicted_iou: -10.0,
            min_stability: 0.0,
            max_area: 1.0,
            ..SamSettings::default()
        };
        for bundle in ["tiny-segmenter", "tiny-segmenter-sam"] {
            let found = masks(bundle, open);
            assert_eq!((found.width, found.height), (96, 64));
            assert!(found.count() > 0, "{bundle}");
            assert_eq!(found, masks(bundle, open), "{bundle}");
            let few = masks(bundle, SamSettings { max_masks: 1, ..open });
            assert_eq!(few.count(), 1, "{bundle}");
            assert_eq!(masks(bundle, SamSettings { min_predicted_iou: 100.0, ..open }).count(), 0);
            assert!(masks(bundle, SamSettings { quarters: true, ..open }).count() > 0);
        }
    }

    #[test]
    fn cancellation_is_checked_between_model_calls() {
        let frames = EncodedFrames::new(tiny_segmenter("tiny-segmenter"), None, 0).unwrap();
        let progress = Progress::new(|_, _| {}, || true);
        let masks = SamMasks {
            frames: &frames,
            settings: SamSettings::default(),
            segments: RgbdSettings::default(),
            name: "tiny".into(),
        }
        .masks(&frame(), &progress);
        assert!(matches!(masks, Err(ParseError::Cancelled(_))));
    }

    /// A part of a thing, with lower confidence than the whole.
    #[test]
    fn painting_order_decides_which_mask_is_on_top() {
        let segmenter = tiny_segmenter("tiny-segmenter");
        let size = segmenter.mask_size();
        let window = CropWindow {
            left: 0,
            top: 0,
            width: 96,
            height: 64,
            scale: (size as f32 / 96.0, size as f32 / 64.0),
        };
        let square = |quality: f32, reach: usize| {
            let inside = |u: usize, v: usize, of: usize| {
                u.abs_diff(of / 2) < reach * of / 100 && v.abs_diff(of / 2) < reach * of / 100
            };
            let logits: Vec<f32> = (0..size * size)
                .map(|i| if inside(i % size, i / size, size) { 9.0 } else { -9.0 })
                .collect();
            let bits: Vec<bool> =
                (0..GRID * GRID).map(|i| inside(i % GRID, i / GRID, GRID)).collect();
            let word = |bits: &[bool]| {
                bits.iter().enumerate().fold(0, |word, (bit, on)| word | u64::from(*on) << bit)
            };
            let area = bits.iter().filter(|on| **on).count() as u32;
            MaskCandidate {
                quality,
                cells: bits.chunks(64).map(word).collect(),
                area,
                patch: MaskPatch::crop(&logits, 0.0),
                window,
            }
        };
        let painted = |order| {
            let masks = vec![square(0.9, 40), square(0.6, 15)];
            paint::paint(
                &masks,
                &segmenter,
                &SamSettings { order, ..SamSettings::default() },
                &frame(),
            )
        };
        // Ids follow the order of painting.
        let (images, by_size) =
            (painted(MaskOrder::AscendingQuality), painted(MaskOrder::LargerFirst).remove(0));
        let [by_quality, wholes] = &images[..] else { panic!("expected two images") };
        assert_eq!(
            (wholes.count(), wholes.at((48, 32))),
            (1, 1),
            "the large mask is left out: it covers more than a quarter of the picture"
        );
        assert_eq!(
            (by_quality.at((48, 32)), by_quality.at((20, 32))),
            (2, 2),
            "the more confident mask covers its part"
        );
        assert_eq!(
            (by_size.at((48, 32)), by_size.at((20, 32)), by_size.at((2, 2))),
            (2, 1, 0),
            "the part is painted over its whole"
        );
    }

    #[test]
    fn mask_patch_contains_the_inside_and_its_border() {
        let logits: Vec<f32> = (0..64_u8)
            .map(|i| {
                if (2..5).contains(&(i % 8)) && (3..5).contains(&(i / 8)) {
                    4.0
                } else {
                    -f32::from(i)
                }
            })
            .collect();
        let patch = MaskPatch::crop(&logits, 0.0);
        assert_eq!((patch.left, patch.top, patch.width, patch.logits.len()), (1, 2, 5, 20));
        let mut spread = vec![0.0; 64];
        patch.write_into(-99.0, &mut spread);
        assert_eq!((spread[3 * 8 + 2], spread[3 * 8 + 1], spread[3 * 8]), (4.0, -25.0, -99.0));
        assert!(MaskPatch::crop(&[-1.0; 16], 0.0).logits.is_empty());
    }

    #[test]
    fn cell_lookup_places_the_window_where_it_was_cut() {
        let window = CropWindow { left: 50, top: 0, width: 50, height: 100, scale: (0.64, 0.32) };
        let lookup = cell_lookup(window, (100, 100), 32);
        assert_eq!(lookup[0], u32::MAX, "left of the window");
        // The window's first column is at the picture's middle.
        assert_eq!((lookup[GRID / 2], lookup[GRID - 1]), (0, 31));
        assert_eq!(lookup[GRID * GRID - 1], 32 * 32 - 1);
    }

    #[test]
    fn of_two_overlapping_masks_the_better_one_is_kept() {
        let frames = EncodedFrames::new(tiny_segmenter("tiny-segmenter"), None, 0).unwrap();
        let sam = SamMasks {
            frames: &frames,
            settings: SamSettings::default(),
            segments: RgbdSettings::default(),
            name: "tiny".into(),
        };
        let window = CropWindow { left: 0, top: 0, width: 96, height: 64, scale: (1.0, 1.0) };
        let candidate = |quality: f32, cells: u64| MaskCandidate {
            quality,
            cells: vec![cells],
            area: cells.count_ones(),
            patch: MaskPatch::default(),
            window,
        };
        let kept = sam.suppress_overlaps(vec![
            candidate(0.6, 0xff),
            candidate(0.9, 0x7f),
            candidate(0.5, 0xff00),
        ]);
        assert_eq!(kept.iter().map(|c| c.quality).collect::<Vec<_>>(), [0.9, 0.5]);
    }
}
