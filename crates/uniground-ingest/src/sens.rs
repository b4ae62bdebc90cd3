//! Reads ScanNet's `.sens`: all frames of a scan in one file, with their poses and both cameras. It
//! is unpacked into pictures and a `scene.json`.
//!
//! All values are little-endian. Sizes and counts in the file are checked before they are used.
//! Frames are written one at a time.

use super::IngestError;
use super::unpacked::read_head;
use camino::{Utf8Path, Utf8PathBuf};
use flate2::read::ZlibDecoder;
use image::{ImageBuffer, ImageFormat, Luma};
use serde_json::json;
use std::fs::{self, File};
use std::io::{self, BufReader, BufWriter, Read, Write};

const VERSION: u32 = 4;
const MAX_NAME_BYTES: u64 = 4096;
const MAX_FRAMES: u64 = super::MAX_FRAMES as u64;
/// Maximum size of a compressed picture, bytes.
const MAX_PICTURE_BYTES: u64 = 64 << 20;
const MAX_SIDE: u32 = 8192;
/// Codecs of color pictures, by their number in the file.
const COLOR_PNG: i32 = 1;
const COLOR_JPEG: i32 = 2;
/// The only supported codec of depth pictures.
const DEPTH_ZLIB: i32 = 1;

/// Returns whether a file with this extension starts like a `.sens` file.
pub(super) fn can_read(head: &[u8], extension: &str) -> bool {
    let version = head.first_chunk::<4>().map(|version| u32::from_le_bytes(*version));
    let name_bytes =
        head.get(4..).and_then(<[u8]>::first_chunk::<8>).map(|bytes| u64::from_le_bytes(*bytes));
    extension == "sens"
        && version == Some(VERSION)
        && name_bytes.is_some_and(|bytes| bytes <= MAX_NAME_BYTES)
}

/// Returns the only `.sens` file of a folder (or of the only folder in it).
pub(super) fn find_single_file(folder: &Utf8Path) -> Result<Option<Utf8PathBuf>, IngestError> {
    let io = |source| IngestError::reading(folder, source);
    let mut folder = folder.to_owned();
    for _ in 0..4 {
        let entries: Vec<Utf8PathBuf> = folder
            .read_dir_utf8()
            .map_err(io)?
            .filter_map(Result::ok)
            .map(|entry| entry.path().to_owned())
            .collect();
        if entries.iter().any(|path| path.file_name() == Some("scene.json")) {
            return Ok(None);
        }
        let mut found: Vec<&Utf8PathBuf> = entries
            .iter()
            .filter(|path| can_read(&read_head(path), path.extension().unwrap_or_default()))
            .collect();
        if found.len() == 1 {
            return Ok(found.pop().cloned());
        }
        match &entries[..] {
            [only] if only.is_dir() => folder = only.clone(),
            _ => return Ok(None),
        }
    }
    Ok(None)
}

struct Header {
    name: String,
    /// Row-major 4x4.
    color: [f32; 16],
    depth: [f32; 16],
    color_codec: i32,
    color_size: [u32; 2],
    depth_size: [u32; 2],
    depth_shift: f32,
    frames: u64,
}

/// Unpacks a file into `target`: `color/ depth/ pose/` and `scene.json`. Returns the number of
/// frames.
///
/// # Errors
/// Returns an [`IngestError`] that names the file. `target` can then contain some of the files.
pub(super) fn unpack(
    file: &Utf8Path,
    target: &Utf8Path,
    max_bytes: u64,
) -> Result<u64, IngestError> {
    let name = Utf8Path::new(file.file_name().unwrap_or("scan.sens"));
    let malformed = |reason: String| IngestError::malformed(name, reason);
    let source = File::open(file).map_err(|source| IngestError::reading(name, source))?;
    let bytes = source.metadata().map_or(0, |m| m.len());
    let mut source = BufReader::with_capacity(1 << 20, source);
    let header = read_header(&mut source)
        .map_err(|e| malformed(format!("not a .sens file of version {VERSION}: {e}")))?;
    // A frame holds at least a pose, two times and two sizes.
    if header.frames > MAX_FRAMES || header.frames.saturating_mul(96) > bytes {
        return Err(malformed(format!(
            "it declares {} frames in {bytes} bytes; the limit is {MAX_FRAMES} frames",
            header.frames
        )));
    }
    let mut out = SensUnpacker { target, written: 0, max_bytes };
    for folder in ["color", "depth", "pose"] {
        fs::create_dir_all(target.join(folder))
            .map_err(|source| IngestError::reading(folder, source))?;
    }
    let ending = if header.color_codec == COLOR_PNG { "png" } else { "jpg" };
    let mut frames = Vec::new();
    for i in 0..header.frames {
        let at = |e: io::Error| malformed(format!("frame {i}: {e}"));
        let pose: [f32; 16] = read_floats(&mut source).map_err(at)?;
        let _times = [read_u64(&mut source).map_err(at)?, read_u64(&mut source).map_err(at)?];
        let (color_bytes, depth_bytes) =
            (read_u64(&mut source).map_err(at)?, read_u64(&mut source).map_err(at)?);
        if color_bytes.max(depth_bytes) > MAX_PICTURE_BYTES {
            return Err(malformed(format!(
                "frame {i}: a picture has {} bytes; the limit is {MAX_PICTURE_BYTES}",
                color_bytes.max(depth_bytes)
            )));
        }
        let (color, depth) = (format!("color/{i}.{ending}"), format!("depth/{i}.png"));
        let picture = read_exact_bytes(&mut source, color_bytes).map_err(at)?;
        out.write(&color, &picture)?;
        let packed = read_exact_bytes(&mut source, depth_bytes).map_err(at)?;
        out.write(&depth, &depth_png(&packed, header.depth_size).map_err(at)?)?;
        out.write(&format!("pose/{i}.txt"), format_rows(&pose).as_bytes())?;
        frames.push(json!({"color": color, "depth": depth, "pose": format!("pose/{i}.txt")}));
    }
    let camera = |m: &[f32; 16], [width, height]: [u32; 2]| json!({"width": width, "height": height, "fx": m[0], "fy": m[5], "cx": m[2], "cy": m[6]});
    let manifest = json!({
        "format": "uniground-scene/1",
        "name": if header.name.trim().is_empty() { "scene" } else { header.name.trim() },
        "source": "scannet-sens",
        "intrinsics": camera(&header.color, header.color_size),
        "depth_intrinsics": camera(&header.depth, header.depth_size),
        "depth_scale_m": 1.0 / header.depth_shift,
        "frames": frames,
    });
    out.write("scene.json", manifest.to_string().as_bytes())?;
    Ok(header.frames)
}

