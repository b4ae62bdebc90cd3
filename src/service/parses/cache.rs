//! Parses that stay in memory, so that a question does not wait for the database or a decoder.

use std::sync::Arc;
use uniground_core::geometry::boxes::Aabb;
use uniground_core::recent::Recent;
use uniground_core::render::RenderScene;
use uniground_core::scene::{Embeddings, Instance};

/// A parse as stage 2 needs it.
pub struct LoadedParse {
    pub id: String,
    pub instances: Vec<Instance>,
    pub extent: Aabb,
    /// Name and version of what the parse was made with.
    pub masks: String,
    pub encoder: String,
    pub embeddings: Option<Embeddings>,
}

/// Scenes whose instances stay in memory: a few kilobytes an instance.
const PARSES: usize = 64;
/// Points of clouds that stay in memory, 15 bytes each.
const POINTS: usize = 8_000_000;

/// What is known of parses without looking at the disk, by their ids.
pub struct ParseCache {
    pub loaded: Recent<Arc<LoadedParse>>,
    pub render_scenes: Recent<Arc<RenderScene>>,
}

impl Default for ParseCache {
    fn default() -> Self {
        Self { loaded: Recent::new(PARSES), render_scenes: Recent::new(POINTS) }
    }
}
