//! Adding frames to scenes, and changes of scenes.

use super::{Client, ClientError, json};
use reqwest::Method;
use uniground_types::changes::SceneChanges;
use uniground_types::placement::FrameChoice;
use uniground_types::scenes::Created;

impl Client {
    /// Adds frames to a scene: an archive of pictures with depth and poses. The poses are in the
    /// coordinate frame `world`. Follow the returned job to wait until the scene includes them.
    ///
    /// # Errors
    /// [`ClientError`].
    pub async fn add_frames(
        &self,
        scene_id: &str,
        world: FrameChoice,
        frames: impl Into<reqwest::Body>,
    ) -> Result<Created, ClientError> {
        let request = self
            .request(Method::POST, &format!("v1/scenes/{scene_id}/frames"))
            .query(&[("world", world)])
            .header("content-type", "application/octet-stream")
            .body(frames);
        json(request).await
    }

    /// Returns what changed in a scene since an earlier version.
    ///
    /// # Errors
    /// [`ClientError`].
    pub async fn changes_since(
        &self,
        scene_id: &str,
        since: u32,
    ) -> Result<SceneChanges, ClientError> {
        json(
            self.request(Method::GET, &format!("v1/scenes/{scene_id}/changes"))
                .query(&[("since", since)]),
        )
        .await
    }

    /// Returns the differences to another scan of the same room. `align` registers the two clouds
    /// first.
    ///
    /// # Errors
    /// [`ClientError`].
    pub async fn changes_to(
        &self,
        scene_id: &str,
        to: &str,
        align: bool,
    ) -> Result<SceneChanges, ClientError> {
        let query = [("to", to), ("align", if align { "true" } else { "false" })];
        json(self.request(Method::GET, &format!("v1/scenes/{scene_id}/changes")).query(&query))
            .await
    }
}
