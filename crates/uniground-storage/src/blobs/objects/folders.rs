//! Folders as objects. The files are uploaded first, then the seal; removal goes in reverse order.

use super::super::checksums::DamagedFile;
use super::{
    Objects, none_if_missing, parse_edition, parse_seal_checksums, to_io_error, with_timeout,
};
use camino::{Utf8Path, Utf8PathBuf};
use futures::{StreamExt, TryStreamExt, stream};
use object_store::ObjectStoreExt;
use object_store::path::Path;
use std::collections::HashSet;
use std::io;
use std::time::{Duration, SystemTime};
use uuid::Uuid;

/// The object whose presence means that the folder exists.
pub(super) const SEAL: &str = ".sha256sums";
/// Files of a folder transferred concurrently.
const FILES_AT_ONCE: usize = 16;

/// Validity of a link. It is followed at once, but a large file may be requested in ranges.
const LINK_LIFETIME: Duration = Duration::from_mins(15);

/// Kind and name of a folder.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct FolderName {
    pub kind: &'static str,
    pub name: String,
}

/// A seal, and when it was uploaded.
#[derive(Debug, Clone)]
pub struct Seal {
    pub text: String,
    pub made: SystemTime,
}

/// Which edition of a folder won.
#[derive(Debug)]
pub enum SealOutcome {
    Sealed,
    AlreadySealed(Seal),
}

/// Objects that nothing refers to. They are removed in the background on drop. If the process ends
/// first, orphan collection removes them.
#[derive(Debug)]
pub struct UnsealedObjects {
    objects: Objects,
    below: Path,
    /// The folder they belonged to and its seal, if it was unsealed.
    was: Option<(FolderName, String)>,
    is_kept: bool,
}

impl UnsealedObjects {
    fn new(objects: &Objects, below: Path) -> Self {
        Self { objects: objects.clone(), below, was: None, is_kept: false }
    }

    /// Removes the objects and waits for completion.
    ///
    /// # Errors
    /// [`ObjectStoreUnavailable`](super::ObjectStoreUnavailable).
    pub async fn remove(mut self) -> io::Result<()> {
        self.is_kept = true;
        self.objects.remove_below(&self.below).await
    }

    /// Keeps the objects: a seal now refers to them.
    pub fn keep(mut self) {
        self.is_kept = true;
    }

    /// Restores the folder that was unsealed, unless it has been published again since.
    ///
    /// # Errors
    /// [`ObjectStoreUnavailable`](super::ObjectStoreUnavailable).
    pub async fn put_back(mut self) -> io::Result<()> {
        let Some((folder, seal)) = self.was.take() else { return Ok(()) };
        // Where the outcome is unknown, orphan collection removes them if needed.
        self.is_kept = true;
        self.is_kept = matches!(self.objects.put_seal(&folder, &seal).await?, SealOutcome::Sealed);
        Ok(())
    }
}

impl Drop for UnsealedObjects {
    fn drop(&mut self) {
        if self.is_kept {
            return;
        }
        let (objects, below) = (self.objects.clone(), std::mem::take(&mut self.below));
        self.objects.runtime.spawn(async move {
            if let Err(error) = objects.remove_below(&below).await {
                let error = &error as &dyn std::error::Error;
                tracing::warn!(error, %below, "unreferenced objects could not be removed; garbage collection removes them later");
            }
        });
    }
}

/// Returns a name for a new edition, unique and ordered by time.
pub fn new_edition() -> String {
    // The time in milliseconds and 32 random bits. Some stores limit the length of keys.
    let id = Uuid::now_v7().simple().to_string();
    format!("{}{}", &id[..12], &id[24..])
}

impl Objects {
    fn folder(&self, FolderName { kind, name }: &FolderName) -> Path {
        self.prefix.clone().join(*kind).join(name.as_str())
    }

    fn edition(&self, folder: &FolderName, edition: &str) -> Path {
        self.folder(folder).join(edition)
    }

    /// Returns the key of a file of an edition.
    fn file(&self, folder: &FolderName, edition: &str, file: &Utf8Path) -> Path {
        file.components()
            .fold(self.edition(folder, edition), |place, part| place.join(part.as_str()))
    }

    /// Returns the seal of a folder, or `None` if the folder does not exist.
    ///
    /// # Errors
    /// [`ObjectStoreUnavailable`](super::ObjectStoreUnavailable).
    pub async fn seal(&self, folder: &FolderName) -> io::Result<Option<Seal>> {
        let place = self.folder(folder).join(SEAL);
        let got = with_timeout(async {
            let got = self.store.get(&place).await?;
            let made = SystemTime::from(got.meta.last_modified);
            Ok((got.bytes().await?, made))
        });
        let Some((bytes, made)) = none_if_missing(got.await)? else { return Ok(None) };
        let text = String::from_utf8(bytes.to_vec())
            .map_err(|error| io::Error::new(io::ErrorKind::InvalidData, error))?;
        Ok(Some(Seal { text, made }))
    }

    /// Uploads files of a local folder as a new edition. Nothing refers to them until the folder is
    /// sealed.
    ///
    /// # Errors
    /// Errors of the file system; [`ObjectStoreUnavailable`](super::ObjectStoreUnavailable).
    pub async fn put_edition(
        &self,
        local: &Utf8Path,
        folder: &FolderName,
        edition: &str,
        files: Vec<Utf8PathBuf>,
    ) -> io::Result<UnsealedObjects> {
        let put = self.unsealed_edition(folder, edition);
        let files = files.into_iter().map(|file| {
            let (from, to) = (local.join(&file), self.file(folder, edition, &file));
            async move { self.put_file(&from, &to).await }
        });
        stream::iter(files).buffer_unordered(FILES_AT_ONCE).try_collect::<()>().await?;
        Ok(put)
    }

