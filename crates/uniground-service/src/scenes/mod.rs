//! Scenes as the outside sees them.

mod changes;
mod export;
mod growing;
mod importing;
mod pieces;
mod uploads;

pub use export::ExportFile;
pub use growing::NewFrames;
pub(super) use pieces::Pieces;
pub use uploads::NewScene;
pub(super) use uploads::{Asked, Received, check_name, what_comes};

use super::{Caller, Service};
use crate::error::Error;
use crate::sample;
use bytes::Bytes;
use std::convert::Infallible;
use tokio::task::spawn_blocking;
use uniground_jobs::Job;
use uniground_storage::{
    JobState, ParseRecord, SceneFilter, SceneRow, SceneRowChange, Scratch, page,
};
use uniground_types::labels::{Labels, check_labels};
use uniground_types::placement::SceneToMap;
use uniground_types::scenes::{Scene, SceneChange, SceneCounts, SceneList, SceneStatus};
use uniground_types::settings::ParseSettings;

impl Service {
    /// # Errors
    /// [`Error::SceneNotFound`].
    pub async fn scene(&self, id: &str) -> Result<Scene, Error> {
        self.present(self.scene_row(id).await?).await
    }

    /// Scenes that have these labels newest first, from `cursor` (the id the last page ended with).
    ///
    /// # Errors
    /// [`Error::Store`].
    pub async fn scenes(
        &self,
        limit: u32,
        cursor: Option<&str>,
        labels: Labels,
    ) -> Result<SceneList, Error> {
        let filter = SceneFilter { ids: None, labels };
        let (rows, next_cursor) =
            page(self.store.scenes.scenes(limit + 1, cursor, &filter).await?, limit, |row| &row.id);
        let mut scenes = Vec::with_capacity(rows.len());
        for row in rows {
            // Pages of scenes are looked through: what one scene was parsed with, and how that
            // went, is asked of that scene.
            scenes.push(Scene { settings: None, report: None, ..self.present(row).await? });
        }
        Ok(SceneList { scenes, next_cursor })
    }

    /// Makes a scene of the scan this program carries, and starts parsing it.
    ///
    /// # Errors
    /// As [`create_scene`](Self::create_scene).
    pub async fn create_sample(&self, caller: &Caller) -> Result<(Scene, Option<Job>), Error> {
        let new = NewScene {
            name: Some(sample::NAME.to_owned()),
            file_name: None,
            parse: Some(ParseSettings::default()),
            idempotency_key: None,
            announced_bytes: sample::LIVING_ROOM.len() as u64,
        };
        let body =
            futures::stream::iter([Ok::<_, Infallible>(Bytes::from_static(sample::LIVING_ROOM))]);
        self.create_scene(new, body, caller).await
    }

    /// Renames a scene, files it, and says where it lies in a map.
    ///
    /// # Errors
    /// [`Error::SceneNotFound`], [`Error::Invalid`] for a name, a label or a rotation that is none.
    pub async fn change_scene(&self, id: &str, change: SceneChange) -> Result<Scene, Error> {
        let SceneChange { name, scene_to_map, map_frame_id, labels } = change;
        name.iter().try_for_each(|name| check_name("/name", name))?;
        map_frame_id
            .iter()
            .flatten()
            .try_for_each(|frame_id| check_name("/map_frame_id", frame_id))?;
        scene_to_map.iter().flatten().try_for_each(SceneToMap::check)?;
        labels.iter().try_for_each(|labels| check_labels("/labels", labels))?;
        let map_frame_id = map_frame_id.as_ref().map(Option::as_deref);
        let change = SceneRowChange { name: name.as_deref(), scene_to_map, map_frame_id, labels };
        let row = self
            .store
            .scenes
            .change_scene(id, change)
            .await?
            .ok_or_else(|| Error::SceneNotFound { id: id.into() })?;
        self.present(row).await
    }

    /// Deletes a scene with its answers; its parse and files too when no other scene shares them.
    /// What it leaves on the disk is out of the way at once and removed in the background:
    /// gigabytes take their time. On a full disk the room for it comes from the reserve.
    ///
    /// # Errors
    /// [`Error::SceneNotFound`].
    pub async fn delete_scene(&self, id: &str) -> Result<(), Error> {
        let trash = match self.try_to_delete(id).await {
            Err(error) if error.is_disk_full() && self.store.reserve.release_reserve() => {
                self.try_to_delete(id).await
            }
            done => done,
        }?;
        let store = self.store.clone();
        tokio::spawn(async move {
            let _ = spawn_blocking(move || drop(trash)).await;
            store.reserve.restore_reserve().await;
        });
        Ok(())
    }

    async fn try_to_delete(&self, id: &str) -> Result<Vec<Scratch>, Error> {
        self.scene_row(id).await?;
        self.jobs.cancel_all_of(id).await?;
        // Answers go first, some at a time: nobody waits for the last of a hundred thousand.
        loop {
            let answers = self.store.answers.delete_some_answers(id).await?;
            if answers.is_empty() {
                break;
            }
            self.discard_transcripts(&answers).await?;
        }
        let _references = self.content_references().await?;
        let left_over = self
            .store
            .scenes
            .delete_scene(id)
            .await?
            .ok_or_else(|| Error::SceneNotFound { id: id.into() })?;
        Ok(self.store.orphans.set_aside(left_over).await?)
    }

    pub(super) async fn scene_row(&self, id: &str) -> Result<SceneRow, Error> {
        self.store.scenes.scene(id).await?.ok_or_else(|| Error::SceneNotFound { id: id.into() })
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
            Some(id) => self.store.parses.parse(id).await?,
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
            (scene.settings, scene.models) = (Some(settings), Some(models));
        }
        Ok(scene)
    }
}
