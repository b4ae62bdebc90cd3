//! Configuration: every flag is also an environment variable; units are in the names.

mod blobs;
mod choice;
mod database;
mod models;
mod process_role;
mod registries;
mod retention;

pub use blobs::BlobsConfig;
pub use choice::ChosenModels;
pub use database::{DatabaseConfig, Vectors};
pub use models::{BundlesConfig, LIBRARY_FOLDER, ModelsConfig, RuntimeConfig};
pub use process_role::{JobType, ProcessRole, Role, WorkerConfig};
pub use registries::registries;
pub use retention::RetentionConfig;
pub use uniground_core::models::choice::{AUTO, BUILTIN, BUILTIN_ENCODER, BUILTIN_MASKS};

use crate::telemetry;
use anyhow::{Context, bail, ensure};
use camino::Utf8PathBuf;
use std::fs;
use std::net::SocketAddr;
use std::time::Duration;
use uniground_core::ingest::archive::UnpackLimits;
use uniground_core::models::chat::Prices;
use uniground_endpoints::chat::{ChatClient, Endpoint, ReplayCache, RetryPolicy};
use uniground_isolation::{ChildProcess, ScanReader};
use uniground_service::webhook::Webhook;
use uniground_service::{Limits, LinkSecret, WhenNamed};

const DEFAULT_MAX_UPLOAD_BYTES: u64 = 16 << 30;
const DEFAULT_MAX_UNFINISHED_UPLOADS: u32 = 100;
const DEFAULT_MAX_QUEUED_JOBS: u32 = 100;
const DEFAULT_MAX_CONCURRENT_QUESTIONS: u32 = 32;
const DEFAULT_VLM_CONCURRENCY: u32 = 8;
const DEFAULT_VLM_TIMEOUT_S: u64 = 300;
const DEFAULT_VLM_ATTEMPTS: u32 = 5;
const DEFAULT_VLM_BACKOFF_MS: u64 = 1000;
const DEFAULT_MAX_CONNECTIONS: u32 = 1024;
const DEFAULT_KEEP_FREE_BYTES: u64 = 256 << 20;
const DEFAULT_READER_MEMORY_MB: u64 = 4096;

/// `uniground serve`
#[allow(clippy::doc_markdown)] // Help is no Markdown.
#[derive(Debug, Clone, clap::Args)]
pub struct ServeConfig {
    /// Address to listen on; port 0 picks a free one. Anything but loopback needs a key
    #[arg(long, env = "UNIGROUND_LISTEN", default_value = "127.0.0.1:8080")]
    pub listen: SocketAddr,
    /// Folder for the database and the scenes' files
    #[arg(long, env = "UNIGROUND_DATA_DIR", default_value = "./data")]
    pub data_dir: Utf8PathBuf,
    #[command(flatten)]
    pub database: DatabaseConfig,
    /// What this process does of the whole; with PostgreSQL others may do the rest
    #[arg(long, env = "UNIGROUND_ROLE", value_enum, default_value_t, value_name = "ROLE")]
    pub role: Role,
    #[command(flatten)]
    pub blobs: BlobsConfig,
    #[command(flatten)]
    pub access: AccessConfig,
    #[command(flatten)]
    pub models: ModelsConfig,
    /// Fetch what --masks and --encoder want and do not find, checked, before the server starts;
    /// without a network it starts all the same
    #[arg(long, env = "UNIGROUND_FETCH_MODELS")]
    pub fetch_models: bool,
    #[command(flatten)]
    pub vlm: VlmConfig,
    #[command(flatten)]
    pub webhook: WebhookConfig,
    #[command(flatten)]
    pub limits: LimitsConfig,
    #[command(flatten)]
    pub log: LogConfig,
}

