//! The neural models of a server.

use serde::{Deserialize, Serialize};

/// Role of a model.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(rename_all = "snake_case")]
pub enum Role {
    /// Segments pictures into masks.
    Masks,
    /// Compares pictures and words.
    Encoder,
}

impl std::fmt::Display for Role {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(match self {
            Self::Masks => "masks",
            Self::Encoder => "encoder",
        })
    }
}

/// A loaded model.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct LoadedModel {
    /// Name of the bundle.
    pub name: String,
    /// Role of the model.
    pub role: Role,
    /// SHA-256 over the bundle's files. On an inference server: over the manifest and the server's
    /// models.
    pub fingerprint: String,
    /// Device or server that runs it: `cpu`, `cuda`, `tensorrt`, `coreml`, or the address of the
    /// inference server.
    pub runs_on: String,
    /// Name and version of the inference library. `null` on an inference server.
    pub library: Option<String>,
    /// Dimensions of an embedding. `null` for segmentation models.
    pub dimensions: Option<usize>,
    /// Batch size: pictures or prompts per call.
    pub batch: usize,
    /// License from the bundle's manifest. Empty if not stated.
    pub licence: String,
}
