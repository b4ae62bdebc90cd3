//! Textures of meshes.

use image::{ImageReader, Limits, RgbImage};
use std::io::Cursor;

/// Maximum memory for decoding a texture, bytes: 64 megapixels.
const MAX_BYTES: u64 = 256 << 20;

#[derive(Debug)]
pub(super) struct Texture(RgbImage);

impl Texture {
    /// Decodes a JPEG or PNG.
    pub fn decode(bytes: &[u8]) -> Result<Self, String> {
        let mut reader = ImageReader::new(Cursor::new(bytes))
            .with_guessed_format()
            .map_err(|e| e.to_string())?;
        let mut limits = Limits::default();
        limits.max_alloc = Some(MAX_BYTES);
        reader.limits(limits);
        let picture = reader.decode().map_err(|e| e.to_string())?.into_rgb8();
        if picture.width() == 0 || picture.height() == 0 {
            Err("it has no pixels".into())
        } else {
            Ok(Self(picture))
        }
    }

    /// Returns the pixel at a position, repeated outside `0..1`.
    pub fn interpolate(&self, u: f32, v: f32) -> [u8; 3] {
        let pixel = |at: f32, size: u32| {
            let at = at - at.floor();
            let at = if at.is_finite() { at } else { 0.0 };
            ((at * size as f32) as u32).min(size - 1)
        };
        self.0.get_pixel(pixel(u, self.0.width()), pixel(v, self.0.height())).0
    }
}
