//! How well every instance fits a whole phrase: the thing itself, what it carries, its relations, its place among its like.
//!
//! A phrase is a tree: its anchors are phrases with anchors of their own. The best score of an instance is its own fit times, for
//! each relation, the best (fit of an anchor) x (geometry of the pair) over **all** other instances, computed from the leaves up:
//! target and anchors are chosen together, not one after the other.

use super::SceneView;
use super::direction::Directions;
use super::fit::{colours_fit, most_plausible, noun_fits, trait_fits};
use super::query::{ME, Meaning, Measure, Phrase, Relation, RelationKind, Superlative, With, zones};
use super::relations::{self, Room};
use super::solid::Solid;
use crate::geometry::boxes::OrientedBox;
use crate::geometry::{Point2, Vector3};
use crate::models::attributes;
use crate::scene::{InstanceId, Structure};
use std::cell::OnceCell;

/// What a contradicted relation leaves of a score: geometry is noisy.
const CONTRADICTED: f32 = 0.05;
/// The same for relations that depend on who looks, and on what "between" or "in the corner" means to them.
const LOOSELY_CONTRADICTED: f32 = 0.2;
/// Each place further from the asked extreme multiplies the score by this.
const NEXT_BEST: f32 = 0.45;
/// Power of a fit when things are ranked: what hardly fits the noun hardly takes up a place in the ranking.
const PRESENCE_POWER: i32 = 4;
/// How many anchors a relation tries, the best ones: this bounds the work in a scene of thousands of instances.
const MAX_ANCHORS: usize = 64;
/// The same for each anchor of "between", where pairs are looked at.
const MAX_ANCHORS_OF_A_PAIR: usize = 16;
/// Windows, doors, screens and pictures are thinner, metres.
const THIN_M: f32 = 0.2;
/// What stands on the floor begins below, metres.
const OFF_THE_FLOOR_M: f32 = 0.4;
/// At this gap from what is looked at a thing is half in view, metres.
const LOOKED_AT_REACH_M: f32 = 1.5;
/// Instances that fit the thing itself worse than this are not looked at further.
const IMPOSSIBLE: f32 = 0.01;
/// Share of its score that a thing keeps when it lacks what it should carry.
const NOT_CARRIED: f32 = 0.1;
/// A phrase whose best fit is below this names nothing that was found in the room.
const FOUND: f32 = 0.05;
/// Below this nothing carries what is asked for.
const CARRIED: f32 = 0.25;
/// What is left of a score when the other thing of a relation was not found: it may be there all the same.
const NOT_FOUND: f32 = 0.3;
/// The same for what a thing should carry or have: small things and parts are seldom found.
const SMALL_NOT_FOUND: f32 = 0.6;

/// Parts of things ("the stool with the orange seat" speaks of the stool's own colour), each with the nouns known for it; none: any thing.
const PARTS: &[(&str, &[&str])] = &[
    ("seat", &[]),
    ("back", &[]),
    ("backrest", &[]),
    ("leg", &[]),
    ("arm", &["armchair", "sofa", "office chair"]),
    ("armrest", &["armchair", "sofa", "office chair"]),
    ("handle", &[]),
    ("drawer", &["dresser", "nightstand", "filing cabinet", "desk", "cabinet"]),
    ("wheel", &["office chair", "cart", "suitcase", "bicycle"]),
    ("caster", &["office chair", "cart"]),
    ("top", &[]),
    ("frame", &[]),
    ("cushion", &["sofa", "armchair", "bench"]),
    ("shade", &["floor lamp", "desk lamp"]),
    ("lid", &[]),
    ("base", &[]),
    ("pattern", &[]),
    ("stripe", &[]),
    ("upholstery", &[]),
    ("edge", &[]),
    ("door", &[]),
];
/// Share of its score that a thing keeps when a part is asked for that it is not known for.
const ODD_PART: f32 = 0.6;

