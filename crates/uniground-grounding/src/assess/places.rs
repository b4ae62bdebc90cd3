//! Scores ranks in an order: "the second closest", "the leftmost", "the third from the door".

use super::Assessor;
use crate::direction::Directions;
use crate::fit::most_plausible;
use crate::relations::{self, SeenBy};
use uniground_geometry::{Vector2, Vector3};
use uniground_language::{Measure, Relation, RelationKind, Superlative};

/// Each rank away from the requested one multiplies the score by this.
const NEXT_BEST: f32 = 0.45;
/// Power of a fit when instances are ranked: one that hardly fits the noun hardly takes up a rank.
const PRESENCE_POWER: i32 = 4;
/// Windows, doors, screens and pictures are thinner than this, meters.
const THIN_M: f32 = 0.2;
/// An instance that stands on the floor begins below this height, meters.
const OFF_THE_FLOOR_M: f32 = 0.4;
/// An instance at this gap from the one that the viewer faces is half in view, meters.
const LOOKED_AT_REACH_M: f32 = 1.5;

/// Factor of a rank by the default convention, where instances stand in a row that a viewer would
/// look at from its free side.
const NOT_FROM_BEFORE_THE_ROW: f32 = 0.85;
/// An instance with at least this share of the best fit belongs to the row.
const OF_THE_ROW: f32 = 0.5;
/// Maximum length of a row: people do not count more instances in a line.
const LONGEST_ROW: usize = 12;
/// Maximum distance of an instance from the line, as a share of the row's length.
const ASIDE: f32 = 0.3;
/// A viewer needs at least this much free space to look at a row, meters.
const NOBODY_STANDS_M: f32 = 0.6;
/// An instance this close to one of the row stands in front of it or behind it, meters.
const IN_THE_WAY_M: f32 = 0.5;

