//! How long things are kept.

use uniground_types::stats::Retention;

/// How long things are kept, and how much of what only saves time. What is over goes once a day;
/// `uniground gc` does it at once.
#[derive(Debug, Clone, clap::Args)]
pub struct RetentionConfig {
    /// Days for which answers are kept; 0: for ever
    #[arg(long, env = "UNIGROUND_KEEP_ANSWERS_DAYS", default_value_t = Retention::default().answers_days, value_name = "DAYS", value_parser = clap::value_parser!(u32).range(..=36_500))]
    pub keep_answers_days: u32,
    /// Days for which the pictures, prompts and replies of answers by a model are kept; 0: none
    /// are
    #[arg(long, env = "UNIGROUND_KEEP_EVIDENCE_DAYS", default_value_t = Retention::default().evidence_days, value_name = "DAYS", value_parser = clap::value_parser!(u32).range(..=36_500))]
    pub keep_evidence_days: u32,
    /// Days for which jobs are kept that are over and that no scene and no batch refers to; 0: for
    /// ever
    #[arg(long, env = "UNIGROUND_KEEP_JOBS_DAYS", default_value_t = Retention::default().jobs_days, value_name = "DAYS", value_parser = clap::value_parser!(u32).range(..=36_500))]
    pub keep_jobs_days: u32,
    /// Days for which batches are kept that are over, with their items; their answers have an age
    /// of their own; 0: for ever
    #[arg(long, env = "UNIGROUND_KEEP_BATCHES_DAYS", default_value_t = Retention::default().batches_days, value_name = "DAYS", value_parser = clap::value_parser!(u32).range(..=36_500))]
    pub keep_batches_days: u32,
    /// Days for which the idempotency key of an upload or a question is remembered; 0: for good
    #[arg(long, env = "UNIGROUND_KEEP_IDEMPOTENCY_DAYS", default_value_t = Retention::default().idempotency_days, value_name = "DAYS", value_parser = clap::value_parser!(u32).range(..=36_500))]
    pub keep_idempotency_days: u32,
    /// Days for which it is remembered what was changed, and with whose key; 0: for ever
    #[arg(long, env = "UNIGROUND_KEEP_AUDIT_DAYS", default_value_t = Retention::default().audit_days, value_name = "DAYS", value_parser = clap::value_parser!(u32).range(..=36_500))]
    pub keep_audit_days: u32,
    /// Days for which a parse is kept that no scene and no answer refers to any more; 0: as long
    /// as its scan
    #[arg(long, env = "UNIGROUND_KEEP_SUPERSEDED_DAYS", default_value_t = Retention::default().superseded_days, value_name = "DAYS", value_parser = clap::value_parser!(u32).range(..=36_500))]
    pub keep_superseded_days: u32,
    /// Days for which an upload that comes in parts waits for the next one, and for which it is
    /// told what came of it; 0: for ever
    #[arg(long, env = "UNIGROUND_KEEP_UPLOADS_DAYS", default_value_t = Retention::default().uploads_days, value_name = "DAYS", value_parser = clap::value_parser!(u32).range(..=36_500))]
    pub keep_uploads_days: u32,
    /// Days for which finished stages of parses are kept that no parse uses; 0: as long as their
    /// scan
    #[arg(long, env = "UNIGROUND_KEEP_CHECKPOINTS_DAYS", default_value_t = Retention::default().checkpoints_days, value_name = "DAYS", value_parser = clap::value_parser!(u32).range(..=36_500))]
    pub keep_checkpoints_days: u32,
    /// Most that finished stages of parses may take together, bytes
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
