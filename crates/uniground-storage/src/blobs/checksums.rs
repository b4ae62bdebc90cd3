//! The list of a published folder's files with their SHA-256, in a file of its own, to detect lost
//! and damaged files. It has the format of `sha256sum`: `sha256sum -c .sha256sums` does the same
//! check.

use camino::{Utf8Path, Utf8PathBuf};
use sha2::{Digest, Sha256};
use std::collections::BTreeMap;
use std::fmt::Write;
use std::fs::{self, File};
use std::io::{self, Read};

pub const SUMS: &str = ".sha256sums";
/// A folder with more files is synced with the whole file system instead of file by file.
const SYNC_ONE_BY_ONE: usize = 64;

/// A file that differs from what was published.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct DamagedFile {
    /// Relative to the folder that was checked.
    pub file: Utf8PathBuf,
    /// "missing", "damaged", "stray", or why it cannot be read.
    pub what: String,
}

/// How thoroughly a folder is checked.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum CheckDepth {
    /// Checks that all files exist.
    Names,
    /// Reads every byte of every file.
    Bytes,
}

/// Known checksums by file.
pub type Sums = BTreeMap<Utf8PathBuf, String>;

/// Writes the checksums of `folder` after the line `head`, and syncs everything to disk. Files with
/// known checksums are not read again.
pub fn seal(folder: &Utf8Path, known: &Sums, head: &str) -> io::Result<()> {
    let files = list_files(folder)?;
    if files.len() <= SYNC_ONE_BY_ONE {
        fs::write(folder.join(SUMS), compute_checksums(folder, &files, known, head)?)?;
        let folders: std::collections::BTreeSet<_> = files
            .iter()
            .filter_map(|file| file.parent())
            .map(|parent| folder.join(parent))
            .collect();
        let paths =
            files.iter().map(|file| folder.join(file)).chain([folder.join(SUMS)]).chain(folders);
        return sync(folder, files.len(), paths);
    }
    // The disk writes while the checksums are computed; only the checksums themselves remain.
    let sums = std::thread::scope(|scope| {
        let synced = scope.spawn(|| sync_everything(folder));
        let sums = compute_checksums(folder, &files, known, head)?;
        synced.join().map_err(|_| io::Error::other("syncing to disk failed"))??;
        Ok::<_, io::Error>(sums)
    })?;
    fs::write(folder.join(SUMS), sums)?;
    sync_everything(folder)
}

/// Syncs files of a folder to disk: one by one, or the whole file system if there are many.
pub fn sync(
    folder: &Utf8Path,
    files: usize,
    mut paths: impl Iterator<Item = Utf8PathBuf>,
) -> io::Result<()> {
    if files > SYNC_ONE_BY_ONE {
        return sync_everything(folder);
    }
    paths.try_for_each(|path| File::open(path)?.sync_all())?;
    File::open(folder)?.sync_all()
}

fn compute_checksums(
    folder: &Utf8Path,
    files: &[Utf8PathBuf],
    known: &Sums,
    head: &str,
) -> io::Result<String> {
    let mut sums = head.to_owned();
    for file in files {
        let sum =
            known.get(file).map_or_else(|| hash_file(&folder.join(file)), |sum| Ok(sum.clone()))?;
        let _ = writeln!(sums, "{sum}  {file}");
    }
    Ok(sums)
}

#[cfg(target_os = "linux")]
pub fn sync_everything(folder: &Utf8Path) -> io::Result<()> {
    Ok(rustix::fs::syncfs(File::open(folder)?)?)
}

#[cfg(not(target_os = "linux"))]
pub fn sync_everything(_: &Utf8Path) -> io::Result<()> {
    rustix::fs::sync();
    Ok(())
}

/// Adds the files of a sealed folder to `to`, below `below`, as hard links where the disk supports
/// them. Returns their checksums.
pub fn link_files(sealed: &Utf8Path, to: &Utf8Path, below: &Utf8Path) -> io::Result<Sums> {
    for file in list_files(sealed)? {
        let (from, place) = (sealed.join(&file), to.join(below).join(&file));
        fs::create_dir_all(place.parent().unwrap_or(to))?;
        // Published files never change, so two names may share one file.
        if fs::hard_link(&from, &place).is_err() {
            fs::copy(&from, &place)?;
        }
    }
    let sums = match fs::read_to_string(sealed.join(SUMS)) {
        Err(error) if error.kind() == io::ErrorKind::NotFound => return Ok(Sums::new()),
        sums => sums?,
    };
    let sums = sums.lines().filter_map(|line| line.split_once("  "));
    Ok(sums.map(|(sum, file)| (below.join(file), sum.to_owned())).collect())
}

