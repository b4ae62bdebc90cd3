//! Compares two recordings of a room: which things are the same, moved, appeared or disappeared.
//!
//! Two parses segment a room independently of each other. Things are the same where they share
//! their points. For the others, the frames of the other recording are checked at the thing's
//! place: they looked through it, did not look at it, or measured a surface there as well.

mod align;
mod carried;
mod identity;
mod overlap;

pub use align::{Alignment, SAME_PLACE_M, align};
pub use carried::carry_over_corrections;
pub use identity::continue_ids;
pub use overlap::{Counterparts, match_things};

use std::collections::BTreeSet;
use uniground_geometry::progress::{Cancelled, Progress};
use uniground_geometry::scene::{
    FrameError, FrameRef, FreeSpaceVotes, Instance, InstanceId, PointCloud, count_free_space,
};
use uniground_geometry::{Isometry3, Point3};
use uniground_types::changes::{ChangedThing, Changes, MovedThing};

/// One recording of a room.
#[derive(Clone, Copy)]
pub struct RoomState<'a> {
    /// Its points, meters, Z up.
    pub cloud: &'a PointCloud,
    /// The instance that owns each point; 0: none.
    pub owner_of_point: &'a [InstanceId],
    /// Sorted by id.
    pub instances: &'a [Instance],
    /// The frames that recorded it, in the same coordinates. For a scan that has grown: only the
    /// frames added last, or only those before.
    pub frames: &'a [FrameRef],
}