impl Assessor<'_> {
    /// Applies a superlative ("the largest", "the second from the left") to the scores. Returns,
    /// for each instance, by whose view its rank was decided.
    pub(super) fn apply_superlative(
        &self,
        superlative: Superlative,
        scores: &mut [f32],
    ) -> Vec<SeenBy> {
        let (by_directions, mut seen_by) = (
            self.rank_fits(superlative, &self.directions, scores),
            vec![SeenBy::Directions; scores.len()],
        );
        let factors = match self.directions_before_row(superlative.measure, scores) {
            None => by_directions,
            Some(directions) => {
                let from_before = self.rank_fits(superlative, &directions, scores);
                let both = || {
                    by_directions
                        .iter()
                        .map(|factor| NOT_FROM_BEFORE_THE_ROW * factor)
                        .zip(from_before.iter().copied())
                };
                seen_by
                    .iter_mut()
                    .zip(both())
                    .filter(|(_, (own, faced))| faced > own)
                    .for_each(|(seen, _)| *seen = SeenBy::WhoFacesIt);
                both().map(|(own, faced)| own.max(faced)).collect()
            }
        };
        scores.iter_mut().zip(factors).for_each(|(score, factor)| *score *= factor);
        seen_by
    }

    /// Returns how well each instance has the requested rank, `0..=1`.
    fn rank_fits(
        &self,
        superlative: Superlative,
        directions: &Directions,
        scores: &[f32],
    ) -> Vec<f32> {
        let along =
            |i: usize, direction: Vector3<f32>| self.solids[i].center.coords.dot(&direction);
        let measure = |i: usize| match superlative.measure {
            Measure::Largest => self.solids[i].volume(),
            Measure::Smallest => -self.solids[i].volume(),
            Measure::Tallest => self.solids[i].size[2],
            Measure::Shortest => -self.solids[i].size[2],
            Measure::Highest => self.solids[i].center.z,
            Measure::Lowest => -self.solids[i].center.z,
            Measure::Leftmost => -along(i, directions.right),
            Measure::Rightmost | Measure::Middle => along(i, directions.right),
            Measure::Frontmost => along(i, directions.front),
            Measure::Backmost => -along(i, directions.front),
        };
        // A viewer who faces a window or a picture has the whole room in view.
        let floor_z = self.scene.extent.min().z;
        let stands_free = |i: &usize| {
            self.solids[*i].sides().1 > THIN_M && self.solids[*i].bottom < floor_z + OFF_THE_FLOOR_M
        };
        let mut here = vec![1.0; scores.len()];
        if let Some(looked_at) =
            self.looked_at.filter(|_| is_sideways(superlative.measure)).filter(stands_free)
        {
            let near = |i: usize| {
                relations::reaching(&self.solids[i], &self.solids[looked_at], LOOKED_AT_REACH_M)
            };
            here.iter_mut().enumerate().for_each(|(i, share)| *share = 0.5 + 0.5 * near(i));
        }
        let scores: Vec<f32> = scores.iter().zip(&here).map(|(score, here)| score * here).collect();
        let mut order: Vec<(f32, usize)> =
            most_plausible(&scores, usize::MAX).into_iter().map(|(t, _)| (measure(t), t)).collect();
        order.sort_by(|a, b| b.0.total_cmp(&a.0).then(a.1.cmp(&b.1)));
        let places = soft_ranks(&order, &scores);
        let asked = match superlative.measure {
            Measure::Middle => places.last().map_or(0.0, |(_, last, _)| last / 2.0),
            _ => superlative.rank.max(1) as f32 - 1.0,
        };
        let mut factors = vec![0.0; scores.len()];
        nearness_to_rank(&places, asked)
            .into_iter()
            .for_each(|(t, factor)| factors[t] = factor * here[t]);
        factors
    }

    /// Returns the directions of a viewer of the instances that may be meant, where these stand in
    /// a row and the question gives no viewpoint. The viewer stands on the row's free side, where
    /// the room continues and nothing is in the way.
    fn directions_before_row(&self, measure: Measure, scores: &[f32]) -> Option<Directions> {
        let best = scores.iter().copied().fold(0.0, f32::max);
        let row: Vec<usize> = (0..scores.len())
            .filter(|&i| scores[i] > 0.0 && scores[i] >= OF_THE_ROW * best)
            .collect();
        if !is_sideways(measure)
            || !self.directions.by_default
            || !(2..=LONGEST_ROW).contains(&row.len())
        {
            return None;
        }
        let line = line_through(
            &row.iter().map(|&i| self.solids[i].center.xy().coords).collect::<Vec<_>>(),
        )?;
        let ahead = Vector2::new(-line.y, line.x);
        let [before, behind] = [-ahead, ahead].map(|side| {
            row.iter().map(|&i| self.free_distance(i, &row, &side)).fold(f32::INFINITY, f32::min)
        });
        let ahead = match () {
            () if before > NOBODY_STANDS_M && behind <= NOBODY_STANDS_M => ahead,
            () if behind > NOBODY_STANDS_M && before <= NOBODY_STANDS_M => -ahead,
            () => return None,
        };
        Directions::looking_along(Vector3::new(ahead.x, ahead.y, 0.0))
    }

    /// Returns the distance from an instance of a row to the next instance on one of its sides, or
    /// to the wall; meters.
    fn free_distance(&self, thing: usize, row: &[usize], side: &Vector2<f32>) -> f32 {
        let own = &self.solids[thing];
        let in_the_way = |i: &usize| {
            let (instance, other) = (&self.scene.instances[*i], &self.solids[*i]);
            let aside = (other.center - own.center).xy();
            let reach = IN_THE_WAY_M + f32::midpoint(own.diagonal(), other.diagonal());
            instance.structure.is_none()
                && aside.norm_squared() < reach * reach
                && own.vertical_gap(other) < 0.0
                && aside.dot(side) > aside.norm() * 0.7
                && !row.contains(i)
        };
        let gaps = (0..self.solids.len())
            .filter(in_the_way)
            .map(|i| own.horizontal_gap(&self.solids[i]))
            .filter(|gap| *gap < IN_THE_WAY_M);
        gaps.fold(self.room().depth(own, side), f32::min)
    }
}

