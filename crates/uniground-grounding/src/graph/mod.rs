//! The scene graph: spatial relations between instances, by the same geometry that answers
//! questions.
//!
//! Support and parts come from the parse. `inside`, `above` and `next_to` are the reasoner's scores
//! ([`relations`]) compared with a threshold. The graph has no relations that depend on the viewer
//! (left of, behind).

mod written;
mod zones;

pub use written::{graphml, text};

use super::SceneView;
use super::answer::describe_instance;
use super::relations;
use super::solid::Solid;
use std::collections::{BTreeMap, BTreeSet};
use uniground_geometry::scene::{Instance, InstanceId, Level, Structure, Support};
use uniground_types::graph::{GraphEdge, GraphNode, GraphRelation, NodeKind};
use uniground_types::instances::Levels;

/// A relation with a lower score does not hold.
const HOLDS: f32 = 0.5;
/// An instance is inside another from this share of its volume on.
const MOSTLY: f32 = 0.7;
/// A container is larger than its content by at least this factor.
const HOLDER_VOLUME: f32 = 2.0;
/// An instance that is higher than another by more than this is not beside it, meters.
const STEP_M: f32 = 0.1;
/// Two instances are neighbors where each is among this many nearest of the other, and the nearest
/// one always is. Otherwise everything in a full shelf would be near everything, and the whole room
/// would be near a wardrobe.
const NEIGHBORS: usize = 4;

/// Where the guessed names come from, for instances without a given name.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Guessed {
    /// An encoder has embedded the instances.
    ByLooks,
    /// From sizes and places alone. Good enough to choose among instances that fit a question, not
    /// to say what a room is.
    ByMeasures,
}

/// Nodes and edges of a scene.
#[derive(Debug, Clone, PartialEq)]
pub struct Graph {
    /// In order of instance id, then zones.
    pub nodes: Vec<GraphNode>,
    /// In order of their nodes.
    pub edges: Vec<GraphEdge>,
}

impl Graph {
    /// Builds the graph of a scene from its things and structural elements, with [`Levels::All`]
    /// from parts and wholes as well. Dismissed instances are left out.
    #[must_use]
    pub fn of(scene: SceneView, levels: Levels, guessed: Guessed) -> Self {
        let is_listed = |i: &&Instance| {
            !i.dismissed
                && (levels == Levels::All
                    || i.level == Level::Thing
                    || levels.includes(i.level, false))
        };
        let listed: Vec<&Instance> = scene.instances.iter().filter(is_listed).collect();
        let known: BTreeSet<InstanceId> = listed.iter().map(|i| i.id).collect();
        let solids: BTreeMap<InstanceId, Solid> =
            listed.iter().map(|i| (i.id, Solid::from(*i))).collect();
        let things: Vec<&Instance> = listed
            .iter()
            .copied()
            .filter(|i| i.level == Level::Thing && i.structure.is_none())
            .collect();
        let zones = zones::of(scene, &things, &solids, guessed);

        let relating = Relating { scene, known, solids };
        let mut edges = relating.told(&listed);
        let carried: BTreeSet<(InstanceId, InstanceId)> =
            edges.iter().map(|edge| (edge.from, edge.to)).collect();
        edges.extend(relating.measured(&things, &carried));
        let by_nodes = |edge: &Edge| (edge.from, edge.to, edge.relation);
        edges.sort_by_key(by_nodes);
        edges.dedup_by_key(|edge| by_nodes(edge));
        let mut edges: Vec<GraphEdge> = edges.into_iter().map(Edge::told).collect();
        edges.extend(zones.iter().enumerate().flat_map(|(at, zone)| zone.edges(&zone_id(at))));
        let mut nodes: Vec<GraphNode> = listed.into_iter().map(node).collect();
        nodes.extend(zones.iter().enumerate().map(|(at, zone)| zone.node(zone_id(at))));
        Self { nodes, edges }
    }

