//! Scenes that grow: new content for an existing scene, and what changed in it.

use super::database::to_unsigned;
use super::scenes::{insert_queued_job, scene_of_key};
use super::writer::Transaction;
use super::{
    ContentRepository, InsertedJob, JobRow, NewJob, ParseRepository, SceneRepository, SceneRow,
    StoreError, now,
};
use camino::Utf8PathBuf;
use uniground_types::changes::Changes;
use uniground_types::corrections::Correction;

/// Growth of a scene. Its new content's blob is in place.
pub struct SceneGrowth<'a> {
    pub scene_id: &'a str,
    /// Its previous content. The growth is rejected if a concurrent one has changed it.
    pub from_content: &'a str,
    pub content_hash: &'a str,
    pub content_bytes: u64,
    /// An idempotency key, and the hash of the request that came with it.
    pub key: Option<(&'a str, &'a str)>,
    pub job: NewJob<'a>,
}

/// The result of growing a scene.
pub enum GrowthOutcome {
    Grown(SceneRow, Box<JobRow>),
    /// The scene was deleted, or has another content.
    Overtaken,
    /// The same request was made earlier under this key.
    AlreadyGrown(SceneRow),
    /// The key was used for another request.
    KeyReused,
}

impl InsertedJob for GrowthOutcome {
    fn inserted_job(&self) -> Option<&JobRow> {
        match self {
            Self::Grown(_, job) => Some(job),
            Self::Overtaken | Self::AlreadyGrown(_) | Self::KeyReused => None,
        }
    }
}

/// What a parse takes over from the previous one.
pub struct ContinuedParse<'a> {
    pub from_parse: &'a str,
    pub changes: &'a Changes,
    /// Corrections whose instances still exist.
    pub corrections: &'a [Correction],
    pub reason: ContinuationReason<'a>,
}

/// Why a parse continues another one.
pub enum ContinuationReason<'a> {
    /// The scene has grown.
    Growth { scene_id: &'a str },
    /// The other parse is a draft of the same content. Every scene that uses it changes to the new
    /// parse in the same transaction.
    Draft,
}

impl SceneRepository {
    /// Gives a scene new content and the job that parses it, in one transaction.
    ///
    /// # Errors
    /// [`StoreError`].
    pub async fn grow_scene(&self, growth: SceneGrowth<'_>) -> Result<GrowthOutcome, StoreError> {
        let SceneGrowth { scene_id, from_content, content_hash, content_bytes, key, job } = growth;
        let time = now();
        let mut tx = self.database.writer.begin().await?;
        if let Some((key, request)) = key
            && let Some((scene, before)) = scene_of_key(&mut tx, key).await?
        {
            tx.rollback().await?;
            return Ok(if before.is_some_and(|before| before == request) {
                GrowthOutcome::AlreadyGrown(scene)
            } else {
                GrowthOutcome::KeyReused
            });
        }
        sqlx::query("INSERT INTO contents (hash, bytes, created_at, grown_from) VALUES ($1, $2, $3, $4) ON CONFLICT DO NOTHING")
            .bind(content_hash)
            .bind(i64::try_from(content_bytes).unwrap_or(i64::MAX))
            .bind(&time)
            .bind(from_content)
            .execute(&mut *tx)
            .await?;
        let grown = sqlx::query("UPDATE scenes SET content_hash = $1, updated_at = $2 WHERE id = $3 AND content_hash = $4")
            .bind(content_hash)
            .bind(&time)
            .bind(scene_id)
            .bind(from_content)
            .execute(&mut *tx)
            .await?;
        if grown.rows_affected() == 0 {
            tx.rollback().await?;
            return Ok(GrowthOutcome::Overtaken);
        }
        if let Some((key, request)) = key {
            let sql = "INSERT INTO idempotency_keys (key, scene_id, created_at, request) VALUES ($1, $2, $3, $4)";
            sqlx::query(sql)
                .bind(key)
                .bind(scene_id)
                .bind(&time)
                .bind(request)
                .execute(&mut *tx)
                .await?;
        }
        let job = insert_queued_job(&mut tx, scene_id, &self.database.new_id(), job).await?;
        let scene = sqlx::query_as("SELECT * FROM scenes WHERE id = $1")
            .bind(scene_id)
            .fetch_one(&mut *tx)
            .await?;
        tx.commit().await?;
        Ok(GrowthOutcome::Grown(scene, Box::new(job)))
    }

