//! Class-agnostic object instances (paper: Global Candidate Filtering).

use super::FrameIndex;
use crate::geometry::boxes::{Aabb, OrientedBox};
use crate::geometry::colour::ColourHistogram;
use serde::{Deserialize, Serialize};
use utoipa::ToSchema;

/// Number of an instance within its scene, counted from 1 in falling order of points.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord, Serialize, Deserialize, ToSchema)]
#[serde(transparent)]
pub struct InstanceId(pub u32);

impl std::fmt::Display for InstanceId {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        self.0.fmt(f)
    }
}

/// Part of the building rather than an object in it.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
#[serde(rename_all = "snake_case")]
pub enum Structure {
    Floor,
    Ceiling,
    Wall,
}

impl Structure {
    #[must_use]
    pub fn word(self) -> &'static str {
        match self {
            Self::Floor => "floor",
            Self::Ceiling => "ceiling",
            Self::Wall => "wall",
        }
    }
}

/// What an instance rests on.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
#[serde(tag = "on", rename_all = "snake_case")]
pub enum Support {
    Floor,
    Instance {
        id: InstanceId,
    },
    Wall {
        id: InstanceId,
    },
    /// Nothing below or behind it was found.
    Nothing,
}

impl std::fmt::Display for Support {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Self::Floor => f.write_str("floor"),
            Self::Instance { id } => write!(f, "instance {id}"),
            Self::Wall { id } => write!(f, "wall {id}"),
            Self::Nothing => f.write_str("nothing found"),
        }
    }
}

/// A picture that shows an instance well.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct View {
    pub frame: FrameIndex,
    /// Points of the instance visible in this frame.
    pub visible_points: u32,
    /// Tight box of the visible points in the colour picture: left, top, right, bottom, pixels.
    pub box_px: [u32; 4],
}

/// A name the encoder would give without having heard a question.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct NameGuess {
    pub name: String,
    /// How well the name fits and how usual such a thing is, `0..=1`.
    pub score: f32,
}

/// One object candidate. Lengths in metres, world frame (Z up).
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Instance {
    pub id: InstanceId,
    /// Axis-aligned box of the robust bounds: stray points do not stretch it.
    pub aabb: Aabb,
    /// Axis-aligned box of every point.
    pub raw_box: Aabb,
    pub oriented_box: OrientedBox,
    pub point_count: u32,
    /// Mean 8-bit sRGB.
    pub mean_rgb: [u8; 3],
    pub colours: ColourHistogram,
    /// Share of the points within 3 cm of the best plane, `0..=1`.
    pub planarity: f32,
    pub structure: Option<Structure>,
    pub support: Support,
    /// Height of the lowest robust point above the floor.
    pub height_above_floor_m: f32,
    /// Best views first; empty for a scan without frames.
    pub views: Vec<View>,
    /// Best names first; empty when the encoder has no opinion.
    pub names: Vec<NameGuess>,
    /// What somebody who has seen it calls it; trumps what the encoder makes of its measures.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub given_name: Option<String>,
}

impl Instance {
    /// What to call it when talking to people: its given name, its structure, its best name, or just "object".
    #[must_use]
    pub fn label(&self) -> &str {
        match (&self.given_name, self.structure, self.names.first()) {
            (Some(name), _, _) => name,
            (None, Some(structure), _) => structure.word(),
            (None, None, Some(guess)) => &guess.name,
            (None, None, None) => "object",
        }
    }
}
