//! Gets bundles of networks from elsewhere: the Hugging Face hub, a folder, or a zip file.
//!
//! ```text
//! BundleSource ─> origin (hub_api, hub_cache, folder): file names ─> plan (which of them)
//!              ─> transfer (resumed, verified) ─> files in a staging folder
//!              ─> manifest ─> the bundle's folder ─> models.lock
//! ```
//! Everything that was installed is pinned in `models.lock`: revision, files and hashes. An attempt
//! that fails changes no bundle, and the next one goes on from the files that are there.

mod folder;
mod hub_api;
mod hub_cache;
mod hub_settings;
mod install;
mod known;
mod lock;
mod measurements;
mod origin;
mod plan;
mod source;
mod transfer;

pub use hub_settings::HubSettings;
pub use install::{AddOptions, Added, add, install_locked};
pub use known::{KNOWN, KnownModel};
pub use lock::{Lock, LockedBundle};
pub use measurements::Measurements;
pub use source::{BundleSource, HubName, check_name};

use camino::Utf8PathBuf;
use std::io;

/// Errors of a bundle from elsewhere. Messages name the source and say what to do.
#[derive(Debug, thiserror::Error)]
#[allow(missing_docs)] // Every message describes its variant.
pub enum AddError {
    #[error("{source_name}: {why}")]
    Source { source_name: String, why: String },
    #[error("{source_name}: {address} cannot be reached: {why}. {remedy}")]
    Unreachable { source_name: String, address: String, why: String, remedy: &'static str },
    #[error("{source_name}: {address} {why}")]
    Failing { source_name: String, address: String, why: String },
    #[error(
        "{source_name}: {file} has the {algorithm} {found}, expected {expected}: it differs from \
         the published file and was not installed"
    )]
    WrongHash {
        source_name: String,
        file: String,
        algorithm: &'static str,
        found: String,
        expected: String,
    },
    #[error("{file}: {why}")]
    File { file: Utf8PathBuf, why: io::Error },
    #[error("{source_name}: {why}")]
    Layout { source_name: String, why: String },
}

impl AddError {
    /// Returns whether the source could not be reached, so that another one can be tried.
    #[must_use]
    pub fn is_unreachable(&self) -> bool {
        matches!(self, Self::Unreachable { .. } | Self::Failing { .. })
    }
}
