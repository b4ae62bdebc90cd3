//! Folders in an object store: downloading for readers, uploading for publishers.

use super::cache::{FolderCache, FolderPin, PinnedPath};
use super::checksums::{self, CheckDepth, DamagedFile, SUMS, Sums};
use super::objects::{
    FolderName, ObjectStoreUnavailable, Objects, SealOutcome, UnsealedObjects, new_edition,
    parse_edition, parse_seal_checksums, seal_header,
};
use super::{Blobs, SEALED, Scratch, size_of, sync_folder};
use camino::{Utf8Path, Utf8PathBuf};
use std::fs::{self, File};
use std::io;
use std::sync::Arc;
use std::time::Instant;

/// The object store, and the local cache of its folders.
#[derive(Debug)]
pub(crate) struct SharedBlobs {
    pub objects: Objects,
    pub cache: Arc<FolderCache>,
}

/// The files of a folder that a caller needs.
#[derive(Debug, Clone, Copy)]
enum WantedFiles<'a> {
    Everything,
    File(&'a Utf8Path),
    /// Only the list of the files.
    Seal,
}

/// The uploaded objects of a folder that is not published yet.
#[derive(Debug)]
pub struct PendingUpload {
    files: UnsealedObjects,
    seal: String,
    begun: Instant,
}

impl SharedBlobs {
    /// Seals a written folder and uploads it as an edition that no seal names yet.
    pub(super) fn upload_edition(
        &self,
        scratch: &Scratch,
        name: &FolderName,
        known: &Sums,
    ) -> io::Result<PendingUpload> {
        let (objects, begun, edition) = (&self.objects, Instant::now(), new_edition());
        checksums::seal(scratch.path(), known, &seal_header(&edition))?;
        let seal = fs::read_to_string(scratch.path().join(SUMS))?;
        let files = parse_seal_checksums(&seal).into_keys().collect();
        let files = objects.block_on(objects.put_edition(scratch.path(), name, &edition, files))?;
        Ok(PendingUpload { files, seal, begun })
    }
}

impl Blobs {
    /// Returns a file of a published folder, pinned while the result lives. Blocks while it is
    /// downloaded. Whether the folder has such a file is checked only with an object store;
    /// otherwise the reader finds out when it opens the file.
    ///
    /// # Errors
    /// Errors of the file system; the object store cannot be used.
    pub fn pin_file(&self, place: &Utf8Path, file: &Utf8Path) -> io::Result<PinnedPath> {
        let below = file.strip_prefix(place).unwrap_or(file);
        let path = place.join(below);
        match (&self.shared, self.name_of(place)) {
            (Some(shared), Some(name)) => Ok(PinnedPath::with_pin(
                path,
                self.download(shared, &name, place, WantedFiles::File(below))?,
            )),
            _ => Ok(path.into()),
        }
    }

    /// Returns a published folder with all its files; otherwise as [`pin_file`](Self::pin_file).
    ///
    /// # Errors
    /// As for [`pin_file`](Self::pin_file).
    pub fn pin_folder(&self, place: &Utf8Path) -> io::Result<PinnedPath> {
        match (&self.shared, self.name_of(place)) {
            (Some(shared), Some(name)) => Ok(PinnedPath::with_pin(
                place.to_owned(),
                self.download(shared, &name, place, WantedFiles::Everything)?,
            )),
            _ => Ok(place.to_owned().into()),
        }
    }

    /// Returns a temporary public link to a file of a published folder, if the object store gives
    /// out links. Blocks.
    ///
    /// # Errors
    /// As for [`pin_file`](Self::pin_file).
    pub fn link(&self, place: &Utf8Path, file: &Utf8Path) -> io::Result<Option<String>> {
        let (Some(shared), Some(name)) = (&self.shared, self.name_of(place)) else {
            return Ok(None);
        };
        if !shared.objects.has_public_links() || !self.has_file(place, file)? {
            return Ok(None);
        }
        let seal = fs::read_to_string(self.pin_file(place, SUMS.into())?)?;
        let Some(edition) = parse_edition(&seal) else { return Ok(None) };
        shared.objects.block_on(shared.objects.link(
            &name,
            edition,
            file.strip_prefix(place).unwrap_or(file),
        ))
    }