/// Why two recordings could not be compared.
#[derive(Debug, thiserror::Error)]
pub enum ChangesError {
    /// A depth picture cannot be read.
    #[error(transparent)]
    Frame(#[from] FrameError),
    /// The caller asked to stop.
    #[error(transparent)]
    Cancelled(#[from] Cancelled),
}

/// Maximum number of frames that are checked: enough to see every corner.
const MOST_FRAMES: usize = 60;
/// Maximum number of points of a thing that are checked in frames.
const MOST_POINTS: usize = 400;
/// Share of a thing's points with a counterpart from which its surfaces also exist in the other
/// recording.
const STILL_THERE: f32 = 0.5;
/// Share of a thing's points on which the other recording's frames must have evidence.
const LOOKED_AT: f32 = 0.25;

/// Returns the differences, given the things that are the same. `place` transforms the coordinates
/// of `before` to those of `after`.
///
/// # Errors
/// [`ChangesError`].
pub fn compare(
    before: &RoomState,
    after: &RoomState,
    same: &[(InstanceId, InstanceId)],
    counterparts: &Counterparts,
    place: &Isometry3<f32>,
    progress: &Progress,
) -> Result<Changes, ChangesError> {
    let stayed: BTreeSet<InstanceId> = same.iter().map(|pair| pair.0).collect();
    let known: BTreeSet<InstanceId> = same.iter().map(|pair| pair.1).collect();
    let is_thing = |instance: &&Instance| instance.is_shown() && instance.structure.is_none();
    let mut changes = Changes::default();
    let unmatched =
        before.instances.iter().filter(is_thing).filter(|thing| !stayed.contains(&thing.id));
    let lost = ObjectPlaces::without_counterpart(
        before,
        unmatched,
        |point| counterparts.counterpart_of(point).is_some(),
        place,
    );
    for (thing, fate) in lost.classify_by_frames(after.frames, progress)? {
        let list = match fate {
            ObjectFate::Known | ObjectFate::SurfaceThere => &mut changes.regrouped,
            ObjectFate::Empty => &mut changes.gone,
            ObjectFate::NotLookedAt => &mut changes.not_seen,
        };
        list.push(to_changed_thing(thing));
    }
    let unmatched =
        after.instances.iter().filter(is_thing).filter(|thing| !known.contains(&thing.id));
    let found = ObjectPlaces::without_counterpart(
        after,
        unmatched,
        |point| counterparts.has_counterpart(point),
        &place.inverse(),
    );
    for (thing, fate) in found.classify_by_frames(before.frames, progress)? {
        match fate {
            // Part of a thing that was larger before.
            ObjectFate::Known => {}
            ObjectFate::Empty => changes.appeared.push(to_changed_thing(thing)),
            ObjectFate::SurfaceThere | ObjectFate::NotLookedAt => {
                changes.first_seen.push(to_changed_thing(thing));
            }
        }
    }
    pair_moved_things(&mut changes, before, after);
    changes.unchanged =
        before.instances.iter().filter(is_thing).filter(|thing| stayed.contains(&thing.id)).count()
            as u32;
    Ok(changes)
}

/// Compares two parses of the same scan, in which an object has the same id. The room is the same,
/// so nothing appeared, moved or is gone.
#[must_use]
pub fn compare_parses(before: &[Instance], now: &[Instance]) -> Changes {
    let is_thing = |thing: &&Instance| thing.is_shown() && thing.structure.is_none();
    let ids = |of: &[Instance]| -> BTreeSet<InstanceId> {
        of.iter().filter(is_thing).map(|thing| thing.id).collect()
    };
    let (old, new) = (ids(before), ids(now));
    let others = |of: &[Instance], known: &BTreeSet<InstanceId>| {
        let things = of.iter().filter(is_thing).filter(|thing| !known.contains(&thing.id));
        things.map(to_changed_thing).collect()
    };
    Changes {
        first_seen: others(now, &old),
        regrouped: others(before, &new),
        unchanged: old.intersection(&new).count() as u32,
        ..Changes::default()
    }
}

fn to_changed_thing(thing: &Instance) -> ChangedThing {
    ChangedThing { id: thing.id, label: thing.label().to_owned(), aabb: thing.aabb }
}

/// Evidence for a thing, or for its place, in the other recording.
#[derive(Clone, Copy, PartialEq, Eq)]
enum ObjectFate {
    /// The other recording has its points.
    Known,
    /// The other recording lacks its points, but its frames measured a surface there.
    SurfaceThere,
    Empty,
    NotLookedAt,
}

/// The things of one recording, and where their points lie in the other.
struct ObjectPlaces<'a> {
    things: Vec<(&'a Instance, f32, std::ops::Range<usize>)>,
    positions: Vec<Point3<f32>>,
}

impl<'a> ObjectPlaces<'a> {
    fn without_counterpart(
        look: &RoomState,
        things: impl Iterator<Item = &'a Instance>,
        has_counterpart: impl Fn(usize) -> bool,
        place: &Isometry3<f32>,
    ) -> Self {
        let things: Vec<&Instance> = things.collect();
        let mut points = vec![Vec::new(); things.len()];
        for (point, owner) in look.owner_of_point.iter().enumerate() {
            if let Ok(at) = things.binary_search_by_key(owner, |thing| thing.id) {
                points[at].push(point);
            }
        }
        let (mut positions, mut places) = (Vec::new(), Vec::new());
        for (thing, points) in
            things.into_iter().zip(points).filter(|(_, points)| !points.is_empty())
        {
            let there = points.iter().filter(|&&point| has_counterpart(point)).count() as f32
                / points.len() as f32;
            let first = positions.len();
            let sample = points.iter().step_by(points.len().div_ceil(MOST_POINTS));
            positions.extend(sample.map(|&point| place * look.cloud.positions[point]));
            places.push((thing, there, first..positions.len()));
        }
        Self { things: places, positions }
    }

    fn classify_by_frames(
        self,
        frames: &[FrameRef],
        progress: &Progress,
    ) -> Result<Vec<(&'a Instance, ObjectFate)>, ChangesError> {
        let frames: Vec<FrameRef> =
            frames.iter().step_by(frames.len().div_ceil(MOST_FRAMES).max(1)).cloned().collect();
        let looks =
            count_free_space::<ChangesError>(&self.positions, &frames, |_| Ok(progress.check()?))?;
        let fate = |there: f32, points: std::ops::Range<usize>| {
            let looks = &looks[points];
            let count = |which: fn(&FreeSpaceVotes) -> bool| {
                looks.iter().filter(|looks| which(looks)).count() as f32
            };
            let (looked_at, empty) =
                (count(FreeSpaceVotes::is_known), count(|looks| looks.through > looks.hits));
            match there >= STILL_THERE {
                true => ObjectFate::Known,
                false if looked_at < LOOKED_AT * looks.len() as f32 => ObjectFate::NotLookedAt,
                false if 2.0 * empty > looked_at => ObjectFate::Empty,
                false => ObjectFate::SurfaceThere,
            }
        };
        Ok(self
            .things
            .into_iter()
            .map(|(thing, there, points)| (thing, fate(there, points)))
            .collect())
    }
}

/// Minimum ratio of two sizes, and slack of a size in meters: a thing is seen from different sides.
const SAME_SIZE: f32 = 0.7;
const SIZE_SLACK_M: f32 = 0.04;
/// Minimum color similarity.
const SAME_COLOR: f32 = 0.5;

/// Pairs things that disappeared with similar things that appeared, and marks them as moved. The
/// most similar pairs come first.
fn pair_moved_things(changes: &mut Changes, before: &RoomState, after: &RoomState) {
    let came: Vec<ChangedThing> =
        changes.appeared.iter().chain(&changes.first_seen).cloned().collect();
    let thing = |look: &RoomState<'_>, id: InstanceId| look.instances[id.0 as usize - 1].clone();
    let mut pairs: Vec<(f32, &ChangedThing, &ChangedThing)> = Vec::new();
    for gone in &changes.gone {
        for came in &came {
            if let Some(alike) = similarity(&thing(before, gone.id), &thing(after, came.id)) {
                pairs.push((alike, gone, came));
            }
        }
    }
    pairs.sort_by(|a, b| b.0.total_cmp(&a.0).then((a.1.id, a.2.id).cmp(&(b.1.id, b.2.id))));
    let mut moved: Vec<MovedThing> = Vec::new();
    for (_, gone, came) in pairs {
        if moved.iter().all(|moved| moved.before.id != gone.id && moved.after.id != came.id) {
            let distance_m = (came.aabb.center - gone.aabb.center).norm();
            moved.push(MovedThing { before: gone.clone(), after: came.clone(), distance_m });
        }
    }
    changes.gone.retain(|thing| moved.iter().all(|moved| moved.before.id != thing.id));
    for list in [&mut changes.appeared, &mut changes.first_seen] {
        list.retain(|thing| moved.iter().all(|moved| moved.after.id != thing.id));
    }
    moved.sort_by_key(|moved| moved.before.id);
    changes.moved = moved;
}

/// Returns the similarity of two things in size, color and name; `None`: not the same thing.
fn similarity(a: &Instance, b: &Instance) -> Option<f32> {
    let sides = |thing: &Instance| {
        let size = thing.oriented_box.size;
        [size.x.min(size.y), size.x.max(size.y), size.z]
    };
    let shares = sides(a)
        .into_iter()
        .zip(sides(b))
        .map(|(a, b)| (a.min(b) + SIZE_SLACK_M) / a.max(b).max(f32::MIN_POSITIVE));
    let size = shares.fold(1.0, f32::min).min(1.0);
    let color: f32 = a.colors.0.iter().zip(b.colors.0).map(|(a, b)| a.min(b)).sum();
    let name = if a.label() == b.label() { 0.5 } else { 0.0 };
    (size >= SAME_SIZE && color >= SAME_COLOR).then_some(size + color + name)
}
