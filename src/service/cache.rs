//! Parsed instances kept in memory, so that a question does not wait for the database.

use crate::geometry::boxes::Aabb;
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

/// Scenes whose instances stay in memory: a few kilobytes an instance.
const CAPACITY: usize = 64;

/// The most recently used parses, latest last. Parses never change, so nothing is ever stale.
#[derive(Default)]
pub(super) struct ParseCache {
    entries: Mutex<Vec<(String, Arc<LoadedParse>)>>,
}

impl ParseCache {
    pub fn get(&self, parse_id: &str) -> Option<Arc<LoadedParse>> {
        let mut entries = self.entries.lock().unwrap_or_else(PoisonError::into_inner);
        let at = entries.iter().position(|(id, _)| id == parse_id)?;
        let entry = entries.remove(at);
        let parse = entry.1.clone();
        entries.push(entry);
        Some(parse)
    }

    pub fn put(&self, parse_id: &str, parse: Arc<LoadedParse>) {
        let mut entries = self.entries.lock().unwrap_or_else(PoisonError::into_inner);
        entries.retain(|(id, _)| id != parse_id);
        entries.push((parse_id.to_owned(), parse));
        if entries.len() > CAPACITY {
            entries.remove(0);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::{Point3, Vector3};

    #[test]
    fn the_least_recently_used_parse_leaves_first() {
        let cache = ParseCache::default();
        let extent = Aabb { center: Point3::origin(), size: Vector3::zeros() };
        let parse =
            || Arc::new(LoadedParse { instances: Vec::new(), extent, masks: String::new(), encoder: String::new(), embeddings: None });
        (0..CAPACITY).for_each(|i| cache.put(&i.to_string(), parse()));
        assert!(cache.get("0").is_some());
        cache.put("new", parse());
        assert!(cache.get("0").is_some() && cache.get("new").is_some() && cache.get("1").is_none());
    }
}
