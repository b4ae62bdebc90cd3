//! Copies files from one data folder to another, one published folder at a time.

use super::{MigrationError, MigrationProgress, MigrationStep, OnProgress};
use crate::backup::{CopyFailure, copy_folder};
use crate::blobs::checksums::{SUMS, check_folder, list_files};
use crate::blobs::{Blobs, CheckDepth, DamagedFile, KINDS, Scratch, remove_tree, size_of};
use camino::{Utf8Path, Utf8PathBuf};
use std::collections::BTreeSet;
use std::fs::{self, File};
use std::io;

/// Folders whose files grow in place. They are never hard-linked: two servers would share one file.
const GROWING: &str = "checkpoints";
/// Files of resumable uploads, which are no folders.
const UPLOADS: &str = "uploads";

/// Migrated folders of one kind.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct MigratedFiles {
    pub kind: &'static str,
    /// For uploads, the number of files.
    pub folders: u64,
    pub bytes: u64,
    /// Bytes that were written anew, contained in `bytes`. The rest is hard-linked, or was there
    /// from an earlier attempt.
    pub copied_bytes: u64,
}

/// Folder, and what is wrong with it.
type DamagedFolders = Vec<(String, String)>;

/// Copies all files that the target lacks. Removes files of an earlier attempt that the source does
/// not have any more.
pub fn move_files(
    from: &Blobs,
    to: &Blobs,
    on_progress: &OnProgress,
) -> Result<(Vec<MigratedFiles>, DamagedFolders), MigrationError> {
    let (mut kinds, mut damaged) = (Vec::new(), DamagedFolders::new());
    for kind in KINDS {
        let names: BTreeSet<String> = from.names(kind)?.into_iter().collect();
        for name in to.names(kind)?.iter().filter(|name| !names.contains(*name)) {
            remove_tree(&to.folder_path(kind, name), to.tmp())?;
        }
        let mut moved = MigratedFiles { kind, folders: 0, bytes: 0, copied_bytes: 0 };
        let of = names.len() as u64;
        on_progress(MigrationProgress { part: MigrationStep::Files(kind), done: 0, of });
        for name in names {
            let (source, place) = (from.folder_path(kind, &name), to.folder_path(kind, &name));
            let file_error = |error| MigrationError::File { file: source.clone(), source: error };
            moved.copied_bytes +=
                move_folder(kind, &source, &place, to, &mut damaged).map_err(file_error)?;
            moved.bytes += size_of(&place).map_err(file_error)?;
            moved.folders += 1;
            on_progress(MigrationProgress {
                part: MigrationStep::Files(kind),
                done: moved.folders,
                of,
            });
        }
        kinds.push(moved);
    }
    kinds.push(move_uploads(from, to, on_progress)?);
    Ok((kinds, damaged))
}

/// Copies one folder. Returns the bytes that were written.
fn move_folder(
    kind: &str,
    source: &Utf8Path,
    place: &Utf8Path,
    to: &Blobs,
    damaged: &mut DamagedFolders,
) -> io::Result<u64> {
    let (scratch, copied) = match link_folder(kind, source, to, damaged)? {
        Some(scratch) => (scratch, 0),
        None if kind != GROWING && is_same(source, place)? => return Ok(0),
        None => copy_and_report_damage(kind, source, to, damaged)?,
    };
    remove_tree(place, to.tmp())?;
    // Keep the original time, so that retention counts from it.
    File::open(scratch.path())?.set_modified(fs::metadata(source)?.modified()?)?;
    fs::rename(scratch.path(), place)?;
    Ok(copied)
}

/// Returns whether a folder was copied earlier, by comparing every byte.
fn is_same(source: &Utf8Path, place: &Utf8Path) -> io::Result<bool> {
    match (fs::read(source.join(SUMS)), fs::read(place.join(SUMS))) {
        (Ok(own), Ok(sums)) if own == sums => {
            Ok(check_folder(place, CheckDepth::Bytes)?.is_empty())
        }
        _ => Ok(false),
    }
}

/// Hard-links the files of a folder. Returns `None` where the disk does not support that, or the
/// target is on another disk.
fn link_folder(
    kind: &str,
    source: &Utf8Path,
    to: &Blobs,
    damaged: &mut DamagedFolders,
) -> io::Result<Option<Scratch>> {
    if kind == GROWING {
        return Ok(None);
    }
    let scratch = to.scratch()?;
    for file in all_files(source)? {
        let place = scratch.path().join(&file);
        fs::create_dir_all(place.parent().unwrap_or(scratch.path()))?;
        if fs::hard_link(source.join(&file), place).is_err() {
            return Ok(None);
        }
    }
    let missing = check_folder(source, CheckDepth::Names)?;
    damaged.extend(
        missing
            .into_iter()
            .map(|DamagedFile { file, what }| (name_of(source), format!("{file} {what}"))),
    );
    Ok(Some(scratch))
}