    /// Returns the changes from each version of a scene to the next, for versions after `since`, in
    /// order.
    ///
    /// # Errors
    /// [`StoreError`].
    pub async fn scene_changes(
        &self,
        scene_id: &str,
        since: u32,
    ) -> Result<Vec<(u32, Changes)>, StoreError> {
        let sql = "SELECT version, body FROM scene_changes WHERE scene_id = $1 AND version > $2 ORDER BY version";
        let rows: Vec<(i64, String)> = sqlx::query_as(sql)
            .bind(scene_id)
            .bind(i64::from(since))
            .fetch_all(&self.database.reader)
            .await?;
        rows.into_iter()
            .map(|(version, body)| Ok((to_unsigned(version)?, serde_json::from_str(&body)?)))
            .collect()
    }
}

impl ContentRepository {
    /// Returns contents that scenes have outgrown: no scene and no parse refers to them.
    ///
    /// # Errors
    /// [`StoreError::Database`].
    pub async fn outgrown_contents(&self, limit: u32) -> Result<Vec<String>, StoreError> {
        let sql = format!("SELECT hash FROM contents WHERE {OUTGROWN} LIMIT $1");
        Ok(sqlx::query_scalar(sqlx::AssertSqlSafe(sql))
            .bind(i64::from(limit))
            .fetch_all(&self.database.reader)
            .await?)
    }

    /// Removes the row of an outgrown content. Returns its folders, which the caller must remove.
    ///
    /// # Errors
    /// [`StoreError`].
    pub async fn remove_outgrown(&self, hash: &str) -> Result<Vec<Utf8PathBuf>, StoreError> {
        let mut tx = self.database.writer.begin().await?;
        let removed = self.remove_outgrown_row(&mut tx, hash).await?;
        tx.commit().await?;
        Ok(if removed {
            vec![self.blobs.content(hash), self.blobs.checkpoints(hash)]
        } else {
            Vec::new()
        })
    }

    /// Removes the row of an outgrown content. Returns whether it was outgrown.
    pub(super) async fn remove_outgrown_row(
        &self,
        tx: &mut Transaction,
        hash: &str,
    ) -> Result<bool, StoreError> {
        // Link the contents that grew from this one to its own predecessor.
        let bridge = format!(
            "UPDATE contents SET grown_from = (SELECT grown_from FROM contents WHERE hash = $1)
             WHERE grown_from = $1 AND EXISTS (SELECT 1 FROM contents WHERE hash = $1 AND {OUTGROWN})"
        );
        sqlx::query(sqlx::AssertSqlSafe(bridge)).bind(hash).execute(&mut **tx).await?;
        let sql = format!("DELETE FROM contents WHERE hash = $1 AND {OUTGROWN}");
        Ok(sqlx::query(sqlx::AssertSqlSafe(sql))
            .bind(hash)
            .execute(&mut **tx)
            .await?
            .rows_affected()
            > 0)
    }

    /// Removes the rows of a content without scenes, the contents it grew from, and their parses.
    /// Returns the folders of all of them.
    pub(super) async fn remove_content(
        &self,
        tx: &mut Transaction,
        content: String,
    ) -> Result<Vec<Utf8PathBuf>, StoreError> {
        let mut folders = Vec::new();
        let mut next = Some(content);
        while let Some(hash) = next {
            let sql = "SELECT (SELECT count(*) FROM scenes WHERE content_hash = $1) + (SELECT count(*) FROM contents WHERE grown_from = $1)";
            let shared: i64 = sqlx::query_scalar(sql).bind(&hash).fetch_one(&mut **tx).await?;
            if shared > 0 {
                break;
            }
            let parses: Vec<String> =
                sqlx::query_scalar("DELETE FROM parses WHERE content_hash = $1 RETURNING id")
                    .bind(&hash)
                    .fetch_all(&mut **tx)
                    .await?;
            let grown_from: Option<Option<String>> =
                sqlx::query_scalar("DELETE FROM contents WHERE hash = $1 RETURNING grown_from")
                    .bind(&hash)
                    .fetch_optional(&mut **tx)
                    .await?;
            folders.extend([self.blobs.content(&hash), self.blobs.checkpoints(&hash)]);
            folders.extend(parses.iter().map(|parse| self.blobs.parse(parse)));
            next = grown_from.flatten();
        }
        Ok(folders)
    }
}

