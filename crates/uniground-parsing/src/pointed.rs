//! Finds the object that a user points at in a photograph, for things that stage 1 did not segment.
//!
//! The place can belong to several masks: those of a promptable segmenter, or the built-in ones
//! from whole things down to even patches. Each mask selects the points of the cloud that its frame
//! shows under it. The segmenter is then prompted at the middle of these points in other frames
//! that see them. The mask on which the frames agree best is chosen. Then the frames vote on
//! points, and the connected piece around the place is the object.
//!
//! If the area of the object in the photograph is known too, the segmenter is also prompted with it,
//! and the built-in masks that lie in it are joined. Masks count by how well they fill it. Where none
//! does, the points that the frame shows in the area are the object.

mod area;
mod frame_lookup;

pub use area::PixelArea;

use super::close_range::Enlargement;
use super::masks::rgbd::RgbdMasks;
use super::outline::Outline;
use super::visibility::{FramePoint, Visibility};
use super::{ParseError, frame_sampling, instances};
use area::masks_inside;
use frame_lookup::{FrameLookup, FrameSegmentation, Mask, color_pixel, nearest_mask};
use std::collections::HashSet;
use uniground_geometry::boxes::Aabb;
use uniground_geometry::scene::{
    FrameIndex, FrameRef, Instance, InstanceId, PointCloud, View, stream_frames,
};
use uniground_geometry::voxels::{NEIGHBORS_26, VoxelKey, VoxelMap, typical_spacing_m};
use uniground_geometry::{Point3, Vector3};
use uniground_models::neural::{Prompt, Segmenter};
use uniground_types::settings::ParsingSettings;

/// A scan, and what segments its photographs.
pub struct PointedObjectFinder<'a> {
    /// The points of the scan.
    pub cloud: &'a PointCloud,
    /// Its frames, with their picture files in place.
    pub frames: &'a [FrameRef],
    /// Segments at a prompt; `None`: the built-in masks are used.
    pub segmenter: Option<&'a Segmenter>,
    /// The settings that stage 1 used.
    pub settings: &'a ParsingSettings,
}

/// A place in a photograph.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PhotographPoint {
    /// The photograph's frame.
    pub frame: FrameIndex,
    /// Column and row in its color picture, pixels.
    pub at: (f32, f32),
    /// The area of the object in its color picture, if it is known.
    pub area: Option<PixelArea>,
}

/// Minimum number of points of an object.
const LEAST_POINTS: usize = 20;
/// Minimum number of points in the area of an object that no mask shows.
const LEAST_IN_AREA: usize = 8;
/// Maximum number of further frames that are checked.
const MORE_FRAMES: usize = 4;
/// A frame votes if its best mask has this IoU with what it sees of the object.
const AGREES: f32 = 0.5;
/// Agreement assumed for a mask that no further frame sees.
const ALONE: f32 = 0.3;
/// Unevenness factors of the built-in masks, relative to those that things consist of.
const UNEVEN: [f32; 3] = [1.0, 4.0, 16.0];
/// Minimum share of the frames that see a point that must have it in their masks.
const VOTES: f32 = 0.5;
/// Maximum gap between connected points, in multiples of their typical spacing; at least
/// [`LEAST_GAP_M`].
const GAP_SPACINGS: f32 = 3.0;
const LEAST_GAP_M: f32 = 0.03;
/// A mask shows a known instance if the points under the mask and those in the instance's box have
/// this IoU. An area shows one if it has this IoU with the area in which the instance is seen.
const SHOWN: f32 = 0.6;
/// Built-in masks are joined if they have this share of their pixels in the object's area. Both
/// shares are tried.
const IN_AREA: [f32; 2] = [0.8, 0.5];
/// A mask shows the object if the IoU of its area and the object's is at least this.
const FILLS_AREA: f32 = 0.5;
/// An object that is wholly in a picture is at most this many times as long as what the picture
/// shows of it: a desk of which one corner is seen is not the keyboard that fills the corner.
const LONGER: f32 = 2.0;
/// Margin of an object's area in other frames, as a share of its width and height.
const AREA_MARGIN: f32 = 0.1;
/// Boxes with this IoU are one thing.
const SAME_THING: f32 = 0.5;
/// An instance is replaced only if it fills the object's area less than this: what is cut out is
/// seldom as exact as an instance that fits.
const MISFIT: f32 = 0.4;
/// What replaces an instance fills the object's area better by at least this IoU.
const BETTER: f32 = 0.3;
/// Points this far outside of an instance's box may still belong to it, meters.
const NOISE_M: f32 = 0.02;
/// Boxes with this IoU have something to do with each other.
const LEAST_COMMON: f32 = 0.02;
/// Number of views of an instance (paper: 3).
const VIEWS: usize = 3;

