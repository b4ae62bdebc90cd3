//! Neural models: bundles of ONNX networks, run here through ONNX Runtime or behind a server of the `KServe` v2 protocol.
//!
//! ```text
//! bundle (model.json) ─> Networks ─> onnx (session pool)   or   kserve (HTTP)
//!                           └─> DualEncoder, Segmenter
//! ```
//! What stands above knows pictures, words and prompts; nobody outside this folder sees a tensor.

mod bundle;
mod dual_encoder;
mod kserve;
mod loading;
mod network;
mod onnx;
mod pixels;
mod segmenter;
mod shelf;

pub use dual_encoder::{DualEncoder, TextEmbedding};
pub use kserve::RemoteServer;
pub use loading::{Engine, LoadedModel, Models, Role, folder_of};
pub use onnx::{OnnxRuntime, Provider, RuntimeSettings};
pub use segmenter::{Encoded, LowMask, PointLabel, Prompt, Segmenter};
pub use shelf::{BundleFile, BundleListing, list, verify};

use camino::Utf8PathBuf;

/// What can be wrong with a model. Messages name the file and the tensor.
#[derive(Debug, thiserror::Error)]
pub enum ModelError {
    #[error("the ONNX Runtime library was not found: looked at {}", looked_at.join(", "))]
    NoLibrary { looked_at: Vec<String> },
    #[error("the ONNX Runtime library {library} can not be used: {why}")]
    BadLibrary { library: Utf8PathBuf, why: String },
    #[error("{provider} is not there: {why}")]
    NoProvider { provider: Provider, why: String },
    #[error("{file}: {why}")]
    Bundle { file: Utf8PathBuf, why: String },
    #[error("{file}: tensor {tensor}: {why}")]
    Tensor { file: Utf8PathBuf, tensor: String, why: String },
    #[error("{network} failed: {why}")]
    Run { network: String, why: String },
    #[error("{network}: {tensor} has values that are no numbers")]
    NotFinite { network: String, tensor: String },
    #[error("{network} at the inference server: {why}")]
    Remote { network: String, why: String },
}

#[cfg(test)]
pub(crate) mod tests;
