//! Appearance embeddings: one vector per instance, the mean over crops of several views (paper:
//! multi-scale crops, 5 levels, 10 views).

use super::ParseError;
use super::correction::{Corrector, KnownMasks, Projection};
use super::lifting::MasksOfFrames;
use super::model_clock::PictureEncoder;
use super::outline::Outline;
use super::views::{LabeledPoints, Sighting, compute_sightings, visible_pixels};
use image::{RgbImage, imageops};
use std::collections::BTreeMap;
use uniground_geometry::progress::Progress;
use uniground_geometry::scene::{FrameIndex, FrameRef, Instance, InstanceId, Level, stream_frames};
use uniground_models::neural::DualEncoder;
use uniground_types::settings::AppearanceSettings;

/// Tight boxes in color pictures, by frame and instance: left, top, right, bottom, pixels.
pub type FrameBoxes = BTreeMap<FrameIndex, BTreeMap<InstanceId, [u32; 4]>>;

/// Returns the frames in which each instance is embedded, with its projected box in each. Parts and
/// wholes get half as many frames as things, because they overlap them.
#[must_use]
pub fn choose_frames(
    instances: &[Instance],
    sightings: &[Sighting],
    settings: &AppearanceSettings,
) -> FrameBoxes {
    let mut of_instance: Vec<Vec<&Sighting>> = vec![Vec::new(); instances.len()];
    for sighting in sightings {
        of_instance[sighting.instance.0 as usize - 1].push(sighting);
    }
    let mut boxes = FrameBoxes::new();
    for (instance, mut seen) in instances.iter().zip(of_instance) {
        seen.sort_by_key(|s| (std::cmp::Reverse(s.view.visible_points), s.view.frame));
        let least = settings.min_visible * instance.point_count as f32;
        let enough =
            |(rank, s): &(usize, &Sighting)| *rank == 0 || s.view.visible_points as f32 > least;
        let views = if instance.level == Level::Thing {
            settings.views
        } else {
            (settings.views / 2).max(1)
        };
        for (_, sighting) in seen.into_iter().enumerate().filter(enough).take(views as usize) {
            boxes.entry(sighting.view.frame).or_default().insert(instance.id, sighting.view.box_px);
        }
    }
    boxes
}

/// A segmenter that corrects outlines, and the masks that are already known.
#[derive(Clone, Copy)]
pub struct Correction<'a> {
    /// Asks the segmenter.
    pub corrector: &'a Corrector<'a>,
    /// The id images of each frame.
    pub known: &'a MasksOfFrames,
}

/// Outlines that a segmenter found for instances, by frame and instance.
pub type Outlines = BTreeMap<FrameIndex, BTreeMap<InstanceId, Outline>>;

/// Returns one vector per instance, row after row (none without an encoder), and the outlines that
/// a segmenter corrected. The encoder sees the corrected boxes.
///
/// # Errors
/// [`ParseError`]: an unreadable frame, a model that fails, cancellation.
pub fn embed_instances(
    frames: &[FrameRef],
    instances: &[Instance],
    boxes: &FrameBoxes,
    labeled: LabeledPoints,
    (correction, encoder): (Option<Correction>, Option<&PictureEncoder>),
    settings: &AppearanceSettings,
    progress: &Progress,
) -> Result<(Vec<f32>, Outlines), ParseError> {
    let wanted: Vec<FrameRef> =
        frames.iter().filter(|frame| boxes.contains_key(&frame.index)).cloned().collect();
    let dim = encoder.map_or(0, PictureEncoder::dim);
    let mut sums = vec![0.0_f64; instances.len() * dim];
    let mut outlines = Outlines::new();
    stream_frames(
        &wanted,
        |frame| {
            progress.check()?;
            let mut seen = boxes[&frame.index].clone();
            let picture = frame.decode_color()?;
            let corrected = match correction {
                Some(correction) => {
                    correct_outlines(frame, &picture, labeled, correction, &seen, progress)?
                }
                None => BTreeMap::new(),
            };
            seen.extend(corrected.iter().map(|(instance, outline)| (*instance, outline.box_px)));
            let embedded = match encoder {
                Some(encoder) => embed(&picture, &seen, encoder, settings, progress)?,
                None => Vec::new(),
            };
            Ok::<_, ParseError>((frame.index, corrected, embedded))
        },
        |i, (frame, corrected, embedded)| {
            for (instance, sum) in embedded {
                let row = &mut sums[(instance.0 as usize - 1) * dim..][..dim];
                row.iter_mut().zip(sum).for_each(|(total, v)| *total += f64::from(v));
            }
            outlines.insert(frame, corrected);
            Ok(progress.report("appearance", (i + 1) as f32 / wanted.len() as f32)?)
        },
    )?;
    Ok((if dim > 0 { normalize_rows(&sums, dim) } else { Vec::new() }, outlines))
}

