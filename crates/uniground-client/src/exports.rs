//! Scenes as files.

use crate::{Client, ClientError, checked, json};
use reqwest::{Method, RequestBuilder};
use uniground_types::export::{ExportFormat, ExportedScene};

impl Client {
    /// A scene with what was found in it, as a file with at most so many points; as many as the
    /// server thinks right where not said.
    ///
    /// # Errors
    /// [`ClientError`].
    pub async fn export(
        &self,
        scene_id: &str,
        format: ExportFormat,
        points: Option<u32>,
    ) -> Result<Vec<u8>, ClientError> {
        let request = self.export_request(scene_id, format).query(&[("points", points)]);
        Ok(checked(request.send().await?).await?.bytes().await?.to_vec())
    }

    /// What was found in a scene, as corrected: the export in JSON.
    ///
    /// # Errors
    /// [`ClientError`].
    pub async fn exported_scene(&self, scene_id: &str) -> Result<ExportedScene, ClientError> {
        json(self.export_request(scene_id, ExportFormat::Json)).await
    }

    fn export_request(&self, scene_id: &str, format: ExportFormat) -> RequestBuilder {
        self.request(Method::GET, &format!("v1/scenes/{scene_id}/export"))
            .query(&[("format", format)])
    }
}
