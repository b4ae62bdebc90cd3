//! Database configuration.

use std::time::Duration;
use uniground_storage::{LEASE, Location};

/// Options of the database.
#[allow(clippy::doc_markdown)] // Help is plain text.
#[derive(Debug, Clone, PartialEq, Eq, clap::Args)]
pub struct DatabaseConfig {
    /// Database for all records: "sqlite" (a file in the data folder), or
    /// postgres://USER@HOST/DATABASE. The password is in the URL, in PGPASSWORD or in ~/.pgpass
    #[arg(
        long = "database",
        env = "UNIGROUND_DATABASE",
        hide_env_values = true,
        value_name = "DATABASE",
        default_value = "sqlite"
    )]
    pub location: Location,
    /// Lease duration, seconds. A process that misses its heartbeats for this long loses its jobs
    /// to other workers. Must be the same for all processes. PostgreSQL only
    #[arg(long, env = "UNIGROUND_LEASE_S", default_value_t = LEASE.as_secs(), value_name = "SECONDS", value_parser = clap::value_parser!(u64).range(10..=3600))]
    pub lease_s: u64,
    /// Vector index that preselects scenes, for questions about more scenes than are searched one
    /// by one
    #[arg(long, env = "UNIGROUND_VECTORS", value_enum, default_value_t, value_name = "WHERE")]
    pub vectors: Vectors,
}

/// The vector index for questions about many scenes.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, clap::ValueEnum)]
pub enum Vectors {
    /// No vector index. Object names preselect the scenes
    #[default]
    Off,
    /// PostgreSQL with the extension pgvector
    Pgvector,
}

impl DatabaseConfig {
    /// Time after which a process without heartbeats counts as lost.
    #[must_use]
    pub fn lease(&self) -> Duration {
        Duration::from_secs(self.lease_s)
    }
}

impl Default for DatabaseConfig {
    fn default() -> Self {
        Self { location: Location::Folder, lease_s: LEASE.as_secs(), vectors: Vectors::default() }
    }
}
