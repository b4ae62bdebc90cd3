//! Read-only access to a data folder: the database is copied elsewhere, files are only read.

use super::blobs::Blobs;
use super::cluster::{ClusterMembership, LEASE, StoreAccess};
use super::data_folder::DataFolder;
use super::database::{Connections, Location};
use super::{Store, StoreError};
use camino::{Utf8Path, Utf8PathBuf};
use std::sync::Arc;
use std::{fs, io};
use tempfile::TempDir;
use tokio::task::spawn_blocking;

/// Suffixes of the files of a database that no process has open.
const FILES_OF_DATABASE: [&str; 2] = ["", "-wal"];

impl Store {
    /// Opens a copy of the database over the folder's own files. Changes to this store never reach
    /// the folder: rows are removed from the copy, and files are left alone.
    ///
    /// # Errors
    /// [`StoreError`]: a server uses the folder, or it is no data folder.
    ///
    /// Only SQLite databases can be copied this way.
    pub async fn open_copy(data_dir: &Utf8Path) -> Result<Self, StoreError> {
        let path = data_dir.to_owned();
        let copied = spawn_blocking(move || {
            let folder = DataFolder::open_read_only(&path)?;
            let elsewhere = tempfile::tempdir()?;
            let database = Utf8PathBuf::try_from(elsewhere.path().join("copy.sqlite"))
                .map_err(io::Error::other)?;
            for part in FILES_OF_DATABASE {
                match fs::copy(format!("{}{part}", folder.database()), format!("{database}{part}"))
                {
                    Err(error) if error.kind() != io::ErrorKind::NotFound => {
                        return Err(error.into());
                    }
                    _ => {}
                }
            }
            Ok::<_, StoreError>((folder, elsewhere, database))
        });
        let (folder, elsewhere, database) = copied.await.map_err(io::Error::other)??;
        let members =
            ClusterMembership::join(&Location::Folder, StoreAccess::Exclusive, LEASE).await?;
        let store = Self::connect(
            Connections::open_file(&database).await?,
            None,
            folder,
            Blobs::open_read_only(data_dir)?,
            members,
        )
        .await?;
        Ok(Self { _copy: Some(Arc::<TempDir>::new(elsewhere)), ..store })
    }
}
