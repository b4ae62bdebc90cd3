//! Class-agnostic object instances (paper: Global Candidate Filtering).

use super::{InstanceId, Level, NameGuess, Structure, Support, View};
use crate::boxes::{Aabb, OrientedBox};
use crate::color::ColorHistogram;
use serde::{Deserialize, Serialize};

/// One object candidate. Lengths in meters, world frame (Z up).
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Instance {
    /// Counted from 1: things in descending order of points, then parts and wholes, the most
    /// visible first.
    pub id: InstanceId,
    /// A thing, a part of one, or a whole of several.
    #[serde(default)]
    pub level: Level,
    /// For a part: the thing it belongs to. For a whole: the things it consists of. Empty for
    /// things.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub things: Vec<InstanceId>,
    /// Axis-aligned box of the robust bounds, without outliers.
    pub aabb: Aabb,
    /// Axis-aligned box of every point.
    pub raw_box: Aabb,
    /// Box of the robust bounds, rotated about Z so that its footprint is smallest.
    pub oriented_box: OrientedBox,
    /// Number of points, outliers included.
    pub point_count: u32,
    /// Mean 8-bit sRGB.
    pub mean_rgb: [u8; 3],
    /// Shares of the color names among its points.
    #[serde(rename = "colours")]
    pub colors: ColorHistogram,
    /// Share of the points within 3 cm of the best plane, `0..=1`.
    pub planarity: f32,
    /// Floor, ceiling or wall; `None` for an object.
    pub structure: Option<Structure>,
    /// What it rests on or hangs from.
    pub support: Support,
    /// Height of the lowest robust point above the floor, meters.
    pub height_above_floor_m: f32,
    /// Best views first; empty for a scan without frames.
    pub views: Vec<View>,
    /// Best names first; empty when the encoder finds none.
    pub names: Vec<NameGuess>,
    /// Name given by a vision-language model or a person; takes precedence over the names of the
    /// encoder.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub given_name: Option<String>,
    /// The question for which it was found in a photograph; `None` for instances of stage 1.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub found_for: Option<String>,
    /// The instances that a person merged into this one; empty for instances of stage 1.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub merged_from: Vec<InstanceId>,
    /// Whether a person dismissed it as not being one object. It then matches no question.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub dismissed: bool,
    /// Whether the object no longer exists, in a scene that has grown. It stays in the list,
    /// dismissed, so that its id is never reused.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub gone: bool,
}

impl Instance {
    /// Creates an object with this box and default values: no points, views or names, black,
    /// supported by nothing, at height 0.
    #[must_use]
    pub fn from_box(id: InstanceId, aabb: Aabb) -> Self {
        Self {
            id,
            level: Level::Thing,
            things: Vec::new(),
            aabb,
            raw_box: aabb,
            oriented_box: aabb.into(),
            point_count: 0,
            mean_rgb: [0; 3],
            colors: ColorHistogram::default(),
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

    /// Returns whether it was created after the parse: for a question, or by merging others.
    #[must_use]
    pub fn is_added_after_parse(&self) -> bool {
        self.found_for.is_some() || !self.merged_from.is_empty()
    }

    /// Returns whether it is a thing that was not dismissed.
    #[must_use]
    pub fn is_shown(&self) -> bool {
        self.level == Level::Thing && !self.dismissed
    }

    /// Returns the name to show to people: the given name, the structure, the best name, or
    /// "object".
    #[must_use]
    pub fn label(&self) -> &str {
        match (&self.given_name, self.structure, self.names.first()) {
            (Some(name), _, _) => name,
            (None, Some(structure), _) => structure.as_str(),
            (None, None, Some(guess)) => &guess.name,
            (None, None, None) => "object",
        }
    }
}
