//! Statistics of a server: stored data, jobs, spending and disk usage.

use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;

/// Statistics of a server.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct Stats {
    /// Version of the server, like `1.2.3`.
    pub version: String,
    /// Start time, RFC 3339 UTC.
    pub started_at: String,
    /// Uptime, whole seconds.
    pub uptime_s: u64,
    /// Numbers of stored records.
    pub stored: StoredCounts,
    /// Job statistics per kind, in alphabetical order.
    pub jobs: Vec<JobStats>,
    /// Spending on models.
    pub spending: Spending,
    /// Disk usage.
    pub disk: DiskUse,
    /// Retention settings.
    pub retention: Retention,
}

/// Numbers of stored records.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct StoredCounts {
    /// Number of scenes, parsed or not.
    pub scenes: u32,
    /// Number of finished parses. Scenes with the same content and settings share one.
    pub parses: u32,
    /// Number of instances of all parses and levels.
    pub instances: u32,
    /// Number of stored answers.
    pub answers: u32,
    /// Number of batches by state: `running`, `paused`, `succeeded`, `cancelled`. A batch whose job
    /// ended early counts as running.
    pub batches: BTreeMap<String, u32>,
}

/// Statistics of one kind of job. Finished jobs count until retention removes them.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct JobStats {
    /// Kind of job: `parse`, `full_parse`, `naming`, `batch`.
    pub kind: String,
    /// Whether this server runs these jobs.
    pub working: bool,
    /// Number of jobs that wait for a worker or a retry.
    pub queued: u32,
    /// Number of running jobs.
    pub running: u32,
    /// Number of succeeded jobs.
    pub succeeded: u32,
    /// Number of failed jobs.
    pub failed: u32,
    /// Number of cancelled jobs.
    pub cancelled: u32,
    /// Age of the oldest queued job, seconds. `null` if none is queued.
    pub oldest_queued_s: Option<f64>,
}

/// Spending on vision-language models at the configured prices.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct Spending {
    /// Day, UTC.
    pub day: String,
    /// Spending on this day, US dollars.
    pub today_usd: f64,
    /// Spending limit per day, US dollars. `null` if none is set.
    pub daily_limit_usd: Option<f64>,
}

/// Disk usage in bytes.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct DiskUse {
    /// Size of the database with its journal.
    pub database_bytes: u64,
    /// Size of files by kind: `contents` (scans), `parses`, `checkpoints`, `answers` (evidence of
    /// models), `uploads` (unfinished), `tmp`, `quarantine`. Measured in the background at most
    /// once a minute. `null` before the first measurement.
    pub blob_bytes: Option<BTreeMap<String, u64>>,
    /// Available disk space.
    pub free_bytes: u64,
}

/// Retention periods in days and size limits. 0 keeps data forever, except for evidence.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct Retention {
    /// Retention of answers, days.
    pub answers_days: u32,
    /// Retention of prompts, replies and pictures of answers, days. 0 stores none.
    pub evidence_days: u32,
    /// Retention of finished jobs that no scene or batch refers to, days.
    pub jobs_days: u32,
    /// Retention of finished batches and their items, days.
    pub batches_days: u32,
    /// Retention of idempotency keys, days.
    pub idempotency_days: u32,
    /// Retention of the audit log, days.
    pub audit_days: u32,
    /// Retention of parses that no scene or answer refers to, days.
    pub superseded_days: u32,
    /// Retention of resumable uploads since their last part, days.
    pub uploads_days: u32,
    /// Retention of parse checkpoints since their last use, days.
    pub checkpoints_days: u32,
    /// Maximum total size of parse checkpoints, bytes. The least recently used ones are removed
    /// first.
    pub checkpoints_bytes: u64,
    /// Retention of quarantined orphan folders, days. Not configurable.
    pub quarantine_days: u32,
}

impl Default for Retention {
    fn default() -> Self {
        Self {
            answers_days: 365,
            evidence_days: 30,
            jobs_days: 90,
            batches_days: 90,
            idempotency_days: 30,
            audit_days: 365,
            superseded_days: 30,
            uploads_days: 7,
            checkpoints_days: 14,
            checkpoints_bytes: 20 << 30,
            quarantine_days: 7,
        }
    }
}
