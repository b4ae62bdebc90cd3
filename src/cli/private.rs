//! Runs a private service in this process, on a free loopback port.

use super::server::client;
use crate::app::{self, RunningService};
use crate::config::{
    AccessConfig, BlobsConfig, DatabaseConfig, LimitsConfig, LogConfig, LogFormat, ModelsConfig,
    ParseChoice, Role, ServeConfig, VlmConfig, WebhookConfig,
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
    /// Returns an error if the folder or a model cannot be used.
    pub async fn start(data_dir: Utf8PathBuf, models: ModelsConfig) -> anyhow::Result<Self> {
        Self::start_with(data_dir, models, VlmConfig::default()).await
    }

    /// Starts a service with a vision-language model.
    ///
    /// # Errors
    /// Like [`start`](Self::start).
    pub async fn start_with(
        data_dir: Utf8PathBuf,
        models: ModelsConfig,
        vlm: VlmConfig,
    ) -> anyhow::Result<Self> {
        let config = ServeConfig {
            listen: SocketAddr::from((Ipv4Addr::LOCALHOST, 0)),
            data_dir,
            database: DatabaseConfig::default(),
            role: Role::All,
            blobs: BlobsConfig::default(),
            access: AccessConfig::default(),
            models,
            fetch_models: false,
            parse: ParseChoice::FullOnly,
            vlm,
            vlm_check: false,
            webhook: WebhookConfig::default(),
            limits: LimitsConfig::default(),
            log: LogConfig { log_format: LogFormat::Text, otlp_endpoint: None },
        };
        let running = app::start(&config).await?;
        let address = running.address;
        // The key in the environment applies to this service too.
        Ok(Self { client: client(&format!("http://{address}"))?, address, running })
    }

    /// # Errors
    /// Returns an error if a task of the service panicked.
    pub async fn stop(self) -> anyhow::Result<()> {
        self.running.stop().await
    }
}
