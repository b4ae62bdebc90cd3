//! Exports of scenes as files.

use crate::{Client, ClientError, checked, json};
use reqwest::{Method, RequestBuilder};
use uniground_types::export::{ExportFormat, ExportedScene};

impl Client {
    /// Returns a scene with its instances as a file with at most `points` points. If omitted, the
    /// server's default applies.
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

    /// Returns the instances of a scene with corrections applied: the JSON export.
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
