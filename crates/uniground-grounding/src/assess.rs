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
use std::cell::{OnceCell, RefCell};
use std::rc::Rc;
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
    /// Fits of nouns by [`Phrase::noun_alone`]. Cached, because the decision and the sentence assess
    /// the same objects.
    noun_fits: RefCell<Vec<(Phrase, Rc<[f32]>)>>,
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
            noun_fits: RefCell::default(),
        }
    }

    /// Returns the fit of every instance to a phrase's noun.
    fn noun_fits(&self, phrase: &Phrase) -> Rc<[f32]> {
        let noun = phrase.noun_alone();
        let known = self.noun_fits.borrow().iter().find(|(of, _)| *of == noun).cloned();
        if let Some((_, fits)) = known {
            return fits;
        }
        let fits: Rc<[f32]> = noun_fits(self.scene, &noun).into();
        self.noun_fits.borrow_mut().push((noun, fits.clone()));
        fits
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
        let nouns = self.noun_fits(phrase);
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
            let others = self.noun_fits(&Phrase { head: head.clone(), ..Phrase::default() });
            // Where all instances that may be meant have the excluded name too ("the football, not
            // the basketball", and both are balls), names do not decide.
            let likely = most_plausible(&own, usize::MAX);
            let shared = likely.iter().map(|&(i, _)| others[i]).fold(1.0, f32::min);
            own.iter_mut()
                .zip(others.iter())
                .for_each(|(score, other)| *score *= 1.0 - 0.95 * (other - shared).max(0.0));
        }
        for with in &phrase.with {
            self.apply_with(with, &mut own);
        }
        (nouns.to_vec(), own)
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
        let named =
            |noun: &&str| self.noun_fits(&Phrase { head: (*noun).to_owned(), ..Phrase::default() });
        let mut made = vec![0.0_f32; fits.len()];
        for of_noun in nouns.iter().map(named) {
            made.iter_mut().zip(of_noun.iter()).for_each(|(best, fit)| *best = best.max(*fit));
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
        let solid = &self.solids[target];
        let score = |a: usize| {
            if let Some(reach) = reach {
                let anchor = &self.solids[a];
                // Most of a large scene is far away, and its exact distance does not matter.
                if solid.is_beyond(anchor, reach.limit_m()) {
                    return 0.0;
                }
                return reach.fit(solid.gap(anchor));
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
mod tests;
