//! A lock on an open file that ends when its owner drops it.

use std::fs::{File, TryLockError};
use std::io;

/// A locked file. Dropping it unlocks the file at once. Closing the file alone would not: a child
/// process that is being started has a copy of the descriptor, and with it the lock, until it
/// executes its program.
#[derive(Debug)]
pub struct FileLock(File);

impl FileLock {
    /// Locks the file for this process alone, after waiting for others.
    ///
    /// # Errors
    /// Returns an error if the file system cannot lock files.
    pub fn exclusive(file: File) -> io::Result<Self> {
        file.lock()?;
        Ok(Self(file))
    }

    /// Locks the file for this process alone.
    ///
    /// # Errors
    /// [`TryLockError::WouldBlock`] if another open file holds the lock.
    pub fn try_exclusive(file: File) -> Result<Self, TryLockError> {
        file.try_lock()?;
        Ok(Self(file))
    }

    /// Locks the file together with others that share it.
    ///
    /// # Errors
    /// [`TryLockError::WouldBlock`] if another open file holds the lock exclusively.
    pub fn try_shared(file: File) -> Result<Self, TryLockError> {
        file.try_lock_shared()?;
        Ok(Self(file))
    }

    /// Replaces an exclusive lock by a shared one. Another process may lock the file in between.
    ///
    /// # Errors
    /// As [`Self::try_shared`].
    pub fn share(&self) -> Result<(), TryLockError> {
        self.0.unlock().map_err(TryLockError::Error)?;
        self.0.try_lock_shared()
    }
}

impl Drop for FileLock {
    fn drop(&mut self) {
        // An error leaves the lock until the file is closed.
        let _unlocked = self.0.unlock();
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_dropped_lock_is_free_although_a_copy_of_its_descriptor_is_open() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("lock");
        let open = || File::create(&path).unwrap();
        let file = open();
        let copy = file.try_clone().unwrap();
        let lock = FileLock::try_exclusive(file).unwrap();
        assert!(matches!(FileLock::try_exclusive(open()), Err(TryLockError::WouldBlock)));
        drop(lock);
        let shared = FileLock::exclusive(open()).unwrap();
        shared.share().unwrap();
        FileLock::try_shared(open()).unwrap();
        assert!(matches!(FileLock::try_exclusive(open()), Err(TryLockError::WouldBlock)));
        drop(copy);
    }
}