/// Copies a folder and checks every file on the way. Returns the bytes. Damaged files are copied as
/// they are, and reported.
fn copy_and_report_damage(
    kind: &str,
    source: &Utf8Path,
    to: &Blobs,
    damaged: &mut DamagedFolders,
) -> io::Result<(Scratch, u64)> {
    let mut scratch = to.scratch()?;
    let copied = match kind {
        GROWING => copy_unverified(source, scratch.path()).map_err(CopyFailure::NotWritten),
        _ => copy_folder(source, scratch.path()).map(drop),
    };
    match copied {
        Ok(()) => {}
        Err(CopyFailure::NotWritten(error)) => return Err(error),
        Err(CopyFailure::Missing) => return Err(io::ErrorKind::NotFound.into()),
        Err(CopyFailure::Damaged(what)) => {
            damaged.push((name_of(source), what));
            scratch = to.scratch()?;
            copy_unverified(source, scratch.path())?;
        }
    }
    let bytes = size_of(scratch.path())?;
    Ok((scratch, bytes))
}

fn copy_unverified(source: &Utf8Path, to: &Utf8Path) -> io::Result<()> {
    for file in all_files(source)? {
        let (own, place) = (source.join(&file), to.join(&file));
        fs::create_dir_all(place.parent().unwrap_or(to))?;
        fs::copy(&own, &place)?;
        File::open(place)?.set_modified(fs::metadata(own)?.modified()?)?;
    }
    Ok(())
}

/// Returns all files below a folder, including the list of checksums.
fn all_files(folder: &Utf8Path) -> io::Result<Vec<Utf8PathBuf>> {
    let mut files = list_files(folder)?;
    files.extend(folder.join(SUMS).exists().then(|| SUMS.into()));
    Ok(files)
}

/// Returns kind and name of a folder.
fn name_of(folder: &Utf8Path) -> String {
    let kind = folder.parent().and_then(Utf8Path::file_name).unwrap_or_default();
    format!("blobs/{kind}/{}", folder.file_name().unwrap_or_default())
}

