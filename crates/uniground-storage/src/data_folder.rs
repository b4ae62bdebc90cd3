//! The data folder. A file marks it as a data folder, and a lock as in use.
//!
//! ```text
//! uniground-data.json    marks a data folder, and holds its id
//! uniground.sqlite       the SQLite database, which stores the same id; absent with PostgreSQL
//! reserve                a few megabytes that are released when the disk is full (`reserve`)
//! blobs/  uploads/  tmp/ see `blobs`
//! quarantine/<day>/...   orphans, kept for a while
//! uniground-moving.json  target of a data migration (`data_migration`); without a marker next to
//!                        it the migration is unfinished
//! ```

use super::database::Engine;
use super::file_lock::FileLock;
use super::{StoreError, now, reserve};
use camino::{Utf8Path, Utf8PathBuf};
use serde::{Deserialize, Serialize};
use std::fs::{self, File, TryLockError};
use std::io::{self, Write};
use std::sync::Arc;
use uuid::Uuid;

pub const MARKER: &str = "uniground-data.json";
/// Marks the target folder of a data migration.
pub const MIGRATION_MARKER: &str = "uniground-moving.json";
/// Left behind when the process is killed while it writes the marker.
const UNFINISHED_MARKER: &str = "uniground-data.json.new";
pub const DATABASE: &str = "uniground.sqlite";
pub const LOCK: &str = "lock";

#[derive(Serialize, Deserialize)]
struct Marker {
    /// Version of the layout.
    format: u32,
    id: String,
    created_at: String,
    /// The engine of the database that holds its rows.
    #[serde(default)]
    database: Engine,
}

/// A data folder that is locked as long as this lives. With SQLite the lock is exclusive: two
/// processes would take each other's jobs and files. With PostgreSQL, where processes have leases,
/// the lock is shared.
#[derive(Debug, Clone)]
pub(super) struct DataFolder {
    path: Utf8PathBuf,
    /// The id by which database and folder recognize each other.
    pub id: String,
    _lock: Option<Arc<FileLock>>,
}

impl DataFolder {
    /// Checks that a folder, if it is a data folder already, belongs to this database engine.
    ///
    /// # Errors
    /// [`StoreError::OtherDatabase`], [`StoreError::UnfinishedMigration`], or an error of the file
    /// system.
    pub fn check_engine(path: &Utf8Path, engine: Engine) -> Result<(), StoreError> {
        Self::check_complete(path)?;
        let kept_in = match fs::read(path.join(MARKER)) {
            Ok(bytes) => serde_json::from_slice::<Marker>(&bytes)?.database,
            Err(error)
                if error.kind() == io::ErrorKind::NotFound && path.join(DATABASE).exists() =>
            {
                Engine::Sqlite
            }
            Err(error) if error.kind() == io::ErrorKind::NotFound => engine,
            Err(error) => return Err(error.into()),
        };
        if kept_in == engine {
            Ok(())
        } else {
            Err(StoreError::OtherDatabase { kept_in: kept_in.name() })
        }
    }

    /// Checks that no unfinished data migration has this folder as its target.
    fn check_complete(path: &Utf8Path) -> Result<(), StoreError> {
        match path.join(MIGRATION_MARKER).exists() && !path.join(MARKER).exists() {
            true => Err(StoreError::UnfinishedMigration),
            false => Ok(()),
        }
    }

    /// Opens a data folder. Creates it in a folder that is empty or missing.
    ///
    /// # Errors
    /// [`StoreError::HoldsOtherFiles`] for a folder with other content, [`StoreError::InUse`], or an
    /// error of the file system.
    pub fn open(path: &Utf8Path, engine: Engine) -> Result<Self, StoreError> {
        fs::create_dir_all(path)?;
        let marker = path.join(MARKER);
        // Data folders from before there were markers contain a database.
        let is_ours = marker.exists() || path.join(DATABASE).exists();
        if let Some(stranger) = path
            .read_dir_utf8()?
            .filter_map(Result::ok)
            .find(|entry| !is_harmless(entry.file_name()))
            && !is_ours
        {
            return Err(StoreError::HoldsOtherFiles { found: stranger.file_name().to_owned() });
        }
        let lock = File::create(path.join(LOCK))?;
        let in_use = |error| match error {
            TryLockError::WouldBlock => StoreError::InUse,
            TryLockError::Error(error) => error.into(),
        };
        let shared = engine == Engine::Postgres;
        let is_marked = marker.exists();
        let lock = match shared && is_marked {
            true => FileLock::try_shared(lock),
            false => FileLock::try_exclusive(lock),
        }
        .map_err(in_use)?;
        // Written under the lock, so that two concurrent starts write one marker.
        let id = match fs::read(&marker) {
            Ok(bytes) => serde_json::from_slice::<Marker>(&bytes)?.id,
            Err(error) if error.kind() == io::ErrorKind::NotFound => {
                let id = Uuid::new_v4().to_string();
                write_marker(path, &id, engine)?;
                id
            }
            Err(error) => return Err(error.into()),
        };
        if shared && !is_marked {
            lock.share().map_err(in_use)?;
        }
        let folder = Self { path: path.to_owned(), id, _lock: Some(Arc::new(lock)) };
        match reserve::write(path) {
            Ok(true) => {}
            Ok(false) => tracing::warn!(
                "disk nearly full: no space for the reserve file; deleting on a full disk may fail"
            ),
            Err(error) => {
                tracing::warn!(%error, "reserve file could not be written; deleting on a full disk may fail");
            }
        }
        Ok(folder)
    }

