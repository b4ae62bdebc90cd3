//! Named locks within this process. Tasks with the same name run one after the other; others do not
//! wait.

use std::collections::HashMap;
use std::sync::{Arc, PoisonError, Weak};
use tokio::sync::{Mutex, OwnedMutexGuard};

/// Holds the lock until it is dropped.
pub(super) type LocalLock = OwnedMutexGuard<()>;

/// The locks by name. Cheap to clone.
#[derive(Clone, Default)]
pub(super) struct LocalLocks(Arc<std::sync::Mutex<HashMap<String, Weak<Mutex<()>>>>>);

impl LocalLocks {
    /// Waits for the lock of this name.
    pub async fn lock(&self, name: &str) -> LocalLock {
        self.mutex_of(name).lock_owned().await
    }

    /// Takes the lock of this name, if it is free.
    pub fn try_lock(&self, name: &str) -> Option<LocalLock> {
        self.mutex_of(name).try_lock_owned().ok()
    }

    fn mutex_of(&self, name: &str) -> Arc<Mutex<()>> {
        let mut locks = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        locks.retain(|_, lock| lock.strong_count() > 0);
        let lock = locks.get(name).and_then(Weak::upgrade).unwrap_or_default();
        locks.insert(name.to_owned(), Arc::downgrade(&lock));
        lock
    }
}
