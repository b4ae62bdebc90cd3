//! Flags for neural models: which bundles, where they lie, what runs them.

use super::{AUTO, BUILTIN};
use crate::{telemetry, words};
use anyhow::ensure;
use camino::Utf8PathBuf;
use std::time::Duration;
use uniground_core::models::neural::{Engine, OnnxRuntime, Provider, RuntimeSettings};
use uniground_endpoints::inference::RemoteServer;

/// Where ONNX Runtime's library is fetched to; the first place it is looked for.
pub const LIBRARY_FOLDER: &str = "./.onnxruntime";

/// Neural models: bundles of ONNX networks, run here or behind an inference server.
#[allow(clippy::doc_markdown)] // Help is no Markdown.
#[derive(Debug, Clone, clap::Args)]
pub struct ModelsConfig {
    /// Where 2D masks come from: auto (the first segmenter in --models that works, else built in),
    /// builtin, or a segmenter's bundle, by name or folder; several joined by + all have a vote
    #[arg(long, env = "UNIGROUND_MASKS", default_value = AUTO, value_name = "BUNDLE")]
    pub masks: String,
    /// What compares pictures and words: auto (the first dual encoder in --models that works, else
    /// built in), builtin, or a dual encoder's bundle, by name or folder
    #[arg(long, env = "UNIGROUND_ENCODER", default_value = AUTO, value_name = "BUNDLE")]
    pub encoder: String,
    #[command(flatten)]
    pub bundles: BundlesConfig,
}

/// Where bundles lie and what runs them.
#[allow(clippy::doc_markdown, rustdoc::invalid_html_tags)] // Help is no Markdown.
#[derive(Debug, Clone, clap::Args)]
pub struct BundlesConfig {
    /// Folder with model bundles
    #[arg(long, env = "UNIGROUND_MODELS", default_value = "./models", value_name = "FOLDER")]
    pub models: Utf8PathBuf,
    #[command(flatten)]
    pub runtime: RuntimeConfig,
    /// Run the bundles' networks at this inference server (KServe v2 protocol) instead of here,
    /// under the names <bundle>-<file>
    #[arg(long, env = "UNIGROUND_INFERENCE_URL", value_name = "URL")]
    pub inference_url: Option<String>,
    /// How long one call to the inference server may take, seconds
    #[arg(long, env = "UNIGROUND_INFERENCE_TIMEOUT_S", default_value_t = DEFAULT_INFERENCE_TIMEOUT_S, value_name = "SECONDS", value_parser = clap::value_parser!(u64).range(1..))]
    pub inference_timeout_s: u64,
}

/// The library that runs networks on this machine.
#[allow(clippy::doc_markdown)] // Help is no Markdown.
#[derive(Debug, Clone, Default, clap::Args)]
pub struct RuntimeConfig {
    /// ONNX Runtime's library [default: ORT_DYLIB_PATH, ./.onnxruntime/libonnxruntime.so, or
    /// beside the executable]
    #[arg(long, env = "UNIGROUND_ONNXRUNTIME_LIB", value_name = "FILE")]
    pub onnxruntime_lib: Option<Utf8PathBuf>,
    /// What networks run on; one that is not there is an error
    #[arg(long, env = "UNIGROUND_PROVIDER", default_value_t, value_name = "PROVIDER", value_parser = words::provider())]
    pub provider: Provider,
    /// Cores a network may use [default: all]
    #[arg(long, env = "UNIGROUND_MODEL_THREADS", value_name = "COUNT", value_parser = clap::value_parser!(u16).range(1..))]
    pub model_threads: Option<u16>,
}

const DEFAULT_INFERENCE_TIMEOUT_S: u64 = 60;

impl ModelsConfig {
    /// No model, whatever lies where.
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
    /// Nothing was said about what runs networks: where the usual library is not found, nobody
    /// asked for it.
    #[must_use]
    pub fn is_default(&self) -> bool {
        let RuntimeConfig { onnxruntime_lib, provider, model_threads: _ } = &self.runtime;
        self.inference_url.is_none()
            && onnxruntime_lib.is_none()
            && *provider == Provider::default()
    }

    /// The engine that runs networks. Blocks: not for asynchronous code.
    ///
    /// # Errors
    /// What is wrong with the library; an address that is none.
    pub fn engine(&self) -> anyhow::Result<Box<dyn Engine>> {
        Ok(match &self.inference_url {
            Some(url) => {
                telemetry::register_secrets_of_address(url);
                ensure!(
                    reqwest::Url::parse(url).is_ok_and(|url| url.has_host()),
                    "--inference-url: this is not an address"
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
