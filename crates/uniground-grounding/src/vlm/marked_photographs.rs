//! Photographs with numbered things: the fewest frames that together show every instance worth
//! asking about, with a tag on each.

use super::prompt_context::PromptContext;
use super::visual_evidence::{Photograph, encoded, shrink};
use crate::picture_cache::PlainPhotograph;
use crate::pipeline::QuestionError;
use crate::scene_source::SceneSource;
use rayon::prelude::*;
use std::collections::{BTreeSet, HashMap};
use std::sync::Arc;
use uniground_geometry::scene::{CellMask, FrameIndex, Instance, InstanceId, Level, Structure};
use uniground_render::{
    FrameContent, FrameContents, Mark, VisibleInstance, draw_marks, middle_of_mask,
};
use uniground_types::answer::LeftOut;

/// Maximum number of photographs.
const MOST: usize = 8;
/// Maximum number of them that are chosen because they look like the target.
const BY_TEXT: usize = 2;
/// Maximum size of the longer side of a photograph, pixels.
const MOST_PX: u32 = 896;
/// An instance that fills less of a picture is not recognizable there.
const LEAST_SHARE: f32 = 0.0008;
/// Quality of a view that cuts the instance off, relative to a whole one.
const CUT: f32 = 0.7;
/// Quality of a view that stage 1 did not choose for the instance, relative to one that it chose.
const NOT_A_VIEW: f32 = 0.75;
/// Minimum gain of a further photograph: 1 is the best view of an instance that no other chosen
/// photograph shows.
const LEAST_GAIN: f32 = 0.5;
/// Weight of the geometry's candidates and anchors: they should be seen well.
const LIKELY: f32 = 3.0;
/// Minimum gain of a further photograph, as a share of the surface that any frame shows.
const LEAST_NEW_SURFACE: f32 = 0.03;
/// An instance is marked where its view is at least this good, relative to its best one among the
/// chosen photographs.
const MARKED: f32 = 0.4;

/// Photographs whose things are numbered.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct MarkedPhotographs {
    /// In the order they are shown.
    pub photographs: Vec<Photograph>,
    /// Instances that are marked in at least one of them.
    pub marked: BTreeSet<InstanceId>,
    /// Things that are marked in none of them.
    pub left_out: LeftOut,
}

/// Returns photographs that show the scene's instances, with their ids as tags. Walls, floors and
/// ceilings are marked only if the target is one, and walls if the question says which one it means.
/// Returns none for a scan without photographs.
///
/// # Errors
/// The cloud or the frames cannot be read, or the encoder fails.
pub fn marked_photographs<S: SceneSource>(
    source: &S,
    context: &PromptContext,
) -> Result<MarkedPhotographs, S::Error> {
    let contents = source.frame_contents()?;
    let views = Views::of(&contents, source.instances(), |structure| context.numbers(structure));
    let first = nearest_to_target(source, context)?;
    let likely: BTreeSet<InstanceId> =
        context.shown().chain(context.anchors.iter().map(|anchor| anchor.id)).collect();
    let chosen = views.choose(&first, |id| if likely.contains(&id) { LIKELY } else { 1.0 });
    Ok(draw(source, &views, &chosen, ("marked", &BTreeSet::new())))
}

/// Returns photographs of the frames that were not shown yet: first those with the parts of the
/// room that none of these shows, then others that together show it once more. Returns none if
/// every frame was shown.
///
/// # Errors
/// The cloud or the frames cannot be read.
pub fn further_photographs<S: SceneSource>(
    source: &S,
    context: &PromptContext,
    shown: &MarkedPhotographs,
) -> Result<MarkedPhotographs, S::Error> {
    let contents = source.frame_contents()?;
    let views = Views::of(&contents, source.instances(), |structure| context.numbers(structure));
    let before: Vec<FrameIndex> = shown.photographs.iter().map(|shown| shown.frame).collect();
    let chosen = choose_further(&contents, &before);
    Ok(draw(source, &views, &chosen, ("further", &shown.marked)))
}