/// Copies unfinished uploads. They grow, so each side needs its own copy.
fn move_uploads(
    from: &Blobs,
    to: &Blobs,
    on_progress: &OnProgress,
) -> Result<MigratedFiles, MigrationError> {
    for gone in to.all_uploads()? {
        fs::remove_file(to.upload(&gone))?;
    }
    let uploads = from.all_uploads()?;
    let of = uploads.len() as u64;
    let mut moved = MigratedFiles { kind: UPLOADS, folders: 0, bytes: 0, copied_bytes: 0 };
    on_progress(MigrationProgress { part: MigrationStep::Files(UPLOADS), done: 0, of });
    for id in uploads {
        let file = from.upload(&id);
        let bytes = fs::copy(&file, to.upload(&id))
            .map_err(|source| MigrationError::File { file, source })?;
        moved = MigratedFiles {
            folders: moved.folders + 1,
            bytes: moved.bytes + bytes,
            copied_bytes: moved.copied_bytes + bytes,
            ..moved
        };
        on_progress(MigrationProgress {
            part: MigrationStep::Files(UPLOADS),
            done: moved.folders,
            of,
        });
    }
    Ok(moved)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::blobs::{BlobHome, FileAccess};
    use std::sync::Arc;
    use std::time::{Duration, SystemTime};

    /// Creates two data folders. The first has a published parse, checkpoints of a scan, and an
    /// unfinished upload.
    fn folders() -> (tempfile::TempDir, Blobs, Blobs) {
        let root = tempfile::tempdir().unwrap();
        let [from, to] = ["old", "new"].map(|name| {
            Blobs::open(
                &Utf8Path::from_path(root.path()).unwrap().join(name),
                &BlobHome::Folder,
                FileAccess::ReadWrite,
            )
            .unwrap()
        });
        let scratch = from.scratch().unwrap();
        fs::create_dir(scratch.path().join("views")).unwrap();
        fs::write(scratch.path().join("cloud.ply"), "points").unwrap();
        fs::write(scratch.path().join("views/1.jpg"), "picture").unwrap();
        from.publish(scratch, &from.parse("p")).unwrap();
        fs::write(from.open_checkpoints("c").unwrap().join("stage.log"), "finished").unwrap();
        fs::write(from.upload("u"), "half").unwrap();
        let long_ago = SystemTime::now() - Duration::from_hours(99);
        for place in
            [from.parse("p"), from.checkpoints("c"), from.checkpoints("c").join("stage.log")]
        {
            File::open(place).unwrap().set_modified(long_ago).unwrap();
        }
        (root, from, to)
    }

    fn run_file_migration(from: &Blobs, to: &Blobs) -> (Vec<MigratedFiles>, DamagedFolders) {
        let on_progress: OnProgress = Arc::new(|_| {});
        let (kinds, damaged) = move_files(from, to, &on_progress).unwrap();
        (kinds.into_iter().filter(|kind| kind.folders > 0).collect(), damaged)
    }

    fn text(file: Utf8PathBuf) -> String {
        fs::read_to_string(file).unwrap()
    }

    #[test]
    fn unchanging_files_are_hard_linked_and_growing_ones_copied() {
        let (_root, from, to) = folders();
        let (kinds, damaged) = run_file_migration(&from, &to);
        let reported: Vec<_> =
            kinds.iter().map(|kind| (kind.kind, kind.folders, kind.copied_bytes)).collect();
        assert_eq!(reported, [("parses", 1, 0), ("checkpoints", 1, 8), ("uploads", 1, 4)]);
        assert_eq!(damaged, []);
        assert!(to.check_folder(&to.parse("p"), CheckDepth::Bytes).unwrap().is_empty());
        // Changes at the source do not affect the copies.
        for log in [from.checkpoints("c").join("stage.log"), from.upload("u")] {
            fs::write(log, "more").unwrap();
        }
        assert_eq!(
            (text(to.checkpoints("c").join("stage.log")), text(to.upload("u"))),
            ("finished".into(), "half".into())
        );
        // Migration keeps modification times.
        assert!(
            to.list_folders_older_than("parses", Duration::from_hours(98), SystemTime::now())
                .unwrap()
                == ["p"]
        );
        assert!(
            to.list_checkpoints().unwrap()[0].used.elapsed().unwrap() > Duration::from_hours(98)
        );
    }

    #[test]
    fn a_second_run_completes_the_first() {
        let (_root, from, to) = folders();
        run_file_migration(&from, &to);
        // Folders that the source does not have, and an incomplete folder at the target.
        fs::create_dir(to.parse("gone")).unwrap();
        fs::write(to.upload("gone"), "x").unwrap();
        fs::remove_file(to.parse("p").join("views/1.jpg")).unwrap();
        fs::write(from.upload("u"), "all of it").unwrap();
        run_file_migration(&from, &to);
        assert_eq!(
            (to.names("parses").unwrap(), to.all_uploads().unwrap()),
            (vec!["p".to_owned()], vec!["u".to_owned()])
        );
        assert_eq!(
            (text(to.parse("p").join("views/1.jpg")), text(to.upload("u"))),
            ("picture".into(), "all of it".into())
        );
    }

    /// Copying (to another disk) checks every file against its checksum, and copies damaged files
    /// unchanged.
    #[test]
    fn damaged_files_are_copied_and_reported() {
        let (_root, from, to) = folders();
        let (source, place) = (from.parse("p"), to.parse("p"));
        let mut damaged = DamagedFolders::new();
        let (scratch, bytes) =
            copy_and_report_damage("parses", &source, &to, &mut damaged).unwrap();
        fs::rename(scratch.path(), &place).unwrap();
        assert_eq!(
            (bytes, size_of(&place).unwrap(), damaged.len()),
            (size_of(&source).unwrap(), bytes, 0)
        );
        assert!(is_same(&source, &place).unwrap());
        fs::write(place.join("cloud.ply"), "pointz").unwrap();
        assert!(!is_same(&source, &place).unwrap());
        fs::write(source.join("cloud.ply"), "pointz").unwrap();
        let (scratch, _) = copy_and_report_damage("parses", &source, &to, &mut damaged).unwrap();
        assert_eq!(text(scratch.path().join("cloud.ply")), "pointz");
        assert_eq!(damaged, [("blobs/parses/p".to_owned(), "cloud.ply damaged".to_owned())]);
        fs::remove_file(source.join("cloud.ply")).unwrap();
        let (_, damaged) = run_file_migration(&from, &to);
        assert_eq!(damaged, [("blobs/parses/p".to_owned(), "cloud.ply missing".to_owned())]);
    }
}
