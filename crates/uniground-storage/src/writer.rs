//! The one who writes. Every write is a transaction that ends on every path: one that was not
//! committed takes its connection with it, and the next write gets a new one. So neither a full
//! disk nor a caller that leaves can spoil what comes after.

use super::StoreError;
use super::database::Engine;
use sqlx::pool::PoolConnection;
use sqlx::{Any, AnyConnection, AnyPool, Executor};
use std::ops::{Deref, DerefMut};

/// Gives out connections that write, to one transaction at a time.
#[derive(Clone)]
pub(super) struct Writer {
    pool: AnyPool,
    engine: Engine,
}

impl Writer {
    pub fn new(pool: AnyPool, engine: Engine) -> Self {
        Self { pool, engine }
    }

    /// Begins a transaction that nobody else writes beside.
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

/// A transaction; it counts once it is [committed](Self::commit).
pub(super) struct Transaction {
    connection: PoolConnection<Any>,
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
            // Whatever state it is in, closing it undoes what was begun.
            self.connection.close_on_drop();
        }
    }
}