/// Returns the known instance that a thing is identical with, if any.
#[must_use]
pub fn find_identical<'a>(known: &'a [Instance], found: &Instance) -> Option<&'a Instance> {
    let overlap = |i: &Instance| i.aabb.iou(&found.aabb);
    let best = known.iter().max_by(|a, b| overlap(a).total_cmp(&overlap(b)).then(b.id.cmp(&a.id)));
    best.filter(|i| overlap(i) >= SAME_THING)
}

impl PointedObjectFinder<'_> {
    /// Returns the object at a place: a known instance if a mask shows exactly that, otherwise a
    /// new instance with the next id. Dismissed instances, those in `is_not` and parts of the
    /// building are not returned. `None` where nothing else can be segmented there.
    ///
    /// # Errors
    /// [`ParseError`]: an unreadable frame, or a segmenter that fails.
    pub fn find_at(
        &self,
        place: PhotographPoint,
        known: &[Instance],
        is_not: &[InstanceId],
    ) -> Result<Option<Instance>, ParseError> {
        self.in_scale(place.frame, known, |finder, frame, known| {
            finder.find_in_scale(frame, place, known, is_not)
        })
    }

    /// Returns what fits an object better than the instance that was taken for it: a known
    /// instance, or a new one as in [`find_at`](Self::find_at). The place has the object's area in
    /// a photograph that shows all of it. `None` where the instance fits well enough, or nothing
    /// there fills the area clearly better, or only what has nothing to do with the instance.
    ///
    /// # Errors
    /// As [`find_at`](Self::find_at).
    pub fn find_better(
        &self,
        place: PhotographPoint,
        known: &[Instance],
        taken: InstanceId,
    ) -> Result<Option<Instance>, ParseError> {
        let Some(area) = place.area else { return Ok(None) };
        self.in_scale(place.frame, known, |finder, frame, known| {
            let Some(taken) = known.iter().find(|i| i.id == taken) else { return Ok(None) };
            let visibility = finder.visibility();
            let looked = finder.look_up_frame(frame, &visibility)?;
            if area.reaches_rim(looked.frame.color.dimensions()) {
                return Ok(None);
            }
            let fit = |i: &Instance| finder.fit_of_box(&looked, &area, i);
            let before = fit(taken);
            if before >= MISFIT {
                return Ok(None);
            }
            let found = finder.find_in_frame(&looked, place, known, &[taken.id], &visibility)?;
            let is_better = |found: &Instance| {
                let (a, b) = (&found.aabb, &taken.aabb);
                let meets =
                    a.contains(&b.center) || b.contains(&a.center) || a.iou(b) >= LEAST_COMMON;
                meets && fit(found) >= FILLS_AREA.max(before + BETTER)
            };
            Ok(found.filter(is_better))
        })
    }

    /// Calls `find` with a finder, the frame and the known instances, of which all are enlarged
    /// where the scan was made from close by.
    fn in_scale(
        &self,
        frame: FrameIndex,
        known: &[Instance],
        find: impl Fn(
            &PointedObjectFinder,
            &FrameRef,
            &[Instance],
        ) -> Result<Option<Instance>, ParseError>,
    ) -> Result<Option<Instance>, ParseError> {
        let Some(at) = self.frames.iter().position(|of| of.index == frame) else {
            return Ok(None);
        };
        let spacing_m = typical_spacing_m(&self.cloud.positions);
        let enlargement = Enlargement::of_frame(&self.frames[at], spacing_m);
        if !enlargement.is_used() {
            return find(self, &self.frames[at], known);
        }
        let (mut cloud, mut frames) = (self.cloud.clone(), self.frames.to_vec());
        enlargement.enlarge_cloud(&mut cloud);
        enlargement.enlarge_frames(&mut frames);
        let mut enlarged = known.to_vec();
        enlarged.iter_mut().for_each(|instance| enlargement.enlarge_instance(instance));
        let finder = PointedObjectFinder { cloud: &cloud, frames: &frames, ..*self };
        let found = find(&finder, &frames[at], &enlarged)?;
        Ok(found.map(|mut found| {
            if let Some(known) = known.iter().find(|known| known.id == found.id) {
                return known.clone();
            }
            enlargement.reduce_instance(&mut found);
            found
        }))
    }

    fn visibility(&self) -> Visibility {
        Visibility::new(self.cloud, &vec![0; self.cloud.len()], self.settings.depth_tolerance)
    }

    fn find_in_scale(
        &self,
        frame: &FrameRef,
        place: PhotographPoint,
        known: &[Instance],
        is_not: &[InstanceId],
    ) -> Result<Option<Instance>, ParseError> {
        let visibility = self.visibility();
        let looked = self.look_up_frame(frame, &visibility)?;
        self.find_in_frame(&looked, place, known, is_not, &visibility)
    }

    fn find_in_frame(
        &self,
        first: &FrameLookup,
        place: PhotographPoint,
        known: &[Instance],
        is_not: &[InstanceId],
        visibility: &Visibility,
    ) -> Result<Option<Instance>, ParseError> {
        let is_other =
            |i: &Instance| i.structure.is_some() || i.dismissed || is_not.contains(&i.id);
        let mut options = Vec::new();
        for (mask, quality) in self.masks_at(first, place.at, place.area.as_ref())? {
            let (seed, pixels) = first.points_under(&mask);
            if seed.len() < LEAST_POINTS {
                continue;
            }
            let quick =
                instances::build_from_points(self.cloud, &seed, known, &self.settings.instances);
            if !find_identical(known, &quick).is_some_and(is_other) {
                let fills = |area: PixelArea| {
                    PixelArea::of_most(&pixels).map_or(0.0, |covered| covered.iou(&area))
                };
                let fit = place.area.map_or(1.0, fills);
                options.push(MaskHypothesis { mask, quality, fit, seed });
            }
        }
        let size = first.frame.color.dimensions();
        let is_wholly_seen = place.area.is_some_and(|area| !area.reaches_rim(size));
        let is_long = |i: &Instance| is_wholly_seen && self.reaches_beyond(first, i);
        let others = || known.iter().filter(|i| !is_other(i) && !is_long(i));
        let shown = self
            .best_shown_instance(first, &options, place.area.as_ref(), others())
            .or_else(|| self.best_filling_instance(first, &place.area?, others()));
        if let Some(shown) = shown {
            return Ok(Some(shown.clone()));
        }
        // As many as stage 1 used, because a user waits for the result.
        let frames = frame_sampling::sample_frames(self.frames, &self.settings.frame_sampling);
        let mut points = self.points_by_masks(first, place, options, &frames, visibility)?;
        if let Some(area) = &place.area
            && first.fill(&points, area) < FILLS_AREA
        {
            // No mask shows the object: it is thin, or has the color of what it lies on.
            points = first.points_in_area(area);
        }
        if points.len() < LEAST_IN_AREA {
            return Ok(None);
        }
        let views = self.build_views(&frames, &points)?;
        Ok(Some(Instance {
            views,
            ..instances::build_from_points(self.cloud, &points, known, &self.settings.instances)
        }))
    }

    /// Returns the points of the object: of the mask on which the frames agree best, with the votes
    /// of other frames. Empty if there is no mask, or one of few points.
    fn points_by_masks(
        &self,
        first: &FrameLookup,
        place: PhotographPoint,
        mut options: Vec<MaskHypothesis>,
        frames: &[FrameRef],
        visibility: &Visibility,
    ) -> Result<Vec<u32>, ParseError> {
        // An area that misses every mask tells nothing.
        if options.iter().all(|option| option.fit == 0.0) {
            options.iter_mut().for_each(|option| option.fit = 1.0);
        }
        let Some(least) = options.iter().map(|option| &option.seed).min_by_key(|seed| seed.len())
        else {
            return Ok(Vec::new());
        };
        let further = self.find_more_frames(frames, least, place.frame, visibility)?;
        let mut best: Option<(f32, MaskVotes, &MaskHypothesis)> = None;
        for option in &options {
            let mut votes =
                MaskVotes { seen: vec![0; self.cloud.len()], inside: vec![0; self.cloud.len()] };
            votes.add(first, &option.mask);
            let agreement =
                self.mean_agreement(&option.seed, place.area.is_some(), &further, &mut votes)?;
            let worth = option.quality * option.fit * agreement;
            if best.as_ref().is_none_or(|(so_far, ..)| worth > *so_far) {
                best = Some((worth, votes, option));
            }
        }
        let Some((_, votes, option)) = best else { return Ok(Vec::new()) };
        let reach = self.search_box(&option.seed);
        let mut carried = votes.majority_points();
        carried.retain(|point| reach.contains(&self.cloud.positions[*point as usize]));
        let mut points = self.largest_piece(&carried, &option.seed);
        if points.len() < LEAST_POINTS {
            points.clear();
        }
        Ok(points)
    }

    /// Returns whether an instance is much longer than what a frame shows of it.
    fn reaches_beyond(&self, looked: &FrameLookup, instance: &Instance) -> bool {
        let seen = looked.seen.iter().map(|point| &self.cloud.positions[point.point as usize]);
        Aabb::around(seen.filter(|at| instance.aabb.contains(at)))
            .is_none_or(|seen| instance.aabb.size.max() > LONGER * seen.size.max())
    }

    /// Returns the IoU of an area and that of the points which the frame sees in an instance's box.
    fn fit_of_box(&self, looked: &FrameLookup, area: &PixelArea, instance: &Instance) -> f32 {
        let size = instance.aabb.size.add_scalar(2.0 * NOISE_M);
        let around = Aabb { size, ..instance.aabb };
        let position = |point: &&FramePoint| self.cloud.positions[point.point as usize];
        let in_box = looked.visible().filter(|point| around.contains(&position(point)));
        let pixels: Vec<(f32, f32)> =
            in_box.filter_map(|point| color_pixel(&looked.frame, point)).collect();
        PixelArea::of_most(&pixels).map_or(0.0, |shown| shown.iou(area))
    }

    /// Returns the known instance that fills an area of a frame best, if any: by its view there, or
    /// by the points that the frame sees in its box.
    fn best_filling_instance<'i>(
        &self,
        looked: &FrameLookup,
        area: &PixelArea,
        known: impl Iterator<Item = &'i Instance>,
    ) -> Option<&'i Instance> {
        let seen: Vec<(Point3<f32>, (f32, f32))> = looked
            .seen
            .iter()
            .filter_map(|point| {
                let position = self.cloud.positions[point.point as usize];
                Some((position, color_pixel(&looked.frame, point)?))
            })
            .collect();
        let fills = |instance: &Instance| {
            let view = instance.views.iter().find(|view| view.frame == looked.frame.index);
            let in_box = || {
                let in_box = seen.iter().filter(|(at, _)| instance.aabb.contains(at));
                let pixels: Vec<(f32, f32)> = in_box.map(|(_, pixel)| *pixel).collect();
                PixelArea::of_most(&pixels)
            };
            let shown = view.map(|view| PixelArea::from(view.box_px)).or_else(in_box);
            shown.map_or(0.0, |shown| shown.iou(area))
        };
        known
            .map(|instance| (fills(instance), instance))
            .filter(|(share, _)| *share >= SHOWN)
            .max_by(|(a, i), (b, j)| a.total_cmp(b).then(j.id.cmp(&i.id)))
            .map(|(_, instance)| instance)
    }

    /// Returns the known instance that a mask shows best, if any. Compares the points that the
    /// frame sees in the instance's box with those under the mask.
    fn best_shown_instance<'i>(
        &self,
        looked: &FrameLookup,
        options: &[MaskHypothesis],
        area: Option<&PixelArea>,
        known: impl Iterator<Item = &'i Instance>,
    ) -> Option<&'i Instance> {
        let under: Vec<Vec<bool>> = options
            .iter()
            .filter(|option| option.fit >= FILLS_AREA)
            .map(|option| {
                looked.seen.iter().map(|point| option.mask.covers(looked, point)).collect()
            })
            .collect();
        let fills = |instance: &Instance| {
            let in_box = |point: &&FramePoint| {
                instance.aabb.contains(&self.cloud.positions[point.point as usize])
            };
            let seen = looked.seen.iter().filter(in_box);
            let pixels: Vec<(f32, f32)> =
                seen.filter_map(|point| color_pixel(&looked.frame, point)).collect();
            area.is_none_or(|area| {
                PixelArea::of_most(&pixels).is_some_and(|seen| seen.iou(area) >= FILLS_AREA)
            })
        };
        let share = |instance: &Instance| {
            let in_box: Vec<bool> = looked
                .seen
                .iter()
                .map(|p| instance.aabb.contains(&self.cloud.positions[p.point as usize]))
                .collect();
            let iou = |under: &Vec<bool>| {
                let count = |both: fn((&bool, &bool)) -> bool| {
                    under.iter().zip(&in_box).filter(|(a, b)| both((a, b))).count()
                };
                count(|(a, b)| *a && *b) as f32 / count(|(a, b)| *a || *b).max(1) as f32
            };
            under.iter().map(iou).fold(0.0, f32::max)
        };
        let shares =
            known.map(|instance| (share(instance), instance)).filter(|(share, _)| *share >= SHOWN);
        shares
            .filter(|(_, instance)| fills(instance))
            .max_by(|(a, i), (b, j)| a.total_cmp(b).then(j.id.cmp(&i.id)))
            .map(|(_, instance)| instance)
    }

    fn look_up_frame(
        &self,
        frame: &FrameRef,
        visibility: &Visibility,
    ) -> Result<FrameLookup, ParseError> {
        let frame = frame.decode()?;
        let seen = visibility.in_frame(&frame.depth_camera, &frame.depth);
        let cut = match self.segmenter {
            Some(segmenter) => FrameSegmentation::Encoded(segmenter.encode(&frame.color)?),
            None => FrameSegmentation::Images(
                RgbdMasks { settings: self.settings.rgbd_masks }.levels(&frame, &UNEVEN),
            ),
        };
        Ok(FrameLookup { frame, seen, cut })
    }

    /// Returns the candidate masks at a place in a frame's color picture, and of its area, each with
    /// the confidence of its source, `0..=1`.
    fn masks_at(
        &self,
        looked: &FrameLookup,
        at: (f32, f32),
        area: Option<&PixelArea>,
    ) -> Result<Vec<(Mask, f32)>, ParseError> {
        match (&looked.cut, self.segmenter) {
            (FrameSegmentation::Encoded(encoded), Some(segmenter)) => {
                let (scale, threshold) = (segmenter.low_scale(encoded), segmenter.threshold());
                let of_area = area.filter(|_| segmenter.takes_boxes()).map(
                    |&PixelArea { left, top, right, bottom }| {
                        Prompt::from_box((left, top), (right, bottom))
                    },
                );
                let prompts: Vec<Prompt> =
                    std::iter::once(Prompt::from_inside_points([at])).chain(of_area).collect();
                let masks = segmenter.decode(encoded, &prompts)?.into_iter().flatten();
                Ok(masks
                    .map(|mask| (mask.predicted_iou.clamp(0.0, 1.0), mask))
                    .map(|(q, mask)| (Mask::Decoded { mask, scale, threshold }, q))
                    .collect())
            }
            (FrameSegmentation::Images(images), _) => {
                let masks = images.iter().enumerate().filter_map(|(level, ids)| {
                    let ids = vec![nearest_mask(ids, &looked.frame, at)?];
                    Some(Mask::Cut { level, ids })
                });
                let joined = images.iter().enumerate().flat_map(|(level, ids)| {
                    let inside = |area| masks_inside(ids, &looked.frame, area, &IN_AREA);
                    let lists = area.map(inside).into_iter().flatten();
                    lists.map(move |ids| Mask::Cut { level, ids })
                });
                Ok(masks.chain(joined).map(|mask| (mask, 1.0)).collect())
            }
            (FrameSegmentation::Encoded(_), None) => Ok(Vec::new()),
        }
    }

    /// Returns the frames that see most of these points, best first, without the frame they were
    /// found in.
    fn find_more_frames(
        &self,
        frames: &[FrameRef],
        seed: &[u32],
        but: FrameIndex,
        visibility: &Visibility,
    ) -> Result<Vec<FrameLookup>, ParseError> {
        let of_seed = CloudSubset::select(self.cloud, seed);
        let others: Vec<FrameRef> = frames
            .iter()
            .filter(|frame| frame.index != but && of_seed.can_be_visible_in(frame))
            .cloned()
            .collect();
        let mut seeing = Vec::new();
        stream_frames(
            &others,
            |frame| {
                Ok::<_, ParseError>(of_seed.visible_in(frame, self.settings.depth_tolerance)?.len())
            },
            |i, visible| {
                seeing.push((visible, others[i].index));
                Ok(())
            },
        )?;
        seeing.sort_by_key(|&(visible, index)| (std::cmp::Reverse(visible), index));
        let enough = (seed.len() / 4).max(LEAST_POINTS / 2);
        let best = seeing.into_iter().filter(|(visible, _)| *visible >= enough).take(MORE_FRAMES);
        best.map(|(_, index)| {
            self.look_up_frame(
                &others[others.partition_point(|frame| frame.index < index)],
                visibility,
            )
        })
        .collect()
    }

    /// Returns the box in which the rest of an object can be, given the points that one frame sees:
    /// extended on each side by half its largest extent.
    fn search_box(&self, seed: &[u32]) -> Aabb {
        let around = Aabb::around(seed.iter().map(|&point| &self.cloud.positions[point as usize]));
        let around = around.unwrap_or(Aabb { center: Point3::origin(), size: Vector3::zeros() });
        Aabb { size: around.size.add_scalar(around.size.max()), ..around }
    }

    /// Returns the mean IoU, over further frames, of what each sees of the seed with its best mask
    /// at the seed's middle. Frames that agree vote.
    fn mean_agreement(
        &self,
        seed: &[u32],
        has_area: bool,
        further: &[FrameLookup],
        votes: &mut MaskVotes,
    ) -> Result<f32, ParseError> {
        let of_seed: HashSet<u32> = seed.iter().copied().collect();
        // Points that the first frame sees outside of its mask belong to something else, and so do
        // points far from the seed.
        let first_seen = votes.seen.clone();
        let reach = self.search_box(seed);
        let is_other = |point: &FramePoint| {
            let seen_apart =
                first_seen[point.point as usize] > 0 && !of_seed.contains(&point.point);
            seen_apart || !reach.contains(&point.position)
        };
        let (mut sum, mut count) = (0.0, 0_u32);
        for looked in further {
            let own: Vec<&FramePoint> =
                looked.seen.iter().filter(|point| of_seed.contains(&point.point)).collect();
            let pixels: Vec<(f32, f32)> =
                own.iter().filter_map(|point| color_pixel(&looked.frame, point)).collect();
            let Some(middle) = medoid(&pixels) else { continue };
            let mut best: Option<(f32, Mask)> = None;
            let size = looked.frame.color.dimensions();
            let area = PixelArea::of_most(&pixels).map(|area| area.grown(AREA_MARGIN).within(size));
            for (mask, _) in self.masks_at(looked, middle, area.as_ref().filter(|_| has_area))? {
                let held = own.iter().filter(|point| mask.covers(looked, point)).count();
                let wrong = looked
                    .seen
                    .iter()
                    .filter(|point| is_other(point) && mask.covers(looked, point))
                    .count();
                let iou = held as f32 / (own.len() + wrong).max(1) as f32;
                if best.as_ref().is_none_or(|(so_far, _)| iou > *so_far) {
                    best = Some((iou, mask));
                }
            }
            let Some((iou, mask)) = best else { continue };
            sum += iou;
            count += 1;
            if iou >= AGREES {
                votes.add(looked, &mask);
            }
        }
        Ok(if count == 0 { ALONE } else { sum / count as f32 })
    }

    /// Returns the largest connected piece of these points that contains part of the seed.
    fn largest_piece(&self, points: &[u32], seed: &[u32]) -> Vec<u32> {
        let spacing = typical_spacing_m(&self.cloud.positions);
        let edge_m = (GAP_SPACINGS * spacing).max(LEAST_GAP_M);
        let key = |point: u32| VoxelKey::containing(&self.cloud.positions[point as usize], edge_m);
        let mut voxels: VoxelMap<Vec<u32>> = VoxelMap::default();
        points.iter().for_each(|&point| voxels.entry(key(point)).or_default().push(point));
        let mut starts: Vec<VoxelKey> = seed.iter().map(|&point| key(point)).collect();
        starts.sort_unstable();
        starts.dedup();
        let mut best = Vec::new();
        for start in starts {
            let (mut piece, mut open) = (voxels.remove(&start).unwrap_or_default(), vec![start]);
            while let Some(at) = open.pop() {
                for near in NEIGHBORS_26.map(|d| at.offset(d)) {
                    if let Some(more) = voxels.remove(&near) {
                        piece.extend(more);
                        open.push(near);
                    }
                }
            }
            if piece.len() > best.len() {
                best = piece;
            }
        }
        best.sort_unstable();
        best
    }

    /// Returns the frames that show most of these points, as views.
    fn build_views(&self, frames: &[FrameRef], points: &[u32]) -> Result<Vec<View>, ParseError> {
        let of_thing = CloudSubset::select(self.cloud, points);
        let frames: Vec<FrameRef> =
            frames.iter().filter(|frame| of_thing.can_be_visible_in(frame)).cloned().collect();
        let mut views = Vec::new();
        stream_frames(
            &frames,
            |frame| {
                let camera = frame.color_camera();
                let seen = of_thing.visible_in(frame, self.settings.depth_tolerance)?;
                let pixels: Vec<(f32, f32)> = seen
                    .iter()
                    .filter_map(|p| camera.project(&p.position).map(|pixel| (pixel.u, pixel.v)))
                    .collect();
                Ok::<_, ParseError>(to_view(frame, &pixels))
            },
            |_, view| {
                views.extend(view);
                Ok(())
            },
        )?;
        views.sort_by_key(|view: &View| (std::cmp::Reverse(view.visible_points), view.frame));
        views.truncate(VIEWS);
        Ok(views)
    }
}

