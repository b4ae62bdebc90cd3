//! Sends webhooks to another server when jobs end: each at least once, in any order, with retries
//! for half a day. Off if no webhook is configured.

use super::BatchJob;
use crate::error::Error;
use crate::webhook::{Webhook, WebhookError};
use crate::{BatchService, ServiceLocks};
use futures::future::join_all;
use jiff::Timestamp;
use serde::Serialize;
use std::sync::Arc;
use std::time::Duration;
use tokio::time::sleep;
use tokio_util::sync::CancellationToken;
use uniground_jobs::{Job, JobKind, Jobs, JobsError};
use uniground_storage::{JobState, LockTable, NamedLock, WebhookRepository};
use uniground_types::batch::Batch;

/// The interval between checks for jobs that have ended.
const POLL_INTERVAL: Duration = Duration::from_secs(1);
/// Webhooks delivered at once.
const MAX_CONCURRENT_DELIVERIES: u32 = 8;
/// The wait after the first failed attempt. It doubles up to the longest wait.
const MIN_BACKOFF: Duration = Duration::from_secs(5);
const MAX_BACKOFF: Duration = Duration::from_hours(2);
/// The maximum number of attempts. They take about twelve hours.
const TRIES: u32 = 17;

/// The body of a webhook.
#[derive(Serialize)]
struct WebhookEvent {
    /// `job.succeeded`, `job.failed`, `job.cancelled`.
    #[serde(rename = "type")]
    kind: &'static str,
    /// When the job ended, RFC 3339 UTC.
    timestamp: String,
    data: WebhookData,
}

#[derive(Serialize)]
struct WebhookData {
    job: Job,
    /// The state of the batch, if the job is that of a batch.
    #[serde(skip_serializing_if = "Option::is_none")]
    batch: Option<Batch>,
}

/// Delivers webhooks about finished jobs.
#[derive(Clone)]
pub struct WebhookService {
    pub(crate) webhook_repository: WebhookRepository,
    pub(crate) service_locks: Arc<ServiceLocks>,
    pub(crate) named_locks: LockTable,
    pub(crate) jobs: Jobs,
    pub(crate) batch_service: Arc<BatchService>,
}

impl WebhookService {
    /// Sends webhooks for all jobs that end, until `shutdown`. The next server sends what could not
    /// be delivered.
    pub async fn deliver_webhooks(
        self: Arc<Self>,
        webhook: Arc<Webhook>,
        shutdown: CancellationToken,
    ) {
        let mut lock = None;
        while !shutdown.is_cancelled() {
            let delivering = self.deliver_due(&webhook, &mut lock);
            match shutdown.run_until_cancelled(delivering).await {
                // More webhooks may be due.
                Some(Ok(true)) => continue,
                Some(Ok(false)) | None => {}
                Some(Err(error)) => tracing::warn!(
                    error = &error as &dyn std::error::Error,
                    "webhook event could not be read"
                ),
            }
            let _ = shutdown.run_until_cancelled(sleep(POLL_INTERVAL)).await;
        }
    }

    /// Sends some webhooks that are due, if this process holds the lock. Returns whether there were
    /// any.
    async fn deliver_due(
        &self,
        webhook: &Arc<Webhook>,
        lock: &mut Option<NamedLock>,
    ) -> Result<bool, Error> {
        // One process sends all webhooks. Another one takes over when it is gone.
        if let Some(ours) = lock.take() {
            *lock = Some(ours).filter(NamedLock::is_ours);
        }
        if lock.is_none() {
            *lock = self.service_locks.try_lock_webhook_delivery().await?;
        }
        if lock.is_none() {
            return Ok(false);
        }
        let due = self.webhook_repository.due_deliveries(MAX_CONCURRENT_DELIVERIES).await?;
        let any = !due.is_empty();
        join_all(
            due.into_iter().map(|(job_id, tried)| {
                self.clone().deliver_and_log(webhook.clone(), job_id, tried)
            }),
        )
        .await;
        Ok(any)
    }

    /// Starts recording the ends of jobs if a webhook is configured. Otherwise stops recording and
    /// drops what was recorded earlier.
    ///
    /// # Errors
    /// [`Error::Store`].
    pub async fn set_deliveries_enabled(&self, webhook: Option<&Webhook>) -> Result<(), Error> {
        match webhook {
            Some(_) => self.webhook_repository.enable_deliveries().await?,
            // Other processes may have a webhook.
            None if !self.named_locks.was_alone_at_start() => {}
            None => self.webhook_repository.disable_deliveries().await?,
        }
        Ok(())
    }

    async fn deliver_and_log(self, webhook: Arc<Webhook>, job_id: String, tried: u32) {
        if let Err(error) = self.deliver_job_event(&webhook, &job_id, tried).await {
            tracing::warn!(
                job_id,
                error = &error as &dyn std::error::Error,
                "webhook delivery failed; retrying later"
            );
            sleep(POLL_INTERVAL).await;
        }
    }

    async fn deliver_job_event(
        &self,
        webhook: &Webhook,
        job_id: &str,
        tried: u32,
    ) -> Result<(), Error> {
        let job = match self.jobs.get(job_id).await {
            Err(JobsError::NotFound { .. }) => {
                return Ok(self.webhook_repository.delete_delivery(job_id).await?);
            }
            job => job?,
        };
        // The id is the same for every retry, so that the receiver can detect duplicates.
        let id = format!("msg_{job_id}");
        let body = serde_json::to_string(&self.to_event(job).await?)?;
        match webhook.deliver(&id, Timestamp::now().as_second(), body).await {
            // Delivered. Status 410 means that the receiver is gone for good.
            Ok(()) | Err(WebhookError::Refused(410)) => {
                self.webhook_repository.delete_delivery(job_id).await?;
            }
            Err(error) if tried + 1 >= TRIES => {
                tracing::error!(
                    job_id,
                    tries = TRIES,
                    error = &error as &dyn std::error::Error,
                    "webhook delivery abandoned after the last attempt"
                );
                self.webhook_repository.delete_delivery(job_id).await?;
            }
            Err(error) => {
                let wait = MIN_BACKOFF.saturating_mul(1 << tried.min(16)).min(MAX_BACKOFF);
                let again_in_s = wait.as_secs();
                tracing::warn!(
                    job_id,
                    again_in_s,
                    error = &error as &dyn std::error::Error,
                    "webhook delivery failed; retrying"
                );
                self.webhook_repository.postpone_delivery(job_id, wait).await?;
            }
        }
        Ok(())
    }

    async fn to_event(&self, job: Job) -> Result<WebhookEvent, Error> {
        let kind = match job.state {
            JobState::Succeeded => "job.succeeded",
            JobState::Cancelled => "job.cancelled",
            JobState::Failed | JobState::Queued | JobState::Running => "job.failed",
        };
        let batch = match job.kind.as_str() {
            BatchJob::NAME => self.batch_service.batch(&job.subject).await.ok(),
            _ => None,
        };
        Ok(WebhookEvent {
            kind,
            timestamp: job.finished_at.clone().unwrap_or_default(),
            data: WebhookData { job, batch },
        })
    }
}
