//! What other members have done that somebody here waits for, as PostgreSQL tells it. Whoever waits
//! looks by himself now and then as well: news may be missed.

use super::StoreError;
use super::database::Database;
use sqlx::postgres::PgListener;

/// Something that another member may have done.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum DbNotification {
    /// A job of this kind waits.
    JobWaits { kind: String },
    /// A key was made or revoked.
    KeysChanged,
    /// Nobody knows: the connection was away.
    Missed,
}

const JOBS: &str = "uniground_job";
const KEYS: &str = "uniground_keys";

/// Where news come in.
pub struct NotificationListener(PgListener);

/// Notifications between processes that share a PostgreSQL database.
#[derive(Clone)]
pub struct Notifications {
    pub(super) database: Database,
}

impl Notifications {
    /// What other members do from now on; `None` where there can be none.
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
    /// Waits for the next.
    ///
    /// # Errors
    /// [`StoreError::Database`]: it is away for longer.
    pub async fn next(&mut self) -> Result<DbNotification, StoreError> {
        // Nothing: the connection broke, and is made anew with the next call.
        let Some(told) = self.0.try_recv().await? else { return Ok(DbNotification::Missed) };
        Ok(match told.channel() {
            JOBS => DbNotification::JobWaits { kind: told.payload().to_owned() },
            _ => DbNotification::KeysChanged,
        })
    }
}