fn is_sideways(measure: Measure) -> bool {
    matches!(measure, Measure::Leftmost | Measure::Rightmost | Measure::Middle)
}

/// Returns the direction of the line that points of the ground plan lie on, if they lie on one.
fn line_through(points: &[Vector2<f32>]) -> Option<Vector2<f32>> {
    let middle = points.iter().sum::<Vector2<f32>>() / points.len() as f32;
    let farthest = points
        .iter()
        .map(|p| p - middle)
        .max_by(|a, b| a.norm_squared().total_cmp(&b.norm_squared()))?;
    let line = farthest.try_normalize(0.1)?;
    let (along, aside) = (
        |p: &Vector2<f32>| (p - middle).dot(&line),
        |p: &Vector2<f32>| (p - middle).perp(&line).abs(),
    );
    let ends = points
        .iter()
        .map(along)
        .fold((0.0_f32, 0.0_f32), |(low, high), at| (low.min(at), high.max(at)));
    points.iter().all(|p| aside(p) <= ASIDE * (ends.1 - ends.0)).then_some(line)
}

/// Returns how well each instance has the requested rank in an order by distance.
pub(super) fn ranks_by_distance(
    relation: &Relation,
    order: &mut [(f32, usize)],
    fits: &[f32],
) -> Vec<(usize, f32)> {
    sort_by_distance(relation, order);
    nearness_to_rank(&soft_ranks(order, fits), (relation.rank.max(1) - 1) as f32)
}

/// Returns each instance's place in an order by distance, from 0. Instances ahead count only as far
/// as they fit themselves.
pub(super) fn places_by_distance(
    relation: &Relation,
    order: &mut [(f32, usize)],
    fits: &[f32],
) -> Vec<(usize, f32)> {
    sort_by_distance(relation, order);
    soft_ranks(order, fits).into_iter().map(|(t, place, _)| (t, place)).collect()
}

fn sort_by_distance(relation: &Relation, order: &mut [(f32, usize)]) {
    order.sort_by(|x, y| x.0.total_cmp(&y.0).then(x.1.cmp(&y.1)));
    if matches!(relation.kind, RelationKind::Farthest | RelationKind::Far) {
        order.reverse();
    }
}

/// Returns, for each instance of an order, its index, its rank from 0, and how certainly it is the
/// requested object, `0..=1`.
///
/// Instances ahead count towards the rank only as far as they fit themselves: the largest instance
/// that might be a table is seldom a table.
fn soft_ranks(order: &[(f32, usize)], fits: &[f32]) -> Vec<(usize, f32, f32)> {
    let best = order.iter().map(|&(_, t)| fits[t]).fold(f32::EPSILON, f32::max);
    let mut ahead = 0.0;
    let place = |&(_, t): &(f32, usize)| {
        let (place, presence) = (ahead, (fits[t] / best).powi(PRESENCE_POWER));
        ahead += presence;
        (t, place, presence.sqrt())
    };
    order.iter().map(place).collect()
}

