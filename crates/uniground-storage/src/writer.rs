//! The write connections. Every write is a transaction that ends on every path: dropping one
//! without a commit closes its connection, and the next write gets a new one. So neither a full
//! disk nor a cancelled caller can affect later writes.

use super::StoreError;
use super::database::Engine;
use sqlx::pool::PoolConnection;
use sqlx::{Any, AnyConnection, AnyPool, Executor};
use std::ops::{Deref, DerefMut};

/// Hands out write connections, to one transaction at a time.
#[derive(Clone)]
pub(super) struct Writer {
    pool: AnyPool,
    engine: Engine,
}

impl Writer {
    pub fn new(pool: AnyPool, engine: Engine) -> Self {
        Self { pool, engine }
    }

    /// Begins a write transaction; no other one runs at the same time.
    pub async fn begin(&self) -> Result<Transaction, StoreError> {
        let mut transaction = Transaction { connection: self.pool.acquire().await?, ended: false };
        transaction.execute(self.engine.begin()).await?;
        Ok(transaction)
    }

    pub fn engine(&self) -> Engine {
        self.engine
    }

    pub fn pool(&self) -> &AnyPool {
        &self.pool
    }

    pub async fn close(&self) {
        self.pool.close().await;
    }
}

/// A transaction. It takes effect when it is [committed](Self::commit).
pub(super) struct Transaction {
    connection: PoolConnection<Any>,
    ended: bool,
}

impl Transaction {
    /// Commits it durably to disk.
    pub async fn commit(mut self) -> Result<(), StoreError> {
        sqlx::query("COMMIT").execute(&mut *self.connection).await?;
        self.ended = true;
        Ok(())
    }

    /// Rolls it back.
    pub async fn rollback(mut self) -> Result<(), StoreError> {
        sqlx::query("ROLLBACK").execute(&mut *self.connection).await?;
        self.ended = true;
        Ok(())
    }
}

impl Deref for Transaction {
    type Target = AnyConnection;

    fn deref(&self) -> &AnyConnection {
        &self.connection
    }
}

impl DerefMut for Transaction {
    fn deref_mut(&mut self) -> &mut AnyConnection {
        &mut self.connection
    }
}

impl Drop for Transaction {
    fn drop(&mut self) {
        if !self.ended {
            // Closing the connection rolls back, whatever state it is in.
            self.connection.close_on_drop();
        }
    }
}
