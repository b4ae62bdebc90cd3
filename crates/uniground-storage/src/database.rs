//! The database: a SQLite file in the data folder, or PostgreSQL. The same statements run on both.
//! Where the engines differ, [`Engine`] has a method; the two schemas are in `migrations/`.

use super::StoreError;
use super::cluster::ClusterMembership;
use super::ids::IdGenerator;
use super::writer::Writer;
use camino::Utf8Path;
use percent_encoding::{AsciiSet, NON_ALPHANUMERIC, utf8_percent_encode};
use serde::{Deserialize, Serialize};
use sqlx::any::{AnyConnectOptions, AnyPoolOptions, install_default_drivers};
use sqlx::{AnyPool, Executor};
use std::convert::Infallible;
use std::fmt::{self, Write};
use std::str::FromStr;
use std::time::Duration;

/// Location of a database.
#[derive(Clone, PartialEq, Eq)]
pub enum Location {
    /// A SQLite file in the data folder.
    Folder,
    Postgres(PostgresUrl),
    /// An unknown kind of database. Only the scheme is stored, since the rest may contain a
    /// password.
    Unknown {
        scheme: String,
    },
}

/// A URL like `postgres://…`. Its `Display` and `Debug` omit the password.
#[derive(Clone, PartialEq, Eq)]
pub struct PostgresUrl(String);

impl PostgresUrl {
    /// Returns the URL as given, with its password.
    #[must_use]
    pub fn with_password(&self) -> &str {
        &self.0
    }
}

impl FromStr for Location {
    type Err = Infallible;

    fn from_str(text: &str) -> Result<Self, Infallible> {
        Ok(match text.split_once("://") {
            Some(("postgres" | "postgresql", _)) => Self::Postgres(PostgresUrl(text.to_owned())),
            None if text == "sqlite" => Self::Folder,
            other => Self::Unknown {
                scheme: other
                    .map_or_else(|| "that".to_owned(), |(scheme, _)| format!("{scheme}://")),
            },
        })
    }
}

impl Location {
    pub(super) fn engine(&self) -> Result<Engine, StoreError> {
        match self {
            Self::Folder => Ok(Engine::Sqlite),
            Self::Postgres(_) => Ok(Engine::Postgres),
            Self::Unknown { scheme } => Err(StoreError::UnknownDatabase { scheme: scheme.clone() }),
        }
    }
}

impl fmt::Display for Location {
    fn fmt(&self, to: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Folder => to.write_str("sqlite"),
            Self::Postgres(url) => url.fmt(to),
            Self::Unknown { scheme } => to.write_str(scheme),
        }
    }
}

impl fmt::Debug for Location {
    fn fmt(&self, to: &mut fmt::Formatter<'_>) -> fmt::Result {
        fmt::Display::fmt(self, to)
    }
}

impl fmt::Display for PostgresUrl {
    fn fmt(&self, to: &mut fmt::Formatter<'_>) -> fmt::Result {
        let (scheme, rest) = self.0.split_once("://").unwrap_or(("postgres", &self.0));
        let place = rest.rsplit_once('@').map_or(rest, |(_, place)| place);
        write!(to, "{scheme}://{}", place.split('?').next().unwrap_or_default())
    }
}

/// The database engine.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub(super) enum Engine {
    #[default]
    Sqlite,
    Postgres,
}

/// How long SQLite waits for a lock that another process holds.
const BUSY_TIMEOUT: Duration = Duration::from_secs(1);
/// Timeout for the write connection, and for any connection to PostgreSQL. SQLite's own timeout for
/// a lock is shorter.
const WRITER_TIMEOUT: Duration = Duration::from_secs(2);
/// Timeout for a read connection to a SQLite file.
const READER_TIMEOUT: Duration = Duration::from_secs(30);
/// Timeout of a PostgreSQL statement.
const STATEMENT_TIMEOUT: Duration = Duration::from_secs(30);
/// A transaction that is idle for longer is rolled back: its process hangs, and all other writers
/// wait for it.
const IDLE_IN_TRANSACTION: Duration = Duration::from_secs(5);
/// The server notices within half a minute that a client machine has vanished.
pub(super) const KEEPALIVES: &str =
    "SET tcp_keepalives_idle = 10; SET tcp_keepalives_interval = 5; SET tcp_keepalives_count = 3";
