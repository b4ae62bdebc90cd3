//! Turns: one after the other where two at once would be in each other's way, and nobody else waits for it.

use std::collections::HashMap;
use std::sync::{Arc, PoisonError, Weak};
use tokio::sync::{Mutex, OwnedMutexGuard};

/// Who is at work on what, by its name: who comes for the same waits.
#[derive(Default)]
pub struct Turns(std::sync::Mutex<HashMap<String, Weak<Mutex<()>>>>);

impl Turns {
    /// Waits for the turn at something; it lasts as long as what comes back.
    pub async fn at(&self, name: &str) -> OwnedMutexGuard<()> {
        let lock: Arc<Mutex<()>> = {
            let mut locks = self.0.lock().unwrap_or_else(PoisonError::into_inner);
            locks.retain(|_, lock| lock.strong_count() > 0);
            let lock = locks.get(name).and_then(Weak::upgrade).unwrap_or_default();
            locks.insert(name.to_owned(), Arc::downgrade(&lock));
            lock
        };
        lock.lock_owned().await
    }
}
