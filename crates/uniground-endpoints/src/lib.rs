//! Models that run elsewhere: chat models behind an OpenAI-compatible API ([`chat`]) and networks
//! on an inference server that speaks `KServe` v2 ([`inference`]).

pub mod chat;
pub mod inference;
