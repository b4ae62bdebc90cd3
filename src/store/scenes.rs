//! Scenes.

use super::{Store, StoreError, now};
use camino::Utf8PathBuf;
use sqlx::sqlite::SqliteRow;
use sqlx::{FromRow, Row};
use uuid::Uuid;

/// A scene as stored.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct SceneRow {
    pub id: String,
    pub name: String,
    pub content_hash: String,
    pub parse_id: Option<String>,
    pub parse_version: i64,
    pub job_id: Option<String>,
    pub created_at: String,
    pub updated_at: String,
}

impl FromRow<'_, SqliteRow> for SceneRow {
    fn from_row(row: &SqliteRow) -> sqlx::Result<Self> {
        Ok(Self {
            id: row.try_get("id")?,
            name: row.try_get("name")?,
            content_hash: row.try_get("content_hash")?,
            parse_id: row.try_get("parse_id")?,
            parse_version: row.try_get("parse_version")?,
            job_id: row.try_get("job_id")?,
            created_at: row.try_get("created_at")?,
            updated_at: row.try_get("updated_at")?,
        })
    }
}

const SCENE_OF_KEY: &str = "SELECT scenes.* FROM scenes JOIN idempotency_keys ON scene_id = scenes.id WHERE key = ?";

impl Store {
    /// Inserts a scene; or returns the one that the same key made before, and `false`.
    ///
    /// # Errors
    /// [`StoreError::Database`].
    pub async fn insert_scene(
        &self,
        name: &str,
        content_hash: &str,
        idempotency_key: Option<&str>,
    ) -> Result<(SceneRow, bool), StoreError> {
        let mut tx = self.writer.begin_with("BEGIN IMMEDIATE").await?;
        let made_before: Option<SceneRow> = sqlx::query_as(SCENE_OF_KEY).bind(idempotency_key).fetch_optional(&mut *tx).await?;
        if let Some(scene) = made_before {
            return Ok((scene, false));
        }
        let time = now();
        let scene: SceneRow =
            sqlx::query_as("INSERT INTO scenes (id, name, content_hash, created_at, updated_at) VALUES (?, ?, ?, ?, ?) RETURNING *")
                .bind(Uuid::now_v7().to_string())
                .bind(name)
                .bind(content_hash)
                .bind(&time)
                .bind(&time)
                .fetch_one(&mut *tx)
                .await?;
        if let Some(key) = idempotency_key {
            sqlx::query("INSERT INTO idempotency_keys (key, scene_id, created_at) VALUES (?, ?, ?)")
                .bind(key)
                .bind(&scene.id)
                .bind(&time)
                .execute(&mut *tx)
                .await?;
        }
        tx.commit().await?;
        Ok((scene, true))
    }

    /// # Errors
    /// [`StoreError::Database`].
    pub async fn scene(&self, id: &str) -> Result<Option<SceneRow>, StoreError> {
        Ok(sqlx::query_as("SELECT * FROM scenes WHERE id = ?").bind(id).fetch_optional(&self.reader).await?)
    }

    /// # Errors
    /// [`StoreError::Database`].
    pub async fn scene_of_idempotency_key(&self, key: &str) -> Result<Option<SceneRow>, StoreError> {
        Ok(sqlx::query_as(SCENE_OF_KEY).bind(key).fetch_optional(&self.reader).await?)
    }

    /// Scenes newest first, those before `cursor` (an id) only.
    ///
    /// # Errors
    /// [`StoreError::Database`].
    pub async fn scenes(&self, limit: u32, cursor: Option<&str>) -> Result<Vec<SceneRow>, StoreError> {
        let sql = "SELECT * FROM scenes WHERE ?1 IS NULL OR id < ?1 ORDER BY id DESC LIMIT ?2";
        Ok(sqlx::query_as(sql).bind(cursor).bind(limit).fetch_all(&self.reader).await?)
    }

    /// # Errors
    /// [`StoreError::Database`].
    pub async fn rename_scene(&self, id: &str, name: &str) -> Result<Option<SceneRow>, StoreError> {
        let sql = "UPDATE scenes SET name = ?, updated_at = ? WHERE id = ? RETURNING *";
        Ok(sqlx::query_as(sql).bind(name).bind(now()).bind(id).fetch_optional(&self.writer).await?)
    }

    /// # Errors
    /// [`StoreError::Database`].
    pub async fn set_scene_job(&self, id: &str, job_id: &str) -> Result<(), StoreError> {
        let sql = "UPDATE scenes SET job_id = ?, updated_at = ? WHERE id = ?";
        sqlx::query(sql).bind(job_id).bind(now()).bind(id).execute(&self.writer).await?;
        Ok(())
    }

    /// Makes a finished parse the scene's own, a new version; unless a later job than `job_id` was asked for meanwhile.
    ///
    /// # Errors
    /// [`StoreError::Database`].
    pub async fn set_scene_parse(&self, id: &str, parse_id: &str, job_id: &str) -> Result<(), StoreError> {
        // Ids are in order of time.
        let sql = "UPDATE scenes SET parse_version = parse_version + (parse_id IS NOT ?1), parse_id = ?1, updated_at = ?2
                   WHERE id = ?3 AND (job_id IS NULL OR job_id <= ?4)";
        sqlx::query(sql).bind(parse_id).bind(now()).bind(id).bind(job_id).execute(&self.writer).await?;
        Ok(())
    }

    /// Removes the rows of a scene with its answers, and those of its content and parses when no other scene shares them. The folders that
    /// no row speaks of any more come back, for the caller to remove; `None` when there is no such scene.
    ///
    /// # Errors
    /// [`StoreError`].
    pub async fn delete_scene(&self, id: &str) -> Result<Option<Vec<Utf8PathBuf>>, StoreError> {
        let mut tx = self.writer.begin_with("BEGIN IMMEDIATE").await?;
        let answers: Vec<String> = sqlx::query_scalar("SELECT id FROM answers WHERE scene_id = ?").bind(id).fetch_all(&mut *tx).await?;
        let content: Option<String> = sqlx::query_scalar("DELETE FROM scenes WHERE id = ? RETURNING content_hash")
            .bind(id)
            .fetch_optional(&mut *tx)
            .await?;
        let Some(content) = content else { return Ok(None) };
        let shared: i64 = sqlx::query_scalar("SELECT count(*) FROM scenes WHERE content_hash = ?")
            .bind(&content)
            .fetch_one(&mut *tx)
            .await?;
        let mut folders: Vec<Utf8PathBuf> = answers.iter().map(|answer| self.blobs.answer(answer)).collect();
        if shared == 0 {
            let parses: Vec<String> = sqlx::query_scalar("DELETE FROM parses WHERE content_hash = ? RETURNING id")
                .bind(&content)
                .fetch_all(&mut *tx)
                .await?;
            sqlx::query("DELETE FROM contents WHERE hash = ?").bind(&content).execute(&mut *tx).await?;
            folders.extend([self.blobs.content(&content), self.blobs.checkpoints(&content)]);
            folders.extend(parses.iter().map(|parse| self.blobs.parse(parse)));
        }
        tx.commit().await?;
        Ok(Some(folders))
    }
}
