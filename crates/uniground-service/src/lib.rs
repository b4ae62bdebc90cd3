//! Use cases: the only place where pipelines meet storage and jobs. Contains no HTTP. Every noun of
//! the API has one folder.
//!
//! The pipelines (`uniground-core`) process questions and scans. This crate checks permissions and
//! budgets, stores data and caches it.

mod answers;
mod approach;
mod batches;
mod capacity;
mod corrections;
mod doctor;
pub mod error;
mod health;
mod instances;
mod keys;
mod maintenance;
mod names;
pub mod packing;
mod parses;
mod permits;
mod retention;
mod room_index;
pub mod sample;
mod scenes;
mod service_locks;
mod services;
mod single_flight_cache;
mod stats;
mod uploads;
mod vlm;
pub mod webhook;
mod webhook_deliveries;

pub use answers::LineFormat;
pub use answers::{AnswerService, GroundingService, Transcripts};
pub use approach::ApproachService;
pub use batches::{BatchBody, BatchJob, ResultRequest, Submission};
pub use batches::{BatchRunner, BatchService};
pub use capacity::Capacity;
pub use corrections::CorrectionService;
pub use corrections::GroundTruth;
pub use doctor::DoctorService;
pub use doctor::{Finding, FindingKind};
pub use health::Health;
pub use health::HealthService;
pub use instances::InstanceService;
pub use instances::{EvidenceFile, write_graph};
pub use keys::{
    AuditedRequest, Caller, KeyRejection, Keyring, LINK_PARAMETER, LinkSecret, RateLimitStatus,
};
pub use maintenance::MaintenanceService;
pub use names::NamingJob;
pub use names::NamingService;
pub use parses::{FileDownload, FullParseJob, ParseFile, ParseJob, ParseMode};
pub use parses::{MediaService, ParseRunner, ParseService, ParsedScenes};
pub use permits::QuestionPermits;
pub use retention::{RetentionReport, RunMode};
pub use room_index::RoomSearch;
pub use scenes::{
    ChangeService, ExportService, GrowthService, ImportService, SceneLookup, SceneService,
};
pub use scenes::{ExportFile, NewFrames, NewScene};
pub use service_locks::ServiceLocks;
pub use services::{Dependencies, Services};
pub use stats::StatsService;
pub use uploads::Explain;
pub use uploads::UploadService;
pub use uploads::{Checksum, ChecksumAlgorithm, NewUpload, UploadPart};
pub use vlm::{Vlm, VlmSettings, WhenNamed};
pub use webhook_deliveries::WebhookService;

use crate::error::Error;
use std::time::Duration;
use uniground_geometry::progress::{Cancelled, Progress};
use uniground_ingest::archive::UnpackLimits;
use uniground_jobs::JobFailure;
use uniground_models::with_causes;
use uniground_types::stats::Retention;

/// Limits on uploads, questions and storage.
#[derive(Debug, Clone, Copy)]
pub struct Limits {
    pub max_upload_bytes: u64,
    /// The maximum number of unfinished resumable uploads.
    pub max_unfinished_uploads: u32,
    pub unpack: UnpackLimits,
    /// Disk space in bytes that uploads, parses and batches must leave free.
    pub keep_free_bytes: u64,
    /// The maximum memory of the process in bytes. `None` means the limit of the system.
    pub max_memory_bytes: Option<u64>,
    /// Questions answered concurrently. Further questions wait for a short time.
    pub max_concurrent_questions: usize,
    pub retention: Retention,
}

/// Uploads received concurrently.
const MAX_UPLOADS: usize = 16;
/// Comparisons of two scans computed concurrently.
const MAX_COMPARISONS: usize = 2;
/// Scenes scanned concurrently for questions about many scenes, over all callers. They take few of
/// the question permits and few connections of the database.
const MAX_CONCURRENT_SCENE_SCANS: usize = 2;
/// How long a question waits for a permit before it fails as overloaded.
const QUEUE_TIMEOUT: Duration = Duration::from_secs(2);

/// Converts an error to the failure of a job.
fn job_failure(error: Error) -> JobFailure {
    match error.code() {
        "cancelled" => JobFailure::Cancelled,
        code => JobFailure::Failed {
            code: code.to_owned(),
            detail: error.to_string(),
            cause: with_causes(&error),
            transient: error.is_transient(),
        },
    }
}

/// Returns once the job is cancelled.
async fn until_cancelled(progress: &Progress) -> Cancelled {
    const POLL_INTERVAL: Duration = Duration::from_millis(100);
    loop {
        if let Err(cancelled) = progress.check() {
            return cancelled;
        }
        tokio::time::sleep(POLL_INTERVAL).await;
    }
}
