//! Places in an order: "the second closest", "the leftmost", "the third from the door".

use super::Assessor;
use crate::direction::Directions;
use crate::fit::most_plausible;
use crate::relations::{self, SeenBy};
use uniground_geometry::{Vector2, Vector3};
use uniground_language::{Measure, Relation, RelationKind, Superlative};

/// Each place further from the asked extreme multiplies the score by this.
const NEXT_BEST: f32 = 0.45;
/// Power of a fit when things are ranked: what hardly fits the noun hardly takes up a place in the
/// ranking.
const PRESENCE_POWER: i32 = 4;
/// Windows, doors, screens and pictures are thinner, metres.
const THIN_M: f32 = 0.2;
/// What stands on the floor begins below, metres.
const OFF_THE_FLOOR_M: f32 = 0.4;
/// At this gap from what is looked at a thing is half in view, metres.
const LOOKED_AT_REACH_M: f32 = 1.5;

/// What a place counts by the convention nobody chose where things stand in a row that somebody
/// would look at from its free side.
const NOT_FROM_BEFORE_THE_ROW: f32 = 0.85;
/// What fits this share of the best is one of a row.
const OF_THE_ROW: f32 = 0.5;
/// More than these in a line are counted by nobody.
const LONGEST_ROW: usize = 12;
/// Share of a row's length that its things stand aside of the line at most.
const ASIDE: f32 = 0.3;
/// Where less than this is free, nobody stands to look at a row, metres.
const NOBODY_STANDS_M: f32 = 0.6;
/// What stands as near as this to a thing of a row stands in front of it or behind it, metres.
const IN_THE_WAY_M: f32 = 0.5;

impl Assessor<'_> {
    /// "the largest", "the second from the left"; for each instance, by whose view its place was
    /// told.
    pub(super) fn apply_superlative(
        &self,
        superlative: Superlative,
        scores: &mut [f32],
    ) -> Vec<SeenBy> {
        let (by_directions, mut seen_by) = (
            self.places(superlative, &self.directions, scores),
            vec![SeenBy::Directions; scores.len()],
        );
        let factors = match self.before_the_row(superlative.measure, scores) {
            None => by_directions,
            Some(directions) => {
                let from_before = self.places(superlative, &directions, scores);
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

    /// How well each instance has the asked place, `0..=1`.
    fn places(
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
        // Who faces a window or a picture has the whole room in view.
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
        let places = soft_places(&order, &scores);
        let asked = match superlative.measure {
            Measure::Middle => places.last().map_or(0.0, |(_, last, _)| last / 2.0),
            _ => superlative.rank.max(1) as f32 - 1.0,
        };
        let mut factors = vec![0.0; scores.len()];
        nearness_to(&places, asked)
            .into_iter()
            .for_each(|(t, factor)| factors[t] = factor * here[t]);
        factors
    }

    /// How somebody looks at the things that may be meant, where these stand in a row and nobody
    /// tells from where: they stand on its free side, where the room goes on and nothing is in
    /// the way.
    fn before_the_row(&self, measure: Measure, scores: &[f32]) -> Option<Directions> {
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
            row.iter().map(|&i| self.free(i, &row, &side)).fold(f32::INFINITY, f32::min)
        });
        let ahead = match () {
            () if before > NOBODY_STANDS_M && behind <= NOBODY_STANDS_M => ahead,
            () if behind > NOBODY_STANDS_M && before <= NOBODY_STANDS_M => -ahead,
            () => return None,
        };
        Directions::looking_along(Vector3::new(ahead.x, ahead.y, 0.0))
    }

    /// How far it is from a thing of a row to the next thing on one of its sides, or to the wall;
    /// metres.
    fn free(&self, thing: usize, row: &[usize], side: &Vector2<f32>) -> f32 {
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

/// The direction of the line that points of the ground plan lie on, if they do.
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

/// How well each instance has the asked place of an order by distance.
pub(super) fn ranked(
    relation: &Relation,
    order: &mut [(f32, usize)],
    fits: &[f32],
) -> Vec<(usize, f32)> {
    order.sort_by(|x, y| x.0.total_cmp(&y.0).then(x.1.cmp(&y.1)));
    if relation.kind == RelationKind::Farthest {
        order.reverse();
    }
    nearness_to(&soft_places(order, fits), (relation.rank.max(1) - 1) as f32)
}

/// For each instance of an order: its index, its place from 0, and how surely it is what is asked
/// for, `0..=1`.
///
/// Those ahead count towards the place only as far as they fit themselves: the largest thing that
/// might be a table is seldom a table.
fn soft_places(order: &[(f32, usize)], fits: &[f32]) -> Vec<(usize, f32, f32)> {
    let best = order.iter().map(|&(_, t)| fits[t]).fold(f32::EPSILON, f32::max);
    let mut ahead = 0.0;
    let place = |&(_, t): &(f32, usize)| {
        let (place, presence) = (ahead, (fits[t] / best).powi(PRESENCE_POWER));
        ahead += presence;
        (t, place, presence.sqrt())
    };
    order.iter().map(place).collect()
}

/// How near each instance stands to the asked place (from 0), weighed by how surely it is what is
/// asked for; scaled so that the best has 1.
fn nearness_to(places: &[(usize, f32, f32)], asked: f32) -> Vec<(usize, f32)> {
    let factor = |&(t, place, presence): &(usize, f32, f32)| {
        (t, presence * NEXT_BEST.powf((place - asked).abs()))
    };
    let factors: Vec<(usize, f32)> = places.iter().map(factor).collect();
    let best = factors.iter().map(|f| f.1).fold(f32::EPSILON, f32::max);
    factors.into_iter().map(|(t, factor)| (t, factor / best)).collect()
}

#[cfg(test)]
mod tests {
    use crate::direction::DirectionConvention;
    use crate::{NameIndex, Question, SceneView, ground};
    use uniground_geometry::boxes::Aabb;
    use uniground_geometry::scene::{Instance, Structure, Support};
    use uniground_geometry::{Point3, Vector3};
    use uniground_testing::thing;

    #[test]
    fn a_row_is_counted_from_its_free_side() {
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
        assert_eq!(leftmost(-2.0, DirectionConvention::Paper).0, Some(3), "by the convention too");
        assert_eq!(
            leftmost(0.0, DirectionConvention::Paper),
            (Some(3), false),
            "in the open by the convention"
        );
        assert_eq!(
            leftmost(-2.0, DirectionConvention::Viewer),
            (Some(1), false),
            "who chose a convention has it"
        );
    }
}
