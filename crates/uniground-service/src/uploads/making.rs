//! Creates scenes from complete uploads.

use super::parts::file_name;
use crate::error::Error;
use crate::scenes::{ReceivedArchive, SceneToMake};
use crate::{Caller, UploadService};
use std::sync::Arc;
use tokio::task::spawn_blocking;
use uniground_jobs::JobsError;
use uniground_storage::{UploadResult, UploadRow};
use uniground_types::job::Job;
use uniground_types::problem::Problem;
use uniground_types::scenes::Scene;
use uniground_types::settings::ParseSettings;

/// Converts an error to the problem that callers see.
pub type Explain = fn(Error) -> Problem;

impl UploadService {
    /// Creates scenes from complete uploads that have none yet, because the server was stopped, or
    /// because a queue or the disk was full.
    ///
    /// # Errors
    /// [`Error::Store`].
    pub async fn complete_pending_uploads(&self) -> Result<(), Error> {
        for id in self.upload_repository.complete_uploads_without_scene().await? {
            let Ok(_lock) = self.service_locks.lock_upload(&id).await else { continue };
            let Some(row) =
                self.upload_repository.upload(&id).await?.filter(|row| row.came_of.is_none())
            else {
                continue;
            };
            let row = self.with_stored_size(row).await?;
            if row.received < row.length {
                continue;
            }
            let made = match self.keyring.resolve_caller(row.key_id.as_deref()) {
                Ok(caller) => self.complete_upload(row, &caller).await,
                Err(_) => self.reject_upload(&id, Error::KeyRefused).await,
            };
            if let Err(error) = made {
                tracing::debug!(
                    upload_id = id,
                    error = &error as &dyn std::error::Error,
                    "upload is waiting to become a scene"
                );
            }
        }
        Ok(())
    }

    /// Creates a scene from a complete upload, or records why it cannot become one. Deletes the
    /// uploaded file afterwards.
    pub(super) async fn complete_upload(
        &self,
        row: UploadRow,
        caller: &Caller,
    ) -> Result<UploadRow, Error> {
        match Box::pin(self.scene_of_upload(&row, caller)).await {
            Ok((scene, job)) => {
                self.end_upload(
                    &row.id,
                    UploadResult::Scene { scene_id: scene.id, job_id: job.map(|job| job.id) },
                )
                .await
            }
            Err(error) if is_transient(&error) => Err(error),
            Err(error) => self.reject_upload(&row.id, error).await,
        }
    }

    pub(super) async fn reject_upload(&self, id: &str, error: Error) -> Result<UploadRow, Error> {
        let problem = (self.explain)(error);
        self.end_upload(id, UploadResult::Nothing(Some(problem))).await
    }

    async fn end_upload(&self, id: &str, came_of: UploadResult) -> Result<UploadRow, Error> {
        let row = self.upload_repository.end_upload(id, &came_of).await?;
        self.blobs.discard(self.blobs.upload(id)).await?;
        row.ok_or_else(|| Error::UploadNotFound { id: id.into() })
    }

    async fn scene_of_upload(
        &self,
        row: &UploadRow,
        caller: &Caller,
    ) -> Result<(Scene, Option<Job>), Error> {
        let wanted = &row.wanted;
        let mut settings = ParseSettings::from_request(wanted.preset, None)?;
        settings.import.up = wanted.up;
        let (path, name) = (self.blobs.upload(&row.id), file_name(row).to_owned());
        let received = Arc::new(spawn_blocking(move || ReceivedArchive::read(path, &name)).await??);
        // The idempotency key makes sure of one scene, even if a server was killed after creating
        // the scene and before recording it.
        let key = caller.qualify_name(
            wanted.idempotency_key.clone().unwrap_or_else(|| format!("upload {}", row.id)),
        );
        let made_before = self.scene_repository.scene_of_idempotency_key(&key).await?;
        if made_before.is_none() {
            self.capacity.check_disk(0)?;
            self.import_service.check_quota(caller).await?;
        }
        let parse = wanted.parse.then_some(settings);
        let asked = SceneToMake {
            name: wanted.name.clone(),
            parse,
            idempotency_key: Some(key),
            made_before,
        };
        self.import_service.make_scene(asked, received, caller).await
    }
}

/// Returns whether creating the scene may succeed later.
fn is_transient(error: &Error) -> bool {
    error.is_transient()
        || matches!(error, Error::Jobs(JobsError::QueueFull { .. }) | Error::Background(_))
}

/// Describes errors for services without an HTTP layer.
pub fn default_problem(error: Error) -> Problem {
    Problem {
        kind: "about:blank".into(),
        title: "Error".into(),
        status: 422,
        detail: error.to_string(),
        code: error.code().into(),
        request_id: None,
        errors: Vec::new(),
        job_id: None,
        retry_after_s: None,
    }
}
