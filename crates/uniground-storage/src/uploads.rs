//! Resumable uploads: the request, the received bytes, and the result.

use super::database::{Database, to_unsigned};
use super::records::read_or_none;
use super::{Blobs, StoreError, now};
use serde::{Deserialize, Serialize};
use sqlx::any::AnyRow;
use sqlx::{FromRow, Row};
use std::collections::HashSet;
use std::sync::Arc;
use std::{fs, io};
use uniground_types::geometry::up_axis::UpAxis;
use uniground_types::problem::Problem;
use uniground_types::settings::ParsePreset;

/// The scene to create from an upload.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(default)]
pub struct SceneRequest {
    pub name: Option<String>,
    pub file_name: Option<String>,
    /// If `false`, the scan is stored and not parsed.
    pub parse: bool,
    pub up: Option<UpAxis>,
    pub preset: ParsePreset,
    pub idempotency_key: Option<String>,
    /// A note by the client, returned unchanged.
    pub note: Option<String>,
}

/// An upload as stored.
#[derive(Debug, Clone, PartialEq)]
pub struct UploadRow {
    pub id: String,
    pub key_id: Option<String>,
    pub wanted: SceneRequest,
    /// Total length, bytes.
    pub length: u64,
    /// Bytes that are on disk.
    pub received: u64,
    pub came_of: Option<UploadResult>,
    pub created_at: String,
    pub updated_at: String,
}

/// The result of an upload.
#[derive(Debug, Clone, PartialEq)]
pub enum UploadResult {
    Scene {
        scene_id: String,
        job_id: Option<String>,
    },
    /// Why no scene was created; `None` if the stored version cannot be read.
    Nothing(Option<Problem>),
}

/// Totals of unfinished uploads.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct UnfinishedUploads {
    pub uploads: u32,
    /// Uploads of one API key, contained in `uploads`.
    pub of_key: u32,
    /// Bytes that have not been received.
    pub announced_bytes: u64,
}

const OPEN: &str = "scene_id IS NULL AND problem IS NULL";

impl FromRow<'_, AnyRow> for UploadRow {
    fn from_row(row: &AnyRow) -> sqlx::Result<Self> {
        let bytes = |column| to_unsigned(row.try_get(column)?);
        let job_id = row.try_get("job_id")?;
        let scene = row
            .try_get::<Option<String>, _>("scene_id")?
            .map(|scene_id| UploadResult::Scene { scene_id, job_id });
        let problem = row.try_get::<Option<String>, _>("problem")?;
        let problem =
            problem.map(|text| UploadResult::Nothing(read_or_none("problem of an upload", &text)));
        Ok(Self {
            id: row.try_get("id")?,
            key_id: row.try_get("key_id")?,
            wanted: read_or_none("wanted scene", row.try_get("wanted")?).unwrap_or_default(),
            length: bytes("length")?,
            received: bytes("received")?,
            came_of: scene.or(problem),
            created_at: row.try_get("created_at")?,
            updated_at: row.try_get("updated_at")?,
        })
    }
}

/// Repository of resumable uploads.
#[derive(Clone)]
pub struct UploadRepository {
    pub(super) database: Arc<Database>,
    pub(super) blobs: Blobs,
}

impl UploadRepository {
    /// Inserts an upload of `length` bytes.
    ///
    /// # Errors
    /// [`StoreError`].
    pub async fn insert_upload(
        &self,
        wanted: &SceneRequest,
        length: u64,
        key_id: Option<&str>,
    ) -> Result<UploadRow, StoreError> {
        let sql = "INSERT INTO uploads (id, key_id, wanted, length, created_at, updated_at) VALUES ($1, $2, $3, $4, $5, $5) RETURNING *";
        let query = sqlx::query_as(sql)
            .bind(self.database.new_id())
            .bind(key_id)
            .bind(serde_json::to_string(wanted)?)
            .bind(i64::try_from(length).unwrap_or(i64::MAX))
            .bind(now());
        Ok(query.fetch_one(self.database.writer.pool()).await?)
    }

    /// # Errors
    /// [`StoreError::Database`].
    pub async fn upload(&self, id: &str) -> Result<Option<UploadRow>, StoreError> {
        Ok(sqlx::query_as("SELECT * FROM uploads WHERE id = $1")
            .bind(id)
            .fetch_optional(&self.database.reader)
            .await?)
    }