impl ParseRepository {
    /// Copies what a parse takes over from the previous one.
    pub(super) async fn continue_parse(
        &self,
        tx: &mut Transaction,
        parse_id: &str,
        continued: &ContinuedParse<'_>,
    ) -> Result<(), StoreError> {
        let ContinuedParse { from_parse, changes, corrections, reason } = continued;
        let changes = serde_json::to_string(changes)?;
        match reason {
            ContinuationReason::Growth { scene_id } => {
                let sql = "INSERT INTO scene_changes (scene_id, parse_id, from_parse, body, created_at) SELECT $1, $2, $3, $4, $5
                           WHERE EXISTS (SELECT 1 FROM scenes WHERE id = $1)";
                sqlx::query(sql)
                    .bind(scene_id)
                    .bind(parse_id)
                    .bind(from_parse)
                    .bind(&changes)
                    .bind(now())
                    .execute(&mut **tx)
                    .await?;
            }
            ContinuationReason::Draft => {
                // A scene that has grown meanwhile waits for the parse of its new content.
                let sql = "UPDATE scenes SET parse_id = $1, parse_version = parse_version + 1, updated_at = $2
                           WHERE parse_id = $3 AND content_hash = (SELECT content_hash FROM parses WHERE id = $1)";
                sqlx::query(sql)
                    .bind(parse_id)
                    .bind(now())
                    .bind(from_parse)
                    .execute(&mut **tx)
                    .await?;
                let sql = "INSERT INTO scene_changes (scene_id, parse_id, from_parse, body, created_at, version)
                           SELECT id, $1, $2, $3, $4, parse_version FROM scenes WHERE parse_id = $1";
                sqlx::query(sql)
                    .bind(parse_id)
                    .bind(from_parse)
                    .bind(&changes)
                    .bind(now())
                    .execute(&mut **tx)
                    .await?;
            }
        }
        for correction in *corrections {
            sqlx::query("INSERT INTO corrections (id, parse_id, change, made, author, created_at) VALUES ($1, $2, $3, $4, $5, $6)")
                .bind(self.database.new_id())
                .bind(parse_id)
                .bind(serde_json::to_string(&correction.change)?)
                .bind(correction.made.map(|id| i64::from(id.0)))
                .bind(&correction.author)
                .bind(&correction.created_at)
                .execute(&mut **tx)
                .await?;
        }
        // Copy the model's names of instances that still exist.
        let gone = self.database.engine.json_has_field("body", "gone");
        let sql = format!(
            "INSERT INTO instance_names (parse_id, model, prompt_version, instance_id, name, created_at)
                   SELECT $1, model, prompt_version, instance_id, name, created_at FROM instance_names AS known
                   WHERE parse_id = $2 AND EXISTS (SELECT 1 FROM instances WHERE parse_id = $1 AND id = known.instance_id
                                                   AND NOT {gone}) ON CONFLICT DO NOTHING"
        );
        sqlx::query(sqlx::AssertSqlSafe(sql))
            .bind(parse_id)
            .bind(from_parse)
            .execute(&mut **tx)
            .await?;
        Ok(())
    }
}

pub(super) const OUTGROWN: &str =
    "NOT EXISTS (SELECT 1 FROM scenes WHERE content_hash = contents.hash)
                        AND NOT EXISTS (SELECT 1 FROM parses WHERE content_hash = contents.hash)";

/// Assigns the number of a scene's new version to its changes, if they start at the scene's
/// previous parse.
pub(super) async fn number_changes(
    tx: &mut Transaction,
    scene_id: &str,
    parse_id: &str,
    from_parse: &str,
) -> Result<(), StoreError> {
    let sql = "UPDATE scene_changes SET version = (SELECT parse_version FROM scenes WHERE id = $1)
               WHERE scene_id = $1 AND parse_id = $2 AND from_parse = $3 AND version IS NULL";
    sqlx::query(sql).bind(scene_id).bind(parse_id).bind(from_parse).execute(&mut **tx).await?;
    Ok(())
}
