//! Requests to queue a job.

use super::JobKind;
use std::marker::PhantomData;
use uniground_storage::{NewJob, StoreError};

/// A request to queue a job of the kind `K`.
#[derive(Debug)]
pub struct JobRequest<K> {
    payload: String,
    key_id: Option<String>,
    /// The id of an existing result, and a message about it.
    done: Option<(String, String)>,
    /// Whether a full queue rejects the job.
    pub(super) is_limited: bool,
    kind: PhantomData<fn() -> K>,
}

impl<K> Clone for JobRequest<K> {
    fn clone(&self) -> Self {
        Self {
            payload: self.payload.clone(),
            key_id: self.key_id.clone(),
            done: self.done.clone(),
            is_limited: self.is_limited,
            kind: PhantomData,
        }
    }
}

impl<K: JobKind> JobRequest<K> {
    /// Creates a request. `key_id` is the API key that asks for the job.
    ///
    /// # Errors
    /// [`StoreError`] if the payload cannot be written as JSON.
    pub fn new(payload: &K::Payload, key_id: Option<&str>) -> Result<Self, StoreError> {
        Ok(Self {
            payload: serde_json::to_string(payload)?,
            key_id: key_id.map(str::to_owned),
            done: None,
            is_limited: true,
            kind: PhantomData,
        })
    }

    /// Marks the job as done, with the stored result that it would have computed. A done job does
    /// not wait, so a full queue does not reject it.
    #[must_use]
    pub fn with_result(self, result_id: String, message: &str) -> Self {
        Self { done: Some((result_id, message.to_owned())), is_limited: false, ..self }
    }

    /// Lets the job wait even if its queue is full: for repairs that the server starts itself.
    #[must_use]
    pub fn without_limit(self) -> Self {
        Self { is_limited: false, ..self }
    }

    /// Returns the row to insert.
    #[must_use]
    pub fn row(&self) -> NewJob<'_> {
        NewJob {
            kind: K::NAME,
            payload: &self.payload,
            key_id: self.key_id.as_deref(),
            done: self.done.as_ref().map(|(id, message)| (id.as_str(), message.as_str())),
        }
    }
}
