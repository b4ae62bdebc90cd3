//! Jobs that somebody follows: each is looked at by one task, however many follow it, and those who
//! wait are woken when it has changed.

use super::{Job, Jobs, JobsError};
use std::collections::HashMap;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;
use tokio::sync::watch;
use tokio::time::sleep;
use uniground_storage::JobRow;

/// How often a job that is followed is looked at.
const LOOK_EVERY: Duration = Duration::from_millis(150);
/// And where the database is busy for a moment.
const TROUBLE: Duration = Duration::from_millis(1500);

/// Those that are followed now, by id.
#[derive(Clone, Default)]
pub(super) struct JobWatchers(Arc<Mutex<HashMap<String, watch::Sender<Job>>>>);

impl JobWatchers {
    fn all(&self) -> MutexGuard<'_, HashMap<String, watch::Sender<Job>>> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// Whether two looks at a job tell a caller the same.
fn is_same(a: &Job, b: &Job) -> bool {
    let told = |job: &Job| {
        (job.attempts, job.state, job.ahead, job.stage.clone(), (job.progress * 1000.0) as i32)
    };
    told(a) == told(b)
}

impl Jobs {
    /// A job as it stands, and as it will: the receiver is told of every change until the job is
    /// over, gone, or nobody follows it.
    ///
    /// # Errors
    /// [`JobsError::NotFound`].
    pub async fn follow(&self, id: &str) -> Result<watch::Receiver<Job>, JobsError> {
        if let Some(followed) = self.followed.all().get(id) {
            return Ok(followed.subscribe());
        }
        let job = self.get(id).await?;
        let mut all = self.followed.all();
        // Somebody else may have come meanwhile.
        if let Some(followed) = all.get(id) {
            return Ok(followed.subscribe());
        }
        let is_over = job.state.is_final();
        let (sender, receiver) = watch::channel(job);
        if !is_over {
            all.insert(id.to_owned(), sender);
            tokio::spawn(self.clone().look_after(id.to_owned()));
        }
        Ok(receiver)
    }

    /// One that runs is told from memory.
    async fn look(&self, id: &str) -> Result<Job, JobsError> {
        let running = self.running().get(id).map(|running| running.row.clone());
        match running {
            Some(row) => Ok(self.as_it_stands(JobRow::clone(&row))),
            None => self.get(id).await,
        }
    }

    /// Looks at a job again and again, as long as it is followed and not over.
    async fn look_after(self, id: String) {
        let mut wait = LOOK_EVERY;
        loop {
            sleep(wait).await;
            // Nobody can begin to follow between the question and the end.
            {
                let mut all = self.followed.all();
                if all.get(&id).is_none_or(watch::Sender::is_closed) {
                    all.remove(&id);
                    return;
                }
            }
            let job = self.look(&id).await;
            wait = if matches!(job, Err(JobsError::Store(_) | JobsError::QueueFull { .. })) {
                TROUBLE
            } else {
                LOOK_EVERY
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
