//! Whether an object that was not found may be where no camera looked.

use super::answer::{CANNOT_TELL_WHETHER, NOTHING_CLEARLY};
use super::{Grounding, NoMatchReason, Region, Status};
use uniground_geometry::Point3;
use uniground_geometry::scene::{RoomCoverage, UnseenVolume};
use uniground_types::coverage::{Coverage, UnseenRegion};

/// From this share on, the room counts as seen: the rest is behind and under furniture.
const SEEN: f32 = 0.95;

/// Adds to the answer about an object that was not found how much of the room was seen, also if
/// another object is guessed. Changes nothing for other answers.
pub(super) fn add_coverage(
    coverage: &RoomCoverage,
    within: Option<&Region>,
    grounding: &mut Grounding,
) {
    let is_absent = grounding.status == Status::NoMatch;
    // A guess: "I found nothing that is clearly a piano. The likeliest is the table."
    if !is_absent && grounding.answer.target_name_matches != Some(false) {
        return;
    }
    grounding.coverage = describe(coverage, within);
    let is_about_the_room = !matches!(
        grounding.no_match_reason,
        Some(NoMatchReason::NotRecognised | NoMatchReason::NotEnglish | NoMatchReason::NotListed)
    );
    let says_nothing_found = is_absent
        || [NOTHING_CLEARLY, CANNOT_TELL_WHETHER].iter().any(|it| grounding.text.starts_with(it));
    if let Some(coverage) = &grounding.coverage
        && says_nothing_found
        && is_about_the_room
    {
        // Rounded down: "100 %" is said of a room only if all of it was seen.
        let percent = (coverage.seen_share * 100.0).floor();
        let part = if within.is_some() { "that part of the room" } else { "the room" };
        let rest = if coverage.may_be_unseen { "; no camera looked at the rest" } else { "" };
        grounding.text = format!("{} I saw {percent} % of {part}{rest}.", grounding.text);
    }
}

/// Returns how much of a room, or of a region in it, was seen; `None` where the region has no part
/// of the room.
fn describe(coverage: &RoomCoverage, within: Option<&Region>) -> Option<Coverage> {
    let is_within = |p: &Point3<f32>| {
        within.is_none_or(|region| region.contains(p.coords.map(f64::from).into()))
    };
    let seen = match within {
        None => coverage.seen_share(),
        Some(_) => coverage.seen_share_within(is_within)?,
    };
    Some(Coverage {
        seen_share: seen.share,
        unseen_m3: seen.unseen_m3,
        unseen_floor_m2: seen.unseen_floor_m2,
        may_be_unseen: seen.share < SEEN,
        regions: unseen_regions(coverage)
            .into_iter()
            .zip(coverage.unseen_volumes())
            .filter(|(_, volume)| within.is_none() || volume.points.iter().any(is_within))
            .map(|(region, _)| region)
            .collect(),
    })
}

/// Returns the parts of a room that no camera saw, the largest first.
#[must_use]
pub fn unseen_regions(coverage: &RoomCoverage) -> Vec<UnseenRegion> {
    let numbered = (1..).zip(coverage.unseen_volumes());
    let region = |(number, volume): (u32, &UnseenVolume)| {
        let &UnseenVolume { aabb, volume_m3, floor_m2, .. } = volume;
        UnseenRegion { number, aabb, volume_m3, floor_m2 }
    };
    numbered.map(region).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{NameIndex, Question, SceneView, ground};
    use serde_json::json;
    use uniground_geometry::boxes::Aabb;

    /// A row of ten voxels of one meter, of which this many were not seen.
    fn row(unseen: u32) -> RoomCoverage {
        let grid =
            json!({"yaw_rad": 0.0, "origin": [0.0, 0.0, 0.0], "voxel_m": 1.0, "size": [10, 1, 1]});
        let stored = json!({"grid": grid, "runs": [[1, 10 - unseen], [2, unseen]]});
        serde_json::from_value(stored).unwrap()
    }

    /// The answer to a question about an empty room.
    fn answer(query: &str, coverage: &RoomCoverage, within: Option<&Region>) -> Grounding {
        let extent = Aabb::from_corners(Point3::origin(), Point3::new(10.0, 1.0, 1.0));
        let names = NameIndex::of(&[]);
        let scene = SceneView { instances: &[], extent, names: &names, appearance: None };
        let mut grounding = ground(scene, &Question::of(query));
        add_coverage(coverage, within, &mut grounding);
        grounding
    }

    #[test]
    fn the_sentence_says_how_much_was_seen() {
        let some = answer("the piano", &row(2), None);
        assert!(
            some.text.ends_with(". I saw 80 % of the room; no camera looked at the rest."),
            "{}",
            some.text
        );
        let coverage = some.coverage.unwrap();
        assert!(
            coverage.may_be_unseen && (coverage.unseen_m3, coverage.unseen_floor_m2) == (2.0, 2.0)
        );
        let [region] = &coverage.regions[..] else { panic!("{:?}", coverage.regions) };
        assert_eq!((region.number, region.volume_m3, region.aabb.center.x), (1, 2.0, 9.0));
        let all = answer("the piano", &row(0), None);
        assert!(all.text.ends_with(" I saw 100 % of the room."), "{}", all.text);
        assert!(!all.coverage.unwrap().may_be_unseen);
    }

    #[test]
    fn a_region_has_its_own_share() {
        let within = |low: f64, high: f64| Region {
            polygon: Some(vec![[low, -1.0], [high, -1.0], [high, 2.0], [low, 2.0]]),
            ..Region::default()
        };
        let seen = answer("the piano", &row(2), Some(&within(0.0, 5.0)));
        assert!(seen.text.ends_with(" I saw 100 % of that part of the room."), "{}", seen.text);
        assert_eq!(seen.coverage.unwrap().regions, []);
        let half = answer("the piano", &row(2), Some(&within(6.0, 10.0))).coverage.unwrap();
        assert_eq!((half.seen_share, half.regions.len()), (0.5, 1));
        assert_eq!(answer("the piano", &row(2), Some(&within(20.0, 21.0))).coverage, None);
    }

    #[test]
    fn unknown_words_say_nothing_about_the_room() {
        let unknown = answer("the qwxzt", &row(2), None);
        assert!(!unknown.text.contains('%') && unknown.coverage.is_some(), "{}", unknown.text);
    }
}
