//! Finished stages of parses: in the data folder while a parse runs, and in the object store for
//! whoever goes on with it elsewhere. Advice only: without them, or with half of one, it is
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

/// How often logs are looked at while a parse runs.
const LOOK_EVERY: Duration = Duration::from_secs(5);
/// A log that has not grown for so long belongs to a stage that is finished, or slow.
const AT_REST: Duration = Duration::from_secs(10);
/// What the end of a parse waits for its logs.
const PATIENCE: Duration = Duration::from_secs(30);

/// Logs of a content that are put into the object store while they grow.
#[derive(Debug)]
pub struct CheckpointUpload(Option<(JoinHandle<()>, CheckpointSync)>);

#[derive(Debug, Clone)]
struct CheckpointSync {
    objects: Objects,
    hash: String,
    folder: Utf8PathBuf,
}

impl CheckpointUpload {
    /// Puts what they have come to.
    pub async fn finish(mut self) {
        let Some((looking, following)) = self.0.take() else { return };
        looking.abort();
        if timeout(PATIENCE, following.put_rest()).await.is_err() {
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
    /// The folder for finished stages of a content, made where there is none, and in use from now
    /// on; with what the object store has of them.
    ///
    /// # Errors
    /// Those of the file system.
    pub fn use_checkpoints(&self, hash: &str) -> io::Result<Utf8PathBuf> {
        let folder = self.checkpoints(hash);
        fs::create_dir_all(&folder)?;
        if let Some(shared) = &self.shared
            && let Err(error) = self.bring_logs(&shared.objects, hash, &folder)
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

    /// Logs only grow: the longer one is the later.
    fn bring_logs(&self, objects: &Objects, hash: &str, folder: &Utf8Path) -> io::Result<()> {
        for StoredLog { name, bytes, .. } in objects.wait(objects.logs(hash))? {
            let here = folder.join(&name);
            if fs::metadata(&here).is_ok_and(|log| log.len() >= bytes) {
                continue;
            }
            let unfinished = self.scratch()?;
            let file = unfinished.path().join("log");
            objects.wait(objects.get_log(hash, &name, &file))?;
            fs::rename(file, here)?;
        }
        Ok(())
    }

    /// Puts the logs of a content into the object store as stages are finished, as long as what is
    /// returned lives.
    #[must_use]
    pub fn keep_stages(&self, hash: &str) -> CheckpointUpload {
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
                    sleep(LOOK_EVERY).await;
                    following.put_finished(&mut put).await;
                }
            }
        });
        CheckpointUpload(Some((looking, following)))
    }

    /// Finished stages of one content are those of another that has grown from it.
    ///
    /// # Errors
    /// Those of the file system.
    pub fn inherit_checkpoints(&self, from: &str, to: &str) -> io::Result<()> {
        // Those of before are not in use again.
        let (from_folder, to_folder) = (self.checkpoints(from), self.use_checkpoints(to)?);
        if self.shared.is_some() {
            self.use_checkpoints(from)?;
        }
        if !from_folder.is_dir() {
            return Ok(());
        }
        for entry in from_folder.read_dir_utf8()? {
            let entry = entry?;
            if !entry.file_type()?.is_file() {
                continue;
            }
            // Logs are appended to: each content has its own.
            fs::copy(entry.path(), to_folder.join(entry.file_name()))?;
        }
        Ok(())
    }

    /// All finished stages that are kept, here or in the object store, those first that were not
    /// used for longest.
    ///
    /// # Errors
    /// Those of the file system; that the object store can not be used.
    pub fn kept_checkpoints(&self) -> io::Result<Vec<StoredCheckpoints>> {
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
            let stored = shared.objects.wait(shared.objects.folders("checkpoints"))?;
            stored.into_iter().for_each(|(hash, found)| count(hash, found.bytes, found.newest()));
        }
        let mut kept: Vec<StoredCheckpoints> = kept.into_values().collect();
        kept.sort_by(|a, b| a.used.cmp(&b.used).then_with(|| a.hash.cmp(&b.hash)));
        Ok(kept)
    }
}

impl CheckpointSync {
    /// Puts logs that have come to rest, or have grown by a quarter: all in all little more than
    /// once.
    async fn put_finished(&self, put: &mut HashMap<String, u64>) {
        let Ok(logs) = self.logs_here().await else { return };
        for (name, bytes, changed) in logs {
            let before = put.get(&name).copied().unwrap_or(0);
            let is_at_rest = changed.elapsed().unwrap_or_default() >= AT_REST;
            if bytes > before
                && (is_at_rest || bytes - before > before / 4)
                && self.put(&name).await
            {
                put.insert(name, bytes);
            }
        }
    }

    /// Puts what is not there yet, and removes what is of other settings by now.
    async fn put_rest(&self) {
        let (Ok(here), Ok(there)) = (self.logs_here().await, self.objects.logs(&self.hash).await)
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
            self.put(name).await;
        }
        for log in there.iter().filter(|log| here.iter().all(|(name, ..)| *name != log.name)) {
            if let Err(error) = self.objects.remove_log(&self.hash, &log.name).await {
                tracing::debug!(
                    error = &error as &dyn std::error::Error,
                    "checkpoint of other settings kept"
                );
            }
        }
    }

    /// Whether a log could be put.
    async fn put(&self, name: &str) -> bool {
        let put = self.objects.put_log(&self.hash, name, &self.folder.join(name)).await;
        let told = |error: &io::Error| {
            let error = error as &dyn std::error::Error;
            tracing::warn!(
                hash = self.hash,
                name,
                error,
                "checkpoint could not be uploaded; it stays on this machine"
            );
        };
        put.inspect_err(told).is_ok()
    }

    /// Name, bytes and last change of every log.
    async fn logs_here(&self) -> io::Result<Vec<(String, u64, SystemTime)>> {
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
