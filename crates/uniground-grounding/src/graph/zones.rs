//! Finds the zones of a scene by the objects that stand in them.

use super::{Guessed, node_id};
use crate::SceneView;
use crate::relations;
use crate::solid::Solid;
use std::collections::{BTreeMap, BTreeSet};
use uniground_geometry::boxes::Aabb;
use uniground_geometry::scene::{Instance, InstanceId};
use uniground_language::Phrase;
use uniground_language::zones;
use uniground_types::graph::{GraphEdge, GraphNode, GraphRelation, NodeKind};

/// Objects that make a zone stand no further apart than this, and other members no further from one
/// of them, meters.
const REACH_M: f32 = 1.5;
/// A given name that fits a noun at least this well counts as that noun.
const SAYS: f32 = 0.8;

/// A zone that was found.
pub(super) struct Zone {
    name: &'static str,
    /// The objects that make the zone.
    makers: Vec<InstanceId>,
    /// Box around these objects.
    aabb: Aabb,
    members: Vec<Member>,
}

/// An object in a zone.
struct Member {
    id: InstanceId,
    score: f32,
    /// Distance from the objects that make the zone, meters.
    distance_m: f32,
}

impl Zone {
    pub fn node(&self, id: String) -> GraphNode {
        GraphNode {
            id,
            kind: NodeKind::Zone,
            name: self.name.to_owned(),
            instance_id: None,
            aabb: self.aabb,
            oriented_box: None,
        }
    }

    pub fn edges(&self, id: &str) -> Vec<GraphEdge> {
        let edge = |&Member { id: member, score, distance_m }: &Member| GraphEdge {
            from: node_id(member),
            to: id.to_owned(),
            relation: GraphRelation::InZone,
            score,
            distance_m,
        };
        self.members.iter().map(edge).collect()
    }

    /// Returns how surely an object is in the zone, and how far it is from the objects that make
    /// it.
    fn holding(&self, id: InstanceId, solids: &BTreeMap<InstanceId, Solid>) -> Member {
        let own = &solids[&id];
        let makers = || self.makers.iter().map(|maker| &solids[maker]);
        let distance_m =
            makers().map(|maker| own.horizontal_gap(maker)).fold(f32::INFINITY, f32::min);
        let near =
            || makers().map(|maker| relations::reaching(own, maker, REACH_M)).fold(0.0, f32::max);
        Member { id, score: if self.makers.contains(&id) { 1.0 } else { near() }, distance_m }
    }
}

/// Returns the zones of a scene: where two kinds of objects that make one stand together. An object
/// is in at most one zone: the one it makes, otherwise the nearest.
pub(super) fn of(
    scene: SceneView,
    things: &[&Instance],
    solids: &BTreeMap<InstanceId, Solid>,
    guessed: Guessed,
) -> Vec<Zone> {
    let mut zones: Vec<Zone> = Vec::new();
    for (name, nouns) in zones::all() {
        let maker = |thing: &&Instance| {
            Some((thing.id, nouns.iter().position(|noun| is_called(scene, thing, noun, guessed))?))
        };
        for cluster in clusters(&things.iter().filter_map(maker).collect::<Vec<_>>(), solids) {
            let kinds: BTreeSet<usize> = cluster.iter().map(|(_, noun)| *noun).collect();
            let makers: Vec<InstanceId> = cluster.into_iter().map(|(id, _)| id).collect();
            let corners: Vec<_> = things
                .iter()
                .filter(|thing| makers.contains(&thing.id))
                .flat_map(|thing| thing.aabb.corners())
                .collect();
            // One desk does not make a study, nor a door a hallway; a dining table alone is enough.
            let Some(aabb) = Aabb::around(&corners).filter(|_| kinds.len() > 1 || nouns.len() == 1)
            else {
                continue;
            };
            zones.push(Zone { name, makers, aabb, members: Vec::new() });
        }
    }
    for thing in things {
        let held = zones.iter().map(|zone| zone.holding(thing.id, solids)).enumerate();
        let nearest =
            held.filter(|(_, member)| member.distance_m <= REACH_M).min_by(|(_, a), (_, b)| {
                b.score.total_cmp(&a.score).then(a.distance_m.total_cmp(&b.distance_m))
            });
        if let Some((at, member)) = nearest {
            zones[at].members.push(member);
        }
    }
    zones
}

/// Returns whether an object has a noun as its name: the given name, otherwise its best guess where
/// an encoder embedded it.
fn is_called(scene: SceneView, thing: &Instance, noun: &str, guessed: Guessed) -> bool {
    match scene.names.get(thing.id.0 as usize - 1) {
        Some(name) => {
            let phrase = Phrase { head: noun.to_owned(), ..Phrase::default() };
            name.is_thing() && name.fit(&phrase, &phrase.meaning()) >= SAYS
        }
        None => {
            guessed == Guessed::ByLooks
                && thing.given_name.is_none()
                && thing.names.first().is_some_and(|guess| guess.name == noun)
        }
    }
}

/// Returns the groups of objects that stand together: each within reach of another.
fn clusters(
    makers: &[(InstanceId, usize)],
    solids: &BTreeMap<InstanceId, Solid>,
) -> Vec<Vec<(InstanceId, usize)>> {
    let mut clusters: Vec<Vec<(InstanceId, usize)>> = Vec::new();
    for &maker in makers {
        let near = |cluster: &Vec<(InstanceId, usize)>| {
            cluster
                .iter()
                .any(|(other, _)| solids[&maker.0].horizontal_gap(&solids[other]) <= REACH_M)
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
