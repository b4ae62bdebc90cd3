//! Where rows are kept.

use crate::store::Location;

/// Which database.
#[allow(clippy::doc_markdown)] // Help is no Markdown.
#[derive(Debug, Clone, PartialEq, Eq, clap::Args)]
pub struct DatabaseConfig {
    /// Where rows are kept: "sqlite", in a file of the data folder, or postgres://USER@HOST/DATABASE (password: there, in PGPASSWORD or in
    /// ~/.pgpass)
    #[arg(long = "database", env = "UNIGROUND_DATABASE", hide_env_values = true, value_name = "DATABASE", default_value = "sqlite")]
    pub location: Location,
}

impl Default for DatabaseConfig {
    fn default() -> Self {
        Self { location: Location::Folder }
    }
}
