//! Copies rows from one database to another, table by table, a few at a time.

use super::target::TargetFolder;
use super::{MigrationError, MigrationProgress, MigrationStep, OnProgress};
use crate::cluster::ClusterMembership;
use crate::database::{Connections, Engine, Location, replace_nul, to_unsigned};
use crate::writer::Writer;
use crate::{LEASE, Store, StoreAccess, StoreError, migrations};
use futures::TryStreamExt;
use futures::stream::TryChunksError;
use sqlx::any::{AnyArguments, AnyRow};
use sqlx::pool::PoolConnection;
use sqlx::query::Query;
use sqlx::{Any, AnyConnection, AnyPool, AssertSqlSafe, Executor, Row};
use std::borrow::Cow;
use std::fmt::Write;
use std::io;
use tokio::task::spawn_blocking;

/// All tables that are migrated, each after the tables it refers to. Not migrated: `data_folder`,
/// the owner of a database, and `members`, its processes, as each database has its own; and
/// vectors, which are computed again.
const TABLES: [&str; 23] = [
    "contents",
    "parses",
    "instances",
    "room_entries",
    "room_names",
    "instance_names",
    "name_indexes",
    "corrections",
    "scenes",
    "scene_changes",
    "idempotency_keys",
    "answers",
    "question_keys",
    "jobs",
    "announcements",
    "batches",
    "batch_items",
    "uploads",
    "keys",
    "spending",
    "reservations",
    "key_spending",
    "audit",
];
/// Rows read at once and written in one transaction.
const ROWS: usize = 1000;
/// Rows per INSERT statement. SQLite's time to parse a statement grows with the square of its
/// number of parameters.
const ROWS_OF_STATEMENT: usize = 50;

/// The type of a column. A NULL must be bound with the right type, too.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum ColumnType {
    Text,
    Integer,
    Real,
}

/// The result of migrating rows.
pub struct MigratedRows {
    pub moved: Vec<(&'static str, u64)>,
    pub texts_changed: u64,
}

/// The target database, which no other process uses.
pub struct TargetDatabase {
    engine: Engine,
    writer: Writer,
    reader: AnyPool,
    members: ClusterMembership,
}

impl TargetDatabase {
    /// Opens a database with the schema and without rows: a new file, or a server's database that
    /// is empty or was started for the same folder. Also starts the target folder, once all checks
    /// pass.
    pub async fn open(
        location: &Location,
        folder: &mut TargetFolder,
    ) -> Result<Self, MigrationError> {
        let not_used =
            |source: StoreError| MigrationError::To { place: location.to_string(), source };
        let members = ClusterMembership::join(location, StoreAccess::Exclusive, LEASE)
            .await
            .map_err(not_used)?;
        let (mut server, mut is_begun) = (None, false);
        if let Location::Postgres(url) = location {
            let connections = Connections::connect_to_server(url).await.map_err(not_used)?;
            // A database that is in use stays unchanged, including its schema.
            is_begun = is_started_for(&folder.id, &connections, location).await?;
            server = Some(connections);
        }
        if !is_begun {
            folder.renew_id();
        }
        begin(folder).await?;
        let connections = match server {
            Some(connections) => connections,
            None => {
                Connections::open_file(&folder.unfinished_database()).await.map_err(not_used)?
            }
        };
        let Connections { engine, reader, writer } = connections;
        migrations(engine).run(&writer).await.map_err(StoreError::from)?;
        let database = Self { engine, writer: Writer::new(writer, engine), reader, members };
        if is_begun {
            database.clear().await?;
        }
        Ok(database)
    }

    /// Removes the rows of an earlier attempt.
    async fn clear(&self) -> Result<(), MigrationError> {
        let mut connection = disable_timeout(self.writer.pool(), self.engine).await?;
        for table in TABLES.iter().rev() {
            let sql = format!("DELETE FROM {table}");
            let cleared = sqlx::query(AssertSqlSafe(sql)).execute(&mut *connection).await;
            cleared.map_err(|error| MigrationError::Rows { table, source: error.into() })?;
        }
        Ok(())
    }

    /// Stores the id of the folder that the database will belong to, and since when it knows its
    /// files.
    async fn store_identity(&self, id: &str, since: &str) -> Result<(), MigrationError> {
        let mut tx = self.writer.begin().await?;
        sqlx::query("DELETE FROM data_folder").execute(&mut *tx).await?;
        sqlx::query("INSERT INTO data_folder (id, since) VALUES ($1, $2)")
            .bind(id)
            .bind(since)
            .execute(&mut *tx)
            .await?;
        Ok(tx.commit().await?)
    }

