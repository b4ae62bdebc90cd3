//! Health, readiness and models of a server.

use crate::models::LoadedModel;
use serde::{Deserialize, Serialize};

/// Health of the process.
#[derive(Debug, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct Health {
    /// Always `ok`.
    pub status: String,
    /// Version of the server, like `1.2.3`.
    pub version: String,
}

/// Readiness of the service. Each component is `ok` or describes its problem.
#[derive(Debug, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct Readiness {
    /// Whether database, folder, disk, workers and inference server are all `ok`. If not, the HTTP
    /// status is 503.
    pub ready: bool,
    /// `ok`, or why the database cannot be written.
    pub database: String,
    /// `ok`, or why the storage of scans and results cannot be read or written.
    pub blob_folder: String,
    /// `ok`, or the remaining disk space if it is low.
    #[serde(default)]
    pub disk: String,
    /// `ok`, or `stopped` with the kinds of jobs that are not processed.
    pub worker: String,
    /// `ok`, or why the inference server does not respond. Absent if networks run in the server
    /// itself.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub inference_server: Option<String>,
    /// `ok`, or the time since when the vision-language model has not responded. Absent if none is
    /// configured. Does not affect `ready`, because built-in components take over.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub vlm: Option<String>,
    /// Source of 2D masks.
    pub masks: String,
    /// Encoder that compares instances and words.
    pub encoder: String,
    /// Loaded neural models. Each was run once at startup.
    pub models: Vec<LoadedModel>,
}

/// The models of a server.
#[derive(Debug, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct ModelList {
    /// Neural models for parses and questions. Empty if only built-in components are used.
    pub models: Vec<LoadedModel>,
    /// Name of the vision-language model at its endpoint. `null` if none is configured.
    pub vlm: Option<String>,
}
