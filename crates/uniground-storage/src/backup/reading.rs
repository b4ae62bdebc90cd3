//! Reads published folders, and checks every file against its checksum.

use super::super::blobs::checksums::{SUMS, list_files};
use super::manifest::hex;
use camino::{Utf8Component, Utf8Path, Utf8PathBuf};
use sha2::{Digest, Sha256};
use std::fmt::Write as _;
use std::fs::{self, File};
use std::io::{self, Read};

/// Why a folder could not be copied.
#[derive(Debug)]
pub enum CopyFailure {
    /// It does not exist, or was removed meanwhile.
    Missing,
    /// Which file is damaged, and how.
    Damaged(String),
    /// The target could not be written.
    NotWritten(io::Error),
}

/// A folder that was read completely.
pub struct CopiedFolder {
    /// Its `.sha256sums`; computed here for folders from before checksums were stored.
    pub sums: String,
    pub files: u64,
    pub bytes: u64,
}

/// Returns the stored checksums of a folder, or `None` for folders from before there were any.
pub fn read_checksum_file(folder: &Utf8Path) -> Result<Option<String>, CopyFailure> {
    match fs::read_to_string(folder.join(SUMS)) {
        Ok(sums) => Ok(Some(sums)),
        Err(error) if error.kind() == io::ErrorKind::NotFound && folder.is_dir() => Ok(None),
        Err(error) if error.kind() == io::ErrorKind::NotFound => Err(CopyFailure::Missing),
        Err(error) => Err(CopyFailure::Damaged(format!("{SUMS}: {error}"))),
    }
}

/// Parses a list of checksums into files and their checksums.
pub fn parse_checksums(sums: &str) -> Result<Vec<(Utf8PathBuf, &str)>, CopyFailure> {
    let entries = sums
        .lines()
        .filter_map(|line| line.split_once("  "))
        .map(|(sum, file)| (Utf8PathBuf::from(file), sum));
    let entries: Vec<_> = entries.collect();
    let strange = entries
        .iter()
        .find(|(file, _)| file.components().any(|step| !matches!(step, Utf8Component::Normal(_))));
    match strange {
        Some((file, _)) => {
            Err(CopyFailure::Damaged(format!("{SUMS} lists the invalid path {file}")))
        }
        None => Ok(entries),
    }
}

/// Reads a folder. `take` receives every file, its length, and exactly as many bytes. If the folder
/// turns out to be damaged, the caller must discard what `take` received.
pub fn read_folder(
    folder: &Utf8Path,
    mut take: impl FnMut(&Utf8Path, u64, &mut dyn Read) -> io::Result<()>,
) -> Result<CopiedFolder, CopyFailure> {
    let known = read_checksum_file(folder)?;
    let files: Vec<(Utf8PathBuf, Option<String>)> = if let Some(sums) = &known {
        parse_checksums(sums)?.into_iter().map(|(file, sum)| (file, Some(sum.to_owned()))).collect()
    } else {
        let files = list_files(folder).map_err(|error| to_copy_failure(folder, &error))?;
        files.into_iter().map(|file| (file, None)).collect()
    };
    let (mut sums, mut bytes) = (String::new(), 0);
    for (file, known) in &files {
        let (sum, length) =
            read_file(&folder.join(file), |length, reader| take(file, length, reader)).map_err(
                |unsound| match unsound {
                    CopyFailure::Missing if folder.is_dir() => {
                        CopyFailure::Damaged(format!("{file} missing"))
                    }
                    CopyFailure::Damaged(what) => CopyFailure::Damaged(format!("{file} {what}")),
                    other => other,
                },
            )?;
        if known.as_ref().is_some_and(|known| *known != sum) {
            return Err(CopyFailure::Damaged(format!("{file} damaged")));
        }
        let _ = writeln!(sums, "{sum}  {file}");
        bytes += length;
    }
    Ok(CopiedFolder { sums: known.unwrap_or(sums), files: files.len() as u64, bytes })
}

