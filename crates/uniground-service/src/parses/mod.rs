//! Parses of scenes. The same content is parsed once with the same settings.

mod cache;
mod files;
mod job;
mod parsed_scenes;
mod plan;
mod previous_parse;
mod report_files;
mod reports;
mod scene_media;

pub use cache::{LoadedParse, ParseCache};
pub use files::{ParseFile, photograph, read, read_frames, read_photograph, view};
pub use job::ParseRunner;
pub use job::{FullParseJob, ParseJob};
pub use parsed_scenes::ParsedScenes;
pub use plan::ParseMode;
pub(crate) use plan::is_draft;
pub use scene_media::MediaService;

use super::Caller;
use crate::error::Error;
use crate::{Capacity, SceneLookup, ServiceLocks};
use job::{ParseStep, Payload};
use plan::{ParseRequest, PreparedParse};
use sha2::{Digest, Sha256};
use std::collections::BTreeMap;
use std::sync::Arc;
use uniground_jobs::{Job, JobRequest, Jobs};
use uniground_models::neural::Models;
use uniground_parsing::scan::{STAGE_1_VERSION, model_names, select_models};
use uniground_storage::{Blobs, JobRepository, PinnedPath, SceneRepository};
use uniground_types::corrections::{Change, Correction};
use uniground_types::settings::{ParseModels, ParsePreset, ParseSettings};

/// A file that a caller downloads.
pub enum FileDownload {
    Local(PinnedPath),
    /// A URL of the object store that works for a limited time.
    Redirect(String),
}

/// Starts parses and serves their files and reports.
#[derive(Clone)]
pub struct ParseService {
    pub(crate) models: Models,
    pub(crate) parse_mode: ParseMode,
    pub(crate) scene_repository: SceneRepository,
    pub(crate) scene_lookup: Arc<SceneLookup>,
    pub(crate) service_locks: Arc<ServiceLocks>,
    pub(crate) capacity: Arc<Capacity>,
    pub(crate) jobs: Jobs,
    pub(crate) parsed_scenes: Arc<ParsedScenes>,
    pub(crate) job_repository: JobRepository,
    pub(crate) blobs: Blobs,
}

impl ParseService {
    /// Returns the models of a parse that starts now, unless it requests others.
    #[must_use]
    pub fn parse_models(&self) -> ParseModels {
        model_names(&self.models)
    }

    /// Parses a scene in the background. A stored parse of the same content and settings is used at
    /// once. A scene without a parse may get a draft first, see [`ParseMode`].
    ///
    /// # Errors
    /// [`Error`] if the scene is unknown or the queue is full.
    pub async fn start_parse(
        &self,
        scene_id: &str,
        settings: &ParseSettings,
        caller: &Caller,
    ) -> Result<Job, Error> {
        let scene = self.scene_lookup.scene_row(scene_id).await?;
        // A stored parse stays until the scene refers to it.
        let _references = self.service_locks.lock_parse_references().await?;
        let is_parsed = scene.parse_id.is_some();
        let wanted =
            self.prepare_parse(&scene.id, &scene.content_hash, is_parsed, settings, caller).await?;
        if !wanted.is_stored {
            self.capacity.check_disk(0)?;
        }
        let insert = self.scene_repository.insert_scene_job(&scene.id, wanted.job.row());
        let row = wanted.job.enqueue(&self.jobs, insert).await?;
        let row = row.ok_or_else(|| Error::SceneNotFound { id: scene.id.clone() })?;
        Ok(self.jobs.to_job(row))
    }

    /// Prepares a scene's parse, before it is recorded. `is_parsed`: the scene can answer questions
    /// meanwhile.
    pub(super) async fn prepare_parse(
        &self,
        scene_id: &str,
        content_hash: &str,
        is_parsed: bool,
        settings: &ParseSettings,
        caller: &Caller,
    ) -> Result<PreparedParse, Error> {
        let networks = !select_models(settings.models, &self.models).loaded.is_empty();
        let stored = self.parsed_scenes.stored_parse(content_hash, settings).await?;
        let step = match self.parse_mode {
            ParseMode::FullOnly => ParseStep::Full,
            _ if !networks || is_parsed || stored.is_some() => ParseStep::Full,
            ParseMode::DraftFirst => ParseStep::DraftThenFull,
            ParseMode::DraftOnly => ParseStep::Draft,
        };
        let payload = Payload { scene_id: scene_id.to_owned(), settings: settings.clone(), step };
        // Drafts of other scenes do not wait for a parse that takes minutes.
        let takes_long = networks && step == ParseStep::Full && stored.is_none();
        let is_stored = stored.is_some();
        let job = if takes_long && self.parse_mode != ParseMode::FullOnly {
            ParseRequest::Full(JobRequest::new(&payload, caller.key_id())?)
        } else {
            let job = JobRequest::new(&payload, caller.key_id())?;
            ParseRequest::Parse(match stored {
                Some(id) => job.with_result(id, job::STORED_PARSE_USED),
                None => job,
            })
        };
        Ok(PreparedParse { job, is_stored })
    }