    /// Returns the graph of one instance and those it is related to; `None` where the graph does
    /// not have the instance.
    #[must_use]
    pub fn around(mut self, id: InstanceId) -> Option<Self> {
        let middle = node_id(id);
        self.nodes.iter().find(|node| node.id == middle)?;
        self.edges.retain(|edge| edge.from == middle || edge.to == middle);
        let kept: BTreeSet<&str> =
            self.edges.iter().flat_map(|edge| [&*edge.from, &*edge.to]).chain([&*middle]).collect();
        self.nodes.retain(|node| kept.contains(&*node.id));
        Some(self)
    }
}

fn node_id(id: InstanceId) -> String {
    format!("i{id}")
}

fn zone_id(at: usize) -> String {
    format!("z{}", at + 1)
}

fn node(instance: &Instance) -> GraphNode {
    let kind = match (instance.level, instance.structure) {
        (_, Some(_)) => NodeKind::Structure,
        (Level::Thing, None) => NodeKind::Thing,
        (Level::Part, None) => NodeKind::Part,
        (Level::Whole, None) => NodeKind::Whole,
    };
    GraphNode {
        id: node_id(instance.id),
        kind,
        // A given name is used unchanged.
        name: match (instance.structure, &instance.given_name) {
            (None, None) => describe_instance(instance),
            _ => instance.label().to_owned(),
        },
        instance_id: Some(instance.id),
        aabb: instance.aabb,
        oriented_box: Some(instance.oriented_box),
    }
}

/// An edge between instances.
struct Edge {
    from: InstanceId,
    to: InstanceId,
    relation: GraphRelation,
    score: f32,
    distance_m: f32,
}

impl Edge {
    fn told(self) -> GraphEdge {
        let Self { from, to, relation, score, distance_m } = self;
        GraphEdge { from: node_id(from), to: node_id(to), relation, score, distance_m }
    }
}

struct Relating<'a> {
    scene: SceneView<'a>,
    known: BTreeSet<InstanceId>,
    solids: BTreeMap<InstanceId, Solid>,
}

impl Relating<'_> {
    /// Returns the relations of the parse itself: part of, carried by.
    fn told(&self, listed: &[&Instance]) -> Vec<Edge> {
        let mut edges = Vec::new();
        for instance in listed {
            match instance.level {
                Level::Part => edges.extend(
                    instance
                        .things
                        .iter()
                        .map(|&thing| self.edge(instance.id, thing, GraphRelation::PartOf, 1.0)),
                ),
                Level::Whole => {
                    edges.extend(
                        instance.things.iter().map(|&thing| {
                            self.edge(thing, instance.id, GraphRelation::PartOf, 1.0)
                        }),
                    );
                }
                Level::Thing if instance.structure.is_none() => {
                    let (carrier, relation) = match instance.support {
                        Support::Instance { id } => (Some(id), GraphRelation::On),
                        Support::Wall { id } => (Some(id), GraphRelation::OnWall),
                        Support::Floor => (self.floor_below(instance), GraphRelation::On),
                        Support::Nothing => (None, GraphRelation::On),
                    };
                    edges.extend(
                        carrier.map(|carrier| self.edge(instance.id, carrier, relation, 1.0)),
                    );
                }
                Level::Thing => {}
            }
        }
        edges.into_iter().flatten().collect()
    }

    /// Returns the relations measured between things neither of which carries the other.
    fn measured(
        &self,
        things: &[&Instance],
        carried: &BTreeSet<(InstanceId, InstanceId)>,
    ) -> Vec<Edge> {
        let mut edges = Vec::new();
        // By thing: what it is above, and what it is next to.
        let mut below: BTreeMap<InstanceId, Vec<(f32, InstanceId)>> = BTreeMap::new();
        let mut beside: BTreeMap<InstanceId, Vec<(f32, InstanceId)>> = BTreeMap::new();
        for (at, a) in things.iter().map(|thing| thing.id).enumerate() {
            for b in things[at + 1..].iter().map(|thing| thing.id) {
                if carried.contains(&(a, b)) || carried.contains(&(b, a)) {
                    continue;
                }
                match measure(&self.solids[&a], &self.solids[&b]) {
                    Some(Measured::Inside(score)) => {
                        edges.push(self.edge(a, b, GraphRelation::Inside, score));
                    }
                    Some(Measured::Around(score)) => {
                        edges.push(self.edge(b, a, GraphRelation::Inside, score));
                    }
                    Some(Measured::Above(score)) => below.entry(a).or_default().push((score, b)),
                    Some(Measured::Below(score)) => below.entry(b).or_default().push((score, a)),
                    Some(Measured::Beside(score)) => {
                        beside.entry(a).or_default().push((score, b));
                        beside.entry(b).or_default().push((score, a));
                    }
                    None => {}
                }
            }
        }
        for (from, others) in below {
            edges.extend(
                best(others, 1).map(|(score, to)| self.edge(from, to, GraphRelation::Above, score)),
            );
        }
        let places = |others: Vec<(f32, InstanceId)>| {
            best(others, NEIGHBORS)
                .zip(0..)
                .map(|((score, to), place)| (to, (place, score)))
                .collect()
        };
        let nearest: BTreeMap<InstanceId, BTreeMap<InstanceId, (usize, f32)>> =
            beside.into_iter().map(|(from, others)| (from, places(others))).collect();
        for (from, others) in &nearest {
            for (to, (place, score)) in others {
                let is_mutual = nearest[to].contains_key(from);
                if *place == 0 || is_mutual {
                    edges.push(self.edge(
                        *from.min(to),
                        *from.max(to),
                        GraphRelation::NextTo,
                        *score,
                    ));
                }
            }
        }
        edges.into_iter().flatten().collect()
    }

    /// Returns the floor under the middle of an instance. Of several, returns the one that more of
    /// it stands over.
    fn floor_below(&self, instance: &Instance) -> Option<InstanceId> {
        let own = &self.solids[&instance.id];
        let floors = self
            .scene
            .instances
            .iter()
            .filter(|i| i.structure == Some(Structure::Floor) && self.known.contains(&i.id));
        let over = floors.map(|floor| (own.footprint_overlap(&self.solids[&floor.id]), floor.id));
        over.max_by(|a, b| a.0.total_cmp(&b.0).then(b.1.cmp(&a.1))).map(|(_, floor)| floor)
    }

    /// Returns an edge if the graph has both instances.
    fn edge(
        &self,
        from: InstanceId,
        to: InstanceId,
        relation: GraphRelation,
        score: f32,
    ) -> Option<Edge> {
        let (a, b) = (self.solids.get(&from)?, self.solids.get(&to)?);
        Some(Edge { from, to, relation, score, distance_m: a.gap(b) })
    }
}

