//! Decoded depth pictures shared by the stages of a parse.

use super::{DepthImage, FrameError, FrameIndex, FrameRef};
use std::collections::BTreeMap;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

/// Keeps decoded depth pictures in memory, so that several stages can read them.
///
/// Every stage reads all frames in the same order. A cache that replaces the oldest picture would
/// therefore never contain the next one. This one keeps the first pictures that fit. The others are
/// decoded each time.
#[derive(Debug)]
pub struct DepthCache {
    max_bytes: usize,
    kept: Mutex<KeptPictures>,
}

#[derive(Debug, Default)]
struct KeptPictures {
    bytes: usize,
    by_frame: BTreeMap<FrameIndex, Arc<DepthImage>>,
}

impl DepthCache {
    /// Creates a cache of at most `max_bytes` of pictures; 4 bytes per pixel.
    #[must_use]
    pub fn new(max_bytes: usize) -> Self {
        Self { max_bytes, kept: Mutex::default() }
    }

    /// Returns the depth picture of a frame, see [`FrameRef::decode_depth`]. All frames of a cache
    /// must belong to one scan.
    ///
    /// # Errors
    /// Returns a [`FrameError`] that names the frame and the file.
    pub fn depth(&self, frame: &FrameRef) -> Result<Arc<DepthImage>, FrameError> {
        if let Some(depth) = self.kept().by_frame.get(&frame.index) {
            return Ok(depth.clone());
        }
        let depth = Arc::new(frame.decode_depth()?);
        let bytes = size_of_val(depth.depth_m.as_slice());
        let mut kept = self.kept();
        if kept.bytes + bytes <= self.max_bytes
            && kept.by_frame.insert(frame.index, depth.clone()).is_none()
        {
            kept.bytes += bytes;
        }
        Ok(depth)
    }

    fn kept(&self) -> MutexGuard<'_, KeptPictures> {
        self.kept.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

#[cfg(test)]
mod tests {
    use super::super::{Intrinsics, Optics};
    use super::*;
    use crate::Isometry3;
    use camino::Utf8Path;
    use image::{ImageBuffer, Luma};

    /// Creates a frame with a depth picture of 2x2 pixels, each `unit` millimeters.
    fn frame(folder: &Utf8Path, index: u32, unit: u16) -> FrameRef {
        let depth = folder.join(format!("{index}.png"));
        ImageBuffer::from_pixel(2, 2, Luma([unit])).save(&depth).unwrap();
        let camera = Intrinsics { width: 2, height: 2, fx: 1.0, fy: 1.0, cx: 1.0, cy: 1.0 };
        FrameRef {
            index: FrameIndex(index),
            color: folder.join("none.jpg"),
            depth,
            color_intrinsics: camera,
            depth_intrinsics: camera,
            depth_scale_m: 0.001,
            camera_to_world: Isometry3::identity(),
            optics: Optics::default(),
        }
    }

    #[test]
    fn pictures_that_fit_are_decoded_once_and_the_others_each_time() {
        let folder = tempfile::tempdir().unwrap();
        let folder = Utf8Path::from_path(folder.path()).unwrap();
        let frames: Vec<_> = (0..3).map(|i| frame(folder, i, 1000 + i as u16)).collect();
        // A picture takes 16 bytes: two fit.
        let cache = DepthCache::new(47);
        let first: Vec<_> = frames.iter().map(|f| cache.depth(f).unwrap()).collect();
        for (i, depth) in (0_u16..).zip(&first) {
            assert_eq!(depth.depth_m, vec![f32::from(1000 + i) * 0.001; 4]);
        }
        let again: Vec<_> = frames.iter().map(|f| cache.depth(f).unwrap()).collect();
        let is_shared: Vec<_> = first.iter().zip(&again).map(|(a, b)| Arc::ptr_eq(a, b)).collect();
        assert_eq!(is_shared, [true, true, false]);
        assert_eq!(first, again);
    }

    #[test]
    fn read_errors_are_not_cached() {
        let folder = tempfile::tempdir().unwrap();
        let folder = Utf8Path::from_path(folder.path()).unwrap();
        let mut frame = frame(folder, 7, 1);
        let sound = frame.depth.clone();
        frame.depth = folder.join("missing.png");
        let cache = DepthCache::new(1 << 20);
        assert!(cache.depth(&frame).unwrap_err().to_string().starts_with("frame 7: "));
        assert!(cache.depth(&frame).is_err());
        frame.depth = sound;
        assert_eq!(cache.depth(&frame).unwrap().width, 2);
    }
}
