//! Evidence views: the frames that show an instance best, from different sides (paper: 3).

use super::ParseError;
use super::appearance::Boxes;
use super::labels::Labels;
use super::lifting::MasksOfFrames;
use super::masks::IdRuns;
use super::visibility::{Visibility, VisiblePoint};
use crate::geometry::Point3;
use crate::geometry::statistics::quantile;
use crate::progress::Progress;
use crate::scene::{Camera, DepthImage, FrameIndex, FrameRef, Instance, InstanceId, View, stream_frames};
use rayon::prelude::*;
use std::collections::BTreeMap;
use uniground_types::settings::ViewSettings;

/// The points of a scene by instance, ready to be looked up in frames.
#[derive(Clone, Copy)]
pub struct Labelled<'a> {
    /// The instances of each point.
    pub labels: &'a Labels<'a>,
    /// The points.
    pub visibility: &'a Visibility,
}

/// One frame's sight of one instance.
#[derive(Debug, Clone, PartialEq)]
pub struct Sighting {
    /// What is seen.
    pub instance: InstanceId,
    /// The frame, how many points it shows, and the box around them.
    pub view: View,
    /// IoU of the points it shows and those of the mask that fits them best; 0 without masks.
    pub agreement: f32,
}

/// A visible point of an instance in the pictures of a frame.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct InstancePixel {
    /// What it belongs to.
    pub instance: InstanceId,
    /// Column and row in the colour picture.
    pub at: (f32, f32),
    /// Pixel of the depth image.
    pub cell: (u32, u32),
}

/// The visible points of every instance this frame shows, sorted by instance.
#[must_use]
pub fn visible_pixels(labelled: Labelled, frame: &FrameRef, depth: &DepthImage) -> Vec<InstancePixel> {
    let (Labelled { labels, visibility }, colour_camera) = (labelled, frame.colour_camera());
    let mut pixels: Vec<InstancePixel> = visibility
        .in_frame(&frame.depth_camera(), depth)
        .into_iter()
        .filter_map(|VisiblePoint { point, position, cell }| {
            let pixel = colour_camera.project(&position)?;
            Some(
                labels
                    .of(point as usize)
                    .map(move |instance| InstancePixel { instance, at: (pixel.u, pixel.v), cell }),
            )
        })
        .flatten()
        .collect();
    pixels.sort_by_key(|pixel| pixel.instance);
    pixels
}

/// Every instance this frame shows, in order of id; `masks` are the frame's id images.
///
/// The box in the picture is robust: the outermost 1 % of the visible points at each side are left out.
#[must_use]
pub fn sightings(labelled: Labelled, frame: &FrameRef, depth: &DepthImage, masks: &[IdRuns]) -> Vec<Sighting> {
    let hits = visible_pixels(labelled, frame, depth);
    let (width, height) = (frame.colour_intrinsics.width, frame.colour_intrinsics.height);
    let agreements = agreements(&hits, labelled.labels.things, masks);
    hits.chunk_by(|a, b| a.instance == b.instance)
        .map(|hits| {
            // At least one pixel each way, inside the picture.
            let span = |of: fn(&InstancePixel) -> f32, len: u32| {
                let mut along: Vec<f32> = hits.iter().map(of).collect();
                let mut bound = |q| quantile(&mut along, q).unwrap_or(0.0);
                let low = bound(TRIM).floor().clamp(0.0, len as f32 - 1.0) as u32;
                (low, (bound(1.0 - TRIM).ceil() as u32).clamp(low + 1, len))
            };
            let ((left, right), (top, bottom)) = (span(|hit| hit.at.0, width), span(|hit| hit.at.1, height));
            let box_px = [left, top, right, bottom];
            let instance = hits[0].instance;
            let view = View { frame: frame.index, visible_points: hits.len() as u32, box_px };
            Sighting { instance, view, agreement: agreements.get(&instance).copied().unwrap_or(0.0) }
        })
        .collect()
}

/// What a frame shows of one instance.
struct Held {
    instance: InstanceId,
    visible: u32,
    /// Visible points per mask, sorted by mask; 0: under none.
    masks: Vec<(u16, u32)>,
}

/// For each instance the best IoU of its visible points with those of a mask. Things have ids up to `things`; the others overlap them.
fn agreements(hits: &[InstancePixel], things: u32, masks: &[IdRuns]) -> BTreeMap<InstanceId, f32> {
    let mut best: BTreeMap<InstanceId, f32> = BTreeMap::new();
    for ids in masks.iter().map(IdRuns::unpacked) {
        let mut of_mask: BTreeMap<u16, u32> = BTreeMap::new();
        let mut held: Vec<Held> = Vec::new();
        for same in hits.chunk_by(|a, b| a.instance == b.instance) {
            let mut own: Vec<u16> = same.iter().map(|hit| ids.at(hit.cell)).collect();
            own.sort_unstable();
            let masks: Vec<(u16, u32)> = own.chunk_by(|a, b| a == b).map(|same| (same[0], same.len() as u32)).collect();
            let instance = same[0].instance;
            if instance.0 <= things {
                masks.iter().for_each(|&(mask, n)| *of_mask.entry(mask).or_insert(0) += n);
            }
            held.push(Held { instance, visible: same.len() as u32, masks });
        }
        for Held { instance, visible, masks } in held {
            let iou = |&(mask, both): &(u16, u32)| both as f32 / (visible + of_mask[&mask] - both) as f32;
            if let Some(iou) = masks.iter().filter(|(mask, _)| *mask != 0).map(iou).reduce(f32::max) {
                let so_far = best.entry(instance).or_default();
                *so_far = so_far.max(iou);
            }
        }
    }
    best
}

const TRIM: f32 = 0.01;