/// Reads a file. Returns its checksum and length.
pub fn read_file(
    path: &Utf8Path,
    take: impl FnOnce(u64, &mut dyn Read) -> io::Result<()>,
) -> Result<(String, u64), CopyFailure> {
    let opened = File::open(path).and_then(|file| Ok((file.metadata()?.len(), file)));
    let (length, file) = opened.map_err(|error| match error.kind() {
        io::ErrorKind::NotFound => CopyFailure::Missing,
        _ => CopyFailure::Damaged(error.to_string()),
    })?;
    let mut summing = HashingReader { file, hasher: Sha256::new(), failed: None };
    // Pad with zeros: a file that is shorter than expected must not break an archive.
    take(length, &mut (&mut summing).chain(io::repeat(0)).take(length))
        .map_err(CopyFailure::NotWritten)?;
    match summing.failed {
        Some(error) => Err(CopyFailure::Damaged(error.to_string())),
        None => Ok((hex(&summing.hasher.finalize()), length)),
    }
}

fn to_copy_failure(folder: &Utf8Path, error: &io::Error) -> CopyFailure {
    match error.kind() {
        io::ErrorKind::NotFound if !folder.is_dir() => CopyFailure::Missing,
        _ => CopyFailure::Damaged(error.to_string()),
    }
}

/// Hashes what is read. On a read error it stores the error and ends the stream.
struct HashingReader {
    file: File,
    hasher: Sha256,
    failed: Option<io::Error>,
}

impl Read for HashingReader {
    fn read(&mut self, buffer: &mut [u8]) -> io::Result<usize> {
        match self.file.read(buffer) {
            Ok(n) => {
                self.hasher.update(&buffer[..n]);
                Ok(n)
            }
            Err(error) if error.kind() == io::ErrorKind::Interrupted => Err(error),
            Err(error) => {
                self.failed = Some(error);
                Ok(0)
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::blobs::checksums;

    fn taken(folder: &Utf8Path) -> Result<Vec<(String, Vec<u8>)>, String> {
        let mut files = Vec::new();
        let read = read_folder(folder, |file, length, reader| {
            let mut bytes = Vec::new();
            reader.read_to_end(&mut bytes)?;
            assert_eq!(bytes.len() as u64, length);
            files.push((file.to_string(), bytes));
            Ok(())
        });
        read.map(|_| files).map_err(|unsound| format!("{unsound:?}"))
    }

    #[test]
    fn read_folder_checks_every_file() {
        let data = tempfile::tempdir().unwrap();
        let folder = Utf8Path::from_path(data.path()).unwrap();
        fs::create_dir(folder.join("views")).unwrap();
        fs::write(folder.join("cloud.ply"), "points").unwrap();
        fs::write(folder.join("views/1.jpg"), "picture").unwrap();
        let both = [
            ("cloud.ply".to_owned(), b"points".to_vec()),
            ("views/1.jpg".to_owned(), b"picture".to_vec()),
        ];
        assert_eq!(taken(folder).unwrap(), both, "readable without checksums");
        checksums::seal(folder, &checksums::Sums::new(), "").unwrap();
        assert_eq!(taken(folder).unwrap(), both);
        fs::write(folder.join("views/1.jpg"), "pictura").unwrap();
        assert_eq!(taken(folder).unwrap_err(), "Damaged(\"views/1.jpg damaged\")");
        fs::remove_file(folder.join("views/1.jpg")).unwrap();
        assert_eq!(taken(folder).unwrap_err(), "Damaged(\"views/1.jpg missing\")");
        fs::write(folder.join(SUMS), "00  ../../passwords\n").unwrap();
        assert_eq!(
            taken(folder).unwrap_err(),
            "Damaged(\".sha256sums lists the invalid path ../../passwords\")"
        );
        assert_eq!(taken(&folder.join("nowhere")).unwrap_err(), "Missing");
    }
}