    /// Returns whether a published folder was published with this file. For folders from before
    /// checksums were stored, returns whether the file exists.
    ///
    /// # Errors
    /// As for [`pin_file`](Self::pin_file).
    pub fn has_file(&self, place: &Utf8Path, file: &Utf8Path) -> io::Result<bool> {
        let _held = match (&self.shared, self.name_of(place)) {
            (Some(shared), Some(name)) => {
                match self.download(shared, &name, place, WantedFiles::Seal) {
                    Err(error) if error.kind() == io::ErrorKind::NotFound => return Ok(false),
                    held => Some(held?),
                }
            }
            _ => None,
        };
        checksums::has_file(place, file.strip_prefix(place).unwrap_or(file))
    }

    /// Checks a published folder and returns its damaged files. In an object store it reports
    /// missing files only: the store itself checks the content of its objects.
    ///
    /// # Errors
    /// Errors of the file system; the object store cannot be used.
    pub fn check_folder(
        &self,
        place: &Utf8Path,
        closely: CheckDepth,
    ) -> io::Result<Vec<DamagedFile>> {
        match (&self.shared, self.name_of(place)) {
            (Some(shared), Some(name)) => shared.objects.block_on(async {
                match closely {
                    CheckDepth::Names if shared.objects.seal(&name).await?.is_some() => {
                        Ok(Vec::new())
                    }
                    _ => shared.objects.list_missing_files(&name).await,
                }
            }),
            _ => checksums::check_folder(place, closely),
        }
    }

    /// Checks one file of a published folder. A damaged copy of a file in an object store is
    /// downloaded again.
    ///
    /// # Errors
    /// As for [`pin_file`](Self::pin_file).
    pub fn check_file(&self, place: &Utf8Path, file: &Utf8Path) -> io::Result<Option<DamagedFile>> {
        let damage = checksums::check_file(place, file)?;
        if damage.is_none() || self.shared.is_none() {
            return Ok(damage);
        }
        tracing::warn!(folder = %place, %file, "local copy is damaged; downloading it again");
        fs::remove_file(place.join(file))?;
        let _brought = self.pin_file(place, file)?;
        checksums::check_file(place, file)
    }

    /// Returns kind and name of a published folder.
    pub(super) fn name_of(&self, place: &Utf8Path) -> Option<FolderName> {
        let mut parts = place.strip_prefix(&self.root).ok()?.components();
        let (kind, name, more) = (parts.next()?, parts.next()?, parts.next());
        let kind = SEALED.into_iter().find(|known| *known == kind.as_str())?;
        more.is_none().then(|| FolderName { kind, name: name.as_str().to_owned() })
    }

    fn download(
        &self,
        shared: &SharedBlobs,
        name: &FolderName,
        place: &Utf8Path,
        wanted: WantedFiles<'_>,
    ) -> io::Result<FolderPin> {
        let held = shared.cache.pin(place);
        if is_complete_locally(place, wanted)? {
            return Ok(held);
        }
        let download_lock = held.lock_for_download();
        // Another task may have downloaded it meanwhile.
        if is_complete_locally(place, wanted)? {
            drop(download_lock);
            return Ok(held);
        }
        let there = match self.download_missing(shared, name, place, wanted) {
            // The folder was published again after its seal was downloaded: the local files belong
            // to an edition that is gone.
            Err(error) if error.kind() == io::ErrorKind::NotFound && place.join(SUMS).exists() => {
                drop(shared.cache.move_content_away(place)?.map(|path| self.to_scratch(path)));
                self.download_missing(shared, name, place, wanted)?
            }
            brought => brought?,
        };
        if !there {
            return Err(io::ErrorKind::NotFound.into());
        }
        drop(download_lock);
        Ok(held)
    }

