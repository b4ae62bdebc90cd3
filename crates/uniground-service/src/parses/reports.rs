//! The report of a parse, in figures and pictures.

use super::report_files::{self, Entry};
use crate::ParseService;
use crate::error::Error;
use uniground_storage::PinnedPath;
use uniground_types::scenes::{ReportPictureLink, Scene, SceneReport};

impl ParseService {
    /// # Errors
    /// [`Error::SceneNotFound`], [`Error::SceneNotReady`].
    pub async fn scene_report(&self, scene_id: &str) -> Result<SceneReport, Error> {
        let (row, parse_id) = self.scene_lookup.ready_scene(scene_id).await?;
        let Scene { id, parse_version, import, report, settings, models, .. } =
            self.scene_lookup.to_scene(row).await?;
        let pictures =
            report_files::index(self.blobs.clone(), self.blobs.parse(&parse_id)).await?.into_iter();
        let link = |Entry { name, title }| ReportPictureLink {
            url: format!("/v1/scenes/{id}/report/{name}.jpg"),
            name,
            title,
        };
        Ok(SceneReport {
            pictures: pictures.map(link).collect(),
            scene_id: id.clone(),
            parse_version,
            import,
            parse: report,
            settings,
            models,
        })
    }

    /// Returns the file of one picture of the current parse's report.
    ///
    /// # Errors
    /// [`Error::SceneNotFound`], [`Error::SceneNotReady`], [`Error::ReportPictureNotFound`].
    pub async fn report_picture(&self, scene_id: &str, name: &str) -> Result<PinnedPath, Error> {
        let (_, parse_id) = self.scene_lookup.ready_scene(scene_id).await?;
        let known = report_files::index(self.blobs.clone(), self.blobs.parse(&parse_id)).await?;
        if known.iter().all(|entry| entry.name != name) {
            return Err(Error::ReportPictureNotFound { name: name.into() });
        }
        self.parsed_scenes
            .check_and_pin_file(
                &parse_id,
                report_files::picture(&self.blobs.parse(&parse_id), name),
            )
            .await
    }
}
