//! Checkpoints of parses: in the data folder while a parse runs, and in the object store for
//! another machine that continues it. They are optional: a missing or incomplete checkpoint is
//! computed again.

use super::objects::{Objects, StoredLog};
use super::{Blobs, StoredCheckpoints};
use camino::{Utf8Path, Utf8PathBuf};
use std::collections::{BTreeMap, HashMap};
use std::fs::{self, File};
use std::io;
use std::time::{Duration, SystemTime};
use tokio::task::{JoinHandle, spawn_blocking};
use tokio::time::{sleep, timeout};

/// Interval of checking the logs while a parse runs.
const POLL_INTERVAL: Duration = Duration::from_secs(5);
/// A log that has not grown for this long belongs to a stage that is finished, or slow.
const STAGE_IDLE_TIME: Duration = Duration::from_secs(10);
/// Timeout of the final upload at the end of a parse.
const FINAL_UPLOAD_TIMEOUT: Duration = Duration::from_secs(30);

/// Uploads the checkpoint logs of a content while they grow.
#[derive(Debug)]
pub struct CheckpointUpload(Option<(JoinHandle<()>, CheckpointSync)>);

#[derive(Debug, Clone)]
struct CheckpointSync {
    objects: Objects,
    hash: String,
    folder: Utf8PathBuf,
}

impl CheckpointUpload {
    /// Uploads the final state of the logs.
    pub async fn finish(mut self) {
        let Some((looking, following)) = self.0.take() else { return };
        looking.abort();
        if timeout(FINAL_UPLOAD_TIMEOUT, following.upload_rest()).await.is_err() {
            tracing::warn!(
                hash = following.hash,
                "checkpoints could not be uploaded to the object store in time"
            );
        }
    }
}

impl Drop for CheckpointUpload {
    fn drop(&mut self) {
        if let Some((looking, _)) = self.0.take() {
            looking.abort();
        }
    }
}

impl Blobs {
    /// Returns the folder of checkpoints of a content, and marks it as used now. Creates it if
    /// needed and downloads newer logs from the object store.
    ///
    /// # Errors
    /// Errors of the file system.
    pub fn open_checkpoints(&self, hash: &str) -> io::Result<Utf8PathBuf> {
        let folder = self.checkpoints(hash);
        fs::create_dir_all(&folder)?;
        if let Some(shared) = &self.shared
            && let Err(error) = self.download_logs(&shared.objects, hash, &folder)
        {
            tracing::warn!(
                hash,
                error = &error as &dyn std::error::Error,
                "checkpoints could not be downloaded; recomputing the stages"
            );
        }
        File::open(&folder)?.set_modified(SystemTime::now())?;
        Ok(folder)
    }

    /// Downloads logs that are longer than the local ones. Logs only grow: the longer one is the
    /// later.
    fn download_logs(&self, objects: &Objects, hash: &str, folder: &Utf8Path) -> io::Result<()> {
        for StoredLog { name, bytes, .. } in objects.block_on(objects.logs(hash))? {
            let here = folder.join(&name);
            if fs::metadata(&here).is_ok_and(|log| log.len() >= bytes) {
                continue;
            }
            let unfinished = self.scratch()?;
            let file = unfinished.path().join("log");
            objects.block_on(objects.get_log(hash, &name, &file))?;
            fs::rename(file, here)?;
        }
        Ok(())
    }

    /// Uploads the logs of a content as stages finish, as long as the result lives.
    #[must_use]
    pub fn upload_stages(&self, hash: &str) -> CheckpointUpload {
        let Some(shared) = &self.shared else { return CheckpointUpload(None) };
        let following = CheckpointSync {
            objects: shared.objects.clone(),
            hash: hash.to_owned(),
            folder: self.checkpoints(hash),
        };
        let looking = tokio::spawn({
            let following = following.clone();
            async move {
                let mut put = HashMap::new();
                loop {
                    sleep(POLL_INTERVAL).await;
                    following.upload_finished(&mut put).await;
                }
            }
        });
        CheckpointUpload(Some((looking, following)))
    }

    /// Copies the checkpoints of one content to another one that has grown from it.
    ///
    /// # Errors
    /// Errors of the file system.
    pub fn copy_checkpoints(&self, from: &str, to: &str) -> io::Result<()> {
        // Copying does not count as a use of the old checkpoints.
        let (from_folder, to_folder) = (self.checkpoints(from), self.open_checkpoints(to)?);
        if self.shared.is_some() {
            self.open_checkpoints(from)?;
        }
        if !from_folder.is_dir() {
            return Ok(());
        }
        for entry in from_folder.read_dir_utf8()? {
            let entry = entry?;
            if !entry.file_type()?.is_file() {
                continue;
            }
            // Logs are appended to, so each content needs its own copy.
            fs::copy(entry.path(), to_folder.join(entry.file_name()))?;
        }
        Ok(())
    }