/// A mask that possibly shows the object the user points at.
struct MaskHypothesis {
    mask: Mask,
    quality: f32,
    /// IoU of its area and the object's; 1 if that is not known.
    fit: f32,
    /// The points under the mask.
    seed: Vec<u32>,
}

/// By point of the cloud: number of frames that show it, and of frames that have it in their masks.
struct MaskVotes {
    seen: Vec<u8>,
    inside: Vec<u8>,
}

impl MaskVotes {
    fn add(&mut self, looked: &FrameLookup, mask: &Mask) {
        for point in &looked.seen {
            self.seen[point.point as usize] += 1;
            self.inside[point.point as usize] += u8::from(mask.covers(looked, point));
        }
    }

    /// Returns the points that most of the frames that see them have in their masks.
    fn majority_points(&self) -> Vec<u32> {
        let carried = |point: &u32| {
            let (seen, inside) = (self.seen[*point as usize], self.inside[*point as usize]);
            inside > 0 && f32::from(inside) >= VOTES * f32::from(seen)
        };
        (0..self.seen.len() as u32).filter(carried).collect()
    }
}

/// Some points of a cloud, prepared for look-ups in frames.
struct CloudSubset {
    points: PointCloud,
    middle: Point3<f32>,
    radius_m: f32,
}