    /// Stores how much of an upload is on disk. Returns `None` if the upload is deleted.
    ///
    /// # Errors
    /// [`StoreError::Database`].
    pub async fn note_received(
        &self,
        id: &str,
        received: u64,
    ) -> Result<Option<UploadRow>, StoreError> {
        let sql = "UPDATE uploads SET received = $1, updated_at = $2 WHERE id = $3 RETURNING *";
        let query = sqlx::query_as(sql)
            .bind(i64::try_from(received).unwrap_or(i64::MAX))
            .bind(now())
            .bind(id);
        Ok(query.fetch_optional(self.database.writer.pool()).await?)
    }

    /// Stores the result of an upload. Returns `None` if the upload is deleted.
    ///
    /// # Errors
    /// [`StoreError`].
    pub async fn end_upload(
        &self,
        id: &str,
        came_of: &UploadResult,
    ) -> Result<Option<UploadRow>, StoreError> {
        let (scene_id, job_id, problem) = match came_of {
            UploadResult::Scene { scene_id, job_id } => (Some(scene_id), job_id.as_ref(), None),
            UploadResult::Nothing(why) => (None, None, Some(serde_json::to_string(why)?)),
        };
        let sql = "UPDATE uploads SET scene_id = $1, job_id = $2, problem = $3, updated_at = $4 WHERE id = $5 RETURNING *";
        let query =
            sqlx::query_as(sql).bind(scene_id).bind(job_id).bind(problem).bind(now()).bind(id);
        Ok(query.fetch_optional(self.database.writer.pool()).await?)
    }

    /// Deletes an upload. Returns whether it existed.
    ///
    /// # Errors
    /// [`StoreError::Database`].
    pub async fn delete_upload(&self, id: &str) -> Result<bool, StoreError> {
        let deleted = sqlx::query("DELETE FROM uploads WHERE id = $1")
            .bind(id)
            .execute(self.database.writer.pool())
            .await?;
        Ok(deleted.rows_affected() > 0)
    }

    /// Counts unfinished uploads that were updated since a time.
    ///
    /// # Errors
    /// [`StoreError::Database`].
    pub async fn unfinished_uploads(
        &self,
        since: &str,
        key_id: Option<&str>,
    ) -> Result<UnfinishedUploads, StoreError> {
        let sql = format!(
            "SELECT count(*), coalesce(sum(CASE WHEN key_id IS NOT DISTINCT FROM $2 THEN 1 ELSE 0 END), 0),
                    CAST(coalesce(sum(length - received), 0) AS bigint) FROM uploads
             WHERE {OPEN} AND updated_at >= $1"
        );
        let (uploads, of_key, announced): (i64, i64, i64) =
            sqlx::query_as(sqlx::AssertSqlSafe(sql))
                .bind(since)
                .bind(key_id)
                .fetch_one(&self.database.reader)
                .await?;
        Ok(UnfinishedUploads {
            uploads: to_unsigned(uploads)?,
            of_key: to_unsigned(of_key)?,
            announced_bytes: to_unsigned(announced)?,
        })
    }

    /// Returns uploads that are completely received and have no result yet.
    ///
    /// # Errors
    /// [`StoreError::Database`].
    pub async fn complete_uploads_without_scene(&self) -> Result<Vec<String>, StoreError> {
        let sql = format!("SELECT id FROM uploads WHERE {OPEN} AND received = length ORDER BY id");
        Ok(sqlx::query_scalar(sqlx::AssertSqlSafe(sql)).fetch_all(&self.database.reader).await?)
    }

    /// Removes files of uploads that are finished or unknown. If the row of an upload was lost, its
    /// client still has the data.
    pub(super) async fn remove_stray_uploads(&self) -> Result<(), StoreError> {
        // List the files before the rows: an upload writes its row first, and then its file.
        let blobs = self.blobs.clone();
        let all = tokio::task::spawn_blocking(move || blobs.all_uploads())
            .await
            .map_err(io::Error::other)??;
        let sql = format!("SELECT id FROM uploads WHERE {OPEN}");
        let open: Vec<String> =
            sqlx::query_scalar(sqlx::AssertSqlSafe(sql)).fetch_all(&self.database.reader).await?;
        let open: HashSet<String> = open.into_iter().collect();
        let blobs = self.blobs.clone();
        let removed = tokio::task::spawn_blocking(move || {
            let mut orphan_folders = all.into_iter().filter(|name| !open.contains(name));
            orphan_folders.try_for_each(|name| match fs::remove_file(blobs.upload(&name)) {
                // Another task has finished the upload meanwhile.
                Err(error) if error.kind() == io::ErrorKind::NotFound => Ok(()),
                removed => removed,
            })
        });
        Ok(removed.await.map_err(io::Error::other)??)
    }
}
