//! Evidence views: the frames that show an instance best, from different sides (paper: 3).

use super::ParseError;
use super::appearance::Outlines;
use super::labels::Labels;
use super::lifting::MasksOfFrames;
use super::masks::IdRuns;
use super::outline::{Outline, unoccluded_share};
use super::relief::{FlatCandidates, FlatHeights, FlatRelief};
use super::sharpness::SharpnessOfFrames;
use super::visibility::{FramePoint, PointVisibility, SAMPLED, Visibility, is_sampled};
use rayon::prelude::*;
use std::collections::BTreeMap;
use uniground_geometry::Point3;
use uniground_geometry::progress::Progress;
use uniground_geometry::scene::{
    Camera, DepthImage, FrameIndex, FrameRef, Instance, InstanceId, View, stream_frames,
};
use uniground_geometry::statistics::{median, quantile};
use uniground_types::settings::ViewSettings;

/// The points of a scene by instance, prepared for look-ups in frames.
#[derive(Clone, Copy)]
pub struct LabeledPoints<'a> {
    /// The instances of each point.
    pub labels: &'a Labels<'a>,
    /// The points.
    pub visibility: &'a Visibility,
}

/// The visibility of one instance in one frame.
#[derive(Debug, Clone, PartialEq)]
pub struct Sighting {
    /// The visible instance.
    pub instance: InstanceId,
    /// The frame, the number of points it shows, the box around them, and the pixels that show the
    /// instance.
    pub view: View,
    /// Share of the instance that is in the picture and not hidden by anything else, `0..=1`.
    pub whole: f32,
    /// Number of pixels that show it.
    pub covered_px: f32,
    /// IoU of its visible points and the mask that fits them best; 0 without masks.
    pub agreement: f32,
}

/// What the frames show of the candidate instances.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct InstanceViews {
    /// Sorted by frame.
    pub sightings: Vec<Sighting>,
    /// Reliefs of things that lie flat on a plane.
    pub reliefs: BTreeMap<InstanceId, FlatRelief>,
}

/// A point of an instance, as pixels of a frame.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct InstancePixel {
    /// The instance it belongs to.
    pub instance: InstanceId,
    /// Column and row in the color picture.
    pub at: (f32, f32),
    /// Pixel of the depth image.
    pub cell: (u32, u32),
}

/// Returns the visible points of every instance this frame shows, sorted by instance.
#[must_use]
pub fn visible_pixels(
    labeled: LabeledPoints,
    frame: &FrameRef,
    depth: &DepthImage,
) -> Vec<InstancePixel> {
    group_by_instance(
        labeled.labels,
        frame,
        &labeled.visibility.in_frame(&frame.depth_camera(), depth),
    )
    .0
}

/// Points of instances that lie inside the picture but are not visible.
#[derive(Default)]
struct UnseenPoints {
    /// Hidden points, with their column and row in the color picture, sorted by instance.
    hidden: Vec<(InstanceId, (f32, f32))>,
    /// Number of points per instance whose visibility is unknown, by id minus 1.
    unknown: Vec<u32>,
}

impl UnseenPoints {
    fn hidden_of(&self, instance: InstanceId) -> &[(InstanceId, (f32, f32))] {
        let first = self.hidden.partition_point(|(of, _)| *of < instance);
        let after = self.hidden.partition_point(|(of, _)| *of <= instance);
        &self.hidden[first..after]
    }
}

/// Projects points into the color picture, once for each instance they belong to: the visible ones,
/// sorted by instance, and the others.
fn group_by_instance(
    labels: &Labels,
    frame: &FrameRef,
    points: &[FramePoint],
) -> (Vec<InstancePixel>, UnseenPoints) {
    let color_camera = frame.color_camera();
    let (mut pixels, mut unseen) = (
        Vec::with_capacity(points.len()),
        UnseenPoints { unknown: vec![0; labels.len()], ..UnseenPoints::default() },
    );
    for &FramePoint { point, position, cell, sight } in points {
        let Some(pixel) = color_camera.project(&position) else { continue };
        let (instances, at) = (labels.instances_of_point(point as usize), (pixel.u, pixel.v));
        match sight {
            PointVisibility::Visible => {
                pixels.extend(instances.map(|instance| InstancePixel { instance, at, cell }));
            }
            PointVisibility::Hidden => {
                unseen.hidden.extend(instances.map(|instance| (instance, at)));
            }
            PointVisibility::Unknown => {
                instances.for_each(|instance| unseen.unknown[instance.0 as usize - 1] += 1);
            }
        }
    }
    pixels.sort_by_key(|pixel| pixel.instance);
    unseen.hidden.sort_by_key(|(instance, _)| *instance);
    (pixels, unseen)
}

