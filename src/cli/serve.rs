//! `uniground serve`: runs the service until SIGTERM, SIGHUP or Ctrl-C.

use super::fetching::fetch_missing;
use crate::app::{self, RunningService};
use crate::config::ServeConfig;
use crate::telemetry;
use std::fs;
use std::io::{self, Write};
use tokio::signal::unix::{SignalKind, signal};

/// Fetches missing models if `--fetch-models` is set. The server starts even if this fails.
pub fn fetch(config: &ServeConfig) {
    if !config.fetch_models {
        return;
    }
    if let Err(error) = fetch_missing(&config.models, &mut io::stderr()) {
        eprintln!("{error:#}; the server starts with the models that are installed");
    }
}

pub async fn run(config: &ServeConfig) -> anyhow::Result<()> {
    until_stopped(config, app::start(config)).await
}

/// Runs the service until a signal arrives.
pub async fn until_stopped(
    config: &ServeConfig,
    start: impl Future<Output = anyhow::Result<RunningService>>,
) -> anyhow::Result<()> {
    // Dropping this sends the remaining traces.
    let _traces = telemetry::start(&config.log)?;
    let mut terminate = signal(SignalKind::terminate())?;
    let mut interrupt = signal(SignalKind::interrupt())?;
    let mut hangup = if ignores_hangup() { None } else { Some(signal(SignalKind::hangup())?) };
    let mut running = start.await?;
    println!("listening on http://{}", running.address);
    io::stdout().flush()?;
    tokio::select! {
        _ = terminate.recv() => tracing::info!("SIGTERM received; shutting down"),
        Some(()) = async { hangup.as_mut()?.recv().await } => {
            tracing::info!("SIGHUP received; shutting down");
        }
        _ = interrupt.recv() => tracing::info!("interrupt received; shutting down"),
        () = running.until_server_ends() => tracing::error!("server stopped unexpectedly"),
    }
    running.stop().await
}

/// Returns whether this process was started with SIGHUP ignored, as `nohup` does. It then keeps
/// running when its terminal closes. Works on Linux only.
fn ignores_hangup() -> bool {
    const SIGHUP_BIT: u64 = 1;
    let status = fs::read_to_string("/proc/self/status").unwrap_or_default();
    let ignored = status.lines().find_map(|line| line.strip_prefix("SigIgn:"));
    ignored.is_some_and(|mask| {
        u64::from_str_radix(mask.trim(), 16).is_ok_and(|mask| mask & SIGHUP_BIT != 0)
    })
}
