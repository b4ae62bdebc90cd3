//! How well every instance fits a whole phrase: the thing itself, what it carries, its relations,
//! its place among its like.
//!
//! A phrase is a tree: its anchors are phrases with anchors of their own. The best score of an
//! instance is its own fit times, for each relation, the best (fit of an anchor) x (geometry of the
//! pair) over **all** other instances, computed from the leaves up: target and anchors are chosen
//! together, not one after the other.

mod carried;
mod places;

use super::SceneView;
use super::direction::Directions;
use super::fit::{colours_fit, most_plausible, noun_fits, trait_fits};
use super::relations::{self, SeenBy};
use super::room::{Faced, Room};
use super::solid::Solid;
use places::ranked;
use std::cell::OnceCell;
use uniground_geometry::boxes::OrientedBox;
use uniground_geometry::scene::{InstanceId, Structure, Support};
use uniground_geometry::statistics::largest;
use uniground_geometry::{Point2, Point3, Vector3};
use uniground_language::{ME, Meaning, Phrase, Relation, RelationKind, zones};

/// What a contradicted relation leaves of a score: geometry is noisy.
const CONTRADICTED: f32 = 0.05;
/// The same for relations that depend on who looks, and on what "between" or "in the corner" means
/// to them.
const LOOSELY_CONTRADICTED: f32 = 0.2;
/// How many anchors a relation tries, the best ones: this bounds the work in a scene of thousands
/// of instances.
const MAX_ANCHORS: usize = 64;
/// The same for each anchor of "between", where pairs are looked at.
const MAX_ANCHORS_OF_A_PAIR: usize = 16;
/// Instances that fit the thing itself worse than this are not looked at further.
const IMPOSSIBLE: f32 = 0.01;
/// A phrase whose best fit is below this names nothing that was found in the room.
const FOUND: f32 = 0.05;
/// Share of the best fit with which something else may be meant.
const MAY_BE_MEANT: f32 = 0.5;
/// Below this nothing carries what is asked for.
const CARRIED: f32 = 0.25;
/// What is left of a score when the other thing of a relation was not found: it may be there all
/// the same.
const NOT_FOUND: f32 = 0.3;

/// What stands on another or in it to this degree touches it; in an order by distance it comes
/// after all that is apart, metres.
const MOSTLY_HELD: f32 = 0.5;
const HELD_M: f32 = 1e3;

/// Share that "on the wall" keeps for what stands in front of it.
const AT_THE_WALL: f32 = 0.3;

/// An anchor chosen for one relation, with the score of the pair.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct RelationMatch {
    pub score: f32,
    pub anchor: Option<InstanceId>,
}

const NO_BOND: RelationMatch = RelationMatch { score: 0.0, anchor: None };

/// A phrase against every instance; vectors are by index, scores in `0..=1`.
#[derive(Debug, Clone, PartialEq)]
pub struct Assessment {
    /// The noun alone.
    pub nouns: Vec<f32>,
    /// Names and attributes, with what the thing carries.
    pub own: Vec<f32>,
    /// For each relation of the phrase, the best anchors of every instance.
    pub bonds: Vec<Vec<RelationMatch>>,
    /// Whose left and right the place among its like was told by; empty where none is asked for.
    pub place_seen_by: Vec<SeenBy>,
    pub total: Vec<f32>,
}

