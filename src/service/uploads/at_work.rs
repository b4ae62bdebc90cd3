//! One at a time: bytes of two senders never mix.

use crate::error::Error;
use std::collections::HashSet;
use std::sync::{Arc, Mutex, PoisonError};

/// Uploads that somebody is at work on.
#[derive(Default)]
pub struct AtWork {
    uploads: Mutex<HashSet<String>>,
    /// Held while one begins.
    pub beginning: tokio::sync::Mutex<()>,
}

/// The only one at work on an upload, as long as this lives.
pub struct Turn {
    at_work: Arc<AtWork>,
    id: String,
}

impl AtWork {
    /// # Errors
    /// [`Error::UploadBusy`]: somebody else is.
    pub fn turn(self: &Arc<Self>, id: &str) -> Result<Turn, Error> {
        let is_free = self.uploads.lock().unwrap_or_else(PoisonError::into_inner).insert(id.to_owned());
        match is_free {
            true => Ok(Turn { at_work: self.clone(), id: id.to_owned() }),
            false => Err(Error::UploadBusy { id: id.to_owned() }),
        }
    }
}

impl Drop for Turn {
    fn drop(&mut self) {
        self.at_work.uploads.lock().unwrap_or_else(PoisonError::into_inner).remove(&self.id);
    }
}
