//! Embeddings of instances, where the database supports nearest-neighbor search: PostgreSQL with
//! the extension pgvector. The search is approximate, with an HNSW graph for each encoder. The
//! tables exist once vectors were requested (`--vectors pgvector`).

use super::database::Engine;
use super::{Labels, RoomIndexRepository, StoreError};
use sha2::{Digest, Sha256};
use sqlx::{AssertSqlSafe, Executor};
use std::fmt::Write;

/// The embeddings of one room by one encoder.
#[derive(Debug, Clone, PartialEq)]
pub struct RoomVectors {
    /// Name and version of the encoder. Vectors of different encoders cannot be compared.
    pub encoder: String,
    /// One for each instance with an embedding, of unit length.
    pub vectors: Vec<Vec<f32>>,
}

/// Nearest instances fetched for one question; several may be of one room.
const NEAREST: u32 = 1000;
/// Size of HNSW's candidate list (`ef_search`), which limits the number of results. A larger list
/// has better recall and is slower.
const IN_HAND: u32 = 1000;
/// Rows per INSERT statement.
const ROWS_PER_STATEMENT: usize = 50;
/// The longest vectors that the extension can index.
const MAX_DIMENSIONS: usize = 2000;

impl RoomIndexRepository {
    /// Enables vectors: creates the tables and, if they are new, has every room indexed again.
    ///
    /// # Errors
    /// [`StoreError::NoVectors`] if the database does not support it; [`StoreError::Database`].
    pub async fn enable_vectors(&self) -> Result<(), StoreError> {
        if self.database.engine == Engine::Sqlite {
            return Err(StoreError::NoVectors {
                why: "SQLite does not support them; use PostgreSQL (--database)".into(),
            });
        }
        if self.has_vectors().await? {
            return Ok(());
        }
        let mut tx = self.database.writer.begin().await?;
        let made = tx.execute("CREATE EXTENSION IF NOT EXISTS vector").await;
        made.map_err(|error| StoreError::NoVectors {
            why: format!("{error}; install pgvector on the database's server and run CREATE EXTENSION vector there as its superuser"),
        })?;
        tx.execute(
            "CREATE TABLE IF NOT EXISTS instance_vectors (
                 parse_id TEXT COLLATE \"C\" NOT NULL REFERENCES parses (id) ON DELETE CASCADE,
                 encoder TEXT COLLATE \"C\" NOT NULL,
                 embedding vector NOT NULL);
             CREATE INDEX IF NOT EXISTS instance_vectors_by_parse ON instance_vectors (parse_id);
             UPDATE parses SET indexed = NULL",
        )
        .await?;
        tx.commit().await
    }

    /// Returns whether vectors are stored.
    ///
    /// # Errors
    /// [`StoreError::Database`].
    pub async fn has_vectors(&self) -> Result<bool, StoreError> {
        match self.database.engine {
            Engine::Sqlite => Ok(false),
            Engine::Postgres => {
                Ok(sqlx::query_scalar("SELECT to_regclass('instance_vectors') IS NOT NULL")
                    .fetch_one(&self.database.reader)
                    .await?)
            }
        }
    }

    /// Replaces the vectors of a room, if vectors are enabled. Updating the graph takes time and
    /// does not block other writers.
    ///
    /// # Errors
    /// [`StoreError::Database`], also when the parse is deleted.
    pub async fn insert_vectors(
        &self,
        parse_id: &str,
        seen: Option<&RoomVectors>,
    ) -> Result<(), StoreError> {
        if !self.has_vectors().await? {
            return Ok(());
        }
        let mut tx = self.database.writer.pool().begin().await?;
        sqlx::query("DELETE FROM instance_vectors WHERE parse_id = $1")
            .bind(parse_id)
            .execute(&mut *tx)
            .await?;
        let dim = seen.and_then(|seen| seen.vectors.first()).map_or(0, Vec::len);
        let Some(RoomVectors { encoder, vectors }) =
            seen.filter(|_| (1..=MAX_DIMENSIONS).contains(&dim))
        else {
            return Ok(tx.commit().await?);
        };
        // The name of the index contains only a hash of the encoder's name.
        let digest = Sha256::digest(encoder);
        let name: String = digest[..8].iter().map(|byte| format!("{byte:02x}")).collect();
        let sql = format!(
            "CREATE INDEX IF NOT EXISTS instance_vectors_{name} ON instance_vectors
             USING hnsw ((embedding::vector({dim})) vector_ip_ops) WHERE encoder = {}",
            quote_literal(encoder)
        );
        tx.execute(AssertSqlSafe(sql)).await?;
        for vectors in vectors.chunks(ROWS_PER_STATEMENT) {
            let rows: Vec<String> =
                (0..vectors.len()).map(|at| format!("($1, $2, ${}::vector)", at + 3)).collect();
            let sql = format!(
                "INSERT INTO instance_vectors (parse_id, encoder, embedding) VALUES {}",
                rows.join(", ")
            );
            let query = sqlx::query(AssertSqlSafe(sql)).bind(parse_id).bind(encoder);
            vectors
                .iter()
                .fold(query, |query, vector| query.bind(vector_literal(vector)))
                .execute(&mut *tx)
                .await?;
        }
        Ok(tx.commit().await?)
    }

    /// Returns rooms with an instance near a vector (unit length), nearest first; empty if vectors
    /// are not stored.
    ///
    /// # Errors
    /// [`StoreError::Database`].
    pub async fn nearest_rooms(
        &self,
        encoder: &str,
        vector: &[f32],
        labels: &Labels,
        most: u32,
    ) -> Result<Vec<String>, StoreError> {
        if !self.has_vectors().await? {
            return Ok(Vec::new());
        }
        let (dim, has_labels) = (vector.len(), self.labels_condition("$2"));
        // The encoder must be a literal: PostgreSQL uses a partial index only if the query repeats
        // its condition.
        let sql = format!(
            "SELECT parse_id, max(cosine) AS cosine FROM (
                 SELECT parse_id, -(embedding::vector({dim}) <#> $1::vector({dim})) AS cosine FROM instance_vectors
                 WHERE encoder = {} ORDER BY embedding::vector({dim}) <#> $1::vector({dim}) LIMIT {NEAREST}) AS entry
             WHERE {has_labels} GROUP BY parse_id ORDER BY cosine DESC, parse_id DESC LIMIT $3",
            quote_literal(encoder)
        );
        let mut reader = self.database.reader.begin().await?;
        reader.execute(AssertSqlSafe(format!("SET LOCAL hnsw.ef_search = {IN_HAND}"))).await?;
        let near = sqlx::query_as(AssertSqlSafe(sql))
            .bind(vector_literal(vector))
            .bind(serde_json::to_string(labels)?)
            .bind(i64::from(most));
        let near: Vec<(String, f64)> = near.fetch_all(&mut *reader).await?;
        reader.rollback().await?;
        Ok(near.into_iter().map(|(room, _)| room).collect())
    }
}

/// Formats a vector for the extension.
fn vector_literal(vector: &[f32]) -> String {
    let mut text = String::with_capacity(vector.len() * 12);
    for (at, value) in vector.iter().enumerate() {
        let _ = write!(text, "{}{value}", if at == 0 { "[" } else { "," });
    }
    text.push(']');
    text
}

/// Formats a text as an SQL literal.
fn quote_literal(text: &str) -> String {
    format!("'{}'", text.replace('\'', "''"))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn quoted_literals_escape_quotes() {
        assert_eq!(quote_literal("it's'; DROP TABLE jobs; --"), "'it''s''; DROP TABLE jobs; --'");
        assert_eq!(vector_literal(&[0.5, -1.0, 0.0]), "[0.5,-1,0]");
    }
}
