//! Networks that run elsewhere: behind an inference server of the `KServe` v2 protocol.

mod kserve;
mod probe;

pub use kserve::RemoteServer;
pub use probe::Probe;
