//! The values that cross uniground's borders: what is asked, answered, told and set. The service,
//! its client and the pipelines of `uniground-core` share them; nothing is computed here beyond
//! what a value knows of itself.
//!
//! Lengths are metres in a right-handed world with Z up, boxes are centre and full extent. With the
//! feature `openapi` every type describes itself for an OpenAPI document.

#![warn(missing_docs)]

pub mod answer;
pub mod approach;
pub mod batch;
pub mod changes;
pub mod corrections;
pub mod export;
pub mod geometry;
pub mod graph;
pub mod instances;
pub mod job;
pub mod keys;
pub mod labels;
pub mod links;
pub mod many;
pub mod models;
pub mod numbers;
pub mod placement;
pub mod problem;
pub mod question;
pub mod scene;
pub mod scenes;
pub mod service;
pub mod settings;
pub mod stats;
pub mod transcript;
pub mod uploads;
