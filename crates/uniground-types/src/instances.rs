//! Objects found in a scene, as callers see them.

use crate::geometry::boxes::{Aabb, OrientedBox};
use crate::scene::{InstanceId, Level, NameGuess, Structure, Support, View};
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;

/// One object candidate. Lengths in metres, world frame (Z up).
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct InstanceView {
    /// Numbered from 1 within the parse: things in falling order of points, then parts and wholes;
    /// another parse numbers anew, but for scenes that have grown: what stays keeps its id
    /// there, and what comes is numbered on.
    pub id: InstanceId,
    /// A thing, a part of one, or a whole of several.
    #[serde(default)]
    pub level: Level,
    /// The thing a part lies in; the things a whole is made of; empty for things.
    #[serde(default)]
    pub things: Vec<InstanceId>,
    /// What the encoder would call it, without having heard a question.
    pub label: String,
    /// Axis-aligned box of the robust bounds.
    #[serde(rename = "box")]
    pub aabb: Aabb,
    /// Axis-aligned box of every point, strays included.
    pub raw_box: Aabb,
    /// Box of the robust bounds, turned about the vertical so that its footprint is smallest.
    pub oriented_box: OrientedBox,
    /// Points of the cloud that belong to it.
    pub point_count: u32,
    /// Mean 8-bit sRGB.
    pub mean_rgb: [u8; 3],
    /// Share of the points per colour name, those of 10 % and more.
    pub colours: BTreeMap<String, f32>,
    /// Share of the points within 3 cm of the best plane.
    pub planarity: f32,
    /// Set for parts of the building.
    pub structure: Option<Structure>,
    /// What it stands on or hangs on.
    pub support: Support,
    /// Metres from the floor to the bottom of `box`; negative where it reaches below.
    pub height_above_floor_m: f32,
    /// Best first, at most five; empty for parts of the building, and where nothing fits.
    pub names: Vec<NameGuess>,
    /// What the configured vision-language model calls it, without having heard a question; `null`
    /// until it was asked.
    #[serde(default)]
    pub model_name: Option<String>,
    /// What somebody has said it is called; `null` where nobody has.
    #[serde(default)]
    pub given_name: Option<String>,
    /// Somebody has said that it is no thing, or not one: no answer, and listed only with
    /// `level=all`.
    #[serde(default)]
    pub dismissed: bool,
    /// Of a scene that has grown: it was there in an earlier version. Its id is never another's;
    /// dismissed as well.
    #[serde(default)]
    pub gone: bool,
    /// The instances that somebody has said are one thing, this one; empty for what the parse has
    /// found.
    #[serde(default)]
    pub merged_from: Vec<InstanceId>,
    /// The question it was found for: a vision-language model saw it in a photograph, and it was
    /// no instance yet. `null` for what the parse has found.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub found_for: Option<String>,
    /// Frames that show it best; pictures at `/instances/{id}/views/{k}.jpg`, k from 0.
    pub views: Vec<View>,
}

/// One page of a scene's instances.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct InstanceList {
    /// In order of id.
    pub instances: Vec<InstanceView>,
    /// Pass as `cursor` for the next page; `null` on the last.
    pub next_cursor: Option<u32>,
}

/// Which instances to list.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(rename_all = "snake_case")]
pub enum Levels {
    /// The pieces the scene is cut into: each point is in one or none.
    #[default]
    Things,
    /// Pieces of things that masks show by themselves.
    Parts,
    /// Several things that masks show as one.
    Wholes,
    /// All of them, those that were dismissed as well.
    All,
}

impl Levels {
    /// Whether an instance of this level is listed; what was dismissed is only among all.
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

/// Which picture of a view.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(rename_all = "snake_case")]
pub enum ViewPicture {
    /// The full frame: the object outlined, with a red box around it.
    #[default]
    Frame,
    /// A crop: the object outlined, its surroundings darker.
    Crop,
}
