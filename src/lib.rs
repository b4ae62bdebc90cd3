//! uniground: 3D visual grounding as a service. The method is in [`uniground_core`], what crosses
//! the wire in [`uniground_types`].
pub mod app;
pub mod cli;
pub mod config;
pub mod http;
pub mod packages;
pub mod telemetry;
mod words;