/// Chooses frames by the surface they show, without these.
fn choose_further(contents: &FrameContents, shown: &[FrameIndex]) -> Vec<FrameIndex> {
    let everything: BTreeSet<_> = contents.frames.iter().flat_map(|frame| &frame.cells).collect();
    let least = (everything.len() as f32 * LEAST_NEW_SURFACE).max(1.0) as usize;
    let (before, mut rest): (Vec<&FrameContent>, Vec<&FrameContent>) =
        contents.frames.iter().partition(|frame| shown.contains(&frame.frame));
    let mut covered: BTreeSet<_> = before.into_iter().flat_map(|frame| &frame.cells).collect();
    let mut is_first_round = true;
    let mut chosen = Vec::new();
    while chosen.len() < MOST {
        let gain =
            |frame: &FrameContent| frame.cells.iter().filter(|c| !covered.contains(c)).count();
        let best = (0..rest.len()).map(|at| (at, gain(rest[at])));
        let best = best.reduce(|best, next| if next.1 > best.1 { next } else { best });
        match best.filter(|(_, gain)| *gain >= least) {
            Some((at, _)) => {
                let frame = rest.remove(at);
                covered.extend(&frame.cells);
                chosen.push(frame.frame);
            }
            None if is_first_round => {
                is_first_round = false;
                covered.clear();
            }
            None => break,
        }
    }
    chosen
}

/// Draws these frames, with tags, in this order. `name` is that of their pictures, `before` has the
/// instances that were marked in others.
fn draw<S: SceneSource>(
    source: &S,
    views: &Views,
    chosen: &[FrameIndex],
    (name, before): (&str, &BTreeSet<InstanceId>),
) -> MarkedPhotographs {
    let (cache, scene) = source.pictures();
    let draw = |&frame: &FrameIndex| {
        let shown = views.marked_in(frame, chosen);
        let key = format!("{scene} {frame:?} {shown:?}");
        let drawn = cache.marked.get(&key).or_else(|| {
            let drawn = draw_marked(source, frame, &shown)?;
            cache.marked.put(key, drawn.clone(), drawn.picture.jpeg.len());
            Some(drawn)
        })?;
        Some((drawn, shown))
    };
    let drawn: Vec<_> = chosen.par_iter().filter_map(draw).collect();
    let mut marked = BTreeSet::new();
    let mut photographs = Vec::new();
    for ((mut photograph, shown), number) in drawn.into_iter().zip(1..) {
        marked.extend(shown.iter().map(|seen| seen.id));
        photograph.picture.name = format!("{name}-{number}");
        photographs.push(photograph);
    }
    let left_out = views.left_out(source.instances(), &(&marked | before));
    MarkedPhotographs { photographs, marked, left_out }
}

/// Draws a frame's photograph with a tag on each of these instances; `None` without a photograph.
fn draw_marked<S: SceneSource>(
    source: &S,
    frame: FrameIndex,
    shown: &[VisibleInstance],
) -> Option<Photograph> {
    let plain = plain_photograph(source, frame)?;
    let (taken_px, mut picture) = (plain.taken_px, plain.picture.clone());
    let instance = |seen: &VisibleInstance| &source.instances()[seen.id.0 as usize - 1];
    let masks: Vec<_> = shown.iter().map(|seen| ViewedMask::of(instance(seen), frame)).collect();
    let mark = |(seen, mask): (&VisibleInstance, &Option<ViewedMask>)| {
        // Masks are exact; what lies within the instance's box may be behind it.
        let place = mask.as_ref().and_then(|mask| mask.own_place(&masks, taken_px));
        let (at, margin) = place.unwrap_or((seen.middle, seen.margin));
        Mark { label: seen.id.to_string(), at, margin }
    };
    draw_marks(&mut picture, &shown.iter().zip(&masks).map(mark).collect::<Vec<_>>());
    Some(Photograph { frame, taken_px, picture: encoded("marked".into(), &picture) })
}

