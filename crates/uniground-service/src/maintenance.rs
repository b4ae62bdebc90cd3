//! Background maintenance: applies retention, collects orphans, and finds damage before a caller
//! does.

use super::RunMode;
use crate::error::Error;
use crate::parses::ParseCache;
use crate::{Limits, ParsedScenes, ServiceLocks};
use std::sync::Arc;
use std::time::Duration;
use tokio::time::sleep;
use uniground_storage::{
    Blobs, CheckDepth, ContentRepository, DamagedFile, OrphanRepository, ParseRepository, Recovery,
    Reserve, RetentionRepository, RoomIndexRepository,
};

/// The pause between two checks of a parse's files, so that checks do not slow down other work.
const PAUSE: Duration = Duration::from_secs(2);

/// Applies retention and removes orphans.
#[derive(Clone)]
pub struct MaintenanceService {
    pub(crate) parse_cache: Arc<ParseCache>,
    pub(crate) recovery: Recovery,
    pub(crate) blobs: Blobs,
    pub(crate) orphan_repository: OrphanRepository,
    pub(crate) room_index_repository: RoomIndexRepository,
    pub(crate) parse_repository: ParseRepository,
    pub(crate) service_locks: Arc<ServiceLocks>,
    pub(crate) parsed_scenes: Arc<ParsedScenes>,
    pub(crate) reserve: Reserve,
    pub(crate) limits: Limits,
    pub(crate) retention_repository: RetentionRepository,
    pub(crate) content_repository: ContentRepository,
}

impl MaintenanceService {
    /// Runs all maintenance once.
    ///
    /// # Errors
    /// [`Error`] of the store. What was done stays done.
    pub async fn run_maintenance(&self) -> Result<(), Error> {
        self.recovery.recover_while_shared().await;
        // Every process has its own local copies of blobs.
        if self.blobs.is_cache() {
            self.orphan_repository.collect_orphans(RunMode::Serving.min_age()).await?;
        }
        // One process does the rest for all.
        let Some(_lock) = self.service_locks.try_lock_maintenance().await? else { return Ok(()) };
        self.apply_retention(RunMode::Serving).await?;
        self.room_index_repository.delete_unused_names().await?;
        // A retired parse is known to be damaged. It is stored only for its answers.
        for parse in
            self.parse_repository.all_parses().await?.iter().filter(|parse| !parse.is_retired())
        {
            let wrong = self.parsed_scenes.check_parse_files(&parse.id, CheckDepth::Bytes).await?;
            if let Some(DamagedFile { file, what }) =
                wrong.iter().find(|damage| damage.what != "stray")
                // Deleted since the list was read, so missing files are expected.
                && self.parse_repository.parse(&parse.id).await?.is_some()
            {
                tracing::error!(parse_id = parse.id, file = %file, what, "stored parse is damaged");
                self.parsed_scenes.retire_parse(&parse.id).await?;
            }
            sleep(PAUSE).await;
        }
        Ok(())
    }
}
