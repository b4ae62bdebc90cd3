//! Evaluation: suites of expressions with ground truth, systems that answer them, measures of both
//! stages, reports.
//!
//! `suite -> run (systems) -> scoring -> measures -> report`. Ground truth is read only in this
//! crate, and only after ranking: see [`sealed`].

pub mod annotated;
pub mod annotations;
pub mod cached_masks;
pub mod comparison;
pub mod configuration;
pub mod digest;
pub mod measures;
pub mod model_check;
pub mod pictures;
pub mod records;
pub mod reliability;
pub mod reply;
pub mod report;
pub mod run;
pub mod scoring;
pub mod sealed;
pub mod segmentation;
pub mod stage_losses;
pub mod suite;
pub mod systems;