/// Returns a frame's photograph, cached, because every question marks other things.
fn plain_photograph<S: SceneSource>(source: &S, frame: FrameIndex) -> Option<Arc<PlainPhotograph>> {
    let (cache, scene) = source.pictures();
    let key = format!("{scene} {frame:?}");
    if let Some(known) = cache.plain.get(&key) {
        return Some(known);
    }
    let photograph = source.photograph(frame)?;
    let taken_px = photograph.dimensions();
    let plain = Arc::new(PlainPhotograph { taken_px, picture: shrink(photograph, MOST_PX) });
    cache.plain.put(key, plain.clone(), plain.picture.len());
    Some(plain)
}

/// An instance's mask in one of its views.
struct ViewedMask {
    /// Left, upper, right and lower rim in the photograph, pixels.
    rims: [f32; 4],
    cells: CellMask,
}

impl ViewedMask {
    /// Returns the instance's mask, if the frame is one of its views.
    fn of(instance: &Instance, frame: FrameIndex) -> Option<Self> {
        let view = instance.views.iter().find(|view| view.frame == frame)?;
        let cells = CellMask::from_view_mask(view.mask.as_ref()?)?;
        Some(Self { rims: view.box_px.map(|px| px as f32), cells })
    }

    fn size(&self) -> (f32, f32) {
        let [left, top, right, bottom] = self.rims;
        (right - left, bottom - top)
    }

    fn area(&self) -> f32 {
        let (width, height) = self.size();
        width * height
    }

    fn contains(&self, (x, y): (f32, f32)) -> bool {
        let ((width, height), (columns, rows)) = (self.size(), self.cells.size());
        let column = (x - self.rims[0]) / width * columns as f32;
        let row = (y - self.rims[1]) / height * rows as f32;
        column >= 0.0 && row >= 0.0 && self.cells.is_set(column as u32, row as u32)
    }

    /// Returns the place in the mask that is farthest from its borders, without what smaller masks
    /// cover: a desk's tag is not on a mug. Shares of the photograph's width and height, and the
    /// distance from the borders as a share of its width.
    fn own_place(&self, masks: &[Option<Self>], taken_px: (u32, u32)) -> Option<([f32; 2], f32)> {
        let ((width, height), (columns, rows)) = (self.size(), self.cells.size());
        let pixel = |x: f32, y: f32| (self.rims[0] + x * width, self.rims[1] + y * height);
        let smaller: Vec<&Self> =
            masks.iter().flatten().filter(|other| other.area() < self.area()).collect();
        let is_alone = |column: u32, row: u32| {
            let share = |cell: u32, count: u32| (cell as f32 + 0.5) / count as f32;
            let at = pixel(share(column, columns), share(row, rows));
            self.cells.is_set(column, row) && !smaller.iter().any(|other| other.contains(at))
        };
        let alone = CellMask::from_fn(columns, rows, is_alone);
        let ([x, y], margin) = middle_of_mask(&alone).or_else(|| middle_of_mask(&self.cells))?;
        let (taken, at) = ((taken_px.0 as f32, taken_px.1 as f32), pixel(x, y));
        Some(([at.0 / taken.0, at.1 / taken.1], margin * width / taken.0))
    }
}

/// Returns the frames that look most like the target; none without an encoder.
fn nearest_to_target<S: SceneSource>(
    source: &S,
    context: &PromptContext,
) -> Result<Vec<FrameIndex>, S::Error> {
    let (Some(frames), Ok(Some((encoder, _)))) = (source.frame_embeddings(), source.embeddings())
    else {
        return Ok(Vec::new());
    };
    let words = encoder.embed_name(&context.target.text()).map_err(QuestionError::Encoder)?;
    Ok(words.vector.map_or_else(Vec::new, |vector| frames.nearest(&vector, BY_TEXT)))
}

