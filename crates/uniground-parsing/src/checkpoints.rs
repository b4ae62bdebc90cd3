//! Work of a parse that is done, kept so that the next attempt does not repeat it.
//!
//! One append-only log per stage, named by a hash of everything the stage depends on: a parse that
//! was cancelled goes on where it stopped, and one with other merging settings starts from the
//! lifted masks. Losing a log costs time, never a result: whatever can not be read is computed
//! again, and whatever can not be written is a line in the server's log.

use camino::{Utf8Path, Utf8PathBuf};
use serde::Serialize;
use serde::de::DeserializeOwned;
use sha2::{Digest, Sha256};
use std::fs::{self, File, OpenOptions};
use std::io::{self, BufReader, Read, Write};
use std::marker::PhantomData;

/// Where the logs of one scan lie, if anywhere.
#[derive(Debug, Clone, Default)]
pub struct Checkpoints {
    location: Option<CheckpointLocation>,
}

#[derive(Debug, Clone)]
struct CheckpointLocation {
    folder: Utf8PathBuf,
    /// What every stage depends on: the scan, how it was imported, the version of the code.
    origin: String,
}

impl Checkpoints {
    /// Nothing is kept.
    #[must_use]
    pub fn none() -> Self {
        Self::default()
    }

    /// Logs in `folder`, which exists; valid for this `origin` only. Once the folder is gone
    /// nothing more is kept.
    #[must_use]
    pub fn kept_in(folder: &Utf8Path, origin: &str) -> Self {
        Self {
            location: Some(CheckpointLocation {
                folder: folder.to_owned(),
                origin: origin.to_owned(),
            }),
        }
    }

    /// Where logs are kept, if anywhere: on the disk that has room for what a parse needs.
    #[must_use]
    pub fn folder(&self) -> Option<&Utf8Path> {
        self.location.as_ref().map(|location| location.folder.as_path())
    }

    /// The same place for what depends on more than the scan it began with.
    #[must_use]
    pub fn depending_on(&self, more: &str) -> Self {
        let location = self.location.as_ref();
        Self {
            location: location.map(|at| CheckpointLocation {
                folder: at.folder.clone(),
                origin: format!("{}{more}", at.origin),
            }),
        }
    }

    /// The log of a stage that depends on these settings. Logs of the stage under other settings
    /// are removed.
    pub fn log<T: Serialize + DeserializeOwned>(
        &self,
        stage: &str,
        depends_on: &impl Serialize,
    ) -> StageLog<T> {
        let Some(CheckpointLocation { folder, origin }) = &self.location else {
            return StageLog::nowhere();
        };
        let opened = key(origin, depends_on).and_then(|key| StageLog::open(folder, stage, &key));
        opened.unwrap_or_else(|error| {
            tracing::warn!(%folder, stage, %error, "checkpoint could not be opened; this stage is not saved");
            StageLog::nowhere()
        })
    }

    /// The result of a stage: kept from before, or computed and kept. The flag tells which: `true`
    /// = kept.
    ///
    /// # Errors
    /// Those of `compute`.
    pub fn once<T: Serialize + DeserializeOwned, E>(
        &self,
        stage: &str,
        depends_on: &impl Serialize,
        compute: impl FnOnce() -> Result<T, E>,
    ) -> Result<(T, bool), E> {
        let mut log = self.log(stage, depends_on);
        if let Some(kept) = log.kept().pop() {
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

/// Records of one stage in the order they were made.
pub struct StageLog<T> {
    file: Option<File>,
    kept: Vec<T>,
    /// Where each kept record ends in the file.
    ends: Vec<u64>,
    records: PhantomData<T>,
}

impl<T: Serialize + DeserializeOwned> StageLog<T> {
    fn nowhere() -> Self {
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
        // What a crash left half written is cut off.
        file.set_len(ends.last().copied().unwrap_or(0))?;
        Ok(Self { file: Some(file), kept, ends, records: PhantomData })
    }

    /// The records of earlier attempts; a second call has none.
    pub fn kept(&mut self) -> Vec<T> {
        std::mem::take(&mut self.kept)
    }

    /// Forgets all records after the first `count`, the only ones that fit the work at hand.
    pub fn forget_after(&mut self, count: usize) {
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

    /// Adds a finished record to the file. When that fails, a warning is logged and nothing more is
    /// kept.
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

/// Length and CRC-32 of a record, before its bytes.
const HEADER: usize = 12;

/// All whole records from the start, and where each ends.
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
    // Read what is there rather than believe the length.
    reader.take(length).read_to_end(&mut bytes).ok()?;
    (bytes.len() as u64 == length && crc32fast::hash(&bytes) == crc).then_some(())?;
    Some((postcard::from_bytes(&bytes).ok()?, HEADER as u64 + length))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn records_are_kept_for_the_same_settings_only() {
        let folder = tempfile::tempdir().unwrap();
        let path = Utf8Path::from_path(folder.path()).unwrap();
        let checkpoints = Checkpoints::kept_in(path, "scan");
        let mut log = checkpoints.log::<(u32, String)>("stage", &("settings", 1));
        assert!(log.kept().is_empty());
        log.append(&(1, "one".into()));
        log.append(&(2, "two".into()));
        let same = checkpoints.log::<(u32, String)>("stage", &("settings", 1)).kept();
        assert_eq!(same, [(1, "one".to_owned()), (2, "two".to_owned())]);
        assert!(
            Checkpoints::kept_in(path, "other")
                .log::<(u32, String)>("stage", &("settings", 1))
                .kept()
                .is_empty()
        );
        assert!(checkpoints.log::<(u32, String)>("stage", &("settings", 2)).kept().is_empty());
        assert_eq!(fs::read_dir(path).unwrap().count(), 1, "one log a stage");
    }

    #[test]
    fn what_a_crash_left_half_written_is_cut_off() {
        let folder = tempfile::tempdir().unwrap();
        let path = Utf8Path::from_path(folder.path()).unwrap();
        let checkpoints = Checkpoints::kept_in(path, "scan");
        let mut log = checkpoints.log::<Vec<u32>>("stage", &0);
        log.append(&vec![7; 100]);
        log.append(&vec![8; 100]);
        let file = path.read_dir_utf8().unwrap().next().unwrap().unwrap().into_path();
        let whole = fs::read(&file).unwrap();
        for damaged in
            [whole[..whole.len() - 1].to_vec(), [&whole[..whole.len() - 50], &[0; 50]].concat()]
        {
            fs::write(&file, damaged).unwrap();
            let mut log = checkpoints.log::<Vec<u32>>("stage", &0);
            assert_eq!(log.kept(), [vec![7; 100]]);
            log.append(&vec![9; 3]);
            assert_eq!(checkpoints.log::<Vec<u32>>("stage", &0).kept(), [vec![7; 100], vec![9; 3]]);
        }
    }

    #[test]
    fn a_place_that_can_not_be_written_costs_only_time() {
        let checkpoints = Checkpoints::kept_in(Utf8Path::new("/proc/no/such/place"), "scan");
        let first = checkpoints.once("stage", &0, || Ok::<_, ()>(1));
        assert_eq!(
            (first, checkpoints.once("stage", &0, || Ok::<_, ()>(2))),
            (Ok((1, false)), Ok((2, false)))
        );
    }
}