const READERS: u32 = 4;
/// PostgreSQL connections for writing. Only one transaction at a time uses one.
const WRITERS: u32 = 8;
/// Characters of a path that need no escaping in a URL.
const IN_PATH: &AsciiSet =
    &NON_ALPHANUMERIC.remove(b'/').remove(b'.').remove(b'-').remove(b'_').remove(b'~');

/// Connection pools for reading and for writing.
pub(super) struct Connections {
    pub engine: Engine,
    pub reader: AnyPool,
    pub writer: AnyPool,
}

impl Connections {
    /// Opens a SQLite file, and creates it if it does not exist.
    pub async fn open_file(file: &Utf8Path) -> Result<Self, StoreError> {
        install_default_drivers();
        // A URL would remove ".." without resolving links.
        let folder = file.parent().unwrap_or(file).canonicalize_utf8()?;
        let file = folder.join(file.file_name().unwrap_or_default());
        let url = format!("sqlite:{}", utf8_percent_encode(file.as_str(), IN_PATH));
        let options = |mode: &str| AnyConnectOptions::from_str(&format!("{url}?mode={mode}"));
        // An acknowledged write must be on disk.
        let settings = format!(
            "PRAGMA busy_timeout = {}; PRAGMA journal_mode = WAL; PRAGMA synchronous = FULL",
            BUSY_TIMEOUT.as_millis()
        );
        let writer = pool(1, WRITER_TIMEOUT, settings).connect_with(options("rwc")?).await?;
        let settings = format!("PRAGMA busy_timeout = {}", BUSY_TIMEOUT.as_millis());
        let reader = pool(READERS, READER_TIMEOUT, settings).connect_lazy_with(options("ro")?);
        Ok(Self { engine: Engine::Sqlite, reader, writer })
    }

    /// Connects to an existing PostgreSQL database.
    pub async fn connect_to_server(url: &PostgresUrl) -> Result<Self, StoreError> {
        install_default_drivers();
        let options = AnyConnectOptions::from_str(url.with_password())?;
        let settings = format!(
            "SET statement_timeout = {}; SET idle_in_transaction_session_timeout = {}; SET client_min_messages = warning; {KEEPALIVES}",
            STATEMENT_TIMEOUT.as_millis(),
            IDLE_IN_TRANSACTION.as_millis()
        );
        let writer =
            pool(WRITERS, WRITER_TIMEOUT, settings.clone()).connect_with(options.clone()).await?;
        let reader = pool(READERS, WRITER_TIMEOUT, settings).connect_lazy_with(options);
        Ok(Self { engine: Engine::Postgres, reader, writer })
    }
}

fn pool(most: u32, acquire_timeout: Duration, settings: String) -> AnyPoolOptions {
    AnyPoolOptions::new().max_connections(most).acquire_timeout(acquire_timeout).after_connect(
        move |connection, _| {
            let settings = settings.clone();
            Box::pin(
                async move { connection.execute(sqlx::AssertSqlSafe(settings)).await.map(drop) },
            )
        },
    )
}