/// How well every frame shows the instances that may be marked.
struct Views<'a> {
    frames: Vec<(FrameIndex, Vec<(&'a VisibleInstance, f32)>)>,
}

impl<'a> Views<'a> {
    /// `numbers` tells which pieces of the building may be marked.
    fn of(
        contents: &'a FrameContents,
        instances: &[Instance],
        numbers: impl Fn(Structure) -> bool,
    ) -> Self {
        let may_be_marked = |seen: &&VisibleInstance| {
            let instance = instances.get((seen.id.0 as usize).wrapping_sub(1));
            seen.share >= LEAST_SHARE
                && instance.is_some_and(|i| !i.dismissed && i.structure.is_none_or(&numbers))
        };
        let worth = |seen: &VisibleInstance| seen.share * if seen.is_cut { CUT } else { 1.0 };
        let mut best: HashMap<InstanceId, f32> = HashMap::new();
        for seen in contents.frames.iter().flat_map(|frame| &frame.instances) {
            let best = best.entry(seen.id).or_default();
            *best = best.max(worth(seen));
        }
        // The views of stage 1 are sharp; others may be blurred.
        let is_view = |frame: FrameIndex, id: InstanceId| {
            let views = &instances[id.0 as usize - 1].views;
            views.is_empty() || views.iter().any(|view| view.frame == frame)
        };
        let quality = |frame: FrameIndex, seen: &'a VisibleInstance| {
            let sharp = if is_view(frame, seen.id) { 1.0 } else { NOT_A_VIEW };
            (seen, sharp * (worth(seen) / best[&seen.id]).sqrt())
        };
        let frames = contents.frames.iter().map(|FrameContent { frame, instances, .. }| {
            let marked = instances.iter().filter(may_be_marked);
            (*frame, marked.map(|seen| quality(*frame, seen)).collect())
        });
        Self { frames: frames.collect() }
    }

    /// Chooses frames that together show the instances well: first these, then always the frame
    /// that adds most.
    fn choose(&self, first: &[FrameIndex], weight: impl Fn(InstanceId) -> f32) -> Vec<FrameIndex> {
        let mut covered: HashMap<InstanceId, f32> = HashMap::new();
        let mut chosen: Vec<usize> = Vec::new();
        let take = |at: usize, covered: &mut HashMap<InstanceId, f32>| {
            for (seen, quality) in &self.frames[at].1 {
                let best = covered.entry(seen.id).or_default();
                *best = best.max(*quality);
            }
        };
        for frame in first {
            if let Some(at) = self.frames.iter().position(|(index, _)| index == frame) {
                take(at, &mut covered);
                chosen.push(at);
            }
        }
        while chosen.len() < MOST {
            let gain = |at: usize| -> f32 {
                let added = |(seen, quality): &(&VisibleInstance, f32)| {
                    let before = covered.get(&seen.id).copied().unwrap_or_default();
                    weight(seen.id) * (quality - before).max(0.0)
                };
                self.frames[at].1.iter().map(added).sum()
            };
            let best = (0..self.frames.len())
                .filter(|at| !chosen.contains(at))
                .map(|at| (at, gain(at)))
                .reduce(|best, next| if next.1 > best.1 { next } else { best });
            let Some((at, _)) = best.filter(|(_, gain)| *gain >= LEAST_GAIN) else { break };
            take(at, &mut covered);
            chosen.push(at);
        }
        chosen.into_iter().map(|at| self.frames[at].0).collect()
    }

    /// Counts the things that are not marked.
    fn left_out(&self, instances: &[Instance], marked: &BTreeSet<InstanceId>) -> LeftOut {
        let visible: BTreeSet<InstanceId> =
            self.frames.iter().flat_map(|(_, seen)| seen).map(|(seen, _)| seen.id).collect();
        let mut left_out = LeftOut::default();
        let is_thing = |i: &&Instance| i.level == Level::Thing && !marked.contains(&i.id);
        for instance in instances.iter().filter(is_thing) {
            let count = match instance {
                Instance { dismissed: true, .. } => &mut left_out.dismissed,
                Instance { id, .. } if visible.contains(id) => &mut left_out.not_shown,
                Instance { structure: Some(_), .. } => &mut left_out.structure,
                _ => &mut left_out.too_small,
            };
            *count += 1;
        }
        left_out
    }

    /// Returns the instances to mark in one of the chosen frames.
    fn marked_in(&self, frame: FrameIndex, chosen: &[FrameIndex]) -> Vec<VisibleInstance> {
        let shown = || self.frames.iter().filter(|(index, _)| chosen.contains(index));
        let best = |id: InstanceId| {
            let of = shown().flat_map(|(_, seen)| seen).filter(|(seen, _)| seen.id == id);
            of.map(|(_, quality)| *quality).fold(0.0, f32::max)
        };
        let here = shown().filter(|(index, _)| *index == frame).flat_map(|(_, seen)| seen);
        here.filter(|(seen, quality)| *quality >= MARKED * best(seen.id))
            .map(|(seen, _)| **seen)
            .collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use uniground_geometry::scene::{Support, View};
    use uniground_testing::thing;

    fn seen(id: u32, share: f32) -> VisibleInstance {
        let (middle, margin) = ([0.5; 2], 0.1);
        VisibleInstance { id: InstanceId(id), share, middle, margin, is_cut: false }
    }

    fn contents(frames: &[&[(u32, f32)]]) -> FrameContents {
        let list = |seen_in: &&[(u32, f32)]| {
            seen_in.iter().map(|&(id, share)| seen(id, share)).collect::<Vec<_>>()
        };
        let frames = frames.iter().zip(0..).map(|(frame, i)| FrameContent {
            frame: FrameIndex(i * 10),
            instances: list(frame),
            cells: BTreeSet::new(),
        });
        FrameContents { frames: frames.collect() }
    }

    fn things(count: u32) -> Vec<Instance> {
        let at =
            |id: u32| thing(id, [id as f32 * 3.0, 0.0], [0.5; 3], 0.0, Support::Floor, [90; 3]);
        (1..=count).map(at).collect()
    }

    fn chosen(views: &Views, first: &[u32], likely: u32) -> Vec<u32> {
        let first: Vec<FrameIndex> = first.iter().copied().map(FrameIndex).collect();
        let weight = |id: InstanceId| if id.0 == likely { LIKELY } else { 1.0 };
        views.choose(&first, weight).into_iter().map(|frame| frame.0).collect()
    }

    #[test]
    fn fewest_frames_that_show_everything_are_chosen() {
        let seen: [&[(u32, f32)]; 4] =
            [&[(1, 0.1)], &[(1, 0.1), (2, 0.1)], &[(3, 0.1)], &[(3, 0.02)]];
        let contents = contents(&seen);
        let views = Views::of(&contents, &things(3), |_| false);
        assert_eq!(chosen(&views, &[], 0), [10, 20]);
        assert_eq!(chosen(&views, &[], 3), [20, 10], "the likely one first");
        assert_eq!(chosen(&views, &[30], 0), [30, 10, 20], "0.02 is 0.45 as good as 0.1");
    }

    #[test]
    fn further_frames_show_what_was_not_shown_then_everything_again() {
        let showing = |cells: [std::ops::Range<i32>; 5]| {
            let frames = cells.into_iter().zip(0..).map(|(cells, i)| FrameContent {
                frame: FrameIndex(i * 10),
                instances: Vec::new(),
                cells: cells.map(|x| [x, 0, 0]).collect(),
            });
            FrameContents { frames: frames.collect() }
        };
        let further = |contents: &FrameContents, shown: &[u32]| {
            let shown: Vec<FrameIndex> = shown.iter().copied().map(FrameIndex).collect();
            let chosen = choose_further(contents, &shown);
            chosen.into_iter().map(|frame| frame.0).collect::<Vec<_>>()
        };
        // The last frame adds one of 100 places only.
        let contents = showing([0..50, 0..60, 40..90, 89..100, 88..90]);
        assert_eq!(further(&contents, &[0]), [20, 30, 10]);
        assert_eq!(further(&contents, &[0, 10, 20, 30]), [0_u32; 0]);
        assert_eq!(further(&contents, &[0, 10, 20, 30, 40]), [0_u32; 0]);
    }

    /// An instance with a mask in frame 3.
    fn viewed(box_px: [u32; 4], cells: CellMask) -> ViewedMask {
        let mask = Some(cells.to_view_mask());
        let view = View { frame: FrameIndex(3), visible_points: 9, box_px, mask };
        let instance = Instance { views: vec![view], ..things(1).remove(0) };
        assert!(ViewedMask::of(&instance, FrameIndex(4)).is_none());
        ViewedMask::of(&instance, FrameIndex(3)).unwrap()
    }

    #[test]
    fn tag_lies_on_the_mask_of_a_view() {
        // The right half of a box from (100, 50) to (300, 150) in a picture of 400 x 200.
        let right = CellMask::from_fn(8, 4, |column, _| column >= 4);
        let mask = viewed([100, 50, 300, 150], right);
        let ([x, y], margin) = mask.own_place(&[], (400, 200)).unwrap();
        assert!(x > 0.5 && x < 0.75 && y > 0.25 && y < 0.75, "{x} {y}");
        assert!(margin > 0.0 && margin < 0.25, "{margin}");
    }

    #[test]
    fn tag_is_not_on_what_stands_before_the_thing() {
        let all = |columns, rows| CellMask::from_fn(columns, rows, |_, _| true);
        // A mug in the middle of a desk.
        let desk = || viewed([100, 50, 300, 150], all(40, 20));
        let mug = || viewed([170, 70, 230, 130], all(12, 12));
        let masks = [Some(desk()), None, Some(mug())];
        let ([x, y], _) = desk().own_place(&masks, (400, 200)).unwrap();
        assert!(!mug().contains((x * 400.0, y * 200.0)), "{x} {y}");
        assert!(desk().contains((x * 400.0, y * 200.0)), "{x} {y}");
        let ([x, y], _) = mug().own_place(&masks, (400, 200)).unwrap();
        assert!((x - 0.5).abs() < 0.02 && (y - 0.5).abs() < 0.05, "{x} {y}");
        // Where smaller things cover all of it, the tag is where it would be without them.
        let [left, right] = [[100, 50, 200, 150], [200, 50, 300, 150]];
        let masks = [left, right].map(|half| Some(viewed(half, all(10, 10))));
        let place = |masks: &[Option<ViewedMask>]| desk().own_place(masks, (400, 200));
        assert!(place(&[]).is_some() && place(&masks) == place(&[]));
    }

    #[test]
    fn instances_are_marked_where_they_are_seen_well() {
        let seen: [&[(u32, f32)]; 3] =
            [&[(1, 0.1), (2, 0.001)], &[(1, 0.01), (2, 0.1)], &[(1, 0.05), (2, 0.0001)]];
        let contents = contents(&seen);
        let views = Views::of(&contents, &things(2), |_| false);
        let marked = |frame| {
            let all = [0, 10, 20].map(FrameIndex);
            let ids = views.marked_in(FrameIndex(frame), &all).into_iter().map(|seen| seen.id.0);
            ids.collect::<Vec<_>>()
        };
        assert_eq!((marked(0), marked(10), marked(20)), (vec![1], vec![2], vec![1]));
    }

    #[test]
    fn building_is_marked_only_if_asked_for_and_dismissed_things_never() {
        let seen: [&[(u32, f32)]; 1] = [&[(1, 0.3), (2, 0.1), (3, 0.1)]];
        let contents = contents(&seen);
        let mut instances = things(3);
        instances[0].structure = Some(Structure::Wall);
        instances[2].dismissed = true;
        let marked = |numbered: Option<Structure>| {
            let views = Views::of(&contents, &instances, |kind| numbered == Some(kind));
            let here = views.marked_in(FrameIndex(0), &[FrameIndex(0)]);
            here.into_iter().map(|seen| seen.id.0).collect::<Vec<_>>()
        };
        assert_eq!(marked(None), [2]);
        assert_eq!(marked(Some(Structure::Wall)), [1, 2]);
        assert_eq!(marked(Some(Structure::Floor)), [2]);
    }

    #[test]
    fn things_without_a_number_are_counted_by_reason() {
        let contents = contents(&[&[(1, 0.3), (2, 0.1), (3, 0.1), (4, 0.0001)], &[(5, 0.1)]]);
        let mut instances = things(6);
        instances[0].structure = Some(Structure::Wall);
        instances[2].dismissed = true;
        let views = Views::of(&contents, &instances, |_| false);
        let left_out = views.left_out(&instances, &[InstanceId(2)].into());
        // 6 is in no frame.
        let expected = LeftOut { structure: 1, too_small: 2, not_shown: 1, dismissed: 1 };
        assert_eq!(left_out, expected);
    }
}