/// Returns how near each instance is to the requested rank (from 0), weighted by how certainly it
/// is the requested object. Scaled so that the best has 1.
fn nearness_to_rank(places: &[(usize, f32, f32)], asked: f32) -> Vec<(usize, f32)> {
    let factor = |&(t, place, presence): &(usize, f32, f32)| {
        (t, presence * NEXT_BEST.powf((place - asked).abs()))
    };
    let factors: Vec<(usize, f32)> = places.iter().map(factor).collect();
    let best = factors.iter().map(|f| f.1).fold(f32::EPSILON, f32::max);
    factors.into_iter().map(|(t, factor)| (t, factor / best)).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::direction::DirectionConvention;
    use crate::{NameIndex, Question, SceneView, ground};
    use uniground_geometry::Point3;
    use uniground_geometry::boxes::Aabb;
    use uniground_geometry::scene::{Instance, Structure, Support};
    use uniground_testing::thing;

    fn stool(id: u32, at: [f32; 2]) -> Instance {
        let stool = thing(id, at, [0.4, 0.4, 0.45], 0.0, Support::Floor, [90, 60, 40]);
        Instance { given_name: Some("stool".into()), ..stool }
    }

    /// Returns four posts far apart, with free space on all sides of the middle.
    fn posts(first: u32) -> [Instance; 4] {
        [(0, [-8.0, -8.0]), (1, [8.0, -8.0]), (2, [-8.0, 8.0]), (3, [8.0, 8.0])]
            .map(|(i, at)| thing(first + i, at, [0.2, 0.2, 2.6], 0.0, Support::Floor, [90; 3]))
    }

    fn with_assessor<T>(instances: &[Instance], of: impl FnOnce(&mut Assessor) -> T) -> T {
        let names = NameIndex::of(instances);
        let extent =
            Aabb { center: Point3::new(0.0, 0.0, 1.3), size: Vector3::new(17.0, 17.0, 2.6) };
        let scene = SceneView { instances, extent, names: &names, appearance: None };
        of(&mut Assessor::new(scene, DirectionConvention::Viewer.into()))
    }

    #[track_caller]
    fn assert_close(found: &[f32], by_hand: &[f32]) {
        let same = found.len() == by_hand.len()
            && found.iter().zip(by_hand).all(|(a, b)| (a - b).abs() < 2e-4);
        assert!(same, "{found:?}, expected {by_hand:?}");
    }

    /// Returns scores of 1 after a superlative.
    fn superlative_scores(instances: &[Instance], measure: Measure, rank: u32) -> Vec<f32> {
        let mut scores = vec![1.0; instances.len()];
        with_assessor(instances, |assessor| {
            let seen = assessor.apply_superlative(Superlative { measure, rank }, &mut scores);
            assert_eq!(seen, vec![SeenBy::Directions; instances.len()]);
        });
        scores
    }

    #[test]
    fn each_superlative_ranks_by_its_own_measure() {
        let sized = |id, at, size, base| thing(id, at, size, base, Support::Nothing, [90; 3]);
        // Volumes of 0.5, 0.08 and 0.25 m³, heights of 0.5, 2 and 1 m, middles at 1.25, 1 and
        // 2.5 m; from the left the third, the first, the second; from the front (-Y) the second,
        // the third, the first.
        let room = [
            sized(1, [0.0, 2.0], [1.0, 1.0, 0.5], 1.0),
            sized(2, [1.0, 0.0], [0.2, 0.2, 2.0], 0.0),
            sized(3, [-1.0, 1.0], [0.5, 0.5, 1.0], 2.0),
        ];
        let (first, second, third) = (1.0, 0.45, 0.202_5);
        for (measure, by_hand) in [
            (Measure::Largest, [first, third, second]),
            (Measure::Smallest, [third, first, second]),
            (Measure::Tallest, [third, first, second]),
            (Measure::Shortest, [first, third, second]),
            (Measure::Highest, [second, third, first]),
            (Measure::Lowest, [second, first, third]),
            (Measure::Leftmost, [second, third, first]),
            (Measure::Rightmost, [second, first, third]),
            (Measure::Frontmost, [third, first, second]),
            (Measure::Backmost, [first, third, second]),
            (Measure::Middle, [1.0, 0.45, 0.45]),
        ] {
            let found = superlative_scores(&room, measure, 1);
            assert!(
                found.iter().zip(by_hand).all(|(a, b)| (a - b).abs() < 1e-4),
                "{measure:?}: {found:?}, expected {by_hand:?}"
            );
        }
        // The second from the left is the first of them.
        assert_close(&superlative_scores(&room, Measure::Leftmost, 2), &[1.0, 0.45, 0.45]);
        assert_close(&superlative_scores(&room, Measure::Leftmost, 3), &[0.45, 1.0, 0.202_5]);
        assert_close(&superlative_scores(&room, Measure::Leftmost, 0), &[0.45, 0.202_5, 1.0]);
    }

    #[test]
    fn each_rank_away_multiplies_by_45_percent_weighted_by_certainty() {
        let of = |places: &[(usize, f32, f32)], asked| {
            let mut factors = nearness_to_rank(places, asked);
            factors.sort_by_key(|f| f.0);
            factors.into_iter().map(|f| f.1).collect::<Vec<_>>()
        };
        assert_close(
            &of(&[(0, 0.0, 1.0), (1, 1.0, 1.0), (2, 2.0, 0.25)], 1.0),
            &[0.45, 1.0, 0.112_5],
        );
        // The best one is scaled to 1: 0.5 / 0.5, and 0.25 · 0.45 / 0.5.
        assert_close(&of(&[(0, 0.0, 0.5), (1, 1.0, 0.25)], 0.0), &[1.0, 0.225]);
        // Half a rank is √0.45.
        assert_close(&of(&[(0, 0.0, 1.0), (1, 0.5, 1.0)], 0.0), &[1.0, 0.670_82]);
        assert!(of(&[], 0.0).is_empty());
    }

    #[test]
    fn weak_fits_hardly_take_up_a_rank() {
        // The others have half of the best fit, 0.8: 0.5⁴ = 0.0625 of a rank, with certainty 0.5².
        let found = soft_ranks(&[(9.0, 2), (5.0, 0), (1.0, 1)], &[0.8, 0.4, 0.4]);
        assert_eq!(found, [(2, 0.0, 0.25), (0, 0.0625, 1.0), (1, 1.0625, 0.25)]);
    }

    #[test]
    fn ranks_count_from_the_nearest_or_the_farthest() {
        let ranked_as = |kind, rank| {
            let relation =
                Relation { kind, text: String::new(), anchors: vec![], negated: false, rank };
            let mut order = [(2.0, 1), (1.0, 0), (2.0, 2)];
            let mut found = ranks_by_distance(&relation, &mut order, &[1.0; 3]);
            found.sort_by_key(|f| f.0);
            found.into_iter().map(|f| f.1).collect::<Vec<_>>()
        };
        // Equal distances keep their order, from either end.
        assert_close(&ranked_as(RelationKind::Closest, 1), &[1.0, 0.45, 0.202_5]);
        assert_close(&ranked_as(RelationKind::Closest, 2), &[0.45, 1.0, 0.45]);
        assert_close(&ranked_as(RelationKind::Closest, 0), &[1.0, 0.45, 0.202_5]);
        assert_close(&ranked_as(RelationKind::Farthest, 1), &[0.202_5, 0.45, 1.0]);
    }

    #[test]
    fn side_ranks_prefer_instances_near_the_faced_instance() {
        // A table, and stools at its side and 1.5 m to the left of it, which halves it.
        let side_table = |size, base| thing(1, [0.0, 0.0], size, base, Support::Floor, [90; 3]);
        let room = |table| [table, stool(2, [-0.5 - 1.5 - 0.2, 0.0]), stool(3, [0.7, 0.0])];
        let of = |table: Instance, measure, looked_at| {
            let mut scores = [0.0, 1.0, 1.0];
            with_assessor(&room(table), |assessor| {
                assessor.looked_at = looked_at;
                assessor.apply_superlative(Superlative { measure, rank: 1 }, &mut scores);
            });
            scores
        };
        let table = || side_table([1.0, 1.0, 0.7], 0.0);
        assert_close(&of(table(), Measure::Leftmost, None), &[0.0, 1.0, 0.45]);
        // 0.5 + 0.5 · 0.5 = 0.75 of it: it takes 0.75⁴ = 0.316406 of a rank with certainty
        // 0.75² = 0.5625; the other has 0.45^0.316406 = 0.776735. 0.75 · 0.5625 / 0.776735.
        assert_close(&of(table(), Measure::Leftmost, Some(0)), &[0.0, 0.543_14, 1.0]);
        // The front does not depend on the faced instance.
        assert_close(
            &of(table(), Measure::Frontmost, Some(0)),
            &of(table(), Measure::Frontmost, None),
        );
        // A viewer who faces a window (thin) or an instance off the floor sees the whole room.
        for (size, base, in_view) in [
            ([1.0, 0.2, 0.7], 0.0, true),
            ([1.0, 0.21, 0.7], 0.0, false),
            ([1.0, 1.0, 0.7], 0.41, true),
            ([1.0, 1.0, 0.7], 0.39, false),
        ] {
            let found = of(side_table(size, base), Measure::Leftmost, Some(0));
            assert_eq!(found[1] > found[2], in_view, "{size:?} {base}: {found:?}");
        }
    }

    #[test]
    fn points_form_a_line_within_thirty_percent_of_its_length() {
        let line = |points: &[[f32; 2]]| {
            line_through(&points.iter().map(|p| Vector2::from(*p)).collect::<Vec<_>>())
        };
        let along = line(&[[1.0, 1.0], [4.0, 5.0], [2.5, 3.0]]).unwrap();
        assert!(along.perp(&Vector2::new(0.6, 0.8)).abs() < 1e-5, "{along}");
        // 4 m long: 1.2 m aside.
        assert!(line(&[[-2.0, 0.0], [2.0, 0.0], [-1.0, 1.19], [1.0, -1.19]]).is_some());
        assert!(line(&[[-2.0, 0.0], [2.0, 0.0], [-1.0, 1.21], [1.0, -1.21]]).is_none());
        // Points within 0.1 m of their middle form no line.
        assert!(line(&[[3.0, 1.0], [3.0, 1.18]]).is_none());
        assert!(line(&[[3.0, 1.0], [3.0, 1.22]]).is_some());
    }

    /// Returns the direction in which a viewer looks at the first `row` instances as a row; `None`
    /// without such a view.
    fn row_view(instances: &[Instance], row: usize) -> Option<[i32; 2]> {
        let mut scores = vec![0.0; instances.len()];
        scores[..row].fill(1.0);
        with_assessor(instances, |assessor| {
            assessor.directions = DirectionConvention::Paper.into();
            let seen = assessor.directions_before_row(Measure::Leftmost, &scores)?;
            let ahead = -seen.front;
            Some([ahead.x.round() as i32, ahead.y.round() as i32])
        })
    }

    fn row_of(count: u32, at: impl Fn(f32) -> [f32; 2]) -> Vec<Instance> {
        (1..=count).map(|id| stool(id, at(id as f32 - f32::midpoint(count as f32, 1.0)))).collect()
    }

    fn block(id: u32, at: [f32; 2], size: [f32; 3], base: f32) -> Instance {
        thing(id, at, size, base, Support::Floor, [90; 3])
    }

    #[test]
    fn row_is_viewed_from_its_unobstructed_side() {
        let beside = |y: f32, base: f32| {
            let mut room = row_of(3, |x| [x, 0.0]);
            room.push(block(4, [0.0, y], [0.5, 0.5, 1.0], base));
            room.extend(posts(5));
            row_view(&room, 3)
        };
        // A block 0.3 m behind the middle one, from 0.2 m to 0.25 m before its middle.
        assert_eq!(beside(0.75, 0.0), Some([0, 1]));
        assert_eq!(beside(-0.75, 0.0), Some([0, -1]));
        // 0.49 m is in the way; 0.51 m is not, nor is a block that hangs above.
        assert_eq!(beside(0.45 + 0.49, 0.0), Some([0, 1]));
        assert_eq!(beside(0.45 + 0.51, 0.0), None);
        assert_eq!(beside(0.75, 0.5), None);
        // A deep block is as near, although its middle is 2 m away.
        let mut room = row_of(3, |x| [x, 0.0]);
        room.push(block(4, [0.0, 2.0], [0.5, 3.0, 1.0], 0.0));
        room.extend(posts(5));
        assert_eq!(row_view(&room, 3), Some([0, 1]));
        // A row along a diagonal, with a block across it.
        let mut room = row_of(3, |x| [x, x]);
        room.push(block(4, [-0.6, 0.6], [0.5, 0.5, 1.0], 0.0));
        room.extend(posts(5));
        assert_eq!(row_view(&room, 3), Some([-1, 1]));
        // Blocks on both sides: no viewer fits anywhere.
        let mut room = row_of(3, |x| [x, 0.0]);
        room.push(block(4, [0.0, 0.75], [0.5, 0.5, 1.0], 0.0));
        room.push(block(5, [0.0, -0.75], [0.5, 0.5, 1.0], 0.0));
        room.extend(posts(6));
        assert_eq!(row_view(&room, 3), None);
        // A row along Y, with a block at +X.
        let mut room = row_of(3, |y| [0.0, y]);
        room.push(block(4, [0.75, 0.0], [0.5, 0.5, 1.0], 0.0));
        room.extend(posts(5));
        assert_eq!(row_view(&room, 3), Some([1, 0]));
    }

    #[test]
    fn only_instances_across_the_row_obstruct_its_view() {
        let beside = |offset: [f32; 2], structure| {
            let mut room = row_of(2, |x| [2.0 * x, 0.0]);
            let at = [1.0 + offset[0], offset[1]];
            room.push(Instance { structure, ..block(3, at, [0.1, 0.1, 1.0], 0.0) });
            room.extend(posts(4));
            row_view(&room, 2)
        };
        // Within 45 degrees of straight behind it: 0.4 of 0.5 m, more than 0.7; 0.3 is less.
        assert_eq!(beside([0.3, 0.4], None), Some([0, 1]));
        assert_eq!(beside([0.4, 0.3], None), None);
        // Structure is not in the way.
        assert_eq!(beside([0.3, 0.4], Some(Structure::Ceiling)), None);
    }

    #[test]
    fn row_view_applies_to_two_to_twelve_instances_and_side_measures() {
        let behind = |count: u32| {
            let mut room = row_of(count, |x| [x, 0.0]);
            // One block behind each stool.
            room.extend((1..=count).map(|id| {
                let x = id as f32 - f32::midpoint(count as f32, 1.0);
                block(count + id, [x, 0.75], [0.5, 0.5, 1.0], 0.0)
            }));
            room.extend(posts(2 * count + 1));
            row_view(&room, count as usize)
        };
        let found = [1, 2, 3, 12, 13].map(behind);
        assert_eq!(found, [None, Some([0, 1]), Some([0, 1]), Some([0, 1]), None]);
        let mut room = row_of(3, |x| [x, 0.0]);
        room.push(block(4, [0.0, 0.75], [0.5, 0.5, 1.0], 0.0));
        room.extend(posts(5));
        with_assessor(&room, |assessor| {
            let of = |assessor: &Assessor, measure, scores: [f32; 8]| {
                assessor.directions_before_row(measure, &scores).is_some()
            };
            let row = [1.0, 1.0, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0];
            assert!(!of(assessor, Measure::Leftmost, row), "the request has a convention");
            assessor.directions = DirectionConvention::Paper.into();
            for measure in Measure::ALL {
                let sideways =
                    matches!(measure, Measure::Leftmost | Measure::Rightmost | Measure::Middle);
                assert_eq!(of(assessor, measure, row), sideways, "{measure:?}");
            }
            // From half of the best fit on, the block belongs to the row and is not in the way.
            let with_block = |fit| [0.8, 0.8, 0.8, fit, 0.0, 0.0, 0.0, 0.0];
            assert!(of(assessor, Measure::Leftmost, with_block(0.39)));
            assert!(!of(assessor, Measure::Leftmost, with_block(0.4)));
            assert!(!of(assessor, Measure::Leftmost, [0.0; 8]));
        });
    }

    #[test]
    fn convention_rank_counts_85_percent_of_the_row_view() {
        // A block behind three stools: a viewer who looks along +Y has left at -X, the paper +X.
        let mut room = row_of(3, |x| [x, 0.0]);
        room.push(block(4, [0.0, 0.75], [0.5, 0.5, 1.0], 0.0));
        room.extend(posts(5));
        with_assessor(&room, |assessor| {
            assessor.directions = DirectionConvention::Paper.into();
            let mut scores = [1.0, 1.0, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0];
            let leftmost = Superlative { measure: Measure::Leftmost, rank: 1 };
            let seen = assessor.apply_superlative(leftmost, &mut scores);
            // From in front of the row 1, 0.45, 0.2025; by the paper 0.85 of 0.2025, 0.45, 1.
            assert_close(&scores, &[1.0, 0.45, 0.85, 0.0, 0.0, 0.0, 0.0, 0.0]);
            let by = [SeenBy::WhoFacesIt, SeenBy::WhoFacesIt, SeenBy::Directions];
            assert_eq!(seen[..3], by);
        });
    }

    #[test]
    fn free_distance_ends_at_the_next_instance_or_the_room() {
        let mut room = row_of(2, |x| [2.0 * x, 0.0]);
        room.push(block(3, [1.0, 0.75], [0.5, 0.5, 1.0], 0.0));
        room.extend(posts(4));
        with_assessor(&room, |assessor| {
            let free = |thing, side: Vector2<f32>| assessor.free_distance(thing, &[0, 1], &side);
            // The posts reach 8.1 m, a stool 0.2 m.
            assert_close(&[free(1, Vector2::y()), free(1, -Vector2::y())], &[0.3, 7.9]);
            assert_close(&[free(0, Vector2::y()), free(0, Vector2::x())], &[7.9, 8.9]);
            // A member of the row is never in the way.
            assert_close(&[assessor.free_distance(1, &[0, 1, 2], &Vector2::y())], &[7.9]);
        });
    }

    #[test]
    fn ranks_in_a_row_follow_the_view_from_its_free_side() {
        // Three stools along a wall at y = 2, at y = -2, and in the open; ids 1 to 3 by X.
        let leftmost = |y: f32, convention| {
            let mut instances: Vec<Instance> = (1..=3)
                .map(|id| {
                    thing(
                        id,
                        [id as f32 - 2.0, y],
                        [0.4, 0.4, 0.45],
                        0.0,
                        Support::Floor,
                        [90, 60, 40],
                    )
                })
                .collect();
            let ends = [(4, -2.3), (5, 2.3)];
            let walls = ends
                .map(|(id, y)| thing(id, [0.0, y], [7.0, 0.1, 2.6], 0.0, Support::Floor, [200; 3]));
            instances
                .extend(walls.map(|wall| Instance { structure: Some(Structure::Wall), ..wall }));
            instances
                .iter_mut()
                .for_each(|i| i.given_name = i.structure.is_none().then(|| "stool".into()));
            let extent =
                Aabb { center: Point3::new(0.0, 0.0, 1.3), size: Vector3::new(7.0, 5.0, 2.6) };
            let names = NameIndex::of(&instances);
            let scene =
                SceneView { instances: &instances, extent, names: &names, appearance: None };
            let answer = ground(
                scene,
                &Question { convention, ..Question::of("the stool on the far left") },
            )
            .answer;
            let from_before = answer.explanation.contains("as who stands before them sees them");
            (answer.predicted_id.map(|id| id.0), from_before)
        };
        assert_eq!(leftmost(2.0, DirectionConvention::Paper), (Some(1), true));
        assert_eq!(leftmost(-2.0, DirectionConvention::Paper).0, Some(3), "the convention agrees");
        assert_eq!(
            leftmost(0.0, DirectionConvention::Paper),
            (Some(3), false),
            "in the open the convention decides"
        );
        assert_eq!(
            leftmost(-2.0, DirectionConvention::Viewer),
            (Some(1), false),
            "a requested convention takes precedence"
        );
    }
}