/// Who may ask.
#[allow(clippy::doc_markdown)] // Help is no Markdown.
#[derive(Debug, Clone, Default, clap::Args)]
pub struct AccessConfig {
    /// File that holds the key callers must show as a bearer token (or the key itself in
    /// UNIGROUND_API_KEY)
    #[arg(long, env = "UNIGROUND_API_KEY_FILE", value_name = "FILE")]
    pub api_key_file: Option<Utf8PathBuf>,
    /// Serve a non-loopback address without a key: anybody who reaches it can read and delete
    /// every scene
    #[arg(long, env = "UNIGROUND_ALLOW_ANYBODY")]
    pub allow_anybody: bool,
    /// Another name this server may be called by without a key, besides localhost; may be given
    /// several times, or with commas
    #[arg(
        long = "allowed-host",
        env = "UNIGROUND_ALLOWED_HOSTS",
        value_name = "HOST",
        value_delimiter = ','
    )]
    pub allowed_hosts: Vec<String>,
    /// Origin whose pages may use this server from a browser, like <https://robots.example>; may be given several times, or with commas
    #[arg(
        long = "cors-origin",
        env = "UNIGROUND_CORS_ORIGINS",
        value_name = "ORIGIN",
        value_delimiter = ','
    )]
    pub cors_origins: Vec<String>,
    /// Folder of this machine whose scans may be imported without being uploaded (POST
    /// /v1/scenes/import)
    #[arg(long, env = "UNIGROUND_IMPORT_ROOT", value_name = "DIR")]
    pub import_root: Option<Utf8PathBuf>,
    /// File that holds what links without a key are signed with (or the secret itself in
    /// UNIGROUND_LINK_SECRET); default: a new one at each start
    #[arg(long, env = "UNIGROUND_LINK_SECRET_FILE", value_name = "FILE")]
    pub link_secret_file: Option<Utf8PathBuf>,
}

impl AccessConfig {
    /// What links are signed with, if that is given.
    ///
    /// # Errors
    /// When it can not be read, or is too short to protect anything.
    pub fn link_secret(&self) -> anyhow::Result<Option<LinkSecret>> {
        let secret = match &self.link_secret_file {
            Some(file) => Some(
                fs::read_to_string(file).with_context(|| format!("the secret's file {file}"))?,
            ),
            None => std::env::var("UNIGROUND_LINK_SECRET").ok(),
        };
        let Some(secret) = secret.map(|secret| secret.trim().to_owned()) else { return Ok(None) };
        ensure!(
            secret.len() >= MIN_KEY_BYTES,
            "the links' secret is too short: at least {MIN_KEY_BYTES} characters"
        );
        telemetry::register_secret(&secret);
        Ok(Some(LinkSecret::new(secret.as_bytes())))
    }
}

/// A server that is told when jobs end, as Standard Webhooks have it. The secret is in
/// UNIGROUND_WEBHOOK_SECRET or in a file.
#[allow(clippy::doc_markdown)] // Help is no Markdown.
#[derive(Debug, Clone, Default, clap::Args)]
pub struct WebhookConfig {
    /// Address that is told when a job ends
    #[arg(long, env = "UNIGROUND_WEBHOOK_URL", value_name = "URL")]
    pub webhook_url: Option<String>,
    /// File that holds what webhooks are signed with, whsec_ and base64 (or the secret itself in
    /// UNIGROUND_WEBHOOK_SECRET)
    #[arg(long, env = "UNIGROUND_WEBHOOK_SECRET_FILE", value_name = "FILE")]
    pub webhook_secret_file: Option<Utf8PathBuf>,
    /// Let webhooks go to this machine and its own network
    #[arg(long, env = "UNIGROUND_WEBHOOK_ALLOW_PRIVATE")]
    pub webhook_allow_private: bool,
}

impl WebhookConfig {
    /// The webhook, if one is configured.
    ///
    /// # Errors
    /// An address that is none, or is private; a secret that is missing or none.
    pub fn webhook(&self) -> anyhow::Result<Option<Webhook>> {
        let Some(url) = &self.webhook_url else { return Ok(None) };
        telemetry::register_secrets_of_address(url);
        let secret = match &self.webhook_secret_file {
            Some(file) => {
                fs::read_to_string(file).with_context(|| format!("the secret's file {file}"))?
            }
            None => {
                std::env::var("UNIGROUND_WEBHOOK_SECRET").context("--webhook-url needs a secret")?
            }
        };
        telemetry::register_secret(secret.trim());
        Ok(Some(Webhook::new(url, &secret, self.webhook_allow_private).context("--webhook-url")?))
    }
}

