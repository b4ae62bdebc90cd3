//! What is in a scene and how it stands to each other, as a graph.

use crate::answer::CoordinateFrame;
use crate::geometry::boxes::{Aabb, OrientedBox};
use crate::scene::InstanceId;
use serde::{Deserialize, Serialize};

/// A scene graph: things, parts, wholes, the building and zones, and relations between them.
/// Metres, world frame (Z up).
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct SceneGraph {
    /// UUIDv7 of the scene.
    pub scene_id: String,
    /// Number of the scene's parse, from 1; instance ids belong to it.
    pub parse_version: u32,
    /// The frame of all coordinates.
    pub frame: CoordinateFrame,
    /// In order of instance id, then zones.
    pub nodes: Vec<GraphNode>,
    /// In order of their nodes. What goes without saying is left out: a symmetric relation stands
    /// once, and no relation has its inverse.
    pub edges: Vec<GraphEdge>,
}

/// Something in the scene.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct GraphNode {
    /// `i12` for instance 12, `z1` for the first zone.
    #[cfg_attr(feature = "openapi", schema(example = "i12"))]
    pub id: String,
    /// What kind of node it is.
    pub kind: NodeKind,
    /// What it is called: "red sofa", "wall", "kitchen".
    pub name: String,
    /// The instance; `null` for zones.
    pub instance_id: Option<InstanceId>,
    /// Axis-aligned box; of a zone, around the things that make it.
    #[serde(rename = "box")]
    pub aabb: Aabb,
    /// Box turned about the vertical to fit it; `null` for zones.
    pub oriented_box: Option<OrientedBox>,
}

/// What kind of node it is.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(rename_all = "snake_case")]
pub enum NodeKind {
    /// Something one would name: each point of the scan is in one or none.
    Thing,
    /// A piece of a thing.
    Part,
    /// Several things that are seen as one.
    Whole,
    /// Floor, wall or ceiling.
    Structure,
    /// A stretch of a room that is told by what stands there: a kitchen is where stove and
    /// refrigerator are.
    Zone,
}

/// What holds between two nodes: `from` stands in the relation to `to`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct GraphEdge {
    /// A node's `id`.
    #[cfg_attr(feature = "openapi", schema(example = "i31"))]
    pub from: String,
    /// Another node's `id`.
    #[cfg_attr(feature = "openapi", schema(example = "i12"))]
    pub to: String,
    /// What holds.
    pub relation: GraphRelation,
    /// How well it holds by the geometry that answers questions, `0..=1`; 1 for what the parse
    /// itself says (support, parts).
    pub score: f32,
    /// Shortest distance between the two boxes, metres; 0 where they touch.
    pub distance_m: f32,
}

/// A relation of the graph.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(rename_all = "snake_case")]
pub enum GraphRelation {
    /// It is a part of the other; things are parts of a whole.
    PartOf,
    /// It stands or lies on the other, or on the floor.
    On,
    /// It hangs on a wall.
    OnWall,
    /// It is within the other.
    Inside,
    /// It hangs or stands above the other without touching it.
    Above,
    /// It is near the other, beside it; symmetric.
    NextTo,
    /// It is in a zone.
    InZone,
}

impl GraphRelation {
    /// Its name in data: `next_to`.
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
    /// Its name in data.
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

/// How a graph is written.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(rename_all = "snake_case")]
pub enum GraphFormat {
    /// [`SceneGraph`] as JSON.
    #[default]
    Json,
    /// `GraphML`, for programs that draw and analyse graphs.
    Graphml,
    /// A line for each thing, short: to be shown to a language model.
    Text,
}
