//! A scene with what was found in it, as a file.

use crate::answer::CoordinateFrame;
use crate::instances::InstanceView;
use serde::{Deserialize, Serialize};

/// Points of a file, where nothing else is said.
pub const DEFAULT_POINTS: u32 = 500_000;
/// Most points of a file.
pub const MAX_POINTS: u32 = 2_000_000;

/// What a scene can be written as.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(rename_all = "snake_case")]
pub enum ExportFormat {
    /// glTF 2.0, binary: a node for each thing, with its points and its box.
    Glb,
    /// Points in their own colours, each with the id of its thing.
    Ply,
    /// USD, one layer of text in an uncompressed archive: a prim for each thing, with its points
    /// and its box.
    Usdz,
    /// What was found, without points.
    Json,
}

impl ExportFormat {
    /// How names of such files end, without the dot.
    #[must_use]
    pub fn extension(self) -> &'static str {
        match self {
            Self::Glb => "glb",
            Self::Ply => "ply",
            Self::Usdz => "usdz",
            Self::Json => "json",
        }
    }

    /// What such a file is sent as.
    #[must_use]
    pub fn media_type(self) -> &'static str {
        match self {
            Self::Glb => "model/gltf-binary",
            Self::Ply => "application/octet-stream",
            Self::Usdz => "model/vnd.usdz+zip",
            Self::Json => "application/json",
        }
    }
}

/// What was found in a scene, as corrected.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct ExportedScene {
    /// UUIDv7.
    pub scene_id: String,
    /// What the scene is called.
    pub name: String,
    /// Which parse the instances are of: counted from 1, one more whenever the scene is parsed
    /// again.
    pub parse_version: u32,
    /// The frame of all coordinates.
    pub frame: CoordinateFrame,
    /// Things, floor, walls and ceiling among them, then parts and wholes, in order of id; what
    /// was dismissed is left out.
    pub instances: Vec<InstanceView>,
}
