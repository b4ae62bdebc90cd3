//! `uniground restore`: restores a data folder from a backup.

use super::output::print_json;
use super::table::format_bytes;
use crate::telemetry;
use anyhow::bail;
use camino::Utf8PathBuf;
use serde_json::json;
use uniground_storage::{BackupSource, RestoreReport, check, restore};

#[derive(Debug, clap::Args)]
pub struct RestoreArgs {
    /// Backup to restore: a folder, an archive, or - for an archive on standard input
    from: Utf8PathBuf,
    /// Destination folder, empty or not existing yet
    #[arg(long, env = "UNIGROUND_DATA_DIR", required_unless_present = "check")]
    data_dir: Option<Utf8PathBuf>,
    /// Only verify the checksums of the backup
    #[arg(long)]
    check: bool,
    /// Print the contents as JSON
    #[arg(long)]
    json: bool,
}

pub async fn run(
    RestoreArgs { from, data_dir, check: only_check, json: as_json }: &RestoreArgs,
) -> anyhow::Result<()> {
    telemetry::start_quiet();
    let source = BackupSource::from_path(from);
    let (restored, done) = match data_dir {
        _ if *only_check => (check(source).await?, format!("{from}: all checksums match")),
        Some(data_dir) => (restore(source, data_dir).await?, format!("restored to {data_dir}")),
        None => bail!("--data-dir is required"),
    };
    let RestoreReport { taken_at, program, scenes, answers, folders, bytes, left_out } = restored;
    if *as_json {
        let left_out: Vec<_> =
            left_out.iter().map(|(folder, what)| json!({"folder": folder, "what": what})).collect();
        return print_json(&json!({
            "from": from, "restored_to": data_dir.as_ref().filter(|_| !only_check), "taken_at": taken_at, "program": program,
            "scenes": scenes, "answers": answers, "folders": folders, "bytes": bytes, "left_out": left_out,
        }));
    }
    println!(
        "{done}: {scenes} scenes, {answers} answers, {folders} folders, {}",
        format_bytes(bytes)
    );
    println!("backup taken at {taken_at} by uniground {program}");
    for (folder, what) in left_out {
        println!("not in the backup: {folder}: {what}");
    }
    Ok(())
}
