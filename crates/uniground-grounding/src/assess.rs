//! Scores how well every instance fits a whole phrase: the instance itself, what it carries, its
//! relations, and its rank among instances of its kind.
//!
//! A phrase is a tree: its anchors are phrases with anchors of their own. The best score of an
//! instance is its own fit times, for each relation, the best (fit of an anchor) x (geometry of the
//! pair) over **all** other instances, computed from the leaves up. So target and anchors are
//! chosen together, not one after the other.

pub(crate) mod carried;
mod distances;
mod places;

use super::SceneView;
use super::direction::Directions;
use super::fit::{
    colors_fit, excluded_words_fit, most_plausible, noun_fits, prefer_main_color, trait_fits,
};
use super::relations::{self, SeenBy};
use super::room::{Faced, Room};
use super::solid::Solid;
use places::ranks_by_distance;
use std::cell::OnceCell;
use uniground_geometry::boxes::OrientedBox;
use uniground_geometry::scene::{InstanceId, Structure, Support};
use uniground_geometry::statistics::largest_indices;
use uniground_geometry::{Point2, Point3, Vector3};
use uniground_language::{ME, Meaning, Phrase, Reach, Relation, RelationKind, zones};

/// Factor of a score when a relation is contradicted. Not 0, because geometry is noisy.
const CONTRADICTED: f32 = 0.05;
/// The same factor for relations that depend on the viewer, and on how people use "between" or "in
/// the corner".
const LOOSELY_CONTRADICTED: f32 = 0.2;
/// How many anchors a relation tries, best first. This bounds the work in a scene of thousands of
/// instances.
const MAX_ANCHORS: usize = 64;
/// The same for each anchor of "between", where pairs are tried.
const MAX_ANCHORS_OF_A_PAIR: usize = 16;
/// Instances whose own fit is lower than this are not examined further.
const IMPOSSIBLE: f32 = 0.01;
/// A phrase whose best noun fit is below this names nothing that was found in the room.
const FOUND: f32 = 0.05;
/// Share of the best fit from which another instance may be meant too.
const MAY_BE_MEANT: f32 = 0.5;
/// Below this score, no instance carries the requested object.
const CARRIED: f32 = 0.25;
/// Factor of a score when the anchor of a relation was not found. It may exist undetected.
const NOT_FOUND: f32 = 0.3;

/// Factor of "on the wall" for an instance that stands in front of the wall.
const AT_THE_WALL: f32 = 0.3;

/// The anchor chosen for one relation, with the score of the pair.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct RelationMatch {
    pub score: f32,
    pub anchor: Option<InstanceId>,
}

const NO_BOND: RelationMatch = RelationMatch { score: 0.0, anchor: None };

/// A phrase scored against every instance. Vectors are by index, scores in `0..=1`.
#[derive(Debug, Clone, PartialEq)]
pub struct Assessment {
    /// Fit of the noun alone.
    pub nouns: Vec<f32>,
    /// Fit of names and attributes, and of what the instance carries.
    pub own: Vec<f32>,
    /// For each relation of the phrase, the best anchors of every instance.
    pub bonds: Vec<Vec<RelationMatch>>,
    /// By whose view the rank among instances of the kind was decided; empty where the question has
    /// no rank.
    pub place_seen_by: Vec<SeenBy>,
    pub total: Vec<f32>,
}

/// A scene with the directions that a question is read in.
pub struct Assessor<'a> {
    pub scene: SceneView<'a>,
    pub solids: Vec<Solid>,
    pub directions: Directions,
    /// Position of the observer whom "me" refers to.
    pub observer: Option<Solid>,
    /// Index of the instance that the viewer faces: of instances to the left and right, those near
    /// it are meant.
    pub looked_at: Option<usize>,
    /// Whether each instance is in the region where the target has to be; `None` where it may be
    /// anywhere.
    pub within: Option<Vec<bool>>,
    room: OnceCell<Room>,
    /// How a viewer faces each instance. Cached, because it needs all walls and is used with every
    /// other instance.
    faced: Vec<OnceCell<Faced>>,
}

impl<'a> Assessor<'a> {
    #[must_use]
    pub fn new(scene: SceneView<'a>, directions: Directions) -> Self {
        Self {
            scene,
            solids: scene.instances.iter().map(Solid::from).collect(),
            directions,
            observer: None,
            looked_at: None,
            within: None,
            room: OnceCell::new(),
            faced: vec![OnceCell::new(); scene.instances.len()],
        }
    }

    /// Returns the smallest rectangle around everything, and the walls.
    pub fn room(&self) -> &Room {
        self.room.get_or_init(|| {
            let corners: Vec<Point2<f32>> = self.solids.iter().flat_map(|s| s.corners).collect();
            let extent = self.scene.extent;
            let heights = (extent.min().z, extent.max().z);
            let outline =
                OrientedBox::min_area(&corners, heights).map_or_else(|| extent.into(), Solid::from);
            let walls = self
                .scene
                .instances
                .iter()
                .zip(&self.solids)
                .filter(|(i, _)| i.structure == Some(Structure::Wall) && !i.dismissed);
            Room::new(outline, walls.map(|(_, solid)| *solid).collect())
        })
    }

    /// Assesses a phrase, anchors first.
    #[must_use]
    pub fn assess(&self, phrase: &Phrase) -> Assessment {
        let (nouns, own) = self.own_fits(phrase);
        let mut total = own.clone();
        let mut bonds: Vec<Vec<RelationMatch>> = vec![Vec::new(); phrase.relations.len()];
        // Comparisons come last: "the closest of those on the table".
        let comparing = |r: &Relation| r.kind.is_comparison();
        let order = (0..phrase.relations.len()).filter(|&i| !comparing(&phrase.relations[i]));
        let order =
            order.chain((0..phrase.relations.len()).filter(|&i| comparing(&phrase.relations[i])));
        let mut counted = phrase.count.filter(|count| *count > 1).map(|count| count as usize);
        let compares = phrase.superlative.is_some() || phrase.relations.iter().any(comparing);
        for i in order {
            if comparing(&phrase.relations[i])
                && let Some(count) = counted.take()
            {
                keep_best(count, &mut total);
            }
            bonds[i] = self.match_relation(&phrase.relations[i], &total);
            let least = contradiction_factor(phrase.relations[i].kind);
            total
                .iter_mut()
                .zip(&bonds[i])
                .for_each(|(score, bond)| *score *= least + (1.0 - least) * bond.score);
        }
        if let Some(count) = counted.filter(|_| compares) {
            keep_best(count, &mut total);
        }
        let place_seen_by = phrase
            .superlative
            .map_or_else(Vec::new, |superlative| self.apply_superlative(superlative, &mut total));
        Assessment { nouns, own, bonds, place_seen_by, total }
    }

    /// Assesses the phrase of a question's target, which has to be in the question's region. A wall,
    /// floor or ceiling is the target only of words for it, and of a name that it was given.
    #[must_use]
    pub fn assess_target(&self, phrase: &Phrase) -> Assessment {
        let mut assessment = self.assess(phrase);
        if matches!(phrase.meaning(), Meaning::Nouns(_)) {
            let Assessment { nouns, own, total, .. } = &mut assessment;
            for (i, instance) in self.scene.instances.iter().enumerate() {
                if instance.structure.is_some() && self.scene.names.get(i).is_none() {
                    (nouns[i], own[i], total[i]) = (0.0, 0.0, 0.0);
                }
            }
        }
        if let Some(within) = &self.within {
            let Assessment { nouns, own, total, .. } = &mut assessment;
            for scores in [nouns, own, total] {
                for (score, is_within) in scores.iter_mut().zip(within) {
                    *score = if *is_within { *score } else { 0.0 };
                }
            }
        }
        assessment
    }

