//! Which parses a scene gets, and the jobs that make them.

use super::job::{FullParseJob, ParseJob};
use uniground_jobs::{JobRequest, Jobs, JobsError};
use uniground_models::neural::Models;
use uniground_parsing::scan::{model_names, select_models};
use uniground_storage::{InsertedJob, NewJob, StoreError};
use uniground_types::settings::{ParseModels, ParseSettings};

/// Which parses a server with neural networks makes of a new scene.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub enum ParseMode {
    /// A draft with the built-in methods, which takes seconds, then the full parse.
    #[default]
    DraftFirst,
    /// Only the full parse.
    FullOnly,
    /// Only the draft. A full parse is made on request.
    DraftOnly,
}

/// A requested parse: to be computed, or already stored.
pub(crate) struct PreparedParse {
    pub job: ParseRequest,
    /// Whether the job is done, because the parse is stored.
    pub is_stored: bool,
}

/// A request to queue a parse, in one of two queues.
pub(crate) enum ParseRequest {
    Parse(JobRequest<ParseJob>),
    Full(JobRequest<FullParseJob>),
}

impl ParseRequest {
    /// Returns the row to insert.
    pub fn row(&self) -> NewJob<'_> {
        match self {
            Self::Parse(job) => job.row(),
            Self::Full(job) => job.row(),
        }
    }

    /// Queues the job, see [`Jobs::enqueue`].
    ///
    /// # Errors
    /// Those of [`Jobs::enqueue`].
    pub async fn enqueue<T: InsertedJob>(
        &self,
        jobs: &Jobs,
        insert: impl Future<Output = Result<T, StoreError>>,
    ) -> Result<T, JobsError> {
        match self {
            Self::Parse(job) => jobs.enqueue(job, insert).await,
            Self::Full(job) => jobs.enqueue(job, insert).await,
        }
    }
}

/// Returns whether a parse with these settings used the built-in methods only, although the
/// settings allow networks and the server has some.
pub(crate) fn is_draft(settings: &ParseSettings, used: &ParseModels, models: &Models) -> bool {
    *used == model_names(&Models::default())
        && !select_models(settings.models, models).loaded.is_empty()
}
