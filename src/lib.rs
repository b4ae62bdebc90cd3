//! uniground: 3D visual grounding as a service. [`uniground_core`] implements the method and
//! [`uniground_types`] the types of the API.
pub mod app;
pub mod bundles;
pub mod cli;
pub mod config;
pub mod http;
pub mod packages;
pub mod telemetry;
mod words;
