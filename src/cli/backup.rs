//! `uniground backup`: writes a consistent copy of a data folder. The server may keep running.

use super::output::print_json;
use super::table::format_bytes;
use crate::telemetry;
use anyhow::{bail, ensure};
use camino::Utf8PathBuf;
use serde_json::json;
use std::time::Instant;
use uniground_storage::{BackupReport, BackupTarget, back_up};

#[derive(Debug, clap::Args)]
pub struct BackupArgs {
    /// Where to write the backup: a folder, an archive (NAME.tar or NAME.tar.zst), or - for
    /// standard output. An earlier backup folder is updated in place
    to: Utf8PathBuf,
    /// Data folder of the server. The server may be running
    #[arg(long, env = "UNIGROUND_DATA_DIR", default_value = "./data")]
    data_dir: Utf8PathBuf,
    /// Print a summary as JSON. Cannot be combined with a backup to standard output
    #[arg(long)]
    json: bool,
}

pub async fn run(BackupArgs { to, data_dir, json: as_json }: &BackupArgs) -> anyhow::Result<()> {
    telemetry::start_quiet();
    ensure!(
        !(*as_json && to == "-"),
        "--json cannot be used when the backup goes to standard output"
    );
    let begun = Instant::now();
    let done = back_up(data_dir, BackupTarget::from_path(to)).await?;
    let BackupReport { scenes, answers, folders, bytes, new_folders, new_bytes, left_out } = done;
    // Standard output may be the backup itself.
    eprintln!(
        "{to}: {scenes} scenes, {answers} answers, {folders} folders, {}",
        format_bytes(bytes)
    );
    eprintln!(
        "new: {new_folders} folders, {}, in {:.1} s",
        format_bytes(new_bytes),
        begun.elapsed().as_secs_f32()
    );
    if *as_json {
        let left_out: Vec<_> =
            left_out.iter().map(|(folder, what)| json!({"folder": folder, "what": what})).collect();
        print_json(&json!({
            "to": to, "scenes": scenes, "answers": answers, "folders": folders, "bytes": bytes,
            "new_folders": new_folders, "new_bytes": new_bytes, "left_out": left_out,
        }))?;
    }
    for (folder, what) in &left_out {
        eprintln!("left out: {folder}: {what}");
    }
    match left_out.len() {
        0 => Ok(()),
        n => bail!(
            "{n} folders are missing or damaged and are not in the backup. Run `uniground doctor \
             --data-dir {data_dir}`."
        ),
    }
}