    /// Downloads the missing files of a folder and checks them. A file is moved into place as a
    /// whole. Returns whether the folder has the wanted files.
    fn download_missing(
        &self,
        SharedBlobs { objects, cache, .. }: &SharedBlobs,
        name: &FolderName,
        place: &Utf8Path,
        wanted: WantedFiles<'_>,
    ) -> io::Result<bool> {
        let seal = match fs::read_to_string(place.join(SUMS)) {
            Err(error) if error.kind() == io::ErrorKind::NotFound => {
                let seal =
                    objects.block_on(objects.seal(name))?.ok_or(io::ErrorKind::NotFound)?.text;
                fs::create_dir_all(place)?;
                let unfinished = self.tmp.join(uuid::Uuid::now_v7().to_string());
                fs::write(&unfinished, &seal)?;
                File::open(&unfinished)?.sync_all()?;
                fs::rename(unfinished, place.join(SUMS))?;
                cache.add(place, seal.len() as u64);
                seal
            }
            seal => seal?,
        };
        let edition = parse_edition(&seal).ok_or_else(|| {
            io::Error::new(
                io::ErrorKind::InvalidData,
                "the first line of its checksum file is invalid",
            )
        })?;
        let mut missing: Sums = parse_seal_checksums(&seal);
        match wanted {
            WantedFiles::Seal => return Ok(true),
            WantedFiles::Everything => missing.retain(|file, _| !place.join(file).exists()),
            WantedFiles::File(wanted) => {
                missing.retain(|file, _| file == wanted);
                if missing.is_empty() {
                    return Ok(false);
                }
            }
        }
        let brought = self.scratch()?;
        let files: Vec<Utf8PathBuf> = missing.keys().cloned().collect();
        let bytes = objects.block_on(objects.get_files(name, edition, &files, brought.path()))?;
        let at = |number: usize| brought.path().join(number.to_string());
        for (number, (file, sum)) in missing.iter().enumerate() {
            if checksums::hash_file(&at(number))? != *sum {
                return Err(io::Error::new(
                    io::ErrorKind::InvalidData,
                    format!("{file}: the checksum of its object does not match"),
                ));
            }
        }
        checksums::sync(brought.path(), files.len(), (0..files.len()).map(at))?;
        for (number, file) in files.iter().enumerate() {
            let to = place.join(file);
            fs::create_dir_all(to.parent().unwrap_or(place))?;
            fs::rename(at(number), to)?;
        }
        cache.add(place, bytes);
        Ok(true)
    }

    /// Seals the uploaded files, and keeps the written folder as a local copy.
    pub(super) fn publish_upload(
        &self,
        shared: &SharedBlobs,
        name: &FolderName,
        scratch: &Scratch,
        put: PendingUpload,
        place: &Utf8Path,
    ) -> io::Result<()> {
        let SharedBlobs { objects, cache, .. } = shared;
        let PendingUpload { files, seal, begun } = put;
        // The row must be written before orphan collection removes the folder as an orphan.
        if begun.elapsed() > objects.grace / 2 {
            return Err(ObjectStoreUnavailable::wrap(
                "copying to the object store took longer than half of --blobs-grace-s: raise this setting",
            ));
        }
        objects.block_on(async {
            match objects.put_seal(name, &seal).await? {
                SealOutcome::Sealed => files.keep(),
                // Same name, same content. But an old folder may be about to be removed, and an
                // incomplete one is of no use.
                SealOutcome::AlreadySealed(theirs) => {
                    let is_young = theirs.made.elapsed().unwrap_or_default() < objects.grace / 2;
                    if is_young && objects.list_missing_files(name).await?.is_empty() {
                        return Ok(());
                    }
                    objects.replace_seal(name, &seal).await?;
                    files.keep();
                    if let Some(edition) = parse_edition(&theirs.text) {
                        drop(objects.unsealed_edition(name, edition));
                    }
                }
            }
            Ok::<_, io::Error>(())
        })?;
        let bytes = size_of(scratch.path())?;
        if let Some(path) = cache.move_folder_away(place)? {
            drop(self.to_scratch(path));
        }
        fs::rename(scratch.path(), place)?;
        sync_folder(place.parent().unwrap_or(place))?;
        cache.add(place, bytes);
        Ok(())
    }
}

fn is_complete_locally(place: &Utf8Path, wanted: WantedFiles<'_>) -> io::Result<bool> {
    match wanted {
        WantedFiles::File(file) => Ok(place.join(file).exists()),
        WantedFiles::Seal => Ok(place.join(SUMS).exists()),
        WantedFiles::Everything if !place.join(SUMS).exists() => Ok(false),
        WantedFiles::Everything => {
            Ok(checksums::check_folder(place, CheckDepth::Names)?.is_empty())
        }
    }
}

