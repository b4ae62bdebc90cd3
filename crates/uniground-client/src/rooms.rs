//! Imports, approach poses, floor maps and scene graphs.

use super::{Client, ClientError, json};
use reqwest::Method;
use uniground_types::approach::{Approach, ApproachRequest, FloorMap};
use uniground_types::graph::SceneGraph;
use uniground_types::instances::Levels;
use uniground_types::scenes::{Created, ImportRequest};

impl Client {
    /// Creates a scene from a scan on the server's disk.
    ///
    /// # Errors
    /// [`ClientError`].
    pub async fn import_scene(&self, request: &ImportRequest) -> Result<Created, ClientError> {
        json(self.request(Method::POST, "v1/scenes/import").json(request)).await
    }

    /// Returns poses from which a robot can see or reach an object.
    ///
    /// # Errors
    /// [`ClientError`].
    pub async fn approach(
        &self,
        scene_id: &str,
        request: &ApproachRequest,
    ) -> Result<Approach, ClientError> {
        json(self.request(Method::POST, &format!("v1/scenes/{scene_id}/approach")).json(request))
            .await
    }

    /// Returns the map of a scene's floor. Its picture is at `/v1/scenes/{id}/floor.png`. Anything
    /// higher than `height_m` above the floor is not an obstacle.
    ///
    /// # Errors
    /// [`ClientError`].
    pub async fn floor(&self, scene_id: &str, height_m: f32) -> Result<FloorMap, ClientError> {
        json(
            self.request(Method::GET, &format!("v1/scenes/{scene_id}/floor"))
                .query(&[("height_m", height_m)]),
        )
        .await
    }

    /// Returns a scene's instances and the relations between them.
    ///
    /// # Errors
    /// [`ClientError`].
    pub async fn graph(&self, scene_id: &str, levels: Levels) -> Result<SceneGraph, ClientError> {
        json(
            self.request(Method::GET, &format!("v1/scenes/{scene_id}/graph"))
                .query(&[("level", levels)]),
        )
        .await
    }
}
