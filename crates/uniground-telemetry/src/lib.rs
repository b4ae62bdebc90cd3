//! Telemetry: metrics, trace context, and the memory use of the process.

pub mod memory;
pub mod metrics;
pub mod trace_context;