struct SensUnpacker<'a> {
    target: &'a Utf8Path,
    written: u64,
    max_bytes: u64,
}

impl SensUnpacker<'_> {
    fn write(&mut self, name: &str, bytes: &[u8]) -> Result<(), IngestError> {
        self.written += bytes.len() as u64;
        if self.written > self.max_bytes {
            return Err(IngestError::ArchiveTooLarge {
                limit: format!("{} bytes", self.max_bytes),
            });
        }
        fs::write(self.target.join(name), bytes)
            .map_err(|source| IngestError::Io { file: name.into(), source })
    }
}

fn read_header(source: &mut impl Read) -> io::Result<Header> {
    let strange = |what: String| io::Error::other(what);
    let version = read_u32(source)?;
    if version != VERSION {
        return Err(strange(format!("it has version {version}")));
    }
    let name_bytes = read_u64(source)?;
    if name_bytes > MAX_NAME_BYTES {
        return Err(strange(format!(
            "its name has {name_bytes} bytes; the limit is {MAX_NAME_BYTES}"
        )));
    }
    let name = String::from_utf8_lossy(&read_exact_bytes(source, name_bytes)?).into_owned();
    let (color, _color_extrinsics): ([f32; 16], [f32; 16]) =
        (read_floats(source)?, read_floats(source)?);
    let (depth, _depth_extrinsics): ([f32; 16], [f32; 16]) =
        (read_floats(source)?, read_floats(source)?);
    let (color_codec, depth_codec) =
        (read_u32(source)?.cast_signed(), read_u32(source)?.cast_signed());
    if !(color_codec == COLOR_PNG || color_codec == COLOR_JPEG) || depth_codec != DEPTH_ZLIB {
        return Err(strange(format!(
            "codecs {color_codec} (color) and {depth_codec} (depth) are not supported: use JPEG or PNG, and zlib"
        )));
    }
    let [cw, ch, dw, dh] =
        [read_u32(source)?, read_u32(source)?, read_u32(source)?, read_u32(source)?];
    if [cw, ch, dw, dh].iter().any(|side| *side == 0 || *side > MAX_SIDE) {
        return Err(strange(format!("picture sizes {cw}x{ch} and {dw}x{dh} are not supported")));
    }
    let [depth_shift]: [f32; 1] = read_floats(source)?;
    if !(depth_shift.is_finite() && depth_shift > 0.0) {
        return Err(strange(format!("its depth shift is {depth_shift}, it must be positive")));
    }
    let frames = read_u64(source)?;
    Ok(Header {
        name,
        color,
        depth,
        color_codec,
        color_size: [cw, ch],
        depth_size: [dw, dh],
        depth_shift,
        frames,
    })
}

/// Converts zlib-compressed 16-bit units to a gray PNG.
fn depth_png(packed: &[u8], [width, height]: [u32; 2]) -> io::Result<Vec<u8>> {
    let expected = u64::from(width) * u64::from(height) * 2;
    let mut bytes = Vec::new();
    ZlibDecoder::new(packed).take(expected + 1).read_to_end(&mut bytes)?;
    if bytes.len() as u64 != expected {
        return Err(io::Error::other(format!(
            "its depth unpacks to {} bytes, but {width}x{height} needs {expected}",
            bytes.len()
        )));
    }
    let units = bytes.as_chunks::<2>().0.iter().map(|b| u16::from_le_bytes(*b)).collect();
    let picture =
        ImageBuffer::<Luma<u16>, Vec<u16>>::from_raw(width, height, units).unwrap_or_default();
    let mut png = BufWriter::new(io::Cursor::new(Vec::new()));
    picture.write_to(&mut png, ImageFormat::Png).map_err(io::Error::other)?;
    png.flush()?;
    Ok(png.into_inner().map_err(io::IntoInnerError::into_error)?.into_inner())
}

