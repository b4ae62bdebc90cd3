//! What is in a room and where one can stand in it.

use super::{Client, ClientError, json};
use reqwest::Method;
use uniground_types::approach::{Approach, ApproachRequest, FloorMap};
use uniground_types::graph::SceneGraph;
use uniground_types::instances::Levels;
use uniground_types::scenes::{Created, ImportRequest};

impl Client {
    /// Makes a scene of a scan on the server's own disk.
    ///
    /// # Errors
    /// [`ClientError`].
    pub async fn import_scene(&self, request: &ImportRequest) -> Result<Created, ClientError> {
        json(self.request(Method::POST, "v1/scenes/import").json(request)).await
    }

    /// Where a robot can stand to see or reach a thing.
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

    /// The map of a scene's floor; its picture is at `/v1/scenes/{id}/floor.png`. What is higher
    /// above it than `height_m` is no obstacle.
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

    /// What is in a scene and how it stands to each other.
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