/// Returns one vector per instance, row after row, for instances whose points are already known.
/// Projected boxes are not corrected.
///
/// # Errors
/// As [`embed_instances`].
pub fn embed_known(
    frames: &[FrameRef],
    instances: &[Instance],
    labeled: LabeledPoints,
    encoder: &DualEncoder,
    settings: &AppearanceSettings,
) -> Result<Vec<f32>, ParseError> {
    let quiet = Progress::silent();
    let seen = compute_sightings(labeled, frames, &MasksOfFrames::new(), &quiet)?;
    let boxes = choose_frames(instances, &seen, settings);
    Ok(embed_instances(
        frames,
        instances,
        &boxes,
        labeled,
        (None, Some(&PictureEncoder::new(encoder))),
        settings,
        &quiet,
    )?
    .0)
}

/// Returns the masks that agree with the projection, for instances with projected boxes.
fn correct_outlines(
    frame: &FrameRef,
    picture: &RgbImage,
    labeled: LabeledPoints,
    Correction { corrector, known }: Correction,
    boxes: &BTreeMap<InstanceId, [u32; 4]>,
    progress: &Progress,
) -> Result<BTreeMap<InstanceId, Outline>, ParseError> {
    let depth = frame.decode_depth()?;
    let known: Vec<KnownMasks> = known
        .get(&frame.index)
        .into_iter()
        .flatten()
        .map(|masks| KnownMasks::from_runs(masks, frame))
        .collect();
    let (mut encoded, mut outlines) = (None, BTreeMap::new());
    let pixels = visible_pixels(labeled, frame, &depth);
    for of_instance in pixels.chunk_by(|a, b| a.instance == b.instance) {
        progress.check()?;
        let instance = of_instance[0].instance;
        if !boxes.contains_key(&instance) {
            continue;
        }
        // Sorted, so that the corrector's random draws depend on the picture and not on the order
        // of the cloud.
        let mut pixels: Vec<(f32, f32)> = of_instance.iter().map(|point| point.at).collect();
        pixels.sort_unstable_by(|a, b| a.0.total_cmp(&b.0).then(a.1.total_cmp(&b.1)));
        let projection = Projection { instance, frame: frame.index, pixels: &pixels };
        let size = picture.dimensions();
        let mut corrected =
            known.iter().find_map(|known| corrector.known_outline(known, &projection, size));
        if corrected.is_none() {
            let encoded = match &encoded {
                Some(encoded) => encoded,
                None => encoded.insert(corrector.frames.encode(frame.index, picture)?),
            };
            corrected = corrector.segment_outline(encoded, &projection, size)?;
        }
        outlines.extend(corrected.map(|outline| (instance, outline)));
    }
    corrector.frames.remove(frame.index);
    Ok(outlines)
}

/// Sums the unit vectors over the crops of each box of one picture.
fn embed(
    picture: &RgbImage,
    boxes: &BTreeMap<InstanceId, [u32; 4]>,
    encoder: &PictureEncoder,
    settings: &AppearanceSettings,
    progress: &Progress,
) -> Result<Vec<(InstanceId, Vec<f32>)>, ParseError> {
    let levels = settings.levels as usize;
    let crops: Vec<RgbImage> =
        boxes.values().flat_map(|tight| crops(picture, *tight, settings)).collect();
    let vectors = encoder.embed(&crops, progress)?;
    let summed = |vectors: &[Vec<f32>]| {
        let mut sum = vec![0.0; encoder.dim()];
        vectors
            .iter()
            .for_each(|vector| sum.iter_mut().zip(vector).for_each(|(total, v)| *total += v));
        sum
    };
    Ok(boxes.keys().copied().zip(vectors.chunks(levels).map(summed)).collect())
}

/// Returns the box with its surroundings, level by level, clipped to the picture.
fn crops(
    picture: &RgbImage,
    [left, top, right, bottom]: [u32; 4],
    settings: &AppearanceSettings,
) -> impl Iterator<Item = RgbImage> {
    (0..settings.levels).map(move |level| {
        let share = settings.level_step * level as f32;
        let grown = |length: u32| (length as f32 * share).round() as u32;
        let (mx, my) = (grown(right - left), grown(bottom - top));
        let (x, y) = (left.saturating_sub(mx), top.saturating_sub(my));
        let (x2, y2) = ((right + mx).min(picture.width()), (bottom + my).min(picture.height()));
        imageops::crop_imm(picture, x, y, x2 - x, y2 - y).to_image()
    })
}

