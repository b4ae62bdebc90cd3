//! Retention settings.

use uniground_types::stats::Retention;

/// Retention periods and size limits. Expired data is removed once a day, or immediately by
/// `uniground gc`.
#[derive(Debug, Clone, clap::Args)]
pub struct RetentionConfig {
    /// Retention of answers, days. 0 keeps them forever
    #[arg(long, env = "UNIGROUND_KEEP_ANSWERS_DAYS", default_value_t = Retention::default().answers_days, value_name = "DAYS", value_parser = clap::value_parser!(u32).range(..=36_500))]
    pub keep_answers_days: u32,
    /// Retention of pictures, prompts and replies of model answers, days. 0 stores none
    #[arg(long, env = "UNIGROUND_KEEP_EVIDENCE_DAYS", default_value_t = Retention::default().evidence_days, value_name = "DAYS", value_parser = clap::value_parser!(u32).range(..=36_500))]
    pub keep_evidence_days: u32,
    /// Retention of finished jobs that no scene or batch refers to, days. 0 keeps them forever
    #[arg(long, env = "UNIGROUND_KEEP_JOBS_DAYS", default_value_t = Retention::default().jobs_days, value_name = "DAYS", value_parser = clap::value_parser!(u32).range(..=36_500))]
    pub keep_jobs_days: u32,
    /// Retention of finished batches and their items, days. Their answers have their own retention.
    /// 0 keeps them forever
    #[arg(long, env = "UNIGROUND_KEEP_BATCHES_DAYS", default_value_t = Retention::default().batches_days, value_name = "DAYS", value_parser = clap::value_parser!(u32).range(..=36_500))]
    pub keep_batches_days: u32,
    /// Retention of idempotency keys of uploads and questions, days. 0 keeps them forever
    #[arg(long, env = "UNIGROUND_KEEP_IDEMPOTENCY_DAYS", default_value_t = Retention::default().idempotency_days, value_name = "DAYS", value_parser = clap::value_parser!(u32).range(..=36_500))]
    pub keep_idempotency_days: u32,
    /// Retention of the audit log, days. 0 keeps it forever
    #[arg(long, env = "UNIGROUND_KEEP_AUDIT_DAYS", default_value_t = Retention::default().audit_days, value_name = "DAYS", value_parser = clap::value_parser!(u32).range(..=36_500))]
    pub keep_audit_days: u32,
    /// Retention of parses that no scene or answer refers to, days. 0 keeps them as long as their
    /// scan
    #[arg(long, env = "UNIGROUND_KEEP_SUPERSEDED_DAYS", default_value_t = Retention::default().superseded_days, value_name = "DAYS", value_parser = clap::value_parser!(u32).range(..=36_500))]
    pub keep_superseded_days: u32,
    /// Retention of resumable uploads without progress, and of the results of finished ones, days.
    /// 0 keeps them forever
    #[arg(long, env = "UNIGROUND_KEEP_UPLOADS_DAYS", default_value_t = Retention::default().uploads_days, value_name = "DAYS", value_parser = clap::value_parser!(u32).range(..=36_500))]
    pub keep_uploads_days: u32,
    /// Retention of parse checkpoints (finished stages) that no parse uses, days. 0 keeps them as
    /// long as their scan
    #[arg(long, env = "UNIGROUND_KEEP_CHECKPOINTS_DAYS", default_value_t = Retention::default().checkpoints_days, value_name = "DAYS", value_parser = clap::value_parser!(u32).range(..=36_500))]
    pub keep_checkpoints_days: u32,
    /// Maximum total size of parse checkpoints, bytes
    #[arg(long, env = "UNIGROUND_MAX_CHECKPOINTS_BYTES", default_value_t = Retention::default().checkpoints_bytes, value_name = "BYTES")]
    pub max_checkpoints_bytes: u64,
}

impl Default for RetentionConfig {
    fn default() -> Self {
        let Retention {
            answers_days,
            evidence_days,
            jobs_days,
            batches_days,
            idempotency_days,
            audit_days,
            superseded_days,
            uploads_days,
            checkpoints_days,
            checkpoints_bytes,
            quarantine_days: _,
        } = Retention::default();
        Self {
            keep_answers_days: answers_days,
            keep_evidence_days: evidence_days,
            keep_jobs_days: jobs_days,
            keep_batches_days: batches_days,
            keep_idempotency_days: idempotency_days,
            keep_audit_days: audit_days,
            keep_superseded_days: superseded_days,
            keep_uploads_days: uploads_days,
            keep_checkpoints_days: checkpoints_days,
            max_checkpoints_bytes: checkpoints_bytes,
        }
    }
}

impl RetentionConfig {
    #[must_use]
    pub fn settings(&self) -> Retention {
        Retention {
            answers_days: self.keep_answers_days,
            evidence_days: self.keep_evidence_days,
            jobs_days: self.keep_jobs_days,
            batches_days: self.keep_batches_days,
            idempotency_days: self.keep_idempotency_days,
            audit_days: self.keep_audit_days,
            superseded_days: self.keep_superseded_days,
            uploads_days: self.keep_uploads_days,
            checkpoints_days: self.keep_checkpoints_days,
            checkpoints_bytes: self.max_checkpoints_bytes,
            ..Retention::default()
        }
    }
}
