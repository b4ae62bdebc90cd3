//! Foreign keys of a SQLite database: finds rows that refer to missing rows, and repairs them.
//! PostgreSQL enforces its foreign keys itself.

use super::StoreError;
use super::database::{Database, Engine};
use super::writer::Transaction;
use sqlx::AssertSqlSafe;
use std::sync::Arc;

/// Rows of a table that refer to missing rows.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct BrokenReference {
    pub table: String,
    /// The referring column.
    pub column: String,
    /// The table it refers to.
    pub parent: String,
    /// Key of the parent table that the column holds.
    parent_key: String,
    /// The column may be NULL: repair clears it. Otherwise repair removes the rows.
    pub is_optional: bool,
    pub rows: u64,
}

/// Removing a row may break references of other rows. This allows one round for each table of the
/// longest chain, and more.
const MAX_ROUNDS: usize = 8;

/// Checks and repairs the consistency of the database.
#[derive(Clone)]
pub struct IntegrityRepository {
    pub(super) database: Arc<Database>,
}

impl IntegrityRepository {
    /// Finds foreign keys that point to missing rows; empty if the database is intact.
    ///
    /// # Errors
    /// [`StoreError::Database`].
    pub async fn broken_references(&self) -> Result<Vec<BrokenReference>, StoreError> {
        if self.database.engine == Engine::Postgres {
            return Ok(Vec::new());
        }
        let mut tx = self.database.writer.begin().await?;
        let broken = broken_in(&mut tx).await?;
        tx.rollback().await?;
        Ok(broken)
    }

    /// Clears optional references to missing rows, and removes rows whose required reference is
    /// broken, in one transaction. Returns the scenes that lost their parse.
    ///
    /// # Errors
    /// [`StoreError::Database`]; then nothing has changed.
    pub async fn repair_references(&self) -> Result<Vec<String>, StoreError> {
        if self.database.engine == Engine::Postgres {
            return Ok(Vec::new());
        }
        let mut tx = self.database.writer.begin().await?;
        let unparsed = "SELECT id FROM scenes WHERE parse_id IS NOT NULL AND NOT EXISTS (SELECT 1 FROM parses WHERE id = scenes.parse_id)
                        AND EXISTS (SELECT 1 FROM contents WHERE hash = scenes.content_hash)";
        let unparsed: Vec<String> = sqlx::query_scalar(unparsed).fetch_all(&mut *tx).await?;
        // The statements break references temporarily; all of them hold again at the commit.
        sqlx::query("PRAGMA defer_foreign_keys = ON").execute(&mut *tx).await?;
        for _ in 0..MAX_ROUNDS {
            let broken = broken_in(&mut tx).await?;
            if broken.is_empty() {
                break;
            }
            for reference in broken {
                sqlx::query(AssertSqlSafe(reference.repair())).execute(&mut *tx).await?;
            }
        }
        tx.commit().await?;
        Ok(unparsed)
    }
}

impl BrokenReference {
    /// Names come from the schema, never from input.
    fn repair(&self) -> String {
        let Self { table, column, parent, parent_key, is_optional, .. } = self;
        let broken = format!(
            "\"{column}\" IS NOT NULL AND NOT EXISTS (SELECT 1 FROM \"{parent}\" AS parent WHERE parent.\"{parent_key}\" = \"{table}\".\"{column}\")"
        );
        match is_optional {
            true => format!("UPDATE \"{table}\" SET \"{column}\" = NULL WHERE {broken}"),
            false => format!("DELETE FROM \"{table}\" WHERE {broken}"),
        }
    }
}

async fn broken_in(tx: &mut Transaction) -> Result<Vec<BrokenReference>, StoreError> {
    let sql = "SELECT violated.\"table\", key.\"from\", violated.parent, coalesce(key.\"to\", key.\"from\"), col.\"notnull\" = 0, count(*)
               FROM pragma_foreign_key_check AS violated
               JOIN pragma_foreign_key_list(violated.\"table\") AS key ON key.id = violated.fkid
               JOIN pragma_table_info(violated.\"table\") AS col ON col.name = key.\"from\"
               GROUP BY 1, 2, 3, 4, 5 ORDER BY 1, 2";
    let rows: Vec<(String, String, String, String, i64, i64)> =
        sqlx::query_as(sql).fetch_all(&mut **tx).await?;
    let broken = |(table, column, parent, parent_key, is_optional, rows)| BrokenReference {
        table,
        column,
        parent,
        parent_key,
        is_optional: is_optional != 0,
        rows: u64::try_from(rows).unwrap_or(0),
    };
    Ok(rows.into_iter().map(broken).collect())
}