    /// Returns the fit of every instance to the noun alone, and to noun, colors, traits and carried
    /// things together.
    #[must_use]
    pub fn own_fits(&self, phrase: &Phrase) -> (Vec<f32>, Vec<f32>) {
        let instances = self.scene.instances;
        let nouns = noun_fits(self.scene, phrase);
        let of_color = |(i, noun): (usize, &f32)| {
            if *noun > 0.0 {
                noun * colors_fit(self.scene, phrase, i) * excluded_words_fit(self.scene, phrase, i)
            } else {
                0.0
            }
        };
        let mut own: Vec<f32> = nouns.iter().enumerate().map(of_color).collect();
        prefer_main_color(self.scene, phrase, &nouns, &mut own);
        for &asked in &phrase.traits {
            let fits = trait_fits(instances, &self.solids, &nouns, asked);
            own.iter_mut().zip(fits).for_each(|(score, fit)| *score *= fit);
        }
        for head in &phrase.other_things {
            let others = noun_fits(self.scene, &Phrase { head: head.clone(), ..Phrase::default() });
            // Where all instances that may be meant have the excluded name too ("the football, not
            // the basketball", and both are balls), names do not decide.
            let likely = most_plausible(&own, usize::MAX);
            let shared = likely.iter().map(|&(i, _)| others[i]).fold(1.0, f32::min);
            own.iter_mut()
                .zip(others)
                .for_each(|(score, other)| *score *= 1.0 - 0.95 * (other - shared).max(0.0));
        }
        for with in &phrase.with {
            self.apply_with(with, &mut own);
        }
        (nouns, own)
    }

    /// Returns the index of the instance that a phrase most likely means.
    #[must_use]
    pub fn best(&self, phrase: &Phrase) -> Option<usize> {
        self.likely(phrase, 1).first().map(|&(index, _)| index)
    }

    /// Returns indices of the instances that a phrase may mean, best first, with their fits
    /// relative to the best. Returns at most `most`, and none that fits less than half as well.
    #[must_use]
    pub fn likely(&self, phrase: &Phrase, most: usize) -> Vec<(usize, f32)> {
        let total = self.assess(phrase).total;
        let best = largest_indices(&total, most);
        let of_best = best.first().map_or(1.0, |&i| total[i].max(f32::EPSILON));
        let shares = best.into_iter().map(|i| (i, total[i] / of_best));
        shares.filter(|&(i, share)| total[i] > 0.0 && share >= MAY_BE_MEANT).collect()
    }

    /// Returns the mean position of all instances that a phrase's own words may mean; meters.
    #[must_use]
    pub fn mean_position(&self, phrase: &Phrase) -> Option<Point3<f32>> {
        let likely = most_plausible(&self.own_fits(phrase).1, MAX_ANCHORS);
        let sum =
            likely.iter().fold(Vector3::zeros(), |sum, &(i, _)| sum + self.solids[i].center.coords);
        (!likely.is_empty()).then(|| Point3::from(sum / likely.len() as f32))
    }

    fn id(&self, index: usize) -> InstanceId {
        self.scene.instances[index].id
    }

    fn geometry(&self, kind: RelationKind, target: usize, anchors: &[usize]) -> f32 {
        let score = |anchors: &[&Solid]| {
            relations::score(kind, &self.solids[target], anchors, &self.directions, self.room())
        };
        if let [a, ..] = *anchors
            && kind.is_a_side()
        {
            return self.at_side(kind, target, a).0;
        }
        // At most two anchors count. Slices on the stack, because this runs once for every pair.
        match *anchors {
            [a, b, ..] => score(&[&self.solids[a], &self.solids[b]]),
            [a] => score(&[&self.solids[a]]),
            [] => score(&[]),
        }
    }

    /// Returns how well an instance stands at a side of another, and by whose view.
    #[must_use]
    pub fn at_side(&self, kind: RelationKind, target: usize, anchor: usize) -> (f32, SeenBy) {
        let (target, of) = (&self.solids[target], &self.solids[anchor]);
        let faced = || *self.faced[anchor].get_or_init(|| self.room().faced(of));
        relations::at_side(kind, target, of, &self.directions, faced)
    }

    /// Returns, for every instance as target, its best anchors and how well the relation holds.
    fn match_relation(&self, relation: &Relation, fits: &[f32]) -> Vec<RelationMatch> {
        let most = if relation.kind == RelationKind::Between {
            MAX_ANCHORS_OF_A_PAIR
        } else {
            MAX_ANCHORS
        };
        if let [zone] = &relation.anchors[..]
            && let Some(nouns) = zones::nouns_of_zone(&zone.head)
        {
            return self.match_zone(nouns, fits, relation.negated);
        }
        if let [anchor] = &relation.anchors[..]
            && anchor.head == ME
        {
            // The observer's position is unknown unless the request gives it.
            let unknown = || vec![RelationMatch { score: 1.0, anchor: None }; fits.len()];
            return self
                .observer
                .as_ref()
                .map_or_else(unknown, |observer| self.match_to_observer(relation, observer, fits));
        }
        let assessed: Vec<Assessment> =
            relation.anchors.iter().map(|phrase| self.assess(phrase)).collect();
        if let Some(share) = unchecked_factor(&relation.anchors, &assessed, NOT_FOUND) {
            return self.match_side_of_unknown(relation, fits, share);
        }
        let anchors: Vec<Vec<(usize, f32)>> =
            assessed.iter().map(|found| most_plausible(&found.total, most)).collect();
        let each = |of: &dyn Fn(usize) -> RelationMatch| {
            (0..fits.len()).map(|t| if fits[t] < IMPOSSIBLE { NO_BOND } else { of(t) }).collect()
        };
        let bonds: Vec<RelationMatch> = match (relation.kind, &anchors[..]) {
            (kind, _) if kind.is_of_the_room() => {
                each(&|t| RelationMatch { score: self.geometry(kind, t, &[]), anchor: None })
            }
            // "near" without an anchor: the parsed query reports it, the decision ignores it.
            (_, []) => vec![RelationMatch { score: 1.0, anchor: None }; fits.len()],
            (kind, all) if kind.is_comparison() => self.match_by_distance(relation, fits, all),
            (RelationKind::Between, [a, b, ..]) => each(&|t| self.match_between(t, a, b)),
            (RelationKind::Between, [only]) => each(&|t| self.match_between(t, only, only)),
            (RelationKind::Near | RelationKind::Far, [only])
                if Reach::in_words(&relation.text).is_none() =>
            {
                let mut bonds: Vec<RelationMatch> = each(&|t| self.best_match(relation, t, only));
                self.rank_matches(relation, fits, &mut bonds);
                bonds
            }
            // Several anchors ("next to the sofa and the lamp") must all hold.
            (_, all) => each(&|t| {
                let mut joint = RelationMatch { score: 1.0, anchor: None };
                for candidates in all {
                    let bond = self.best_match(relation, t, candidates);
                    joint = RelationMatch {
                        score: joint.score * bond.score,
                        anchor: joint.anchor.or(bond.anchor),
                    };
                }
                joint
            }),
        };
        // "on a stand": if no detected stand holds it, it is on an undetected one.
        let found =
            bonds.iter().zip(fits).any(|(bond, fit)| bond.score >= CARRIED && *fit >= IMPOSSIBLE);
        if !found && relation.anchors.iter().any(|anchor| anchor.indefinite) && !relation.negated {
            return vec![RelationMatch { score: NOT_FOUND, anchor: None }; fits.len()];
        }
        match relation.negated {
            true => {
                bonds.into_iter().map(|b| RelationMatch { score: 1.0 - b.score, ..b }).collect()
            }
            false => bonds,
        }
    }

    /// Scores a relation whose anchor is unknown or was not found. "Right of the mantel" then means
    /// the rightmost of its kind.
    fn match_side_of_unknown(
        &self,
        relation: &Relation,
        fits: &[f32],
        share: f32,
    ) -> Vec<RelationMatch> {
        let side = match relation.kind {
            RelationKind::LeftOf => -self.directions.right,
            RelationKind::RightOf => self.directions.right,
            _ => return vec![RelationMatch { score: share, anchor: None }; fits.len()],
        };
        let along = |t: usize| -self.solids[t].center.coords.dot(&side);
        let mut order: Vec<(f32, usize)> =
            most_plausible(fits, usize::MAX).into_iter().map(|(t, _)| (along(t), t)).collect();
        let mut bonds = vec![NO_BOND; fits.len()];
        for (t, factor) in ranks_by_distance(relation, &mut order, fits) {
            bonds[t].score = share * if relation.negated { 1.0 - factor } else { factor };
        }
        bonds
    }

