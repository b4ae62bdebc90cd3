//! Disk usage of files, by kind. Measured in small steps, since there may be very many files.

use super::{Blobs, KINDS};
use camino::{Utf8Path, Utf8PathBuf};
use std::collections::{BTreeMap, HashMap};
use std::hash::{DefaultHasher, Hash, Hasher};
use std::io;
use std::time::Duration;
use tokio::task::spawn_blocking;
use tokio::time::sleep;

/// Folders measured in one step, and the pause between two.
const STEP: usize = 64;
const PAUSE: Duration = Duration::from_millis(5);
/// The kind of folder that changes after it was written. The others stay as published.
const CHANGING: &str = "checkpoints";
/// Folders next to `blobs/` that hold files.
const OTHER_FOLDERS: [&str; 3] = ["uploads", "tmp", "quarantine"];

/// Sizes of folders measured before, by a hash of kind and name.
#[derive(Debug, Default)]
pub struct FolderSizes(HashMap<u64, u64>);

impl Blobs {
    /// Returns the bytes of all files, by kind. Reuses earlier measurements of folders that never
    /// change.
    ///
    /// # Errors
    /// Errors of the file system. A folder that disappears meanwhile is no error.
    pub async fn sizes(
        &self,
        measured: &mut FolderSizes,
    ) -> io::Result<BTreeMap<&'static str, u64>> {
        let (mut sizes, mut known) = (BTreeMap::new(), HashMap::new());
        for kind in KINDS {
            let blobs = self.clone();
            let names = spawn_blocking(move || blobs.names(kind)).await??;
            let mut total = 0;
            let mut unknown = Vec::new();
            for name in names {
                let key = key(kind, &name);
                match measured.0.get(&key).filter(|_| kind != CHANGING) {
                    Some(bytes) => {
                        total += bytes;
                        known.insert(key, *bytes);
                    }
                    None => unknown.push((key, self.folder_path(kind, &name))),
                }
            }
            let mut unknown = unknown.into_iter().peekable();
            while unknown.peek().is_some() {
                let step: Vec<(u64, Utf8PathBuf)> = unknown.by_ref().take(STEP).collect();
                let sizes = spawn_blocking(move || {
                    let sizes =
                        step.into_iter().map(|(key, folder)| Ok((key, bytes_below(&folder)?)));
                    sizes.collect::<io::Result<Vec<_>>>()
                });
                for (key, bytes) in sizes.await?? {
                    total += bytes;
                    known.insert(key, bytes);
                }
                sleep(PAUSE).await;
            }
            sizes.insert(kind, total);
        }
        for (kind, folder) in OTHER_FOLDERS.map(|kind| (kind, self.root.with_file_name(kind))) {
            sizes.insert(kind, spawn_blocking(move || bytes_below(&folder)).await??);
        }
        measured.0 = known;
        Ok(sizes)
    }
}

fn key(kind: &str, name: &str) -> u64 {
    let mut hasher = DefaultHasher::new();
    (kind, name).hash(&mut hasher);
    hasher.finish()
}

/// Returns the bytes of all files below a folder. Missing files count as 0; links are not followed.
fn bytes_below(folder: &Utf8Path) -> io::Result<u64> {
    let gone = |error: &io::Error| error.kind() == io::ErrorKind::NotFound;
    let (mut folders, mut bytes) = (vec![folder.to_owned()], 0);
    while let Some(folder) = folders.pop() {
        let entries = match folder.read_dir_utf8() {
            Err(error) if gone(&error) => continue,
            entries => entries?,
        };
        for entry in entries {
            let entry = entry?;
            match entry.metadata() {
                Err(error) if gone(&error) => {}
                Err(error) => return Err(error),
                Ok(found) if found.is_dir() => folders.push(entry.into_path()),
                Ok(found) => bytes += found.len(),
            }
        }
    }
    Ok(bytes)
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::fs;

    #[tokio::test]
    async fn sizes_are_updated_when_files_change() {
        let data = tempfile::tempdir().unwrap();
        let blobs = Blobs::open(
            Utf8Path::from_path(data.path()).unwrap(),
            &super::super::BlobHome::Folder,
            super::super::FileAccess::ReadWrite,
        )
        .unwrap();
        for i in 0..STEP + 3 {
            let parse = blobs.parse(&i.to_string());
            fs::create_dir_all(parse.join("views")).unwrap();
            fs::write(parse.join("views/1.jpg"), [0; 10]).unwrap();
        }
        fs::create_dir(blobs.checkpoints("c")).unwrap();
        fs::write(blobs.checkpoints("c").join("log"), [0; 7]).unwrap();
        let mut measured = FolderSizes::default();
        let sizes = blobs.sizes(&mut measured).await.unwrap();
        assert_eq!(
            (sizes["parses"], sizes["checkpoints"], sizes["contents"], sizes["tmp"]),
            (670, 7, 0, 0)
        );
        fs::write(blobs.checkpoints("c").join("log"), [0; 9]).unwrap();
        fs::remove_dir_all(blobs.parse("0")).unwrap();
        let sizes = blobs.sizes(&mut measured).await.unwrap();
        assert_eq!((sizes["parses"], sizes["checkpoints"], sizes["quarantine"]), (660, 9, 0));
    }
}
