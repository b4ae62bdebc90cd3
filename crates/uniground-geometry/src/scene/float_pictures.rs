//! Depth pictures with measured values: `OpenEXR`, and TIFF of one channel. Sizes are checked
//! before memory is allocated.

use camino::Utf8Path;
use exr::block::reader::Reader;
use exr::image::FlatSamples;
use exr::meta::header::Header;
use exr::prelude::{MetaData, ReadChannels, ReadLayers, read};
use std::fs::File;
use std::io::{self, BufReader, Read};
use tiff::decoder::{Decoder, DecodingResult, Limits};
use tiff::tags::Tag;

const EXR_MAGIC: &[u8; 4] = b"\x76\x2f\x31\x01";
const TIFF_MAGICS: [&[u8; 4]; 4] = [b"II\x2a\0", b"MM\0\x2a", b"II\x2b\0", b"MM\0\x2b"];
/// Names of the distance channel of an EXR, best first. A file with three equal color channels uses
/// red.
const CHANNELS: [&str; 5] = ["z", "depth", "y", "v", "r"];
/// Maximum memory for a picture's own numbers.
const MAX_BYTES: u64 = 256 << 20;
/// `SampleFormat` of IEEE floats.
const IEEE_FLOATS: u16 = 3;

/// Values of a picture, row-major.
pub(super) enum PixelValues {
    Floats(Vec<f32>),
    Words(Vec<u16>),
    Bytes(Vec<u8>),
}

/// A picture of one channel.
pub(super) struct SingleChannelImage {
    pub size: (u32, u32),
    pub numbers: PixelValues,
}

#[derive(Clone, Copy, PartialEq)]
enum FloatImageFormat {
    Exr,
    Tiff,
}

/// Returns width and height of an EXR or TIFF, or `None` if the file is neither.
///
/// # Errors
/// Returns I/O errors, or an error for a header that cannot be read.
pub fn float_picture_size(file: &Utf8Path) -> io::Result<Option<(u32, u32)>> {
    Ok(match detect_format(file)? {
        None => None,
        Some(FloatImageFormat::Exr) => Some(exr_size(
            &MetaData::read_from_buffered(open_buffered(file)?, false)
                .map_err(damaged_error)?
                .headers,
        )?),
        Some(FloatImageFormat::Tiff) => Some(open_tiff(file)?.dimensions().map_err(damaged_error)?),
    })
}

/// Returns whether a file is an EXR, or a TIFF of floats. By convention, floats are meters and
/// integers are millimeters.
///
/// # Errors
/// Returns I/O errors, or an error for a header that cannot be read.
pub fn is_float_picture(file: &Utf8Path) -> io::Result<bool> {
    Ok(match detect_format(file)? {
        None => false,
        Some(FloatImageFormat::Exr) => true,
        Some(FloatImageFormat::Tiff) => {
            let formats = open_tiff(file)?
                .find_tag_unsigned_vec::<u16>(Tag::SampleFormat)
                .map_err(damaged_error)?;
            formats.is_some_and(|formats| formats.first() == Some(&IEEE_FLOATS))
        }
    })
}

/// Reads the picture. Returns `None` if the file is neither EXR nor TIFF.
pub(super) fn read_grayscale(file: &Utf8Path) -> io::Result<Option<SingleChannelImage>> {
    detect_format(file)?
        .map(|kind| if kind == FloatImageFormat::Exr { read_exr(file) } else { read_tiff(file) })
        .transpose()
}

fn detect_format(file: &Utf8Path) -> io::Result<Option<FloatImageFormat>> {
    let mut magic = [0; 4];
    if File::open(file)?.read_exact(&mut magic).is_err() {
        return Ok(None);
    }
    Ok(match &magic {
        EXR_MAGIC => Some(FloatImageFormat::Exr),
        magic if TIFF_MAGICS.contains(&magic) => Some(FloatImageFormat::Tiff),
        _ => None,
    })
}

fn open_buffered(file: &Utf8Path) -> io::Result<BufReader<File>> {
    File::open(file).map(BufReader::new)
}

fn damaged_error(reason: impl Into<Box<dyn std::error::Error + Send + Sync>>) -> io::Error {
    io::Error::new(io::ErrorKind::InvalidData, reason)
}

