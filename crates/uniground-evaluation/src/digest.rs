//! Short digests of contents: the first 16 hexadecimal digits of a SHA-256.

use camino::{Utf8DirEntry, Utf8Path};
use sha2::{Digest, Sha256};
use std::fs::File;
use std::io::{self, Read};

/// Returns the first 16 digits of the digest of `bytes`.
#[must_use]
pub fn short_digest(bytes: &[u8]) -> String {
    hex(&Sha256::digest(bytes))
}

/// Returns the first 16 digits of a hasher's digest.
#[must_use]
pub fn short_hex(hasher: Sha256) -> String {
    hex(&hasher.finalize())
}

fn hex(bytes: &[u8]) -> String {
    bytes.iter().take(8).map(|byte| format!("{byte:02x}")).collect()
}

/// Adds a file, or a folder with everything below it, to a hash.
///
/// # Errors
/// Returns an error for unreadable files. Pipes and devices are skipped: they are not part of a
/// scan, and reading them may never end.
pub fn add_path(path: &Utf8Path, hasher: &mut Sha256) -> io::Result<()> {
    if path.is_dir() {
        let listed = path.read_dir_utf8()?.map(|entry| entry.map(Utf8DirEntry::into_path));
        let mut entries = listed.collect::<io::Result<Vec<_>>>()?;
        entries.sort();
        for entry in entries {
            hasher.update(entry.file_name().unwrap_or_default());
            add_path(&entry, hasher)?;
        }
        return Ok(());
    }
    if !path.metadata()?.is_file() {
        return Ok(());
    }
    let mut file = File::open(path)?;
    let mut chunk = vec![0; 1 << 16];
    loop {
        match file.read(&mut chunk)? {
            0 => return Ok(()),
            n => hasher.update(&chunk[..n]),
        }
    }
}