/// A scene, and how it is looked at.
pub struct Assessor<'a> {
    pub scene: SceneView<'a>,
    pub solids: Vec<Solid>,
    pub directions: Directions,
    /// Where the one who asks stands.
    pub observer: Option<Solid>,
    /// Index of what somebody looks at: of things to the left and right, those near it are meant.
    pub looked_at: Option<usize>,
    room: OnceCell<Room>,
    /// How somebody looks who faces an instance: it takes a look at all walls, and is asked for
    /// with every other instance.
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
            room: OnceCell::new(),
            faced: vec![OnceCell::new(); scene.instances.len()],
        }
    }

    /// The smallest rectangle around everything, and the walls.
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
                leave_best(count, &mut total);
            }
            bonds[i] = self.bonds(&phrase.relations[i], &total);
            let least = contradicted(phrase.relations[i].kind);
            total
                .iter_mut()
                .zip(&bonds[i])
                .for_each(|(score, bond)| *score *= least + (1.0 - least) * bond.score);
        }
        if let Some(count) = counted.filter(|_| compares) {
            leave_best(count, &mut total);
        }
        let place_seen_by = phrase
            .superlative
            .map_or_else(Vec::new, |superlative| self.apply_superlative(superlative, &mut total));
        Assessment { nouns, own, bonds, place_seen_by, total }
    }

    /// Fit of every instance to the noun alone, and to noun, colours, traits and carried things
    /// together.
    #[must_use]
    pub fn own_fits(&self, phrase: &Phrase) -> (Vec<f32>, Vec<f32>) {
        let instances = self.scene.instances;
        let nouns = noun_fits(self.scene, phrase);
        let of_colour = |(i, noun): (usize, &f32)| {
            if *noun > 0.0 { noun * colours_fit(self.scene, phrase, i) } else { 0.0 }
        };
        let mut own: Vec<f32> = nouns.iter().enumerate().map(of_colour).collect();
        for &asked in &phrase.traits {
            let fits = trait_fits(instances, &self.solids, &nouns, asked);
            own.iter_mut().zip(fits).for_each(|(score, fit)| *score *= fit);
        }
        for head in &phrase.other_things {
            let others = noun_fits(self.scene, &Phrase { head: head.clone(), ..Phrase::default() });
            // Where all that may be meant is called so as well ("the football, not the basketball",
            // and both are balls), names do not tell.
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

    /// The index of what a phrase most likely means.
    #[must_use]
    pub fn best(&self, phrase: &Phrase) -> Option<usize> {
        self.likely(phrase, 1).first().map(|&(index, _)| index)
    }

    /// Indices of what a phrase may mean, and how well each fits against the best, at most so many,
    /// best first: none that fits less than half as well.
    #[must_use]
    pub fn likely(&self, phrase: &Phrase, most: usize) -> Vec<(usize, f32)> {
        let total = self.assess(phrase).total;
        let best = largest(&total, most);
        let of_best = best.first().map_or(1.0, |&i| total[i].max(f32::EPSILON));
        let shares = best.into_iter().map(|i| (i, total[i] / of_best));
        shares.filter(|&(i, share)| total[i] > 0.0 && share >= MAY_BE_MEANT).collect()
    }

    /// The middle of all that a phrase's own words may mean; metres.
    #[must_use]
    pub fn middle_of(&self, phrase: &Phrase) -> Option<Point3<f32>> {
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
        // At most two anchors count. Slices on the stack: this runs once for every pair.
        match *anchors {
            [a, b, ..] => score(&[&self.solids[a], &self.solids[b]]),
            [a] => score(&[&self.solids[a]]),
            [] => score(&[]),
        }
    }

    /// How well a thing stands at a side of another, and by whose view.
    #[must_use]
    pub fn at_side(&self, kind: RelationKind, target: usize, anchor: usize) -> (f32, SeenBy) {
        let (target, of) = (&self.solids[target], &self.solids[anchor]);
        let faced = || *self.faced[anchor].get_or_init(|| self.room().faced(of));
        relations::at_side(kind, target, of, &self.directions, faced)
    }

    /// For every instance as target: its best anchors and how well the relation holds.
    fn bonds(&self, relation: &Relation, fits: &[f32]) -> Vec<RelationMatch> {
        let most = if relation.kind == RelationKind::Between {
            MAX_ANCHORS_OF_A_PAIR
        } else {
            MAX_ANCHORS
        };
        if let [zone] = &relation.anchors[..]
            && let Some(nouns) = zones::made_of(&zone.head)
        {
            return self.within(nouns, fits, relation.negated);
        }
        if let [anchor] = &relation.anchors[..]
            && anchor.head == ME
        {
            // Nobody knows where the one who asks stands, unless the request says so.
            let unknown = || vec![RelationMatch { score: 1.0, anchor: None }; fits.len()];
            return self
                .observer
                .as_ref()
                .map_or_else(unknown, |observer| self.to_observer(relation, observer, fits));
        }
        let assessed: Vec<Assessment> =
            relation.anchors.iter().map(|phrase| self.assess(phrase)).collect();
        if let Some(share) = unchecked(&relation.anchors, &assessed, NOT_FOUND) {
            return self.at_a_side(relation, fits, share);
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
            // "near" without an anchor: the parsed query tells of it, the decision leaves it out.
            (_, []) => vec![RelationMatch { score: 1.0, anchor: None }; fits.len()],
            (kind, all) if kind.is_comparison() => self.by_distance(relation, fits, all),
            (RelationKind::Between, [a, b, ..]) => each(&|t| self.between_pair(t, a, b)),
            (RelationKind::Between, [only]) => each(&|t| self.between_pair(t, only, only)),
            // Several anchors ("next to the sofa and the lamp") must all hold.
            (_, all) => each(&|t| {
                let mut joint = RelationMatch { score: 1.0, anchor: None };
                for candidates in all {
                    let bond = self.best_bond(relation, t, candidates);
                    joint = RelationMatch {
                        score: joint.score * bond.score,
                        anchor: joint.anchor.or(bond.anchor),
                    };
                }
                joint
            }),
        };
        // "on a stand": where none of those that were found will do, it is another one.
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

    /// A relation to a thing that is not known or was not found. "Right of the mantel": of its
    /// like, the one on the right.
    fn at_a_side(&self, relation: &Relation, fits: &[f32], share: f32) -> Vec<RelationMatch> {
        let side = match relation.kind {
            RelationKind::LeftOf => -self.directions.right,
            RelationKind::RightOf => self.directions.right,
            _ => return vec![RelationMatch { score: share, anchor: None }; fits.len()],
        };
        let along = |t: usize| -self.solids[t].center.coords.dot(&side);
        let mut order: Vec<(f32, usize)> =
            most_plausible(fits, usize::MAX).into_iter().map(|(t, _)| (along(t), t)).collect();
        let mut bonds = vec![NO_BOND; fits.len()];
        for (t, factor) in ranked(relation, &mut order, fits) {
            bonds[t].score = share * if relation.negated { 1.0 - factor } else { factor };
        }
        bonds
    }

    /// How far each instance lies within the zone that things of these nouns make: near one of
    /// them. Where there are none, anything may.
    fn within(&self, nouns: &[&str], fits: &[f32], negated: bool) -> Vec<RelationMatch> {
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
                // What stands behind the wall is in another room.
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

    fn best_bond(
        &self,
        relation: &Relation,
        target: usize,
        anchors: &[(usize, f32)],
    ) -> RelationMatch {
        let score = |a: usize| {
            self.geometry(relation.kind, target, &[a]).max(self.on_its_side(relation, target, a))
                * self.hangs(relation.kind, target, a)
        };
        let bond = |&(a, fit): &(usize, f32)| RelationMatch {
            score: fit.sqrt() * score(a),
            anchor: Some(self.id(a)),
        };
        anchors.iter().filter(|&&(a, _)| a != target).map(bond).fold(NO_BOND, better)
    }

    /// What is on a wall hangs there: what stands on the floor or on a thing is only at it.
    fn hangs(&self, kind: RelationKind, target: usize, anchor: usize) -> f32 {
        let of = |i: usize| &self.scene.instances[i];
        let held_below = matches!(of(target).support, Support::Floor | Support::Instance { .. });
        if kind == RelationKind::On && of(anchor).structure == Some(Structure::Wall) && held_below {
            AT_THE_WALL
        } else {
            1.0
        }
    }

    /// "On the left side of the desk" may be said of what stands on it, to the left.
    fn on_its_side(&self, relation: &Relation, target: usize, anchor: usize) -> f32 {
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

    fn between_pair(&self, target: usize, a: &[(usize, f32)], b: &[(usize, f32)]) -> RelationMatch {
        let pairs = a.iter().flat_map(|x| b.iter().map(move |y| (x, y)));
        pairs
            .filter(|(x, y)| x.0 != y.0 && x.0 != target && y.0 != target)
            .map(|(&(i, fit_i), &(j, fit_j))| RelationMatch {
                score: (fit_i * fit_j).sqrt()
                    * self.geometry(RelationKind::Between, target, &[i, j]),
                anchor: Some(self.id(i)),
            })
            .fold(NO_BOND, better)
    }

    /// "closest to" compares the things the target may be: each place further down the list counts
    /// less. Several anchors count by the sum of the distances to them.
    fn by_distance(
        &self,
        relation: &Relation,
        fits: &[f32],
        anchors: &[Vec<(usize, f32)>],
    ) -> Vec<RelationMatch> {
        let [first, others @ ..] = anchors else { return vec![NO_BOND; fits.len()] };
        let rivals = most_plausible(fits, usize::MAX);
        let likeliest: Vec<usize> = others
            .iter()
            .filter_map(|c| c.iter().max_by(|a, b| a.1.total_cmp(&b.1).then(b.0.cmp(&a.0))))
            .map(|c| c.0)
            .collect();
        let of_the_building = |a: usize| self.scene.instances[a].structure.is_some();
        let apart = |t: usize, a: usize| {
            relations::apart(&self.solids[t], &self.solids[a], of_the_building(a), self.room())
        };
        // What the anchor carries touches it: only where all of them do is one of them the closest.
        let held = |t: usize, a: usize| {
            relation.kind == RelationKind::Closest
                && !of_the_building(a)
                && relations::holds(&self.solids[a], &self.solids[t]) > MOSTLY_HELD
        };
        let mut bonds = vec![NO_BOND; fits.len()];
        for &(a, anchor_fit) in first {
            let mut order: Vec<(f32, usize)> = rivals
                .iter()
                .map(|&(t, _)| t)
                .filter(|&t| t != a && !likeliest.contains(&t))
                .map(|t| {
                    (
                        if held(t, a) { HELD_M } else { 0.0 }
                            + apart(t, a)
                            + likeliest.iter().map(|&b| apart(t, b)).sum::<f32>(),
                        t,
                    )
                })
                .collect();
            for (t, factor) in ranked(relation, &mut order, fits) {
                bonds[t] = better(
                    bonds[t],
                    RelationMatch { score: anchor_fit.sqrt() * factor, anchor: Some(self.id(a)) },
                );
            }
        }
        bonds
    }

    /// "closest to me", "in front of me".
    fn to_observer(
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
            ranked(relation, &mut order, fits)
                .into_iter()
                .for_each(|(t, factor)| scores[t] = factor);
        } else {
            let score = |t: usize| {
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

/// What is left of a score where nothing can be measured: all of it when a word is not known,
/// `share` when no such thing was found.
fn unchecked(phrases: &[Phrase], found: &[Assessment], share: f32) -> Option<f32> {
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

/// "The middle one of the three stools": the three that fit best are compared, and what fits as
/// well as the third.
fn leave_best(count: usize, scores: &mut [f32]) {
    const AS_WELL: f32 = 0.95;
    let mut best = scores.to_vec();
    best.sort_by(|a, b| b.total_cmp(a));
    let least = best.get(count - 1).map_or(0.0, |last| AS_WELL * last);
    scores.iter_mut().filter(|score| **score < least).for_each(|score| *score = 0.0);
}

fn contradicted(kind: RelationKind) -> f32 {
    if kind.depends_on_who_looks() { LOOSELY_CONTRADICTED } else { CONTRADICTED }
}

fn better(best: RelationMatch, other: RelationMatch) -> RelationMatch {
    if other.score > best.score { other } else { best }
}