/// The measured relation of one instance to another, with its score.
enum Measured {
    Inside(f32),
    Around(f32),
    Above(f32),
    Below(f32),
    Beside(f32),
}

/// Returns the most specific relation of two instances.
fn measure(a: &Solid, b: &Solid) -> Option<Measured> {
    // No relation reaches further than this, and most pairs of a hall are further apart.
    let reach_m = a.diagonal() + b.diagonal() + 1.0;
    if (a.center - b.center).xy().norm() > reach_m {
        return None;
    }
    let inside = |held: &Solid, holder: &Solid| {
        if holder.volume() > HOLDER_VOLUME * held.volume() {
            relations::inside(held, holder)
        } else {
            0.0
        }
    };
    // Instances that are beside each other overlap in height, or nearly: a lamp at the ceiling is
    // not next to a chair.
    if a.vertical_gap(b) <= STEP_M {
        return match (inside(a, b), inside(b, a), relations::near(a, b)) {
            (score, _, _) if score >= MOSTLY => Some(Measured::Inside(score)),
            (_, score, _) if score >= MOSTLY => Some(Measured::Around(score)),
            (_, _, score) => (score >= HOLDS).then_some(Measured::Beside(score)),
        };
    }
    match (relations::above(a, b), relations::above(b, a)) {
        (score, _) if score >= HOLDS => Some(Measured::Above(score)),
        (_, score) if score >= HOLDS => Some(Measured::Below(score)),
        _ => None,
    }
}

/// Returns the best of others, in descending order.
fn best(
    mut others: Vec<(f32, InstanceId)>,
    most: usize,
) -> impl Iterator<Item = (f32, InstanceId)> {
    others.sort_by(|a, b| b.0.total_cmp(&a.0).then(a.1.cmp(&b.1)));
    others.into_iter().take(most)
}

#[cfg(test)]
mod tests;
