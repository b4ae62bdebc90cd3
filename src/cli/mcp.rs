//! `uniground mcp`: serves a data folder to a local agent over stdin and stdout.

use crate::app;
use crate::config::ServeConfig;
use crate::http::Mcp;
use crate::telemetry;
use std::net::{Ipv4Addr, SocketAddr};

/// Writes everything except MCP messages to stderr.
pub async fn run(config: &ServeConfig) -> anyhow::Result<()> {
    let _traces = telemetry::start(&config.log)?;
    // The HTTP API and the page also run, on a free loopback port.
    let here = ServeConfig { listen: SocketAddr::from((Ipv4Addr::LOCALHOST, 0)), ..config.clone() };
    let running = app::start(&here).await?;
    tracing::info!("HTTP API listening on http://{}", running.address);
    let served = Box::pin(Mcp::over_stdio(running.services())).await;
    running.stop().await?;
    served
}
