//! A disk cache of encoded pictures for one parse: encoding takes a second, reading back hundredths
//! of a second.

use crate::model_clock::ModelClock;
use camino::Utf8Path;
use image::RgbImage;
use std::fs;
use std::io;
use std::path::PathBuf;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use tempfile::TempDir;
use uniground_geometry::scene::{FrameIndex, ModelNetwork};
use uniground_models::neural::{Encoded, LowMask, ModelError, Prompt, Segmenter};

/// The encoded frames of one scene. Each is encoded once, as long as the disk quota allows.
pub struct EncodedFrames {
    /// Computes masks. Called through the methods here, which record the time.
    segmenter: Arc<Segmenter>,
    /// Time spent in the segmenter.
    pub clock: ModelClock,
    folder: TempDir,
    bytes_left: AtomicU64,
}

impl EncodedFrames {
    /// Creates a cache of up to `max_bytes` in a new folder below `place`, or below the system's
    /// temporary folder. Dropping the value removes the folder.
    ///
    /// # Errors
    /// An I/O error when the folder cannot be created.
    pub fn new(
        segmenter: Arc<Segmenter>,
        place: Option<&Utf8Path>,
        max_bytes: u64,
    ) -> io::Result<Self> {
        let folder = place.map_or_else(tempfile::tempdir, tempfile::tempdir_in)?;
        Ok(Self {
            segmenter,
            clock: ModelClock::default(),
            folder,
            bytes_left: AtomicU64::new(max_bytes),
        })
    }

    /// Returns the encoding of a frame's picture for the decoder.
    ///
    /// # Errors
    /// [`ModelError`] when the picture cannot be encoded. A full disk only costs time.
    pub fn encode(&self, frame: FrameIndex, picture: &RgbImage) -> Result<Encoded, ModelError> {
        let file = self.file(frame);
        if let Ok(bytes) = fs::read(&file)
            && let Ok(encoded) = postcard::from_bytes(&bytes)
        {
            return Ok(encoded);
        }
        let encoded = self.encode_uncached(picture)?;
        self.store(&file, &encoded);
        Ok(encoded)
    }

    /// Encodes a picture that is not a whole frame.
    ///
    /// # Errors
    /// [`ModelError`] when the picture cannot be encoded.
    pub fn encode_uncached(&self, picture: &RgbImage) -> Result<Encoded, ModelError> {
        self.clock.time(ModelNetwork::MaskEncoder, 1, || self.segmenter.encode(picture))
    }

    /// Returns the candidate masks of each prompt, as [`Segmenter::decode`] does.
    ///
    /// # Errors
    /// [`ModelError`]: a failed call.
    pub fn decode(
        &self,
        encoded: &Encoded,
        prompts: &[Prompt],
    ) -> Result<Vec<Vec<LowMask>>, ModelError> {
        let decode = || self.segmenter.decode(encoded, prompts);
        self.clock.time(ModelNetwork::MaskDecoder, prompts.len(), decode)
    }

    /// Returns the segmenter, for the properties of its masks.
    #[must_use]
    pub fn segmenter(&self) -> &Segmenter {
        &self.segmenter
    }

    /// Removes a frame from the cache once it is not needed again.
    pub fn remove(&self, frame: FrameIndex) {
        let file = self.file(frame);
        if let Ok(metadata) = file.metadata()
            && fs::remove_file(&file).is_ok()
        {
            self.bytes_left.fetch_add(metadata.len(), Ordering::Relaxed);
        }
    }

    fn file(&self, frame: FrameIndex) -> PathBuf {
        self.folder.path().join(frame.to_string())
    }

    fn store(&self, file: &std::path::Path, encoded: &Encoded) {
        if self.bytes_left.load(Ordering::Relaxed) == 0 {
            return;
        }
        let Ok(bytes) = postcard::to_allocvec(encoded) else { return };
        let size = bytes.len() as u64;
        let reserved = self
            .bytes_left
            .try_update(Ordering::Relaxed, Ordering::Relaxed, |left| left.checked_sub(size));
        if reserved.is_ok() && fs::write(file, bytes).is_err() {
            // A partially written file is useless.
            let _gone = fs::remove_file(file);
            self.bytes_left.fetch_add(size, Ordering::Relaxed);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use uniground_testing::tiny_segmenter;

    #[test]
    fn encodings_are_cached_until_removed_within_the_disk_quota() {
        let picture = |v: u8| RgbImage::from_pixel(40, 30, image::Rgb([v, 80, 90]));
        let frames = EncodedFrames::new(tiny_segmenter("tiny-segmenter"), None, 1 << 20).unwrap();
        let first = frames.encode(FrameIndex(1), &picture(10)).unwrap();
        // Another picture under the same index: the cached encoding comes back.
        assert_eq!(frames.encode(FrameIndex(1), &picture(200)).unwrap(), first);
        frames.remove(FrameIndex(1));
        assert_ne!(frames.encode(FrameIndex(1), &picture(200)).unwrap(), first);
        let full = EncodedFrames::new(tiny_segmenter("tiny-segmenter"), None, 100).unwrap();
        full.encode(FrameIndex(1), &picture(10)).unwrap();
        assert_ne!(
            full.encode(FrameIndex(1), &picture(200)).unwrap(),
            first,
            "nothing fits into the cache"
        );
    }
}
