//! Configuration of the service. Every flag is also an environment variable. Units are in the
//! names.

mod blobs;
mod choice;
mod database;
mod hub;
mod models;
mod process_role;
mod registries;
mod retention;

pub use blobs::BlobsConfig;
pub use choice::ChosenModels;
pub use database::{DatabaseConfig, Vectors};
pub use hub::hub_settings;
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
use uniground_core::grounding::vlm::{PictureLimits, PointForm};
use uniground_core::ingest::archive::UnpackLimits;
use uniground_core::models::chat::Prices;
use uniground_endpoints::chat::{ChatClient, Endpoint, ReplayCache, RetryPolicy};
use uniground_isolation::{ChildProcess, ScanReader};
use uniground_service::webhook::Webhook;
use uniground_service::{Limits, LinkSecret, ParseMode, WhenNamed};

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
#[allow(clippy::doc_markdown)] // Help is plain text.
#[derive(Debug, Clone, clap::Args)]
pub struct ServeConfig {
    /// Listen address. Port 0 picks a free port. Addresses other than loopback require a key
    #[arg(long, env = "UNIGROUND_LISTEN", default_value = "127.0.0.1:8080")]
    pub listen: SocketAddr,
    /// Data folder for the database and the files of scenes
    #[arg(long, env = "UNIGROUND_DATA_DIR", default_value = "./data")]
    pub data_dir: Utf8PathBuf,
    #[command(flatten)]
    pub database: DatabaseConfig,
    /// Role of this process. With PostgreSQL, other processes can do the rest of the work
    #[arg(long, env = "UNIGROUND_ROLE", value_enum, default_value_t, value_name = "ROLE")]
    pub role: Role,
    #[command(flatten)]
    pub blobs: BlobsConfig,
    #[command(flatten)]
    pub access: AccessConfig,
    #[command(flatten)]
    pub models: ModelsConfig,
    /// Fetch missing models for --masks and --encoder before the server starts, verified by
    /// checksum. The server starts even if this fails
    #[arg(long, env = "UNIGROUND_FETCH_MODELS")]
    pub fetch_models: bool,
    /// Parses of a new scene, if there are neural networks
    #[arg(long, env = "UNIGROUND_PARSE", value_enum, default_value_t, value_name = "MODE")]
    pub parse: ParseChoice,
    #[command(flatten)]
    pub vlm: VlmConfig,
    /// Show the vision-language model three pictures at startup, and warn of what it gets wrong
    #[arg(long, env = "UNIGROUND_VLM_CHECK")]
    pub vlm_check: bool,
    #[command(flatten)]
    pub webhook: WebhookConfig,
    #[command(flatten)]
    pub limits: LimitsConfig,
    #[command(flatten)]
    pub log: LogConfig,
}

/// Access control.
#[allow(clippy::doc_markdown)] // Help is plain text.
#[derive(Debug, Clone, Default, clap::Args)]
pub struct AccessConfig {
    /// File with the API key that callers send as a bearer token. The key itself can be set in
    /// UNIGROUND_API_KEY
    #[arg(long, env = "UNIGROUND_API_KEY_FILE", value_name = "FILE")]
    pub api_key_file: Option<Utf8PathBuf>,
    /// Allow access without a key on a non-loopback address. Anybody who can reach it can read and
    /// delete every scene
    #[arg(long, env = "UNIGROUND_ALLOW_ANYBODY")]
    pub allow_anybody: bool,
    /// Additional host name accepted for requests without a key, besides localhost. May be repeated
    /// or comma-separated
    #[arg(
        long = "allowed-host",
        env = "UNIGROUND_ALLOWED_HOSTS",
        value_name = "HOST",
        value_delimiter = ','
    )]
    pub allowed_hosts: Vec<String>,
    /// Origin whose web pages may call this server from a browser (CORS), like
    /// <https://robots.example>. May be repeated or comma-separated
    #[arg(
        long = "cors-origin",
        env = "UNIGROUND_CORS_ORIGINS",
        value_name = "ORIGIN",
        value_delimiter = ','
    )]
    pub cors_origins: Vec<String>,
    /// Folder of this machine from which scans may be imported without upload (POST
    /// /v1/scenes/import)
    #[arg(long, env = "UNIGROUND_IMPORT_ROOT", value_name = "DIR")]
    pub import_root: Option<Utf8PathBuf>,
    /// File with the secret that signs links without a key. The secret itself can be set in
    /// UNIGROUND_LINK_SECRET [default: a new secret at each start]
    #[arg(long, env = "UNIGROUND_LINK_SECRET_FILE", value_name = "FILE")]
    pub link_secret_file: Option<Utf8PathBuf>,
}

