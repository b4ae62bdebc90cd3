//! Whether a server is alive and ready, and what it was started with.

use crate::models::LoadedModel;
use serde::{Deserialize, Serialize};

/// Whether the process is alive.
#[derive(Debug, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct Health {
    /// Always `ok`: a process that answers is alive.
    pub status: String,
    /// Version of the server, like `1.2.3`.
    pub version: String,
}

/// What the service needs to do its work, each `ok` or what is wrong.
#[derive(Debug, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct Readiness {
    /// Whether database, folder, disk, workers and inference server are all `ok`; the HTTP status
    /// is 503 otherwise.
    pub ready: bool,
    /// `ok`, or why the database can not be written.
    pub database: String,
    /// `ok`, or why nothing can be read or written where scans and results are kept.
    pub blob_folder: String,
    /// `ok`, or how little room is left.
    #[serde(default)]
    pub disk: String,
    /// `ok`, or `stopped` with the kinds of jobs that are no longer worked on.
    pub worker: String,
    /// `ok`, or why the inference server does not answer; absent where networks run in the server
    /// itself.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub inference_server: Option<String>,
    /// `ok`, or since when the vision-language model has answered no call; absent where none is
    /// configured. It does not count for `ready`: built-in parts answer meanwhile.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub vlm: Option<String>,
    /// Where masks come from.
    pub masks: String,
    /// How instances and words are compared.
    pub encoder: String,
    /// The neural models among these, loaded and run once at the start.
    pub models: Vec<LoadedModel>,
}

/// The models a server was started with.
#[derive(Debug, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct ModelList {
    /// The neural models that take part in parses and questions; empty when all parts are built
    /// in.
    pub models: Vec<LoadedModel>,
    /// The vision-language model that reasons, by the name its endpoint knows it by; `null` when
    /// none is configured.
    pub vlm: Option<String>,
}
