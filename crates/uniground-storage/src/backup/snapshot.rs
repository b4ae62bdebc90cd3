//! A snapshot of the database, in a file of its own.

use super::{BackupError, FolderKey, KINDS};
use crate::blobs::Blobs;
use crate::{StoreError, now, reserve};
use camino::{Utf8Path, Utf8PathBuf};
use sqlx::sqlite::{SqliteConnectOptions, SqliteConnection};
use sqlx::{Connection, Executor};
use std::time::Duration;
use std::{fs, io};

/// Timeout for locks that a server holds.
const BUSY_TIMEOUT: Duration = Duration::from_secs(30);
/// Names looked up in one query.
const CHUNK: usize = 500;

pub struct Snapshot {
    pub file: Utf8PathBuf,
    pub taken_at: String,
    /// Its last migration.
    pub schema: i64,
    /// The folder it belongs to; `None` for databases from before folders had ids.
    pub data_folder: Option<String>,
    pub scenes: u64,
    pub answers: u64,
}

impl Snapshot {
    /// Takes a snapshot, also while a server reads and writes.
    pub async fn take(database: &Utf8Path, file: Utf8PathBuf) -> Result<Self, BackupError> {
        match fs::remove_file(&file) {
            Err(error) if error.kind() != io::ErrorKind::NotFound => return Err(error.into()),
            _ => {}
        }
        let mut source = open_source(database).await?;
        let taken_at = now();
        sqlx::query("VACUUM INTO ?").bind(file.as_str()).execute(&mut source).await?;
        source.close().await?;
        let mut copy = SqliteConnection::connect_with(&read_only(&file)).await?;
        let schema: i64 = sqlx::query_scalar("SELECT max(version) FROM _sqlx_migrations")
            .fetch_one(&mut copy)
            .await?;
        let knows_folder: i64 =
            sqlx::query_scalar("SELECT count(*) FROM sqlite_schema WHERE name = 'data_folder'")
                .fetch_one(&mut copy)
                .await?;
        let data_folder = match knows_folder {
            0 => None,
            _ => sqlx::query_scalar("SELECT id FROM data_folder").fetch_optional(&mut copy).await?,
        };
        let scenes: i64 =
            sqlx::query_scalar("SELECT count(*) FROM scenes").fetch_one(&mut copy).await?;
        let answers: i64 =
            sqlx::query_scalar("SELECT count(*) FROM answers").fetch_one(&mut copy).await?;
        copy.close().await?;
        Ok(Self {
            file,
            taken_at,
            schema,
            data_folder,
            scenes: scenes as u64,
            answers: answers as u64,
        })
    }

    /// Returns the folders it refers to. Folders of answers are included only if they exist.
    pub async fn folders(&self, source: &Blobs) -> Result<Vec<FolderKey>, BackupError> {
        let [contents, parses, answers] = KINDS;
        let mut copy = SqliteConnection::connect_with(&read_only(&self.file)).await?;
        let mut folders = Vec::new();
        for (kind, sql) in [
            (contents, "SELECT hash FROM contents ORDER BY hash"),
            (parses, "SELECT id FROM parses ORDER BY id"),
        ] {
            let names: Vec<String> = sqlx::query_scalar(sql).fetch_all(&mut copy).await?;
            folders.extend(names.into_iter().map(|name| (kind, name)));
        }
        for names in source.names(answers)?.chunks(CHUNK) {
            let sql =
                "SELECT id FROM answers WHERE id IN (SELECT value FROM json_each(?)) ORDER BY id";
            let names = serde_json::to_string(names).map_err(StoreError::from)?;
            let known: Vec<String> =
                sqlx::query_scalar(sql).bind(names).fetch_all(&mut copy).await?;
            folders.extend(known.into_iter().map(|name| (answers, name)));
        }
        copy.close().await?;
        Ok(folders)
    }
}

/// Stores the id of a restored folder in its database, as if the folder had always had that id.
pub async fn rename_folder(database: &Utf8Path, id: &str) -> Result<(), BackupError> {
    let options = SqliteConnectOptions::new().filename(database);
    let mut connection = SqliteConnection::connect_with(&options).await?;
    let tables: i64 =
        sqlx::query_scalar("SELECT count(*) FROM sqlite_schema WHERE name = 'data_folder'")
            .fetch_one(&mut connection)
            .await?;
    if tables > 0 {
        connection.execute(sqlx::query("UPDATE data_folder SET id = ?").bind(id)).await?;
    }
    connection.close().await?;
    Ok(())
}

/// Opens the database to copy. SQLite's files next to it need disk space; on a full disk the
/// reserve provides it, if no server runs.
async fn open_source(database: &Utf8Path) -> Result<SqliteConnection, StoreError> {
    match try_to_open_source(database).await {
        Err(error) if reserve::make_room_to_open(database.parent().unwrap_or(database), &error) => {
            try_to_open_source(database).await
        }
        opened => opened,
    }
}

async fn try_to_open_source(database: &Utf8Path) -> Result<SqliteConnection, StoreError> {
    let mut source = SqliteConnection::connect_with(&read_only(database)).await?;
    sqlx::query("SELECT count(*) FROM sqlite_schema").execute(&mut source).await?;
    Ok(source)
}

fn read_only(database: &Utf8Path) -> SqliteConnectOptions {
    SqliteConnectOptions::new().filename(database).read_only(true).busy_timeout(BUSY_TIMEOUT)
}