    /// Parses a scene again, with a preset in which single values are replaced.
    ///
    /// The settings of how files are read stay as in the upload, unless given: the up direction,
    /// the length of the unit, and whether the scan is leveled.
    ///
    /// # Errors
    /// [`Error`] for invalid settings, an unknown scene or a full queue.
    pub async fn reparse(
        &self,
        scene_id: &str,
        preset: ParsePreset,
        overrides: Option<serde_json::Value>,
        caller: &Caller,
    ) -> Result<Job, Error> {
        let scene = self.scene_lookup.scene_row(scene_id).await?;
        let told = match &scene.job_id {
            Some(job_id) => self.job_repository.job(job_id).await?,
            None => None,
        };
        let overrides = match told {
            Some(job) => job::with_import_settings_of(&job.payload, overrides),
            None => overrides,
        };
        let settings = ParseSettings::from_request(preset, overrides)?;
        self.start_parse(scene_id, &settings, caller).await
    }

    /// Returns a file of a scene's current parse.
    ///
    /// # Errors
    /// [`Error::SceneNotFound`], [`Error::SceneNotReady`]; [`Error::NoEmbeddings`] if no encoder
    /// was used for the scene.
    pub async fn parse_file(&self, scene_id: &str, file: ParseFile) -> Result<FileDownload, Error> {
        let (_, parse_id) = self.scene_lookup.ready_scene(scene_id).await?;
        if file == ParseFile::Embeddings
            && self.parsed_scenes.loaded_parse(&parse_id).await?.embeddings.is_none()
        {
            return Err(Error::NoEmbeddings { scene_id: scene_id.into() });
        }
        match self.parsed_scenes.public_link(&parse_id, file).await? {
            Some(link) => Ok(FileDownload::Redirect(link)),
            None => Ok(FileDownload::Local(
                self.parsed_scenes
                    .check_and_pin_file(&parse_id, file.path_in(&self.blobs.parse(&parse_id)))
                    .await?,
            )),
        }
    }
}

/// Returns the names that people have given, by instance id. The last name counts.
fn corrected_names(corrections: &[Correction]) -> BTreeMap<u32, String> {
    let name = |correction: &Correction| match (&correction.change, correction.made) {
        (Change::Rename { instance_id, name }, _) => Some((instance_id.0, name.clone())),
        (Change::Merge { name: Some(name), .. }, Some(made)) => Some((made.0, name.clone())),
        _ => None,
    };
    corrections
        .iter()
        .filter(|correction| correction.undone_at.is_none())
        .filter_map(name)
        .collect()
}

/// Returns a hash of settings, with the models and the version of the code that use them.
fn settings_hash(settings: &ParseSettings, models: &ParseModels) -> Result<String, Error> {
    let mut hasher = Sha256::new();
    hasher.update(serde_json::to_vec(&(STAGE_1_VERSION, models, settings))?);
    Ok(hasher.finalize().iter().take(16).map(|byte| format!("{byte:02x}")).collect())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn settings_hash_covers_settings_and_models() {
        let models = |encoder: &str| ParseModels { masks: "m".into(), encoder: encoder.into() };
        let (default, paper) = (
            ParseSettings::default(),
            ParseSettings::from_request(ParsePreset::Paper, None).unwrap(),
        );
        assert_eq!(
            settings_hash(&default, &models("a")).unwrap(),
            settings_hash(&default.clone(), &models("a")).unwrap()
        );
        assert_ne!(
            settings_hash(&default, &models("a")).unwrap(),
            settings_hash(&paper, &models("a")).unwrap()
        );
        assert_ne!(
            settings_hash(&default, &models("a")).unwrap(),
            settings_hash(&default, &models("b")).unwrap()
        );
    }
}
