//! Parses: the same content with the same settings is parsed once.

mod cache;
mod files;
mod job;
mod report_files;
mod reports;

pub use cache::{LoadedParse, ParseCache};
pub use files::{ParseFile, view};
pub use job::ParseJob;

use super::Service;
use crate::error::Error;
use crate::jobs::Job;
use crate::store::{ParseRecord, SceneRow};
use camino::Utf8PathBuf;
use job::Payload;
use sha2::{Digest, Sha256};
use std::sync::Arc;
use uniground_core::geometry::boxes::Aabb;
use uniground_core::parse::{STAGE_1_VERSION, chosen, names_of};
use uniground_types::settings::{ParseModels, ParsePreset, ParseSettings};

impl Service {
    /// The models a parse started now is made with, unless it asks for others.
    #[must_use]
    pub fn parse_models(&self) -> ParseModels {
        names_of(&self.models)
    }

    /// Parses a scene, in the background. A stored parse of the same content and settings is taken at once.
    ///
    /// # Errors
    /// [`Error`] when the scene is unknown or the queue is full.
    pub async fn start_parse(&self, scene_id: &str, settings: &ParseSettings) -> Result<Job, Error> {
        let scene = self.scene_row(scene_id).await?;
        let payload = Payload { scene_id: scene.id.clone(), settings: settings.clone() };
        let job = match self.stored_parse(&scene, settings).await? {
            Some(parse_id) => {
                let job = self.jobs.submit_done::<ParseJob>(&scene.id, &payload, job::STORED_PARSE_USED).await?;
                self.store.set_scene_parse(&scene.id, &parse_id, &job.id).await?;
                job
            }
            None => self.jobs.submit::<ParseJob>(&scene.id, &payload).await?,
        };
        self.store.set_scene_job(&scene.id, &job.id).await?;
        Ok(job)
    }

    /// Parses a scene again: a preset with single values replaced. What is up was settled at the upload and stays, unless said.
    ///
    /// # Errors
    /// [`Error`] for settings that make no sense, an unknown scene or a full queue.
    pub async fn reparse(&self, scene_id: &str, preset: ParsePreset, overrides: Option<serde_json::Value>) -> Result<Job, Error> {
        let mut settings = ParseSettings::from_request(preset, overrides)?;
        let scene = self.scene_row(scene_id).await?;
        if settings.import.up.is_none()
            && let Some(job_id) = &scene.job_id
            && let Some(job) = self.store.job(job_id).await?
        {
            settings.import.up = job::up_asked_for(&job.payload);
        }
        self.start_parse(scene_id, &settings).await
    }

    /// A file of a scene's current parse.
    ///
    /// # Errors
    /// [`Error::SceneNotFound`], [`Error::SceneNotReady`]; [`Error::NoEmbeddings`] when no encoder has seen the scene.
    pub async fn parse_file(&self, scene_id: &str, file: ParseFile) -> Result<Utf8PathBuf, Error> {
        let (_, parse_id) = self.ready_scene(scene_id).await?;
        let path = file.of(&self.store.blobs.parse(&parse_id));
        if file == ParseFile::Embeddings && !tokio::fs::try_exists(&path).await? {
            return Err(Error::NoEmbeddings { scene_id: scene_id.into() });
        }
        Ok(path)
    }

    /// The parse of a scene's content under these settings and the models they choose, where there is one.
    async fn stored_parse(&self, scene: &SceneRow, settings: &ParseSettings) -> Result<Option<String>, Error> {
        let hash = settings_hash(settings, &names_of(&chosen(settings.models, &self.models)))?;
        Ok(self.store.parse_of(&scene.content_hash, &hash).await?.map(|parse| parse.id))
    }

    /// A parse in memory.
    pub(super) async fn loaded_parse(&self, parse_id: &str) -> Result<Arc<LoadedParse>, Error> {
        if let Some(parse) = self.parses.loaded.get(parse_id) {
            return Ok(parse);
        }
        let gone = || Error::SceneNotFound { id: parse_id.into() };
        let ParseRecord { models, extent, .. } = self.store.parse(parse_id).await?.ok_or_else(gone)?.record();
        let instances = self.store.instances(parse_id).await?;
        let around = || Aabb::around(&instances.iter().flat_map(|i| i.aabb.corners()).collect::<Vec<_>>());
        let parse = Arc::new(LoadedParse {
            id: parse_id.to_owned(),
            embeddings: files::read_embeddings(&self.store.blobs.parse(parse_id)).await?,
            extent: extent.or_else(around).ok_or_else(gone)?,
            instances,
            masks: models.masks,
            encoder: models.encoder,
        });
        self.parses.loaded.put(parse_id.to_owned(), parse.clone(), 1);
        Ok(parse)
    }
}

/// Identifies settings and the code and models that read them.
fn settings_hash(settings: &ParseSettings, models: &ParseModels) -> Result<String, Error> {
    let mut hasher = Sha256::new();
    hasher.update(serde_json::to_vec(&(STAGE_1_VERSION, models, settings))?);
    Ok(hasher.finalize().iter().take(16).map(|byte| format!("{byte:02x}")).collect())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn settings_and_models_make_the_hash() {
        let models = |encoder: &str| ParseModels { masks: "m".into(), encoder: encoder.into() };
        let (default, paper) = (ParseSettings::default(), ParseSettings::from_request(ParsePreset::Paper, None).unwrap());
        assert_eq!(settings_hash(&default, &models("a")).unwrap(), settings_hash(&default.clone(), &models("a")).unwrap());
        assert_ne!(settings_hash(&default, &models("a")).unwrap(), settings_hash(&paper, &models("a")).unwrap());
        assert_ne!(settings_hash(&default, &models("a")).unwrap(), settings_hash(&default, &models("b")).unwrap());
    }
}
