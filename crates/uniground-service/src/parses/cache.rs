//! Parses that stay in memory, so that a question does not wait for the database or a decoder.

use bytes::Bytes;
use camino::Utf8PathBuf;
use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::SystemTime;
use uniground_geometry::boxes::Aabb;
use uniground_geometry::lru_cache::LruCache;
use uniground_geometry::scene::{Embeddings, FrameEmbeddings, Instance, SourceToScene};
use uniground_grounding::NameIndex;
use uniground_grounding::approach::Occupancy;
use uniground_render::RenderScene;
use uniground_storage::Scratch;

/// A parse as stage 2 needs it.
#[derive(Clone)]
pub struct LoadedParse {
    pub id: String,
    /// The unpacked scan.
    pub content: Utf8PathBuf,
    /// With the names of the index, and as people have corrected them.
    pub instances: Vec<Instance>,
    pub names: NameIndex,
    /// What somebody has said instances are called, by id.
    pub renamed: BTreeMap<u32, String>,
    /// Name and version of the model that named everything; `None` where none did.
    pub named_by: Option<String>,
    pub extent: Aabb,
    /// From the coordinates of the files that were uploaded; `None` in parses from before it was
    /// kept.
    pub source_to_scene: Option<SourceToScene>,
    /// Name and version of what the parse was made with.
    pub masks: String,
    pub encoder: String,
    pub embeddings: Option<Embeddings>,
    /// What that encoder has seen of frames as a whole.
    pub frame_embeddings: Option<FrameEmbeddings>,
}

/// Scenes whose instances stay in memory: a few kilobytes an instance.
const PARSES: usize = 64;
/// Points of clouds that stay in memory, 17 bytes each.
const POINTS: usize = 8_000_000;
/// Bytes of columns that stay in memory, for places to stand: 16 a cell of the floor and 8 an
/// occupied voxel.
const OCCUPANCY_BYTES: usize = 128 << 20;
/// Folders with points that were made since the start; each is as large as the scene's cloud.
const MADE: usize = 16;
/// Bytes of drawn pictures of instances that stay in memory.
const DRAWN_BYTES: usize = 64 << 20;
/// Files whose state is remembered.
const FILES: usize = 4096;

/// What is known of parses without looking at the disk, by their ids.
pub struct ParseCache {
    /// Each with how often what is known of it had changed by then.
    loaded: LruCache<(i64, Arc<LoadedParse>)>,
    pub render_scenes: LruCache<Arc<RenderScene>>,
    /// What of the room is occupied. Corrections change nothing of it: it is of the points as they
    /// were cut.
    pub occupancies: LruCache<Arc<Occupancy>>,
    /// Files that were found to be what was written, by path: their size and time then.
    pub sound: LruCache<(u64, SystemTime)>,
    /// Points of parses from before they were kept.
    pub points: LruCache<Arc<Scratch>>,
    /// Pictures of instances, by the file a parse could have kept.
    pub drawn: LruCache<Bytes>,
}

impl Default for ParseCache {
    fn default() -> Self {
        Self {
            loaded: LruCache::new(PARSES),
            render_scenes: LruCache::new(POINTS),
            occupancies: LruCache::new(OCCUPANCY_BYTES),
            sound: LruCache::new(FILES),
            points: LruCache::new(MADE),
            drawn: LruCache::new(DRAWN_BYTES),
        }
    }
}

impl ParseCache {
    /// A parse, unless what is known of it has changed since it was loaded.
    pub fn loaded(&self, id: &str, changes: i64) -> Option<Arc<LoadedParse>> {
        self.loaded.get(id).filter(|(of, _)| *of == changes).map(|(_, parse)| parse)
    }

    /// Keeps a parse that was loaded after so many changes.
    pub fn keep(&self, parse: &Arc<LoadedParse>, changes: i64) {
        self.loaded.put(parse.id.clone(), (changes, parse.clone()), 1);
    }

    /// Forgets a parse that is gone.
    pub fn forget(&self, id: &str) {
        self.loaded.remove(id);
    }

    /// How often parses were found in memory, and how often not.
    pub fn looks(&self) -> (u64, u64) {
        self.loaded.looks()
    }
}