/// An anchor chosen for one relation, with the score of the pair.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Bond {
    pub score: f32,
    pub anchor: Option<InstanceId>,
}

const NO_BOND: Bond = Bond { score: 0.0, anchor: None };

/// A phrase against every instance; vectors are by index, scores in `0..=1`.
#[derive(Debug, Clone, PartialEq)]
pub struct Assessment {
    /// The noun alone.
    pub nouns: Vec<f32>,
    /// Names and attributes, with what the thing carries.
    pub own: Vec<f32>,
    /// For each relation of the phrase, the best anchors of every instance.
    pub bonds: Vec<Vec<Bond>>,
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
        }
    }

    /// The smallest rectangle around everything, and the walls.
    pub fn room(&self) -> &Room {
        self.room.get_or_init(|| {
            let corners: Vec<Point2<f32>> = self.solids.iter().flat_map(|s| s.corners).collect();
            let extent = self.scene.extent;
            let heights = (extent.min().z, extent.max().z);
            let outline = OrientedBox::min_area(&corners, heights).map_or_else(|| extent.into(), Solid::from);
            let walls = self.scene.instances.iter().zip(&self.solids).filter(|(i, _)| i.structure == Some(Structure::Wall));
            Room { outline, walls: walls.map(|(_, solid)| *solid).collect() }
        })
    }

    /// Assesses a phrase, anchors first.
    #[must_use]
    pub fn assess(&self, phrase: &Phrase) -> Assessment {
        let (nouns, own) = self.own_fits(phrase);
        let mut total = own.clone();
        let mut bonds: Vec<Vec<Bond>> = vec![Vec::new(); phrase.relations.len()];
        // Comparisons come last: "the closest of those on the table".
        let comparing = |r: &Relation| r.kind.is_comparison();
        let order = (0..phrase.relations.len()).filter(|&i| !comparing(&phrase.relations[i]));
        let order = order.chain((0..phrase.relations.len()).filter(|&i| comparing(&phrase.relations[i])));
        for i in order {
            bonds[i] = self.bonds(&phrase.relations[i], &total);
            let least = contradicted(phrase.relations[i].kind);
            total
                .iter_mut()
                .zip(&bonds[i])
                .for_each(|(score, bond)| *score *= least + (1.0 - least) * bond.score);
        }
        if let Some(superlative) = phrase.superlative {
            self.apply_superlative(superlative, &mut total);
        }
        Assessment { nouns, own, bonds, total }
    }

    /// Fit of every instance to the noun alone, and to noun, colours, traits and carried things together.
    #[must_use]
    pub fn own_fits(&self, phrase: &Phrase) -> (Vec<f32>, Vec<f32>) {
        let instances = self.scene.instances;
        let nouns = noun_fits(self.scene, phrase);
        let mut own: Vec<f32> = instances
            .iter()
            .zip(&nouns)
            .map(|(i, noun)| if *noun > 0.0 { noun * colours_fit(phrase, i) } else { 0.0 })
            .collect();
        for &asked in &phrase.traits {
            let fits = trait_fits(instances, &self.solids, &nouns, asked);
            own.iter_mut().zip(fits).for_each(|(score, fit)| *score *= fit);
        }
        for head in &phrase.other_things {
            let others = noun_fits(self.scene, &Phrase { head: head.clone(), ..Phrase::default() });
            own.iter_mut().zip(others).for_each(|(score, other)| *score *= 1.0 - 0.95 * other);
        }
        for with in &phrase.with {
            self.apply_with(with, &mut own);
        }
        (nouns, own)
    }

    /// The index of what a phrase most likely means.
    #[must_use]
    pub fn best(&self, phrase: &Phrase) -> Option<usize> {
        let total = self.assess(phrase).total;
        let best = (0..total.len()).max_by(|&a, &b| total[a].total_cmp(&total[b]).then(b.cmp(&a)))?;
        (total[best] > 0.0).then_some(best)
    }

    fn id(&self, index: usize) -> InstanceId {
        self.scene.instances[index].id
    }

    fn geometry(&self, kind: RelationKind, target: usize, anchors: &[usize]) -> f32 {
        let score = |anchors: &[&Solid]| relations::score(kind, &self.solids[target], anchors, &self.directions, self.room());
        // At most two anchors count. Slices on the stack: this runs once for every pair.
        match *anchors {
            [a, b, ..] => score(&[&self.solids[a], &self.solids[b]]),
            [a] => score(&[&self.solids[a]]),
            [] => score(&[]),
        }
    }

    /// For every instance as target: its best anchors and how well the relation holds.
    fn bonds(&self, relation: &Relation, fits: &[f32]) -> Vec<Bond> {
        let most = if relation.kind == RelationKind::Between { MAX_ANCHORS_OF_A_PAIR } else { MAX_ANCHORS };
        if let [zone] = &relation.anchors[..]
            && let Some(nouns) = zones::made_of(&zone.head)
        {
            return self.within(nouns, fits, relation.negated);
        }
        if let [anchor] = &relation.anchors[..]
            && anchor.head == ME
        {
            // Nobody knows where the one who asks stands, unless the request says so.
            let unknown = || vec![Bond { score: 1.0, anchor: None }; fits.len()];
            return self.observer.as_ref().map_or_else(unknown, |observer| self.to_observer(relation, observer, fits));
        }
        let assessed: Vec<Assessment> = relation.anchors.iter().map(|phrase| self.assess(phrase)).collect();
        if let Some(share) = unchecked(&relation.anchors, &assessed, NOT_FOUND) {
            return vec![Bond { score: share, anchor: None }; fits.len()];
        }
        let anchors: Vec<Vec<(usize, f32)>> = assessed.iter().map(|found| most_plausible(&found.total, most)).collect();
        let each = |of: &dyn Fn(usize) -> Bond| (0..fits.len()).map(|t| if fits[t] < IMPOSSIBLE { NO_BOND } else { of(t) }).collect();
        let bonds: Vec<Bond> = match (relation.kind, &anchors[..]) {
            (kind, _) if kind.is_of_the_room() => each(&|t| Bond { score: self.geometry(kind, t, &[]), anchor: None }),
            // "near" without an anchor: the parsed query tells of it, the decision leaves it out.
            (_, []) => vec![Bond { score: 1.0, anchor: None }; fits.len()],
            (kind, all) if kind.is_comparison() => self.by_distance(relation, fits, all),
            (RelationKind::Between, [a, b, ..]) => each(&|t| self.between_pair(t, a, b)),
            (RelationKind::Between, [only]) => each(&|t| self.between_pair(t, only, only)),
            // Several anchors ("next to the sofa and the lamp") must all hold.
            (kind, all) => each(&|t| {
                let mut joint = Bond { score: 1.0, anchor: None };
                for candidates in all {
                    let bond = self.best_bond(kind, t, candidates);
                    joint = Bond { score: joint.score * bond.score, anchor: joint.anchor.or(bond.anchor) };
                }
                joint
            }),
        };
        match relation.negated {
            true => bonds.into_iter().map(|b| Bond { score: 1.0 - b.score, ..b }).collect(),
            false => bonds,
        }
    }

    /// How far each instance lies within the zone that things of these nouns make: near one of them. Where there are none, anything may.
    fn within(&self, nouns: &[&str], fits: &[f32], negated: bool) -> Vec<Bond> {
        const REACH_M: f32 = 1.5;
        let named = |noun: &&str| noun_fits(self.scene, &Phrase { head: (*noun).to_owned(), ..Phrase::default() });
        let mut made = vec![0.0_f32; fits.len()];
        for of_noun in nouns.iter().map(named) {
            made.iter_mut().zip(of_noun).for_each(|(best, fit)| *best = best.max(fit));
        }
        let things = most_plausible(&made, MAX_ANCHORS);
        if things.iter().all(|(_, fit)| *fit < FOUND) {
            return vec![Bond { score: 1.0, anchor: None }; fits.len()];
        }
        let within = |t: usize| {
            let to = |&(i, fit): &(usize, f32)| fit * relations::reaching(&self.solids[t], &self.solids[i], REACH_M);
            things.iter().map(to).fold(0.0, f32::max)
        };
        (0..fits.len())
            .map(|t| {
                let score = if fits[t] < IMPOSSIBLE { 0.0 } else { within(t) };
                Bond { score: if negated { 1.0 - score } else { score }, anchor: None }
            })
            .collect()
    }

    fn best_bond(&self, kind: RelationKind, target: usize, anchors: &[(usize, f32)]) -> Bond {
        let bond = |&(a, fit): &(usize, f32)| Bond { score: fit.sqrt() * self.geometry(kind, target, &[a]), anchor: Some(self.id(a)) };
        anchors.iter().filter(|&&(a, _)| a != target).map(bond).fold(NO_BOND, better)
    }

    fn between_pair(&self, target: usize, a: &[(usize, f32)], b: &[(usize, f32)]) -> Bond {
        let pairs = a.iter().flat_map(|x| b.iter().map(move |y| (x, y)));
        pairs
            .filter(|(x, y)| x.0 != y.0 && x.0 != target && y.0 != target)
            .map(|(&(i, fit_i), &(j, fit_j))| Bond {
                score: (fit_i * fit_j).sqrt() * self.geometry(RelationKind::Between, target, &[i, j]),
                anchor: Some(self.id(i)),
            })
            .fold(NO_BOND, better)
    }

    /// "closest to" compares the things the target may be: each place further down the list counts less. Several anchors count by the
    /// sum of the distances to them.
    fn by_distance(&self, relation: &Relation, fits: &[f32], anchors: &[Vec<(usize, f32)>]) -> Vec<Bond> {
        let [first, others @ ..] = anchors else { return vec![NO_BOND; fits.len()] };
        let rivals = most_plausible(fits, usize::MAX);
        let likeliest: Vec<usize> = others
            .iter()
            .filter_map(|c| c.iter().max_by(|a, b| a.1.total_cmp(&b.1).then(b.0.cmp(&a.0))))
            .map(|c| c.0)
            .collect();
        let apart = |t: usize, a: usize| relations::apart(&self.solids[t], &self.solids[a], self.scene.instances[a].structure.is_some());
        let mut bonds = vec![NO_BOND; fits.len()];
        for &(a, anchor_fit) in first {
            let mut order: Vec<(f32, usize)> = rivals
                .iter()
                .map(|&(t, _)| t)
                .filter(|&t| t != a && !likeliest.contains(&t))
                .map(|t| (apart(t, a) + likeliest.iter().map(|&b| apart(t, b)).sum::<f32>(), t))
                .collect();
            for (t, factor) in ranked(relation, &mut order, fits) {
                bonds[t] = better(bonds[t], Bond { score: anchor_fit.sqrt() * factor, anchor: Some(self.id(a)) });
            }
        }
        bonds
    }

    /// "closest to me", "in front of me".
    fn to_observer(&self, relation: &Relation, observer: &Solid, fits: &[f32]) -> Vec<Bond> {
        let mut scores = vec![0.0; fits.len()];
        if relation.kind.is_comparison() {
            let apart = |t: usize| relations::apart(&self.solids[t], observer, false);
            let mut order: Vec<(f32, usize)> = most_plausible(fits, usize::MAX).into_iter().map(|(t, _)| (apart(t), t)).collect();
            ranked(relation, &mut order, fits).into_iter().for_each(|(t, factor)| scores[t] = factor);
        } else {
            let score = |t: usize| relations::to_observer(relation.kind, &self.solids[t], observer, &self.directions, self.room());
            scores
                .iter_mut()
                .enumerate()
                .filter(|(t, _)| fits[*t] >= IMPOSSIBLE)
                .for_each(|(t, s)| *s = score(t));
        }
        let told = |score: f32| if relation.negated { 1.0 - score } else { score };
        scores.into_iter().map(|score| Bond { score: told(score), anchor: None }).collect()
    }

    fn apply_superlative(&self, superlative: Superlative, scores: &mut [f32]) {
        let along = |i: usize, direction: Vector3<f32>| self.solids[i].center.coords.dot(&direction);
        let measure = |i: usize| match superlative.measure {
            Measure::Largest => self.solids[i].volume(),
            Measure::Smallest => -self.solids[i].volume(),
            Measure::Tallest => self.solids[i].size[2],
            Measure::Shortest => -self.solids[i].size[2],
            Measure::Highest => self.solids[i].center.z,
            Measure::Lowest => -self.solids[i].center.z,
            Measure::Leftmost => -along(i, self.directions.right),
            Measure::Rightmost | Measure::Middle => along(i, self.directions.right),
            Measure::Frontmost => along(i, self.directions.front),
            Measure::Backmost => -along(i, self.directions.front),
        };
        let sideways = matches!(superlative.measure, Measure::Leftmost | Measure::Rightmost | Measure::Middle);
        // Who faces a window or a picture has the whole room in view.
        let floor_z = self.scene.extent.min().z;
        let stands_free = |i: &usize| self.solids[*i].sides().1 > THIN_M && self.solids[*i].bottom < floor_z + OFF_THE_FLOOR_M;
        if let Some(looked_at) = self.looked_at.filter(|_| sideways).filter(stands_free) {
            let here = |i: usize| relations::reaching(&self.solids[i], &self.solids[looked_at], LOOKED_AT_REACH_M);
            scores.iter_mut().enumerate().for_each(|(i, score)| *score *= 0.5 + 0.5 * here(i));
        }
        let mut order: Vec<(f32, usize)> = most_plausible(scores, usize::MAX).into_iter().map(|(t, _)| (measure(t), t)).collect();
        order.sort_by(|a, b| b.0.total_cmp(&a.0).then(a.1.cmp(&b.1)));
        let places = soft_places(&order, scores);
        let asked = match superlative.measure {
            Measure::Middle => places.last().map_or(0.0, |(_, last, _)| last / 2.0),
            _ => superlative.rank.max(1) as f32 - 1.0,
        };
        let mut factors = vec![0.0; scores.len()];
        nearness_to(&places, asked).into_iter().for_each(|(t, factor)| factors[t] = factor);
        scores.iter_mut().zip(factors).for_each(|(score, factor)| *score *= factor);
    }

    /// "with the book on it", "with four chairs", "without books", "with the orange seat".
    fn apply_with(&self, With { phrase, absent }: &With, scores: &mut [f32]) {
        let singular = |part: &str| phrase.head == part || phrase.head.strip_suffix('s') == Some(part);
        if let Some((_, of)) = PARTS.iter().find(|(part, _)| singular(part)) {
            let known = |i: usize| of.is_empty() || of.iter().any(|noun| is_named(&self.scene.instances[i], noun));
            for (i, score) in scores.iter_mut().enumerate().filter(|(_, s)| **s > 0.0) {
                let fit = colours_fit(phrase, &self.scene.instances[i]) * if known(i) { 1.0 } else { ODD_PART };
                *score *= if *absent { 1.0 } else { fit };
            }
            return;
        }
        let found = self.assess(phrase);
        if let Some(share) = unchecked(std::slice::from_ref(phrase), std::slice::from_ref(&found), SMALL_NOT_FOUND) {
            if !absent {
                scores.iter_mut().for_each(|score| *score *= share);
            }
            return;
        }
        let things = most_plausible(&found.total, MAX_ANCHORS);
        let best = things.iter().map(|t| t.1).fold(f32::EPSILON, f32::max);
        let fit_of = |i: usize| {
            let carried = |&(t, _): &(usize, f32)| {
                let (thing, own) = (&self.solids[t], &self.solids[i]);
                let held = relations::on(thing, own).max(relations::inside(thing, own));
                held.max(0.6 * relations::around(thing, own))
            };
            let others = || things.iter().filter(|(t, _)| *t != i);
            match phrase.count {
                None => others().map(|t| t.1 * carried(t)).fold(0.0, f32::max),
                // What stands around counts when it stands close.
                Some(count) => {
                    let found: f32 = others().map(|t| t.1 / best * ((carried(t) - 0.3) / 0.2).clamp(0.0, 1.0)).sum();
                    best.min(1.0) / (1.0 + ((found - count as f32) / 0.6).powi(2))
                }
            }
        };
        let fits: Vec<(usize, f32)> = most_plausible(scores, usize::MAX).into_iter().map(|(i, _)| (i, fit_of(i))).collect();
        // Where none carries such a thing, it was missed: books on a shelf are seldom found one by one.
        let missed = !absent && fits.iter().all(|(_, fit)| *fit < CARRIED);
        let mut shares = vec![NOT_CARRIED; scores.len()];
        for (i, fit) in fits {
            let fit = NOT_CARRIED + (1.0 - NOT_CARRIED) * fit;
            shares[i] = if *absent { 1.0 + NOT_CARRIED - fit } else { fit.max(if missed { SMALL_NOT_FOUND } else { 0.0 }) };
        }
        scores.iter_mut().zip(shares).for_each(|(score, share)| *score *= share);
    }
}

