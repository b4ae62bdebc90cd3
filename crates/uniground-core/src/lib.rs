//! 3D visual grounding as a library: a scan of a room to instances, a question in plain words to an
//! instance and its 3D box.
//!
//! ```text
//! scan   -> parse (ingest -> scene_parsing) -> ParsedScene          stage 1 (paper: Global Candidate Filtering)
//! query  -> grounding::query -> grounding::pipeline -> answer   stage 2 (paper: Contextual Precision Grounding)
//! ```
//! No async runtime, no database, no HTTP, no command line: usable inside a robot's own process.
//! `examples/ground.rs` is the whole way in forty lines. `docs/METHOD.md` says what each stage
//! computes and where the paper has it.

#![warn(missing_docs)]

pub mod approach;
pub mod background;
pub mod changes;
pub mod export;
pub mod geometry;
pub mod grounding;
pub mod ingest;
pub mod models;
pub mod parse;
pub mod progress;
pub mod recent;
pub mod render;
pub mod scene;
pub mod scene_parsing;

pub use uniground_types as types;
