//! Exports the contents of a room as annotations of an evaluation: `<scene>.scene.json`.

use crate::CorrectionService;
use crate::error::Error;
use serde::Serialize;
use uniground_geometry::boxes::OrientedBox;
use uniground_geometry::scene::{Instance, Level};
use utoipa::ToSchema;

/// Objects of a scene, in the format of annotations for `uniground eval`.
#[derive(Debug, Serialize, ToSchema)]
pub struct GroundTruth {
    /// UUIDv7 of the scene.
    pub scene_id: String,
    /// In order of id.
    objects: Vec<TrueObject>,
}

/// An object. Meters, world frame of the scene (Z up).
#[derive(Debug, Serialize, ToSchema)]
struct TrueObject {
    /// Id of the instance.
    id: u32,
    /// Name of the object.
    name: String,
    /// Lowest corner.
    min: [f32; 3],
    /// Highest corner.
    max: [f32; 3],
    /// Box rotated about the vertical axis to fit the object.
    obb: TurnedBox,
    /// Whether a correction renamed or merged it.
    corrected: bool,
}

/// A box rotated about the vertical axis.
#[derive(Debug, Serialize, ToSchema)]
struct TurnedBox {
    center: [f32; 3],
    size: [f32; 3],
    /// Counter-clockwise from above, degrees.
    yaw_deg: f32,
}

impl CorrectionService {
    /// Returns the objects of a scene's current parse with corrections applied. Excludes floor,
    /// walls and ceiling.
    ///
    /// # Errors
    /// [`Error::SceneNotFound`], [`Error::SceneNotReady`].
    pub async fn ground_truth(&self, scene_id: &str) -> Result<GroundTruth, Error> {
        let (_, parse_id) = self.scene_lookup.ready_scene(scene_id).await?;
        let parse = self.parsed_scenes.loaded_parse(&parse_id).await?;
        let is_thing =
            |i: &&Instance| i.level == Level::Thing && i.structure.is_none() && !i.dismissed;
        let object = |instance: &Instance| {
            let OrientedBox { center, size, yaw_rad } = instance.oriented_box;
            TrueObject {
                id: instance.id.0,
                name: instance.label().to_owned(),
                min: instance.aabb.min().into(),
                max: instance.aabb.max().into(),
                obb: TurnedBox {
                    center: center.into(),
                    size: size.into(),
                    yaw_deg: yaw_rad.to_degrees(),
                },
                corrected: parse.renamed.contains_key(&instance.id.0)
                    || !instance.merged_from.is_empty(),
            }
        };
        Ok(GroundTruth {
            scene_id: scene_id.to_owned(),
            objects: parse.instances.iter().filter(is_thing).map(object).collect(),
        })
    }
}
