//! What of the whole a process does: all of it, or a part beside others over the same database.

use super::ServeConfig;
use uniground_jobs::JobKind;
use uniground_service::{BatchJob, NamingJob, ParseJob};

/// What `uniground serve` does.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, clap::ValueEnum)]
pub enum Role {
    /// Answers requests and does the work that waits
    #[default]
    All,
    /// Answers requests only: jobs are done by `uniground worker`
    Api,
}

/// Work that waits in a queue.
#[derive(Debug, Clone, Copy, PartialEq, Eq, clap::ValueEnum)]
pub enum JobType {
    /// Scans that are cut into instances
    Parse,
    /// Scenes whose things a model names
    Naming,
    /// Lists of questions
    Batch,
}

impl JobType {
    /// All there is.
    pub const ALL: [Self; 3] = [Self::Parse, Self::Naming, Self::Batch];

    /// As its jobs are stored.
    #[must_use]
    pub const fn kind(self) -> &'static str {
        match self {
            Self::Parse => ParseJob::NAME,
            Self::Naming => NamingJob::NAME,
            Self::Batch => BatchJob::NAME,
        }
    }
}

/// `uniground worker`
#[allow(clippy::doc_markdown)] // Help is no Markdown.
#[derive(Debug, Clone, clap::Args)]
#[command(mut_arg("listen", |arg| arg.default_value("127.0.0.1:8081").help("Address of /healthz, /readyz and /metrics; port 0 picks a free one")))]
#[command(mut_arg("role", |arg| arg.hide(true)))]
pub struct WorkerConfig {
    /// Which jobs to do
    #[arg(long, env = "UNIGROUND_KINDS", value_enum, value_delimiter = ',', default_values_t = JobType::ALL, value_name = "KIND")]
    pub kinds: Vec<JobType>,
    /// Jobs of each kind at once; default: 1 parse, 1 naming, 4 batches
    #[arg(long, env = "UNIGROUND_CONCURRENCY", value_name = "N", value_parser = clap::value_parser!(u16).range(1..=64))]
    pub concurrency: Option<u16>,
    #[command(flatten)]
    pub serve: ServeConfig,
}

/// What a process does.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct ProcessRole {
    /// Whether it answers requests; if not, it only tells how it is.
    pub serves: bool,
    pub works: Vec<JobType>,
    /// Jobs of each kind at once, where somebody says.
    pub concurrency: Option<usize>,
}

impl From<Role> for ProcessRole {
    fn from(role: Role) -> Self {
        let works = match role {
            Role::All => JobType::ALL.to_vec(),
            Role::Api => Vec::new(),
        };
        Self { serves: true, works, concurrency: None }
    }
}

impl From<&WorkerConfig> for ProcessRole {
    fn from(config: &WorkerConfig) -> Self {
        Self {
            serves: false,
            works: config.kinds.clone(),
            concurrency: config.concurrency.map(usize::from),
        }
    }
}

impl ProcessRole {
    /// Whether others have to do the rest.
    #[must_use]
    pub fn requires_other_processes(&self) -> bool {
        !self.serves || self.works.is_empty()
    }
}