impl Engine {
    pub const fn name(self) -> &'static str {
        match self {
            Self::Sqlite => "SQLite",
            Self::Postgres => "PostgreSQL",
        }
    }

    /// Begins a write transaction, and waits until no other process has one.
    pub const fn begin(self) -> &'static str {
        match self {
            Self::Sqlite => "BEGIN IMMEDIATE",
            // No other user of this database may use this number. The lock ends with the
            // transaction.
            Self::Postgres => "BEGIN; SELECT pg_advisory_xact_lock(7313052)",
        }
    }

    /// Seconds of Unix time by the database's clock: the clocks of its clients may differ.
    pub const fn clock(self) -> &'static str {
        match self {
            Self::Sqlite => "unixepoch('subsec')",
            Self::Postgres => "extract(epoch FROM clock_timestamp())::float8",
        }
    }

    /// A join that starts with its left side, whatever the query planner prefers.
    pub const fn ordered_join(self) -> &'static str {
        match self {
            Self::Sqlite => "CROSS JOIN",
            Self::Postgres => "JOIN",
        }
    }

    /// A condition: the JSON in a column has a field.
    pub fn json_has_field(self, column: &str, field: &str) -> String {
        match self {
            Self::Sqlite => format!("json_extract({column}, '$.{field}') IS NOT NULL"),
            Self::Postgres => format!("{column}::json ->> '{field}' IS NOT NULL"),
        }
    }

    /// A number in a column's JSON, or 0 if it is missing.
    pub fn json_number(self, column: &str, field: &str) -> String {
        match self {
            Self::Sqlite => format!("coalesce(json_extract({column}, '$.{field}'), 0)"),
            Self::Postgres => format!("coalesce(({column}::json ->> '{field}')::bigint, 0)"),
        }
    }

    /// A table expression with one column, `value`, from a JSON list of texts.
    pub fn json_texts(self, list: &str) -> String {
        match self {
            Self::Sqlite => format!("(SELECT value FROM json_each({list}))"),
            Self::Postgres => format!(
                "(SELECT value FROM json_array_elements_text({list}::json) AS texts (value))"
            ),
        }
    }

    /// A condition: a column's JSON object of texts contains all entries of another one.
    pub fn json_contains(self, column: &str, other: &str) -> String {
        match self {
            Self::Sqlite => format!(
                "NOT EXISTS (SELECT 1 FROM json_each({other}) AS wanted WHERE NOT EXISTS (
                     SELECT 1 FROM json_each({column}) AS has WHERE has.key = wanted.key AND has.value = wanted.value))"
            ),
            Self::Postgres => format!("{column}::jsonb @> {other}::jsonb"),
        }
    }

    /// Statements that create the trigger for webhook deliveries: every finished job gets a row in
    /// `announcements`, in the same transaction.
    pub const fn create_job_end_trigger(self) -> &'static [&'static str] {
        match self {
            Self::Sqlite => &["CREATE TRIGGER IF NOT EXISTS jobs_that_end AFTER UPDATE OF state ON jobs
                 WHEN NEW.state IN ('succeeded', 'failed', 'cancelled') AND OLD.state NOT IN ('succeeded', 'failed', 'cancelled')
                 BEGIN INSERT OR IGNORE INTO announcements (job_id) VALUES (NEW.id); END"],
            Self::Postgres => &[
                "CREATE OR REPLACE FUNCTION note_end() RETURNS trigger LANGUAGE plpgsql AS
                 'BEGIN INSERT INTO announcements (job_id) VALUES (NEW.id) ON CONFLICT DO NOTHING; RETURN NULL; END'",
                "CREATE OR REPLACE TRIGGER jobs_that_end AFTER UPDATE OF state ON jobs FOR EACH ROW
                 WHEN (NEW.state IN ('succeeded', 'failed', 'cancelled') AND OLD.state NOT IN ('succeeded', 'failed', 'cancelled'))
                 EXECUTE FUNCTION note_end()",
            ],
        }
    }

    /// The statement that removes the trigger of
    /// [`create_job_end_trigger`](Self::create_job_end_trigger).
    pub const fn drop_job_end_trigger(self) -> &'static str {
        match self {
            Self::Sqlite => "DROP TRIGGER IF EXISTS jobs_that_end",
            Self::Postgres => "DROP TRIGGER IF EXISTS jobs_that_end ON jobs",
        }
    }

    /// The query for the names of all tables.
    pub const fn tables_query(self) -> &'static str {
        match self {
            Self::Sqlite => "SELECT name FROM sqlite_schema WHERE type = 'table' ORDER BY name",
            Self::Postgres => {
                "SELECT CAST(tablename AS text) AS name FROM pg_tables WHERE schemaname = current_schema() ORDER BY tablename"
            }
        }
    }

    /// The query for names and types of a table's columns, without generated columns.
    pub const fn columns_query(self) -> &'static str {
        match self {
            Self::Sqlite => "SELECT name, lower(type) FROM pragma_table_xinfo($1) WHERE hidden = 0 ORDER BY cid",
            Self::Postgres => {
                "SELECT CAST(column_name AS text), CAST(data_type AS text) FROM information_schema.columns
                 WHERE table_schema = current_schema() AND table_name = $1 AND is_generated = 'NEVER' ORDER BY ordinal_position"
            }
        }
    }

    /// Statements that disable the statement timeout of a connection.
    pub const fn disable_timeout(self) -> &'static [&'static str] {
        match self {
            Self::Sqlite => &[],
            Self::Postgres => &["SET statement_timeout = 0"],
        }
    }

    /// Statements that checkpoint the write-ahead log and return its space to the disk. PostgreSQL
    /// does that by itself.
    pub const fn truncate_log(self) -> &'static [&'static str] {
        match self {
            Self::Sqlite => &["PRAGMA wal_checkpoint(TRUNCATE)"],
            Self::Postgres => &[],
        }
    }

    /// The query for the bytes that removed rows left unused. PostgreSQL reuses them and does not
    /// report their number.
    pub const fn unused_bytes(self) -> Option<&'static str> {
        match self {
            Self::Sqlite => Some(
                "SELECT freelist_count * page_size FROM pragma_freelist_count, pragma_page_size",
            ),
            Self::Postgres => None,
        }
    }

    /// Statements that return the space of removed rows to the disk. PostgreSQL does that by
    /// itself.
    pub const fn compact(self) -> &'static [&'static str] {
        match self {
            Self::Sqlite => &["VACUUM", "PRAGMA wal_checkpoint(TRUNCATE)"],
            Self::Postgres => &[],
        }
    }
}

