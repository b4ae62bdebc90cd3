//! Locks by name.

use super::StoreError;
use super::cluster::{ClusterMembership, NamedLock};

/// Locks by name, shared by all processes that use a database. Cheap to clone.
#[derive(Clone)]
pub struct LockTable {
    pub(super) members: ClusterMembership,
}

impl LockTable {
    /// Waits for a lock. No other task of this or another process holds it at the same time.
    ///
    /// # Errors
    /// [`StoreError::Database`].
    pub async fn lock(&self, name: &str) -> Result<NamedLock, StoreError> {
        self.members.lock(name).await
    }

    /// Takes a lock, if it is free.
    ///
    /// # Errors
    /// [`StoreError::Database`].
    pub async fn try_lock(&self, name: &str) -> Result<Option<NamedLock>, StoreError> {
        self.members.try_lock(name).await
    }

    /// Returns whether other processes may use the same database.
    #[must_use]
    pub fn is_shared(&self) -> bool {
        self.members.is_shared()
    }

    /// Returns whether no other process used the database when this one started.
    #[must_use]
    pub fn was_alone_at_start(&self) -> bool {
        self.members.was_alone
    }
}
