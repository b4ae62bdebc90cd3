//! Turns within this process: one after the other where two at once would be in each other's way,
//! and nobody else waits for it.

use std::collections::HashMap;
use std::sync::{Arc, PoisonError, Weak};
use tokio::sync::{Mutex, OwnedMutexGuard};

/// Lasts as long as it lives.
pub(super) type LocalLock = OwnedMutexGuard<()>;

/// Who is at work on what, by its name. Cheap to clone.
#[derive(Clone, Default)]
pub(super) struct LocalLocks(Arc<std::sync::Mutex<HashMap<String, Weak<Mutex<()>>>>>);

impl LocalLocks {
    /// Waits for the turn at something.
    pub async fn at(&self, name: &str) -> LocalLock {
        self.lock_of(name).lock_owned().await
    }

    /// The turn at something, if nobody has it.
    pub fn try_at(&self, name: &str) -> Option<LocalLock> {
        self.lock_of(name).try_lock_owned().ok()
    }

    fn lock_of(&self, name: &str) -> Arc<Mutex<()>> {
        let mut locks = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        locks.retain(|_, lock| lock.strong_count() > 0);
        let lock = locks.get(name).and_then(Weak::upgrade).unwrap_or_default();
        locks.insert(name.to_owned(), Arc::downgrade(&lock));
        lock
    }
}
