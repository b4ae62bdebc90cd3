//! Pictures that stay in memory, so that a question does not wait for the renderer.

use uniground_geometry::lru_cache::LruCache;
use uniground_models::chat::Picture;

/// Pictures drawn before, shared by all questions about all scenes.
pub struct PictureCache {
    /// By scene and what is drawn.
    pub(super) globals: LruCache<Picture>,
    /// By scene and instance.
    pub(super) collages: LruCache<Picture>,
}

/// Bytes of pictures that stay in memory, of each kind.
const PICTURE_BYTES: usize = 64 << 20;

impl PictureCache {
    /// How often a picture was found, and how often not.
    #[must_use]
    pub fn looks(&self) -> (u64, u64) {
        let ((hits, misses), (more_hits, more_misses)) =
            (self.globals.looks(), self.collages.looks());
        (hits + more_hits, misses + more_misses)
    }
}

impl Default for PictureCache {
    fn default() -> Self {
        Self { globals: LruCache::new(PICTURE_BYTES), collages: LruCache::new(PICTURE_BYTES) }
    }
}
