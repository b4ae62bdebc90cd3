//! `uniground serve`: the service, until SIGTERM or Ctrl-C.

use super::fetching::{fetch_all, wanted};
use crate::app::{self, RunningService};
use crate::config::{LIBRARY_FOLDER, ServeConfig};
use crate::packages::Places;
use crate::telemetry;
use std::io::{self, Write};
use tokio::signal::unix::{SignalKind, signal};

/// Fetches what the server would use and does not find, if that is wished. Whatever becomes of it, the server can start.
pub fn fetch(config: &ServeConfig) {
    if !config.fetch_models {
        return;
    }
    let places = Places { models: config.models.bundles.models.clone(), library: LIBRARY_FOLDER.into() };
    if let Err(error) = fetch_all(&wanted(&config.models), &places, &mut io::stderr()) {
        eprintln!("{error:#}; the server goes on with what is there");
    }
}

pub async fn run(config: &ServeConfig) -> anyhow::Result<()> {
    until_stopped(config, app::start(config)).await
}

/// Runs what `start` starts until somebody stops it.
pub async fn until_stopped(config: &ServeConfig, start: impl Future<Output = anyhow::Result<RunningService>>) -> anyhow::Result<()> {
    // Sends what is left when this ends.
    let _traces = telemetry::start(&config.log)?;
    let mut terminate = signal(SignalKind::terminate())?;
    let mut interrupt = signal(SignalKind::interrupt())?;
    let mut running = start.await?;
    println!("listening on http://{}", running.address);
    io::stdout().flush()?;
    tokio::select! {
        _ = terminate.recv() => tracing::info!("SIGTERM: stopping"),
        _ = interrupt.recv() => tracing::info!("interrupted: stopping"),
        () = running.ended() => tracing::error!("the server ended by itself"),
    }
    running.stop().await
}
