//! What knows words and pictures: the built-in lexicon (`attributes`), neural networks (`neural`), chat models (`chat`).

pub mod attributes;
pub mod chat;
pub mod likeness;
pub mod neural;
