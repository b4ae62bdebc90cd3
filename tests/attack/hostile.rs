//! Uploads nobody means well with, each a few kilobytes on the wire.

use crate::archives::{Scan, ply_header};
use std::io::{Cursor, Write};

pub const ZIP: &str = "application/zip";
pub const ZST: &str = "application/zstd";

/// A zip of these files.
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
    let manifest = format!(r#"{{"format":"uniground-scene/1","frames":[{}]}}"#, frames.trim_end_matches(','));
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

/// A tar whose first entry is a header of so many bytes that describes the next.
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
