//! Engines that run networks.

use super::ModelError;
use super::bundle::Bundle;
use super::network::Network;

/// The purpose of a network's calls. It decides their priority.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Work {
    /// Frames of a parse: many calls, and no user waits for a single one.
    Parsing,
    /// Words of a question: a short call, and a user waits for it.
    Questions,
}

/// Runs networks: ONNX Runtime in this process ([`OnnxRuntime`](super::OnnxRuntime)), or a remote
/// inference server.
pub trait Engine: Send + Sync {
    /// Opens a network of a bundle. Up to `at_once` calls of it can run at the same time.
    ///
    /// # Errors
    /// Returns a [`ModelError`] that names the file or the server's model.
    fn open(
        &self,
        bundle: &Bundle,
        file: &str,
        at_once: usize,
        work: Work,
    ) -> Result<Box<dyn Network>, ModelError>;

    /// Returns a fingerprint that identifies this bundle's results: computed from its files if they
    /// are read here; otherwise from its manifest and what the server reports.
    ///
    /// # Errors
    /// Returns a [`ModelError`] that names the file or the server's model.
    fn fingerprint(&self, bundle: &Bundle) -> Result<String, ModelError>;

    /// Returns where networks run, for people: `cpu`, `cuda`, or an address.
    fn runs_on(&self) -> String;

    /// Returns whether an accelerator is known to be used. It benefits from larger batches.
    fn is_accelerated(&self) -> bool {
        false
    }

    /// Returns the path of the runtime library, or `None` if networks run elsewhere.
    fn library(&self) -> Option<String>;
}