impl AccessConfig {
    /// Returns the configured secret that signs links.
    ///
    /// # Errors
    /// Returns an error if the secret cannot be read or is too short.
    pub fn link_secret(&self) -> anyhow::Result<Option<LinkSecret>> {
        let secret = match &self.link_secret_file {
            Some(file) => {
                Some(fs::read_to_string(file).with_context(|| format!("the secret file {file}"))?)
            }
            None => std::env::var("UNIGROUND_LINK_SECRET").ok(),
        };
        let Some(secret) = secret.map(|secret| secret.trim().to_owned()) else { return Ok(None) };
        ensure!(
            secret.len() >= MIN_KEY_BYTES,
            "the link secret is too short: it needs at least {MIN_KEY_BYTES} characters"
        );
        telemetry::register_secret(&secret);
        Ok(Some(LinkSecret::new(secret.as_bytes())))
    }
}

/// Webhook for finished jobs, in the format of Standard Webhooks. The secret is in
/// UNIGROUND_WEBHOOK_SECRET or in a file.
#[allow(clippy::doc_markdown)] // Help is plain text.
#[derive(Debug, Clone, Default, clap::Args)]
pub struct WebhookConfig {
    /// URL that receives a webhook when a job ends
    #[arg(long, env = "UNIGROUND_WEBHOOK_URL", value_name = "URL")]
    pub webhook_url: Option<String>,
    /// File with the secret that signs webhooks: whsec_ and base64. The secret itself can be set in
    /// UNIGROUND_WEBHOOK_SECRET
    #[arg(long, env = "UNIGROUND_WEBHOOK_SECRET_FILE", value_name = "FILE")]
    pub webhook_secret_file: Option<Utf8PathBuf>,
    /// Allow webhooks to loopback and private network addresses
    #[arg(long, env = "UNIGROUND_WEBHOOK_ALLOW_PRIVATE")]
    pub webhook_allow_private: bool,
}

impl WebhookConfig {
    /// Returns the webhook, if one is configured.
    ///
    /// # Errors
    /// Returns an error for an invalid or private address, and for a missing or invalid secret.
    pub fn webhook(&self) -> anyhow::Result<Option<Webhook>> {
        let Some(url) = &self.webhook_url else { return Ok(None) };
        telemetry::register_secrets_of_address(url);
        let secret = match &self.webhook_secret_file {
            Some(file) => {
                fs::read_to_string(file).with_context(|| format!("the secret file {file}"))?
            }
            None => std::env::var("UNIGROUND_WEBHOOK_SECRET").context(
                "--webhook-url requires --webhook-secret-file or UNIGROUND_WEBHOOK_SECRET",
            )?,
        };
        telemetry::register_secret(secret.trim());
        Ok(Some(Webhook::new(url, &secret, self.webhook_allow_private).context("--webhook-url")?))
    }
}

