//! Keeps parses in memory, so that questions need neither the database nor a decoder.

use bytes::Bytes;
use camino::Utf8PathBuf;
use jiff::Timestamp;
use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::SystemTime;
use uniground_geometry::boxes::Aabb;
use uniground_geometry::lru_cache::LruCache;
use uniground_geometry::scene::{Embeddings, FrameEmbeddings, Instance, InstanceId, SourceToScene};
use uniground_grounding::NameIndex;
use uniground_grounding::approach::Occupancy;
use uniground_parsing::observation::Observation;
use uniground_render::RenderScene;
use uniground_storage::Scratch;

/// A parse in the form that stage 2 needs.
#[derive(Clone)]
pub struct LoadedParse {
    pub id: String,
    /// The folder of the unpacked scan.
    pub content: Utf8PathBuf,
    /// The instances with the names of the index and with corrections applied.
    pub instances: Vec<Instance>,
    pub names: NameIndex,
    /// The names that people have given, by instance id.
    pub renamed: BTreeMap<u32, String>,
    /// Name and version of the model that named all instances. `None` if no model did.
    pub named_by: Option<String>,
    pub extent: Aabb,
    /// The transform from the coordinates of the uploaded files. `None` in parses of versions that
    /// did not store it.
    pub source_to_scene: Option<SourceToScene>,
    /// Name and version of the models that made the parse.
    pub masks: String,
    pub encoder: String,
    pub embeddings: Option<Embeddings>,
    /// The encoder's embeddings of whole frames.
    pub frame_embeddings: Option<FrameEmbeddings>,
    /// What the frames saw. Empty for parses of versions that did not store it.
    pub observation: Observation,
}

impl LoadedParse {
    /// Returns the time of the newest frame that shows an instance, RFC 3339 UTC. `None` if frames
    /// have no times.
    pub fn last_seen(&self, id: InstanceId) -> Option<String> {
        let seconds = self.observation.last_seen_s.get(&id.0)?;
        let time = Timestamp::from_millisecond((seconds * 1e3).round() as i64).ok()?;
        Some(time.to_string())
    }
}

/// The number of scenes whose instances stay in memory. An instance takes a few kilobytes.
const PARSES: usize = 64;
/// The number of points of clouds that stay in memory, 17 bytes each.
const POINTS: usize = 8_000_000;
/// The bytes of columns that stay in memory for standing poses: 16 bytes per floor cell and 8 per
/// occupied voxel.
const OCCUPANCY_BYTES: usize = 128 << 20;
/// The number of folders with computed points that are cached. They were computed since the
/// start, and each is as large as the scene's cloud.
const MAX_CACHED_POINTS: usize = 16;
/// The bytes of drawn pictures of instances that stay in memory.
const DRAWN_BYTES: usize = 64 << 20;
/// The number of files whose verified state is remembered.
const FILES: usize = 4096;

/// Caches the data of parses in memory, by parse id.
pub struct ParseCache {
    /// Each parse with its number of changes when it was loaded.
    loaded: LruCache<(i64, Arc<LoadedParse>)>,
    pub render_scenes: LruCache<Arc<RenderScene>>,
    /// The occupied space of rooms. Corrections do not change it, because it depends only on the
    /// points as stage 1 divided them.
    pub occupancies: LruCache<Arc<Occupancy>>,
    /// Verified files by path, with their size and modification time at that moment.
    pub sound: LruCache<(u64, SystemTime)>,
    /// Points computed for parses of versions that did not store them.
    pub points: LruCache<Arc<Scratch>>,
    /// Pictures of instances, by the path of the file that a parse could have stored.
    pub drawn: LruCache<Bytes>,
}

impl Default for ParseCache {
    fn default() -> Self {
        Self {
            loaded: LruCache::new(PARSES),
            render_scenes: LruCache::new(POINTS),
            occupancies: LruCache::new(OCCUPANCY_BYTES),
            sound: LruCache::new(FILES),
            points: LruCache::new(MAX_CACHED_POINTS),
            drawn: LruCache::new(DRAWN_BYTES),
        }
    }
}

impl ParseCache {
    /// Returns a parse, unless it has changed since it was loaded.
    pub fn get(&self, id: &str, changes: i64) -> Option<Arc<LoadedParse>> {
        self.loaded.get(id).filter(|(of, _)| *of == changes).map(|(_, parse)| parse)
    }

    /// Caches a parse that was loaded after this number of changes.
    pub fn insert(&self, parse: &Arc<LoadedParse>, changes: i64) {
        self.loaded.put(parse.id.clone(), (changes, parse.clone()), 1);
    }

    /// Removes a deleted parse.
    pub fn forget(&self, id: &str) {
        self.loaded.remove(id);
    }

    /// Returns the number of cache hits and of cache misses.
    pub fn hits_and_misses(&self) -> (u64, u64) {
        self.loaded.hits_and_misses()
    }
}
