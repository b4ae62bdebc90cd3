//! Where networks run.

use super::ModelError;
use super::bundle::Bundle;
use super::network::Network;

/// What a network is called for: it decides who gives way.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Work {
    /// Frames of a parse: long, and nobody waits for a single call.
    Parsing,
    /// Words of a question: short, and somebody waits.
    Questions,
}

/// Something that runs networks: ONNX Runtime in this process
/// ([`OnnxRuntime`](super::OnnxRuntime)), or an inference server elsewhere.
pub trait Engine: Send + Sync {
    /// Opens a network of a bundle; `at_once` calls of it may run at the same time.
    ///
    /// # Errors
    /// [`ModelError`] naming the file, or the server's model.
    fn open(
        &self,
        bundle: &Bundle,
        file: &str,
        at_once: usize,
        work: Work,
    ) -> Result<Box<dyn Network>, ModelError>;

    /// What tells this bundle's answers from those of another: its files where they are read here;
    /// elsewhere, its manifest and what the server says it has.
    ///
    /// # Errors
    /// [`ModelError`] naming the file, or the server's model.
    fn fingerprint(&self, bundle: &Bundle) -> Result<String, ModelError>;

    /// For people: `cpu`, `cuda`, or an address.
    fn runs_on(&self) -> String;

    /// Whether something other than processor cores is known to compute, which likes larger
    /// batches.
    fn is_accelerated(&self) -> bool {
        false
    }

    /// File of the library that computes; none where networks run elsewhere.
    fn library(&self) -> Option<String>;
}
