//! Networks on an inference server that speaks the `KServe` v2 protocol.

mod kserve;
mod probe;

pub use kserve::RemoteServer;
pub use probe::Probe;
