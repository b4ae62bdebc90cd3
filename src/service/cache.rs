//! What stays in memory, so that a question does not wait for the database, a decoder or the renderer.

use crate::geometry::boxes::Aabb;
use crate::models::chat::Picture;
use crate::render::Scenery;
use crate::scene::{Embeddings, Instance};
use std::sync::{Arc, Mutex, PoisonError};

/// A parse as stage 2 needs it.
pub(super) struct LoadedParse {
    pub instances: Vec<Instance>,
    pub extent: Aabb,
    pub masks: String,
    pub encoder: String,
    pub embeddings: Option<Embeddings>,
}

/// The most recently used values, as many as their weights allow, and always the latest; latest last. What is kept never changes, so nothing is ever stale.
pub(super) struct Recent<V> {
    entries: Mutex<Vec<(String, V, usize)>>,
    capacity: usize,
}

impl<V: Clone> Recent<V> {
    pub fn new(capacity: usize) -> Self {
        Self { entries: Mutex::default(), capacity }
    }

    pub fn get(&self, key: &str) -> Option<V> {
        let mut entries = self.entries.lock().unwrap_or_else(PoisonError::into_inner);
        let at = entries.iter().position(|(known, ..)| known == key)?;
        let entry = entries.remove(at);
        let value = entry.1.clone();
        entries.push(entry);
        Some(value)
    }

    pub fn put(&self, key: String, value: V, weight: usize) {
        let mut entries = self.entries.lock().unwrap_or_else(PoisonError::into_inner);
        entries.retain(|(known, ..)| *known != key);
        entries.push((key, value, weight));
        let mut total: usize = entries.iter().map(|(_, _, weight)| weight).sum();
        let mut leaving = 0;
        while total > self.capacity && leaving + 1 < entries.len() {
            total -= entries[leaving].2;
            leaving += 1;
        }
        entries.drain(..leaving);
    }
}

/// Scenes whose instances stay in memory: a few kilobytes an instance.
const PARSES: usize = 64;
/// Points of clouds that stay in memory, 15 bytes each.
const POINTS: usize = 8_000_000;
/// Bytes of pictures that stay in memory, of each kind.
const PICTURE_BYTES: usize = 64 << 20;

/// Everything that stays in memory.
pub(super) struct Caches {
    pub parses: Recent<Arc<LoadedParse>>,
    /// By parse.
    pub sceneries: Recent<Arc<Scenery>>,
    /// By parse and what is drawn.
    pub globals: Recent<Picture>,
    /// By parse and instance.
    pub collages: Recent<Picture>,
}

impl Default for Caches {
    fn default() -> Self {
        Self {
            parses: Recent::new(PARSES),
            sceneries: Recent::new(POINTS),
            globals: Recent::new(PICTURE_BYTES),
            collages: Recent::new(PICTURE_BYTES),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_least_recently_used_leaves_first() {
        let cache = Recent::new(64);
        (0..64).for_each(|i| cache.put(i.to_string(), i, 1));
        assert!(cache.get("0").is_some());
        cache.put("new".into(), 64, 1);
        assert!(cache.get("0").is_some() && cache.get("new").is_some() && cache.get("1").is_none());
    }

    #[test]
    fn heavy_values_push_out_many() {
        let cache = Recent::new(10);
        (0..5).for_each(|i| cache.put(i.to_string(), i, 2));
        cache.put("heavy".into(), 9, 7);
        assert!(cache.get("heavy").is_some() && cache.get("4").is_some() && cache.get("3").is_none());
        cache.put("too heavy".into(), 9, 11);
        assert!(cache.get("too heavy").is_some() && cache.get("heavy").is_none(), "the latest stays, alone");
        cache.put("heavy".into(), 1, 1);
        assert_eq!(cache.get("heavy"), Some(1));
    }
}
