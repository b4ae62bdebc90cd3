//! What a parse did, in figures and pictures.

use super::parsing::{ParseModels, ParseSettings, REPORT_FOLDER};
use super::{Scene, Service};
use crate::error::Error;
use crate::scene::{ImportReport, ParseReport};
use crate::scene_parsing::report_pictures::ReportPicture;
use camino::{Utf8Path, Utf8PathBuf};
use serde::{Deserialize, Serialize};
use std::fs;
use std::io;
use utoipa::ToSchema;

/// Everything known about a scene's current parse.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct SceneReport {
    pub scene_id: String,
    pub parse_version: u32,
    /// What the importer found.
    pub import: Option<ImportReport>,
    /// What every stage did and took.
    pub parse: Option<ParseReport>,
    pub settings: Option<ParseSettings>,
    pub models: Option<ParseModels>,
    pub pictures: Vec<ReportPictureLink>,
}

/// A picture of a parse.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
pub struct ReportPictureLink {
    pub name: String,
    /// What it shows.
    pub title: String,
    /// JPEG, relative to the server.
    pub url: String,
}

/// What is stored of a picture beside its file.
#[derive(Serialize, Deserialize)]
struct Entry {
    name: String,
    title: String,
}

/// Titles of the pictures, beside them.
const INDEX: &str = "index.json";

/// Writes the pictures of a parse into its folder.
pub(super) fn write_pictures(parse: &Utf8Path, pictures: Vec<ReportPicture>) -> Result<(), Error> {
    let folder = parse.join(REPORT_FOLDER);
    fs::create_dir(&folder)?;
    let mut index = Vec::with_capacity(pictures.len());
    for ReportPicture { name, title, jpeg } in pictures {
        fs::write(folder.join(format!("{name}.jpg")), jpeg)?;
        index.push(Entry { name, title });
    }
    Ok(fs::write(folder.join(INDEX), serde_json::to_vec(&index)?)?)
}

impl Service {
    /// # Errors
    /// [`Error::SceneNotFound`], [`Error::SceneNotReady`].
    pub async fn scene_report(&self, scene_id: &str) -> Result<SceneReport, Error> {
        let (row, parse_id) = self.ready_scene(scene_id).await?;
        let Scene { id, parse_version, import, report, settings, models, .. } = self.present(row).await?;
        let pictures = self.report_index(&parse_id).await?.into_iter();
        let link = |Entry { name, title }| ReportPictureLink { url: format!("/v1/scenes/{id}/report/{name}.jpg"), name, title };
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

    /// File of one picture of the current parse.
    ///
    /// # Errors
    /// [`Error::SceneNotFound`], [`Error::SceneNotReady`], [`Error::ReportPictureNotFound`].
    pub async fn report_picture(&self, scene_id: &str, name: &str) -> Result<Utf8PathBuf, Error> {
        let (_, parse_id) = self.ready_scene(scene_id).await?;
        let known = self.report_index(&parse_id).await?;
        if known.iter().all(|entry| entry.name != name) {
            return Err(Error::ReportPictureNotFound { name: name.into() });
        }
        Ok(self.store.blobs.parse(&parse_id).join(REPORT_FOLDER).join(format!("{name}.jpg")))
    }

    /// Parses of earlier versions have no pictures.
    async fn report_index(&self, parse_id: &str) -> Result<Vec<Entry>, Error> {
        let index = self.store.blobs.parse(parse_id).join(REPORT_FOLDER).join(INDEX);
        match tokio::fs::read(index).await {
            Ok(bytes) => Ok(serde_json::from_slice(&bytes)?),
            Err(error) if error.kind() == io::ErrorKind::NotFound => Ok(Vec::new()),
            Err(error) => Err(error.into()),
        }
    }
}