/// A vision-language model behind an OpenAI-compatible chat endpoint. Its key is in
/// UNIGROUND_VLM_API_KEY or in a file.
#[allow(clippy::doc_markdown)] // Help is plain text.
#[derive(Debug, Clone, clap::Args)]
pub struct VlmConfig {
    /// Base URL of an OpenAI-compatible chat endpoint, like <https://host/v1>
    #[arg(long, env = "UNIGROUND_VLM_URL", value_name = "URL")]
    pub vlm_url: Option<String>,
    /// Name of the vision-language model at the endpoint
    #[arg(long, env = "UNIGROUND_VLM_MODEL", value_name = "NAME")]
    pub vlm_model: Option<String>,
    /// File with the API key of the endpoint. The key itself can be set in UNIGROUND_VLM_API_KEY
    #[arg(long, env = "UNIGROUND_VLM_API_KEY_FILE", value_name = "FILE")]
    pub vlm_api_key_file: Option<Utf8PathBuf>,
    /// Price per million prompt tokens, US dollars
    #[arg(long, env = "UNIGROUND_VLM_PROMPT_USD", default_value_t = 0.0, value_name = "USD")]
    pub vlm_prompt_usd: f64,
    /// Price per million completion tokens, US dollars
    #[arg(long, env = "UNIGROUND_VLM_COMPLETION_USD", default_value_t = 0.0, value_name = "USD")]
    pub vlm_completion_usd: f64,
    /// Spending limit for the model per day (UTC), US dollars. Requires both prices
    #[arg(long, env = "UNIGROUND_VLM_DAILY_USD", value_name = "USD")]
    pub vlm_daily_usd: Option<f64>,
    /// Maximum number of parallel requests to the endpoint
    #[arg(long, env = "UNIGROUND_VLM_CONCURRENCY", default_value_t = DEFAULT_VLM_CONCURRENCY, value_name = "N", value_parser = clap::value_parser!(u32).range(1..=1024))]
    pub vlm_concurrency: u32,
    /// Timeout of one attempt, seconds
    #[arg(long, env = "UNIGROUND_VLM_TIMEOUT_S", default_value_t = DEFAULT_VLM_TIMEOUT_S, value_name = "SECONDS", value_parser = clap::value_parser!(u64).range(1..=3600))]
    pub vlm_timeout_s: u64,
    /// Maximum number of attempts per call. The delay between attempts doubles
    #[arg(long, env = "UNIGROUND_VLM_ATTEMPTS", default_value_t = DEFAULT_VLM_ATTEMPTS, value_name = "N", value_parser = clap::value_parser!(u32).range(1..=20))]
    pub vlm_attempts: u32,
    /// Delay before the second attempt, milliseconds
    #[arg(long, env = "UNIGROUND_VLM_BACKOFF_MS", default_value_t = DEFAULT_VLM_BACKOFF_MS, value_name = "MS")]
    pub vlm_backoff_ms: u64,
    /// When the model names all objects of a scene. The names are then used by every reasoner
    #[arg(long, env = "UNIGROUND_NAMES", value_enum, default_value_t)]
    pub names: NamingChoice,
    /// Request answers as JSON with a schema, if the endpoint supports it
    #[arg(long, env = "UNIGROUND_VLM_JSON")]
    pub vlm_json: bool,
    /// How the model gives places in pictures. `models check-vlm` finds out
    #[arg(long, env = "UNIGROUND_VLM_POINTS", value_enum, default_value_t)]
    pub vlm_points: PointChoice,
    /// Maximum number of pictures in one request. Where a question has more, several are combined
    #[arg(long, env = "UNIGROUND_VLM_MAX_IMAGES", value_name = "N", value_parser = clap::value_parser!(u32).range(1..=100))]
    pub vlm_max_images: Option<u32>,
    /// Maximum size of the longer side of a picture, pixels. Larger pictures are reduced
    #[arg(long, env = "UNIGROUND_VLM_MAX_IMAGE_PX", value_name = "PIXELS", value_parser = clap::value_parser!(u32).range(256..=8192))]
    pub vlm_max_image_px: Option<u32>,
}

/// How a model gives places in pictures.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, clap::ValueEnum)]
pub enum PointChoice {
    /// Thousandths of width and height
    #[default]
    Thousandths,
    /// Pixels, as the models of the Qwen2.5-VL family
    Pixels,
}

impl From<PointChoice> for PointForm {
    fn from(choice: PointChoice) -> Self {
        match choice {
            PointChoice::Thousandths => Self::Thousandths,
            PointChoice::Pixels => Self::Pixels,
        }
    }
}

/// Parses of a new scene, if there are neural networks.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, clap::ValueEnum)]
pub enum ParseChoice {
    /// First a draft with the built-in methods, in seconds, then the full parse
    #[default]
    DraftFirst,
    /// Only the full parse
    FullOnly,
    /// Only the draft. A full parse is made on request (`POST /v1/scenes/{id}/parse`)
    DraftOnly,
}

impl From<ParseChoice> for ParseMode {
    fn from(choice: ParseChoice) -> Self {
        match choice {
            ParseChoice::DraftFirst => Self::DraftFirst,
            ParseChoice::FullOnly => Self::FullOnly,
            ParseChoice::DraftOnly => Self::DraftOnly,
        }
    }
}

/// When the model names all objects of a scene automatically.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, clap::ValueEnum)]
pub enum NamingChoice {
    /// Never. Only on request (`POST /v1/scenes/{id}/names`)
    #[default]
    Off,
    /// Before the first question that the model answers. That question waits
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
            vlm_points: PointChoice::Thousandths,
            vlm_max_images: None,
            vlm_max_image_px: None,
        }
    }
}

impl VlmConfig {
    /// Returns what the model accepts in one request.
    #[must_use]
    pub fn picture_limits(&self) -> PictureLimits {
        PictureLimits { count: self.vlm_max_images, side_px: self.vlm_max_image_px }
    }

