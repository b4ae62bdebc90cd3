//! The work of a process: everything, or a part next to other processes on the same database.

use super::ServeConfig;
use uniground_jobs::JobKind;
use uniground_service::{BatchJob, FullParseJob, NamingJob, ParseJob};

/// The role of `uniground serve`.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, clap::ValueEnum)]
pub enum Role {
    /// Answers requests and runs jobs
    #[default]
    All,
    /// Only answers requests. Jobs run in `uniground worker`
    Api,
}

/// A kind of background job.
#[derive(Debug, Clone, Copy, PartialEq, Eq, clap::ValueEnum)]
pub enum JobType {
    /// Parses of scans, drafts and full ones
    Parse,
    /// Naming of all objects of a scene by a model
    Naming,
    /// Batches of questions
    Batch,
}

impl JobType {
    /// All kinds of jobs.
    pub const ALL: [Self; 3] = [Self::Parse, Self::Naming, Self::Batch];

    /// Returns the names of the kind's queues in the database.
    #[must_use]
    pub const fn kinds(self) -> &'static [&'static str] {
        match self {
            Self::Parse => &[ParseJob::NAME, FullParseJob::NAME],
            Self::Naming => &[NamingJob::NAME],
            Self::Batch => &[BatchJob::NAME],
        }
    }
}

/// `uniground worker`
#[allow(clippy::doc_markdown)] // Help is plain text.
#[derive(Debug, Clone, clap::Args)]
#[command(mut_arg("listen", |arg| arg.default_value("127.0.0.1:8081").help("Address of /healthz, /readyz and /metrics; port 0 picks a free port")))]
#[command(mut_arg("role", |arg| arg.hide(true)))]
pub struct WorkerConfig {
    /// Kinds of jobs to run, comma-separated
    #[arg(long, env = "UNIGROUND_KINDS", value_enum, value_delimiter = ',', default_values_t = JobType::ALL, value_name = "KIND")]
    pub kinds: Vec<JobType>,
    /// Number of jobs of each kind to run in parallel [default: 1 parse, 4 naming, 4 batches]
    #[arg(long, env = "UNIGROUND_CONCURRENCY", value_name = "N", value_parser = clap::value_parser!(u16).range(1..=64))]
    pub concurrency: Option<u16>,
    #[command(flatten)]
    pub serve: ServeConfig,
}

/// The work that a process does.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct ProcessRole {
    /// Whether it serves the API. If not, it only serves health checks and metrics.
    pub serves: bool,
    pub works: Vec<JobType>,
    /// Number of parallel jobs of each kind, if configured.
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
    /// Returns whether other processes have to do the rest of the work.
    #[must_use]
    pub fn requires_other_processes(&self) -> bool {
        !self.serves || self.works.is_empty()
    }
}