fn exr_size(headers: &[Header]) -> io::Result<(u32, u32)> {
    let first = headers
        .iter()
        .find(|header| !header.deep)
        .ok_or_else(|| damaged_error("all its layers are deep: flatten the image"))?;
    let side = |pixels: usize| u32::try_from(pixels).map_err(damaged_error);
    Ok((side(first.layer_size.width())?, side(first.layer_size.height())?))
}

fn read_exr(file: &Utf8Path) -> io::Result<SingleChannelImage> {
    let reader = Reader::read_from_buffered(open_buffered(file)?, false).map_err(damaged_error)?;
    let bytes = |header: &Header| {
        let pixels = header.layer_size.width() as u64 * header.layer_size.height() as u64;
        pixels.saturating_mul(header.channels.bytes_per_pixel as u64)
    };
    let bytes = reader.headers().iter().map(bytes).fold(0, u64::saturating_add);
    if bytes > MAX_BYTES {
        return Err(damaged_error(format!(
            "it declares {bytes} bytes of pixels; the limit is {MAX_BYTES}"
        )));
    }
    let size = exr_size(reader.headers())?;
    let image = read()
        .no_deep_data()
        .largest_resolution_level()
        .all_channels()
        .first_valid_layer()
        .all_attributes()
        .non_parallel();
    let mut channels =
        image.from_chunks(reader).map_err(damaged_error)?.layer_data.channel_data.list;
    // "scene.Z" is the Z channel of a layer.
    let name = |at: usize| {
        channels[at].name.to_string().rsplit('.').next().unwrap_or_default().to_ascii_lowercase()
    };
    let found =
        CHANNELS.iter().find_map(|wanted| (0..channels.len()).find(|at| name(*at) == *wanted));
    let Some(at) = found.or((channels.len() == 1).then_some(0)) else {
        return Err(damaged_error("none of its channels is called Z, depth, Y, V or R"));
    };
    let floats = match channels.swap_remove(at).sample_data {
        FlatSamples::F32(floats) => floats,
        FlatSamples::F16(halves) => halves.into_iter().map(half::f16::to_f32).collect(),
        FlatSamples::U32(units) => units.into_iter().map(|unit| unit as f32).collect(),
    };
    check_pixel_count(size, floats.len())?;
    Ok(SingleChannelImage { size, numbers: PixelValues::Floats(floats) })
}

fn open_tiff(file: &Utf8Path) -> io::Result<Decoder<BufReader<File>>> {
    let mut limits = Limits::default();
    limits.decoding_buffer_size = MAX_BYTES as usize;
    limits.intermediate_buffer_size = MAX_BYTES as usize;
    Ok(Decoder::new(open_buffered(file)?).map_err(damaged_error)?.with_limits(limits))
}

fn read_tiff(file: &Utf8Path) -> io::Result<SingleChannelImage> {
    let mut tiff = open_tiff(file)?;
    let (size, colors) =
        (tiff.dimensions().map_err(damaged_error)?, tiff.colortype().map_err(damaged_error)?);
    let not_depth = || {
        damaged_error(format!(
            "not a depth picture: it must be gray with floats or 16 bits; this is {colors:?}"
        ))
    };
    if !matches!(colors, tiff::ColorType::Gray(_)) {
        return Err(not_depth());
    }
    let (count, numbers) = match tiff.read_image().map_err(damaged_error)? {
        DecodingResult::F32(floats) => (floats.len(), PixelValues::Floats(floats)),
        DecodingResult::F64(floats) => {
            (floats.len(), PixelValues::Floats(floats.into_iter().map(|z| z as f32).collect()))
        }
        DecodingResult::F16(halves) => {
            (halves.len(), PixelValues::Floats(halves.into_iter().map(half::f16::to_f32).collect()))
        }
        DecodingResult::U16(words) => (words.len(), PixelValues::Words(words)),
        DecodingResult::U8(bytes) => (bytes.len(), PixelValues::Bytes(bytes)),
        _ => return Err(not_depth()),
    };
    check_pixel_count(size, count)?;
    Ok(SingleChannelImage { size, numbers })
}

fn check_pixel_count((width, height): (u32, u32), count: usize) -> io::Result<()> {
    match count as u64 == u64::from(width) * u64::from(height) {
        true => Ok(()),
        false => Err(damaged_error(format!("it has {count} numbers for {width}x{height} pixels"))),
    }
}
