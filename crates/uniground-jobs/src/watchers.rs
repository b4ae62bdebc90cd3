//! Watching jobs. One task polls each watched job, however many watchers it has, and wakes them
//! when it has changed.

use super::{Job, Jobs, JobsError};
use std::collections::HashMap;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;
use tokio::sync::watch;
use tokio::time::sleep;
use uniground_storage::JobRow;

/// Polling interval of a watched job.
const POLL_INTERVAL: Duration = Duration::from_millis(150);
/// Polling interval after an error of the database.
const RETRY_INTERVAL: Duration = Duration::from_millis(1500);

/// The watched jobs by id.
#[derive(Clone, Default)]
pub(super) struct JobWatchers(Arc<Mutex<HashMap<String, watch::Sender<Job>>>>);

impl JobWatchers {
    fn all(&self) -> MutexGuard<'_, HashMap<String, watch::Sender<Job>>> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// Returns whether two states of a job look the same to a caller.
fn is_same(a: &Job, b: &Job) -> bool {
    let visible_state = |job: &Job| {
        (job.attempts, job.state, job.ahead, job.stage.clone(), (job.progress * 1000.0) as i32)
    };
    visible_state(a) == visible_state(b)
}

impl Jobs {
    /// Returns a job and its future changes: the receiver gets every change until the job is
    /// finished or deleted, or nobody watches it.
    ///
    /// # Errors
    /// [`JobsError::NotFound`].
    pub async fn follow(&self, id: &str) -> Result<watch::Receiver<Job>, JobsError> {
        if let Some(followed) = self.followed.all().get(id) {
            return Ok(followed.subscribe());
        }
        let job = self.get(id).await?;
        let mut all = self.followed.all();
        // Another caller may have started watching meanwhile.
        if let Some(followed) = all.get(id) {
            return Ok(followed.subscribe());
        }
        let is_over = job.state.is_final();
        let (sender, receiver) = watch::channel(job);
        if !is_over {
            all.insert(id.to_owned(), sender);
            tokio::spawn(self.clone().poll_until_finished(id.to_owned()));
        }
        Ok(receiver)
    }

    /// Reads a job. The state of a running one comes from memory.
    async fn look(&self, id: &str) -> Result<Job, JobsError> {
        let running = self.running().get(id).map(|running| running.row.clone());
        match running {
            Some(row) => Ok(self.to_job(JobRow::clone(&row))),
            None => self.get(id).await,
        }
    }

    /// Polls a job as long as it is watched and not finished.
    async fn poll_until_finished(self, id: String) {
        let mut wait = POLL_INTERVAL;
        loop {
            sleep(wait).await;
            // Under the lock, so that no new watcher can subscribe between the check and the
            // removal.
            {
                let mut all = self.followed.all();
                if all.get(&id).is_none_or(watch::Sender::is_closed) {
                    all.remove(&id);
                    return;
                }
            }
            let job = self.look(&id).await;
            wait = if matches!(job, Err(JobsError::Store(_) | JobsError::QueueFull { .. })) {
                RETRY_INTERVAL
            } else {
                POLL_INTERVAL
            };
            let mut all = self.followed.all();
            let is_over = match (job, all.get(&id)) {
                (Ok(job), Some(followed)) => {
                    let is_over = job.state.is_final();
                    followed.send_if_modified(|before| {
                        let changed = !is_same(before, &job);
                        *before = job;
                        changed
                    });
                    is_over
                }
                (Err(JobsError::NotFound { .. }), _) | (_, None) => true,
                (Err(_), _) => false,
            };
            if is_over {
                all.remove(&id);
                return;
            }
        }
    }
}
