//! Malicious uploads, each a few kilobytes on the wire.

use crate::test_scans::{Scan, ply_header};
use std::io::{Cursor, Write};

pub const ZIP: &str = "application/zip";
pub const ZST: &str = "application/zstd";
pub const ANY: &str = "application/octet-stream";

/// Returns a zip of these files.
fn zip_of(entries: impl IntoIterator<Item = (String, Vec<u8>)>) -> Vec<u8> {
    let options = zip::write::SimpleFileOptions::default();
    let mut zip = zip::ZipWriter::new(Cursor::new(Vec::new()));
    for (name, content) in entries {
        zip.start_file(name, options).unwrap();
        zip.write_all(&content).unwrap();
    }
    zip.finish().unwrap().into_inner()
}

fn cloud(ply: Vec<u8>) -> Vec<u8> {
    zip_of([("cloud.ply".to_owned(), ply)])
}

pub fn a_million_columns() -> Vec<u8> {
    let columns: String = (0..1_000_000).map(|i| format!("property double c{i}\n")).collect();
    cloud(format!("ply\nformat binary_little_endian 1.0\nelement vertex 1\nproperty float x\nproperty float y\nproperty float z\n{columns}end_header\n").into_bytes())
}

pub fn an_endless_line(bytes: usize) -> Vec<u8> {
    let header = "ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nproperty float y\nproperty float z\nend_header\n";
    cloud([header.as_bytes(), &vec![b'1'; bytes]].concat())
}

pub fn an_endless_header(bytes: usize) -> Vec<u8> {
    cloud([&b"ply\nformat ascii 1.0\ncomment "[..], &vec![b'x'; bytes]].concat())
}

pub fn thirteen_million_points() -> Vec<u8> {
    cloud([ply_header(13_000_000), vec![0; 13_000_000 * 15]].concat())
}

pub fn a_large_pose(bytes: usize) -> Vec<u8> {
    Scan::frames_only().with("pose/2.txt", "1 ".repeat(bytes / 2)).zip()
}