/// A vision-language model behind an OpenAI-compatible chat endpoint. Its key is in
/// UNIGROUND_VLM_API_KEY or in a file.
#[allow(clippy::doc_markdown)] // Help is no Markdown.
#[derive(Debug, Clone, clap::Args)]
pub struct VlmConfig {
    /// Address of a chat endpoint, like <https://host/v1>
    #[arg(long, env = "UNIGROUND_VLM_URL", value_name = "URL")]
    pub vlm_url: Option<String>,
    /// Model to ask there
    #[arg(long, env = "UNIGROUND_VLM_MODEL", value_name = "NAME")]
    pub vlm_model: Option<String>,
    /// File that holds the endpoint's key (or the key itself in UNIGROUND_VLM_API_KEY)
    #[arg(long, env = "UNIGROUND_VLM_API_KEY_FILE", value_name = "FILE")]
    pub vlm_api_key_file: Option<Utf8PathBuf>,
    /// Price of a million prompt tokens, US dollars
    #[arg(long, env = "UNIGROUND_VLM_PROMPT_USD", default_value_t = 0.0, value_name = "USD")]
    pub vlm_prompt_usd: f64,
    /// Price of a million completion tokens, US dollars
    #[arg(long, env = "UNIGROUND_VLM_COMPLETION_USD", default_value_t = 0.0, value_name = "USD")]
    pub vlm_completion_usd: f64,
    /// Most that may be spent on the model in a day (UTC), US dollars; needs prices
    #[arg(long, env = "UNIGROUND_VLM_DAILY_USD", value_name = "USD")]
    pub vlm_daily_usd: Option<f64>,
    /// Requests to the endpoint at once
    #[arg(long, env = "UNIGROUND_VLM_CONCURRENCY", default_value_t = DEFAULT_VLM_CONCURRENCY, value_name = "N", value_parser = clap::value_parser!(u32).range(1..=1024))]
    pub vlm_concurrency: u32,
    /// Seconds one attempt may take
    #[arg(long, env = "UNIGROUND_VLM_TIMEOUT_S", default_value_t = DEFAULT_VLM_TIMEOUT_S, value_name = "SECONDS", value_parser = clap::value_parser!(u64).range(1..=3600))]
    pub vlm_timeout_s: u64,
    /// Attempts for one call; the wait between them doubles
    #[arg(long, env = "UNIGROUND_VLM_ATTEMPTS", default_value_t = DEFAULT_VLM_ATTEMPTS, value_name = "N", value_parser = clap::value_parser!(u32).range(1..=20))]
    pub vlm_attempts: u32,
    /// The first wait between two attempts, milliseconds
    #[arg(long, env = "UNIGROUND_VLM_BACKOFF_MS", default_value_t = DEFAULT_VLM_BACKOFF_MS, value_name = "MS")]
    pub vlm_backoff_ms: u64,
    /// When the model names everything in a scene: its names decide what is meant from then on,
    /// whoever answers
    #[arg(long, env = "UNIGROUND_NAMES", value_enum, default_value_t)]
    pub names: NamingChoice,
    /// Ask for answers as JSON by a schema, where the endpoint knows schemas
    #[arg(long, env = "UNIGROUND_VLM_JSON")]
    pub vlm_json: bool,
}

/// When the model names everything in a scene, unasked.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, clap::ValueEnum)]
pub enum NamingChoice {
    /// Never: only where somebody asks for it (`POST /v1/scenes/{id}/names`)
    #[default]
    Off,
    /// Before the first question that the model reviews; that question waits for it
    Lazy,
    /// As soon as a scene is parsed
    Parse,
}

impl From<NamingChoice> for WhenNamed {
    fn from(choice: NamingChoice) -> Self {
        match choice {
            NamingChoice::Off => Self::Off,
            NamingChoice::Lazy => Self::Lazy,
            NamingChoice::Parse => Self::Parse,
        }
    }
}

impl Default for VlmConfig {
    fn default() -> Self {
        Self {
            vlm_url: None,
            vlm_model: None,
            vlm_api_key_file: None,
            vlm_prompt_usd: 0.0,
            vlm_completion_usd: 0.0,
            vlm_daily_usd: None,
            vlm_concurrency: DEFAULT_VLM_CONCURRENCY,
            vlm_timeout_s: DEFAULT_VLM_TIMEOUT_S,
            vlm_attempts: DEFAULT_VLM_ATTEMPTS,
            vlm_backoff_ms: DEFAULT_VLM_BACKOFF_MS,
            names: NamingChoice::Off,
            vlm_json: false,
        }
    }
}