/// What is left of a score where nothing can be measured: all of it when a word is not known, `share` when no such thing was found.
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

fn contradicted(kind: RelationKind) -> f32 {
    if kind.depends_on_who_looks() { LOOSELY_CONTRADICTED } else { CONTRADICTED }
}

fn is_named(instance: &crate::scene::Instance, noun: &str) -> bool {
    match &instance.given_name {
        Some(given) => attributes::Lexicon::get().find(given).is_some_and(|own| own.name == noun),
        None => instance.names.iter().any(|guess| guess.name == noun),
    }
}

fn better(best: Bond, other: Bond) -> Bond {
    if other.score > best.score { other } else { best }
}

/// How well each instance has the asked place of an order by distance.
fn ranked(relation: &Relation, order: &mut [(f32, usize)], fits: &[f32]) -> Vec<(usize, f32)> {
    order.sort_by(|x, y| x.0.total_cmp(&y.0).then(x.1.cmp(&y.1)));
    if relation.kind == RelationKind::Farthest {
        order.reverse();
    }
    nearness_to(&soft_places(order, fits), (relation.rank.max(1) - 1) as f32)
}

/// For each instance of an order: its index, its place from 0, and how surely it is what is asked for, `0..=1`.
///
/// Those ahead count towards the place only as far as they fit themselves: the largest thing that might be a table is seldom a table.
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

/// How near each instance stands to the asked place (from 0), weighed by how surely it is what is asked for; scaled so that the best
/// has 1.
fn nearness_to(places: &[(usize, f32, f32)], asked: f32) -> Vec<(usize, f32)> {
    let factor = |&(t, place, presence): &(usize, f32, f32)| (t, presence * NEXT_BEST.powf((place - asked).abs()));
    let factors: Vec<(usize, f32)> = places.iter().map(factor).collect();
    let best = factors.iter().map(|f| f.1).fold(f32::EPSILON, f32::max);
    factors.into_iter().map(|(t, factor)| (t, factor / best)).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn things_with_parts_are_names_of_the_lexicon() {
        for noun in PARTS.iter().flat_map(|(_, of)| *of) {
            assert!(attributes::Lexicon::get().nouns().iter().any(|known| known.name == *noun), "{noun}");
        }
    }
}