    /// Returns the client, if a model is configured.
    ///
    /// # Errors
    /// Returns an error if only one of address and model is set, for an invalid address, and for an
    /// unreadable key file.
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
            (Some(_), None) => bail!("--vlm-url requires --vlm-model"),
            (None, Some(_)) => bail!("--vlm-model requires --vlm-url"),
        };
        ensure!(
            reqwest::Url::parse(&base_url).is_ok_and(|url| url.has_host()),
            "--vlm-url: invalid URL"
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
        // Without prices every cost is 0, so a budget would have no effect.
        let is_free = *vlm_prompt_usd == 0.0 && *vlm_completion_usd == 0.0;
        ensure!(
            !is_free || vlm_daily_usd.is_none(),
            "--vlm-daily-usd requires --vlm-prompt-usd and --vlm-completion-usd"
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

/// Limits for requests and jobs.
#[derive(Debug, Clone, clap::Args)]
pub struct LimitsConfig {
    /// Maximum size of an upload, bytes
    #[arg(long, env = "UNIGROUND_MAX_UPLOAD_BYTES", default_value_t = DEFAULT_MAX_UPLOAD_BYTES)]
    pub max_upload_bytes: u64,
    /// Maximum number of unfinished resumable uploads
    #[arg(long, env = "UNIGROUND_MAX_UNFINISHED_UPLOADS", default_value_t = DEFAULT_MAX_UNFINISHED_UPLOADS, value_name = "N")]
    pub max_unfinished_uploads: u32,
    /// Maximum unpacked size of an archive, bytes
    #[arg(long, env = "UNIGROUND_MAX_UNPACKED_BYTES", default_value_t = UnpackLimits::default().max_bytes)]
    pub max_unpacked_bytes: u64,
    /// Maximum number of queued parses. Further uploads are rejected with Retry-After
    #[arg(long, env = "UNIGROUND_MAX_QUEUED_JOBS", default_value_t = DEFAULT_MAX_QUEUED_JOBS)]
    pub max_queued_jobs: u32,
    /// Maximum number of questions answered in parallel
    #[arg(long, env = "UNIGROUND_MAX_CONCURRENT_QUESTIONS", default_value_t = DEFAULT_MAX_CONCURRENT_QUESTIONS, value_parser = clap::value_parser!(u32).range(1..=4096))]
    pub max_concurrent_questions: u32,
    /// Maximum number of open connections
    #[arg(long, env = "UNIGROUND_MAX_CONNECTIONS", default_value_t = DEFAULT_MAX_CONNECTIONS, value_parser = clap::value_parser!(u32).range(8..=65_536))]
    pub max_connections: u32,
    /// Free disk space that uploads, parses and batches must leave, bytes
    #[arg(long, env = "UNIGROUND_KEEP_FREE_BYTES", default_value_t = DEFAULT_KEEP_FREE_BYTES)]
    pub keep_free_bytes: u64,
    /// Memory limit of the server, bytes. A parse that would exceed it does not start [default: the
    /// limit of the container, or the memory of the machine]
    #[arg(long, env = "UNIGROUND_MAX_MEMORY_BYTES")]
    pub max_memory_bytes: Option<u64>,
    /// Memory limit of a process that imports an uploaded scan, MB. A process that checks an upload
    /// may use a quarter of it
    #[arg(long, env = "UNIGROUND_READER_MEMORY_MB", default_value_t = DEFAULT_READER_MEMORY_MB, value_name = "MB", value_parser = clap::value_parser!(u64).range(256..=1_048_576))]
    pub reader_memory_mb: u64,
    /// Executable that reads uploaded scans in separate processes [default: this executable]
    #[arg(long, hide = true, value_name = "FILE")]
    pub reader_program: Option<Utf8PathBuf>,
    #[command(flatten)]
    pub retention: RetentionConfig,
}

/// Log format and trace export. `RUST_LOG` sets the level; the default is `info`.
#[allow(clippy::doc_markdown)] // Help is plain text.
#[derive(Debug, Clone, clap::Args)]
pub struct LogConfig {
    /// Format of the log on stderr
    #[arg(long, env = "UNIGROUND_LOG_FORMAT", value_enum, default_value_t = LogFormat::Text)]
    pub log_format: LogFormat,
    /// Export traces of requests, jobs and model calls to this OpenTelemetry collector (OTLP over
    /// HTTP), like <http://127.0.0.1:4318>
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
    /// Returns the processes that read uploaded scans.
    #[must_use]
    pub fn scan_reader(&self) -> ScanReader {
        ScanReader::isolated(ChildProcess::new(
            self.reader_program.clone(),
            self.reader_memory_mb << 20,
        ))
    }
}

impl ServeConfig {
    /// Returns the configured API key of the server.
    ///
    /// # Errors
    /// Returns an error if the key cannot be read or is too short.
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
            "the API key is too short: it needs at least {MIN_KEY_BYTES} characters"
        );
        telemetry::register_secret(&key);
        Ok(Some(key))
    }

    /// Returns whether other machines can reach this server while neither a key nor
    /// `--allow-anybody` is set.
    #[must_use]
    pub fn requires_keys(&self) -> bool {
        !self.listen.ip().is_loopback() && !self.access.allow_anybody
    }
}

const MIN_KEY_BYTES: usize = 16;
