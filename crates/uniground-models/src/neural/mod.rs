//! Neural models: bundles of ONNX networks, run by an [`Engine`]: ONNX Runtime in this process, or
//! another engine that the program provides.
//!
//! ```text
//! bundle (model.json) ─> Engine ─> Networks (onnx: session pools)
//!                           └─> DualEncoder, Segmenter
//! ```
//! Callers work with pictures, words and prompts. Tensors are not used outside of this folder.

pub mod bundle;
mod bundle_listing;
mod dual_encoder;
mod engine;
pub mod layouts;
mod loading;
pub mod network;
mod onnx;
mod onnx_file;
mod pixels;
mod segmenter;

pub use bundle_listing::{BundleFile, BundleListing, list, verify};
pub use dual_encoder::{DualEncoder, TextEmbedding};
pub use engine::{Engine, Work};
pub use loading::{Models, bundle_folder};
pub use onnx::{OnnxRuntime, Provider, RuntimeSettings};
pub use segmenter::{Encoded, LowMask, PointLabel, Prompt, Segmenter};
pub use uniground_types::models::{LoadedModel, Role};

use camino::Utf8PathBuf;

/// Errors of a model. Messages name the file and the tensor.
#[derive(Debug, thiserror::Error)]
#[allow(missing_docs)] // Every message describes its variant.
pub enum ModelError {
    #[error("the ONNX Runtime library was not found: searched {}", looked_at.join(", "))]
    NoLibrary { looked_at: Vec<String> },
    #[error("the ONNX Runtime library {library} cannot be used: {why}")]
    BadLibrary { library: Utf8PathBuf, why: String },
    #[error("{provider} is not available: {why}")]
    NoProvider { provider: Provider, why: String },
    #[error("{file}: {why}")]
    Bundle { file: Utf8PathBuf, why: String },
    #[error("{file}: tensor {tensor}: {why}")]
    Tensor { file: Utf8PathBuf, tensor: String, why: String },
    #[error("{network} failed: {why}")]
    Run { network: String, why: String },
    #[error("{network}: {tensor} has NaN or infinite values")]
    NotFinite { network: String, tensor: String },
    #[error("{network} at the inference server: {why}")]
    Remote { network: String, why: String },
}

#[cfg(test)]
pub(crate) mod tests;
