//! Age and size of files that have a retention time.

use super::Blobs;
use camino::Utf8Path;
use std::time::{Duration, SystemTime};
use std::{fs, io};

/// The finished stages of a content, and when a parse last used them.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct StoredCheckpoints {
    pub hash: String,
    pub bytes: u64,
    pub used: SystemTime,
}

impl Blobs {
    /// Returns the names of published folders of a kind that are older than `age`.
    ///
    /// # Errors
    /// Errors of the file system; the object store cannot be used.
    pub fn list_folders_older_than(
        &self,
        kind: &'static str,
        age: Duration,
        now: SystemTime,
    ) -> io::Result<Vec<String>> {
        let is_old = |made: SystemTime| now.duration_since(made).unwrap_or_default() > age;
        if let Some(shared) = &self.shared {
            let found = shared.objects.block_on(shared.objects.folders(kind))?;
            return Ok(found
                .into_iter()
                .filter(|(_, found)| found.sealed.is_some_and(is_old))
                .map(|(name, _)| name)
                .collect());
        }
        let mut old = Vec::new();
        for name in self.names(kind)? {
            match fs::metadata(self.folder_path(kind, &name)).and_then(|folder| folder.modified()) {
                Ok(made) if is_old(made) => old.push(name),
                Ok(_) => {}
                // Another process removed it.
                Err(error) if error.kind() == io::ErrorKind::NotFound => {}
                Err(error) => return Err(error),
            }
        }
        Ok(old)
    }
}

/// Returns the bytes of a file, or of all files below a folder. A missing path has 0 bytes.
///
/// # Errors
/// Errors of the file system.
pub fn size_of(path: &Utf8Path) -> io::Result<u64> {
    Ok(measure(path)?.0)
}

/// Returns the bytes below a folder, and the time of the latest change there. Ignores files that
/// are removed meanwhile.
pub(super) fn measure(path: &Utf8Path) -> io::Result<(u64, SystemTime)> {
    let (mut bytes, mut changed, mut left) = (0, SystemTime::UNIX_EPOCH, vec![path.to_owned()]);
    while let Some(path) = left.pop() {
        let looked = fs::symlink_metadata(&path).and_then(|entry| {
            changed = changed.max(entry.modified()?);
            if !entry.is_dir() {
                bytes += entry.len();
                return Ok(());
            }
            for within in path.read_dir_utf8()? {
                left.push(within?.into_path());
            }
            Ok(())
        });
        match looked {
            Err(error) if error.kind() != io::ErrorKind::NotFound => return Err(error),
            _ => {}
        }
    }
    Ok((bytes, changed))
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::fs::File;

    const DAY: Duration = Duration::from_hours(24);

    fn open_blobs(data: &tempfile::TempDir) -> Blobs {
        Blobs::open(
            Utf8Path::from_path(data.path()).unwrap(),
            &super::super::BlobHome::Folder,
            super::super::FileAccess::ReadWrite,
        )
        .unwrap()
    }

    #[test]
    fn folder_age_counts_from_the_last_change() {
        let data = tempfile::tempdir().unwrap();
        let blobs = open_blobs(&data);
        for id in ["a", "b"] {
            fs::create_dir(blobs.answer(id)).unwrap();
        }
        let now = SystemTime::now();
        File::open(blobs.answer("b")).unwrap().set_modified(now - DAY * 3).unwrap();
        assert_eq!(blobs.list_folders_older_than("answers", DAY, now).unwrap(), ["b"]);
        let mut all = blobs.list_folders_older_than("answers", DAY, now + DAY * 2).unwrap();
        all.sort();
        assert_eq!(all, ["a", "b"]);
    }

    /// Opening a log updates its time; starting a parse updates the time of the folder.
    #[test]
    fn checkpoints_are_listed_by_last_use() {
        let data = tempfile::tempdir().unwrap();
        let (blobs, now) = (open_blobs(&data), SystemTime::now());
        for (hash, days) in [("first", 9), ("second", 5), ("third", 7)] {
            let folder = blobs.open_checkpoints(hash).unwrap();
            fs::write(folder.join("stage.log"), "four").unwrap();
            File::open(folder.join("stage.log")).unwrap().set_modified(now - DAY * 10).unwrap();
            File::open(folder).unwrap().set_modified(now - DAY * days).unwrap();
        }
        let order = || {
            blobs
                .list_checkpoints()
                .unwrap()
                .into_iter()
                .map(|kept| (kept.hash, kept.bytes))
                .collect::<Vec<_>>()
        };
        assert_eq!(
            order(),
            [("first", 4), ("third", 4), ("second", 4)]
                .map(|(hash, bytes)| (hash.to_owned(), bytes))
        );
        blobs.open_checkpoints("first").unwrap();
        assert_eq!(order()[2].0, "first");
    }
}
