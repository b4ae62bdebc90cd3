//! Types of uniground's public interface: requests, answers, settings and errors. The service, its
//! client and the pipelines of `uniground-core` share them.
//!
//! Lengths are in meters in a right-handed world frame with Z up. Boxes have a center and a full
//! extent. The feature `openapi` adds OpenAPI schemas.

#![warn(missing_docs)]

pub mod answer;
pub mod approach;
pub mod batch;
pub mod changes;
pub mod corrections;
pub mod coverage;
pub mod export;
pub mod findings;
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
