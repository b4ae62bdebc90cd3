//! Instances of a scene as the API returns them.

use crate::geometry::boxes::{Aabb, OrientedBox};
use crate::scene::{InstanceId, Level, NameGuess, Structure, Support, View};
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;

/// One instance. Lengths in meters, world frame (Z up).
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct InstanceView {
    /// Id within the parse, from 1: objects by descending number of points, then parts and wholes.
    /// Another parse assigns new ids. Adding frames to a scene keeps the ids of existing objects
    /// and appends new ones.
    pub id: InstanceId,
    /// Level: an object, a part of one, or a whole of several.
    #[serde(default)]
    pub level: Level,
    /// For a part, the object that contains it. For a whole, its objects. Empty for objects.
    #[serde(default)]
    pub things: Vec<InstanceId>,
    /// Name of the object, independent of any question.
    pub label: String,
    /// Axis-aligned box without outlier points.
    #[serde(rename = "box")]
    pub aabb: Aabb,
    /// Axis-aligned box of all points, including outliers.
    pub raw_box: Aabb,
    /// Box without outlier points, rotated about the vertical axis to the smallest footprint.
    pub oriented_box: OrientedBox,
    /// Number of points.
    pub point_count: u32,
    /// Mean color, 8-bit sRGB.
    pub mean_rgb: [u8; 3],
    /// Share of the points per color name, `0..=1`. Omits colors below 10 %.
    pub colours: BTreeMap<String, f32>,
    /// Share of the points within 3 cm of the best-fitting plane, `0..=1`.
    pub planarity: f32,
    /// Set for building elements: floor, wall or ceiling.
    pub structure: Option<Structure>,
    /// What the object stands on or hangs on.
    pub support: Support,
    /// Height of the bottom of `box` above the floor, meters. Negative if below the floor.
    pub height_above_floor_m: f32,
    /// Name guesses, best first, at most five. Empty for building elements, and if no name fits.
    pub names: Vec<NameGuess>,
    /// Name from the configured vision-language model, independent of any question. `null` if the
    /// model has not named it.
    #[serde(default)]
    pub model_name: Option<String>,
    /// Name set by a user. `null` if not set.
    #[serde(default)]
    pub given_name: Option<String>,
    /// Whether a user dismissed it as no object, or merged or split it. Dismissed instances are no
    /// answers and are listed only with `level=all`.
    #[serde(default)]
    pub dismissed: bool,
    /// Whether the object was in an earlier version and is gone after frames were added. Its id is
    /// not reused, and it is also dismissed.
    #[serde(default)]
    pub gone: bool,
    /// Ids of the instances that a user merged into this one. Empty for instances of the parse.
    #[serde(default)]
    pub merged_from: Vec<InstanceId>,
    /// Question for which a vision-language model found this instance in a photograph. `null` for
    /// instances of the parse.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub found_for: Option<String>,
    /// Time of the newest frame that shows it, RFC 3339 UTC. `null` if the scan's frames have no
    /// times since 1970, and for parses from older versions.
    #[serde(default)]
    pub last_seen: Option<String>,
    /// Best views. Their pictures are at `/instances/{id}/views/{k}.jpg` with k from 0.
    pub views: Vec<View>,
}

/// A page of a scene's instances.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct InstanceList {
    /// Instances, ordered by id.
    pub instances: Vec<InstanceView>,
    /// Cursor of the next page. `null` on the last page.
    pub next_cursor: Option<u32>,
}

/// Filter for the level of instances.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(rename_all = "snake_case")]
pub enum Levels {
    /// Objects only. Each point belongs to at most one.
    #[default]
    Things,
    /// Parts of objects only.
    Parts,
    /// Wholes only: groups of objects that form one unit.
    Wholes,
    /// All levels, including dismissed instances.
    All,
}

impl Levels {
    /// Returns whether an instance is listed. Dismissed instances are listed only with `All`.
    #[must_use]
    pub fn includes(self, level: Level, dismissed: bool) -> bool {
        match self {
            Self::All => true,
            _ if dismissed => false,
            Self::Things => level == Level::Thing,
            Self::Parts => level == Level::Part,
            Self::Wholes => level == Level::Whole,
        }
    }
}

/// Kind of picture of a view.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(rename_all = "snake_case")]
pub enum ViewPicture {
    /// The full frame with the object outlined and a red box around it.
    #[default]
    Frame,
    /// A crop with the object outlined and its surroundings darkened.
    Crop,
}
