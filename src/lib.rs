//! uniground: 3D visual grounding as a service.
pub mod app;
pub mod config;
pub mod error;
pub mod geometry;
pub mod grounding;
pub mod http;
pub mod ingest;
pub mod jobs;
pub mod models;
pub mod progress;
pub mod render;
pub mod scene;
pub mod scene_parsing;
pub mod service;
pub mod store;
pub mod telemetry;
pub mod cli;
