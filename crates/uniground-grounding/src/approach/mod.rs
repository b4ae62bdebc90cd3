//! Approach poses: where a robot can stand to see or reach an instance, and the path to get there.
//!
//! [`Occupancy`] is computed once per parse: the cloud in columns of voxels above a 5 cm grid. For
//! a robot, [`Floor`] classifies its cells as floor, obstacle or unknown. Cells at least the
//! robot's radius away from obstacles (`clearance`) are free. Of the free cells around the
//! `target`, `poses` keeps those within reach and with a path to them (`path`), checks the view of
//! the object from there (`visibility`), and returns the best ones, apart from each other. The
//! support of an object is an obstacle like any other: for a mug on a table the robot stands at the
//! table.
//!
//! Unseen areas are never assumed to be free: a robot neither stands on unknown floor nor drives
//! over it.

mod clearance;
mod floor;
mod occupancy;
mod path;
mod poses;
mod target;
mod visibility;

pub use floor::Floor;
pub use occupancy::Occupancy;
pub use poses::{Places, Wish};

use target::Target;
use uniground_geometry::Point3;
use uniground_geometry::scene::{Instance, InstanceId, Support};
use uniground_types::approach::{CellCounts, FailedCondition, StandingPose};

/// Finds approach poses for an instance. `instances` are those of the parse, as corrected, in order
/// of id. Returns `None` where there is no such instance.
#[must_use]
pub fn approach(
    occupancy: &Occupancy,
    instances: &[Instance],
    id: InstanceId,
    wish: &Wish,
) -> Option<Places> {
    let instance = instances.get((id.0 as usize).checked_sub(1)?)?;
    let Some(target) = Target::of(occupancy, instances, id) else {
        return Some(Places {
            poses: Err(FailedCondition::NotVisible),
            start: None,
            cells: CellCounts::default(),
        });
    };
    let mut places = poses::places(occupancy, &target, wish);
    let place = place_of(instance, instances);
    places
        .poses
        .iter_mut()
        .flatten()
        .for_each(|pose| pose.why = why(pose, instance.label(), &place));
    Some(places)
}

/// Finds poses from which a robot can look at points that no camera saw (meters, world frame).
/// `name` is what the explanations call them. Returns `None` if all points are below the floor.
#[must_use]
pub fn approach_points(
    occupancy: &Occupancy,
    points: &[Point3<f32>],
    name: &str,
    wish: &Wish,
) -> Option<Places> {
    let target = Target::of_points(occupancy, points)?;
    let mut places = poses::places(occupancy, &target, wish);
    places.poses.iter_mut().flatten().for_each(|pose| pose.why = why(pose, name, ""));
    Some(places)
}

/// Returns what an instance stands or hangs on, as an addition to its name.
fn place_of(instance: &Instance, instances: &[Instance]) -> String {
    let name = |id: InstanceId| {
        instances.get((id.0 as usize).wrapping_sub(1)).map_or("object", Instance::label)
    };
    match instance.support {
        Support::Instance { id } => format!(" on the {}", name(id)),
        Support::Wall { .. } => " on the wall".into(),
        Support::Floor | Support::Nothing => String::new(),
    }
}

fn why(pose: &StandingPose, name: &str, place: &str) -> String {
    let StandingPose { distance_m, reach_m, visible_share, clearance_m, path_m, .. } = pose;
    let way = path_m.map_or_else(String::new, |metres| format!("{metres:.1} m to drive, "));
    let room = clearance_m.map_or_else(
        || "no obstacle near".into(),
        |metres| format!("the nearest obstacle is {metres:.2} m away"),
    );
    let sight = (visible_share * 100.0).round();
    format!(
        "{way}{distance_m:.2} m from the {name}{place} ({reach_m:.2} m to reach), {sight} % of it not hidden, {room}"
    )
}

/// Explains in words why there is no approach pose.
#[must_use]
pub fn explanation(failed: FailedCondition, name: &str, cells: &CellCounts) -> String {
    let CellCounts { near, floor, clear, connected, in_reach, looked_from, visible: _ } = cells;
    match failed {
        FailedCondition::StartNotFree => {
            "the start position is not free floor, and none is within 0.5 m of it".into()
        }
        FailedCondition::NoFloor => format!(
            "no free floor was seen near the {name}: none of {near} cells within the limits of distance"
        ),
        FailedCondition::NoRoom => format!(
            "obstacles near the {name} leave this robot no room: none of {floor} cells of free floor"
        ),
        FailedCondition::NotReachable => {
            format!(
                "no path leads to where the {name} can be seen and reached: the robot can drive to {connected} of {clear} cells with room"
            )
        }
        FailedCondition::OutOfReach => {
            let cut_off = match clear - connected {
                0 => String::new(),
                cells => format!(
                    "; obstacles cut off {cells} other cells with room, so a smaller robot or another start may find a pose"
                ),
            };
            format!(
                "the {name} is out of reach from all {connected} cells that the robot can drive to{cut_off}"
            )
        }
        FailedCondition::NotVisible => {
            format!(
                "other objects hide the {name} from all {looked_from} cells that were tested, of {in_reach} cells in reach"
            )
        }
    }
}

#[cfg(test)]
mod tests;
