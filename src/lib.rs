//! uniground: 3D visual grounding as a service.
pub mod geometry;
pub mod grounding;
pub mod ingest;
pub mod models;
pub mod progress;
pub mod scene;
pub mod scene_parsing;
pub mod cli;
