//! Reads depth pictures: gray pictures (PNG, PGM, TIFF) of 16 bits, or of 8 bits with a unit large
//! enough to cover a room, and floats (EXR, TIFF; compressed with LZFSE: Record3D).

use super::float_pictures::{PixelValues, SingleChannelImage, read_grayscale};
use super::{DepthImage, FrameError, FrameRef};
use crate::MAX_COORDINATE_M;
use camino::Utf8Path;
use image::DynamicImage;
use std::fs::File;
use std::io::{self, BufReader, Read};

/// The first bytes of an LZFSE block.
const LZFSE_MAGIC: &[u8; 3] = b"bvx";

/// Minimum unit of 8-bit depth: its largest value is then one meter. With a smaller unit, the
/// picture is a visualization, stretched over the depth range of the scene.
pub const LEAST_UNIT_OF_BYTES_M: f32 = 0.004;

/// Returns whether a file is LZFSE. Such a file does not contain its size in pixels.
///
/// # Errors
/// Returns I/O errors.
pub fn is_compressed_floats(file: &Utf8Path) -> io::Result<bool> {
    let mut magic = [0; 3];
    Ok(File::open(file)?.read_exact(&mut magic).is_ok() && &magic == LZFSE_MAGIC)
}

/// Reads the picture as stored, meters; 0 where the file has no valid distance. `size` applies to
/// files that do not contain their size.
pub(super) fn read(frame: &FrameRef, size: (u32, u32)) -> Result<DepthImage, FrameError> {
    let SingleChannelImage { size: (width, height), numbers } = read_numeric_picture(frame, size)?;
    let scale_m = frame.depth_scale_m;
    // Sensors write the largest integer where they measured nothing, or too far (7-Scenes, 3RScan).
    let depth_m = match numbers {
        PixelValues::Floats(floats) => {
            floats.into_iter().map(|z| distance_m(z * scale_m)).collect()
        }
        PixelValues::Words(words) => words
            .into_iter()
            .map(|unit| if unit == u16::MAX { 0.0 } else { f32::from(unit) * scale_m })
            .collect(),
        PixelValues::Bytes(bytes) if scale_m >= LEAST_UNIT_OF_BYTES_M => bytes
            .into_iter()
            .map(|unit| if unit == u8::MAX { 0.0 } else { f32::from(unit) * scale_m })
            .collect(),
        PixelValues::Bytes(_) => {
            return Err(not_depth_error(frame, "8-bit gray with a smaller `depth_scale_m`".into()));
        }
    };
    Ok(DepthImage { width, height, depth_m })
}

/// Returns a distance in meters, or 0 for invalid ones. Renderers write huge numbers or infinity
/// for empty space.
fn distance_m(z: f32) -> f32 {
    if z > 0.0 && z <= MAX_COORDINATE_M { z } else { 0.0 }
}

fn read_numeric_picture(
    frame: &FrameRef,
    size: (u32, u32),
) -> Result<SingleChannelImage, FrameError> {
    let unreadable = |source| FrameError::Unreadable {
        frame: frame.index,
        file: super::frame::relative_name(&frame.depth),
        source,
    };
    if is_compressed_floats(&frame.depth).map_err(unreadable)? {
        let floats = read_floats(&frame.depth, size.0, size.1).map_err(unreadable)?;
        return Ok(SingleChannelImage { size, numbers: PixelValues::Floats(floats) });
    }
    if let Some(grey) = read_grayscale(&frame.depth).map_err(unreadable)? {
        return Ok(grey);
    }
    match frame.read_picture(&frame.depth)? {
        DynamicImage::ImageLuma16(image) => Ok(SingleChannelImage {
            size: image.dimensions(),
            numbers: PixelValues::Words(image.into_raw()),
        }),
        DynamicImage::ImageLuma8(image) => Ok(SingleChannelImage {
            size: image.dimensions(),
            numbers: PixelValues::Bytes(image.into_raw()),
        }),
        // Distances encoded as mixed colors are not supported.
        other => Err(not_depth_error(frame, format!("{:?}", other.color()))),
    }
}

fn not_depth_error(frame: &FrameRef, found: String) -> FrameError {
    FrameError::NotDepth {
        frame: frame.index,
        file: super::frame::relative_name(&frame.depth),
        found,
    }
}

/// Reads row-major floats. The file must unpack to exactly as many as the picture has pixels.
fn read_floats(file: &Utf8Path, width: u32, height: u32) -> io::Result<Vec<f32>> {
    let bytes = read_compressed(file, u64::from(width) * u64::from(height) * 4)?;
    Ok(bytes.as_chunks::<4>().0.iter().map(|b| f32::from_le_bytes(*b)).collect())
}

/// Reads an LZFSE file that must unpack to exactly `expected` bytes.
pub(super) fn read_compressed(file: &Utf8Path, expected: u64) -> io::Result<Vec<u8>> {
    let mut decoder = lzfse_rust::LzfseRingDecoder::default();
    let mut bytes = Vec::new();
    decoder.reader(BufReader::new(File::open(file)?)).take(expected + 1).read_to_end(&mut bytes)?;
    if bytes.len() as u64 == expected {
        return Ok(bytes);
    }
    let (found, more) =
        (bytes.len(), if bytes.len() as u64 > expected { "more than " } else { "" });
    Err(io::Error::new(
        io::ErrorKind::InvalidData,
        format!("it unpacks to {more}{found} bytes, but its picture needs {expected}"),
    ))
}