    /// Returns all stored checkpoints, here or in the object store, least recently used first.
    ///
    /// # Errors
    /// Errors of the file system; the object store cannot be used.
    pub fn list_checkpoints(&self) -> io::Result<Vec<StoredCheckpoints>> {
        let mut kept: BTreeMap<String, StoredCheckpoints> = BTreeMap::new();
        let mut count = |hash: String, bytes: u64, used: SystemTime| {
            let known = kept.entry(hash.clone()).or_insert(StoredCheckpoints { hash, bytes, used });
            (known.bytes, known.used) = (known.bytes.max(bytes), known.used.max(used));
        };
        for hash in self.names("checkpoints")? {
            let (bytes, used) = super::aging::measure(&self.checkpoints(&hash))?;
            count(hash, bytes, used);
        }
        if let Some(shared) = &self.shared {
            let stored = shared.objects.block_on(shared.objects.folders("checkpoints"))?;
            stored.into_iter().for_each(|(hash, found)| count(hash, found.bytes, found.newest()));
        }
        let mut kept: Vec<StoredCheckpoints> = kept.into_values().collect();
        kept.sort_by(|a, b| a.used.cmp(&b.used).then_with(|| a.hash.cmp(&b.hash)));
        Ok(kept)
    }
}

impl CheckpointSync {
    /// Uploads logs that have stopped growing, or have grown by a quarter. In total that uploads
    /// little more than the logs' final size.
    async fn upload_finished(&self, put: &mut HashMap<String, u64>) {
        let Ok(logs) = self.list_local_logs().await else { return };
        for (name, bytes, changed) in logs {
            let before = put.get(&name).copied().unwrap_or(0);
            let is_at_rest = changed.elapsed().unwrap_or_default() >= STAGE_IDLE_TIME;
            if bytes > before
                && (is_at_rest || bytes - before > before / 4)
                && self.upload_log(&name).await
            {
                put.insert(name, bytes);
            }
        }
    }

    /// Uploads what is missing, and removes logs that belong to other settings.
    async fn upload_rest(&self) {
        let (Ok(here), Ok(there)) =
            (self.list_local_logs().await, self.objects.logs(&self.hash).await)
        else {
            tracing::warn!(
                hash = self.hash,
                "checkpoints could not be uploaded; they stay on this machine"
            );
            return;
        };
        let stored: HashMap<&str, u64> =
            there.iter().map(|log| (log.name.as_str(), log.bytes)).collect();
        for (name, bytes, _) in
            here.iter().filter(|(name, bytes, _)| stored.get(name.as_str()) != Some(bytes))
        {
            tracing::debug!(
                hash = self.hash,
                name,
                bytes,
                "uploading a checkpoint to the object store"
            );
            self.upload_log(name).await;
        }
        for log in there.iter().filter(|log| here.iter().all(|(name, ..)| *name != log.name)) {
            if let Err(error) = self.objects.remove_log(&self.hash, &log.name).await {
                tracing::debug!(
                    error = &error as &dyn std::error::Error,
                    "checkpoint of other settings could not be removed"
                );
            }
        }
    }

    /// Uploads one log. Returns whether that succeeded.
    async fn upload_log(&self, name: &str) -> bool {
        let put = self.objects.put_log(&self.hash, name, &self.folder.join(name)).await;
        let log_failed_upload = |error: &io::Error| {
            let error = error as &dyn std::error::Error;
            tracing::warn!(
                hash = self.hash,
                name,
                error,
                "checkpoint could not be uploaded; it stays on this machine"
            );
        };
        put.inspect_err(log_failed_upload).is_ok()
    }

    /// Returns name, bytes and last change of every log.
    async fn list_local_logs(&self) -> io::Result<Vec<(String, u64, SystemTime)>> {
        let folder = self.folder.clone();
        let logs = spawn_blocking(move || {
            let logs = folder.read_dir_utf8()?.map(|entry| {
                let entry = entry?;
                let log = entry.metadata()?;
                Ok((entry.file_name().to_owned(), log.len(), log.modified()?))
            });
            logs.collect::<io::Result<Vec<_>>>()
        });
        logs.await?
    }
}
