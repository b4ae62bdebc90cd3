//! Scenes and their rows.

use super::database::Database;
use super::growth::number_changes;
use super::records::read_or_none;
use super::writer::Transaction;
use super::{Blobs, ContentRepository, InsertedJob, JobRow, NewJob, StoreError, now};
use camino::Utf8PathBuf;
use sqlx::any::AnyRow;
use sqlx::{AnyConnection, AssertSqlSafe, FromRow, Row};
use std::sync::Arc;
use uniground_types::labels::Labels;
use uniground_types::placement::SceneToMap;

/// A scene as stored.
#[derive(Debug, Clone, PartialEq)]
pub struct SceneRow {
    pub id: String,
    pub name: String,
    pub content_hash: String,
    pub parse_id: Option<String>,
    pub parse_version: i64,
    pub job_id: Option<String>,
    /// `None` also if its version cannot be read.
    pub scene_to_map: Option<SceneToMap>,
    pub map_frame_id: Option<String>,
    pub labels: Labels,
    pub created_at: String,
    pub updated_at: String,
}

/// Changes of a scene. An outer `None` keeps the value, an inner `None` removes it.
pub struct SceneRowChange<'a> {
    pub name: Option<&'a str>,
    pub scene_to_map: Option<Option<SceneToMap>>,
    pub map_frame_id: Option<Option<&'a str>>,
    pub labels: Option<Labels>,
}

/// Which scenes to list.
#[derive(Debug, Default)]
pub struct SceneFilter {
    /// `None`: any.
    pub ids: Option<Vec<String>>,
    /// A scene must have all of them.
    pub labels: Labels,
}

impl FromRow<'_, AnyRow> for SceneRow {
    fn from_row(row: &AnyRow) -> sqlx::Result<Self> {
        Ok(Self {
            id: row.try_get("id")?,
            name: row.try_get("name")?,
            content_hash: row.try_get("content_hash")?,
            parse_id: row.try_get("parse_id")?,
            parse_version: row.try_get("parse_version")?,
            job_id: row.try_get("job_id")?,
            scene_to_map: row
                .try_get::<Option<String>, _>("scene_to_map")?
                .and_then(|text| read_or_none("place in a map", &text)),
            map_frame_id: row.try_get("map_frame_id")?,
            labels: read_or_none("labels", row.try_get("labels")?).unwrap_or_default(),
            created_at: row.try_get("created_at")?,
            updated_at: row.try_get("updated_at")?,
        })
    }
}

/// A scene to be inserted, with its dependent rows. Its content's blob is in place.
pub struct NewSceneRow<'a> {
    pub id: &'a str,
    pub name: &'a str,
    pub content_hash: &'a str,
    pub content_bytes: u64,
    /// The API key that uploads it.
    pub key_id: Option<&'a str>,
    /// An idempotency key, and the hash of the request that came with it.
    pub key: Option<(&'a str, &'a str)>,
    /// The job that parses it, if requested.
    pub job: Option<NewJob<'a>>,
}

/// The result of inserting a scene.
pub enum InsertOutcome {
    New(SceneRow, Option<Box<JobRow>>),
    /// The scene that was created earlier under the same key.
    AlreadyExists(SceneRow),
    /// The key was used for another request.
    KeyReused,
}

impl InsertedJob for InsertOutcome {
    fn inserted_job(&self) -> Option<&JobRow> {
        match self {
            Self::New(_, job) => job.as_deref(),
            Self::AlreadyExists(_) | Self::KeyReused => None,
        }
    }
}

pub(super) async fn scene_of_key(
    connection: &mut AnyConnection,
    key: &str,
) -> sqlx::Result<Option<(SceneRow, Option<String>)>> {
    let sql = "SELECT scenes.*, request FROM scenes JOIN idempotency_keys ON scene_id = scenes.id WHERE key = $1";
    let row = sqlx::query(sql).bind(key).fetch_optional(connection).await?;
    row.map(|row| Ok((SceneRow::from_row(&row)?, row.try_get("request")?))).transpose()
}

