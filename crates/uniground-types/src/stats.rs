//! What a server holds, does and may spend, in numbers: for people, and for programs without
//! Prometheus.

use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;

/// A server in numbers.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct Stats {
    /// Version of the server, like `1.2.3`.
    pub version: String,
    /// When it was started, RFC 3339 UTC.
    pub started_at: String,
    /// Whole seconds since then.
    pub uptime_s: u64,
    /// What is stored.
    pub stored: StoredCounts,
    /// By kind, in alphabetical order.
    pub jobs: Vec<JobStats>,
    /// What models have cost.
    pub spending: Spending,
    /// How much room everything takes.
    pub disk: DiskUse,
    /// How long things are kept.
    pub retention: Retention,
}

/// How many there are of what is stored.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct StoredCounts {
    /// Scenes, parsed or not.
    pub scenes: u32,
    /// Finished parses; scenes with the same content and settings share one.
    pub parses: u32,
    /// Instances of all parses, of every level.
    pub instances: u32,
    /// Answers that can be asked for again.
    pub answers: u32,
    /// Batches by state: `running`, `paused`, `succeeded`, `cancelled`; one whose job ended early
    /// counts as running here.
    pub batches: BTreeMap<String, u32>,
}

/// Jobs of one kind. Those that are over are kept on record.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct JobStats {
    /// What they do: `parse`, `naming`, `batch`.
    pub kind: String,
    /// Whether this server works on them.
    pub working: bool,
    /// Waiting for their turn, or for another try.
    pub queued: u32,
    /// In a worker's hands.
    pub running: u32,
    /// Done.
    pub succeeded: u32,
    /// Given up.
    pub failed: u32,
    /// Stopped because somebody asked for it.
    pub cancelled: u32,
    /// How long ago the oldest that waits was asked for, seconds; `null` where none waits.
    pub oldest_queued_s: Option<f64>,
}

/// What vision-language models have cost, at the prices the server was given.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct Spending {
    /// The day, UTC.
    pub day: String,
    /// Spent on it, US dollars.
    pub today_usd: f64,
    /// What may be spent in a day, US dollars; `null` without a limit.
    pub daily_limit_usd: Option<f64>,
}

/// Bytes on the disk.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct DiskUse {
    /// The database with its journal.
    pub database_bytes: u64,
    /// Files by kind: `contents` (scans), `parses`, `checkpoints`, `answers` (what models were
    /// shown), `uploads` (in parts), `tmp`, `quarantine`. Measured in the background, a minute
    /// apart at least; `null` until that was done once.
    pub blob_bytes: Option<BTreeMap<String, u64>>,
    /// What may still be written.
    pub free_bytes: u64,
}

/// How long things are kept, in days, and how much of what only saves time. 0 days: for ever,
/// except for evidence.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct Retention {
    /// Answers.
    pub answers_days: u32,
    /// Prompts, replies and pictures of answers; 0: none are kept.
    pub evidence_days: u32,
    /// Jobs that are over and that no scene and no batch refers to.
    pub jobs_days: u32,
    /// Batches that are over, with their items.
    pub batches_days: u32,
    /// Idempotency keys of uploads.
    pub idempotency_days: u32,
    /// What was done, and with whose key.
    pub audit_days: u32,
    /// Parses, from when no scene and no answer refers to them.
    pub superseded_days: u32,
    /// Uploads that come in parts, from the last part.
    pub uploads_days: u32,
    /// Finished stages of parses, from their last use.
    pub checkpoints_days: u32,
    /// Of all finished stages together; those go first that were not used for longest.
    pub checkpoints_bytes: u64,
    /// Folders no record speaks of; not a setting.
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