/// Scales sums to unit length; instances that were never seen stay zero.
fn normalize_rows(sums: &[f64], dim: usize) -> Vec<f32> {
    let mut rows = Vec::with_capacity(sums.len());
    for sum in sums.chunks_exact(dim) {
        let norm = sum.iter().map(|v| v * v).sum::<f64>().sqrt();
        rows.extend(sum.iter().map(|v| if norm > 0.0 { (v / norm) as f32 } else { 0.0 }));
    }
    rows
}

#[cfg(test)]
mod tests {
    use super::*;
    use uniground_geometry::scene::{Support, View};
    use uniground_testing::thing;
    use uniground_testing::tiny_encoder;

    fn sighting(instance: u32, frame: u32, visible_points: u32) -> Sighting {
        Sighting {
            instance: InstanceId(instance),
            view: View {
                frame: FrameIndex(frame),
                visible_points,
                box_px: [frame, 0, frame + 9, 9],
                mask: None,
            },
            whole: 1.0,
            covered_px: 81.0,
            agreement: 0.0,
        }
    }

    #[test]
    fn frames_are_chosen_by_visible_points_and_include_the_best() {
        let instances: Vec<Instance> = (1..=2)
            .map(|id| thing(id, [0.0, 0.0], [1.0, 1.0, 1.0], 0.0, Support::Floor, [90; 3]))
            .collect();
        let seen = [
            sighting(1, 0, 900),
            sighting(1, 1, 100),
            sighting(1, 2, 400),
            sighting(1, 3, 500),
            sighting(2, 1, 7),
            sighting(2, 2, 5),
        ];
        let settings = AppearanceSettings { views: 2, ..AppearanceSettings::default() };
        let frames_of = |boxes: &FrameBoxes, id| {
            boxes
                .iter()
                .filter(|(_, b)| b.contains_key(&InstanceId(id)))
                .map(|(f, _)| f.0)
                .collect::<Vec<_>>()
        };
        let chosen = choose_frames(&instances, &seen, &settings);
        assert_eq!((frames_of(&chosen, 1), frames_of(&chosen, 2)), (vec![0, 3], vec![1]));
        assert_eq!(chosen[&FrameIndex(3)][&InstanceId(1)], [3, 0, 12, 9]);
    }

    #[test]
    fn crops_grow_per_level_and_stay_inside_the_picture() {
        let picture = RgbImage::new(100, 80);
        let settings =
            AppearanceSettings { levels: 3, level_step: 0.1, ..AppearanceSettings::default() };
        let sizes: Vec<_> =
            crops(&picture, [10, 20, 50, 40], &settings).map(|c| c.dimensions()).collect();
        assert_eq!(sizes, [(40, 20), (48, 24), (56, 28)]);
        assert_eq!(
            crops(&picture, [0, 0, 100, 80], &settings).last().unwrap().dimensions(),
            (100, 80)
        );
    }

    #[test]
    fn embeddings_do_not_depend_on_other_boxes_and_are_normalized() {
        let encoder = tiny_encoder();
        let encoder = PictureEncoder::new(&encoder);
        let picture =
            RgbImage::from_fn(90, 60, |x, y| image::Rgb([(x * 2) as u8, (y * 3) as u8, 70]));
        let boxes =
            BTreeMap::from([(InstanceId(1), [5, 5, 40, 40]), (InstanceId(2), [30, 10, 80, 50])]);
        let settings = AppearanceSettings::default();
        let both = embed(&picture, &boxes, &encoder, &settings, &Progress::silent()).unwrap();
        let alone = embed(
            &picture,
            &BTreeMap::from([(InstanceId(2), [30, 10, 80, 50])]),
            &encoder,
            &settings,
            &Progress::silent(),
        )
        .unwrap();
        assert!(both[1].1.iter().zip(&alone[0].1).all(|(a, b)| (a - b).abs() < 1e-4));
        let stopped =
            embed(&picture, &boxes, &encoder, &settings, &Progress::new(|_, _| {}, || true));
        assert!(matches!(stopped, Err(ParseError::Cancelled(_))));
        let sums: Vec<f64> = both
            .iter()
            .flat_map(|(_, sum)| sum.iter().map(|v| f64::from(*v)))
            .chain(vec![0.0; encoder.dim()])
            .collect();
        let rows = normalize_rows(&sums, encoder.dim());
        let norms: Vec<f32> =
            rows.chunks(encoder.dim()).map(|row| row.iter().map(|v| v * v).sum::<f32>()).collect();
        assert!((norms[0] - 1.0).abs() < 1e-5 && (norms[1] - 1.0).abs() < 1e-5 && norms[2] == 0.0);
    }
}
