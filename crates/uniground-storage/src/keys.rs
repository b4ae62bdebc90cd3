//! API keys, their spending, and the audit log.

use super::database::{Database, to_unsigned};
use super::writer::Writer;
use super::{StoreError, now};
use sqlx::any::AnyRow;
use sqlx::{FromRow, Row};
use std::sync::Arc;
use uniground_types::keys::{AuditEntry, Scope};

/// An API key as stored.
#[derive(Debug, Clone, PartialEq)]
pub struct KeyRow {
    pub id: String,
    pub name: String,
    /// The first characters of the secret.
    pub prefix: String,
    /// SHA-256 of the secret, hex.
    pub hash: String,
    pub scope: Scope,
    pub expires_at: Option<String>,
    pub requests_per_minute: Option<u32>,
    pub max_scenes: Option<u32>,
    pub daily_usd: Option<f64>,
    pub created_at: String,
    pub last_used_at: Option<String>,
    pub revoked_at: Option<String>,
}

impl FromRow<'_, AnyRow> for KeyRow {
    fn from_row(row: &AnyRow) -> sqlx::Result<Self> {
        let scope: String = row.try_get("scope")?;
        Ok(Self {
            id: row.try_get("id")?,
            name: row.try_get("name")?,
            prefix: row.try_get("prefix")?,
            hash: row.try_get("hash")?,
            scope: Scope::try_from(scope).map_err(|error| sqlx::Error::Decode(error.into()))?,
            expires_at: row.try_get("expires_at")?,
            requests_per_minute: row
                .try_get::<Option<i64>, _>("requests_per_minute")?
                .map(to_unsigned)
                .transpose()?,
            max_scenes: row
                .try_get::<Option<i64>, _>("max_scenes")?
                .map(to_unsigned)
                .transpose()?,
            daily_usd: row.try_get("daily_usd")?,
            created_at: row.try_get("created_at")?,
            last_used_at: row.try_get("last_used_at")?,
            revoked_at: row.try_get("revoked_at")?,
        })
    }
}

/// Period of the request rate, seconds.
const MINUTE_S: f64 = 60.0;

/// Writes audit entries. Holds connections to the database but not the lock of the data folder, so
/// a long-lived task may own one.
#[derive(Clone)]
pub struct AuditWriter(Writer);

impl AuditWriter {
    /// Writes entries in one transaction. Entries that are stored already stay as they are.
    ///
    /// # Errors
    /// [`StoreError::Database`].
    pub async fn insert(&self, entries: &[AuditEntry]) -> Result<(), StoreError> {
        let sql = "INSERT INTO audit (id, at, key_id, method, path, status, request_id) VALUES ($1, $2, $3, $4, $5, $6, $7)
                   ON CONFLICT (id) DO NOTHING";
        let mut tx = self.0.begin().await?;
        for AuditEntry { id, at, key_id, method, path, status, request_id } in entries {
            sqlx::query(sql)
                .bind(id)
                .bind(at)
                .bind(key_id)
                .bind(method)
                .bind(path)
                .bind(i64::from(*status))
                .bind(request_id)
                .execute(&mut *tx)
                .await?;
        }
        tx.commit().await
    }
}

/// API keys and the audit log.
#[derive(Clone)]
pub struct KeyRepository {
    pub(super) database: Arc<Database>,
}

impl KeyRepository {
    /// # Errors
    /// [`StoreError::Database`].
    pub async fn insert_key(&self, key: &KeyRow) -> Result<(), StoreError> {
        let sql = "INSERT INTO keys (id, name, prefix, hash, scope, expires_at, requests_per_minute, max_scenes, daily_usd, created_at)
                   VALUES ($1, $2, $3, $4, $5, $6, $7, $8, $9, $10)";
        // Not a persistent prepared statement: sqlx infers a smaller type for a NULL than for a
        // number.
        sqlx::query(sql)
            .persistent(false)
            .bind(&key.id)
            .bind(&key.name)
            .bind(&key.prefix)
            .bind(&key.hash)
            .bind(key.scope.as_str())
            .bind(&key.expires_at)
            .bind(key.requests_per_minute.map(i64::from))
            .bind(key.max_scenes.map(i64::from))
            .bind(key.daily_usd)
            .bind(&key.created_at)
            .execute(self.database.writer.pool())
            .await?;
        Ok(())
    }

    /// Returns all keys that ever existed, oldest first.
    ///
    /// # Errors
    /// [`StoreError::Database`].
    pub async fn all_keys(&self) -> Result<Vec<KeyRow>, StoreError> {
        Ok(sqlx::query_as("SELECT * FROM keys ORDER BY id")
            .fetch_all(&self.database.reader)
            .await?)
    }

    /// Returns keys, newest first; with a `cursor` (an id) only those before it.
    ///
    /// # Errors
    /// [`StoreError::Database`].
    pub async fn keys(&self, limit: u32, cursor: Option<&str>) -> Result<Vec<KeyRow>, StoreError> {
        let sql = "SELECT * FROM keys WHERE $1 IS NULL OR id < $1 ORDER BY id DESC LIMIT $2";
        Ok(sqlx::query_as(sql)
            .bind(cursor)
            .bind(i64::from(limit))
            .fetch_all(&self.database.reader)
            .await?)
    }

