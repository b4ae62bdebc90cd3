//! 3D visual grounding as a library: a scan of a room to instances, a question in plain words to
//! an instance and its 3D box.
//!
//! ```text
//! scan   -> parse (ingest -> parsing) -> ParsedScene         stage 1 (paper: Global Candidate Filtering)
//! query  -> language -> grounding::pipeline -> answer        stage 2 (paper: Contextual Precision Grounding)
//! ```
//! This crate re-exports the crates of the method under one name. None of them has an async
//! runtime, a database, HTTP or a command line: they run inside a robot's own process.
//! `examples/ground.rs` shows the whole way in forty lines. `docs/METHOD.md` says what each stage
//! computes and where the paper describes it.

#![warn(missing_docs)]

pub use uniground_export as export;
pub use uniground_geometry as geometry;
pub use uniground_geometry::{background, lru_cache, progress, scene};
pub use uniground_grounding as grounding;
pub use uniground_grounding::approach;
pub use uniground_ingest as ingest;
pub use uniground_language as language;
pub use uniground_models as models;
pub use uniground_parsing as parsing;
pub use uniground_parsing::{changes, scan};
pub use uniground_render as render;
pub use uniground_types as types;
