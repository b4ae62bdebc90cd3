//! The one writing connection. Every write is a transaction that ends on every path: one that was not committed takes its connection with
//! it, and the next write gets a new one. So neither a full disk nor a caller that leaves can spoil what comes after.

use super::StoreError;
use sqlx::pool::PoolConnection;
use sqlx::sqlite::{SqliteConnectOptions, SqlitePool, SqlitePoolOptions};
use sqlx::{Sqlite, SqliteConnection};
use std::ops::{Deref, DerefMut};
use std::time::Duration;

/// How long a write waits for its turn. SQLite's own wait for a lock is shorter.
const TURN: Duration = Duration::from_secs(2);

/// Gives out the writing connection, to one writer at a time.
#[derive(Clone)]
pub(super) struct Writer {
    pool: SqlitePool,
}

impl Writer {
    pub async fn open(options: SqliteConnectOptions) -> Result<Self, StoreError> {
        let pool = SqlitePoolOptions::new().max_connections(1).acquire_timeout(TURN).connect_with(options).await?;
        Ok(Self { pool })
    }

    /// Begins a transaction that nobody else writes beside.
    pub async fn begin(&self) -> Result<Transaction, StoreError> {
        let mut transaction = Transaction { connection: self.pool.acquire().await?, ended: false };
        sqlx::query("BEGIN IMMEDIATE").execute(&mut *transaction).await?;
        Ok(transaction)
    }

    pub fn pool(&self) -> &SqlitePool {
        &self.pool
    }

    pub async fn close(&self) {
        self.pool.close().await;
    }
}

/// A transaction; it counts once it is [committed](Self::commit).
pub(super) struct Transaction {
    connection: PoolConnection<Sqlite>,
    ended: bool,
}

impl Transaction {
    /// Makes it count: on the disk, not only in memory.
    pub async fn commit(mut self) -> Result<(), StoreError> {
        sqlx::query("COMMIT").execute(&mut *self.connection).await?;
        self.ended = true;
        Ok(())
    }

    /// Ends it without effect.
    pub async fn forget(mut self) -> Result<(), StoreError> {
        sqlx::query("ROLLBACK").execute(&mut *self.connection).await?;
        self.ended = true;
        Ok(())
    }
}

impl Deref for Transaction {
    type Target = SqliteConnection;

    fn deref(&self) -> &SqliteConnection {
        &self.connection
    }
}

impl DerefMut for Transaction {
    fn deref_mut(&mut self) -> &mut SqliteConnection {
        &mut self.connection
    }
}

impl Drop for Transaction {
    fn drop(&mut self) {
        if !self.ended {
            // Whatever state it is in, closing it undoes what was begun.
            self.connection.close_on_drop();
        }
    }
}