pub fn a_large_manifest(bytes: usize) -> Vec<u8> {
    let frame = r#"{"color":"a","depth":"b","pose":"c"},"#;
    let frames = frame.repeat(bytes / frame.len());
    let manifest =
        format!(r#"{{"format":"uniground-scene/1","frames":[{}]}}"#, frames.trim_end_matches(','));
    zip_of([("scene.json".to_owned(), manifest.into_bytes())])
}

pub fn deep_folders(depth: usize) -> Vec<u8> {
    zip_of([(format!("{}cloud.ply", "d/".repeat(depth)), b"x".to_vec())])
}

pub fn many_files(count: usize) -> Vec<u8> {
    zip_of((0..count).map(|i| (format!("{i}"), Vec::new())))
}

pub fn many_folders(count: usize) -> Vec<u8> {
    let mut tar = tar::Builder::new(zstd::Encoder::new(Vec::new(), 1).unwrap());
    for i in 0..count {
        let mut header = tar::Header::new_gnu();
        header.set_entry_type(tar::EntryType::Directory);
        header.set_size(0);
        tar.append_data(&mut header, format!("{i}/"), &[][..]).unwrap();
    }
    tar.into_inner().unwrap().finish().unwrap()
}

/// Returns a tar whose first entry is an extended header of `bytes` bytes.
pub fn an_extended_header(kind: tar::EntryType, bytes: u64) -> Vec<u8> {
    let mut packed = zstd::Encoder::new(Vec::new(), 1).unwrap();
    let mut header = tar::Header::new_gnu();
    header.set_path("x").unwrap();
    header.set_entry_type(kind);
    header.set_size(bytes);
    header.set_cksum();
    packed.write_all(header.as_bytes()).unwrap();
    let block = vec![b'a'; 1 << 20];
    let mut left = bytes;
    while left > 0 {
        let n = left.min(block.len() as u64);
        packed.write_all(&block[..n as usize]).unwrap();
        left -= n;
    }
    packed.finish().unwrap()
}

pub fn zeros(bytes: usize) -> Vec<u8> {
    zip_of([("cloud.ply".to_owned(), vec![0; bytes])])
}

/// Returns a LAS 1.4 file with compressed points: a header of 375 bytes, records, points, and what
/// follows.
fn laz(records: u32, vlrs: &[u8], points: &[u8], evlr_bytes: Option<u64>) -> Vec<u8> {
    let mut header = vec![0; 375];
    let start = 375 + vlrs.len() as u32;
    let mut put = |at: usize, bytes: &[u8]| header[at..at + bytes.len()].copy_from_slice(bytes);
    put(0, b"LASF");
    put(24, &[1, 4]);
    put(94, &375_u16.to_le_bytes());
    put(96, &start.to_le_bytes());
    put(100, &records.to_le_bytes());
    put(104, &[0x80]);
    put(105, &20_u16.to_le_bytes());
    put(107, &10_u32.to_le_bytes());
    for axis in 0..3 {
        put(131 + 8 * axis, &0.001_f64.to_le_bytes());
    }
    put(247, &10_u64.to_le_bytes());
    if evlr_bytes.is_some() {
        put(235, &(u64::from(start) + points.len() as u64).to_le_bytes());
        put(243, &1_u32.to_le_bytes());
    }
    let evlr = evlr_bytes.map_or_else(Vec::new, |bytes| {
        let mut evlr = vec![0; 60];
        evlr[20..28].copy_from_slice(&bytes.to_le_bytes());
        evlr
    });
    [&header, vlrs, points, &evlr].concat()
}

/// Returns a LAZ file with an extended record that declares this length.
pub fn laz_with_a_record(bytes: u64) -> Vec<u8> {
    laz(0, &[], &[0; 400], Some(bytes))
}

/// Returns a LAZ file with a table that declares this many chunks.
pub fn laz_with_chunks(chunks: u32) -> Vec<u8> {
    let items: Vec<u8> = [6_u16, 20, 2].iter().flat_map(|word| word.to_le_bytes()).collect();
    let mut data: Vec<u8> = [2_u16, 0].iter().flat_map(|word| word.to_le_bytes()).collect();
    data.extend([2, 0, 0, 0]);
    data.extend([0; 4]);
    data.extend(50_000_u32.to_le_bytes());
    data.extend((-1_i64).to_le_bytes());
    data.extend((-1_i64).to_le_bytes());
    data.extend(1_u16.to_le_bytes());
    data.extend(items);
    let mut vlr = vec![0; 54];
    vlr[2..16].copy_from_slice(b"laszip encoded");
    vlr[18..20].copy_from_slice(&22_204_u16.to_le_bytes());
    vlr[20..22].copy_from_slice(&(data.len() as u16).to_le_bytes());
    vlr.extend(data);
    let table = 375 + vlr.len() as i64 + 8;
    let mut points = table.to_le_bytes().to_vec();
    points.extend([0; 4]);
    points.extend(chunks.to_le_bytes());
    points.extend([0; 400]);
    laz(1, &vlr, &points, None)
}

/// Returns bytes that do not compress, because an archive may unpack only to a few hundred times
/// its size.
fn noise(bytes: usize) -> Vec<u8> {
    let mut state = 0x2545_f491_4f6c_dd1d_u64;
    let next = || {
        state ^= state << 13;
        state ^= state >> 7;
        state ^= state << 17;
        state as u8
    };
    std::iter::repeat_with(next).take(bytes).collect()
}

/// Returns a GLB of triangles with `count` indices of one byte.
pub fn glb_of_indices(count: usize) -> Vec<u8> {
    let json = format!(
        r#"{{"asset":{{"version":"2.0"}},"scenes":[{{"nodes":[0]}}],"nodes":[{{"mesh":0}}],
        "meshes":[{{"primitives":[{{"attributes":{{"POSITION":0}},"indices":1}}]}}],
        "accessors":[{{"bufferView":0,"componentType":5126,"count":3,"type":"VEC3"}},{{"bufferView":1,"componentType":5121,"count":{count},"type":"SCALAR"}}],
        "bufferViews":[{{"buffer":0,"byteOffset":0,"byteLength":36}},{{"buffer":0,"byteOffset":36,"byteLength":{count}}}],
        "buffers":[{{"byteLength":{}}}]}}"#,
        36 + count
    );
    let json = format!("{json}{}", " ".repeat(json.len().next_multiple_of(4) - json.len()));
    let corners: Vec<u8> = [0.0_f32, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0, 0.0]
        .iter()
        .flat_map(|x| x.to_le_bytes())
        .collect();
    let binary = [corners, vec![0; count]].concat();
    let word = |number: usize| (number as u32).to_le_bytes();
    let total = 12 + 8 + json.len() + 8 + binary.len();
    let glb = [
        &b"glTF"[..],
        &word(2),
        &word(total),
        &word(json.len()),
        b"JSON",
        json.as_bytes(),
        &word(binary.len()),
        b"BIN\0",
        &binary,
    ]
    .concat();
    zip_of([("scan.glb".to_owned(), glb), ("noise.bin".to_owned(), noise(count / 150))])
}

/// Returns an E57 file whose description has `pages` pages of empty elements.
pub fn e57_of_elements(pages: usize) -> Vec<u8> {
    const CONTENT: usize = 1020;
    let page = |content: &[u8], fill: u8| {
        let mut page = content.to_vec();
        page.resize(CONTENT, fill);
        let sum = crc32c(&page).to_be_bytes();
        page.extend(sum);
        page
    };
    let (xml_bytes, total) = ((CONTENT * (pages + 2)) as u64, (1024 * (pages + 3)) as u64);
    let mut header = b"ASTM-E57".to_vec();
    header.extend([1_u32, 0].iter().flat_map(|word| word.to_le_bytes()));
    header.extend([total, 1024, xml_bytes, 1024].iter().flat_map(|word| word.to_le_bytes()));
    let root = br#"<?xml version="1.0" encoding="UTF-8"?><e57Root type="Structure" xmlns="http://www.astm.org/COMMIT/E57/2010-e57-v1.0">"#;
    let mut e57 = [page(&header, 0), page(root, b' ')].concat();
    let elements = page(&b"<a/>".repeat(CONTENT / 4), b' ');
    for _ in 0..pages {
        e57.extend(&elements);
    }
    e57.extend(page(b"</e57Root>", b' '));
    let noise = noise(e57.len() / 150);
    zip_of([("scan.e57".to_owned(), e57), ("noise.bin".to_owned(), noise)])
}

fn crc32c(bytes: &[u8]) -> u32 {
    let step = |crc: u32, byte: &u8| {
        (0..8).fold(crc ^ u32::from(*byte), |crc, _| {
            if crc & 1 == 1 { crc >> 1 ^ 0x82f6_3b78 } else { crc >> 1 }
        })
    };
    !bytes.iter().fold(u32::MAX, step)
}