    /// Returns how far each instance lies within the zone that instances of these nouns form: near
    /// one of them. Without such instances, every instance counts as inside.
    fn match_zone(&self, nouns: &[&str], fits: &[f32], negated: bool) -> Vec<RelationMatch> {
        const REACH_M: f32 = 1.5;
        let named = |noun: &&str| {
            noun_fits(self.scene, &Phrase { head: (*noun).to_owned(), ..Phrase::default() })
        };
        let mut made = vec![0.0_f32; fits.len()];
        for of_noun in nouns.iter().map(named) {
            made.iter_mut().zip(of_noun).for_each(|(best, fit)| *best = best.max(fit));
        }
        let things = most_plausible(&made, MAX_ANCHORS);
        if things.iter().all(|(_, fit)| *fit < FOUND) {
            return vec![RelationMatch { score: 1.0, anchor: None }; fits.len()];
        }
        let within = |t: usize| {
            let to = |&(i, fit): &(usize, f32)| {
                let reaching = fit * relations::reaching(&self.solids[t], &self.solids[i], REACH_M);
                // An instance behind the wall is in another room.
                if reaching > FOUND && self.room().apart_by_a_wall(&self.solids[t], &self.solids[i])
                {
                    FOUND * fit
                } else {
                    reaching
                }
            };
            things.iter().map(to).fold(0.0, f32::max)
        };
        (0..fits.len())
            .map(|t| {
                let score = if fits[t] < IMPOSSIBLE { 0.0 } else { within(t) };
                RelationMatch { score: if negated { 1.0 - score } else { score }, anchor: None }
            })
            .collect()
    }

    fn best_match(
        &self,
        relation: &Relation,
        target: usize,
        anchors: &[(usize, f32)],
    ) -> RelationMatch {
        let reach = Reach::in_words(&relation.text);
        let score = |a: usize| {
            if let Some(reach) = reach {
                return reach.fit(self.solids[target].gap(&self.solids[a]));
            }
            self.geometry(relation.kind, target, &[a]).max(self.score_on_side(relation, target, a))
                * self.hanging_factor(relation.kind, target, a)
        };
        let bond = |&(a, fit): &(usize, f32)| RelationMatch {
            score: fit.sqrt() * score(a),
            anchor: Some(self.id(a)),
        };
        anchors.iter().filter(|&&(a, _)| a != target).map(bond).fold(NO_BOND, better_match)
    }

    /// Returns the factor of "on the wall". Only instances that hang there count fully; an instance
    /// on the floor or on another instance only stands at the wall.
    fn hanging_factor(&self, kind: RelationKind, target: usize, anchor: usize) -> f32 {
        let of = |i: usize| &self.scene.instances[i];
        let held_below = matches!(of(target).support, Support::Floor | Support::Instance { .. });
        if kind == RelationKind::On && of(anchor).structure == Some(Structure::Wall) && held_below {
            AT_THE_WALL
        } else {
            1.0
        }
    }

    /// "On the left side of the desk" may also mean on the desk, to the left.
    fn score_on_side(&self, relation: &Relation, target: usize, anchor: usize) -> f32 {
        let sign = match relation.kind {
            RelationKind::LeftOf => -1.0,
            RelationKind::RightOf => 1.0,
            _ => return 0.0,
        };
        let (target, anchor) = (&self.solids[target], &self.solids[anchor]);
        if relation.text.starts_with("on the") {
            relations::on(target, anchor)
                * anchor.share_along(&target.center, &(sign * self.directions.right))
        } else {
            0.0
        }
    }

    fn match_between(
        &self,
        target: usize,
        a: &[(usize, f32)],
        b: &[(usize, f32)],
    ) -> RelationMatch {
        let pairs = a.iter().flat_map(|x| b.iter().map(move |y| (x, y)));
        pairs
            .filter(|(x, y)| x.0 != y.0 && x.0 != target && y.0 != target)
            .map(|(&(i, fit_i), &(j, fit_j))| RelationMatch {
                score: (fit_i * fit_j).sqrt()
                    * self.geometry(RelationKind::Between, target, &[i, j]),
                anchor: Some(self.id(i)),
            })
            .fold(NO_BOND, better_match)
    }

    /// Scores relations to the observer: "closest to me", "in front of me".
    fn match_to_observer(
        &self,
        relation: &Relation,
        observer: &Solid,
        fits: &[f32],
    ) -> Vec<RelationMatch> {
        let mut scores = vec![0.0; fits.len()];
        if relation.kind.is_comparison() {
            let apart = |t: usize| relations::apart(&self.solids[t], observer, false, self.room());
            let mut order: Vec<(f32, usize)> =
                most_plausible(fits, usize::MAX).into_iter().map(|(t, _)| (apart(t), t)).collect();
            ranks_by_distance(relation, &mut order, fits)
                .into_iter()
                .for_each(|(t, factor)| scores[t] = factor);
        } else {
            let reach = Reach::in_words(&relation.text);
            let score = |t: usize| {
                if let Some(reach) = reach {
                    return reach.fit(self.solids[t].gap(observer));
                }
                relations::to_observer(
                    relation.kind,
                    &self.solids[t],
                    observer,
                    &self.directions,
                    self.room(),
                )
            };
            scores
                .iter_mut()
                .enumerate()
                .filter(|(t, _)| fits[*t] >= IMPOSSIBLE)
                .for_each(|(t, s)| *s = score(t));
        }
        let told = |score: f32| if relation.negated { 1.0 - score } else { score };
        scores.into_iter().map(|score| RelationMatch { score: told(score), anchor: None }).collect()
    }
}

/// Returns the factor of a score where nothing can be measured: 1 when a word is unknown, `share`
/// when no such instance was found.
fn unchecked_factor(phrases: &[Phrase], found: &[Assessment], share: f32) -> Option<f32> {
    let shares = phrases.iter().zip(found).map(|(phrase, found)| {
        let there = found.nouns.iter().any(|fit| *fit >= FOUND);
        match phrase.meaning() {
            _ if there => 2.0,
            Meaning::Unknown => 1.0,
            _ => share,
        }
    });
    shares.reduce(f32::min).filter(|share| *share <= 1.0)
}

/// "The middle one of the three stools": keeps the three that fit best, and those that fit as well
/// as the third.
fn keep_best(count: usize, scores: &mut [f32]) {
    const AS_WELL: f32 = 0.95;
    let mut best = scores.to_vec();
    best.sort_by(|a, b| b.total_cmp(a));
    let least = best.get(count - 1).map_or(0.0, |last| AS_WELL * last);
    scores.iter_mut().filter(|score| **score < least).for_each(|score| *score = 0.0);
}

fn contradiction_factor(kind: RelationKind) -> f32 {
    match kind {
        // How far "near" and "far" reach depends on what else is there.
        RelationKind::Near | RelationKind::Far => LOOSELY_CONTRADICTED,
        _ if kind.depends_on_who_looks() => LOOSELY_CONTRADICTED,
        _ => CONTRADICTED,
    }
}