impl VlmConfig {
    /// The client, if a model is configured.
    ///
    /// # Errors
    /// An address without a model or the other way round, an address that is none, or an unreadable
    /// key file.
    pub fn client(&self, replay_cache: ReplayCache) -> anyhow::Result<Option<ChatClient>> {
        let Self {
            vlm_url,
            vlm_model,
            vlm_api_key_file,
            vlm_prompt_usd,
            vlm_completion_usd,
            vlm_daily_usd,
            ..
        } = self;
        let (base_url, model) = match (vlm_url, vlm_model) {
            (None, None) => return Ok(None),
            (Some(url), Some(model)) => (url.clone(), model.clone()),
            (Some(_), None) => bail!("--vlm-url needs --vlm-model"),
            (None, Some(_)) => bail!("--vlm-model needs --vlm-url"),
        };
        ensure!(
            reqwest::Url::parse(&base_url).is_ok_and(|url| url.has_host()),
            "--vlm-url: this is not an address"
        );
        let api_key = match vlm_api_key_file {
            Some(file) => Some(
                fs::read_to_string(file)
                    .with_context(|| format!("the key file {file}"))?
                    .trim()
                    .to_owned(),
            ),
            None => std::env::var("UNIGROUND_VLM_API_KEY").ok().map(|key| key.trim().to_owned()),
        };
        let api_key = api_key.filter(|key| !key.is_empty());
        api_key.iter().for_each(|key| telemetry::register_secret(key));
        telemetry::register_secrets_of_address(&base_url);
        for (flag, usd) in [
            ("--vlm-prompt-usd", Some(*vlm_prompt_usd)),
            ("--vlm-completion-usd", Some(*vlm_completion_usd)),
            ("--vlm-daily-usd", *vlm_daily_usd),
        ] {
            ensure!(
                usd.is_none_or(|usd| usd.is_finite() && usd >= 0.0),
                "{flag}: must be 0 or more"
            );
        }
        // Without prices nothing seems to cost anything, and a budget would protect nobody.
        let is_free = *vlm_prompt_usd == 0.0 && *vlm_completion_usd == 0.0;
        ensure!(
            !is_free || vlm_daily_usd.is_none(),
            "--vlm-daily-usd needs --vlm-prompt-usd and --vlm-completion-usd"
        );
        let prices = Prices { prompt_usd: *vlm_prompt_usd, completion_usd: *vlm_completion_usd };
        let patience = RetryPolicy {
            timeout: Duration::from_secs(self.vlm_timeout_s),
            attempts: self.vlm_attempts,
            backoff: Duration::from_millis(self.vlm_backoff_ms),
            ..RetryPolicy::default()
        };
        let endpoint = Endpoint {
            base_url,
            model,
            api_key,
            prices,
            concurrency: self.vlm_concurrency as usize,
        };
        let client = ChatClient::new(endpoint, patience, replay_cache)
            .context("a client for the model's server")?;
        Ok(Some(client))
    }
}

/// What requests may take.
#[derive(Debug, Clone, clap::Args)]
pub struct LimitsConfig {
    /// Largest upload accepted, bytes
    #[arg(long, env = "UNIGROUND_MAX_UPLOAD_BYTES", default_value_t = DEFAULT_MAX_UPLOAD_BYTES)]
    pub max_upload_bytes: u64,
    /// Uploads in parts that may be unfinished at once
    #[arg(long, env = "UNIGROUND_MAX_UNFINISHED_UPLOADS", default_value_t = DEFAULT_MAX_UNFINISHED_UPLOADS, value_name = "N")]
    pub max_unfinished_uploads: u32,
    /// Largest size an archive may unpack to, bytes
    #[arg(long, env = "UNIGROUND_MAX_UNPACKED_BYTES", default_value_t = UnpackLimits::default().max_bytes)]
    pub max_unpacked_bytes: u64,
    /// Parses that may wait; more uploads are told to come back later
    #[arg(long, env = "UNIGROUND_MAX_QUEUED_JOBS", default_value_t = DEFAULT_MAX_QUEUED_JOBS)]
    pub max_queued_jobs: u32,
    /// Questions answered at once
    #[arg(long, env = "UNIGROUND_MAX_CONCURRENT_QUESTIONS", default_value_t = DEFAULT_MAX_CONCURRENT_QUESTIONS, value_parser = clap::value_parser!(u32).range(1..=4096))]
    pub max_concurrent_questions: u32,
    /// Connections open at once
    #[arg(long, env = "UNIGROUND_MAX_CONNECTIONS", default_value_t = DEFAULT_MAX_CONNECTIONS, value_parser = clap::value_parser!(u32).range(8..=65_536))]
    pub max_connections: u32,
    /// Room on the disk that uploads, parses and batches leave to the rest, bytes
    #[arg(long, env = "UNIGROUND_KEEP_FREE_BYTES", default_value_t = DEFAULT_KEEP_FREE_BYTES)]
    pub keep_free_bytes: u64,
    /// Memory that the server may come to hold; a parse that would take more is not begun.
    /// Default: its container's limit, or the machine's
    #[arg(long, env = "UNIGROUND_MAX_MEMORY_BYTES")]
    pub max_memory_bytes: Option<u64>,
    /// Memory that a process which imports an uploaded scan may take, MB; one that checks an
    /// upload may take a quarter of it
    #[arg(long, env = "UNIGROUND_READER_MEMORY_MB", default_value_t = DEFAULT_READER_MEMORY_MB, value_name = "MB", value_parser = clap::value_parser!(u64).range(256..=1_048_576))]
    pub reader_memory_mb: u64,
    /// Program that reads uploaded scans in processes of its own; default: this one
    #[arg(long, hide = true, value_name = "FILE")]
    pub reader_program: Option<Utf8PathBuf>,
    #[command(flatten)]
    pub retention: RetentionConfig,
}

