//! Recovery at start: clears what an interrupted run left behind.
//!
//! Steps are independent. A step that fails is logged, and its rows and files stay, so that
//! recovery never prevents a server from starting.

use super::database::Database;
use super::growth::OUTGROWN;
use super::{
    BatchRepository, Blobs, ContentRepository, OrphanRepository, SpendingRepository, StoreError,
    UploadRepository,
};
use sqlx::AssertSqlSafe;
use std::sync::Arc;
use std::time::Duration;

/// Files younger than this may belong to a process that is still running.
const IN_USE: Duration = Duration::from_hours(24);

/// Clears what an interrupted run left behind.
#[derive(Clone)]
pub struct Recovery {
    pub(super) database: Arc<Database>,
    pub(super) batches: BatchRepository,
    pub(super) blobs: Blobs,
    pub(super) contents: ContentRepository,
    pub(super) orphans: OrphanRepository,
    pub(super) spending: SpendingRepository,
    pub(super) uploads: UploadRepository,
}

impl Recovery {
    /// Clears what interrupted processes left. If no other process uses the store, also removes
    /// unused rows, orphan folders and unfinished uploads. Returns the error of a step that failed
    /// because the disk is full.
    pub(super) async fn recover(&self) -> Option<StoreError> {
        let interrupted = self.finish_interrupted_work().await;
        if !self.database.members.was_alone {
            return interrupted;
        }
        let steps = [
            interrupted,
            log_failure("remove unused parses and scans", self.remove_unused_rows().await),
            log_failure(
                "move unreferenced folders to the quarantine",
                self.orphans.collect_orphans(Duration::ZERO).await,
            ),
            log_failure(
                "remove files of unfinished uploads",
                self.uploads.remove_stray_uploads().await,
            ),
            log_failure("remove temporary files", self.remove_temporary(Duration::ZERO)),
        ];
        steps.into_iter().flatten().next()
    }

    /// Clears what crashed processes left, while this process and others use the store.
    pub async fn recover_while_shared(&self) {
        self.finish_interrupted_work().await;
        log_failure(
            "remove files of unfinished uploads",
            self.uploads.remove_stray_uploads().await,
        );
        log_failure("remove temporary files", self.remove_temporary(IN_USE));
    }

    /// Ends interrupted work of crashed processes: batches being received, and money reserved for
    /// model calls.
    async fn finish_interrupted_work(&self) -> Option<StoreError> {
        let received = log_failure(
            "remove batches that were not received completely",
            self.batches.delete_unsubmitted_batches().await,
        );
        let settled = log_failure(
            "settle reserved spending",
            self.spending.settle_abandoned_reservations().await,
        );
        received.or(settled)
    }

    fn remove_temporary(&self, age: Duration) -> Result<(), StoreError> {
        let left_behind = self.blobs.list_leftovers(age)?;
        self.blobs.remove_later(left_behind);
        Ok(())
    }

    /// Removes parses and contents that no scene and no answer refers to, in one transaction: the
    /// loser of two uploads under one idempotency key, or the parse that a scene had before it
    /// grew.
    async fn remove_unused_rows(&self) -> Result<(), StoreError> {
        let mut tx = self.database.writer.begin().await?;
        // A scene that has grown refers to the parse of its earlier content until the new one
        // finishes.
        let parses = "DELETE FROM parses
                      WHERE NOT EXISTS (SELECT 1 FROM scenes WHERE scenes.content_hash = parses.content_hash OR scenes.parse_id = parses.id)
                      AND NOT EXISTS (SELECT 1 FROM answers WHERE answers.parse_id = parses.id)";
        sqlx::query(parses).execute(&mut *tx).await?;
        let unused = format!("SELECT hash FROM contents WHERE {OUTGROWN}");
        let unused: Vec<String> =
            sqlx::query_scalar(AssertSqlSafe(unused)).fetch_all(&mut *tx).await?;
        for hash in unused {
            self.contents.remove_outgrown_row(&mut tx, &hash).await?;
        }
        tx.commit().await
    }
}

/// Logs the error of a step. Returns it if the disk is full: the step may succeed once there is
/// space.
fn log_failure<T>(step: &'static str, outcome: Result<T, StoreError>) -> Option<StoreError> {
    let error = outcome.err()?;
    tracing::error!(
        step,
        error = &error as &dyn std::error::Error,
        "recovery step failed; its rows and files are kept"
    );
    error.is_full().then_some(error)
}