/// Repository of scenes.
#[derive(Clone)]
pub struct SceneRepository {
    pub(super) database: Arc<Database>,
    pub(super) blobs: Blobs,
    pub(super) contents: ContentRepository,
}

impl SceneRepository {
    /// Inserts a scene with its content, its key and its first job, in one transaction.
    ///
    /// # Errors
    /// [`StoreError::Database`].
    pub async fn insert_scene(&self, new: NewSceneRow<'_>) -> Result<InsertOutcome, StoreError> {
        let NewSceneRow { id, name, content_hash, content_bytes, key_id, key, job } = new;
        let time = now();
        let mut tx = self.database.writer.begin().await?;
        if let Some((key, request)) = key
            && let Some((scene, before)) = scene_of_key(&mut tx, key).await?
        {
            tx.rollback().await?;
            // Old servers did not store the request: accept the key.
            let same = before.is_none_or(|before| before == request);
            return Ok(if same {
                InsertOutcome::AlreadyExists(scene)
            } else {
                InsertOutcome::KeyReused
            });
        }
        sqlx::query("INSERT INTO contents (hash, bytes, created_at) VALUES ($1, $2, $3) ON CONFLICT DO NOTHING")
            .bind(content_hash)
            .bind(i64::try_from(content_bytes).unwrap_or(i64::MAX))
            .bind(&time)
            .execute(&mut *tx)
            .await?;
        let sql = "INSERT INTO scenes (id, name, content_hash, created_at, updated_at, key_id) VALUES ($1, $2, $3, $4, $4, $5)";
        sqlx::query(sql)
            .bind(id)
            .bind(name)
            .bind(content_hash)
            .bind(&time)
            .bind(key_id)
            .execute(&mut *tx)
            .await?;
        if let Some((key, request)) = key {
            let sql = "INSERT INTO idempotency_keys (key, scene_id, created_at, request) VALUES ($1, $2, $3, $4)";
            sqlx::query(sql).bind(key).bind(id).bind(&time).bind(request).execute(&mut *tx).await?;
        }
        let job = match job {
            Some(job) => Some(insert_queued_job(&mut tx, id, &self.database.new_id(), job).await?),
            None => None,
        };
        let scene = sqlx::query_as("SELECT * FROM scenes WHERE id = $1")
            .bind(id)
            .fetch_one(&mut *tx)
            .await?;
        tx.commit().await?;
        Ok(InsertOutcome::New(scene, job.map(Box::new)))
    }

    /// Inserts a job and makes it the scene's current one, in one transaction. Returns `None` when
    /// the scene is deleted.
    ///
    /// # Errors
    /// [`StoreError::Database`].
    pub async fn insert_scene_job(
        &self,
        scene_id: &str,
        job: NewJob<'_>,
    ) -> Result<Option<JobRow>, StoreError> {
        let mut tx = self.database.writer.begin().await?;
        let found: Option<i64> = sqlx::query_scalar("SELECT 1 FROM scenes WHERE id = $1")
            .bind(scene_id)
            .fetch_optional(&mut *tx)
            .await?;
        if found.is_none() {
            tx.rollback().await?;
            return Ok(None);
        }
        let job = insert_queued_job(&mut tx, scene_id, &self.database.new_id(), job).await?;
        tx.commit().await?;
        Ok(Some(job))
    }

    /// Returns the ids of scenes with this name, at most two.
    ///
    /// # Errors
    /// [`StoreError::Database`].
    pub async fn scene_ids_by_name(&self, name: &str) -> Result<Vec<String>, StoreError> {
        Ok(sqlx::query_scalar("SELECT id FROM scenes WHERE name = $1 ORDER BY id DESC LIMIT 2")
            .bind(name)
            .fetch_all(&self.database.reader)
            .await?)
    }

