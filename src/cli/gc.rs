//! `uniground gc`: lets a stopped server's folder go of everything that was kept long enough.

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
    /// Folder of the server, which must not run
    #[arg(long, env = "UNIGROUND_DATA_DIR", default_value = "./data")]
    data_dir: Utf8PathBuf,
    #[command(flatten)]
    database: DatabaseConfig,
    #[command(flatten)]
    blobs: BlobsConfig,
    /// Only tell what would go; nothing is written
    #[arg(long)]
    dry_run: bool,
    /// As JSON
    #[arg(long)]
    json: bool,
    #[command(flatten)]
    retention: RetentionConfig,
}

/// Unused room in the database for which it is written anew, where nothing was removed now: what a
/// refused batch has left, say.
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
        let verb = if *dry_run { "would go" } else { "gone" };
        println!("{verb}: {entries} entries, {}", table::format_bytes(bytes));
    }
    drop(services);
    if !dry_run && (entries > 0 || store.retention.unused_bytes().await? >= WORTH_COMPACTING_BYTES)
    {
        match store.retention.compact().await {
            // Compacting writes the database once more: what was removed has made its room, for rows if not for files.
            Err(error) if error.is_full() => {
                eprintln!("the disk has too little room to compact the database: run gc again when it has more");
            }
            compacted => compacted.context("what was removed is gone, but the database could not give its room back to the disk")?,
        }
    }
    store.close().await;
    Ok(())
}
