//! Scans that lie on the server's own disk, below the folder its operator named.

use super::NewScene;
use crate::error::Error;
use crate::packing::{Links, pack};
use crate::service::{Caller, Service};
use camino::{Utf8Path, Utf8PathBuf};
use std::fs::File;
use std::io::{self, Seek};
use tokio::task::spawn_blocking;
use tokio_util::io::ReaderStream;
use uniground_types::job::Job;
use uniground_types::scenes::{ImportRequest, Scene};
use uniground_types::settings::ParseSettings;

impl Service {
    /// Whoever may write may import what lies below this folder.
    #[must_use]
    pub fn importing_from(mut self, root: Option<Utf8PathBuf>) -> Self {
        self.import_root = root;
        self
    }

    /// Makes a scene of a file or folder of the server's, as if it had been uploaded.
    ///
    /// # Errors
    /// [`Error::ImportNotAllowed`], [`Error::ImportNotFound`], and those of an upload.
    pub async fn import_scene(
        &self,
        request: ImportRequest,
        idempotency_key: Option<String>,
        caller: &Caller,
    ) -> Result<(Scene, Option<Job>), Error> {
        let ImportRequest { path, name, parse, up, preset } = request;
        let root = self.import_root.clone().ok_or(Error::ImportNotAllowed)?;
        let (file, file_name) = spawn_blocking(move || opened(&root, &path)).await??;
        let mut settings = ParseSettings::from_request(preset, None)?;
        settings.import.up = up;
        let announced_bytes = file.metadata()?.len();
        let new = NewScene { name, file_name: Some(file_name), parse: parse.then_some(settings), idempotency_key, announced_bytes };
        let mut bytes = ReaderStream::new(tokio::fs::File::from_std(file));
        self.create_scene(new, &mut bytes, caller).await
    }
}

/// The scan as one file, and what it is called. A folder is packed; nothing that a link brings in from elsewhere goes with it.
fn opened(root: &Utf8Path, path: &str) -> Result<(File, String), Error> {
    let not_found = || Error::ImportNotFound { path: path.to_owned() };
    let root = root.canonicalize_utf8()?;
    // Whoever leaves the folder is not told what lies there.
    let whole = root.join(path).canonicalize_utf8().map_err(|_| not_found())?;
    if !whole.starts_with(&root) {
        return Err(not_found());
    }
    if whole == root {
        return Err(Error::invalid("/path", "it names a file or folder below the one that is imported from"));
    }
    let name = whole.file_name().unwrap_or("scan").to_owned();
    if whole.is_file() {
        return Ok((File::open(&whole)?, name));
    }
    let mut file = tempfile::tempfile()?;
    pack(&whole, Links::Below(&root), io::BufWriter::new(&mut file))
        .map_err(|error| Error::invalid("/path", told(&error.to_string(), &root)))?;
    file.rewind()?;
    Ok((file, format!("{name}.tar")))
}

/// A message without what the server's folder is called.
fn told(message: &str, root: &Utf8Path) -> String {
    message.replace(root.as_str(), "").trim_start_matches('/').to_owned()
}
