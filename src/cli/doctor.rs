//! `uniground doctor`: whether a data folder is whole, and what can be done where it is not. The server must not run.

use super::table;
use crate::service::{Service, Trouble};
use crate::store::Store;
use crate::{config, telemetry};
use anyhow::{Context, bail, ensure};
use camino::Utf8PathBuf;

#[derive(Debug, clap::Args)]
pub struct DoctorArgs {
    /// Folder of the server, which must not run
    #[arg(long, env = "UNIGROUND_DATA_DIR", default_value = "./data")]
    data_dir: Utf8PathBuf,
    /// Make again what can be made, take strays to the quarantine, end what has no end
    #[arg(long)]
    repair: bool,
}

pub async fn run(args: &DoctorArgs) -> anyhow::Result<()> {
    telemetry::start_quiet();
    let DoctorArgs { data_dir, repair } = args;
    ensure!(data_dir.is_dir(), "there is no folder {data_dir}");
    let store = Store::open_as_it_is(data_dir).await.with_context(|| format!("the data folder {data_dir}"))?;
    let service = Service::at_rest(store.clone(), config::LimitsConfig::default().service_limits()).await?;
    let findings = service.examine().await?;
    if findings.is_empty() {
        println!("{data_dir} is whole");
        store.close().await;
        return Ok(());
    }
    println!("{}", table::of_findings(&findings));
    let (cured, left): (Vec<_>, Vec<_>) = findings.iter().partition(|finding| finding.trouble.remedy().is_some());
    if *repair {
        service.repair(&findings).await?;
        println!("repaired: {}; {} parses wait for the server", cured.len(), service.waiting_parses().await?);
    } else if !cured.is_empty() {
        println!("{} of them can be repaired: uniground doctor --repair --data-dir {data_dir}", cured.len());
    }
    store.close().await;
    let harmless = |trouble: &Trouble| matches!(trouble, Trouble::StrayFile);
    let open = if *repair { left.iter().filter(|finding| !harmless(&finding.trouble)).count() } else { findings.len() };
    match open {
        0 => Ok(()),
        open => bail!("{open} findings are open"),
    }
}
