//! `uniground serve`: the service, until SIGTERM or Ctrl-C.

use crate::app;
use crate::config::ServeConfig;
use crate::telemetry;
use std::io::Write;
use tokio::signal::unix::{SignalKind, signal};

pub async fn run(config: &ServeConfig) -> anyhow::Result<()> {
    // Sends what is left when this ends.
    let _traces = telemetry::start(&config.log)?;
    let mut terminate = signal(SignalKind::terminate())?;
    let mut interrupt = signal(SignalKind::interrupt())?;
    let mut running = app::start(config).await?;
    println!("listening on http://{}", running.address);
    std::io::stdout().flush()?;
    tokio::select! {
        _ = terminate.recv() => tracing::info!("SIGTERM: stopping"),
        _ = interrupt.recv() => tracing::info!("interrupted: stopping"),
        () = running.ended() => tracing::error!("the server ended by itself"),
    }
    running.stop().await
}
