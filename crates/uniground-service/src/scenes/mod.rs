//! Scenes as callers of the API see them.

mod changes;
mod export;
mod growing;
mod importing;
mod lookup;
mod pieces;
mod uploads;

pub use changes::ChangeService;
pub use export::ExportFile;
pub use export::ExportService;
pub use growing::GrowthService;
pub use growing::NewFrames;
pub use lookup::SceneLookup;
pub(super) use pieces::BodyPieces;
pub use uploads::ImportService;
pub use uploads::NewScene;
pub(super) use uploads::{ReceivedArchive, SceneToMake, check_name, detect_format};

use super::Caller;
use crate::error::Error;
use crate::{ServiceLocks, Transcripts, sample};
use bytes::Bytes;
use std::convert::Infallible;
use std::sync::Arc;
use tokio::task::spawn_blocking;
use uniground_jobs::{Job, Jobs};
use uniground_storage::{
    AnswerRepository, OrphanRepository, Reserve, SceneFilter, SceneRepository, SceneRowChange,
    Scratch, split_page,
};
use uniground_types::labels::{Labels, check_labels};
use uniground_types::placement::SceneToMap;
use uniground_types::scenes::{Scene, SceneChange, SceneList};
use uniground_types::settings::ParseSettings;

/// Lists, changes and deletes scenes.
#[derive(Clone)]
pub struct SceneService {
    pub(crate) scene_repository: SceneRepository,
    pub(crate) scene_lookup: Arc<SceneLookup>,
    pub(crate) reserve: Reserve,
    pub(crate) answer_repository: AnswerRepository,
    pub(crate) orphan_repository: OrphanRepository,
    pub(crate) jobs: Jobs,
    pub(crate) transcripts: Arc<Transcripts>,
    pub(crate) service_locks: Arc<ServiceLocks>,
}

impl SceneService {
    /// Lists scenes with these labels, newest first. `cursor` is the last id of the previous page.
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
        let (rows, next_cursor) = split_page(
            self.scene_repository.scenes(limit + 1, cursor, &filter).await?,
            limit,
            |row| &row.id,
        );
        let mut scenes = Vec::with_capacity(rows.len());
        for row in rows {
            // Lists leave out the settings and the report of a parse. Callers get them from the
            // single scene.
            scenes.push(Scene {
                settings: None,
                report: None,
                ..self.scene_lookup.to_scene(row).await?
            });
        }
        Ok(SceneList { scenes, next_cursor })
    }

    /// Changes a scene's name, its labels and its pose in a map.
    ///
    /// # Errors
    /// [`Error::SceneNotFound`]; [`Error::Invalid`] for an invalid name, label or rotation.
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
            .scene_repository
            .change_scene(id, change)
            .await?
            .ok_or_else(|| Error::SceneNotFound { id: id.into() })?;
        self.scene_lookup.to_scene(row).await
    }

    /// Deletes a scene with its answers. Its parse and files are deleted too if no other scene
    /// shares them.
    ///
    /// Files are set aside at once and removed in the background, because removing gigabytes takes
    /// time. If the disk is full, the reserve is released to make room for the deletion.
    ///
    /// # Errors
    /// [`Error::SceneNotFound`].
    pub async fn delete_scene(&self, id: &str) -> Result<(), Error> {
        let trash = match self.try_to_delete(id).await {
            Err(error) if error.is_disk_full() && self.reserve.release_reserve() => {
                self.try_to_delete(id).await
            }
            done => done,
        }?;
        let reserve = self.reserve.clone();
        tokio::spawn(async move {
            let _ = spawn_blocking(move || drop(trash)).await;
            reserve.restore_reserve().await;
        });
        Ok(())
    }

    async fn try_to_delete(&self, id: &str) -> Result<Vec<Scratch>, Error> {
        self.scene_lookup.scene_row(id).await?;
        self.jobs.cancel_all_of(id).await?;
        // Answers are deleted first, in small batches, because there may be a hundred thousand of
        // them.
        loop {
            let answers = self.answer_repository.delete_some_answers(id).await?;
            if answers.is_empty() {
                break;
            }
            self.transcripts.discard_transcripts(&answers).await?;
        }
        let _references = self.service_locks.lock_content_references().await?;
        let left_over = self
            .scene_repository
            .delete_scene(id)
            .await?
            .ok_or_else(|| Error::SceneNotFound { id: id.into() })?;
        Ok(self.orphan_repository.set_aside(left_over).await?)
    }
}

impl ImportService {
    /// Creates a scene from the sample scan built into this program, and starts parsing it.
    ///
    /// # Errors
    /// Those of [`create_scene`](Self::create_scene).
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
}
