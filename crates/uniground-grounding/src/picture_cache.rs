//! Caches rendered pictures in memory, so that a question does not wait for the renderer.

use crate::vlm::Photograph;
use image::RgbImage;
use std::sync::Arc;
use uniground_geometry::lru_cache::LruCache;
use uniground_models::chat::Picture;
use uniground_render::FrameContents;

/// Rendered pictures, shared by all questions about all scenes.
pub struct PictureCache {
    /// By scene and subjects.
    pub(super) globals: LruCache<Picture>,
    /// By scene and instance.
    pub(super) collages: LruCache<Picture>,
    /// Photographs whose things are numbered, by scene, frame and things.
    pub(super) marked: LruCache<Photograph>,
    /// The same photographs with nothing drawn in, by scene and frame.
    pub(super) plain: LruCache<Arc<PlainPhotograph>>,
    /// What the frames of a scene show.
    pub(super) contents: LruCache<Arc<FrameContents>>,
}

/// A decoded photograph.
pub(super) struct PlainPhotograph {
    /// Width and height of the frame's picture, pixels.
    pub taken_px: (u32, u32),
    /// The same picture, or a smaller copy.
    pub picture: RgbImage,
}

/// Maximum size of each kind of pictures in memory, bytes.
const PICTURE_BYTES: usize = 64 << 20;
/// Maximum size of what frames show in memory, bytes.
const CONTENT_BYTES: usize = 16 << 20;

impl PictureCache {
    /// Returns the number of cache hits and of cache misses.
    #[must_use]
    pub fn hits_and_misses(&self) -> (u64, u64) {
        [&self.globals, &self.collages]
            .map(LruCache::hits_and_misses)
            .into_iter()
            .chain([self.marked.hits_and_misses()])
            .fold((0, 0), |(hits, misses), (more, missed)| (hits + more, misses + missed))
    }
}

impl Default for PictureCache {
    fn default() -> Self {
        Self {
            globals: LruCache::new(PICTURE_BYTES),
            collages: LruCache::new(PICTURE_BYTES),
            marked: LruCache::new(PICTURE_BYTES),
            plain: LruCache::new(PICTURE_BYTES),
            contents: LruCache::new(CONTENT_BYTES),
        }
    }
}