/// Returns every instance this frame shows, in order of id, given the frame's
/// [`around_frame`](Visibility::around_frame). `masks` are the frame's id images. `sampled` counts
/// the points of each instance that are also reported where they are not visible.
///
/// The box in the picture is robust: the outermost 1 % of the visible points at each side are left
/// out.
fn sightings(
    labeled: LabeledPoints,
    sampled: &[u32],
    frame: &FrameRef,
    points: &[FramePoint],
    masks: &[IdRuns],
) -> Vec<Sighting> {
    let (hits, unseen) = group_by_instance(labeled.labels, frame, points);
    let (width, height) = (frame.color_intrinsics.width, frame.color_intrinsics.height);
    let agreements = agreements(&hits, labeled.labels.things, masks);
    hits.chunk_by(|a, b| a.instance == b.instance)
        .map(|hits| {
            // At least one pixel each way, inside the picture.
            let span = |of: fn(&InstancePixel) -> f32, len: u32| {
                let mut along: Vec<f32> = hits.iter().map(of).collect();
                let mut bound = |q| quantile(&mut along, q).unwrap_or(0.0);
                let low = bound(TRIM).floor().clamp(0.0, len as f32 - 1.0) as u32;
                (low, (bound(1.0 - TRIM).ceil() as u32).clamp(low + 1, len))
            };
            let ((left, right), (top, bottom)) =
                (span(|hit| hit.at.0, width), span(|hit| hit.at.1, height));
            let box_px = [left, top, right, bottom];
            let instance = hits[0].instance;
            let at: Vec<(f32, f32)> = hits.iter().map(|hit| hit.at).collect();
            let outline = Outline::from_points(&at, box_px);
            let view = View {
                frame: frame.index,
                visible_points: hits.len() as u32,
                box_px,
                mask: Some(outline.mask.to_view_mask()),
            };
            let agreement = agreements.get(&instance).copied().unwrap_or(0.0);
            let of_instance = instance.0 as usize - 1;
            let whole = visible_share(
                &at,
                unseen.hidden_of(instance),
                unseen.unknown[of_instance],
                sampled[of_instance],
            );
            Sighting { instance, view, whole, covered_px: outline.covered_px(), agreement }
        })
        .collect()
}

/// Returns the share of an instance that is in the picture, times the unoccluded share of that.
///
/// Points that are not visible are known only for a sample of `sampled` points.
fn visible_share(
    visible: &[(f32, f32)],
    hidden: &[(InstanceId, (f32, f32))],
    unknown: u32,
    sampled: u32,
) -> f32 {
    let hidden: Vec<(f32, f32)> = hidden.iter().map(|(_, at)| *at).collect();
    // Thins out the visible points to the same sampling rate.
    let visible: Vec<(f32, f32)> = visible.iter().step_by(SAMPLED as usize).copied().collect();
    let in_picture = visible.len() as f32 + hidden.len() as f32 + unknown as f32;
    (in_picture / sampled.max(1) as f32).min(1.0) * unoccluded_share(&visible, &hidden)
}

/// What a frame shows of one instance.
struct InstanceInFrame {
    instance: InstanceId,
    visible: u32,
    /// Visible points per mask, sorted by mask; 0: under none.
    masks: Vec<(u16, u32)>,
}

