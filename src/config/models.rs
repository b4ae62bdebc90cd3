//! Flags of neural models: which bundles, where they are, and what runs them.

use super::{AUTO, BUILTIN};
use crate::{telemetry, words};
use anyhow::ensure;
use camino::Utf8PathBuf;
use std::time::Duration;
use uniground_core::models::neural::{Engine, OnnxRuntime, Provider, RuntimeSettings};
use uniground_endpoints::inference::RemoteServer;

/// Folder into which ONNX Runtime is fetched, and the first one searched for it.
pub const LIBRARY_FOLDER: &str = "./.onnxruntime";

/// Neural models: bundles of ONNX networks, run locally or on an inference server.
#[allow(clippy::doc_markdown)] // Help is plain text.
#[derive(Debug, Clone, clap::Args)]
pub struct ModelsConfig {
    /// Source of 2D masks: auto (the first segmentation bundle in --models that works, else
    /// builtin), builtin, or a bundle by name, folder or source (hub:OWNER/NAME). Join several with
    /// + to combine their masks
    #[arg(long, env = "UNIGROUND_MASKS", default_value = AUTO, value_name = "BUNDLE")]
    pub masks: String,
    /// Image and text encoder: auto (the first encoder bundle in --models that works, else
    /// builtin), builtin, or a bundle by name, folder or source (hub:OWNER/NAME)
    #[arg(long, env = "UNIGROUND_ENCODER", default_value = AUTO, value_name = "BUNDLE")]
    pub encoder: String,
    #[command(flatten)]
    pub bundles: BundlesConfig,
}

/// The folder of bundles and what runs them.
#[allow(clippy::doc_markdown, rustdoc::invalid_html_tags)] // Help is plain text.
#[derive(Debug, Clone, clap::Args)]
pub struct BundlesConfig {
    /// Folder with model bundles
    #[arg(long, env = "UNIGROUND_MODELS", default_value = "./models", value_name = "FOLDER")]
    pub models: Utf8PathBuf,
    #[command(flatten)]
    pub runtime: RuntimeConfig,
    /// Run networks on this inference server (KServe v2 protocol) instead of locally. The model
    /// names there are <bundle>-<file>
    #[arg(long, env = "UNIGROUND_INFERENCE_URL", value_name = "URL")]
    pub inference_url: Option<String>,
    /// Timeout of one call to the inference server, seconds
    #[arg(long, env = "UNIGROUND_INFERENCE_TIMEOUT_S", default_value_t = DEFAULT_INFERENCE_TIMEOUT_S, value_name = "SECONDS", value_parser = clap::value_parser!(u64).range(1..))]
    pub inference_timeout_s: u64,
}

/// The library that runs networks locally.
#[allow(clippy::doc_markdown)] // Help is plain text.
#[derive(Debug, Clone, Default, clap::Args)]
pub struct RuntimeConfig {
    /// Path of the ONNX Runtime library [default: ORT_DYLIB_PATH, ./.onnxruntime/libonnxruntime.so,
    /// or next to the executable]
    #[arg(long, env = "UNIGROUND_ONNXRUNTIME_LIB", value_name = "FILE")]
    pub onnxruntime_lib: Option<Utf8PathBuf>,
    /// Execution provider for networks. Startup fails if it is not available
    #[arg(long, env = "UNIGROUND_PROVIDER", default_value_t, value_name = "PROVIDER", value_parser = words::provider())]
    pub provider: Provider,
    /// Number of CPU cores a network may use [default: all]
    #[arg(long, env = "UNIGROUND_MODEL_THREADS", value_name = "COUNT", value_parser = clap::value_parser!(u16).range(1..))]
    pub model_threads: Option<u16>,
}

const DEFAULT_INFERENCE_TIMEOUT_S: u64 = 60;

impl ModelsConfig {
    /// Returns a configuration without models.
    #[must_use]
    pub fn builtin() -> Self {
        Self { masks: BUILTIN.into(), encoder: BUILTIN.into(), bundles: BundlesConfig::default() }
    }
}

impl Default for BundlesConfig {
    fn default() -> Self {
        Self {
            models: "./models".into(),
            runtime: RuntimeConfig::default(),
            inference_url: None,
            inference_timeout_s: DEFAULT_INFERENCE_TIMEOUT_S,
        }
    }
}

impl BundlesConfig {
    /// Returns whether no runtime option is set. A missing default library is then not an error.
    #[must_use]
    pub fn is_default(&self) -> bool {
        let RuntimeConfig { onnxruntime_lib, provider, model_threads: _ } = &self.runtime;
        self.inference_url.is_none()
            && onnxruntime_lib.is_none()
            && *provider == Provider::default()
    }

    /// Returns the engine that runs networks. Blocks: not for asynchronous code.
    ///
    /// # Errors
    /// Returns an error if the library cannot be used or the address is invalid.
    pub fn engine(&self) -> anyhow::Result<Box<dyn Engine>> {
        Ok(match &self.inference_url {
            Some(url) => {
                telemetry::register_secrets_of_address(url);
                ensure!(
                    reqwest::Url::parse(url).is_ok_and(|url| url.has_host()),
                    "--inference-url: invalid URL"
                );
                Box::new(RemoteServer::new(url, Duration::from_secs(self.inference_timeout_s))?)
            }
            None => Box::new(OnnxRuntime::load(&self.runtime.settings())?),
        })
    }
}

impl RuntimeConfig {
    #[must_use]
    pub fn settings(&self) -> RuntimeSettings {
        let Self { onnxruntime_lib, provider, model_threads } = self;
        RuntimeSettings {
            library: onnxruntime_lib.clone(),
            provider: *provider,
            threads: model_threads.map(usize::from),
        }
    }
}
