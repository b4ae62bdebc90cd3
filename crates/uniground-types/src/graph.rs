//! Scene graphs: the instances of a scene and the relations between them.

use crate::answer::CoordinateFrame;
use crate::geometry::boxes::{Aabb, OrientedBox};
use crate::scene::InstanceId;
use serde::{Deserialize, Serialize};

/// A scene graph: objects, parts, wholes, building elements and zones, with the relations between
/// them. Meters, world frame (Z up).
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct SceneGraph {
    /// UUIDv7 of the scene.
    pub scene_id: String,
    /// Version of the scene's parse, from 1. Instance ids belong to it.
    pub parse_version: u32,
    /// The coordinate frame of all coordinates.
    pub frame: CoordinateFrame,
    /// Nodes ordered by instance id, then zones.
    pub nodes: Vec<GraphNode>,
    /// Edges in the order of their nodes. A symmetric relation is listed once, and inverse
    /// relations are omitted.
    pub edges: Vec<GraphEdge>,
}

/// A node of the graph.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct GraphNode {
    /// Node id: `i12` for instance 12, `z1` for the first zone.
    #[cfg_attr(feature = "openapi", schema(example = "i12"))]
    pub id: String,
    /// Kind of node.
    pub kind: NodeKind,
    /// Name: "red sofa", "wall", "kitchen".
    pub name: String,
    /// Id of the instance. `null` for zones.
    pub instance_id: Option<InstanceId>,
    /// Axis-aligned box, meters. The box of a zone encloses the objects that define it.
    #[serde(rename = "box")]
    pub aabb: Aabb,
    /// Box rotated about the vertical axis. `null` for zones.
    pub oriented_box: Option<OrientedBox>,
}

/// Kind of node.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(rename_all = "snake_case")]
pub enum NodeKind {
    /// An object. Each point of the scan belongs to at most one.
    Thing,
    /// A part of an object.
    Part,
    /// A group of objects that forms one unit.
    Whole,
    /// Floor, wall or ceiling.
    Structure,
    /// An area of a room that is defined by its objects: a kitchen contains a stove and a
    /// refrigerator.
    Zone,
}

/// A relation between two nodes: `from` has the relation to `to`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct GraphEdge {
    /// `id` of a node.
    #[cfg_attr(feature = "openapi", schema(example = "i31"))]
    pub from: String,
    /// `id` of another node.
    #[cfg_attr(feature = "openapi", schema(example = "i12"))]
    pub to: String,
    /// The relation.
    pub relation: GraphRelation,
    /// Geometric score of the relation, `0..=1`. 1 for relations from the parse itself (support,
    /// parts).
    pub score: f32,
    /// Shortest distance between the two boxes, meters. 0 if they touch.
    pub distance_m: f32,
}

/// A relation between two nodes.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(rename_all = "snake_case")]
pub enum GraphRelation {
    /// It is a part of the other node. Objects are parts of a whole.
    PartOf,
    /// It stands or lies on the other node or on the floor.
    On,
    /// It hangs on a wall.
    OnWall,
    /// It is inside the other node.
    Inside,
    /// It is above the other node without contact.
    Above,
    /// It is next to the other node. Symmetric.
    NextTo,
    /// It is in a zone.
    InZone,
}

impl GraphRelation {
    /// Returns the name in JSON, like `next_to`.
    #[must_use]
    pub fn as_str(self) -> &'static str {
        match self {
            Self::PartOf => "part_of",
            Self::On => "on",
            Self::OnWall => "on_wall",
            Self::Inside => "inside",
            Self::Above => "above",
            Self::NextTo => "next_to",
            Self::InZone => "in_zone",
        }
    }
}

impl NodeKind {
    /// Returns the name in JSON.
    #[must_use]
    pub fn as_str(self) -> &'static str {
        match self {
            Self::Thing => "thing",
            Self::Part => "part",
            Self::Whole => "whole",
            Self::Structure => "structure",
            Self::Zone => "zone",
        }
    }
}

/// Format of a scene graph.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(rename_all = "snake_case")]
pub enum GraphFormat {
    /// [`SceneGraph`] as JSON.
    #[default]
    Json,
    /// `GraphML`, for tools that draw and analyze graphs.
    Graphml,
    /// Compact text with one line per object, for language models.
    Text,
}
