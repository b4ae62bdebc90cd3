//! An in-memory LRU cache with a bounded total weight.

use std::sync::atomic::{AtomicU64, Ordering::Relaxed};
use std::sync::{Mutex, PoisonError};

/// Stores the most recently used values, as many as their weights allow, and always the latest one.
/// Stored values never change, so no entry can be stale.
pub struct LruCache<V> {
    /// Most recently used last: key, value, weight.
    entries: Mutex<Vec<(String, V, usize)>>,
    capacity: usize,
    hits: AtomicU64,
    misses: AtomicU64,
}

impl<V: Clone> LruCache<V> {
    /// Creates a cache for values whose weights add up to at most `capacity`.
    #[must_use]
    pub fn new(capacity: usize) -> Self {
        Self {
            entries: Mutex::default(),
            capacity,
            hits: AtomicU64::new(0),
            misses: AtomicU64::new(0),
        }
    }

    /// Returns the value of a key and marks it as most recently used.
    pub fn get(&self, key: &str) -> Option<V> {
        let mut entries = self.entries.lock().unwrap_or_else(PoisonError::into_inner);
        let at = entries.iter().position(|(known, ..)| known == key);
        if at.is_some() { &self.hits } else { &self.misses }.fetch_add(1, Relaxed);
        let at = at?;
        let entry = entries.remove(at);
        let value = entry.1.clone();
        entries.push(entry);
        Some(value)
    }

    /// Returns the numbers of cache hits and misses.
    pub fn hits_and_misses(&self) -> (u64, u64) {
        (self.hits.load(Relaxed), self.misses.load(Relaxed))
    }

    /// Removes a value.
    pub fn remove(&self, key: &str) {
        self.entries
            .lock()
            .unwrap_or_else(PoisonError::into_inner)
            .retain(|(known, ..)| known != key);
    }

    /// Stores a value and evicts the least recently used ones.
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_least_recently_used_value_is_evicted_first() {
        let cache = LruCache::new(64);
        (0..64).for_each(|i| cache.put(i.to_string(), i, 1));
        assert!(cache.get("0").is_some());
        cache.put("new".into(), 64, 1);
        assert!(cache.get("0").is_some() && cache.get("new").is_some() && cache.get("1").is_none());
        assert_eq!(cache.hits_and_misses(), (3, 1));
    }

    #[test]
    fn a_heavy_value_evicts_as_many_values_as_needed() {
        let cache = LruCache::new(10);
        (0..5).for_each(|i| cache.put(i.to_string(), i, 2));
        cache.put("heavy".into(), 9, 7);
        assert!(
            cache.get("heavy").is_some() && cache.get("4").is_some() && cache.get("3").is_none()
        );
        cache.put("too heavy".into(), 9, 11);
        assert!(
            cache.get("too heavy").is_some() && cache.get("heavy").is_none(),
            "the latest value is stored even above the capacity"
        );
        cache.put("heavy".into(), 1, 1);
        assert_eq!(cache.get("heavy"), Some(1));
    }
}
