//! Checkpoints: finished work of a parse, stored so that the next attempt does not repeat it.
//!
//! One append-only log per stage, named by a hash of everything the stage depends on. A cancelled
//! parse continues where it stopped, and a parse with other merging settings starts from the lifted
//! masks. Losing a log costs time, never a result: what cannot be read is computed again, and what
//! cannot be written is logged as a warning.

use camino::{Utf8Path, Utf8PathBuf};
use serde::Serialize;
use serde::de::DeserializeOwned;
use sha2::{Digest, Sha256};
use std::fs::{self, File, OpenOptions};
use std::io::{self, BufReader, Read, Write};
use std::marker::PhantomData;

/// Location of the logs of one scan, if they are stored at all.
#[derive(Debug, Clone, Default)]
pub struct Checkpoints {
    location: Option<CheckpointLocation>,
}

#[derive(Debug, Clone)]
struct CheckpointLocation {
    folder: Utf8PathBuf,
    /// Inputs of every stage: the scan, how it was imported, the version of the code.
    origin: String,
}

impl Checkpoints {
    /// Stores no checkpoints.
    #[must_use]
    pub fn disabled() -> Self {
        Self::default()
    }

    /// Stores logs in `folder`, which must exist. They are valid for this `origin` only. Once the
    /// folder has been deleted, nothing more is stored.
    #[must_use]
    pub fn in_folder(folder: &Utf8Path, origin: &str) -> Self {
        Self {
            location: Some(CheckpointLocation {
                folder: folder.to_owned(),
                origin: origin.to_owned(),
            }),
        }
    }

    /// Returns the folder of the logs, if they are stored. It is on the disk that has room for what
    /// a parse needs.
    #[must_use]
    pub fn folder(&self) -> Option<&Utf8Path> {
        self.location.as_ref().map(|location| location.folder.as_path())
    }

    /// Returns checkpoints at the same location for stages that depend on more than the original
    /// scan.
    #[must_use]
    pub fn with_dependency(&self, more: &str) -> Self {
        let location = self.location.as_ref();
        Self {
            location: location.map(|at| CheckpointLocation {
                folder: at.folder.clone(),
                origin: format!("{}{more}", at.origin),
            }),
        }
    }

    /// Opens the log of a stage that depends on these settings. Removes logs of the same stage with
    /// other settings.
    pub fn open_log<T: Serialize + DeserializeOwned>(
        &self,
        stage: &str,
        depends_on: &impl Serialize,
    ) -> StageLog<T> {
        let Some(CheckpointLocation { folder, origin }) = &self.location else {
            return StageLog::disabled();
        };
        let opened = key(origin, depends_on).and_then(|key| StageLog::open(folder, stage, &key));
        opened.unwrap_or_else(|error| {
            tracing::warn!(%folder, stage, %error, "checkpoint could not be opened; this stage is not saved");
            StageLog::disabled()
        })
    }

    /// Returns the result of a stage: loaded from its checkpoint, or computed and stored. The flag
    /// is `true` when it was loaded.
    ///
    /// # Errors
    /// Errors of `compute`.
    pub fn load_or_compute<T: Serialize + DeserializeOwned, E>(
        &self,
        stage: &str,
        depends_on: &impl Serialize,
        compute: impl FnOnce() -> Result<T, E>,
    ) -> Result<(T, bool), E> {
        let mut log = self.open_log(stage, depends_on);
        if let Some(kept) = log.take_records().pop() {
            return Ok((kept, true));
        }
        let result = compute()?;
        log.append(&result);
        Ok((result, false))
    }
}

fn key(origin: &str, depends_on: &impl Serialize) -> io::Result<String> {
    let mut hasher = Sha256::new();
    hasher.update(origin);
    hasher.update(serde_json::to_vec(depends_on)?);
    Ok(hasher.finalize().iter().take(8).map(|byte| format!("{byte:02x}")).collect())
}

/// The records of one stage in the order they were written.
pub struct StageLog<T> {
    file: Option<File>,
    kept: Vec<T>,
    /// End offset of each stored record in the file.
    ends: Vec<u64>,
    records: PhantomData<T>,
}

impl<T: Serialize + DeserializeOwned> StageLog<T> {
    fn disabled() -> Self {
        Self { file: None, kept: Vec::new(), ends: Vec::new(), records: PhantomData }
    }

    fn open(folder: &Utf8Path, stage: &str, key: &str) -> io::Result<Self> {
        let name = format!("{stage}-{key}.log");
        for entry in folder.read_dir_utf8()? {
            let entry = entry?;
            if entry.file_name().starts_with(&format!("{stage}-")) && entry.file_name() != name {
                fs::remove_file(entry.path())?;
            }
        }
        let file =
            OpenOptions::new().read(true).append(true).create(true).open(folder.join(name))?;
        let (kept, ends) = read_records(&file);
        // Truncates a record that a crash left half written.
        file.set_len(ends.last().copied().unwrap_or(0))?;
        Ok(Self { file: Some(file), kept, ends, records: PhantomData })
    }

    /// Takes the records of earlier attempts; a second call returns none.
    pub fn take_records(&mut self) -> Vec<T> {
        std::mem::take(&mut self.kept)
    }