/// The [`sightings`] of all frames, in order; only their depth is decoded. Frames that have no `masks` agree with nothing.
///
/// # Errors
/// [`ParseError`]: an unreadable frame, or cancellation.
pub fn all_sightings(
    labelled: Labelled,
    frames: &[FrameRef],
    masks: &MasksOfFrames,
    progress: &Progress,
) -> Result<Vec<Sighting>, ParseError> {
    let mut all = Vec::new();
    stream_frames(
        frames,
        |frame| {
            progress.check()?;
            let masks = masks.get(&frame.index).map_or(&[][..], Vec::as_slice);
            Ok::<_, ParseError>(sightings(labelled, frame, &frame.decode_depth()?, masks))
        },
        |i, seen| {
            all.extend(seen);
            Ok(progress.report("views", (i + 1) as f32 / frames.len() as f32)?)
        },
    )?;
    Ok(all)
}

/// Gives each instance its views: the best first, then the farthest camera centre among those that show it well.
pub fn choose(instances: &mut [Instance], sightings: Vec<Sighting>, frames: &[FrameRef], settings: &ViewSettings) {
    let mut per_instance: Vec<Vec<View>> = vec![Vec::new(); instances.len()];
    for Sighting { instance, view, .. } in sightings {
        per_instance[instance.0 as usize - 1].push(view);
    }
    instances.par_iter_mut().zip(per_instance).for_each(|(instance, seen)| {
        let center = |frame: FrameIndex| {
            let at = frames.binary_search_by_key(&frame, |f| f.index);
            at.map_or_else(|_| Point3::origin(), |i| Camera::center(&frames[i].colour_camera()))
        };
        instance.views = spread(seen, settings, center);
    });
}

/// Takes over boxes that a segmenter has corrected.
pub fn tighten(instances: &mut [Instance], boxes: &Boxes) {
    for instance in instances {
        for view in &mut instance.views {
            if let Some(tight) = boxes.get(&view.frame).and_then(|of_frame| of_frame.get(&instance.id)) {
                view.box_px = *tight;
            }
        }
    }
}

fn spread(mut seen: Vec<View>, settings: &ViewSettings, center: impl Fn(FrameIndex) -> Point3<f32>) -> Vec<View> {
    // More covered pixels is better; a larger picture of the same points is too.
    let covered = |view: &View| {
        let [left, top, right, bottom] = view.box_px;
        u64::from(view.visible_points) * u64::from((right.saturating_sub(left)).max(1) * (bottom.saturating_sub(top)).max(1)).isqrt().max(1)
    };
    seen.sort_by_key(|view| (std::cmp::Reverse(covered(view)), view.frame));
    let Some(best) = seen.first().cloned() else { return Vec::new() };
    let least = covered(&best) as f32 * settings.min_share_of_best;
    let mut pool: Vec<View> = seen.into_iter().skip(1).filter(|view| covered(view) as f32 >= least).collect();
    let mut chosen = vec![best];
    while chosen.len() < settings.count as usize && !pool.is_empty() {
        let nearest_chosen = |view: &View| {
            let here = center(view.frame);
            chosen.iter().map(|c| (center(c.frame) - here).norm()).fold(f32::INFINITY, f32::min)
        };
        let farthest = (0..pool.len()).max_by(|&a, &b| nearest_chosen(&pool[a]).total_cmp(&nearest_chosen(&pool[b])).then(b.cmp(&a)));
        chosen.push(pool.remove(farthest.unwrap_or(0)));
    }
    chosen
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scene_parsing::masks::IdImage;

    fn view(frame: u32, visible_points: u32) -> View {
        View { frame: FrameIndex(frame), visible_points, box_px: [0, 0, 10, 10] }
    }

    #[test]
    fn the_best_view_comes_first_and_the_next_from_far_away() {
        // Cameras stand on a line at x = frame number; frame 9 hardly sees the thing; 0 and 2 are as far from 1, 2 sees more.
        let seen = vec![view(0, 80), view(1, 100), view(2, 90), view(6, 70), view(9, 10)];
        let chosen = spread(seen, &ViewSettings::default(), |f| Point3::new(f.0 as f32, 0.0, 0.0));
        assert_eq!(chosen.iter().map(|v| v.frame.0).collect::<Vec<_>>(), [1, 6, 2]);
    }

    #[test]
    fn an_instance_agrees_with_the_mask_that_shows_just_it() {
        // Six pixels in a row: instance 1 on four, 2 on two. Mask 5 is instance 1 less a pixel; mask 7 the rest.
        let hits: Vec<InstancePixel> = (0..6)
            .map(|i| InstancePixel { instance: InstanceId(if i < 4 { 1 } else { 2 }), at: (i as f32, 0.0), cell: (i, 0) })
            .collect();
        let image = |ids: [u16; 6]| IdRuns::of(&IdImage { width: 6, height: 1, ids: ids.to_vec() });
        let parts = image([5, 5, 5, 7, 7, 7]);
        let found = agreements(&hits, 2, std::slice::from_ref(&parts));
        assert_eq!(found, BTreeMap::from([(InstanceId(1), 0.75), (InstanceId(2), 2.0 / 3.0)]));
        let whole = agreements(&hits, 2, &[parts, image([3, 3, 3, 3, 0, 0])]);
        assert_eq!(whole, BTreeMap::from([(InstanceId(1), 1.0), (InstanceId(2), 2.0 / 3.0)]));
        assert!(agreements(&hits, 2, &[]).is_empty());
    }

    #[test]
    fn an_instance_nobody_sees_has_no_views() {
        assert!(spread(Vec::new(), &ViewSettings::default(), |_| Point3::origin()).is_empty());
    }
}
