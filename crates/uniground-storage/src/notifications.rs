//! Notifications from other processes, by PostgreSQL's LISTEN/NOTIFY. Notifications may be lost, so
//! their receivers also poll from time to time.

use super::StoreError;
use super::database::Database;
use sqlx::postgres::PgListener;
use std::sync::Arc;

/// A change that another process has made.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum DbNotification {
    /// A job of this kind was queued.
    JobQueued { kind: String },
    /// A key was created or revoked.
    KeysChanged,
    /// The connection was interrupted: notifications may have been lost.
    ConnectionLost,
}

const JOBS: &str = "uniground_job";
const KEYS: &str = "uniground_keys";

/// Receives notifications.
pub struct NotificationListener(PgListener);

/// Notifications between processes that share a PostgreSQL database.
#[derive(Clone)]
pub struct Notifications {
    pub(super) database: Arc<Database>,
}

impl Notifications {
    /// Starts listening. Returns `None` where the database has no other processes.
    ///
    /// # Errors
    /// [`StoreError::Database`].
    pub async fn listen(&self) -> Result<Option<NotificationListener>, StoreError> {
        let Some(url) = &self.database.server else { return Ok(None) };
        let mut listener = PgListener::connect(url.with_password()).await?;
        listener.listen_all([JOBS, KEYS]).await?;
        Ok(Some(NotificationListener(listener)))
    }
}

impl NotificationListener {
    /// Waits for the next notification.
    ///
    /// # Errors
    /// [`StoreError::Database`]: the database stays unavailable.
    pub async fn next(&mut self) -> Result<DbNotification, StoreError> {
        // `None` means that the connection was lost. The next call reconnects.
        let Some(notification) = self.0.try_recv().await? else {
            return Ok(DbNotification::ConnectionLost);
        };
        Ok(match notification.channel() {
            JOBS => DbNotification::JobQueued { kind: notification.payload().to_owned() },
            _ => DbNotification::KeysChanged,
        })
    }
}