    /// Seals a folder, unless it is already sealed.
    ///
    /// # Errors
    /// [`ObjectStoreUnavailable`](super::ObjectStoreUnavailable).
    pub async fn put_seal(&self, folder: &FolderName, text: &str) -> io::Result<SealOutcome> {
        match self.create(&self.folder(folder).join(SEAL), text.into()).await {
            Err(error) if error.kind() == io::ErrorKind::AlreadyExists => {
                match self.seal(folder).await? {
                    // This was a retry: the first attempt succeeded, but its response was lost.
                    Some(seal) if seal.text == text => Ok(SealOutcome::Sealed),
                    Some(theirs) => Ok(SealOutcome::AlreadySealed(theirs)),
                    None => Err(error),
                }
            }
            put => put.map(|()| SealOutcome::Sealed),
        }
    }

    /// Seals a folder, replacing any existing seal.
    ///
    /// # Errors
    /// [`ObjectStoreUnavailable`](super::ObjectStoreUnavailable).
    pub async fn replace_seal(&self, folder: &FolderName, text: &str) -> io::Result<()> {
        with_timeout(self.store.put(&self.folder(folder).join(SEAL), text.to_owned().into()))
            .await
            .map(drop)
    }

    /// Unseals a folder, so that it no longer exists. Its files are removed when the result is
    /// dropped.
    ///
    /// # Errors
    /// [`ObjectStoreUnavailable`](super::ObjectStoreUnavailable).
    pub async fn unseal(&self, folder: &FolderName) -> io::Result<Option<UnsealedObjects>> {
        let Some(seal) = self.seal(folder).await? else { return Ok(None) };
        let removed = with_timeout(self.store.delete(&self.folder(folder).join(SEAL))).await;
        none_if_missing(removed)?;
        Ok(parse_edition(&seal.text).map(|edition| {
            let mut unclaimed = self.unsealed_edition(folder, edition);
            unclaimed.was = Some((folder.clone(), seal.text.clone()));
            unclaimed
        }))
    }

    /// Returns an edition that no seal refers to.
    pub fn unsealed_edition(&self, folder: &FolderName, edition: &str) -> UnsealedObjects {
        UnsealedObjects::new(self, self.edition(folder, edition))
    }

    /// Returns the checkpoints of a content, to be removed on drop.
    pub fn unsealed_checkpoints(&self, hash: &str) -> UnsealedObjects {
        UnsealedObjects::new(self, self.checkpoints(hash))
    }

    /// Downloads files of a sealed folder into a local one, named by their index. Returns the
    /// bytes.
    ///
    /// # Errors
    /// Not found where a file is missing;
    /// [`ObjectStoreUnavailable`](super::ObjectStoreUnavailable); errors of the file system.
    pub async fn get_files(
        &self,
        folder: &FolderName,
        edition: &str,
        files: &[Utf8PathBuf],
        to: &Utf8Path,
    ) -> io::Result<u64> {
        let files = files.iter().enumerate().map(|(number, file)| {
            let (from, to) = (self.file(folder, edition, file), to.join(number.to_string()));
            async move { self.get_file(&from, &to).await }
        });
        let sizes: Vec<u64> =
            stream::iter(files).buffer_unordered(FILES_AT_ONCE).try_collect().await?;
        Ok(sizes.into_iter().sum())
    }

    /// Returns whether links to files are given out.
    pub fn has_public_links(&self) -> bool {
        self.signer.is_some()
    }

    /// Returns a temporary public link to a file, or `None` if links are disabled.
    ///
    /// # Errors
    /// [`ObjectStoreUnavailable`](super::ObjectStoreUnavailable).
    pub async fn link(
        &self,
        folder: &FolderName,
        edition: &str,
        file: &Utf8Path,
    ) -> io::Result<Option<String>> {
        let Some(signer) = &self.signer else { return Ok(None) };
        let place = self.file(folder, edition, file);
        let signed =
            with_timeout(signer.signed_url(reqwest::Method::GET, &place, LINK_LIFETIME)).await?;
        Ok(Some(signed.into()))
    }

    /// Returns the missing files of a folder. The store itself checks the content of its objects.
    ///
    /// # Errors
    /// [`ObjectStoreUnavailable`](super::ObjectStoreUnavailable).
    pub async fn list_missing_files(&self, folder: &FolderName) -> io::Result<Vec<DamagedFile>> {
        let missing = |file: Utf8PathBuf| DamagedFile { file, what: "missing".into() };
        let seal = self.seal(folder).await?;
        let Some((seal, edition)) =
            seal.as_ref().and_then(|seal| Some((seal, parse_edition(&seal.text)?)))
        else {
            return Ok(vec![missing(Utf8PathBuf::new())]);
        };
        let listed = self.store.list(Some(&self.edition(folder, edition)));
        let there: HashSet<Path> =
            listed.map_ok(|object| object.location).try_collect().await.map_err(to_io_error)?;
        let files = parse_seal_checksums(&seal.text).into_keys();
        Ok(files
            .filter(|file| !there.contains(&self.file(folder, edition, file)))
            .map(missing)
            .collect())
    }
}