/// Returns the best IoU of visible points and a mask for each instance. Things have ids up to
/// `things`; the other instances overlap them.
fn agreements(hits: &[InstancePixel], things: u32, masks: &[IdRuns]) -> BTreeMap<InstanceId, f32> {
    let mut best: BTreeMap<InstanceId, f32> = BTreeMap::new();
    for ids in masks.iter().map(IdRuns::to_image) {
        let mut of_mask: BTreeMap<u16, u32> = BTreeMap::new();
        let mut held: Vec<InstanceInFrame> = Vec::new();
        for same in hits.chunk_by(|a, b| a.instance == b.instance) {
            let mut own: Vec<u16> = same.iter().map(|hit| ids.at(hit.cell)).collect();
            own.sort_unstable();
            let masks: Vec<(u16, u32)> =
                own.chunk_by(|a, b| a == b).map(|same| (same[0], same.len() as u32)).collect();
            let instance = same[0].instance;
            if instance.0 <= things {
                masks.iter().for_each(|&(mask, n)| *of_mask.entry(mask).or_insert(0) += n);
            }
            held.push(InstanceInFrame { instance, visible: same.len() as u32, masks });
        }
        for InstanceInFrame { instance, visible, masks } in held {
            let iou =
                |&(mask, both): &(u16, u32)| both as f32 / (visible + of_mask[&mask] - both) as f32;
            if let Some(iou) = masks.iter().filter(|(mask, _)| *mask != 0).map(iou).reduce(f32::max)
            {
                let so_far = best.entry(instance).or_default();
                *so_far = so_far.max(iou);
            }
        }
    }
    best
}

const TRIM: f32 = 0.01;

/// Computes the [`sightings`] of all frames, in order; decodes only their depth. Frames without
/// `masks` have zero agreement.
///
/// # Errors
/// [`ParseError`]: an unreadable frame, or cancellation.
pub fn compute_sightings(
    labeled: LabeledPoints,
    frames: &[FrameRef],
    masks: &MasksOfFrames,
    progress: &Progress,
) -> Result<Vec<Sighting>, ParseError> {
    Ok(compute_instance_views(labeled, None, frames, masks, progress)?.sightings)
}

/// Computes the same as [`compute_sightings`], plus the reliefs of flat things.
///
/// # Errors
/// [`ParseError`]: an unreadable frame, or cancellation.
pub fn compute_instance_views(
    labeled: LabeledPoints,
    flats: Option<&FlatCandidates>,
    frames: &[FrameRef],
    masks: &MasksOfFrames,
    progress: &Progress,
) -> Result<InstanceViews, ParseError> {
    let (mut all, mut heights) = (Vec::new(), FlatHeights::default());
    let sampled = labeled.labels.counts(is_sampled);
    stream_frames(
        frames,
        |frame| {
            progress.check()?;
            let masks = masks.get(&frame.index).map_or(&[][..], Vec::as_slice);
            let depth = frame.decode_depth()?;
            let camera = frame.depth_camera();
            let points = labeled.visibility.around_frame(&camera, &depth);
            let heights = flats
                .map(|flats| flats.measure_heights(&camera, &depth, &points))
                .unwrap_or_default();
            Ok::<_, ParseError>((sightings(labeled, &sampled, frame, &points, masks), heights))
        },
        |i, (seen, of_frame)| {
            all.extend(seen);
            heights.merge(of_frame);
            Ok(progress.report("views", (i + 1) as f32 / frames.len() as f32)?)
        },
    )?;
    Ok(InstanceViews {
        sightings: all,
        reliefs: flats.map(|flats| flats.compute_reliefs(heights)).unwrap_or_default(),
    })
}

/// Chooses the views of each instance: the best first, then those with the farthest camera centers
/// among the frames that show it well.
pub fn choose_views(
    instances: &mut [Instance],
    sightings: Vec<Sighting>,
    frames: &[FrameRef],
    sharpness: &SharpnessOfFrames,
    settings: &ViewSettings,
) {
    let mut per_instance: Vec<Vec<Sighting>> = vec![Vec::new(); instances.len()];
    for sighting in sightings {
        per_instance[sighting.instance.0 as usize - 1].push(sighting);
    }
    instances.par_iter_mut().zip(per_instance).for_each(|(instance, seen)| {
        let center = |frame: FrameIndex| {
            let at = frames.binary_search_by_key(&frame, |f| f.index);
            at.map_or_else(|_| Point3::origin(), |i| Camera::center(&frames[i].color_camera()))
        };
        instance.views = select_distant(score_views(seen, sharpness), settings, center);
    });
}

