//! Models of words and pictures: the built-in lexicon (`attributes`), neural networks (`neural`),
//! chat models (`chat`).

#![warn(missing_docs)]

pub mod attributes;
pub mod calibration;
pub mod chat;
pub mod choice;
pub mod neural;

/// Formats an error with its causes. The outermost error alone often does not explain the failure.
#[must_use]
pub fn with_causes(error: &dyn std::error::Error) -> String {
    let causes = std::iter::successors(Some(error), |e| e.source());
    causes.map(ToString::to_string).collect::<Vec<_>>().join(": ")
}
