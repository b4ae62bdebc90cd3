//! Limits how many questions are computed at once.

use crate::QUEUE_TIMEOUT;
use crate::error::Error;
use std::sync::Arc;
use tokio::sync::{OwnedSemaphorePermit, Semaphore};
use tokio::task::spawn_blocking;
use tokio::time::timeout;

/// Limits how many questions are computed at once.
#[derive(Clone)]
pub struct QuestionPermits {
    pub(crate) permits: Arc<Semaphore>,
}

impl QuestionPermits {
    /// Waits for a permit to compute a question, for at most `QUEUE_TIMEOUT`.
    pub(crate) async fn acquire(&self) -> Result<OwnedSemaphorePermit, Error> {
        let permit = timeout(QUEUE_TIMEOUT, self.permits.clone().acquire_owned()).await;
        permit.ok().and_then(Result::ok).ok_or(Error::Overloaded)
    }

    /// Computes for a question outside the async threads, once it has a permit.
    pub(crate) async fn compute<T: Send + 'static>(
        &self,
        work: impl FnOnce() -> Result<T, Error> + Send + 'static,
    ) -> Result<T, Error> {
        let permit = self.acquire().await?;
        let span = tracing::Span::current();
        spawn_blocking(move || {
            let _permit = permit;
            span.in_scope(work)
        })
        .await?
    }
}
