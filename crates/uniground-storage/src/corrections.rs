//! Corrections of parses by people.

use super::database::{Database, to_unsigned};
use super::parses::{insert_instance, note_change};
use super::{StoreError, now};
use sqlx::any::AnyRow;
use sqlx::{FromRow, Row};
use std::sync::Arc;
use uniground_geometry::scene::{Instance, InstanceId};
use uniground_types::corrections::{Change, Correction};

struct CorrectionRow {
    id: String,
    change: String,
    made: Option<u32>,
    author: Option<String>,
    created_at: String,
    undone_at: Option<String>,
}

impl FromRow<'_, AnyRow> for CorrectionRow {
    fn from_row(row: &AnyRow) -> sqlx::Result<Self> {
        Ok(Self {
            id: row.try_get("id")?,
            change: row.try_get("change")?,
            made: row.try_get::<Option<i64>, _>("made")?.map(to_unsigned).transpose()?,
            author: row.try_get("author")?,
            created_at: row.try_get("created_at")?,
            undone_at: row.try_get("undone_at")?,
        })
    }
}

impl CorrectionRow {
    fn read(self) -> Result<Correction, StoreError> {
        let Self { id, change, made, author, created_at, undone_at } = self;
        Ok(Correction {
            id,
            change: serde_json::from_str(&change)?,
            made: made.map(InstanceId),
            author,
            created_at,
            undone_at,
        })
    }
}

/// A correction to be inserted.
pub struct NewCorrection<'a> {
    pub parse_id: &'a str,
    pub change: &'a Change,
    pub author: Option<&'a str>,
    /// The result of a merge. It gets the next instance id of the parse.
    pub made: Option<Instance>,
}

/// Repository of corrections.
#[derive(Clone)]
pub struct CorrectionRepository {
    pub(super) database: Arc<Database>,
}

impl CorrectionRepository {
    /// Inserts a correction and the instance it creates, in one transaction. Returns `None` when
    /// the parse is deleted or already has `most` corrections.
    ///
    /// # Errors
    /// [`StoreError`].
    pub async fn insert_correction(
        &self,
        new: NewCorrection<'_>,
        most: u32,
    ) -> Result<Option<Correction>, StoreError> {
        let NewCorrection { parse_id, change, author, made } = new;
        let mut tx = self.database.writer.begin().await?;
        let sql = "SELECT (SELECT count(*) FROM corrections WHERE parse_id = $1), (SELECT max(id) FROM instances WHERE parse_id = $1)";
        let (count, last): (i64, Option<i64>) =
            sqlx::query_as(sql).bind(parse_id).fetch_one(&mut *tx).await?;
        let last: Option<u32> =
            last.filter(|_| count < i64::from(most)).map(to_unsigned).transpose()?;
        let Some(last) = last else {
            tx.rollback().await?;
            return Ok(None);
        };
        let made = made.map(|made| Instance { id: InstanceId(last + 1), ..made });
        if let Some(made) = &made {
            insert_instance(&mut tx, parse_id, made).await?;
        }
        let correction = Correction {
            id: self.database.new_id(),
            change: change.clone(),
            made: made.map(|made| made.id),
            author: author.map(str::to_owned),
            created_at: now(),
            undone_at: None,
        };
        sqlx::query("INSERT INTO corrections (id, parse_id, change, made, author, created_at) VALUES ($1, $2, $3, $4, $5, $6)")
            .bind(&correction.id)
            .bind(parse_id)
            .bind(serde_json::to_string(change)?)
            .bind(correction.made.map(|id| i64::from(id.0)))
            .bind(author)
            .bind(&correction.created_at)
            .execute(&mut *tx)
            .await?;
        note_change(&mut tx, parse_id).await?;
        tx.commit().await?;
        Ok(Some(correction))
    }

    /// Returns all corrections of a parse, oldest first, including those that were undone.
    ///
    /// # Errors
    /// [`StoreError`].
    pub async fn corrections(&self, parse_id: &str) -> Result<Vec<Correction>, StoreError> {
        let sql = "SELECT * FROM corrections WHERE parse_id = $1 ORDER BY id";
        let rows: Vec<CorrectionRow> =
            sqlx::query_as(sql).bind(parse_id).fetch_all(&self.database.reader).await?;
        rows.into_iter().map(CorrectionRow::read).collect()
    }

    /// Undoes a correction. Repeated calls have no effect.
    ///
    /// # Errors
    /// [`StoreError`].
    pub async fn undo_correction(&self, id: &str) -> Result<(), StoreError> {
        let mut tx = self.database.writer.begin().await?;
        let sql = "UPDATE corrections SET undone_at = $1 WHERE id = $2 AND undone_at IS NULL RETURNING parse_id";
        let undone: Option<String> =
            sqlx::query_scalar(sql).bind(now()).bind(id).fetch_optional(&mut *tx).await?;
        if let Some(parse_id) = undone {
            note_change(&mut tx, &parse_id).await?;
        }
        tx.commit().await
    }
}
