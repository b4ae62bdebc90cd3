//! Depth pictures as files: 16-bit grey pictures (PNG, PGM), and 32-bit floats compressed with LZFSE (Record3D).

use super::{DepthImage, FrameError, FrameRef};
use camino::Utf8Path;
use image::DynamicImage;
use std::fs::File;
use std::io::{self, BufReader, Read};

/// What a block of LZFSE begins with.
const LZFSE_MAGIC: &[u8; 3] = b"bvx";

/// Sensors write this where they measured nothing, or too far (7-Scenes, 3RScan).
const SATURATED: u16 = u16::MAX;

/// Whether a file is LZFSE: its size in pixels stands elsewhere.
///
/// # Errors
/// Those of the file system.
pub fn is_compressed_floats(file: &Utf8Path) -> io::Result<bool> {
    let mut magic = [0; 3];
    Ok(File::open(file)?.read_exact(&mut magic).is_ok() && &magic == LZFSE_MAGIC)
}

/// The picture as the file holds it, metres; 0 where the file holds nothing that is a distance.
pub(super) fn read(frame: &FrameRef, (width, height): (u32, u32)) -> Result<DepthImage, FrameError> {
    let unreadable = |source| FrameError::Unreadable { frame: frame.index, file: super::frame::in_scene(&frame.depth), source };
    if is_compressed_floats(&frame.depth).map_err(unreadable)? {
        let mut depth = DepthImage { width, height, depth_m: read_floats(&frame.depth, width, height).map_err(unreadable)? };
        for z in &mut depth.depth_m {
            *z = if z.is_finite() && *z > 0.0 { *z * frame.depth_scale_m } else { 0.0 };
        }
        return Ok(depth);
    }
    let image = match frame.read_picture(&frame.depth)? {
        DynamicImage::ImageLuma16(image) => image,
        // Eight bits would be stretched, colours mixed: neither is a depth.
        other => {
            let (file, found) = (super::frame::in_scene(&frame.depth), format!("{:?}", other.color()));
            return Err(FrameError::NotDepth { frame: frame.index, file, found });
        }
    };
    let (width, height) = image.dimensions();
    let depth_m = image
        .into_raw()
        .into_iter()
        .map(|unit| if unit == SATURATED { 0.0 } else { f32::from(unit) * frame.depth_scale_m })
        .collect();
    Ok(DepthImage { width, height, depth_m })
}

/// Row-major floats; exactly as many as the picture has pixels, whatever the file unpacks to.
fn read_floats(file: &Utf8Path, width: u32, height: u32) -> io::Result<Vec<f32>> {
    let bytes = read_compressed(file, u64::from(width) * u64::from(height) * 4)?;
    Ok(bytes.as_chunks::<4>().0.iter().map(|b| f32::from_le_bytes(*b)).collect())
}

/// A file of LZFSE that holds so many bytes and no other number of them.
pub(super) fn read_compressed(file: &Utf8Path, expected: u64) -> io::Result<Vec<u8>> {
    let mut decoder = lzfse_rust::LzfseRingDecoder::default();
    let mut bytes = Vec::new();
    decoder.reader(BufReader::new(File::open(file)?)).take(expected + 1).read_to_end(&mut bytes)?;
    if bytes.len() as u64 == expected {
        return Ok(bytes);
    }
    let (found, more) = (bytes.len(), if bytes.len() as u64 > expected { "more than " } else { "" });
    Err(io::Error::new(
        io::ErrorKind::InvalidData,
        format!("it unpacks to {more}{found} bytes, its picture has {expected}"),
    ))
}