/// Applies the outlines that a segmenter has corrected.
pub fn apply_outlines(instances: &mut [Instance], outlines: &Outlines) {
    for instance in instances {
        for view in &mut instance.views {
            if let Some(outline) =
                outlines.get(&view.frame).and_then(|of_frame| of_frame.get(&instance.id))
            {
                view.box_px = outline.box_px;
                view.mask = Some(outline.mask.to_view_mask());
            }
        }
    }
}

/// Picture size beyond which size matters less than how much of the thing is shown: collages and
/// sheets show no more pixels.
const ENOUGH_PX: f32 = 96.0 * 96.0;
/// A view counts as blurred below this share of the median sharpness of all views of the same
/// thing, and its score decreases in proportion.
const BLURRED: f32 = 0.5;
/// Minimum factor for a blurred view.
const LEAST_SHARP: f32 = 0.3;

/// Scores the views of one instance, `0..=1`: by how much of it is in the picture and not hidden,
/// how large it is, and how sharp.
///
/// The first counts squared: with half of a thing in view, it is at most a quarter as easy to
/// recognize, at any size.
fn score_views(seen: Vec<Sighting>, sharpness: &SharpnessOfFrames) -> Vec<(f32, View)> {
    let sharp: Vec<Option<f32>> =
        seen.iter().map(|s| Some(sharpness.get(&s.view.frame)?.within(s.view.box_px))).collect();
    let usual =
        median(&mut sharp.iter().flatten().copied().collect::<Vec<_>>()).unwrap_or(0.0) * BLURRED;
    let worth = |(sighting, sharp): (Sighting, Option<f32>)| {
        let size = sighting.covered_px / (sighting.covered_px + ENOUGH_PX);
        let clear = sharp
            .filter(|_| usual > 0.0)
            .map_or(1.0, |sharp| (sharp / usual).clamp(LEAST_SHARP, 1.0));
        (sighting.whole * sighting.whole * size * clear, sighting.view)
    };
    seen.into_iter().zip(sharp).map(worth).collect()
}