/// A WHERE clause that is built one condition at a time, with its text parameters.
pub(super) struct SqlFilter {
    sql: String,
    values: Vec<String>,
}

impl SqlFilter {
    /// Appends conditions to `sql`, which must end in a condition.
    pub fn new(sql: impl Into<String>) -> Self {
        Self { sql: sql.into(), values: Vec::new() }
    }

    /// Adds a condition like `id <`, if there is a value.
    pub fn and_if_some(&mut self, condition: &str, value: Option<impl Into<String>>) {
        if let Some(value) = value {
            self.values.push(value.into());
            let _ = write!(self.sql, " AND {condition} ${}", self.values.len());
        }
    }

    /// Returns the first rows in an order.
    pub async fn fetch<R>(
        self,
        order: &str,
        limit: u32,
        pool: &AnyPool,
    ) -> Result<Vec<R>, StoreError>
    where
        R: for<'r> sqlx::FromRow<'r, sqlx::any::AnyRow> + Send + Unpin,
    {
        let sql = format!("{} ORDER BY {order} LIMIT ${}", self.sql, self.values.len() + 1);
        let query = self
            .values
            .into_iter()
            .fold(sqlx::query_as(sqlx::AssertSqlSafe(sql)), sqlx::query::QueryAs::bind);
        Ok(query.bind(i64::from(limit)).fetch_all(pool).await?)
    }
}

/// Replaces NUL characters, which PostgreSQL cannot store.
pub(super) fn replace_nul(text: &str) -> std::borrow::Cow<'_, str> {
    if text.contains('\0') { text.replace('\0', "\u{fffd}").into() } else { text.into() }
}

/// Converts a stored number that is never negative.
pub(super) fn to_unsigned<T: TryFrom<i64>>(kept: i64) -> sqlx::Result<T>
where
    T::Error: std::error::Error + Send + Sync + 'static,
{
    T::try_from(kept).map_err(|error| sqlx::Error::Decode(error.into()))
}

/// The database of a store, shared by its repositories.
pub struct Database {
    pub(super) reader: AnyPool,
    pub(super) writer: Writer,
    pub(super) engine: Engine,
    pub(super) ids: IdGenerator,
    pub(super) members: ClusterMembership,
    /// The PostgreSQL server, if the database is PostgreSQL.
    pub(super) server: Option<PostgresUrl>,
}

impl Database {
    /// Returns a new id, greater than all before it.
    #[must_use]
    pub fn new_id(&self) -> String {
        self.ids.new_id()
    }

    /// Checkpoints the write-ahead log and returns its space to the disk. The space of removed rows
    /// stays in the database and is reused.
    ///
    /// # Errors
    /// [`StoreError::Database`].
    pub async fn truncate_log(&self) -> Result<(), StoreError> {
        for &sql in self.engine.truncate_log() {
            sqlx::query(sql).execute(self.writer.pool()).await?;
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_location_is_displayed_without_its_password() {
        let display = |text: &str| {
            text.parse::<Location>().map(|location| format!("{location} {location:?}")).unwrap()
        };
        let place = "postgres://db.example/rooms postgres://db.example/rooms";
        assert_eq!(
            display("postgres://robot:s3cret@db.example/rooms?sslmode=require&password=s3cret"),
            place
        );
        assert_eq!(display("postgres://robot:s3?cret@db.example/rooms"), place);
        assert_eq!(
            display("postgress://robot:s3cret@db.example/rooms"),
            "postgress:// postgress://"
        );
        assert_eq!("sqlite".parse(), Ok(Location::Folder));
    }
}
