//! What happens without being asked for: what was kept long enough goes, stray folders are swept,
//! damage is found before somebody meets it.

use super::{Beside, Service};
use crate::error::Error;
use std::time::Duration;
use tokio::task::spawn_blocking;
use tokio::time::sleep;
use uniground_storage::{Damage, Look};

/// The pause between two looks at a parse's files: nobody shall notice.
const PAUSE: Duration = Duration::from_secs(2);

impl Service {
    /// One round through everything.
    ///
    /// # Errors
    /// [`Error`] of the store; what was done stays done.
    pub async fn keep_house(&self) -> Result<(), Error> {
        self.store.recovery.recover_beside_others().await;
        // Copies are each process's own.
        if self.store.blobs.are_copies() {
            self.store.orphans.sweep(Beside::TheServer.settled()).await?;
        }
        // One process does the rest for all.
        let Some(_turn) = self.keeping_house().await? else { return Ok(()) };
        self.let_go(Beside::TheServer).await?;
        self.store.room_index.forget_unused_names().await?;
        // One that was retired is known to be damaged, and kept for its answers only.
        for parse in
            self.store.parses.all_parses().await?.iter().filter(|parse| !parse.is_retired())
        {
            let wrong = self.look_at_parse(&parse.id, Look::Bytes).await?;
            if let Some(Damage { file, what }) = wrong.iter().find(|damage| damage.what != "stray")
            {
                tracing::error!(parse_id = parse.id, file = %file, what, "a stored parse is damaged");
                self.retire_parse(&parse.id).await?;
            }
            sleep(PAUSE).await;
        }
        Ok(())
    }

    /// What is wrong with a parse's files.
    pub(super) async fn look_at_parse(
        &self,
        parse_id: &str,
        closely: Look,
    ) -> Result<Vec<Damage>, Error> {
        let (blobs, place) = (self.store.blobs.clone(), self.store.blobs.parse(parse_id));
        Ok(spawn_blocking(move || blobs.look(&place, closely)).await??)
    }
}
