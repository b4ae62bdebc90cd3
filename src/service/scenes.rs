//! Scenes as the outside sees them.

use super::parse_settings::{ParseModels, ParseSettings};
use super::parsing::EMBEDDINGS_FILE;
use super::{Service, uploads};
use crate::error::Error;
use crate::geometry::boxes::Aabb;
use crate::jobs::{Job, JobError};
use crate::scene::{ImportReport, ParseReport};
use crate::store::{JobState, ParseRow, SceneRow};
use camino::Utf8PathBuf;
use serde::{Deserialize, Serialize};
use utoipa::ToSchema;

#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
#[serde(rename_all = "snake_case")]
pub enum SceneStatus {
    /// Stored, not parsed.
    Uploaded,
    /// The first parse is queued or running.
    Parsing,
    /// Questions are answered.
    Ready,
    /// The only parse so far failed or was cancelled; see `error`.
    Failed,
}

#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
pub struct SceneCounts {
    pub points: u64,
    pub frames_used: u32,
    pub superpoints: u32,
    pub instances: u32,
}

/// A scene: one uploaded scan and its current parse.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct Scene {
    pub id: String,
    pub name: String,
    pub status: SceneStatus,
    /// SHA-256 of the uploaded bytes, hex.
    pub content_hash: String,
    /// Number of the current parse, from 1; 0 before the first. Questions use the current one until a newer is ready.
    pub parse_version: u32,
    pub counts: Option<SceneCounts>,
    /// Box of all points, world frame (Z up), metres.
    pub extent: Option<Aabb>,
    /// What the importer found.
    pub import: Option<ImportReport>,
    /// What stage 1 did.
    pub report: Option<ParseReport>,
    pub settings: Option<ParseSettings>,
    pub models: Option<ParseModels>,
    /// The latest job on this scene.
    pub job_id: Option<String>,
    /// Why the latest job failed.
    pub error: Option<JobError>,
    pub created_at: String,
    pub updated_at: String,
}

#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct SceneList {
    /// Newest first.
    pub scenes: Vec<Scene>,
    /// Pass as `cursor` for the next page; `null` on the last.
    pub next_cursor: Option<String>,
}

impl Service {
    /// # Errors
    /// [`Error::SceneNotFound`].
    pub async fn scene(&self, id: &str) -> Result<Scene, Error> {
        self.present(self.scene_row(id).await?).await
    }

    /// Scenes newest first, from `cursor` (the id the last page ended with).
    ///
    /// # Errors
    /// [`Error::Store`].
    pub async fn scenes(&self, limit: u32, cursor: Option<&str>) -> Result<SceneList, Error> {
        let mut rows = self.store.scenes(limit + 1, cursor).await?;
        let more = rows.len() > limit as usize;
        rows.truncate(limit as usize);
        let next_cursor = rows.last().filter(|_| more).map(|row| row.id.clone());
        let mut scenes = Vec::with_capacity(rows.len());
        for row in rows {
            scenes.push(self.present(row).await?);
        }
        Ok(SceneList { scenes, next_cursor })
    }

    /// # Errors
    /// [`Error::SceneNotFound`], [`Error::Invalid`] for a name that is none.
    pub async fn rename_scene(&self, id: &str, name: &str) -> Result<Scene, Error> {
        uploads::check_name("/name", name)?;
        let row = self.store.rename_scene(id, name).await?.ok_or_else(|| Error::SceneNotFound { id: id.into() })?;
        self.present(row).await
    }

    /// Deletes a scene with its answers; its parse and files too when no other scene shares them.
    ///
    /// # Errors
    /// [`Error::SceneNotFound`].
    pub async fn delete_scene(&self, id: &str) -> Result<(), Error> {
        self.jobs.cancel_all_of(id).await?;
        let _references = self.content_references.lock().await;
        if self.store.delete_scene(id).await? { Ok(()) } else { Err(Error::SceneNotFound { id: id.into() }) }
    }

    /// A PLY file of the current parse.
    ///
    /// # Errors
    /// [`Error::SceneNotFound`], [`Error::SceneNotReady`].
    pub async fn parse_file(&self, scene_id: &str, file: &str) -> Result<Utf8PathBuf, Error> {
        let (_, parse_id) = self.ready_scene(scene_id).await?;
        Ok(self.store.blobs.parse(&parse_id).join(file))
    }

    /// The embeddings of the current parse.
    ///
    /// # Errors
    /// Those of [`parse_file`](Self::parse_file); [`Error::NoEmbeddings`] when no encoder has seen the scene.
    pub async fn embeddings_file(&self, scene_id: &str) -> Result<Utf8PathBuf, Error> {
        let file = self.parse_file(scene_id, EMBEDDINGS_FILE).await?;
        match tokio::fs::try_exists(&file).await? {
            true => Ok(file),
            false => Err(Error::NoEmbeddings { scene_id: scene_id.into() }),
        }
    }

    pub(super) async fn scene_row(&self, id: &str) -> Result<SceneRow, Error> {
        self.store.scene(id).await?.ok_or_else(|| Error::SceneNotFound { id: id.into() })
    }

    /// A scene that has a parse, and the parse's id.
    pub(super) async fn ready_scene(&self, id: &str) -> Result<(SceneRow, String), Error> {
        let row = self.scene_row(id).await?;
        match row.parse_id.clone() {
            Some(parse_id) => Ok((row, parse_id)),
            None => Err(Error::SceneNotReady { id: row.id, job_id: row.job_id }),
        }
    }

    pub(super) async fn job_of(&self, row: &SceneRow) -> Result<Option<Job>, Error> {
        match &row.job_id {
            Some(id) => Ok(Some(self.jobs.get(id).await?)),
            None => Ok(None),
        }
    }

    pub(super) async fn present(&self, row: SceneRow) -> Result<Scene, Error> {
        let job = self.job_of(&row).await?;
        let parse = match &row.parse_id {
            Some(id) => self.store.parse(id).await?,
            None => None,
        };
        let status = match (&parse, job.as_ref().map(|job| job.state)) {
            (Some(_), _) => SceneStatus::Ready,
            (None, None) => SceneStatus::Uploaded,
            (None, Some(JobState::Queued | JobState::Running | JobState::Succeeded)) => SceneStatus::Parsing,
            (None, Some(JobState::Failed | JobState::Cancelled)) => SceneStatus::Failed,
        };
        let SceneRow { id, name, content_hash, parse_id: _, parse_version, job_id, created_at, updated_at } = row;
        let mut scene = Scene {
            id,
            name,
            status,
            content_hash,
            parse_version: u32::try_from(parse_version).unwrap_or(0),
            counts: None,
            extent: None,
            import: None,
            report: None,
            settings: None,
            models: None,
            job_id,
            error: job.and_then(|job| job.error),
            created_at,
            updated_at,
        };
        if let Some(ParseRow { settings, models, import_report, parse_report, extent, .. }) = parse {
            let report: ParseReport = serde_json::from_str(&parse_report)?;
            scene.counts = Some(SceneCounts {
                points: report.points,
                frames_used: report.frames_used,
                superpoints: report.superpoints,
                instances: report.instances,
            });
            scene.extent = Some(serde_json::from_str(&extent)?);
            scene.import = Some(serde_json::from_str(&import_report)?);
            scene.report = Some(report);
            scene.settings = Some(serde_json::from_str(&settings)?);
            scene.models = Some(serde_json::from_str(&models)?);
        }
        Ok(scene)
    }
}