/// Checks a folder and returns its damaged files. A folder without checksums passes as long as it
/// exists.
pub fn check_folder(folder: &Utf8Path, closely: CheckDepth) -> io::Result<Vec<DamagedFile>> {
    let sums = match fs::read_to_string(folder.join(SUMS)) {
        Ok(sums) => sums,
        // A folder from before checksums were stored.
        Err(error) if error.kind() == io::ErrorKind::NotFound && folder.is_dir() => {
            return Ok(Vec::new());
        }
        Err(error) if error.kind() == io::ErrorKind::NotFound => {
            return Ok(vec![damaged_file("", "missing")]);
        }
        Err(error) => return Err(error),
    };
    let mut wrong = Vec::new();
    let mut known = std::collections::BTreeSet::new();
    for (sum, file) in sums.lines().filter_map(|line| line.split_once("  ")) {
        known.insert(Utf8PathBuf::from(file));
        let path = folder.join(file);
        match closely {
            CheckDepth::Names if path.is_file() => {}
            CheckDepth::Names => wrong.push(damaged_file(file, "missing")),
            CheckDepth::Bytes => match hash_file(&path) {
                Ok(found) if found == sum => {}
                Ok(_) => wrong.push(damaged_file(file, "damaged")),
                Err(error) if error.kind() == io::ErrorKind::NotFound => {
                    wrong.push(damaged_file(file, "missing"));
                }
                Err(error) => wrong.push(damaged_file(file, &error.to_string())),
            },
        }
    }
    if closely == CheckDepth::Bytes {
        let orphan_folders = list_files(folder)?.into_iter().filter(|file| !known.contains(file));
        wrong.extend(orphan_folders.map(|file| damaged_file(file.as_str(), "stray")));
    }
    Ok(wrong)
}

/// Checks one file of a folder. A file without a checksum passes.
pub fn check_file(folder: &Utf8Path, file: &Utf8Path) -> io::Result<Option<DamagedFile>> {
    let sums = match fs::read_to_string(folder.join(SUMS)) {
        Err(error) if error.kind() == io::ErrorKind::NotFound => return Ok(None),
        sums => sums?,
    };
    let Some((sum, _)) =
        sums.lines().filter_map(|line| line.split_once("  ")).find(|(_, name)| *name == file)
    else {
        return Ok(None);
    };
    Ok((hash_file(&folder.join(file))? != sum).then(|| damaged_file(file.as_str(), "damaged")))
}

/// Returns whether a folder was sealed with this file. Without a seal, returns whether the file
/// exists.
pub fn has_file(folder: &Utf8Path, file: &Utf8Path) -> io::Result<bool> {
    match fs::read_to_string(folder.join(SUMS)) {
        Err(error) if error.kind() == io::ErrorKind::NotFound => Ok(folder.join(file).is_file()),
        sums => {
            Ok(sums?.lines().filter_map(|line| line.split_once("  ")).any(|(_, name)| file == name))
        }
    }
}

fn damaged_file(file: &str, what: &str) -> DamagedFile {
    DamagedFile { file: file.into(), what: what.to_owned() }
}

/// Returns the regular files below a folder, sorted, without the list of checksums.
pub fn list_files(folder: &Utf8Path) -> io::Result<Vec<Utf8PathBuf>> {
    let (mut files, mut folders) = (Vec::new(), vec![Utf8PathBuf::new()]);
    while let Some(below) = folders.pop() {
        for entry in folder.join(&below).read_dir_utf8()? {
            let entry = entry?;
            let path = below.join(entry.file_name());
            match entry.file_type()?.is_dir() {
                true => folders.push(path),
                false if path != SUMS => files.push(path),
                false => {}
            }
        }
    }
    files.sort();
    Ok(files)
}

pub fn hash_file(file: &Utf8Path) -> io::Result<String> {
    let (mut source, mut hasher, mut buffer) =
        (File::open(file)?, Sha256::new(), vec![0; 256 << 10]);
    loop {
        let n = source.read(&mut buffer)?;
        if n == 0 {
            return Ok(hasher.finalize().iter().map(|byte| format!("{byte:02x}")).collect());
        }
        hasher.update(&buffer[..n]);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn uploads_cannot_contain_a_checksum_file() {
        assert!(uniground_ingest::is_reserved(Utf8Path::new(SUMS)));
    }
}