fn better_match(best: RelationMatch, other: RelationMatch) -> RelationMatch {
    if other.score > best.score { other } else { best }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::NameIndex;
    use crate::direction::DirectionConvention;
    use uniground_geometry::boxes::Aabb;
    use uniground_geometry::color::{ColorHistogram, ColorName};
    use uniground_geometry::scene::Instance;
    use uniground_language::{Measure, Superlative, Trait};
    use uniground_testing::thing;

    /// Returns a named instance; `base` is the height of its underside.
    fn named(id: u32, name: &str, at: [f32; 2], size: [f32; 3], base: f32) -> Instance {
        let instance = thing(id, at, size, base, Support::Nothing, [90; 3]);
        Instance { given_name: Some(name.into()), ..instance }
    }

    /// Returns a lamp on the floor, 0.2 m wide.
    fn lamp(id: u32, x: f32) -> Instance {
        named(id, "lamp", [x, 0.0], [0.2, 0.2, 0.4], 0.0)
    }

    /// Returns a desk of 0.6 m by 0.8 m (diagonal 1 m) that is 1 m high.
    fn desk(id: u32, x: f32) -> Instance {
        named(id, "desk", [x, 0.0], [0.6, 0.8, 1.0], 0.0)
    }

    /// Returns a lamp whose underside is `hovers` meters above a desk's top.
    fn lamp_over(id: u32, x: f32, hovers: f32) -> Instance {
        named(id, "lamp", [x, 0.0], [0.2, 0.2, 0.4], 1.0 + hovers)
    }

    fn wall(id: u32, x: f32) -> Instance {
        let wall = named(id, "wall", [x, 0.0], [0.1, 6.0, 2.6], 0.0);
        Instance { structure: Some(Structure::Wall), ..wall }
    }

    fn with_assessor<T>(instances: &[Instance], of: impl FnOnce(&mut Assessor) -> T) -> T {
        let names = NameIndex::of(instances);
        let extent =
            Aabb { center: Point3::new(0.0, 0.0, 1.3), size: Vector3::new(20.0, 9.0, 2.6) };
        let scene = SceneView { instances, extent, names: &names, appearance: None };
        of(&mut Assessor::new(scene, DirectionConvention::Viewer.into()))
    }

    fn noun_phrase(head: &str) -> Phrase {
        Phrase { head: head.into(), ..Phrase::default() }
    }

    fn relation(kind: RelationKind, anchors: &[&str]) -> Relation {
        let anchors = anchors.iter().map(|head| noun_phrase(head)).collect();
        Relation { kind, text: kind.as_str().into(), anchors, negated: false, rank: 1 }
    }

    fn lamp_that(relations: Vec<Relation>) -> Phrase {
        Phrase { relations, ..noun_phrase("lamp") }
    }

    fn totals(instances: &[Instance], phrase: &Phrase) -> Vec<f32> {
        with_assessor(instances, |assessor| assessor.assess(phrase).total)
    }

    fn scores(instances: &[Instance], relation: &Relation, fits: &[f32]) -> Vec<f32> {
        with_assessor(instances, |assessor| {
            assessor.match_relation(relation, fits).iter().map(|bond| bond.score).collect()
        })
    }

    fn anchors(instances: &[Instance], relation: &Relation, fits: &[f32]) -> Vec<Option<u32>> {
        with_assessor(instances, |assessor| {
            assessor
                .match_relation(relation, fits)
                .iter()
                .map(|bond| bond.anchor.map(|id| id.0))
                .collect()
        })
    }

    fn red(share: f32, instance: Instance) -> Instance {
        let mut shares = [0.0; 12];
        shares[ColorName::Red as usize] = share;
        shares[ColorName::Green as usize] = 1.0 - share;
        Instance { colors: ColorHistogram(shares), ..instance }
    }

    #[track_caller]
    fn assert_close(found: &[f32], by_hand: &[f32]) {
        let same = found.len() == by_hand.len()
            && found.iter().zip(by_hand).all(|(a, b)| (a - b).abs() < 2e-4);
        assert!(same, "{found:?}, expected {by_hand:?}");
    }

    #[test]
    fn near_prefers_the_nearer_one_and_far_the_farther_one() {
        let room = [desk(1, 0.0), lamp(2, 0.9), lamp(3, 1.0), lamp(4, 6.0), lamp(5, 6.5)];
        let fits = [0.0, 1.0, 1.0, 1.0, 1.0];
        let near = scores(&room, &relation(RelationKind::Near, &["desk"]), &fits);
        assert!(near[1] > 1.05 * near[2] && near[2] > near[3], "{near:?}");
        let far = scores(&room, &relation(RelationKind::Far, &["desk"]), &fits);
        assert!(far[4] > 1.05 * far[3] && far[3] > far[2], "{far:?}");
        // With a distance in the question, all within it count.
        let near = relation(RelationKind::Near, &["desk"]);
        let within = Relation { text: "within 2 m of".into(), ..near };
        let within = scores(&room, &within, &fits);
        assert_eq!(within[1], within[2]);
    }

    #[test]
    fn contradicted_relation_keeps_five_or_twenty_percent() {
        // On the desk, 6 cm above it (a half), and elsewhere: 0.05 + 0.95 · bond.
        let room = [
            desk(1, 0.0),
            desk(2, 3.0),
            lamp_over(3, 0.0, 0.0),
            lamp_over(4, 3.0, 0.06),
            lamp(5, 8.0),
        ];
        let phrase = lamp_that(vec![relation(RelationKind::On, &["desk"])]);
        assert_close(&totals(&room, &phrase), &[0.0, 0.0, 1.0, 0.525, 0.05]);
        // Left depends on the viewer: a lamp on the right keeps 0.2.
        let room = [desk(1, 0.0), lamp(2, 3.0)];
        let phrase = lamp_that(vec![relation(RelationKind::LeftOf, &["desk"])]);
        assert_close(&totals(&room, &phrase), &[0.0, 0.2]);
        assert_eq!(contradiction_factor(RelationKind::Near), 0.2);
        assert_eq!(contradiction_factor(RelationKind::Between), 0.2);
    }

    #[test]
    fn scores_of_several_relations_multiply() {
        let room = [desk(1, 0.0), lamp_over(2, 0.0, 0.06), lamp(3, 8.0)];
        let on = || relation(RelationKind::On, &["desk"]);
        assert_close(
            &totals(&room, &lamp_that(vec![on(), on()])),
            &[0.0, 0.525 * 0.525, 0.05 * 0.05],
        );
        let found = with_assessor(&room, |assessor| assessor.assess(&lamp_that(vec![on()])));
        assert_close(&found.nouns, &[0.0, 1.0, 1.0]);
        assert_close(&found.own, &[0.0, 1.0, 1.0]);
        assert_eq!(found.bonds.len(), 1);
        assert_eq!(found.bonds[0][1].anchor, Some(InstanceId(1)));
        assert!(found.place_seen_by.is_empty(), "{found:?}");
    }

    #[test]
    fn comparisons_are_scored_after_other_relations() {
        // The closest to the door of those on the desk is the one on the desk.
        let door = named(4, "door", [6.0, 0.0], [0.1, 0.9, 2.0], 0.0);
        let room = [desk(1, 0.0), lamp_over(2, 0.0, 0.0), lamp(3, 5.0), door];
        let closest = || relation(RelationKind::Closest, &["door"]);
        let on = || relation(RelationKind::On, &["desk"]);
        let by_hand = [0.0, 1.0, 0.05 * 0.05, 0.0];
        assert_close(&totals(&room, &lamp_that(vec![closest(), on()])), &by_hand);
        assert_close(&totals(&room, &lamp_that(vec![on(), closest()])), &by_hand);
        // Of all lamps it is the second: 0.05 + 0.95 · 0.45.
        assert_close(&totals(&room, &lamp_that(vec![closest()])), &[0.0, 0.477_5, 1.0, 0.0]);
    }

    #[test]
    fn comparisons_with_a_count_rank_only_the_best_matches() {
        // Two red lamps, and a half-red one that is the largest.
        let large = named(3, "lamp", [4.0, 0.0], [0.4, 0.4, 0.8], 0.0);
        let door = named(4, "door", [6.0, 0.0], [0.1, 0.9, 2.0], 0.0);
        let room = [red(1.0, lamp(1, 0.0)), red(1.0, lamp(2, 2.0)), red(0.3, large), door];
        let largest = Some(Superlative { measure: Measure::Largest, rank: 1 });
        let closest = [relation(RelationKind::Closest, &["door"])];
        let asked = |count, superlative, relations: &[Relation]| {
            let relations = relations.to_vec();
            let colors = vec![ColorName::Red];
            totals(&room, &Phrase { colors, count, superlative, ..lamp_that(relations) })
        };
        assert_close(&asked(None, None, &[]), &[1.0, 1.0, 0.5, 0.0]);
        assert_close(&asked(Some(2), None, &[]), &[1.0, 1.0, 0.5, 0.0]);
        for (superlative, relations) in [(largest, &[][..]), (None, &closest[..])] {
            let all = asked(None, superlative, relations);
            let one = asked(Some(1), superlative, relations);
            let two = asked(Some(2), superlative, relations);
            assert!(all[2] > 0.0 && one[2] == all[2], "{superlative:?} {all:?} {one:?}");
            assert_eq!(two[2], 0.0, "{superlative:?} {two:?}");
            assert!(two[0].max(two[1]) > 0.9, "{superlative:?} {two:?}");
        }
    }

    #[test]
    fn keep_best_also_keeps_near_ties_with_the_last() {
        let left = |count, scores: &[f32]| {
            let mut scores = scores.to_vec();
            keep_best(count, &mut scores);
            scores
        };
        // 0.95 · 0.86 = 0.817.
        assert_close(&left(2, &[0.9, 0.5, 0.86, 0.1]), &[0.9, 0.0, 0.86, 0.0]);
        assert_close(&left(2, &[0.9, 0.82, 0.86, 0.81]), &[0.9, 0.82, 0.86, 0.0]);
        assert_eq!(left(2, &[1.0, 1.0, 0.95]), [1.0, 1.0, 0.95]);
        assert_close(&left(9, &[0.9, 0.1]), &[0.9, 0.1]);
    }

    #[test]
    fn own_fits_multiply_noun_colors_and_traits() {
        let small = named(3, "lamp", [4.0, 0.0], [0.1, 0.1, 0.2], 0.0);
        let room = [red(1.0, lamp(1, 0.0)), red(0.3, lamp(2, 2.0)), red(0.3, small), desk(4, 9.0)];
        let (colors, traits) = (vec![ColorName::Red], vec![Trait::Large]);
        let of = |phrase: &Phrase| with_assessor(&room, |assessor| assessor.own_fits(phrase));
        let (nouns, own) = of(&Phrase { colors: colors.clone(), ..noun_phrase("lamp") });
        assert_close(&nouns, &[1.0, 1.0, 1.0, 0.0]);
        assert_close(&own, &[1.0, 0.5, 0.5, 0.0]);
        // The small one is not large: 0.3.
        assert_close(
            &of(&Phrase { colors, traits, ..noun_phrase("lamp") }).1,
            &[1.0, 0.5, 0.15, 0.0],
        );
    }

    #[test]
    fn excluded_nouns_lower_the_fit_where_names_distinguish() {
        // "The stool that is not the bar stool": the plain one is a bar stool by 0.7, so the other
        // is one by 0.3 more, 1 - 0.95 · 0.3.
        let stool = |id, name| named(id, name, [id as f32, 0.0], [0.4; 3], 0.0);
        let room = [stool(1, "bar stool"), stool(2, "stool"), stool(3, "kettle")];
        let phrase = Phrase { other_things: vec!["bar stool".into()], ..noun_phrase("stool") };
        let (nouns, own) = with_assessor(&room, |assessor| assessor.own_fits(&phrase));
        assert_close(&[own[0] / nouns[0], own[1] / nouns[1], own[2]], &[0.715, 1.0, 0.0]);
        // All plausible instances are bar stools: names do not distinguish them.
        let room = [stool(1, "bar stool"), stool(2, "bar stool")];
        let (nouns, own) = with_assessor(&room, |assessor| assessor.own_fits(&phrase));
        assert_eq!(own, nouns);
        // Another kind of object keeps almost nothing: 1 - 0.95.
        let room = [stool(1, "kettle"), stool(2, "lamp")];
        let other = Phrase { other_things: vec!["kettle".into()], ..noun_phrase("thing") };
        let (nouns, own) = with_assessor(&room, |assessor| assessor.own_fits(&other));
        assert_close(&[own[0] / nouns[0], own[1] / nouns[1]], &[0.05, 1.0]);
    }

    #[test]
    fn likely_keeps_instances_with_at_least_half_of_the_best_fit() {
        let room = |shares: [f32; 3]| {
            let [a, b, c] = shares;
            [red(a, lamp(1, 0.0)), red(b, lamp(2, 2.0)), red(c, lamp(3, 4.0)), desk(4, 9.0)]
        };
        let asked = Phrase { colors: vec![ColorName::Red], ..noun_phrase("lamp") };
        let likely =
            |shares, most| with_assessor(&room(shares), |assessor| assessor.likely(&asked, most));
        // Fits of 0.5, 0.26667 and 0.23333: 0.53333 and 0.46667 of the best.
        let found = likely([0.14, 0.3, 0.16], 9);
        assert_eq!(found.iter().map(|f| f.0).collect::<Vec<_>>(), [1, 2], "{found:?}");
        assert_close(&[found[0].1, found[1].1], &[1.0, 0.533_333]);
        assert_eq!(likely([0.14, 0.3, 0.16], 1), [(1, 1.0)]);
        // Exactly half is enough.
        assert_eq!(likely([1.0, 0.3, 0.0], 9), [(0, 1.0), (1, 0.5)]);
        let room = room([1.0, 0.3, 0.0]);
        with_assessor(&room, |assessor| {
            assert_eq!(assessor.best(&asked), Some(0));
            assert_eq!(assessor.best(&noun_phrase("desk")), Some(3));
            assert_eq!(assessor.best(&noun_phrase("piano")), None);
            assert_eq!(assessor.likely(&noun_phrase("piano"), 9), []);
        });
    }

    #[test]
    fn mean_position_averages_the_instance_centers() {
        let high = named(3, "lamp", [4.0, 3.0], [0.2, 0.2, 0.4], 3.0);
        let room = [lamp(1, 0.0), lamp(2, 2.0), high, desk(4, 90.0)];
        with_assessor(&room, |assessor| {
            // (0 + 2 + 4) / 3, (0 + 0 + 3) / 3, (0.2 + 0.2 + 3.2) / 3.
            let middle = assessor.mean_position(&noun_phrase("lamp")).unwrap();
            assert_close(middle.coords.as_slice(), &[2.0, 1.0, 1.2]);
            assert_eq!(assessor.mean_position(&noun_phrase("piano")), None);
        });
    }

    #[test]
    fn dismissed_walls_are_not_part_of_the_room() {
        let gone = Instance { dismissed: true, ..wall(2, 4.0) };
        let floor = Instance {
            structure: Some(Structure::Floor),
            ..named(3, "floor", [0.0, 0.0], [8.0, 6.0, 0.1], 0.0)
        };
        let room = [wall(1, -4.0), gone, floor, lamp(4, 0.0)];
        with_assessor(&room, |assessor| {
            let room = assessor.room();
            let walls: Vec<f32> = room.walls.iter().map(|wall| wall.center.x).collect();
            assert_eq!(walls, [-4.0]);
            // From -4.05 to 4.05, and as high as the scan.
            let (long, short) = room.outline.sides();
            assert_close(&[long, short, room.outline.size[2]], &[8.1, 6.0, 2.6]);
        });
    }

    #[test]
    fn anchor_counts_by_the_root_of_its_fit_and_is_never_the_target() {
        let room = [desk(1, 0.0), lamp_over(2, 0.0, 0.06), desk(3, 5.0)];
        let on = relation(RelationKind::On, &["desk"]);
        with_assessor(&room, |assessor| {
            let bond = |anchors: &[(usize, f32)]| assessor.best_match(&on, 1, anchors);
            // √0.25 · 0.5.
            let found = bond(&[(2, 1.0), (0, 0.25)]);
            assert_close(&[found.score], &[0.25]);
            assert_eq!(found.anchor, Some(InstanceId(1)));
            assert_eq!(bond(&[(1, 1.0)]), NO_BOND);
            assert_eq!(bond(&[]), NO_BOND);
        });
        let (low, high) = (
            RelationMatch { score: 0.2, anchor: None },
            RelationMatch { score: 0.3, anchor: Some(InstanceId(7)) },
        );
        assert_eq!((better_match(low, high), better_match(high, low)), (high, high));
        let other = RelationMatch { score: 0.3, anchor: None };
        assert_eq!(better_match(high, other), high, "the first of equals");
    }

    #[test]
    fn anchor_pairs_have_a_lower_limit_than_single_anchors() {
        // The lamp stands on the twentieth of twenty desks, and between it and the one before.
        let mut room: Vec<Instance> = (1..=20).map(|id| desk(id, id as f32 * 4.0)).collect();
        room.push(lamp_over(21, 80.0, 0.0));
        room.push(lamp(22, 78.0));
        let mut fits = vec![0.0; 20];
        fits.extend([1.0, 1.0]);
        let on = scores(&room, &relation(RelationKind::On, &["desk"]), &fits);
        assert_close(&on[20..], &[1.0, 0.0]);
        let between = scores(&room, &relation(RelationKind::Between, &["desk"]), &fits);
        // Only the first sixteen desks are tried; the last of them is at 64 m.
        assert!(between[21] < 0.2, "{between:?}");
    }

    #[test]
    fn supported_instances_at_a_wall_keep_thirty_percent_of_on() {
        let supported = |id, support| Instance { support, ..lamp(id, 0.0) };
        let room = [
            wall(1, 0.1),
            supported(2, Support::Floor),
            supported(3, Support::Instance { id: InstanceId(6) }),
            supported(4, Support::Wall { id: InstanceId(1) }),
            supported(5, Support::Nothing),
            desk(6, 0.0),
        ];
        with_assessor(&room, |assessor| {
            let hangs = |kind, anchor: usize| {
                [1, 2, 3, 4].map(|t| assessor.hanging_factor(kind, t, anchor))
            };
            assert_eq!(hangs(RelationKind::On, 0), [0.3, 0.3, 1.0, 1.0]);
            assert_eq!(hangs(RelationKind::On, 5), [1.0; 4]);
            assert_eq!(hangs(RelationKind::Leaning, 0), [1.0; 4]);
            // 0.9 for an instance flat against the wall, and 0.3 of that for a supported one.
            let bond =
                |t| assessor.best_match(&relation(RelationKind::On, &["wall"]), t, &[(0, 1.0)]);
            assert_close(&[bond(1).score, bond(3).score], &[0.27, 0.9]);
        });
    }

    #[test]
    fn on_the_left_side_of_an_anchor_may_mean_on_top_of_it() {
        // A quarter of the desk's width to the left of its middle: half of the way to its end, a
        // half of which counts in full. 2 · 0.075 / 0.3.
        let room = [desk(1, 0.0), lamp_over(2, -0.075, 0.0)];
        let side = |kind, text: &str| {
            let relation = Relation { text: text.into(), ..relation(kind, &["desk"]) };
            with_assessor(&room, |assessor| {
                let own = assessor.score_on_side(&relation, 1, 0);
                (own, assessor.best_match(&relation, 1, &[(0, 1.0)]).score)
            })
        };
        let (own, bond) = side(RelationKind::LeftOf, "on the left side of");
        assert_close(&[own, bond], &[0.5, 0.5]);
        let (own, bond) = side(RelationKind::RightOf, "on the right side of");
        assert_close(&[own, bond], &[0.0, 0.0]);
        assert_eq!(side(RelationKind::LeftOf, "left of").0, 0.0);
        assert_eq!(side(RelationKind::InFrontOf, "on the front side of").0, 0.0);
        let room = [desk(1, 0.0), lamp_over(2, 0.075, 0.06)];
        with_assessor(&room, |assessor| {
            let text = "on the right of".to_owned();
            let relation = Relation { text, ..relation(RelationKind::RightOf, &["desk"]) };
            // Half on it: 0.5 · 0.5.
            assert_close(&[assessor.score_on_side(&relation, 1, 0)], &[0.25]);
        });
    }

    #[test]
    fn targets_below_one_percent_fit_have_no_relation_match() {
        let room = [desk(1, 0.0), lamp_over(2, 0.0, 0.0), lamp_over(3, 0.0, 0.0)];
        let on = relation(RelationKind::On, &["desk"]);
        assert_close(&scores(&room, &on, &[0.0, 0.01, 0.009_9]), &[0.0, 1.0, 0.0]);
        assert_eq!(anchors(&room, &on, &[0.0, 0.01, 0.009_9]), [None, Some(1), None]);
    }

    #[test]
    fn negated_relation_scores_one_minus_the_relation() {
        let room = [desk(1, 0.0), lamp_over(2, 0.0, 0.06), lamp(3, 5.0)];
        let on = Relation { negated: true, ..relation(RelationKind::On, &["desk"]) };
        assert_close(&scores(&room, &on, &[0.0, 1.0, 1.0]), &[1.0, 0.5, 1.0]);
    }

    #[test]
    fn relation_must_hold_for_all_anchors() {
        let shelf = named(2, "shelf", [0.0, 0.0], [0.6, 0.8, 0.97], 0.0);
        let room = [desk(1, 0.0), shelf, lamp_over(3, 0.0, 0.0)];
        // On the desk, and 3 cm above the shelf: 1 · 1 / (1 + 1/4).
        let both = relation(RelationKind::On, &["desk", "shelf"]);
        assert_close(&scores(&room, &both, &[0.0, 0.0, 1.0]), &[0.0, 0.0, 0.8]);
        assert_eq!(anchors(&room, &both, &[0.0, 0.0, 1.0]), [None, None, Some(1)]);
    }

    #[test]
    fn between_uses_two_distinct_anchors_other_than_the_target() {
        let room = [desk(1, 0.0), lamp(2, 2.0), named(3, "door", [4.0, 0.0], [0.6, 0.8, 1.0], 0.0)];
        let between = relation(RelationKind::Between, &["desk", "door"]);
        assert_close(&scores(&room, &between, &[0.0, 1.0, 0.0]), &[0.0, 1.0, 0.0]);
        assert_eq!(anchors(&room, &between, &[0.0, 1.0, 0.0]), [None, Some(1), None]);
        let pair = |room: &[Instance], t, a: &[(usize, f32)], b: &[(usize, f32)]| {
            with_assessor(room, |assessor| assessor.match_between(t, a, b))
        };
        // √(0.25 · 1) · 1.
        assert_close(&[pair(&room, 1, &[(0, 0.25)], &[(2, 1.0)]).score], &[0.5]);
        assert_close(&[pair(&room, 1, &[(0, 0.25)], &[(2, 0.16)]).score], &[0.2]);
        // Two of one kind: "between the desks".
        let two = [desk(1, 0.0), lamp(2, 2.0), desk(3, 4.0)];
        let of_one = relation(RelationKind::Between, &["desk"]);
        assert_close(&scores(&two, &of_one, &[0.0, 1.0, 0.0]), &[0.0, 1.0, 0.0]);
        // 0.35 · 4 m + 0.2 m aside.
        let aside = Instance {
            given_name: Some("lamp".into()),
            ..thing(2, [2.0, 1.6], [0.2, 0.2, 0.4], 0.0, Support::Floor, [90; 3])
        };
        assert_close(
            &scores(&[desk(1, 0.0), aside, desk(3, 4.0)], &of_one, &[0.0, 1.0, 0.0])[1..2],
            &[0.5],
        );
        // One of two anchors is the target: no pair is left.
        let near = [lamp(1, 0.0), lamp(2, 0.1), lamp(3, 4.0)];
        let both = [(0, 1.0), (1, 1.0)];
        assert_eq!(pair(&near, 1, &both, &both), NO_BOND);
        assert_eq!(pair(&near, 1, &both[..1], &both[1..]), NO_BOND);
        assert_eq!(pair(&near, 1, &both[1..], &both[..1]), NO_BOND);
    }

    #[test]
    fn relations_to_the_room_have_no_anchor() {
        // Between walls 10 m apart; 0.5 m to the one at +X: 1 / (1 + (0.5 / 0.3)²).
        let room = [wall(1, -5.0), wall(2, 5.0), lamp(3, 5.0 - 0.05 - 0.5 - 0.1), lamp(4, 0.0)];
        let against = relation(RelationKind::AgainstWall, &[]);
        let found = scores(&room, &against, &[0.0, 0.0, 1.0, 0.0]);
        assert_close(&found, &[0.0, 0.0, 0.264_706, 0.0]);
        assert_eq!(anchors(&room, &against, &[0.0, 0.0, 1.0, 0.0]), [None; 4]);
        // "Near" without an anchor lowers no score.
        assert_close(
            &scores(&room, &relation(RelationKind::Near, &[]), &[0.0, 0.0, 1.0, 0.0]),
            &[1.0; 4],
        );
    }

    #[test]
    fn unknown_anchors_keep_the_score_and_missing_ones_thirty_percent() {
        let room = [desk(1, 0.0), lamp(2, 3.0)];
        let of = |anchor: &str| scores(&room, &relation(RelationKind::On, &[anchor]), &[0.0, 1.0]);
        assert_close(&of("zorblax"), &[1.0, 1.0]);
        assert_close(&of("piano"), &[0.3, 0.3]);
        assert_close(&of("desk"), &[0.0, 0.0]);
        // Of several anchors, the least certain one counts.
        let both = relation(RelationKind::On, &["zorblax", "piano"]);
        assert_close(&scores(&room, &both, &[0.0, 1.0]), &[0.3, 0.3]);
    }

    #[test]
    fn unchecked_factor_is_one_for_unknown_words_and_lower_for_missing_instances() {
        let found = |fit: f32| Assessment {
            nouns: vec![0.0, fit],
            own: Vec::new(),
            bonds: Vec::new(),
            place_seen_by: Vec::new(),
            total: Vec::new(),
        };
        let share = |heads: &[&str], fits: &[f32]| {
            let phrases: Vec<Phrase> = heads.iter().map(|head| noun_phrase(head)).collect();
            let assessed: Vec<Assessment> = fits.iter().map(|fit| found(*fit)).collect();
            unchecked_factor(&phrases, &assessed, 0.3)
        };
        assert_eq!(share(&["desk"], &[0.05]), None);
        assert_eq!(share(&["desk"], &[0.049]), Some(0.3));
        assert_eq!(share(&["zorblax"], &[0.049]), Some(1.0));
        assert_eq!(share(&["zorblax"], &[0.05]), None);
        assert_eq!(share(&["desk", "zorblax"], &[1.0, 0.0]), Some(1.0));
        assert_eq!(share(&["desk", "zorblax"], &[0.0, 0.0]), Some(0.3));
        assert_eq!(share(&[], &[]), None);
    }

    #[test]
    fn indefinite_anchor_may_be_an_instance_that_was_not_found() {
        let on = |hovers: f32, indefinite, negated| {
            let room = [desk(1, 0.0), lamp_over(2, 0.0, hovers), lamp(3, 6.0)];
            let anchors = vec![Phrase { indefinite, ..noun_phrase("desk") }];
            let on = Relation { anchors, negated, ..relation(RelationKind::On, &[]) };
            scores(&room, &on, &[0.0, 1.0, 1.0])
        };
        // 12 cm above scores 0.2: not a match. 6 cm above scores 0.5: a match.
        assert_close(&on(0.12, true, false), &[0.3; 3]);
        assert_close(&on(0.06, true, false), &[0.0, 0.5, 0.0]);
        assert_close(&on(0.12, false, false), &[0.0, 0.2, 0.0]);
        assert_close(&on(0.12, true, true), &[1.0, 0.8, 1.0]);
    }

    #[test]
    fn side_of_a_missing_anchor_ranks_targets_along_that_side() {
        let room = [lamp(1, 2.0), lamp(2, -1.0), lamp(3, 0.0), desk(4, -9.0)];
        let fits = [1.0, 1.0, 1.0, 0.0];
        let of = |kind, anchor: &str, negated| {
            scores(&room, &Relation { negated, ..relation(kind, &[anchor]) }, &fits)
        };
        // Each rank away multiplies by 0.45.
        assert_close(&of(RelationKind::LeftOf, "zorblax", false), &[0.202_5, 1.0, 0.45, 0.0]);
        assert_close(&of(RelationKind::RightOf, "zorblax", false), &[1.0, 0.202_5, 0.45, 0.0]);
        assert_close(&of(RelationKind::RightOf, "piano", false), &[0.3, 0.060_75, 0.135, 0.0]);
        assert_close(&of(RelationKind::RightOf, "piano", true), &[0.0, 0.239_25, 0.165, 0.0]);
        assert_close(&of(RelationKind::Behind, "piano", false), &[0.3; 4]);
    }

    #[test]
    fn zone_score_falls_with_distance_from_its_instances() {
        // Half at 1.5 m from the stove; surfaces touch at 0.3 m + 0.1 m.
        let stove = |id, x| named(id, "stove", [x, 0.0], [0.6, 0.6, 0.9], 0.0);
        let room = [stove(1, 0.0), lamp(2, 1.9), lamp(3, 3.4), lamp(4, 0.4)];
        let kitchen =
            |negated| Relation { negated, ..relation(RelationKind::Inside, &["kitchen"]) };
        let fits = [0.0, 1.0, 1.0, 0.009];
        assert_close(&scores(&room, &kitchen(false), &fits), &[0.0, 0.5, 0.2, 0.0]);
        assert_close(&scores(&room, &kitchen(true), &fits), &[1.0, 0.5, 0.8, 1.0]);
        assert_close(
            &scores(&room, &kitchen(false), &[0.0, 0.01, 0.0, 0.0]),
            &[0.0, 0.5, 0.0, 0.0],
        );
        // Of two stoves, the nearer one counts.
        let room = [stove(1, 0.0), lamp(2, 1.9), stove(3, 2.3)];
        assert_close(&scores(&room, &kitchen(false), &[0.0, 1.0, 0.0])[1..2], &[1.0]);
        // Without a stove the zone changes no score, negated or not.
        let room = [desk(1, 0.0), lamp(2, 1.9)];
        assert_close(&scores(&room, &kitchen(false), &[0.0, 1.0]), &[1.0, 1.0]);
        assert_close(&scores(&room, &kitchen(true), &[0.0, 1.0]), &[1.0, 1.0]);
    }

    #[test]
    fn zones_do_not_extend_through_walls() {
        let stove = named(1, "stove", [0.0, 0.0], [0.6, 0.6, 0.9], 0.0);
        // Far away the gap is the one between circles: 7.914 - (0.8485 + 0.2828) / 2 = 7.3483 m,
        // 1 / (1 + (7.3483 / 1.5)²) = 0.04, less than the factor of a wall.
        let room = [stove, lamp(2, 1.9), lamp(3, 7.914), wall(4, 1.0)];
        let kitchen = relation(RelationKind::Inside, &["kitchen"]);
        let found = scores(&room, &kitchen, &[0.0, 1.0, 1.0, 0.0]);
        assert_close(&found, &[0.0, 0.05, 0.04, 0.0]);
    }

    #[test]
    fn closest_and_farthest_rank_by_distance() {
        let room = [desk(1, 0.0), lamp(2, 3.0), lamp(3, -2.0), lamp(4, 5.0)];
        let of = |kind, rank| {
            let relation = Relation { rank, ..relation(kind, &["desk"]) };
            scores(&room, &relation, &[0.0, 1.0, 1.0, 1.0])
        };
        assert_close(&of(RelationKind::Closest, 1), &[0.0, 0.45, 1.0, 0.202_5]);
        assert_close(&of(RelationKind::Closest, 2), &[0.0, 1.0, 0.45, 0.45]);
        assert_close(&of(RelationKind::Closest, 3), &[0.0, 0.45, 0.202_5, 1.0]);
        assert_close(&of(RelationKind::Closest, 0), &[0.0, 0.45, 1.0, 0.202_5]);
        assert_close(&of(RelationKind::Farthest, 1), &[0.0, 0.45, 0.202_5, 1.0]);
        assert_close(&of(RelationKind::Farthest, 2), &[0.0, 1.0, 0.45, 0.45]);
    }

    #[test]
    fn closest_excludes_the_anchor_and_counts_by_the_root_of_its_fit() {
        let room = [desk(1, 0.0), lamp(2, 3.0), lamp(3, 2.0)];
        let closest = relation(RelationKind::Closest, &["desk"]);
        with_assessor(&room, |assessor| {
            let found = assessor.match_by_distance(&closest, &[1.0; 3], &[vec![(0, 0.25)]]);
            // √0.25 · 1 and · 0.45.
            assert_close(
                &found.iter().map(|bond| bond.score).collect::<Vec<_>>(),
                &[0.0, 0.225, 0.5],
            );
            assert_eq!(found[2].anchor, Some(InstanceId(1)));
            assert_eq!(assessor.match_by_distance(&closest, &[1.0; 3], &[]), [NO_BOND; 3]);
            // Another desk may be meant: the better of both counts.
            let found = assessor.match_by_distance(
                &closest,
                &[0.0, 1.0, 1.0],
                &[vec![(0, 0.25), (1, 1.0)]],
            );
            assert_close(&[found[2].score], &[1.0]);
            assert_eq!(found[2].anchor, Some(InstanceId(2)));
        });
    }

    #[test]
    fn closest_to_several_anchors_has_the_smallest_distance_sum() {
        // From desks at 0 and 4: 3 + 3 for the one, 2 + 5 for the other.
        let at = |id, x, y| named(id, "lamp", [x, y], [0.2, 0.2, 0.4], 0.0);
        let room = [
            desk(1, 0.0),
            desk(2, 4.0),
            at(3, 2.0, 2.236_068),
            at(4, -0.625, 1.899_836),
            desk(5, 40.0),
        ];
        let closest = relation(RelationKind::Closest, &["desk", "desk"]);
        let of = |others: &[(usize, f32)]| {
            let anchors = [vec![(0, 1.0)], others.to_vec()];
            with_assessor(&room, |assessor| {
                let found =
                    assessor.match_by_distance(&closest, &[1.0, 1.0, 1.0, 1.0, 0.0], &anchors);
                found.iter().map(|bond| bond.score).collect::<Vec<_>>()
            })
        };
        assert_close(&of(&[(1, 1.0)]), &[0.0, 0.0, 1.0, 0.45, 0.0]);
        // The likeliest of the others counts, of equals the first.
        assert_close(&of(&[(1, 1.0), (4, 0.9)]), &[0.0, 0.0, 1.0, 0.45, 0.0]);
        assert_close(&of(&[(1, 1.0), (4, 1.0)]), &[0.0, 0.0, 1.0, 0.45, 0.0]);
    }

    #[test]
    fn what_an_instance_carries_is_closest_to_it() {
        let room = [desk(1, 0.0), lamp_over(2, 0.0, 0.0), lamp(3, 2.0), lamp(4, 3.0)];
        let of = |kind| scores(&room, &relation(kind, &["desk"]), &[0.0, 1.0, 1.0, 1.0]);
        assert_close(&of(RelationKind::Closest), &[0.0, 1.0, 0.45, 0.202_5]);
        assert_close(&of(RelationKind::Farthest), &[0.0, 0.202_5, 0.45, 1.0]);
        // Two on it: the nearer to its middle first.
        let room = [desk(1, 0.0), lamp_over(2, 0.1, 0.0), lamp_over(3, 0.0, 0.0)];
        let closest = relation(RelationKind::Closest, &["desk"]);
        assert_close(&scores(&room, &closest, &[0.0, 1.0, 1.0]), &[0.0, 0.45, 1.0]);
        // A lamp 12 cm above the desk is not carried.
        let room = [desk(1, 0.0), lamp_over(2, 0.0, 0.12), lamp(3, 2.0)];
        assert_close(&scores(&room, &closest, &[0.0, 1.0, 1.0]), &[0.0, 1.0, 0.45]);
        // A picture on the wall touches it and is the closest to it.
        let picture = named(2, "lamp", [0.15, 2.5], [0.1, 0.4, 0.4], 1.0);
        let room = [wall(1, 0.0), picture, lamp(3, 1.0)];
        let closest = relation(RelationKind::Closest, &["wall"]);
        assert_close(&scores(&room, &closest, &[0.0, 1.0, 1.0]), &[0.0, 1.0, 0.45]);
    }

    #[test]
    fn me_refers_to_the_observer_and_is_ignored_without_one() {
        let room = [lamp(1, 1.0), lamp(2, 3.0), lamp(3, -2.0), desk(4, 0.0)];
        let fits = [1.0, 1.0, 1.0, 0.0];
        let of = |kind, negated, observer: bool| {
            with_assessor(&room, |assessor| {
                // At the origin, looking along +X: left is +Y, ahead is +X.
                assessor.observer = observer.then(|| {
                    Aabb { center: Point3::new(0.0, 0.0, 0.2), size: Vector3::zeros() }.into()
                });
                assessor.directions = Directions::looking_along(Vector3::x()).unwrap();
                let relation = Relation { negated, ..relation(kind, &[ME]) };
                assessor.match_relation(&relation, &fits)
            })
        };
        let scores = |kind, negated| {
            let found = of(kind, negated, true);
            assert!(found.iter().all(|bond| bond.anchor.is_none()), "{found:?}");
            found.iter().map(|bond| bond.score).collect::<Vec<_>>()
        };
        assert_eq!(
            of(RelationKind::Closest, false, false),
            [RelationMatch { score: 1.0, anchor: None }; 4]
        );
        assert_close(&scores(RelationKind::Closest, false), &[1.0, 0.202_5, 0.45, 0.0]);
        assert_close(&scores(RelationKind::Closest, true), &[0.0, 0.797_5, 0.55, 1.0]);
        assert_close(&scores(RelationKind::Farthest, false), &[0.202_5, 1.0, 0.45, 0.0]);
        // The first is 0.9 m ahead; near halves at 0.3 m + 0.25 · 0.2828 m / 2 = 0.335355 m:
        // 1 / (1 + 7.2022) = 0.121918; 0.4 + 0.6 · 0.121918.
        let ahead = scores(RelationKind::InFrontOf, false);
        assert_close(&[ahead[0], ahead[2], ahead[3]], &[0.473_151, 0.0, 0.0]);
        let back = scores(RelationKind::Behind, false);
        assert_close(&back[..2], &[0.0, 0.0]);
        assert!(back[2] > 0.4 && back[3] == 0.0, "{back:?}");
    }

    #[test]
    fn targets_below_one_percent_fit_have_no_relation_to_the_observer() {
        let room = [lamp(1, 1.0), lamp(2, 1.0)];
        with_assessor(&room, |assessor| {
            assessor.directions = Directions::looking_along(Vector3::x()).unwrap();
            let me = Aabb { center: Point3::new(0.0, 0.0, 0.2), size: Vector3::zeros() }.into();
            let ahead = relation(RelationKind::InFrontOf, &[ME]);
            let found = assessor.match_to_observer(&ahead, &me, &[0.01, 0.009_9]);
            assert_close(&[found[0].score, found[1].score], &[0.473_151, 0.0]);
        });
    }

    #[test]
    fn side_score_reports_whose_view_decided() {
        // By the viewer's convention, from the open middle of the room: straight to the right.
        let room = [desk(1, 0.0), lamp(2, 2.0)];
        with_assessor(&room, |assessor| {
            assessor.directions = Directions::looking_along(Vector3::y()).unwrap();
            let (right, by) = assessor.at_side(RelationKind::RightOf, 1, 0);
            assert!(right > 0.4 && by == SeenBy::Directions, "{right} {by:?}");
            assert_eq!(assessor.at_side(RelationKind::RightOf, 0, 1).0, 0.0);
            assert_eq!(assessor.geometry(RelationKind::RightOf, 1, &[0]), right);
            assert_eq!(assessor.id(1), InstanceId(2));
        });
    }

    #[test]
    fn superlative_multiplies_the_total() {
        let large = named(2, "lamp", [4.0, 0.0], [0.4, 0.4, 0.8], 0.0);
        let room = [red(0.3, lamp(1, 0.0)), red(0.3, large), desk(3, 9.0)];
        let superlative = Some(Superlative { measure: Measure::Largest, rank: 1 });
        let phrase = Phrase { colors: vec![ColorName::Red], superlative, ..noun_phrase("lamp") };
        with_assessor(&room, |assessor| {
            let found = assessor.assess(&phrase);
            assert_close(&found.own, &[0.5, 0.5, 0.0]);
            assert_close(&found.total, &[0.225, 0.5, 0.0]);
            assert_eq!(found.place_seen_by, [SeenBy::Directions; 3]);
        });
    }
}
