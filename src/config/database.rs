//! Where rows are kept.

use std::time::Duration;
use uniground_storage::{LEASE, Location};

/// Which database.
#[allow(clippy::doc_markdown)] // Help is no Markdown.
#[derive(Debug, Clone, PartialEq, Eq, clap::Args)]
pub struct DatabaseConfig {
    /// Where rows are kept: "sqlite", in a file of the data folder, or
    /// postgres://USER@HOST/DATABASE (password: there, in PGPASSWORD or in ~/.pgpass)
    #[arg(
        long = "database",
        env = "UNIGROUND_DATABASE",
        hide_env_values = true,
        value_name = "DATABASE",
        default_value = "sqlite"
    )]
    pub location: Location,
    /// Seconds after which a process that was not seen is taken to be gone, and what it was at
    /// work on is given to others; the same for all. Only with PostgreSQL
    #[arg(long, env = "UNIGROUND_LEASE_S", default_value_t = LEASE.as_secs(), value_name = "SECONDS", value_parser = clap::value_parser!(u64).range(10..=3600))]
    pub lease_s: u64,
    /// Where what encoders have seen is looked for, for questions about more rooms than are looked
    /// into one by one
    #[arg(long, env = "UNIGROUND_VECTORS", value_enum, default_value_t, value_name = "WHERE")]
    pub vectors: Vectors,
}

/// Where vectors are looked for.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, clap::ValueEnum)]
pub enum Vectors {
    /// Nowhere: names tell which rooms are worth a look
    #[default]
    Off,
    /// In PostgreSQL, which has the extension pgvector
    Pgvector,
}

impl DatabaseConfig {
    /// After which a process that was not seen is taken to be gone.
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