    /// Revokes a key. Returns it as it is then, or `None` if it does not exist. A key that is
    /// already revoked keeps its earlier time.
    ///
    /// # Errors
    /// [`StoreError::Database`].
    pub async fn revoke_key(&self, id: &str) -> Result<Option<KeyRow>, StoreError> {
        let sql = "UPDATE keys SET revoked_at = coalesce(revoked_at, $1) WHERE id = $2 RETURNING *";
        Ok(sqlx::query_as(sql)
            .bind(now())
            .bind(id)
            .fetch_optional(self.database.writer.pool())
            .await?)
    }

    /// Stores when a key was last used.
    ///
    /// # Errors
    /// [`StoreError::Database`].
    pub async fn note_key_use(&self, id: &str, at: &str) -> Result<(), StoreError> {
        sqlx::query("UPDATE keys SET last_used_at = $1 WHERE id = $2")
            .bind(at)
            .bind(id)
            .execute(self.database.writer.pool())
            .await?;
        Ok(())
    }

    /// Counts a request against the per-minute limit of a key, over all processes. Returns `Ok`
    /// with the seconds until the full limit is available again (at most 60), or `Err` with the
    /// seconds until the next request is allowed.
    ///
    /// A token bucket: each request takes its share of a minute. A key without requests for a
    /// minute has the full limit.
    ///
    /// # Errors
    /// [`StoreError::Database`].
    pub async fn count_request(
        &self,
        key_id: &str,
        per_minute: u32,
    ) -> Result<Result<f64, f64>, StoreError> {
        let (clock, share) =
            (self.database.engine.clock(), MINUTE_S / f64::from(per_minute.max(1)));
        let sql = format!(
            "INSERT INTO key_rates (key_id, full_at) VALUES ($1, {clock} + $2)
             ON CONFLICT (key_id) DO UPDATE SET full_at = greatest(key_rates.full_at, {clock}) + $2
             WHERE greatest(key_rates.full_at, {clock}) + $2 <= {clock} + $3 + 0.000001
             RETURNING full_at - {clock}"
        );
        let taken =
            sqlx::query_scalar(sqlx::AssertSqlSafe(sql)).bind(key_id).bind(share).bind(MINUTE_S);
        if let Some(until_full) = taken.fetch_optional(self.database.writer.pool()).await? {
            return Ok(Ok(until_full));
        }
        let sql = format!("SELECT full_at - {clock} FROM key_rates WHERE key_id = $1");
        let until_full: Option<f64> = sqlx::query_scalar(sqlx::AssertSqlSafe(sql))
            .bind(key_id)
            .fetch_optional(self.database.writer.pool())
            .await?;
        Ok(Err((until_full.unwrap_or(0.0) + share - MINUTE_S).max(0.0)))
    }

    /// Returns what the questions of a key cost on a day, US dollars.
    ///
    /// # Errors
    /// [`StoreError::Database`].
    pub async fn spending_of_key(&self, key_id: &str, day: &str) -> Result<f64, StoreError> {
        let usd: Option<f64> =
            sqlx::query_scalar("SELECT usd FROM key_spending WHERE key_id = $1 AND day = $2")
                .bind(key_id)
                .bind(day)
                .fetch_optional(&self.database.reader)
                .await?;
        Ok(usd.unwrap_or(0.0))
    }

    /// Counts the existing scenes that a key has uploaded.
    ///
    /// # Errors
    /// [`StoreError::Database`].
    pub async fn count_scenes_of_key(&self, key_id: &str) -> Result<u32, StoreError> {
        let scenes =
            sqlx::query_scalar("SELECT count(*) FROM scenes WHERE key_id = $1").bind(key_id);
        Ok(to_unsigned(scenes.fetch_one(&self.database.reader).await?)?)
    }

    /// Returns a writer of audit entries.
    #[must_use]
    pub fn audit_writer(&self) -> AuditWriter {
        AuditWriter(self.database.writer.clone())
    }

    /// Returns audit entries, newest first; with a `cursor` (an id) only those before it.
    ///
    /// # Errors
    /// [`StoreError::Database`].
    pub async fn audit(
        &self,
        limit: u32,
        cursor: Option<&str>,
    ) -> Result<Vec<AuditEntry>, StoreError> {
        let sql = "SELECT * FROM audit WHERE $1 IS NULL OR id < $1 ORDER BY id DESC LIMIT $2";
        let rows = sqlx::query(sql)
            .bind(cursor)
            .bind(i64::from(limit))
            .fetch_all(&self.database.reader)
            .await?;
        let entry = |row: &AnyRow| {
            Ok(AuditEntry {
                id: row.try_get("id")?,
                at: row.try_get("at")?,
                key_id: row.try_get("key_id")?,
                method: row.try_get("method")?,
                path: row.try_get("path")?,
                status: to_unsigned(row.try_get("status")?)?,
                request_id: row.try_get("request_id")?,
            })
        };
        rows.iter().map(entry).collect()
    }
}
