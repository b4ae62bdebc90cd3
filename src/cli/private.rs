//! A service of this process's own: on a free loopback port, for nobody else.

use super::server::client;
use crate::app::{self, RunningService};
use crate::config::{
    AccessConfig, BlobsConfig, DatabaseConfig, LimitsConfig, LogConfig, LogFormat, ModelsConfig,
    Role, ServeConfig, VlmConfig, WebhookConfig,
};
use camino::Utf8PathBuf;
use std::net::{Ipv4Addr, SocketAddr};
use uniground_client::Client;

pub struct PrivateServer {
    pub client: Client,
    pub address: SocketAddr,
    running: RunningService,
}

impl PrivateServer {
    /// # Errors
    /// When the folder or a model can not be used.
    pub async fn start(data_dir: Utf8PathBuf, models: ModelsConfig) -> anyhow::Result<Self> {
        let config = ServeConfig {
            listen: SocketAddr::from((Ipv4Addr::LOCALHOST, 0)),
            data_dir,
            database: DatabaseConfig::default(),
            role: Role::All,
            blobs: BlobsConfig::default(),
            access: AccessConfig::default(),
            models,
            fetch_models: false,
            vlm: VlmConfig::default(),
            webhook: WebhookConfig::default(),
            limits: LimitsConfig::default(),
            log: LogConfig { log_format: LogFormat::Text, otlp_endpoint: None },
        };
        let running = app::start(&config).await?;
        let address = running.address;
        // Where the environment has a key, the service wants it as any other does.
        Ok(Self { client: client(&format!("http://{address}"))?, address, running })
    }

    /// # Errors
    /// When a part of the service had panicked before.
    pub async fn stop(self) -> anyhow::Result<()> {
        self.running.stop().await
    }
}