/// Selects the best view and distant ones from scored views.
fn select_distant(
    mut seen: Vec<(f32, View)>,
    settings: &ViewSettings,
    center: impl Fn(FrameIndex) -> Point3<f32>,
) -> Vec<View> {
    seen.sort_by(|(a, x), (b, y)| {
        b.total_cmp(a).then(y.visible_points.cmp(&x.visible_points)).then(x.frame.cmp(&y.frame))
    });
    let Some(least) = seen.first().map(|(best, _)| best * settings.min_share_of_best) else {
        return Vec::new();
    };
    let mut pool: Vec<View> =
        seen.into_iter().filter(|(worth, _)| *worth >= least).map(|(_, view)| view).collect();
    let mut chosen = vec![pool.remove(0)];
    while chosen.len() < settings.count as usize && !pool.is_empty() {
        let nearest_chosen = |view: &View| {
            let here = center(view.frame);
            chosen.iter().map(|c| (center(c.frame) - here).norm()).fold(f32::INFINITY, f32::min)
        };
        let farthest = (0..pool.len()).max_by(|&a, &b| {
            nearest_chosen(&pool[a]).total_cmp(&nearest_chosen(&pool[b])).then(b.cmp(&a))
        });
        chosen.push(pool.remove(farthest.unwrap_or(0)));
    }
    chosen
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::masks::IdImage;
    use crate::sharpness::Sharpness;
    use image::RgbImage;

    fn view(frame: u32) -> View {
        View { frame: FrameIndex(frame), visible_points: 9, box_px: [0, 0, 10, 10], mask: None }
    }

    fn sighting(frame: u32, whole: f32, covered_px: f32) -> Sighting {
        Sighting { instance: InstanceId(1), view: view(frame), whole, covered_px, agreement: 0.0 }
    }

    #[test]
    fn best_view_comes_first_and_is_followed_by_distant_views() {
        // Cameras stand on a line at x = frame number. Frame 9 hardly shows the thing. Frames 0 and
        // 2 are equally far from 1, and 2 shows more.
        let seen = [(0.8, 0), (1.0, 1), (0.9, 2), (0.7, 6), (0.1, 9)]
            .map(|(worth, frame)| (worth, view(frame)))
            .to_vec();
        let chosen =
            select_distant(seen, &ViewSettings::default(), |f| Point3::new(f.0 as f32, 0.0, 0.0));
        assert_eq!(chosen.iter().map(|v| v.frame.0).collect::<Vec<_>>(), [1, 6, 2]);
    }

    #[test]
    fn complete_large_and_sharp_views_score_higher() {
        let worth = |seen: &[Sighting], sharpness: &SharpnessOfFrames| -> Vec<f32> {
            score_views(seen.to_vec(), sharpness).into_iter().map(|(worth, _)| worth).collect()
        };
        let nothing_known = SharpnessOfFrames::new();
        let [half_hidden, whole, near] = worth(
            &[sighting(0, 0.5, 30_000.0), sighting(1, 1.0, 20_000.0), sighting(2, 1.0, 30_000.0)],
            &nothing_known,
        )[..] else {
            panic!("expected three views")
        };
        assert!(half_hidden < whole && whole < near);
        let even = RgbImage::from_pixel(32, 32, image::Rgb([90; 3]));
        let checked = RgbImage::from_fn(32, 32, |x, y| {
            image::Rgb([if (x / 3 + y / 3) % 2 == 0 { 200 } else { 20 }; 3])
        });
        let sharpness = [(0, &checked), (1, &even), (2, &checked)]
            .map(|(f, picture)| (FrameIndex(f), Sharpness::measure(picture)));
        let found = worth(&[0, 1, 2].map(|frame| sighting(frame, 1.0, 900.0)), &sharpness.into());
        assert!(found[0] == found[2] && found[1] < 0.5 * found[0], "{found:?}");
    }

    #[test]
    fn points_outside_the_picture_or_hidden_lower_the_visible_share() {
        let front: Vec<(f32, f32)> =
            (0..40).flat_map(|x| (0..40).map(move |y| (x as f32 * 2.0, y as f32 * 2.0))).collect();
        let beside: Vec<(InstanceId, (f32, f32))> = (0..20)
            .flat_map(|x| {
                (0..20).map(move |y| (InstanceId(1), (80.0 + x as f32 * 4.0, y as f32 * 4.0)))
            })
            .collect();
        assert_eq!(
            (visible_share(&front, &[], 0, 400), visible_share(&front, &[], 0, 800)),
            (1.0, 0.5),
            "half of it is outside the picture"
        );
        assert_eq!(
            visible_share(&front, &[], 400, 800),
            1.0,
            "points of unknown visibility do not count as hidden"
        );
        let covered = visible_share(&front, &beside, 0, 800);
        assert!((0.4..0.6).contains(&covered), "half of it is hidden: {covered}");
    }

    #[test]
    fn agreement_is_the_iou_with_the_best_fitting_mask() {
        // Six pixels in a row: instance 1 on four, 2 on two. Mask 5 is instance 1 minus a pixel;
        // mask 7 the rest.
        let hits: Vec<InstancePixel> = (0..6)
            .map(|i| InstancePixel {
                instance: InstanceId(if i < 4 { 1 } else { 2 }),
                at: (i as f32, 0.0),
                cell: (i, 0),
            })
            .collect();
        let image =
            |ids: [u16; 6]| IdRuns::from_image(&IdImage { width: 6, height: 1, ids: ids.to_vec() });
        let parts = image([5, 5, 5, 7, 7, 7]);
        let found = agreements(&hits, 2, std::slice::from_ref(&parts));
        assert_eq!(found, BTreeMap::from([(InstanceId(1), 0.75), (InstanceId(2), 2.0 / 3.0)]));
        let whole = agreements(&hits, 2, &[parts, image([3, 3, 3, 3, 0, 0])]);
        assert_eq!(whole, BTreeMap::from([(InstanceId(1), 1.0), (InstanceId(2), 2.0 / 3.0)]));
        assert!(agreements(&hits, 2, &[]).is_empty());
    }

    #[test]
    fn unseen_instance_has_no_views() {
        assert!(
            select_distant(Vec::new(), &ViewSettings::default(), |_| Point3::origin()).is_empty()
        );
    }
}
