//! Finished parses and their instances.

use super::{Store, StoreError, now};
use crate::scene::{Instance, InstanceId};

/// A finished parse as stored; JSON columns as text.
#[derive(Debug, Clone, PartialEq, Eq, sqlx::FromRow)]
pub struct ParseRow {
    pub id: String,
    pub content_hash: String,
    pub settings_hash: String,
    pub settings: String,
    pub models: String,
    pub import_report: String,
    pub parse_report: String,
    pub extent: String,
    pub created_at: String,
}

/// A parse about to be recorded; its blobs are in place.
pub struct NewParse<'a> {
    pub id: &'a str,
    pub content_hash: &'a str,
    pub settings_hash: &'a str,
    pub settings: String,
    pub models: String,
    pub import_report: String,
    pub parse_report: String,
    pub extent: String,
    pub instances: &'a [Instance],
}

impl Store {
    /// Records a parse and its instances as one. `false` when the same content and settings were recorded before, or the
    /// content is gone because its last scene was deleted meanwhile: then nothing is written.
    ///
    /// # Errors
    /// [`StoreError`].
    pub async fn insert_parse(&self, parse: NewParse<'_>) -> Result<bool, StoreError> {
        let NewParse { id, content_hash, settings_hash, settings, models, import_report, parse_report, extent, instances } = parse;
        let bodies = instances
            .iter()
            .map(|i| Ok((i.id.0, serde_json::to_string(i)?)))
            .collect::<Result<Vec<_>, StoreError>>()?;
        let mut tx = self.writer.begin_with("BEGIN IMMEDIATE").await?;
        let inserted = sqlx::query(
            "INSERT INTO parses (id, content_hash, settings_hash, settings, models, import_report, parse_report, extent, created_at)
             SELECT ?1, ?2, ?3, ?4, ?5, ?6, ?7, ?8, ?9 WHERE EXISTS (SELECT 1 FROM contents WHERE hash = ?2) ON CONFLICT DO NOTHING",
        )
        .bind(id)
        .bind(content_hash)
        .bind(settings_hash)
        .bind(settings)
        .bind(models)
        .bind(import_report)
        .bind(parse_report)
        .bind(extent)
        .bind(now())
        .execute(&mut *tx)
        .await?;
        if inserted.rows_affected() == 0 {
            return Ok(false);
        }
        for (instance, body) in bodies {
            sqlx::query("INSERT INTO instances (parse_id, id, body) VALUES (?, ?, ?)")
                .bind(id)
                .bind(instance)
                .bind(body)
                .execute(&mut *tx)
                .await?;
        }
        tx.commit().await?;
        Ok(true)
    }

    /// # Errors
    /// [`StoreError::Database`].
    pub async fn parse(&self, id: &str) -> Result<Option<ParseRow>, StoreError> {
        Ok(sqlx::query_as("SELECT * FROM parses WHERE id = ?").bind(id).fetch_optional(&self.reader).await?)
    }

    /// The parse of this content under these settings, when there is one.
    ///
    /// # Errors
    /// [`StoreError::Database`].
    pub async fn parse_of(&self, content_hash: &str, settings_hash: &str) -> Result<Option<ParseRow>, StoreError> {
        let sql = "SELECT * FROM parses WHERE content_hash = ? AND settings_hash = ?";
        Ok(sqlx::query_as(sql).bind(content_hash).bind(settings_hash).fetch_optional(&self.reader).await?)
    }

    /// All instances of a parse, in order of id.
    ///
    /// # Errors
    /// [`StoreError`].
    pub async fn instances(&self, parse_id: &str) -> Result<Vec<Instance>, StoreError> {
        let bodies: Vec<String> = sqlx::query_scalar("SELECT body FROM instances WHERE parse_id = ? ORDER BY id")
            .bind(parse_id)
            .fetch_all(&self.reader)
            .await?;
        bodies.iter().map(|body| Ok(serde_json::from_str(body)?)).collect()
    }

    /// # Errors
    /// [`StoreError`].
    pub async fn instance(&self, parse_id: &str, id: InstanceId) -> Result<Option<Instance>, StoreError> {
        let sql = "SELECT body FROM instances WHERE parse_id = ? AND id = ?";
        let body: Option<String> = sqlx::query_scalar(sql).bind(parse_id).bind(id.0).fetch_optional(&self.reader).await?;
        Ok(body.map(|body| serde_json::from_str(&body)).transpose()?)
    }
}
