//! The target folder of a migration, while it is incomplete.

use super::MigrationError;
use crate::StoreError;
use crate::blobs::checksums::sync_everything;
use crate::blobs::{BlobHome, Blobs, FileAccess};
use crate::data_folder::{
    DATABASE, LOCK, MARKER, MIGRATION_MARKER, is_harmless, write_marker, write_synced,
};
use crate::database::Engine;
use crate::file_lock::FileLock;
use camino::{Utf8Path, Utf8PathBuf};
use jiff::Timestamp;
use serde::{Deserialize, Serialize};
use std::fs::{self, File, TryLockError};
use std::io;
use std::sync::Arc;
use std::time::Duration;
use uuid::Uuid;

/// Suffixes of the files of a SQLite database.
const PARTS_OF_DATABASE: [&str; 3] = ["", "-wal", "-shm"];

/// Marks a folder as the target of an unfinished migration.
#[derive(Serialize, Deserialize)]
struct TargetMarker {
    /// The folder's future id. It identifies the database that was started for the folder.
    id: String,
}

#[derive(Clone)]
pub struct TargetFolder {
    path: Utf8PathBuf,
    /// Its future id.
    pub id: String,
    engine: Engine,
    /// The engine of its rows before, if the folder is not new.
    engine_before: Option<Engine>,
    /// The lock of a new folder. For an existing folder its store holds the lock.
    _lock: Option<Arc<FileLock>>,
}

impl TargetFolder {
    /// Opens a folder that is empty, missing, or the target of an unfinished migration. Nothing is
    /// written before [`begin`](Self::begin).
    pub fn open(path: Utf8PathBuf, engine: Engine) -> Result<Self, MigrationError> {
        let not_used = |source: io::Error| MigrationError::To {
            place: path.to_string(),
            source: source.into(),
        };
        fs::create_dir_all(&path).map_err(not_used)?;
        let begun = read_note(&path)?;
        let stranger = path
            .read_dir_utf8()?
            .filter_map(Result::ok)
            .find(|entry| !is_harmless(entry.file_name()));
        if let Some(stranger) = stranger
            && (begun.is_none() || path.join(MARKER).exists())
        {
            return Err(MigrationError::NotEmpty {
                found: stranger.file_name().to_owned(),
                place: path.to_string(),
            });
        }
        let lock = File::create(path.join(LOCK)).map_err(not_used)?;
        let lock = match FileLock::try_exclusive(lock) {
            Ok(lock) => lock,
            Err(TryLockError::WouldBlock) => {
                return Err(MigrationError::To {
                    place: path.to_string(),
                    source: StoreError::InUse,
                });
            }
            Err(TryLockError::Error(error)) => return Err(not_used(error)),
        };
        let id = begun.unwrap_or_else(new_id);
        Ok(Self { path, id, engine, engine_before: None, _lock: Some(Arc::new(lock)) })
    }

    /// Prepares an in-place migration of an open data folder. The folder gets another id with its
    /// other database, so that no two databases have the same id.
    pub fn in_place(
        path: Utf8PathBuf,
        id_before: &str,
        engine_before: Engine,
        engine: Engine,
    ) -> Result<Self, MigrationError> {
        // A note with the folder's own id was left by a migration that finished, but was killed
        // before removing it.
        let id = read_note(&path)?.filter(|id| id != id_before).unwrap_or_else(new_id);
        Ok(Self { path, id, engine, engine_before: Some(engine_before), _lock: None })
    }

    /// Gives the target another id: another database may have been started under the previous one,
    /// and must not become part of this folder.
    pub fn renew_id(&mut self) {
        self.id = new_id();
    }

    /// Writes the note of an unfinished migration, and removes what an earlier attempt left half
    /// done.
    pub fn begin(&self) -> Result<(), MigrationError> {
        let note = serde_json::to_vec_pretty(&TargetMarker { id: self.id.clone() })
            .map_err(StoreError::from)?;
        write_synced(&self.path.join(MIGRATION_MARKER), &note)?;
        drop(self.blobs()?.list_leftovers(Duration::ZERO)?);
        Ok(())
    }

    pub fn blobs(&self) -> Result<Blobs, StoreError> {
        Blobs::open(&self.path, &BlobHome::Folder, FileAccess::ReadWrite)
    }

    /// Returns the path of an unfinished SQLite database. No server opens this path.
    pub fn unfinished_database(&self) -> Utf8PathBuf {
        self.path.join("tmp").join(DATABASE)
    }

    /// Turns the target into a data folder, now that everything is there. Returns the new name of a
    /// database file that is not used any more. If it is interrupted, the folder is a data folder
    /// already, or the migration can be repeated.
    pub fn complete(self) -> Result<Option<Utf8PathBuf>, MigrationError> {
        sync_everything(&self.path)?;
        let mut aside = None;
        if self.engine == Engine::Sqlite {
            // A file that an earlier migration left in the folder whose rows are still elsewhere.
            if self.engine_before.is_some() {
                aside = set_aside(&self.path)?;
            }
            fs::rename(self.unfinished_database(), self.path.join(DATABASE))?;
        }
        write_marker(&self.path, &self.id, self.engine)?;
        if self.engine_before == Some(Engine::Sqlite) {
            aside = set_aside(&self.path)?;
        }
        fs::remove_file(self.path.join(MIGRATION_MARKER))?;
        Ok(aside)
    }
}

fn new_id() -> String {
    Uuid::new_v4().to_string()
}

/// Returns the future id of a folder, if a migration to it is unfinished.
fn read_note(folder: &Utf8Path) -> Result<Option<String>, MigrationError> {
    match fs::read(folder.join(MIGRATION_MARKER)) {
        Ok(bytes) => {
            Ok(Some(serde_json::from_slice::<TargetMarker>(&bytes).map_err(StoreError::from)?.id))
        }
        Err(error) if error.kind() == io::ErrorKind::NotFound => Ok(None),
        Err(source) => Err(MigrationError::File { file: folder.join(MIGRATION_MARKER), source }),
    }
}

/// Renames a database file, if there is one, so that no server finds it.
fn set_aside(folder: &Utf8Path) -> io::Result<Option<Utf8PathBuf>> {
    let (database, mut aside) = (folder.join(DATABASE), None);
    let name = folder
        .join(format!("uniground-until-{}.sqlite", Timestamp::now().strftime("%Y%m%dT%H%M%S%.fZ")));
    for part in PARTS_OF_DATABASE {
        match fs::rename(format!("{database}{part}"), format!("{name}{part}")) {
            Err(error) if error.kind() == io::ErrorKind::NotFound => {}
            moved => {
                moved?;
                aside = Some(name.clone());
            }
        }
    }
    Ok(aside)
}
