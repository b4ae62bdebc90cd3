//! uniground: 3D visual grounding as a service. The method is in [`uniground_core`], what crosses
//! the wire in [`uniground_types`].
pub mod app;
pub mod chat;
pub mod cli;
pub mod config;
pub mod error;
pub mod evaluation;
pub mod http;
pub mod inference;
pub mod isolation;
pub mod jobs;
mod memory;
pub mod metrics;
pub mod packages;
pub mod packing;
pub mod sample;
pub mod service;
pub mod store;
pub mod telemetry;
mod trace_context;
pub mod webhook;
mod words;