    /// # Errors
    /// [`StoreError::Database`].
    pub async fn scene(&self, id: &str) -> Result<Option<SceneRow>, StoreError> {
        Ok(sqlx::query_as("SELECT * FROM scenes WHERE id = $1")
            .bind(id)
            .fetch_optional(&self.database.reader)
            .await?)
    }

    /// Returns the scene that was created under a key, and the hash of its request if that was
    /// stored.
    ///
    /// # Errors
    /// [`StoreError::Database`].
    pub async fn scene_of_idempotency_key(
        &self,
        key: &str,
    ) -> Result<Option<(SceneRow, Option<String>)>, StoreError> {
        Ok(scene_of_key(&mut *self.database.reader.acquire().await?, key).await?)
    }

    /// Returns scenes, newest first; with a `cursor` (an id) only those before it.
    ///
    /// # Errors
    /// [`StoreError::Database`].
    pub async fn scenes(
        &self,
        limit: u32,
        cursor: Option<&str>,
        filter: &SceneFilter,
    ) -> Result<Vec<SceneRow>, StoreError> {
        let (among, is_filed_so) = (
            self.database.engine.json_texts("$3"),
            self.database.engine.json_contains("scenes.labels", "$4"),
        );
        let sql = format!(
            "SELECT * FROM scenes WHERE ($1 IS NULL OR id < $1) AND ($3 IS NULL OR id IN {among}) AND {is_filed_so}
             ORDER BY id DESC LIMIT $2"
        );
        let ids = filter.ids.as_ref().map(serde_json::to_string).transpose()?;
        let labels = serde_json::to_string(&filter.labels)?;
        let query = sqlx::query_as(AssertSqlSafe(sql))
            .bind(cursor)
            .bind(i64::from(limit))
            .bind(ids)
            .bind(labels);
        Ok(query.fetch_all(&self.database.reader).await?)
    }

    /// # Errors
    /// [`StoreError::Database`].
    pub async fn change_scene(
        &self,
        id: &str,
        change: SceneRowChange<'_>,
    ) -> Result<Option<SceneRow>, StoreError> {
        let SceneRowChange { name, scene_to_map, map_frame_id, labels } = change;
        let sql = "UPDATE scenes SET name = coalesce($1, name), scene_to_map = CASE WHEN $2 THEN $3 ELSE scene_to_map END,
                   map_frame_id = CASE WHEN $4 THEN $5 ELSE map_frame_id END, updated_at = $6, labels = coalesce($8, labels)
                   WHERE id = $7 RETURNING *";
        let place =
            scene_to_map.flatten().map(|place| serde_json::to_string(&place)).transpose()?;
        let query = sqlx::query_as(sql)
            .bind(name)
            .bind(scene_to_map.is_some())
            .bind(place)
            .bind(map_frame_id.is_some())
            .bind(map_frame_id.flatten())
            .bind(now())
            .bind(id)
            .bind(labels.map(|labels| serde_json::to_string(&labels)).transpose()?);
        Ok(query.fetch_optional(self.database.writer.pool()).await?)
    }

    /// Makes a finished parse the scene's current one, as a new version, unless a later job than
    /// `job_id` was requested meanwhile.
    ///
    /// # Errors
    /// [`StoreError::Database`].
    pub async fn set_scene_parse(
        &self,
        id: &str,
        parse_id: &str,
        job_id: &str,
    ) -> Result<(), StoreError> {
        let mut tx = self.database.writer.begin().await?;
        set_parse(&mut tx, id, parse_id, job_id).await?;
        tx.commit().await
    }