/// What the log looks like, and where traces go. Its level is `RUST_LOG`'s, `info` by default.
#[allow(clippy::doc_markdown)] // Help is no Markdown.
#[derive(Debug, Clone, clap::Args)]
pub struct LogConfig {
    #[arg(long, env = "UNIGROUND_LOG_FORMAT", value_enum, default_value_t = LogFormat::Text)]
    pub log_format: LogFormat,
    /// Send traces of requests, jobs and model calls to this OpenTelemetry collector, OTLP over HTTP, like <http://127.0.0.1:4318>
    #[arg(long, env = "UNIGROUND_OTLP_ENDPOINT", value_name = "URL")]
    pub otlp_endpoint: Option<String>,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, clap::ValueEnum)]
pub enum LogFormat {
    Text,
    Json,
}

impl Default for LimitsConfig {
    fn default() -> Self {
        Self {
            max_upload_bytes: DEFAULT_MAX_UPLOAD_BYTES,
            max_unfinished_uploads: DEFAULT_MAX_UNFINISHED_UPLOADS,
            max_unpacked_bytes: UnpackLimits::default().max_bytes,
            max_queued_jobs: DEFAULT_MAX_QUEUED_JOBS,
            max_concurrent_questions: DEFAULT_MAX_CONCURRENT_QUESTIONS,
            max_connections: DEFAULT_MAX_CONNECTIONS,
            keep_free_bytes: DEFAULT_KEEP_FREE_BYTES,
            max_memory_bytes: None,
            reader_memory_mb: DEFAULT_READER_MEMORY_MB,
            reader_program: None,
            retention: RetentionConfig::default(),
        }
    }
}

impl LimitsConfig {
    #[must_use]
    pub fn service_limits(&self) -> Limits {
        Limits {
            max_upload_bytes: self.max_upload_bytes,
            max_unfinished_uploads: self.max_unfinished_uploads,
            unpack: UnpackLimits { max_bytes: self.max_unpacked_bytes, ..UnpackLimits::default() },
            keep_free_bytes: self.keep_free_bytes,
            max_memory_bytes: self.max_memory_bytes,
            max_concurrent_questions: self.max_concurrent_questions as usize,
            retention: self.retention.settings(),
        }
    }
}

impl LimitsConfig {
    /// Processes that read uploaded scans.
    #[must_use]
    pub fn scan_reader(&self) -> ScanReader {
        ScanReader::isolated(ChildProcess::new(
            self.reader_program.clone(),
            self.reader_memory_mb << 20,
        ))
    }
}

impl ServeConfig {
    /// The server's own key, if it is given one.
    ///
    /// # Errors
    /// When it can not be read, or is too short to protect anything.
    pub fn api_key(&self) -> anyhow::Result<Option<String>> {
        let key = match &self.access.api_key_file {
            Some(file) => {
                Some(fs::read_to_string(file).with_context(|| format!("the key file {file}"))?)
            }
            None => std::env::var("UNIGROUND_API_KEY").ok(),
        };
        let Some(key) = key.map(|key| key.trim().to_owned()) else { return Ok(None) };
        ensure!(
            key.len() >= MIN_KEY_BYTES,
            "the API key is too short: at least {MIN_KEY_BYTES} characters"
        );
        telemetry::register_secret(&key);
        Ok(Some(key))
    }

    /// Whether this server can be reached from other machines and nothing was said about that.
    #[must_use]
    pub fn requires_keys(&self) -> bool {
        !self.listen.ip().is_loopback() && !self.access.allow_anybody
    }
}

const MIN_KEY_BYTES: usize = 16;
