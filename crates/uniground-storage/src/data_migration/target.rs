//! The folder that a store is moved to, as long as not all of it is there.

use super::MigrationError;
use crate::StoreError;
use crate::blobs::checksums::sync_everything;
use crate::blobs::{BlobHome, Blobs, FileAccess};
use crate::data_folder::{DATABASE, LOCK, MARKER, MOVING, is_harmless, mark, write_synced};
use crate::database::Engine;
use camino::{Utf8Path, Utf8PathBuf};
use jiff::Timestamp;
use serde::{Deserialize, Serialize};
use std::fs::{self, File, TryLockError};
use std::io;
use std::sync::Arc;
use std::time::Duration;
use uuid::Uuid;

/// What SQLite may lay beside its file.
const PARTS_OF_DATABASE: [&str; 3] = ["", "-wal", "-shm"];

/// Says of a folder that something is being moved to it.
#[derive(Serialize, Deserialize)]
struct TargetMarker {
    /// What the folder's id will be; by it a database is known that was begun for it.
    id: String,
}

#[derive(Clone)]
pub struct TargetFolder {
    path: Utf8PathBuf,
    /// What its id will be.
    pub id: String,
    engine: Engine,
    /// Where its rows were before, if it is not new.
    engine_before: Option<Engine>,
    /// One that is not new is held by its store.
    _lock: Option<Arc<File>>,
}

impl TargetFolder {
    /// A folder that is empty or not there, or has been begun before. It is as empty as it was
    /// until something [begins](Self::begin).
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
        match lock.try_lock() {
            Ok(()) => {}
            Err(TryLockError::WouldBlock) => {
                return Err(MigrationError::To {
                    place: path.to_string(),
                    source: StoreError::InUse,
                });
            }
            Err(TryLockError::Error(error)) => return Err(not_used(error)),
        }
        let id = begun.unwrap_or_else(new_id);
        Ok(Self { path, id, engine, engine_before: None, _lock: Some(Arc::new(lock)) })
    }

    /// A data folder that is open and stays; it gets another id with its other database, so that no
    /// two databases have the same one.
    pub fn in_place(
        path: Utf8PathBuf,
        id_before: &str,
        engine_before: Engine,
        engine: Engine,
    ) -> Result<Self, MigrationError> {
        // A note of its own id is what a move that came to its end was killed before removing.
        let id = read_note(&path)?.filter(|id| id != id_before).unwrap_or_else(new_id);
        Ok(Self { path, id, engine, engine_before: Some(engine_before), _lock: None })
    }

    /// Gives it another id: under the one it was to have another database may have been begun, and
    /// that must not become its own.
    pub fn renew_id(&mut self) {
        self.id = new_id();
    }

    /// Notes that something is on its way here, and makes room for it: what an earlier try has left
    /// half done goes.
    pub fn begin(&self) -> Result<(), MigrationError> {
        let note = serde_json::to_vec_pretty(&TargetMarker { id: self.id.clone() })
            .map_err(StoreError::from)?;
        write_synced(&self.path.join(MOVING), &note)?;
        drop(self.blobs()?.left_behind(Duration::ZERO)?);
        Ok(())
    }

    pub fn blobs(&self) -> Result<Blobs, StoreError> {
        Blobs::open(&self.path, &BlobHome::Folder, FileAccess::Used)
    }

    /// Where a database is written that is a file: out of every server's sight.
    pub fn unfinished_database(&self) -> Utf8PathBuf {
        self.path.join("tmp").join(DATABASE)
    }

    /// Makes a data folder of it, now that everything is there; the name of a database's file that
    /// is not used any more. What is interrupted here is a data folder, or can be moved once
    /// more.
    pub fn settle(self) -> Result<Option<Utf8PathBuf>, MigrationError> {
        sync_everything(&self.path)?;
        let mut aside = None;
        if self.engine == Engine::Sqlite {
            // What an earlier move has left to where the rows still are.
            if self.engine_before.is_some() {
                aside = set_aside(&self.path)?;
            }
            fs::rename(self.unfinished_database(), self.path.join(DATABASE))?;
        }
        mark(&self.path, &self.id, self.engine)?;
        if self.engine_before == Some(Engine::Sqlite) {
            aside = set_aside(&self.path)?;
        }
        fs::remove_file(self.path.join(MOVING))?;
        Ok(aside)
    }
}

fn new_id() -> String {
    Uuid::new_v4().to_string()
}

/// The id that was meant for a folder, where something was on its way to it.
fn read_note(folder: &Utf8Path) -> Result<Option<String>, MigrationError> {
    match fs::read(folder.join(MOVING)) {
        Ok(bytes) => {
            Ok(Some(serde_json::from_slice::<TargetMarker>(&bytes).map_err(StoreError::from)?.id))
        }
        Err(error) if error.kind() == io::ErrorKind::NotFound => Ok(None),
        Err(source) => Err(MigrationError::File { file: folder.join(MOVING), source }),
    }
}

/// Gives a database's file, if there is one, a name under which nobody looks for it.
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
