//! Receives the parts of an upload.

use super::checking::{Checksum, ChecksumCheck};
use crate::error::Error;
use crate::scenes::{BodyPieces, detect_format};
use crate::{Caller, MAX_UPLOADS, UploadService};
use bytes::Bytes;
use futures::Stream;
use tokio::task::spawn_blocking;
use tracing::Instrument;
use uniground_ingest::ArchiveFormat;
use uniground_storage::{GrowingFile, UploadRow};
use uniground_types::uploads::Upload;

/// A part of an upload.
pub struct UploadPart<S> {
    /// The offset at which the part begins. Must equal the bytes received so far.
    pub offset: u64,
    /// The size in bytes that the client announced.
    pub announced_bytes: u64,
    /// The expected checksum. A part that does not match is discarded.
    pub checksum: Option<Checksum>,
    pub body: S,
}

/// Bytes between two saves. A killed server loses at most this much.
const SAVE_BYTES: u64 = 32 << 20;

impl UploadService {
    /// Appends a part to an upload.
    ///
    /// If a part breaks off, the bytes received so far are stored, unless the part has a checksum,
    /// because an incomplete part cannot be checked.
    ///
    /// After the last part the upload becomes a scene or is rejected. A rejection is reported in
    /// the returned upload, not as an error. This runs to its end even if the client disconnects.
    ///
    /// # Errors
    /// [`Error::WrongOffset`], [`Error::UploadBusy`], [`Error::ChecksumMismatch`],
    /// [`Error::UploadInterrupted`] and other errors of the body; transient errors while creating
    /// the scene, which the server retries by itself.
    pub async fn append<E, S>(
        &self,
        id: &str,
        part: UploadPart<S>,
        caller: Caller,
    ) -> Result<Upload, Error>
    where
        S: Stream<Item = Result<Bytes, E>> + Send + Unpin + 'static,
        E: Send + 'static,
    {
        let (service, id) = (self.clone(), id.to_owned());
        let appending = async move { service.append_to_end(&id, part, &caller).await };
        tokio::spawn(appending.in_current_span()).await?
    }

    async fn append_to_end<E, S>(
        &self,
        id: &str,
        part: UploadPart<S>,
        caller: &Caller,
    ) -> Result<Upload, Error>
    where
        S: Stream<Item = Result<Bytes, E>> + Unpin,
    {
        let place = self.upload_permits.clone().try_acquire_owned();
        let place = place.map_err(|_| Error::TooMany { what: "uploads", most: MAX_UPLOADS })?;
        // Checked before the lock: other callers must not learn that the upload is busy.
        self.upload_row(id, caller).await?;
        let _lock = self.service_locks.lock_upload(id).await?;
        let mut row = self.upload_row(id, caller).await?;
        if part.offset != row.received {
            return Err(Error::WrongOffset { offset: row.received });
        }
        if part.announced_bytes > row.length - row.received {
            return Err(Error::UploadTooLarge { max_bytes: row.length });
        }
        if row.came_of.is_none() && row.received < row.length {
            self.capacity.check_disk(part.announced_bytes)?;
            row = match self.receive_part(row, part).await {
                Err(error @ Error::NoScan { .. }) => self.reject_upload(id, error).await?,
                taken => taken?,
            };
        }
        drop(place);
        if row.came_of.is_none() && row.received == row.length {
            row = self.complete_upload(row, caller).await?;
        }
        Ok(self.to_upload(row))
    }

    /// Receives a part up to its end or to the point where it breaks off.
    async fn receive_part<E, S>(
        &self,
        mut row: UploadRow,
        part: UploadPart<S>,
    ) -> Result<UploadRow, Error>
    where
        S: Stream<Item = Result<Bytes, E>> + Unpin,
    {
        let (blobs, id, received) = (self.blobs.clone(), row.id.clone(), row.received);
        let mut file = spawn_blocking(move || blobs.open_upload(&id, received)).await??;
        let mut pieces = BodyPieces::new(part.body, row.length - row.received, row.length);
        let mut checking = part.checksum.map(ChecksumCheck::new);
        let end = loop {
            let piece = match pieces.next().await {
                Ok(Some(piece)) => piece,
                Ok(None) => break Ok(()),
                Err(error) => break Err(error),
            };
            let written = spawn_blocking(move || {
                checking.iter_mut().for_each(|checking| checking.update(&piece));
                file.write(&piece).map(|()| (file, checking))
            });
            (file, checking) = written.await??;
            // The first bytes are saved at once, so that an invalid file is rejected before the
            // client sends all of it.
            let is_beginning = row.received < HEAD_BYTES && file.bytes() >= HEAD_BYTES;
            if checking.is_none() && (is_beginning || file.unsaved_bytes() >= SAVE_BYTES) {
                (row, file) = self.save_part(row, file).await?;
            }
        };
        if let Some(checking) = checking {
            // A part that broke off cannot be checked.
            end?;
            return match checking.matches() {
                true => Ok(self.save_part(row, file).await?.0),
                false => Err(Error::ChecksumMismatch),
            };
        }
        if file.unsaved_bytes() > 0 {
            row = self.save_part(row, file).await?.0;
        }
        end.map(|()| row)
    }

    /// Writes the received bytes to disk, then updates the record, in this order.
    async fn save_part(
        &self,
        row: UploadRow,
        mut file: GrowingFile,
    ) -> Result<(UploadRow, GrowingFile), Error> {
        let (file, head) = spawn_blocking(move || {
            file.save()?;
            file.read_head(ArchiveFormat::HEAD_BYTES).map(|head| (file, head))
        })
        .await??;
        let noted = self.upload_repository.note_received(&row.id, file.bytes()).await?;
        let noted = noted.ok_or_else(|| Error::UploadNotFound { id: row.id.clone() })?;
        if row.received < HEAD_BYTES && noted.received >= HEAD_BYTES {
            detect_format(&head, file_name(&noted))?;
        }
        Ok((noted, file))
    }
}

const HEAD_BYTES: u64 = ArchiveFormat::HEAD_BYTES as u64;

/// Returns the file name of an upload. The extension helps where the bytes are ambiguous.
pub(super) fn file_name(row: &UploadRow) -> &str {
    row.wanted.file_name.as_deref().or(row.wanted.name.as_deref()).unwrap_or_default()
}