fn format_rows(matrix: &[f32; 16]) -> String {
    matrix.chunks(4).map(|row| format!("{} {} {} {}\n", row[0], row[1], row[2], row[3])).collect()
}

fn read_u32(source: &mut impl Read) -> io::Result<u32> {
    let mut bytes = [0; 4];
    source.read_exact(&mut bytes)?;
    Ok(u32::from_le_bytes(bytes))
}

fn read_u64(source: &mut impl Read) -> io::Result<u64> {
    let mut bytes = [0; 8];
    source.read_exact(&mut bytes)?;
    Ok(u64::from_le_bytes(bytes))
}

fn read_floats<const N: usize>(source: &mut impl Read) -> io::Result<[f32; N]> {
    let mut all = [0.0; N];
    for value in &mut all {
        *value = f32::from_bits(read_u32(source)?);
    }
    Ok(all)
}

/// Reads exactly `bytes` bytes. Allocates memory only as they arrive.
fn read_exact_bytes(source: &mut impl Read, bytes: u64) -> io::Result<Vec<u8>> {
    let mut all = Vec::new();
    source.take(bytes).read_to_end(&mut all)?;
    if all.len() as u64 == bytes { Ok(all) } else { Err(io::ErrorKind::UnexpectedEof.into()) }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    /// Creates a header that announces `frames` frames, and one black frame.
    pub(super) fn sens(frames: u64) -> Vec<u8> {
        let mut bytes = VERSION.to_le_bytes().to_vec();
        bytes.extend(4_u64.to_le_bytes());
        bytes.extend(b"test");
        let camera: [f32; 16] =
            [4.0, 0.0, 1.5, 0.0, 0.0, 4.0, 1.5, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0];
        let eye: [f32; 16] = std::array::from_fn(|i| if i % 5 == 0 { 1.0 } else { 0.0 });
        for matrix in [camera, eye, camera, eye] {
            matrix.iter().for_each(|v| bytes.extend(v.to_le_bytes()));
        }
        [COLOR_PNG, DEPTH_ZLIB].iter().for_each(|v| bytes.extend(v.to_le_bytes()));
        [4_u32; 4].iter().for_each(|v| bytes.extend(v.to_le_bytes()));
        bytes.extend(1000.0_f32.to_le_bytes());
        bytes.extend(frames.to_le_bytes());
        let mut png = io::Cursor::new(Vec::new());
        image::RgbImage::new(4, 4).write_to(&mut png, ImageFormat::Png).unwrap();
        let mut zlib = flate2::write::ZlibEncoder::new(Vec::new(), flate2::Compression::fast());
        zlib.write_all(&[0xe8, 0x03].repeat(16)).unwrap();
        let (png, zlib) = (png.into_inner(), zlib.finish().unwrap());
        eye.iter().for_each(|v| bytes.extend(v.to_le_bytes()));
        [7, 7, png.len() as u64, zlib.len() as u64]
            .iter()
            .for_each(|v| bytes.extend(v.to_le_bytes()));
        bytes.extend(png);
        bytes.extend(zlib);
        bytes
    }

    fn unpack_bytes(bytes: &[u8]) -> Result<u64, IngestError> {
        let folder = tempfile::tempdir().unwrap();
        let folder = Utf8Path::from_path(folder.path()).unwrap();
        let file = folder.join("scan.sens");
        fs::write(&file, bytes).unwrap();
        let frames = unpack(&file, folder, 1 << 20)?;
        let scan = crate::open(folder)?;
        assert_eq!((scan.format, scan.frames.len() as u64), ("scannet-sens", frames));
        Ok(frames)
    }

    #[test]
    fn frames_are_unpacked_into_files() {
        assert_eq!(unpack_bytes(&sens(1)).unwrap(), 1);
    }

    #[test]
    fn invalid_headers_and_missing_frames_are_refused() {
        for (bytes, expected) in [
            (sens(2), "frame 1"),
            (sens(u64::MAX), "declares"),
            (sens(1)[..200].to_vec(), "not a .sens file"),
            ([&5_u32.to_le_bytes()[..], &sens(1)[4..]].concat(), "version 5"),
        ] {
            let message = unpack_bytes(&bytes).unwrap_err().to_string();
            assert!(message.contains(expected) && message.contains("scan.sens"), "{message}");
        }
    }

    proptest! {
        #[test]
        fn damaged_files_never_panic(at in 0_usize..600, with in prop::collection::vec(any::<u8>(), 1..8)) {
            let mut bytes = sens(1);
            for (i, byte) in with.iter().enumerate() {
                if let Some(own) = bytes.get_mut(at + i) {
                    *own = *byte;
                }
            }
            let _ = unpack_bytes(&bytes);
        }
    }
}
