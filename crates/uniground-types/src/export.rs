//! Export of a scene and its instances as a file.

use crate::answer::CoordinateFrame;
use crate::instances::InstanceView;
use serde::{Deserialize, Serialize};

/// Default number of points in a file.
pub const DEFAULT_POINTS: u32 = 500_000;
/// Maximum number of points in a file.
pub const MAX_POINTS: u32 = 2_000_000;

/// File format of an export.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(rename_all = "snake_case")]
pub enum ExportFormat {
    /// glTF 2.0 binary with a node for each object, its points and its box.
    Glb,
    /// Points with their colors and the ids of their objects.
    Ply,
    /// USD, one text layer in an uncompressed archive, with a prim for each object, its points and
    /// its box.
    Usdz,
    /// The instances, without points.
    Json,
}

impl ExportFormat {
    /// Returns the file name extension without the dot.
    #[must_use]
    pub fn extension(self) -> &'static str {
        match self {
            Self::Glb => "glb",
            Self::Ply => "ply",
            Self::Usdz => "usdz",
            Self::Json => "json",
        }
    }

    /// Returns the media type.
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

/// The instances of a scene, with corrections applied.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct ExportedScene {
    /// UUIDv7.
    pub scene_id: String,
    /// Name of the scene.
    pub name: String,
    /// Version of the parse of the instances, from 1. Each new parse increments it.
    pub parse_version: u32,
    /// The coordinate frame of all coordinates.
    pub frame: CoordinateFrame,
    /// Objects including floor, walls and ceiling, then parts and wholes, ordered by id. Excludes
    /// dismissed instances.
    pub instances: Vec<InstanceView>,
}
