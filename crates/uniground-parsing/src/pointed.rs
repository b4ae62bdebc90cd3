//! What somebody points at in a photograph, as an instance: for things that stage 1 has not cut out
//! by themselves.
//!
//! The place may mean several masks: those of a promptable segmenter, or the built-in ones from
//! whole things down to even patches. Each takes the points of the cloud that its frame shows under
//! it. Frames that see these are asked at their middle, and the mask on which they agree best is
//! meant. Then points vote, and what hangs together around the place is the thing.

use super::masks::IdImage;
use super::masks::rgbd::RgbdMasks;
use super::outline::Outline;
use super::visibility::{FramePoint, Visibility};
use super::{ParseError, frame_sampling, instances};
use std::collections::HashSet;
use uniground_geometry::boxes::Aabb;
use uniground_geometry::scene::{
    Frame, FrameIndex, FrameRef, Instance, InstanceId, PointCloud, View, stream_frames,
};
use uniground_geometry::voxels::{NEIGHBOURS_26, VoxelKey, VoxelMap, typical_spacing_m};
use uniground_geometry::{Point3, Vector3};
use uniground_models::neural::{Encoded, LowMask, Prompt, Segmenter};
use uniground_types::settings::ParsingSettings;

/// A scan, and who cuts its photographs.
pub struct PointedObjectFinder<'a> {
    /// The points of the scan.
    pub cloud: &'a PointCloud,
    /// Its frames, with their picture files in place.
    pub frames: &'a [FrameRef],
    /// Cuts out what lies at a place; `None`: the built-in masks.
    pub segmenter: Option<&'a Segmenter>,
    /// As stage 1 was done with.
    pub settings: &'a ParsingSettings,
}

/// A place in a photograph.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PhotographPoint {
    /// The frame it is taken with.
    pub frame: FrameIndex,
    /// Column and row in its colour picture, pixels.
    pub at: (f32, f32),
}

/// Points fewer than these are no thing that anybody could tell.
const LEAST_POINTS: usize = 20;
/// Further frames that are asked.
const MORE_FRAMES: usize = 4;
/// A frame votes whose best mask has this IoU with what it sees of the thing.
const AGREES: f32 = 0.5;
/// What a mask counts for that no further frame sees.
const ALONE: f32 = 0.3;
/// Built-in patches may also be so many times as uneven as those that things are made of.
const UNEVEN: [f32; 3] = [1.0, 4.0, 16.0];
/// Of the frames that see a point so many must have it in their masks.
const VOTES: f32 = 0.5;
/// Points hang together within so many times their typical spacing, at least [`LEAST_GAP_M`].
const GAP_SPACINGS: f32 = 3.0;
const LEAST_GAP_M: f32 = 0.03;
/// Pixels around a place in which a mask is looked for where the place itself has none.
const AROUND_PX: i32 = 6;
/// A mask shows an instance when so much of what its frame sees under it, or in the instance's box,
/// is both (IoU).
const SHOWN: f32 = 0.6;
/// Boxes that overlap by this much are one thing.
const SAME_THING: f32 = 0.5;
/// Views an instance is shown by (paper: 3).
const VIEWS: usize = 3;

/// The instance among the known ones that a thing is, if it is one.
#[must_use]
pub fn known_as<'a>(known: &'a [Instance], found: &Instance) -> Option<&'a Instance> {
    let overlap = |i: &Instance| i.aabb.iou(&found.aabb);
    let best = known.iter().max_by(|a, b| overlap(a).total_cmp(&overlap(b)).then(b.id.cmp(&a.id)));
    best.filter(|i| overlap(i) >= SAME_THING)
}

