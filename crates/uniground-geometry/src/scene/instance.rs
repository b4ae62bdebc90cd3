//! Class-agnostic object instances (paper: Global Candidate Filtering).

use super::{InstanceId, Level, NameGuess, Structure, Support, View};
use crate::boxes::{Aabb, OrientedBox};
use crate::colour::ColourHistogram;
use serde::{Deserialize, Serialize};

/// One object candidate. Lengths in metres, world frame (Z up).
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Instance {
    /// Counted from 1: things in falling order of points, then parts and wholes, best shown first.
    pub id: InstanceId,
    /// A thing, a part of one, or a whole of several.
    #[serde(default)]
    pub level: Level,
    /// The thing a part lies in; the things a whole is made of; empty for things.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub things: Vec<InstanceId>,
    /// Axis-aligned box of the robust bounds: stray points do not stretch it.
    pub aabb: Aabb,
    /// Axis-aligned box of every point.
    pub raw_box: Aabb,
    /// Box of the robust bounds, turned about Z so that its footprint is smallest.
    pub oriented_box: OrientedBox,
    /// All its points, strays included.
    pub point_count: u32,
    /// Mean 8-bit sRGB.
    pub mean_rgb: [u8; 3],
    /// Shares of the colour names among its points.
    pub colours: ColourHistogram,
    /// Share of the points within 3 cm of the best plane, `0..=1`.
    pub planarity: f32,
    /// Floor, ceiling or wall; `None` for an object.
    pub structure: Option<Structure>,
    /// What it rests on or hangs at.
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
    /// The question it was found for, when somebody saw it in a photograph; `None` for what stage
    /// 1 has found.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub found_for: Option<String>,
    /// The instances that somebody has said are one thing, this one; empty for what stage 1 has
    /// found.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub merged_from: Vec<InstanceId>,
    /// Somebody has said that it is no thing, or not one: it fits nothing.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub dismissed: bool,
    /// Of a scene that has grown: it was there once. Kept, dismissed, so that its id is never
    /// another's.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub gone: bool,
}

impl Instance {
    /// An object with this box, of which nothing else is known: no points, views or names, black,
    /// supported by nothing and lying at height 0.
    #[must_use]
    pub fn from_box(id: InstanceId, aabb: Aabb) -> Self {
        Self {
            id,
            level: Level::Thing,
            things: Vec::new(),
            aabb,
            raw_box: aabb,
            oriented_box: OrientedBox { center: aabb.center, size: aabb.size, yaw_rad: 0.0 },
            point_count: 0,
            mean_rgb: [0; 3],
            colours: ColourHistogram::default(),
            planarity: 0.0,
            structure: None,
            support: Support::Nothing,
            height_above_floor_m: 0.0,
            views: Vec::new(),
            names: Vec::new(),
            given_name: None,
            found_for: None,
            merged_from: Vec::new(),
            dismissed: false,
            gone: false,
        }
    }

    /// Whether it was made after the parse: for a question, or of others that are one thing.
    #[must_use]
    pub fn came_later(&self) -> bool {
        self.found_for.is_some() || !self.merged_from.is_empty()
    }

    /// Whether it is a thing that nobody has dismissed.
    #[must_use]
    pub fn is_shown(&self) -> bool {
        self.level == Level::Thing && !self.dismissed
    }

    /// What to call it when talking to people: its given name, its structure, its best name, or
    /// just "object".
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