    pub async fn close(&self) {
        self.members.leave().await;
        self.reader.close().await;
        self.writer.close().await;
    }
}

async fn begin(folder: &TargetFolder) -> Result<(), MigrationError> {
    let folder = folder.clone();
    spawn_blocking(move || folder.begin()).await.map_err(io::Error::other)?
}

/// Returns whether a non-empty database was started for a folder of this id. Every server writes
/// the owner of a database before anything else.
async fn is_started_for(
    id: &str,
    Connections { engine, writer, .. }: &Connections,
    location: &Location,
) -> Result<bool, MigrationError> {
    let tables: Vec<String> = sqlx::query_scalar(engine.tables_query()).fetch_all(writer).await?;
    if !tables.iter().any(|table| table == "data_folder") {
        return Ok(false);
    }
    match sqlx::query_scalar::<_, String>("SELECT id FROM data_folder")
        .fetch_optional(writer)
        .await?
    {
        None => Ok(false),
        Some(known) if known == id => Ok(true),
        Some(_) => {
            let sql = "SELECT (SELECT count(*) FROM scenes), (SELECT count(*) FROM answers)";
            let (scenes, answers): (i64, i64) = sqlx::query_as(sql).fetch_one(writer).await?;
            let found = format!("rows of another data folder: {scenes} scenes, {answers} answers");
            Err(MigrationError::NotEmpty { place: location.to_string(), found })
        }
    }
}

/// Copies all rows to a database. It belongs to a folder of this id from the first row on, so no
/// other folder's server accepts it.
pub async fn move_rows(
    source: &Store,
    target: &TargetDatabase,
    id: &str,
    on_progress: &OnProgress,
) -> Result<MigratedRows, MigrationError> {
    let since: String = sqlx::query_scalar("SELECT since FROM data_folder")
        .fetch_one(&source.database.reader)
        .await?;
    target.store_identity(id, &since).await?;
    let mut from = disable_timeout(&source.database.reader, source.database.engine).await?;
    let mut rows = MigratedRows { moved: Vec::new(), texts_changed: 0 };
    for table in TABLES {
        let moved =
            move_table(&mut from, target, table, &mut rows.texts_changed, on_progress).await;
        rows.moved.push((table, moved.map_err(|source| MigrationError::Rows { table, source })?));
    }
    Ok(rows)
}

async fn disable_timeout(pool: &AnyPool, engine: Engine) -> sqlx::Result<PoolConnection<Any>> {
    let mut connection = pool.acquire().await?;
    for statement in engine.disable_timeout() {
        connection.execute(*statement).await?;
    }
    Ok(connection)
}

/// Copies the rows of a table. Returns their number.
async fn move_table(
    from: &mut AnyConnection,
    target: &TargetDatabase,
    table: &'static str,
    texts_changed: &mut u64,
    on_progress: &OnProgress,
) -> Result<u64, StoreError> {
    let sql = format!("SELECT count(*) FROM {table}");
    let of: i64 = sqlx::query_scalar(AssertSqlSafe(sql)).fetch_one(&mut *from).await?;
    let (mut progress, columns) = (
        MigrationProgress { part: MigrationStep::Rows(table), done: 0, of: to_unsigned(of)? },
        columns_of(target, table).await?,
    );
    on_progress(progress);
    let sql = format!("SELECT {} FROM {table}", column_names(&columns));
    let mut chunks = sqlx::query(AssertSqlSafe(sql)).fetch(from).try_chunks(ROWS);
    while let Some(rows) = chunks.try_next().await.map_err(|TryChunksError(_, error)| error)? {
        let mut tx = target.writer.begin().await?;
        for rows in rows.chunks(ROWS_OF_STATEMENT) {
            build_insert(rows, table, &columns, target.engine, texts_changed)?
                .execute(&mut *tx)
                .await?;
        }
        tx.commit().await?;
        progress.done += rows.len() as u64;
        on_progress(progress);
    }
    Ok(progress.done)
}

/// Builds the query that inserts rows into a table.
fn build_insert<'q>(
    rows: &[AnyRow],
    table: &str,
    columns: &[(String, ColumnType)],
    engine: Engine,
    texts_changed: &mut u64,
) -> sqlx::Result<Query<'q, Any, AnyArguments>> {
    // Not a persistent prepared statement: sqlx infers a smaller type for a NULL than for a number.
    let mut query =
        sqlx::query(AssertSqlSafe(insert_statement(table, columns, rows.len()))).persistent(false);
    for row in rows {
        for (place, (_, kind)) in columns.iter().enumerate() {
            query = match kind {
                ColumnType::Integer => query.bind(row.try_get::<Option<i64>, _>(place)?),
                ColumnType::Real => query.bind(row.try_get::<Option<f64>, _>(place)?),
                ColumnType::Text => {
                    let text: Option<String> = row.try_get(place)?;
                    let kept = text.as_deref().map(|text| to_storable_text(engine, text));
                    *texts_changed += u64::from(kept.as_deref() != text.as_deref());
                    query.bind(kept.map(Cow::into_owned))
                }
            };
        }
    }
    Ok(query)
}

