//! `uniground gc`: applies the retention settings to the data folder of a stopped server.

use super::table;
use crate::config::{BlobsConfig, DatabaseConfig, LimitsConfig, RetentionConfig};
use crate::telemetry;
use anyhow::Context;
use camino::Utf8PathBuf;
use serde_json::json;
use uniground_service::{Dependencies, RunMode, Services};
use uniground_storage::Store;

#[derive(Debug, clap::Args)]
pub struct GcArgs {
    /// Data folder of the server. The server must be stopped
    #[arg(long, env = "UNIGROUND_DATA_DIR", default_value = "./data")]
    data_dir: Utf8PathBuf,
    #[command(flatten)]
    database: DatabaseConfig,
    #[command(flatten)]
    blobs: BlobsConfig,
    /// Show what would be removed without removing it
    #[arg(long)]
    dry_run: bool,
    /// Print the result as JSON
    #[arg(long)]
    json: bool,
    #[command(flatten)]
    retention: RetentionConfig,
}

/// Unused bytes in the database from which it is compacted even if this run removed nothing.
const WORTH_COMPACTING_BYTES: u64 = 16 << 20;

pub async fn run(args: &GcArgs) -> anyhow::Result<()> {
    telemetry::start_quiet();
    let GcArgs { data_dir, database, blobs, dry_run, json: as_json, retention } = args;
    let opened = match dry_run {
        true => Store::open_copy(data_dir).await,
        false => Store::open_known(data_dir, &database.location, &blobs.blob_home()?).await,
    };
    let store = opened.with_context(|| format!("the data folder {data_dir}"))?;
    let limits = LimitsConfig { retention: retention.clone(), ..LimitsConfig::default() };
    let dependencies = Dependencies::offline(store.clone(), limits.service_limits()).await?;
    let services = Services::new(dependencies);
    let removed = services.maintenance.apply_retention(RunMode::Offline).await?;
    let (entries, bytes) = removed
        .iter()
        .fold((0, 0), |(entries, bytes), one| (entries + one.entries, bytes + one.bytes));
    if *as_json {
        println!(
            "{}",
            json!({"dry_run": dry_run, "entries": entries, "bytes": bytes, "removed": removed, "retention": retention.settings()})
        );
    } else {
        println!("{}", table::removed_table(&removed));
        let verb = if *dry_run { "would be removed" } else { "removed" };
        println!("{verb}: {entries} entries, {}", table::format_bytes(bytes));
    }
    drop(services);
    if !dry_run && (entries > 0 || store.retention.unused_bytes().await? >= WORTH_COMPACTING_BYTES)
    {
        match store.retention.compact().await {
            // Compacting rewrites the database. The rows are removed even if it fails, but the
            // database file does not shrink.
            Err(error) if error.is_full() => {
                eprintln!(
                    "not enough disk space to compact the database. Free some space and run gc \
                     again."
                );
            }
            compacted => compacted
                .context("the entries were removed, but the database could not be compacted")?,
        }
    }
    store.close().await;
    Ok(())
}
