//! Imports scans from the server's own disk, below the folder that the operator configured.

use super::NewScene;
use crate::error::Error;
use crate::packing::{Links, PackingError, pack};
use crate::{Caller, ImportService};
use bytes::Bytes;
use camino::{Utf8Path, Utf8PathBuf};
use futures::stream;
use std::fs::File;
use std::io::{self, BufWriter, Write};
use tokio::sync::mpsc;
use tokio::task::spawn_blocking;
use tokio_util::io::ReaderStream;
use uniground_types::job::Job;
use uniground_types::scenes::{ImportRequest, Scene};
use uniground_types::settings::{ImportSettings, ParseSettings, check_metres_per_unit};

/// The chunk size for packing a folder, in bytes, and how many chunks may be buffered.
const CHUNK_BYTES: usize = 256 << 10;
const CHUNKS: usize = 4;

impl ImportService {
    /// Creates a scene from a file or folder on the server, as if it had been uploaded.
    ///
    /// # Errors
    /// [`Error::ImportNotAllowed`], [`Error::ImportNotFound`], and those of an upload.
    pub async fn import_scene(
        &self,
        request: ImportRequest,
        idempotency_key: Option<String>,
        caller: &Caller,
    ) -> Result<(Scene, Option<Job>), Error> {
        let ImportRequest { path, name, parse, up, metres_per_unit, levelling, preset } = request;
        let root = self.import_root.clone().ok_or(Error::ImportNotAllowed)?;
        check_metres_per_unit("/metres_per_unit", metres_per_unit)?;
        let (found, below) =
            spawn_blocking(move || resolve_path(&root, &path).map(|found| (found, root))).await??;
        let mut settings = ParseSettings::from_request(preset, None)?;
        settings.import = ImportSettings { up, metres_per_unit, levelling, ..settings.import };
        let new = |file_name, announced_bytes| NewScene {
            name,
            file_name: Some(file_name),
            parse: parse.then_some(settings),
            idempotency_key,
            announced_bytes,
        };
        match found {
            ScanOnDisk::File { file, name, bytes } => {
                let mut body = ReaderStream::new(tokio::fs::File::from_std(file));
                self.create_scene(new(name, bytes), &mut body, caller).await
            }
            ScanOnDisk::Folder { path, name } => {
                // The folder is packed while it is received. The usual upload limits apply, and the
                // archive is never stored on disk a second time.
                let (sender, receiver) = mpsc::channel(CHUNKS);
                let packing = spawn_blocking(move || {
                    pack_into_body(&path, &below, &sender)
                        .map_err(|error| message_without_path(&error, &below))
                });
                let next = |mut receiver: mpsc::Receiver<io::Result<Bytes>>| async {
                    receiver.recv().await.map(|chunk| (chunk, receiver))
                };
                let mut body = Box::pin(stream::unfold(receiver, next));
                let made =
                    self.create_scene(new(format!("{name}.tar"), 0), &mut body, caller).await;
                drop(body);
                match (made, packing.await?) {
                    // The error of the packer explains why the upload was interrupted.
                    (Err(Error::UploadInterrupted { .. }), Err(why)) => {
                        Err(Error::invalid("/path", why))
                    }
                    (made, _) => made,
                }
            }
        }
    }
}

/// A scan on the disk.
enum ScanOnDisk {
    File { file: File, name: String, bytes: u64 },
    Folder { path: Utf8PathBuf, name: String },
}

/// Returns the file or folder at a path below `root`.
fn resolve_path(root: &Utf8Path, path: &str) -> Result<ScanOnDisk, Error> {
    let not_found = || Error::ImportNotFound { path: path.to_owned() };
    let root = root.canonicalize_utf8()?;
    // The error is the same for every path outside the folder. It does not reveal what exists
    // there.
    let path = root.join(path).canonicalize_utf8().map_err(|_| not_found())?;
    if !path.starts_with(&root) {
        return Err(not_found());
    }
    if path == root {
        return Err(Error::invalid(
            "/path",
            "it names a file or folder below the one that is imported from",
        ));
    }
    let name = path.file_name().unwrap_or("scan").to_owned();
    if path.is_dir() {
        return Ok(ScanOnDisk::Folder { path, name });
    }
    if !path.is_file() {
        return Err(not_found());
    }
    let file = File::open(&path)?;
    let bytes = file.metadata()?.len();
    Ok(ScanOnDisk::File { file, name, bytes })
}

/// Packs a folder into a request body. Links that lead out of the root are not followed.
fn pack_into_body(
    folder: &Utf8Path,
    root: &Utf8Path,
    to: &mpsc::Sender<io::Result<Bytes>>,
) -> Result<(), PackingError> {
    let below = |source| PackingError::File { path: folder.to_owned(), source };
    let mut body = BufWriter::with_capacity(CHUNK_BYTES, ArchiveWriter(to));
    let root = root.canonicalize_utf8().map_err(below)?;
    let done =
        pack(folder, Links::Below(&root), &mut body).and_then(|()| body.flush().map_err(below));
    if done.is_err() {
        // The archive sent so far is incomplete. The receiver may already be gone.
        let _ = to.blocking_send(Err(io::ErrorKind::BrokenPipe.into()));
    }
    done
}

/// Sends what is written to the receiver of the upload.
struct ArchiveWriter<'a>(&'a mpsc::Sender<io::Result<Bytes>>);

impl Write for ArchiveWriter<'_> {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        let sent = self.0.blocking_send(Ok(Bytes::copy_from_slice(bytes)));
        sent.map(|()| bytes.len()).map_err(|_| io::ErrorKind::BrokenPipe.into())
    }

    fn flush(&mut self) -> io::Result<()> {
        Ok(())
    }
}

/// Returns the error's message without the server's path.
fn message_without_path(error: &PackingError, root: &Utf8Path) -> String {
    error.to_string().replace(root.as_str(), "").trim_start_matches('/').to_owned()
}