/// Returns the target's columns to write; both sides have the same schema.
async fn columns_of(
    target: &TargetDatabase,
    table: &str,
) -> sqlx::Result<Vec<(String, ColumnType)>> {
    let columns: Vec<(String, String)> = sqlx::query_as(target.engine.columns_query())
        .bind(table)
        .fetch_all(target.writer.pool())
        .await?;
    let columns = columns.into_iter().map(|(name, type_name)| match type_name.as_str() {
        "text" => Ok((name, ColumnType::Text)),
        "integer" | "bigint" => Ok((name, ColumnType::Integer)),
        "real" | "double precision" => Ok((name, ColumnType::Real)),
        _ => Err(sqlx::Error::TypeNotFound { type_name }),
    });
    columns.collect()
}

fn column_names(columns: &[(String, ColumnType)]) -> String {
    columns.iter().map(|(name, _)| name.as_str()).collect::<Vec<_>>().join(", ")
}

/// Returns the INSERT statement for this many rows.
fn insert_statement(table: &str, columns: &[(String, ColumnType)], rows: usize) -> String {
    let mut sql = format!("INSERT INTO {table} ({}) VALUES ", column_names(columns));
    for parameter in 0..rows * columns.len() {
        let before = match parameter {
            0 => "(",
            _ if parameter % columns.len() == 0 => "), (",
            _ => ", ",
        };
        let _ = write!(sql, "{before}${}", parameter + 1);
    }
    sql + ")"
}

/// Returns a text as the database can store it.
fn to_storable_text(engine: Engine, text: &str) -> Cow<'_, str> {
    match engine {
        Engine::Sqlite => text.into(),
        Engine::Postgres => replace_nul(text),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::BlobHome;
    use camino::Utf8Path;

    /// Every table of the migrations must be migrated or be listed as an exception, and no table
    /// comes before one that it refers to.
    #[tokio::test]
    async fn every_table_is_migrated() {
        let place = tempfile::tempdir().unwrap();
        let store = Store::open_without_recovery(
            Utf8Path::from_path(place.path()).unwrap(),
            &Location::Folder,
            &BlobHome::Folder,
        )
        .await
        .unwrap();
        let mut tables: Vec<String> = sqlx::query_scalar(Engine::Sqlite.tables_query())
            .fetch_all(&store.database.reader)
            .await
            .unwrap();
        tables.sort();
        let mut known: Vec<&str> =
            TABLES.into_iter().chain(["_sqlx_migrations", "data_folder", "members"]).collect();
        known.sort_unstable();
        assert_eq!(tables, known, "add new tables to TABLES or to the exceptions of this test");
        for (place, table) in TABLES.iter().enumerate() {
            let sql = "SELECT \"table\" FROM pragma_foreign_key_list($1)";
            let above: Vec<String> = sqlx::query_scalar(sql)
                .bind(*table)
                .fetch_all(&store.database.reader)
                .await
                .unwrap();
            assert!(
                above.iter().all(|above| TABLES[..place].contains(&&**above)),
                "{table} comes before {above:?}"
            );
        }
        for table in TABLES {
            let columns: Vec<(String, String)> = sqlx::query_as(Engine::Sqlite.columns_query())
                .bind(table)
                .fetch_all(&store.database.reader)
                .await
                .unwrap();
            assert!(!columns.is_empty() && columns.len() * ROWS_OF_STATEMENT < 1 << 15, "{table}");
        }
        store.close().await;
    }

    #[test]
    fn insert_statements_have_one_tuple_per_row() {
        let columns = [("id".to_owned(), ColumnType::Text), ("usd".to_owned(), ColumnType::Real)];
        assert_eq!(
            insert_statement("t", &columns, 2),
            "INSERT INTO t (id, usd) VALUES ($1, $2), ($3, $4)"
        );
    }
}