    /// Locks a data folder that no server uses and whose database is SQLite. Writes nothing.
    ///
    /// # Errors
    /// [`StoreError::NoDataFolder`], [`StoreError::InUse`], [`StoreError::RequiresSqlite`], or an
    /// error of the file system.
    pub fn open_read_only(path: &Utf8Path) -> Result<Self, StoreError> {
        let (id, engine) = Self::read_identity(path)?;
        if engine != Engine::Sqlite {
            return Err(StoreError::RequiresSqlite { kept_in: engine.name() });
        }
        let lock = match File::open(path.join(LOCK)) {
            Ok(lock) => Some(lock),
            Err(error) if error.kind() == io::ErrorKind::NotFound => None,
            Err(error) => return Err(error.into()),
        };
        match lock.map(FileLock::try_exclusive).transpose() {
            Ok(lock) => Ok(Self { path: path.to_owned(), id, _lock: lock.map(Arc::new) }),
            Err(TryLockError::WouldBlock) => Err(StoreError::InUse),
            Err(TryLockError::Error(error)) => Err(error.into()),
        }
    }

    /// Returns id and database engine of a data folder, without locking it. Returns a new id for a
    /// folder from before folders had ids.
    pub fn read_identity(path: &Utf8Path) -> Result<(String, Engine), StoreError> {
        Self::check_complete(path)?;
        match fs::read(path.join(MARKER)) {
            Ok(bytes) => {
                let Marker { id, database, .. } = serde_json::from_slice(&bytes)?;
                match database {
                    Engine::Sqlite if !path.join(DATABASE).is_file() => {
                        Err(StoreError::NoDataFolder { folder: path.to_owned() })
                    }
                    _ => Ok((id, database)),
                }
            }
            Err(error)
                if error.kind() == io::ErrorKind::NotFound && path.join(DATABASE).is_file() =>
            {
                Ok((Uuid::new_v4().to_string(), Engine::Sqlite))
            }
            Err(error) if error.kind() == io::ErrorKind::NotFound => {
                Err(StoreError::NoDataFolder { folder: path.to_owned() })
            }
            Err(error) => Err(error.into()),
        }
    }

    pub fn database(&self) -> Utf8PathBuf {
        self.path.join(DATABASE)
    }

    pub fn path(&self) -> &Utf8Path {
        &self.path
    }

    /// Returns the free disk space, bytes.
    pub fn free_bytes(&self) -> io::Result<u64> {
        reserve::free_bytes(&self.path)
    }

    /// Reads the marker, to check that the folder still exists and is readable.
    pub fn check_marker(&self) -> io::Result<()> {
        fs::read(self.path.join(MARKER)).map(drop)
    }
}

/// Marks a folder as a data folder with this id.
pub(super) fn write_marker(folder: &Utf8Path, id: &str, database: Engine) -> io::Result<()> {
    let text = serde_json::to_vec_pretty(&Marker {
        format: 1,
        id: id.to_owned(),
        created_at: now(),
        database,
    })?;
    write_synced(&folder.join(MARKER), &text)
}

/// Files that a system or an earlier start puts into otherwise empty folders.
pub(super) fn is_harmless(name: &str) -> bool {
    name == "lost+found" || name == LOCK || name == UNFINISHED_MARKER || name.starts_with('.')
}

/// Writes a file atomically: to a temporary name first, then renamed, both synced to disk.
pub(super) fn write_synced(path: &Utf8Path, content: &[u8]) -> io::Result<()> {
    let unfinished = Utf8PathBuf::from(format!("{path}.new"));
    let mut file = File::create(&unfinished)?;
    file.write_all(content)?;
    file.sync_all()?;
    fs::rename(&unfinished, path)?;
    sync_folder(path.parent().unwrap_or(path))
}

/// Syncs the entries of a folder to disk.
pub(super) fn sync_folder(folder: &Utf8Path) -> io::Result<()> {
    File::open(folder)?.sync_all()
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::sync::Barrier;
    use std::thread;

    /// Two processes open a new folder at the same time: one fails with "in use", and the marker has
    /// the id that the other one got.
    #[test]
    fn two_concurrent_opens_write_one_marker() {
        for _ in 0..20 {
            let place = tempfile::tempdir().unwrap();
            let path = Utf8Path::from_path(place.path()).unwrap().join("data");
            let (begin, end) = (Barrier::new(2), Barrier::new(2));
            let opened = thread::scope(|scope| {
                let open = || {
                    begin.wait();
                    let opened = DataFolder::open(&path, Engine::Sqlite);
                    end.wait();
                    opened.map(|folder| folder.id)
                };
                let both = [scope.spawn(open), scope.spawn(open)];
                both.map(|one| one.join().unwrap())
            });
            let ids: Vec<&String> = opened.iter().flatten().collect();
            let marker: Marker =
                serde_json::from_slice(&fs::read(path.join(MARKER)).unwrap()).unwrap();
            assert_eq!(ids, [&marker.id], "{opened:?}");
            assert!(
                opened
                    .iter()
                    .filter_map(|one| one.as_ref().err())
                    .all(|error| matches!(error, StoreError::InUse)),
                "{opened:?}"
            );
        }
    }

    #[test]
    fn an_unfinished_marker_does_not_prevent_opening_but_other_files_do() {
        let place = tempfile::tempdir().unwrap();
        let path = Utf8Path::from_path(place.path()).unwrap();
        fs::write(path.join(UNFINISHED_MARKER), "{").unwrap();
        assert!(DataFolder::open(path, Engine::Sqlite).is_ok());
        let other = tempfile::tempdir().unwrap();
        let other = Utf8Path::from_path(other.path()).unwrap();
        fs::write(other.join("thesis.txt"), "words").unwrap();
        assert!(matches!(
            DataFolder::open(other, Engine::Sqlite),
            Err(StoreError::HoldsOtherFiles { .. })
        ));
    }
}