#[cfg(test)]
mod tests {
    use super::super::{BlobHome, FileAccess};
    use super::*;
    use object_store::memory::InMemory;
    use object_store::path::Path;
    use object_store::{ObjectStore, ObjectStoreExt};
    use std::collections::BTreeMap;
    use std::time::Duration;
    use tokio::task::spawn_blocking;

    const DAY: Duration = Duration::from_hours(24);

    /// Several machines with separate folders that share one object store.
    struct Site {
        store: Arc<InMemory>,
        machines: Vec<(tempfile::TempDir, Blobs)>,
    }

    impl Site {
        async fn new(machines: usize, cache_bytes: u64, grace: Duration) -> Self {
            let store = Arc::new(InMemory::new());
            let mut opened = Vec::new();
            for _ in 0..machines {
                let objects = Objects::new(store.clone(), "rooms/a", grace);
                let machine = spawn_blocking(move || {
                    let folder = tempfile::tempdir().unwrap();
                    let blobs = Blobs::open(
                        Utf8Path::from_path(folder.path()).unwrap(),
                        &BlobHome::Folder,
                        FileAccess::ReadWrite,
                    )
                    .unwrap();
                    let blobs =
                        blobs.with_object_store(objects, "memory", None, cache_bytes).unwrap();
                    (folder, blobs)
                });
                opened.push(machine.await.unwrap());
            }
            Self { store, machines: opened }
        }

        /// Runs blocking work on one machine.
        async fn run_on<T: Send + 'static>(
            &self,
            machine: usize,
            work: impl FnOnce(Blobs) -> T + Send + 'static,
        ) -> T {
            let blobs = self.machines[machine].1.clone();
            spawn_blocking(move || work(blobs)).await.unwrap()
        }

