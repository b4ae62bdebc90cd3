//! What the service counts and traces: metrics, the trace a request belongs to, and the memory the
//! process holds.

pub mod memory;
pub mod metrics;
pub mod trace_context;
