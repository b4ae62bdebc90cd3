//! Networks that run elsewhere: behind an inference server of the `KServe` v2 protocol.

mod kserve;

pub use kserve::RemoteServer;