impl PointedObjectFinder<'_> {
    /// The thing at a place: one of the instances that are known, where a mask shows just that,
    /// else as the next of them; not one of those it is known not to be, and no part of the
    /// building. `None` where nothing else can be cut out there.
    ///
    /// # Errors
    /// [`ParseError`]: an unreadable frame, or a segmenter that fails.
    pub fn find(
        &self,
        place: PhotographPoint,
        known: &[Instance],
        is_not: &[InstanceId],
    ) -> Result<Option<Instance>, ParseError> {
        let Some(first) = self.frames.iter().find(|frame| frame.index == place.frame) else {
            return Ok(None);
        };
        let visibility =
            Visibility::new(self.cloud, &vec![0; self.cloud.len()], self.settings.depth_tolerance);
        let first = self.look(first, &visibility)?;
        let is_other =
            |i: &Instance| i.structure.is_some() || i.dismissed || is_not.contains(&i.id);
        let mut options = Vec::new();
        for (mask, quality) in self.masks_at(&first, place.at)? {
            let seed = first.under(&mask);
            if seed.len() < LEAST_POINTS {
                continue;
            }
            let quick = instances::of_points(self.cloud, &seed, known, &self.settings.instances);
            if !known_as(known, &quick).is_some_and(is_other) {
                options.push(MaskHypothesis { mask, quality, seed });
            }
        }
        if let Some(shown) = self.shown(&first, &options, known.iter().filter(|i| !is_other(i))) {
            return Ok(Some(shown.clone()));
        }
        let Some(least) = options.iter().map(|option| &option.seed).min_by_key(|seed| seed.len())
        else {
            return Ok(None);
        };
        // As many as stage 1 looked at: somebody waits.
        let frames = frame_sampling::sample(self.frames, &self.settings.frame_sampling);
        let further = self.further(&frames, least, place.frame, &visibility)?;
        let mut best: Option<(f32, MaskVotes, &MaskHypothesis)> = None;
        for option in &options {
            let mut votes =
                MaskVotes { seen: vec![0; self.cloud.len()], inside: vec![0; self.cloud.len()] };
            votes.count(&first, &option.mask);
            let worth = option.quality * self.agreement(&option.seed, &further, &mut votes)?;
            if best.as_ref().is_none_or(|(so_far, ..)| worth > *so_far) {
                best = Some((worth, votes, option));
            }
        }
        let Some((_, votes, option)) = best else { return Ok(None) };
        let reach = self.reach(&option.seed);
        let mut carried = votes.carried();
        carried.retain(|point| reach.contains(&self.cloud.positions[*point as usize]));
        let points = self.hanging_together(&carried, &option.seed);
        if points.len() < LEAST_POINTS {
            return Ok(None);
        }
        let views = self.views_of(&frames, &points)?;
        Ok(Some(Instance {
            views,
            ..instances::of_points(self.cloud, &points, known, &self.settings.instances)
        }))
    }

    /// The instance that a mask shows best, if one does: what the frame sees of its box is what it
    /// sees under the mask.
    fn shown<'i>(
        &self,
        looked: &FrameLookup,
        options: &[MaskHypothesis],
        known: impl Iterator<Item = &'i Instance>,
    ) -> Option<&'i Instance> {
        let under: Vec<Vec<bool>> = options
            .iter()
            .map(|option| {
                looked.seen.iter().map(|point| option.mask.holds(looked, point)).collect()
            })
            .collect();
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
            .max_by(|(a, i), (b, j)| a.total_cmp(b).then(j.id.cmp(&i.id)))
            .map(|(_, instance)| instance)
    }

    fn look(&self, frame: &FrameRef, visibility: &Visibility) -> Result<FrameLookup, ParseError> {
        let frame = frame.decode()?;
        let seen = visibility.in_frame(&frame.depth_camera, &frame.depth);
        let cut = match self.segmenter {
            Some(segmenter) => FrameSegmentation::Encoded(segmenter.encode(&frame.colour)?),
            None => FrameSegmentation::Images(
                RgbdMasks { settings: self.settings.rgbd_masks }.levels(&frame, &UNEVEN),
            ),
        };
        Ok(FrameLookup { frame, seen, cut })
    }

    /// The masks that a place of a frame's colour picture may mean, each with what its maker thinks
    /// of it, `0..=1`.
    fn masks_at(
        &self,
        looked: &FrameLookup,
        at: (f32, f32),
    ) -> Result<Vec<(Mask, f32)>, ParseError> {
        match (&looked.cut, self.segmenter) {
            (FrameSegmentation::Encoded(encoded), Some(segmenter)) => {
                let (scale, threshold) = (segmenter.low_scale(encoded), segmenter.threshold());
                let masks =
                    segmenter.decode(encoded, &[Prompt::inside([at])])?.into_iter().flatten();
                Ok(masks
                    .map(|mask| (mask.predicted_iou.clamp(0.0, 1.0), mask))
                    .map(|(q, mask)| (Mask::Decoded { mask, scale, threshold }, q))
                    .collect())
            }
            (FrameSegmentation::Images(images), _) => {
                let masks = images.iter().enumerate().filter_map(|(level, ids)| {
                    Some(Mask::Cut { level, id: nearest_mask(ids, &looked.frame, at)? })
                });
                Ok(masks.map(|mask| (mask, 1.0)).collect())
            }
            (FrameSegmentation::Encoded(_), None) => Ok(Vec::new()),
        }
    }

    /// The frames that see most of these points, but for the one they were found in, best first.
    fn further(
        &self,
        frames: &[FrameRef],
        seed: &[u32],
        but: FrameIndex,
        visibility: &Visibility,
    ) -> Result<Vec<FrameLookup>, ParseError> {
        let of_seed = CloudSubset::of(self.cloud, seed);
        let others: Vec<FrameRef> = frames
            .iter()
            .filter(|frame| frame.index != but && of_seed.may_be_in(frame))
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
            self.look(&others[others.partition_point(|frame| frame.index < index)], visibility)
        })
        .collect()
    }

    /// Where the rest of a thing may be of which a frame sees these points: as far again as half
    /// its largest side.
    fn reach(&self, seed: &[u32]) -> Aabb {
        let around = Aabb::around(seed.iter().map(|&point| &self.cloud.positions[point as usize]));
        let around = around.unwrap_or(Aabb { center: Point3::origin(), size: Vector3::zeros() });
        Aabb { size: around.size.add_scalar(around.size.max()), ..around }
    }

    /// Mean IoU of the best masks that further frames have at the middle of a seed with what they
    /// see of it; those that agree vote.
    fn agreement(
        &self,
        seed: &[u32],
        further: &[FrameLookup],
        votes: &mut MaskVotes,
    ) -> Result<f32, ParseError> {
        let of_seed: HashSet<u32> = seed.iter().copied().collect();
        // What the first frame sees outside of its mask is something else, and so is what lies far
        // from that.
        let first_seen = votes.seen.clone();
        let reach = self.reach(seed);
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
                own.iter().filter_map(|point| colour_pixel(&looked.frame, point)).collect();
            let Some(middle) = medoid(&pixels) else { continue };
            let mut best: Option<(f32, Mask)> = None;
            for (mask, _) in self.masks_at(looked, middle)? {
                let held = own.iter().filter(|point| mask.holds(looked, point)).count();
                let wrong = looked
                    .seen
                    .iter()
                    .filter(|point| is_other(point) && mask.holds(looked, point))
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
                votes.count(looked, &mask);
            }
        }
        Ok(if count == 0 { ALONE } else { sum / count as f32 })
    }

    /// The largest piece of these points that has some of the seed.
    fn hanging_together(&self, points: &[u32], seed: &[u32]) -> Vec<u32> {
        let spacing = typical_spacing_m(&self.cloud.positions);
        let edge_m = (GAP_SPACINGS * spacing).max(LEAST_GAP_M);
        let key = |point: u32| VoxelKey::of(&self.cloud.positions[point as usize], edge_m);
        let mut voxels: VoxelMap<Vec<u32>> = VoxelMap::default();
        points.iter().for_each(|&point| voxels.entry(key(point)).or_default().push(point));
        let mut starts: Vec<VoxelKey> = seed.iter().map(|&point| key(point)).collect();
        starts.sort_unstable();
        starts.dedup();
        let mut best = Vec::new();
        for start in starts {
            let (mut piece, mut open) = (voxels.remove(&start).unwrap_or_default(), vec![start]);
            while let Some(at) = open.pop() {
                for near in NEIGHBOURS_26.map(|d| at.offset(d)) {
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

    /// The frames that show most of these points.
    fn views_of(&self, frames: &[FrameRef], points: &[u32]) -> Result<Vec<View>, ParseError> {
        let of_thing = CloudSubset::of(self.cloud, points);
        let frames: Vec<FrameRef> =
            frames.iter().filter(|frame| of_thing.may_be_in(frame)).cloned().collect();
        let mut views = Vec::new();
        stream_frames(
            &frames,
            |frame| {
                let camera = frame.colour_camera();
                let seen = of_thing.visible_in(frame, self.settings.depth_tolerance)?;
                let pixels: Vec<(f32, f32)> = seen
                    .iter()
                    .filter_map(|p| camera.project(&p.position).map(|pixel| (pixel.u, pixel.v)))
                    .collect();
                Ok::<_, ParseError>(view(frame, &pixels))
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

/// A frame, what it shows of the cloud, and what masks are made from.
struct FrameLookup {
    frame: Frame,
    seen: Vec<FramePoint>,
    cut: FrameSegmentation,
}

enum FrameSegmentation {
    /// For a segmenter's decoder.
    Encoded(Encoded),
    /// Built-in masks, coarse to fine.
    Images(Vec<IdImage>),
}

impl FrameLookup {
    /// The points of the cloud under a mask.
    fn under(&self, mask: &Mask) -> Vec<u32> {
        self.seen.iter().filter(|point| mask.holds(self, point)).map(|point| point.point).collect()
    }
}

/// What a place may mean.
struct MaskHypothesis {
    mask: Mask,
    quality: f32,
    /// The points under the mask.
    seed: Vec<u32>,
}

/// What was cut out of a frame.
enum Mask {
    /// One of the frame's built-in masks, on its depth image.
    Cut { level: usize, id: u16 },
    /// A segmenter's, over the colour picture.
    Decoded { mask: LowMask, scale: (f32, f32), threshold: f32 },
}

impl Mask {
    /// Whether it covers a point that its frame shows.
    fn holds(&self, looked: &FrameLookup, point: &FramePoint) -> bool {
        match (self, &looked.cut) {
            (Self::Cut { level, id }, FrameSegmentation::Images(images)) => {
                images[*level].at(point.cell) == *id
            }
            (Self::Cut { .. }, FrameSegmentation::Encoded(_)) => false,
            (Self::Decoded { mask, scale, threshold }, _) => colour_pixel(&looked.frame, point)
                .is_some_and(|at| mask.at(at, *scale) > *threshold),
        }
    }
}

/// By point of the cloud: frames that show it, and frames that have it in their masks.
struct MaskVotes {
    seen: Vec<u8>,
    inside: Vec<u8>,
}

impl MaskVotes {
    fn count(&mut self, looked: &FrameLookup, mask: &Mask) {
        for point in &looked.seen {
            self.seen[point.point as usize] += 1;
            self.inside[point.point as usize] += u8::from(mask.holds(looked, point));
        }
    }

    /// Points most of the frames that see them have in their masks.
    fn carried(&self) -> Vec<u32> {
        let carried = |point: &u32| {
            let (seen, inside) = (self.seen[*point as usize], self.inside[*point as usize]);
            inside > 0 && f32::from(inside) >= VOTES * f32::from(seen)
        };
        (0..self.seen.len() as u32).filter(carried).collect()
    }
}

/// Some points of a cloud, ready to be looked up in frames.
struct CloudSubset {
    points: PointCloud,
    middle: Point3<f32>,
    radius_m: f32,
}

impl CloudSubset {
    fn of(cloud: &PointCloud, points: &[u32]) -> Self {
        let positions: Vec<Point3<f32>> =
            points.iter().map(|&point| cloud.positions[point as usize]).collect();
        let middle = Point3::from(
            positions.iter().map(|p| p.coords).sum::<Vector3<f32>>()
                / positions.len().max(1) as f32,
        );
        let radius_m = positions.iter().map(|p| (p - middle).norm()).fold(0.0, f32::max);
        Self {
            points: PointCloud { colours: vec![[0; 3]; positions.len()], positions },
            middle,
            radius_m,
        }
    }

    fn may_be_in(&self, frame: &FrameRef) -> bool {
        frame.depth_camera().may_show(&self.middle, self.radius_m)
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

/// Where a point of the cloud is in a frame's colour picture; `None` outside.
fn colour_pixel(frame: &Frame, point: &FramePoint) -> Option<(f32, f32)> {
    frame.colour_camera.project(&point.position).map(|pixel| (pixel.u, pixel.v))
}

/// The mask at a place of the colour picture, or the nearest one to it.
fn nearest_mask(ids: &IdImage, frame: &Frame, (x, y): (f32, f32)) -> Option<u16> {
    let (depth, colour) = (&frame.depth_camera.intrinsics, &frame.colour_camera.intrinsics);
    let column = ((x - colour.cx) / colour.fx * depth.fx + depth.cx).round() as i32;
    let row = ((y - colour.cy) / colour.fy * depth.fy + depth.cy).round() as i32;
    let around =
        |reach: i32| (-reach..=reach).flat_map(move |dy| (-reach..=reach).map(move |dx| (dx, dy)));
    let mut near: Vec<(i32, i32)> = around(AROUND_PX).collect();
    near.sort_by_key(|(dx, dy)| dx * dx + dy * dy);
    let id = |(dx, dy): (i32, i32)| {
        let (u, v) = (u32::try_from(column + dx).ok()?, u32::try_from(row + dy).ok()?);
        (u < ids.width && v < ids.height).then(|| ids.at((u, v))).filter(|id| *id != 0)
    };
    near.into_iter().find_map(id)
}

/// Of some positions the one nearest to the middle of all.
fn medoid(pixels: &[(f32, f32)]) -> Option<(f32, f32)> {
    let count = pixels.len() as f32;
    let middle = pixels.iter().fold((0.0, 0.0), |(x, y), p| (x + p.0 / count, y + p.1 / count));
    let distance = |p: &&(f32, f32)| (p.0 - middle.0).hypot(p.1 - middle.1);
    pixels.iter().min_by(|a, b| distance(a).total_cmp(&distance(b))).copied()
}

/// A frame's view of what covers these pixels of its colour picture.
fn view(frame: &FrameRef, pixels: &[(f32, f32)]) -> Option<View> {
    let span = |of: fn(&(f32, f32)) -> f32, length: u32| {
        let low = pixels.iter().map(of).fold(f32::INFINITY, f32::min);
        let high = pixels.iter().map(of).fold(f32::NEG_INFINITY, f32::max);
        let low = low.floor().clamp(0.0, length as f32 - 1.0) as u32;
        (low, (high.ceil() as u32).clamp(low + 1, length))
    };
    if pixels.len() < LEAST_POINTS / 2 {
        return None;
    }
    let (width, height) = (frame.colour_intrinsics.width, frame.colour_intrinsics.height);
    let ((left, right), (top, bottom)) = (span(|p| p.0, width), span(|p| p.1, height));
    let box_px = [left, top, right, bottom];
    let mask = Outline::of_points(pixels, box_px).mask.packed();
    Some(View { frame: frame.index, visible_points: pixels.len() as u32, box_px, mask: Some(mask) })
}