        /// Returns all keys in the store except the ownership marker.
        async fn keys(&self) -> Vec<String> {
            use futures::TryStreamExt;
            let all: Vec<_> = self
                .store
                .list(None)
                .map_ok(|object| object.location.to_string())
                .try_collect()
                .await
                .unwrap();
            let mut keys: Vec<String> =
                all.into_iter().filter(|key| !key.ends_with("uniground-data.json")).collect();
            keys.sort();
            keys
        }
    }

    const FILES: [(&str, &str); 3] = [
        ("cloud.ply", "points"),
        ("views/1 a#\u{e9}.jpg", "picture"),
        ("views/deep/er/2.jpg", "other"),
    ];

    fn write_scratch(blobs: &Blobs) -> Scratch {
        let scratch = blobs.scratch().unwrap();
        for (file, text) in FILES {
            let path = scratch.path().join(file);
            fs::create_dir_all(path.parent().unwrap()).unwrap();
            fs::write(path, text).unwrap();
        }
        scratch
    }

    fn publish(blobs: &Blobs, place: &Utf8Path) -> io::Result<()> {
        blobs.publish(write_scratch(blobs), place)
    }

    fn read(blobs: &Blobs, place: &Utf8Path, file: &str) -> io::Result<String> {
        blobs.pin_file(place, file.into()).and_then(fs::read_to_string)
    }

    fn read_all_files(blobs: &Blobs, place: &Utf8Path) -> BTreeMap<String, String> {
        let whole = blobs.pin_folder(place).unwrap();
        let files = checksums::list_files(&whole).unwrap().into_iter();
        files
            .map(|file| (file.to_string(), fs::read_to_string(whole.join(file)).unwrap()))
            .collect()
    }

    #[tokio::test]
    async fn published_folders_can_be_read_on_other_machines() {
        let site = Site::new(3, u64::MAX, DAY).await;
        site.run_on(0, |blobs| publish(&blobs, &blobs.parse("p")).unwrap()).await;
        site.run_on(1, |blobs| {
            let place = blobs.parse("p");
            assert!(
                blobs.has_file(&place, "views/1 a#\u{e9}.jpg".into()).unwrap()
                    && !blobs.has_file(&place, "views/3.jpg".into()).unwrap()
            );
            assert_eq!(read(&blobs, &place, "cloud.ply").unwrap(), "points");
            // Only the requested file was downloaded.
            assert!(!place.join("views/deep/er/2.jpg").exists());
            assert_eq!(
                read(&blobs, &place, "views/3.jpg").unwrap_err().kind(),
                io::ErrorKind::NotFound
            );
            assert!(
                place.join("cloud.ply").exists(),
                "a request for an unknown file does not remove the local copy"
            );
            assert!(blobs.check_folder(&place, CheckDepth::Bytes).unwrap().is_empty());
            assert_eq!(
                read(&blobs, &blobs.parse("q"), "cloud.ply").unwrap_err().kind(),
                io::ErrorKind::NotFound
            );
            assert_eq!(
                blobs.check_folder(&blobs.parse("q"), CheckDepth::Names).unwrap()[0].what,
                "missing"
            );
        })
        .await;
        let expected: BTreeMap<String, String> =
            FILES.iter().map(|(file, text)| ((*file).to_owned(), (*text).to_owned())).collect();
        assert_eq!(
            site.run_on(2, |blobs| read_all_files(&blobs, &blobs.parse("p"))).await,
            expected
        );
    }

    #[tokio::test]
    async fn files_without_a_seal_are_not_a_published_folder() {
        let site = Site::new(2, u64::MAX, DAY).await;
        // The writer ended before it uploaded the seal.
        for (file, _) in FILES {
            site.store
                .put(&Path::from(format!("rooms/a/contents/c/0123/{file}")), "torn".into())
                .await
                .unwrap();
        }
        site.run_on(0, |blobs| {
            let place = blobs.content("c");
            assert_eq!(
                read(&blobs, &place, "cloud.ply").unwrap_err().kind(),
                io::ErrorKind::NotFound
            );
            publish(&blobs, &place).unwrap();
        })
        .await;
        assert_eq!(
            site.run_on(1, |blobs| read(&blobs, &blobs.content("c"), "cloud.ply")).await.unwrap(),
            "points"
        );
    }

    #[tokio::test]
    async fn the_first_of_two_publishers_wins_and_files_of_the_other_are_removed() {
        let site = Site::new(2, u64::MAX, DAY).await;
        // Both machines start before either has finished.
        let prepared = site
            .run_on(1, |blobs| blobs.prepare(write_scratch(&blobs), &blobs.content("c")).unwrap())
            .await;
        site.run_on(0, |blobs| publish(&blobs, &blobs.content("c")).unwrap()).await;
        assert_eq!(site.keys().await.len(), 2 * FILES.len() + 1);
        site.run_on(1, |blobs| blobs.publish_prepared(prepared).unwrap()).await;
        for machine in 0..2 {
            assert_eq!(
                site.run_on(machine, |blobs| read(&blobs, &blobs.content("c"), "cloud.ply"))
                    .await
                    .unwrap(),
                "points"
            );
        }
        wait_until_objects_left(&site, FILES.len() + 1).await;
    }

    /// Waits until only this many objects are left.
    async fn wait_until_objects_left(site: &Site, left: usize) {
        for _ in 0..500 {
            if site.keys().await.len() == left {
                return;
            }
            tokio::time::sleep(Duration::from_millis(10)).await;
        }
        panic!("{:?}", site.keys().await);
    }

    #[tokio::test]
    async fn a_removed_folder_is_removed_on_all_machines_and_can_be_republished() {
        let site = Site::new(2, u64::MAX, DAY).await;
        site.run_on(0, |blobs| publish(&blobs, &blobs.content("c")).unwrap()).await;
        site.run_on(1, |blobs| read(&blobs, &blobs.content("c"), "cloud.ply").unwrap()).await;
        let blobs = site.machines[0].1.clone();
        blobs.discard(blobs.content("c")).await.unwrap();
        assert_eq!(
            site.run_on(0, |blobs| blobs
                .check_folder(&blobs.content("c"), CheckDepth::Names)
                .unwrap()
                .len())
                .await,
            1
        );
        wait_until_objects_left(&site, 0).await;
        site.run_on(0, |blobs| publish(&blobs, &blobs.content("c")).unwrap()).await;
        // This machine still has the previous seal and only one of the files.
        assert_eq!(
            site.run_on(1, |blobs| read_all_files(&blobs, &blobs.content("c"))).await.len(),
            FILES.len()
        );
    }

    #[tokio::test]
    async fn a_folder_moved_away_is_put_back_unless_replaced() {
        let site = Site::new(2, u64::MAX, DAY).await;
        let [one, other] = [0, 1].map(|at| site.machines[at].1.clone());
        site.run_on(0, |blobs| publish(&blobs, &blobs.content("c")).unwrap()).await;
        let taken = other.set_aside(vec![other.content("c")]).await.unwrap().remove(0);
        other.put_back(taken, other.content("c")).await.unwrap();
        assert_eq!(
            site.run_on(1, |blobs| read_all_files(&blobs, &blobs.content("c"))).await.len(),
            FILES.len()
        );
        let taken = one.set_aside(vec![one.content("c")]).await.unwrap().remove(0);
        site.run_on(1, |blobs| publish(&blobs, &blobs.content("c")).unwrap()).await;
        one.put_back(taken, one.content("c")).await.unwrap();
        wait_until_objects_left(&site, FILES.len() + 1).await;
        assert_eq!(
            site.run_on(0, |blobs| read_all_files(&blobs, &blobs.content("c"))).await.len(),
            FILES.len()
        );
    }

    #[tokio::test]
    async fn a_damaged_copy_is_downloaded_again_and_missing_objects_are_reported() {
        let site = Site::new(2, u64::MAX, DAY).await;
        site.run_on(0, |blobs| publish(&blobs, &blobs.parse("p")).unwrap()).await;
        site.run_on(1, |blobs| {
            let (place, file) = (blobs.parse("p"), Utf8Path::new("cloud.ply"));
            read(&blobs, &place, "cloud.ply").unwrap();
            fs::write(place.join(file), "pointz").unwrap();
            assert_eq!(blobs.check_file(&place, file).unwrap(), None);
            assert_eq!(fs::read_to_string(place.join(file)).unwrap(), "points");
        })
        .await;
        let key = site.keys().await.into_iter().find(|key| key.ends_with("2.jpg")).unwrap();
        site.store.put(&Path::parse(key).unwrap(), "others".into()).await.unwrap();
        let result = site
            .run_on(1, |blobs| blobs.pin_folder(&blobs.parse("p")).map(drop))
            .await
            .unwrap_err();
        assert_eq!(result.kind(), io::ErrorKind::InvalidData);
        assert!(result.to_string().contains("views/deep/er/2.jpg"), "{result}");
    }

    #[tokio::test]
    async fn a_publish_slower_than_half_the_grace_period_fails() {
        let site = Site::new(1, u64::MAX, Duration::from_millis(100)).await;
        let result = site.run_on(0, |blobs| {
            let prepared = blobs.prepare(write_scratch(&blobs), &blobs.content("c")).unwrap();
            std::thread::sleep(Duration::from_millis(60));
            blobs.publish_prepared(prepared)
        });
        assert!(ObjectStoreUnavailable::is_behind(&result.await.unwrap_err()));
        wait_until_objects_left(&site, 0).await;
    }

    #[tokio::test]
    async fn copies_are_evicted_and_downloaded_again() {
        let site = Site::new(1, 600, DAY).await;
        site.run_on(0, |blobs| {
            for name in ["a", "b", "c"] {
                publish(&blobs, &blobs.parse(name)).unwrap();
            }
            // One folder is about 270 bytes, most of it the seal.
            let here = |blobs: &Blobs| blobs.names("parses").unwrap().len();
            assert_eq!(here(&blobs), 2);
            for name in ["a", "b", "c"] {
                assert_eq!(read_all_files(&blobs, &blobs.parse(name)).len(), FILES.len());
                assert!(here(&blobs) <= 2);
            }
        })
        .await;
    }

    #[tokio::test]
    async fn a_cache_folder_belongs_to_one_object_store() {
        let site = Site::new(1, u64::MAX, DAY).await;
        let other = Objects::new(Arc::new(InMemory::new()), "", DAY);
        let (folder, blobs) = &site.machines[0];
        let path = Utf8Path::from_path(folder.path()).unwrap();
        let (blobs, known) = (blobs.clone(), super::super::home::read_source_store(path).unwrap());
        let again = spawn_blocking(move || {
            blobs.with_object_store(other, "memory", known, u64::MAX).map(drop)
        });
        assert!(matches!(again.await.unwrap(), Err(crate::StoreError::StoresDoNotMatch)));
        assert!(matches!(
            Blobs::open(path, &BlobHome::Folder, FileAccess::ReadWrite),
            Err(crate::StoreError::BlobsElsewhere { .. })
        ));
        assert!(matches!(
            Blobs::open_read_only(path),
            Err(crate::StoreError::RequiresLocalFiles { .. })
        ));
    }
}