    /// Drops all records after the first `count`, because only those match the current work.
    pub fn truncate_after(&mut self, count: usize) {
        let Some(file) = &self.file else { return };
        if count < self.ends.len() {
            let end = count.checked_sub(1).map_or(0, |last| self.ends[last]);
            self.ends.truncate(count);
            if let Err(error) = file.set_len(end) {
                tracing::warn!(%error, "checkpoint could not be written; stage is no longer saved");
                self.file = None;
            }
        }
    }

    /// Appends a finished record to the file. On failure, logs a warning and stores nothing more.
    pub fn append(&mut self, record: &T) {
        let Some(file) = &mut self.file else { return };
        let written = postcard::to_stdvec(record).map_err(io::Error::other).and_then(|bytes| {
            let mut framed = Vec::with_capacity(HEADER + bytes.len());
            framed.extend((bytes.len() as u64).to_le_bytes());
            framed.extend(crc32fast::hash(&bytes).to_le_bytes());
            framed.extend(bytes);
            file.write_all(&framed)
        });
        if let Err(error) = written {
            tracing::warn!(%error, "checkpoint could not be saved");
            self.file = None;
        }
    }
}

/// Size of the header before each record: length and CRC-32.
const HEADER: usize = 12;

/// Reads all complete records from the start, with the end offset of each.
fn read_records<T: DeserializeOwned>(file: &File) -> (Vec<T>, Vec<u64>) {
    let mut reader = BufReader::new(file);
    let (mut records, mut ends, mut end) = (Vec::new(), Vec::new(), 0);
    while let Some((record, length)) = read_record(&mut reader) {
        end += length;
        records.push(record);
        ends.push(end);
    }
    (records, ends)
}

fn read_record<T: DeserializeOwned>(reader: &mut impl Read) -> Option<(T, u64)> {
    let mut header = [0; HEADER];
    reader.read_exact(&mut header).ok()?;
    let length = u64::from_le_bytes(header[..8].try_into().ok()?);
    let crc = u32::from_le_bytes(header[8..].try_into().ok()?);
    let mut bytes = Vec::new();
    // Reads what exists instead of allocating by the stored length.
    reader.take(length).read_to_end(&mut bytes).ok()?;
    (bytes.len() as u64 == length && crc32fast::hash(&bytes) == crc).then_some(())?;
    Some((postcard::from_bytes(&bytes).ok()?, HEADER as u64 + length))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn records_are_loaded_only_for_the_same_settings() {
        let folder = tempfile::tempdir().unwrap();
        let path = Utf8Path::from_path(folder.path()).unwrap();
        let checkpoints = Checkpoints::in_folder(path, "scan");
        let mut log = checkpoints.open_log::<(u32, String)>("stage", &("settings", 1));
        assert!(log.take_records().is_empty());
        log.append(&(1, "one".into()));
        log.append(&(2, "two".into()));
        let same = checkpoints.open_log::<(u32, String)>("stage", &("settings", 1)).take_records();
        assert_eq!(same, [(1, "one".to_owned()), (2, "two".to_owned())]);
        assert!(
            Checkpoints::in_folder(path, "other")
                .open_log::<(u32, String)>("stage", &("settings", 1))
                .take_records()
                .is_empty()
        );
        assert!(
            checkpoints
                .open_log::<(u32, String)>("stage", &("settings", 2))
                .take_records()
                .is_empty()
        );
        assert_eq!(fs::read_dir(path).unwrap().count(), 1, "one log per stage");
    }

    #[test]
    fn incomplete_records_are_truncated() {
        let folder = tempfile::tempdir().unwrap();
        let path = Utf8Path::from_path(folder.path()).unwrap();
        let checkpoints = Checkpoints::in_folder(path, "scan");
        let mut log = checkpoints.open_log::<Vec<u32>>("stage", &0);
        log.append(&vec![7; 100]);
        log.append(&vec![8; 100]);
        let file = path.read_dir_utf8().unwrap().next().unwrap().unwrap().into_path();
        let whole = fs::read(&file).unwrap();
        for damaged in
            [whole[..whole.len() - 1].to_vec(), [&whole[..whole.len() - 50], &[0; 50]].concat()]
        {
            fs::write(&file, damaged).unwrap();
            let mut log = checkpoints.open_log::<Vec<u32>>("stage", &0);
            assert_eq!(log.take_records(), [vec![7; 100]]);
            log.append(&vec![9; 3]);
            assert_eq!(
                checkpoints.open_log::<Vec<u32>>("stage", &0).take_records(),
                [vec![7; 100], vec![9; 3]]
            );
        }
    }

    #[test]
    fn unwritable_folder_means_recomputation_without_errors() {
        let checkpoints = Checkpoints::in_folder(Utf8Path::new("/proc/no/such/place"), "scan");
        let first = checkpoints.load_or_compute("stage", &0, || Ok::<_, ()>(1));
        assert_eq!(
            (first, checkpoints.load_or_compute("stage", &0, || Ok::<_, ()>(2))),
            (Ok((1, false)), Ok((2, false)))
        );
    }
}
