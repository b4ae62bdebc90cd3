//! The neural models of a server.

use serde::{Deserialize, Serialize};

/// What a model is for.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(rename_all = "snake_case")]
pub enum Role {
    /// Cuts pictures into masks.
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

/// A model in use, as told to callers.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct LoadedModel {
    /// Name of the bundle.
    pub name: String,
    /// Which part of the work it does.
    pub role: Role,
    /// SHA-256 over the bundle's files; of the manifest and the server's models where those run
    /// elsewhere.
    pub fingerprint: String,
    /// `cpu`, `cuda`, `tensorrt`, `coreml`, or the inference server's address.
    pub runs_on: String,
    /// The library that computes; none where networks run elsewhere.
    pub library: Option<String>,
    /// Dimensions of an embedding; none for masks.
    pub dimensions: Option<usize>,
    /// Pictures, or prompts, per call.
    pub batch: usize,
    /// As the bundle's manifest states it; empty where it does not.
    pub licence: String,
}
