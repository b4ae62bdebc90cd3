//! The index for search across rooms: names of their instances and, where the database supports it
//! (`vectors`), their embeddings.

use super::database::Database;
use super::{Labels, SceneRow, StoreError};
use sqlx::{AssertSqlSafe, FromRow, Row};
use std::collections::BTreeSet;
use std::sync::Arc;

/// A parse whose index is out of date.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct ParseToIndex {
    pub parse_id: String,
    /// The parse's number of changes.
    pub changes: i64,
}

/// A name of an instance in a room.
#[derive(Debug, Clone, PartialEq)]
pub struct RoomEntry {
    pub name: String,
    /// The word for its color; "" for none in particular.
    pub color: &'static str,
    /// `0..=1`
    pub weight: f32,
}

/// An index entry that matches a search.
#[derive(Debug, Clone, PartialEq)]
pub struct RoomMatch {
    pub parse_id: String,
    pub color: String,
    pub weight: f32,
}

/// Rows per INSERT statement.
const ROWS_PER_STATEMENT: usize = 50;

/// Repository of the room index: words and vectors.
#[derive(Clone)]
pub struct RoomIndexRepository {
    pub(super) database: Arc<Database>,
}

impl RoomIndexRepository {
    /// Returns parses to be indexed, oldest first.
    ///
    /// # Errors
    /// [`StoreError::Database`].
    pub async fn parses_to_index(&self, most: u32) -> Result<Vec<ParseToIndex>, StoreError> {
        let sql = "SELECT id, changes FROM parses WHERE indexed IS NULL OR indexed <> changes ORDER BY id LIMIT $1";
        let rows: Vec<(String, i64)> =
            sqlx::query_as(sql).bind(i64::from(most)).fetch_all(&self.database.reader).await?;
        Ok(rows.into_iter().map(|(parse_id, changes)| ParseToIndex { parse_id, changes }).collect())
    }

    /// Replaces the index entries of a room. Does nothing if the parse is deleted.
    ///
    /// # Errors
    /// [`StoreError::Database`].
    pub async fn index_room(
        &self,
        room: &ParseToIndex,
        entries: &[RoomEntry],
    ) -> Result<(), StoreError> {
        let mut tx = self.database.writer.begin().await?;
        let sql = "UPDATE parses SET indexed = $2 WHERE id = $1";
        let is_there =
            sqlx::query(sql).bind(&room.parse_id).bind(room.changes).execute(&mut *tx).await?;
        if is_there.rows_affected() == 0 {
            tx.rollback().await?;
            return Ok(());
        }
        sqlx::query("DELETE FROM room_entries WHERE parse_id = $1")
            .bind(&room.parse_id)
            .execute(&mut *tx)
            .await?;
        for entries in entries.chunks(ROWS_PER_STATEMENT) {
            let row =
                |at: usize| format!("($1, ${}, ${}, ${})", 3 * at + 2, 3 * at + 3, 3 * at + 4);
            let rows: Vec<String> = (0..entries.len()).map(row).collect();
            let sql = format!(
                "INSERT INTO room_entries (parse_id, name, colour, weight) VALUES {}",
                rows.join(", ")
            );
            let query = entries.iter().fold(
                sqlx::query(AssertSqlSafe(sql)).bind(&room.parse_id),
                |query, entry| {
                    query.bind(&entry.name).bind(entry.color).bind(f64::from(entry.weight))
                },
            );
            query.execute(&mut *tx).await?;
        }
        let names: BTreeSet<&str> = entries.iter().map(|entry| entry.name.as_str()).collect();
        let values = self.database.engine.json_texts("$1");
        let sql = format!(
            "INSERT INTO room_names (name) SELECT value FROM {values} AS names WHERE true ON CONFLICT DO NOTHING"
        );
        sqlx::query(AssertSqlSafe(sql))
            .bind(serde_json::to_string(&names)?)
            .execute(&mut *tx)
            .await?;
        tx.commit().await
    }

    /// Returns all names in the index, including unused ones.
    ///
    /// # Errors
    /// [`StoreError::Database`].
    pub async fn room_names(&self) -> Result<Vec<String>, StoreError> {
        Ok(sqlx::query_scalar("SELECT name FROM room_names ORDER BY name")
            .fetch_all(&self.database.reader)
            .await?)
    }

    /// Returns entries of one name, in one color or in any, for rooms of scenes with these labels;
    /// highest weight first.
    ///
    /// # Errors
    /// [`StoreError::Database`].
    pub async fn rooms_with(
        &self,
        name: &str,
        color: Option<&str>,
        labels: &Labels,
        most: u32,
    ) -> Result<Vec<RoomMatch>, StoreError> {
        let has_labels = self.labels_condition("$3");
        let sql = format!(
            "SELECT parse_id, colour, weight FROM room_entries AS entry WHERE name = $1 AND ($2 IS NULL OR colour = $2) AND {has_labels}
             ORDER BY weight DESC, parse_id DESC LIMIT $4"
        );
        let query = sqlx::query_as(AssertSqlSafe(sql))
            .bind(name)
            .bind(color)
            .bind(serde_json::to_string(labels)?)
            .bind(i64::from(most));
        let rows: Vec<(String, String, f64)> = query.fetch_all(&self.database.reader).await?;
        Ok(rows
            .into_iter()
            .map(|(parse_id, color, weight)| RoomMatch { parse_id, color, weight: weight as f32 })
            .collect())
    }

    /// A condition: the parse of `entry` belongs to a scene with these labels.
    pub(super) fn labels_condition(&self, labels: &str) -> String {
        let is_filed_so = self.database.engine.json_contains("scenes.labels", labels);
        format!(
            "EXISTS (SELECT 1 FROM scenes WHERE scenes.parse_id = entry.parse_id AND {is_filed_so})"
        )
    }

    /// Returns the scenes of these parses, newest first and at most `most_of_one` for each parse,
    /// with their position among the scenes of their parse.
    ///
    /// # Errors
    /// [`StoreError::Database`].
    pub async fn scenes_of_parses(
        &self,
        parses: &[String],
        labels: &Labels,
        most_of_one: u32,
    ) -> Result<Vec<(i64, SceneRow)>, StoreError> {
        let (among, is_filed_so) = (
            self.database.engine.json_texts("$1"),
            self.database.engine.json_contains("scenes.labels", "$2"),
        );
        let sql = format!(
            "SELECT * FROM (SELECT scenes.*, row_number() OVER (PARTITION BY parse_id ORDER BY id DESC) AS place FROM scenes
             WHERE parse_id IN {among} AND {is_filed_so}) AS placed WHERE place <= $3"
        );
        let query = sqlx::query(AssertSqlSafe(sql))
            .bind(serde_json::to_string(parses)?)
            .bind(serde_json::to_string(labels)?);
        let rows = query.bind(i64::from(most_of_one)).fetch_all(&self.database.reader).await?;
        rows.iter().map(|row| Ok((row.try_get("place")?, SceneRow::from_row(row)?))).collect()
    }

    /// Deletes names that no index entry uses.
    ///
    /// # Errors
    /// [`StoreError::Database`].
    pub async fn delete_unused_names(&self) -> Result<(), StoreError> {
        let mut tx = self.database.writer.begin().await?;
        sqlx::query("DELETE FROM room_names WHERE NOT EXISTS (SELECT 1 FROM room_entries WHERE room_entries.name = room_names.name)")
            .execute(&mut *tx)
            .await?;
        tx.commit().await
    }
}
