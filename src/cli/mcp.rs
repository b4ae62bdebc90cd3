//! `uniground mcp`: the tools of a data folder for an agent on this machine, over stdin and stdout.

use crate::app;
use crate::config::ServeConfig;
use crate::http::Mcp;
use crate::telemetry;
use std::net::{Ipv4Addr, SocketAddr};

/// Everything but MCP goes to stderr: stdout is the agent's.
pub async fn run(config: &ServeConfig) -> anyhow::Result<()> {
    let _traces = telemetry::start(&config.log)?;
    // The service listens for pages and programs of this machine too, at a port the system picks.
    let here = ServeConfig { listen: SocketAddr::from((Ipv4Addr::LOCALHOST, 0)), ..config.clone() };
    let running = app::start(&here).await?;
    tracing::info!("also at http://{}", running.address);
    let served = Box::pin(Mcp::over_stdio(running.services())).await;
    running.stop().await?;
    served
}
