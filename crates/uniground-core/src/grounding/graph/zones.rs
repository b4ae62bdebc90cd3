//! Zones of a scene, by what stands in them.

use super::{Guessed, node_id};
use crate::geometry::boxes::Aabb;
use crate::grounding::SceneView;
use crate::grounding::query::Phrase;
use crate::grounding::query::zones;
use crate::grounding::relations;
use crate::grounding::solid::Solid;
use crate::scene::{Instance, InstanceId};
use std::collections::{BTreeMap, BTreeSet};
use uniground_types::graph::{GraphEdge, GraphNode, GraphRelation, NodeKind};

/// Things of a zone stand no further apart, and other things no further from one of them, metres.
const REACH_M: f32 = 1.5;
/// A given name that fits a noun as well as this says it.
const SAYS: f32 = 0.8;

/// A zone that was found.
pub(super) struct Zone {
    name: &'static str,
    /// Around what makes it.
    aabb: Aabb,
    /// What is in it, with how surely and how far from what makes it.
    members: Vec<(InstanceId, f32, f32)>,
}

impl Zone {
    pub fn node(&self, id: String) -> GraphNode {
        GraphNode { id, kind: NodeKind::Zone, name: self.name.to_owned(), instance_id: None, aabb: self.aabb, oriented_box: None }
    }

    pub fn edges(&self, id: &str) -> Vec<GraphEdge> {
        let edge = |&(member, score, distance_m): &(InstanceId, f32, f32)| GraphEdge {
            from: node_id(member),
            to: id.to_owned(),
            relation: GraphRelation::InZone,
            score,
            distance_m,
        };
        self.members.iter().map(edge).collect()
    }
}

/// The zones of a scene: where two kinds of things that make one stand together. Every thing is in one at most, the nearest.
pub(super) fn of(scene: SceneView, things: &[&Instance], solids: &BTreeMap<InstanceId, Solid>, guessed: Guessed) -> Vec<Zone> {
    let mut found: Vec<(&'static str, Vec<InstanceId>)> = Vec::new();
    for (name, nouns) in zones::all() {
        let makers: Vec<(InstanceId, usize)> = things
            .iter()
            .filter_map(|thing| Some((thing.id, nouns.iter().position(|noun| is_called(scene, thing, noun, guessed))?)))
            .collect();
        for cluster in clusters(&makers, solids) {
            let kinds: BTreeSet<usize> = cluster.iter().map(|(_, noun)| *noun).collect();
            // One desk is no study, nor a door a hallway; a dining table alone tells.
            if kinds.len() > 1 || nouns.len() == 1 {
                found.push((name, cluster.into_iter().map(|(id, _)| id).collect()));
            }
        }
    }
    let mut members: Vec<Vec<(InstanceId, f32, f32)>> = vec![Vec::new(); found.len()];
    for thing in things {
        let own = &solids[&thing.id];
        let away = |makers: &[InstanceId]| makers.iter().map(|maker| own.horizontal_gap(&solids[maker])).fold(f32::INFINITY, f32::min);
        let of_zone = |(at, (_, makers)): (usize, &(&str, Vec<InstanceId>))| (!makers.contains(&thing.id), away(makers), at);
        let nearest = found
            .iter()
            .enumerate()
            .map(of_zone)
            .min_by(|a, b| a.0.cmp(&b.0).then(a.1.total_cmp(&b.1)).then(a.2.cmp(&b.2)));
        if let Some((makes_none, distance_m, at)) = nearest.filter(|(_, distance_m, _)| *distance_m <= REACH_M) {
            let score = if makes_none {
                let makers = found[at].1.iter();
                makers.map(|maker| relations::reaching(own, &solids[maker], REACH_M)).fold(0.0, f32::max)
            } else {
                1.0
            };
            members[at].push((thing.id, score, distance_m));
        }
    }
    let zone = |((name, makers), members): ((&'static str, Vec<InstanceId>), Vec<(InstanceId, f32, f32)>)| {
        let corners: Vec<_> = scene.instances.iter().filter(|i| makers.contains(&i.id)).flat_map(|i| i.aabb.corners()).collect();
        Some(Zone { name, aabb: Aabb::around(&corners)?, members })
    };
    found.into_iter().zip(members).filter_map(zone).collect()
}

/// Whether a thing is called by a noun: by the name it was given, else by its best one where it was seen.
fn is_called(scene: SceneView, thing: &Instance, noun: &str, guessed: Guessed) -> bool {
    match scene.names.get(thing.id.0 as usize - 1) {
        Some(name) => {
            let phrase = Phrase { head: noun.to_owned(), ..Phrase::default() };
            name.is_thing() && name.fit(&phrase, &phrase.meaning()) >= SAYS
        }
        None => guessed == Guessed::ByLooks && thing.given_name.is_none() && thing.names.first().is_some_and(|guess| guess.name == noun),
    }
}

/// What stands together: each within reach of another.
fn clusters(makers: &[(InstanceId, usize)], solids: &BTreeMap<InstanceId, Solid>) -> Vec<Vec<(InstanceId, usize)>> {
    let mut clusters: Vec<Vec<(InstanceId, usize)>> = Vec::new();
    for &maker in makers {
        let near = |cluster: &Vec<(InstanceId, usize)>| {
            cluster.iter().any(|(other, _)| solids[&maker.0].horizontal_gap(&solids[other]) <= REACH_M)
        };
        let (mut joined, apart): (Vec<_>, Vec<_>) = clusters.into_iter().partition(near);
        let mut own: Vec<(InstanceId, usize)> = joined.drain(..).flatten().collect();
        own.push(maker);
        clusters = apart;
        clusters.push(own);
    }
    clusters.iter_mut().for_each(|cluster| cluster.sort_unstable());
    clusters.sort();
    clusters
}