    /// Like [`set_scene_parse`](Self::set_scene_parse), and queues the job that comes after
    /// `job_id` in the same transaction. Returns `None` and queues nothing if a later job was
    /// requested meanwhile.
    ///
    /// # Errors
    /// [`StoreError::Database`].
    pub async fn set_scene_parse_and_queue(
        &self,
        id: &str,
        parse_id: &str,
        job_id: &str,
        next: NewJob<'_>,
    ) -> Result<Option<JobRow>, StoreError> {
        let mut tx = self.database.writer.begin().await?;
        let job = match set_parse(&mut tx, id, parse_id, job_id).await? {
            true => Some(insert_queued_job(&mut tx, id, &self.database.new_id(), next).await?),
            false => None,
        };
        tx.commit().await?;
        Ok(job)
    }

    /// Deletes the rows of a scene with the rest of its answers, and those of its content and
    /// parses if no other scene shares them. Returns the folders that no row refers to any more,
    /// which the caller must remove; `None` if the scene does not exist.
    ///
    /// # Errors
    /// [`StoreError`].
    pub async fn delete_scene(&self, id: &str) -> Result<Option<Vec<Utf8PathBuf>>, StoreError> {
        let mut tx = self.database.writer.begin().await?;
        let answers: Vec<String> = sqlx::query_scalar("SELECT id FROM answers WHERE scene_id = $1")
            .bind(id)
            .fetch_all(&mut *tx)
            .await?;
        let content: Option<String> =
            sqlx::query_scalar("DELETE FROM scenes WHERE id = $1 RETURNING content_hash")
                .bind(id)
                .fetch_optional(&mut *tx)
                .await?;
        let Some(content) = content else {
            tx.rollback().await?;
            return Ok(None);
        };
        let mut folders: Vec<Utf8PathBuf> =
            answers.iter().map(|answer| self.blobs.answer(answer)).collect();
        folders.extend(self.contents.remove_content(&mut tx, content).await?);
        tx.commit().await?;
        Ok(Some(folders))
    }
}

/// Makes a parse the scene's current one, unless a later job than `job_id` was requested meanwhile.
/// Returns whether it did.
async fn set_parse(
    tx: &mut Transaction,
    scene_id: &str,
    parse_id: &str,
    job_id: &str,
) -> Result<bool, StoreError> {
    let before: Option<Option<String>> =
        sqlx::query_scalar("SELECT parse_id FROM scenes WHERE id = $1")
            .bind(scene_id)
            .fetch_optional(&mut **tx)
            .await?;
    // Ids are ordered by time.
    let sql = "UPDATE scenes SET parse_version = parse_version + CASE WHEN parse_id IS DISTINCT FROM $1 THEN 1 ELSE 0 END, parse_id = $1, updated_at = $2
               WHERE id = $3 AND (job_id IS NULL OR job_id <= $4)";
    let query = sqlx::query(sql).bind(parse_id).bind(now()).bind(scene_id).bind(job_id);
    let is_set = query.execute(&mut **tx).await?.rows_affected() > 0;
    if let Some(before) = before.flatten().filter(|_| is_set) {
        number_changes(tx, scene_id, parse_id, &before).await?;
    }
    Ok(is_set)
}

/// Inserts a job on a scene, in the caller's transaction.
pub(super) async fn insert_queued_job(
    tx: &mut Transaction,
    scene_id: &str,
    id: &str,
    job: NewJob<'_>,
) -> Result<JobRow, StoreError> {
    let done = job.done;
    let time = now();
    let sql = "UPDATE scenes SET job_id = $1, updated_at = $2 WHERE id = $3";
    sqlx::query(sql).bind(id).bind(&time).bind(scene_id).execute(&mut **tx).await?;
    let Some((parse_id, message)) = done else {
        return super::jobs::insert(tx, id, scene_id, &job).await;
    };
    let sql = "UPDATE scenes SET parse_version = parse_version + CASE WHEN parse_id IS DISTINCT FROM $1 THEN 1 ELSE 0 END, parse_id = $1 WHERE id = $2";
    sqlx::query(sql).bind(parse_id).bind(scene_id).execute(&mut **tx).await?;
    super::jobs::insert_done(tx, id, scene_id, &job, message).await
}
