//! Files that grow from one request to the next: resumable uploads.

use super::{Blobs, sync_folder};
use bytes::Bytes;
use camino::Utf8PathBuf;
use std::fs::{self, File, OpenOptions};
use std::io::{self, Seek, SeekFrom, Write};
use std::os::unix::fs::FileExt;

/// A file that is being appended to.
#[derive(Debug)]
pub struct GrowingFile {
    file: File,
    bytes: u64,
    /// Bytes that are synced to disk, contained in `bytes`.
    saved: u64,
}

impl Blobs {
    pub(super) fn uploads(&self) -> Utf8PathBuf {
        self.root.with_file_name("uploads")
    }

    /// Returns the file of a resumable upload.
    #[must_use]
    pub fn upload(&self, id: &str) -> Utf8PathBuf {
        self.uploads().join(id)
    }

    /// Returns how many bytes of a resumable upload are stored.
    ///
    /// # Errors
    /// Errors of the file system; a missing file counts as 0 bytes.
    pub fn upload_bytes(&self, id: &str) -> io::Result<u64> {
        match fs::metadata(self.upload(id)) {
            Err(error) if error.kind() == io::ErrorKind::NotFound => Ok(0),
            found => Ok(found?.len()),
        }
    }

    /// Opens an upload to continue after its first `bytes`. Cuts off anything beyond them: it was
    /// never acknowledged to the client.
    ///
    /// # Errors
    /// Errors of the file system; a file that has fewer bytes.
    pub fn open_upload(&self, id: &str, bytes: u64) -> io::Result<GrowingFile> {
        let path = self.upload(id);
        let is_new = !path.exists();
        let mut file =
            OpenOptions::new().create(true).truncate(false).read(true).write(true).open(&path)?;
        if file.metadata()?.len() < bytes {
            return Err(io::Error::new(
                io::ErrorKind::UnexpectedEof,
                "the upload's file is shorter than its recorded size",
            ));
        }
        file.set_len(bytes)?;
        file.seek(SeekFrom::Start(bytes))?;
        if is_new {
            sync_folder(&self.uploads())?;
        }
        Ok(GrowingFile { file, bytes, saved: bytes })
    }

    /// Returns the file names of all resumable uploads.
    pub(crate) fn all_uploads(&self) -> io::Result<Vec<String>> {
        let entries = self.uploads().read_dir_utf8()?;
        entries.map(|entry| Ok(entry?.file_name().to_owned())).collect()
    }
}

impl GrowingFile {
    #[must_use]
    pub fn bytes(&self) -> u64 {
        self.bytes
    }

    /// Returns the bytes that a power failure would lose.
    #[must_use]
    pub fn unsaved_bytes(&self) -> u64 {
        self.bytes - self.saved
    }

    /// # Errors
    /// Errors of the file system. The next [`open_upload`](Blobs::open_upload) cuts off a partial
    /// write.
    pub fn write(&mut self, chunks: &[Bytes]) -> io::Result<()> {
        for chunk in chunks {
            self.file.write_all(chunk)?;
            self.bytes += chunk.len() as u64;
        }
        Ok(())
    }

    /// Syncs the written bytes to disk.
    ///
    /// # Errors
    /// Errors of the file system.
    pub fn save(&mut self) -> io::Result<()> {
        self.file.sync_data()?;
        self.saved = self.bytes;
        Ok(())
    }

    /// Returns the first bytes of the file, at most this many.
    ///
    /// # Errors
    /// Errors of the file system.
    pub fn read_head(&self, most: usize) -> io::Result<Vec<u8>> {
        let mut head = vec![0; most.min(usize::try_from(self.bytes).unwrap_or(most))];
        self.file.read_exact_at(&mut head, 0)?;
        Ok(head)
    }
}