impl CloudSubset {
    fn select(cloud: &PointCloud, points: &[u32]) -> Self {
        let positions: Vec<Point3<f32>> =
            points.iter().map(|&point| cloud.positions[point as usize]).collect();
        let middle = Point3::from(
            positions.iter().map(|p| p.coords).sum::<Vector3<f32>>()
                / positions.len().max(1) as f32,
        );
        let radius_m = positions.iter().map(|p| (p - middle).norm()).fold(0.0, f32::max);
        Self {
            points: PointCloud { colors: vec![[0; 3]; positions.len()], positions },
            middle,
            radius_m,
        }
    }

    fn can_be_visible_in(&self, frame: &FrameRef) -> bool {
        frame.depth_camera().can_show(&self.middle, self.radius_m)
    }

    fn visible_in(
        &self,
        frame: &FrameRef,
        depth_tolerance: f32,
    ) -> Result<Vec<FramePoint>, ParseError> {
        let depth = frame.decode_depth()?;
        Ok(Visibility::new(&self.points, &vec![0; self.points.len()], depth_tolerance)
            .in_frame(&frame.depth_camera(), &depth))
    }
}

/// Returns the position that is nearest to the middle of all.
fn medoid(pixels: &[(f32, f32)]) -> Option<(f32, f32)> {
    let count = pixels.len() as f32;
    let middle = pixels.iter().fold((0.0, 0.0), |(x, y), p| (x + p.0 / count, y + p.1 / count));
    let distance = |p: &&(f32, f32)| (p.0 - middle.0).hypot(p.1 - middle.1);
    pixels.iter().min_by(|a, b| distance(a).total_cmp(&distance(b))).copied()
}

/// Returns a frame's view of an object that covers these pixels of its color picture.
fn to_view(frame: &FrameRef, pixels: &[(f32, f32)]) -> Option<View> {
    let span = |of: fn(&(f32, f32)) -> f32, length: u32| {
        let low = pixels.iter().map(of).fold(f32::INFINITY, f32::min);
        let high = pixels.iter().map(of).fold(f32::NEG_INFINITY, f32::max);
        let low = low.floor().clamp(0.0, length as f32 - 1.0) as u32;
        (low, (high.ceil() as u32).clamp(low + 1, length))
    };
    if pixels.len() < LEAST_POINTS / 2 {
        return None;
    }
    let (width, height) = (frame.color_intrinsics.width, frame.color_intrinsics.height);
    let ((left, right), (top, bottom)) = (span(|p| p.0, width), span(|p| p.1, height));
    let box_px = [left, top, right, bottom];
    let mask = Outline::from_points(pixels, box_px).mask.to_view_mask();
    Some(View { frame: frame.index, visible_points: pixels.len() as u32, box_px, mask: Some(mask) })
}

#[cfg(test)]
mod tests;
