//! Finds scenes and their parses.

use crate::ServiceLocks;
use crate::error::Error;
use crate::parses::is_draft;
use std::sync::Arc;
use uniground_jobs::{Job, Jobs};
use uniground_models::neural::Models;
use uniground_storage::{
    JobState, NamedLock, ParseRecord, ParseRepository, SceneRepository, SceneRow,
};
use uniground_types::scenes::{ParseQuality, Scene, SceneCounts, SceneStatus};
use uuid::Uuid;

/// Finds scenes and their parses.
#[derive(Clone)]
pub struct SceneLookup {
    pub(crate) service_locks: Arc<ServiceLocks>,
    pub(crate) scene_repository: SceneRepository,
    pub(crate) jobs: Jobs,
    pub(crate) parse_repository: ParseRepository,
    pub(crate) models: Models,
}

impl SceneLookup {
    /// Returns the id of a scene that is given by its id or its name. An id is returned unchecked.
    ///
    /// # Errors
    /// [`Error::SceneNotFound`], or [`Error::SceneNameAmbiguous`] if several scenes have the name.
    pub async fn resolve(&self, id_or_name: String) -> Result<String, Error> {
        if Uuid::try_parse(&id_or_name).is_ok() {
            return Ok(id_or_name);
        }
        let ids = self.scene_repository.scene_ids_by_name(&id_or_name).await?;
        match <[String; 1]>::try_from(ids) {
            Ok([id]) => Ok(id),
            Err(ids) if ids.is_empty() => Err(Error::SceneNotFound { id: id_or_name }),
            Err(_) => Err(Error::SceneNameAmbiguous { name: id_or_name }),
        }
    }

    /// # Errors
    /// [`Error::SceneNotFound`].
    pub async fn scene(&self, id: &str) -> Result<Scene, Error> {
        self.to_scene(self.scene_row(id).await?).await
    }

    pub(crate) async fn scene_row(&self, id: &str) -> Result<SceneRow, Error> {
        self.scene_repository.scene(id).await?.ok_or_else(|| Error::SceneNotFound { id: id.into() })
    }

    /// Returns a scene that has a parse, and the parse's id.
    pub(crate) async fn ready_scene(&self, id: &str) -> Result<(SceneRow, String), Error> {
        let row = self.scene_row(id).await?;
        match row.parse_id.clone() {
            Some(parse_id) => Ok((row, parse_id)),
            None => Err(Error::SceneNotReady { id: row.id, job_id: row.job_id }),
        }
    }

    pub(crate) async fn current_job(&self, row: &SceneRow) -> Result<Option<Job>, Error> {
        match &row.job_id {
            Some(id) => Ok(Some(self.jobs.get(id).await?)),
            None => Ok(None),
        }
    }

    /// Waits until the latest parse job of a scene is done, and the full parse after a draft.
    ///
    /// # Errors
    /// [`Error::SceneNotFound`].
    pub(crate) async fn wait_for_full_parse(&self, id: &str) -> Result<(), Error> {
        loop {
            let Some(job_id) = self.scene_row(id).await?.job_id else { return Ok(()) };
            // A deleted job counts as done too.
            let done = self.jobs.follow(&job_id).await;
            if let Ok(mut job) = done {
                let _ = job.wait_for(|job| job.state.is_final()).await;
            }
            if self.scene_row(id).await?.job_id == Some(job_id) {
                return Ok(());
            }
        }
    }

    pub(crate) async fn to_scene(&self, row: SceneRow) -> Result<Scene, Error> {
        let job = self.current_job(&row).await?;
        let parse = match &row.parse_id {
            Some(id) => self.parse_repository.parse(id).await?,
            None => None,
        };
        let status = match (&parse, job.as_ref().map(|job| job.state)) {
            (Some(_), _) => SceneStatus::Ready,
            (None, None) => SceneStatus::Uploaded,
            (None, Some(JobState::Queued | JobState::Running | JobState::Succeeded)) => {
                SceneStatus::Parsing
            }
            (None, Some(JobState::Failed | JobState::Cancelled)) => SceneStatus::Failed,
        };
        let SceneRow {
            id,
            name,
            content_hash,
            parse_id: _,
            parse_version,
            job_id,
            scene_to_map,
            map_frame_id,
            labels,
            created_at,
            updated_at,
        } = row;
        let mut scene = Scene {
            id,
            name,
            status,
            content_hash,
            parse_version: u32::try_from(parse_version).unwrap_or(0),
            quality: None,
            counts: None,
            extent: None,
            scene_to_map,
            map_frame_id,
            labels,
            import: None,
            report: None,
            settings: None,
            models: None,
            job_id,
            error: job.and_then(|job| job.error),
            created_at,
            updated_at,
        };
        if let Some(ParseRecord { settings, models, import, report, extent }) =
            parse.map(|parse| parse.record())
        {
            scene.counts = report.as_ref().map(|report| SceneCounts {
                points: report.points,
                frames_used: report.frames_used,
                superpoints: report.superpoints,
                instances: report.instances,
            });
            (scene.extent, scene.import, scene.report) = (extent, import, report);
            scene.quality = Some(match is_draft(&settings, &models, &self.models) {
                true => ParseQuality::Draft,
                false => ParseQuality::Full,
            });
            (scene.settings, scene.models) = (Some(settings), Some(models));
        }
        Ok(scene)
    }

    /// Returns a scene's current parse and the lock for corrections of that parse. While the lock
    /// is held, nobody else corrects the parse or adds instances to it, and no growing scene
    /// continues from it.
    ///
    /// # Errors
    /// [`Error::SceneNotFound`], [`Error::SceneNotReady`].
    pub(crate) async fn lock_current_parse(
        &self,
        scene_id: &str,
    ) -> Result<(String, NamedLock), Error> {
        loop {
            let (_, parse_id) = self.ready_scene(scene_id).await?;
            let lock = self.service_locks.lock_parse_data(&parse_id).await?;
            if self.ready_scene(scene_id).await?.1 == parse_id {
                return Ok((parse_id, lock));
            }
        }
    }
}
