//! What knows words and pictures: the built-in lexicon (`attributes`), neural networks (`neural`),
//! chat models (`chat`).

#![warn(missing_docs)]

pub mod attributes;
pub mod calibration;
pub mod chat;
pub mod choice;
pub mod neural;

/// An error with what caused it: the outermost alone seldom says it.
#[must_use]
pub fn with_causes(error: &dyn std::error::Error) -> String {
    let causes = std::iter::successors(Some(error), |e| e.source());
    causes.map(ToString::to_string).collect::<Vec<_>>().join(": ")
}
