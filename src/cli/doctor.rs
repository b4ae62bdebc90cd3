//! `uniground doctor`: checks the consistency of a data folder and repairs it. The server must be
//! stopped.

use super::output::print_json;
use super::table;
use crate::config::{BlobsConfig, DatabaseConfig, LimitsConfig};
use crate::telemetry;
use anyhow::{Context, bail, ensure};
use camino::{Utf8Path, Utf8PathBuf};
use serde_json::json;
use uniground_service::{Dependencies, Finding, FindingKind, Services};
use uniground_storage::Store;

#[derive(Debug, clap::Args)]
pub struct DoctorArgs {
    /// Data folder of the server. The server must be stopped
    #[arg(long, env = "UNIGROUND_DATA_DIR", default_value = "./data")]
    data_dir: Utf8PathBuf,
    #[command(flatten)]
    database: DatabaseConfig,
    #[command(flatten)]
    blobs: BlobsConfig,
    /// Repair: rebuild derived data, move orphan files to the quarantine folder, close unfinished
    /// jobs
    #[arg(long)]
    repair: bool,
    /// Print the findings as JSON
    #[arg(long)]
    json: bool,
}

pub async fn run(args: &DoctorArgs) -> anyhow::Result<()> {
    telemetry::start_quiet();
    let DoctorArgs { data_dir, database, blobs, repair, json: as_json } = args;
    ensure!(data_dir.is_dir(), "folder {data_dir} does not exist");
    let store =
        Store::open_without_recovery(data_dir, &database.location, &blobs.blob_home()?).await;
    let store = store.with_context(|| format!("the data folder {data_dir}"))?;
    let limits = LimitsConfig::default().service_limits();
    let services = Services::new(Dependencies::offline(store.clone(), limits).await?);
    let findings = services.doctor.check_all_data().await?;
    if findings.is_empty() {
        match as_json {
            true => print_json(&to_json(data_dir, &findings, None))?,
            false => println!("{data_dir}: no problems found"),
        }
        store.close().await;
        return Ok(());
    }
    if !as_json {
        println!("{}", table::findings_table(&findings));
    }
    let (cured, left): (Vec<_>, Vec<_>) =
        findings.iter().partition(|finding| finding.trouble.remedy().is_some());
    let mut waiting = None;
    if *repair {
        services.doctor.repair(&findings).await?;
        waiting = Some(services.doctor.waiting_parses().await?);
    }
    match waiting {
        _ if *as_json => print_json(&to_json(data_dir, &findings, waiting))?,
        Some(waiting) => {
            println!("repaired: {}; {waiting} parses will run when the server starts", cured.len());
        }
        None if cured.is_empty() => {}
        None => println!(
            "{} of them can be repaired. Run: uniground doctor --repair --data-dir {data_dir}",
            cured.len()
        ),
    }
    store.close().await;
    let harmless = |trouble: &FindingKind| matches!(trouble, FindingKind::StrayFile);
    let open = if *repair {
        left.iter().filter(|finding| !harmless(&finding.trouble)).count()
    } else {
        findings.len()
    };
    match open {
        0 => Ok(()),
        open => bail!("{open} problems remain"),
    }
}

/// Returns the findings and their remedies as JSON. `waiting` is the number of queued parses, set
/// after a repair.
fn to_json(data_dir: &Utf8Path, findings: &[Finding], waiting: Option<u32>) -> serde_json::Value {
    let findings: Vec<_> = findings
        .iter()
        .map(|Finding { trouble, detail }| json!({"trouble": trouble.to_string(), "detail": detail, "remedy": trouble.remedy()}))
        .collect();
    json!({
        "data_dir": data_dir, "is_whole": findings.is_empty(), "findings": findings,
        "repaired": waiting.is_some(), "waiting_parses": waiting,
    })
}
