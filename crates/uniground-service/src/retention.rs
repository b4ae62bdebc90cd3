//! Removes data whose retention has expired: once a day while the server runs, and at once with
//! `uniground gc`.
//!
//! A run takes small steps: a few hundred rows at a time, each step in a short transaction, with
//! pauses for other users of the database. Rows are removed first, then the folders they referred
//! to. Orphans that a crash leaves in between are moved to the quarantine.

use crate::MaintenanceService;
use crate::error::Error;
use camino::Utf8PathBuf;
use jiff::Timestamp;
use serde::Serialize;
use std::collections::HashSet;
use std::time::{Duration, SystemTime};
use tokio::task::spawn_blocking;
use tokio::time::sleep;
use uniground_storage::{
    Cutoff, ExpiredRow, KEEP_QUARANTINE_DAYS, RetentionKind, StoredCheckpoints, size_of,
};
use uniground_types::stats::Retention;

/// The removed data of one kind.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct RetentionReport {
    pub kind: &'static str,
    pub entries: u64,
    pub bytes: u64,
    pub why: String,
}

/// Rows removed in one transaction.
const ROWS_PER_TRANSACTION: u32 = 200;
const DAY: Duration = Duration::from_hours(24);

/// The number of removed entries of one kind, and their size.
#[derive(Default)]
struct RemovedSoFar {
    entries: u64,
    bytes: u64,
}

impl RemovedSoFar {
    fn into_report(self, kind: &'static str, why: String) -> RetentionReport {
        RetentionReport { kind, entries: self.entries, bytes: self.bytes, why }
    }
}

/// Whether a server uses the store during a run.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum RunMode {
    Offline,
    /// Pauses for questions, and skips data that is being written.
    Serving,
}

impl RunMode {
    /// Pauses between two steps.
    async fn pause(self) {
        const STEP_PAUSE: Duration = Duration::from_millis(50);
        if self == Self::Serving {
            sleep(STEP_PAUSE).await;
        }
    }

    /// Returns the age below which data may be incomplete.
    pub(super) fn min_age(self) -> Duration {
        match self {
            Self::Offline => Duration::ZERO,
            Self::Serving => Duration::from_hours(1),
        }
    }
}

/// A retention run.
struct RetentionRun<'a> {
    service: &'a MaintenanceService,
    mode: RunMode,
    now: Timestamp,
    /// Folders that were removed, or would be. None is counted twice.
    folders: HashSet<Utf8PathBuf>,
}

impl MaintenanceService {
    /// Removes all data whose retention has expired, in small steps. Returns what was removed, by
    /// kind. If the disk is full, the reserve is released to make room.
    ///
    /// # Errors
    /// [`Error`] of the store. What was removed stays removed.
    pub async fn apply_retention(&self, mode: RunMode) -> Result<Vec<RetentionReport>, Error> {
        let removed = match self.try_to_apply_retention(mode).await {
            Err(error) if error.is_disk_full() && self.reserve.release_reserve() => {
                self.try_to_apply_retention(mode).await
            }
            done => done,
        }?;
        self.reserve.restore_reserve().await;
        Ok(removed)
    }

    async fn try_to_apply_retention(&self, mode: RunMode) -> Result<Vec<RetentionReport>, Error> {
        let mut round =
            RetentionRun { service: self, mode, now: Timestamp::now(), folders: HashSet::new() };
        let Retention {
            answers_days,
            jobs_days,
            batches_days,
            idempotency_days,
            audit_days,
            superseded_days,
            uploads_days,
            ..
        } = self.limits.retention;
        // First, because it looks for folders without rows, and a dry run leaves some.
        let quarantine = round.collect_orphan_folders().await?;
        let mut removed = vec![
            round.remove_transcripts().await?,
            round.remove_rows(RetentionKind::Answers, answers_days, "answers").await?,
            round.remove_rows(RetentionKind::Batches, batches_days, "batches").await?,
            // After batches and answers, which refer to jobs and parses.
            round.remove_rows(RetentionKind::Jobs, jobs_days, "jobs").await?,
            round
                .remove_rows(RetentionKind::IdempotencyKeys, idempotency_days, "idempotency keys")
                .await?,
            round
                .remove_rows(
                    RetentionKind::QuestionKeys,
                    idempotency_days,
                    "idempotency keys of questions",
                )
                .await?,
            round.remove_rows(RetentionKind::Audit, audit_days, "audit").await?,
            round.remove_superseded_parses(superseded_days).await?,
            // After the parses of these contents.
            round.remove_outgrown_contents(superseded_days).await?,
            round.remove_rows(RetentionKind::Uploads, uploads_days, "uploads in parts").await?,
            round.remove_checkpoints().await?,
            quarantine,
        ];
        if self.blobs.is_cache() {
            removed.push(round.remove_orphan_objects().await?);
        }
        for RetentionReport { kind, entries, bytes, why } in
            removed.iter().filter(|removed| removed.entries > 0)
        {
            tracing::info!(kind, entries, bytes, why, "retention applied");
        }
        Ok(removed)
    }
}

impl RetentionRun<'_> {
    async fn remove_transcripts(&mut self) -> Result<RetentionReport, Error> {
        let days = self.service.limits.retention.evidence_days;
        let blobs = self.service.blobs.clone();
        let old = spawn_blocking(move || {
            blobs.list_folders_older_than("answers", DAY * days, SystemTime::now())
        })
        .await??;
        let mut removed_so_far = RemovedSoFar::default();
        for names in old.chunks(ROWS_PER_TRANSACTION as usize) {
            let folders = names.iter().map(|name| self.service.blobs.answer(name)).collect();
            removed_so_far.bytes += self.discard(folders).await?;
            removed_so_far.entries += names.len() as u64;
        }
        Ok(removed_so_far.into_report("evidence", format!("{days} days after the answer")))
    }

    /// Removes the expired rows of a kind, with their files.
    async fn remove_rows(
        &mut self,
        aged: RetentionKind,
        days: u32,
        kind: &'static str,
    ) -> Result<RetentionReport, Error> {
        let mut removed_so_far = RemovedSoFar::default();
        if days == 0 {
            return Ok(removed_so_far.into_report(kind, "kept for ever".into()));
        }
        let before = Cutoff::days_ago(days, self.now);
        let rows = &self.service.retention_repository;
        let blobs = &self.service.blobs;
        let mut after = String::new();
        loop {
            let due = rows.due(aged, &before, &after, ROWS_PER_TRANSACTION).await?;
            let Some(last) = due.last() else { break };
            after.clone_from(&last.id);
            let removed = rows
                .remove_due(
                    aged,
                    &before,
                    &due.iter().map(|due| due.id.as_str()).collect::<Vec<_>>(),
                )
                .await?;
            removed_so_far.count(&due, &removed);
            let folders = match aged {
                RetentionKind::Answers => removed.iter().map(|id| blobs.answer(id)).collect(),
                RetentionKind::Uploads => removed.iter().map(|id| blobs.upload(id)).collect(),
                _ => Vec::new(),
            };
            removed_so_far.bytes += self.discard(folders).await?;
            self.mode.pause().await;
        }
        Ok(removed_so_far.into_report(kind, format!("over {days} days old")))
    }

    /// Removes parses one by one, because they are large with their instances.
    async fn remove_superseded_parses(&mut self, days: u32) -> Result<RetentionReport, Error> {
        const KIND: &str = "superseded parses";
        let (service, mut removed_so_far) = (self.service, RemovedSoFar::default());
        service.retention_repository.mark_superseded_parses(self.now).await?;
        if days == 0 {
            return Ok(removed_so_far.into_report(KIND, "kept for ever".into()));
        }
        let before = Cutoff::days_ago(days, self.now);
        let mut after = String::new();
        while let Some(due) = service
            .retention_repository
            .due(RetentionKind::SupersededParses, &before, &after, 1)
            .await?
            .pop()
        {
            after.clone_from(&due.id);
            let removed = {
                // The locks prevent a scene from taking the parse while it is removed.
                let _references = (
                    service.service_locks.lock_content_references().await?,
                    service.service_locks.lock_parse_references().await?,
                );
                service
                    .retention_repository
                    .remove_due(RetentionKind::SupersededParses, &before, &[&due.id])
                    .await?
            };
            for id in &removed {
                service.parse_cache.forget(id);
                service.parse_cache.render_scenes.remove(id);
                removed_so_far.bytes += self.discard(vec![service.blobs.parse(id)]).await?;
            }
            removed_so_far.count(&[due], &removed);
            self.mode.pause().await;
        }
        Ok(removed_so_far.into_report(
            KIND,
            format!("no scene and no answer has referred to them for {days} days"),
        ))
    }

    /// Removes the contents of scans before they grew. The grown scan shares their files, so mostly
    /// links are removed.
    async fn remove_outgrown_contents(&mut self, days: u32) -> Result<RetentionReport, Error> {
        const KIND: &str = "outgrown scans";
        let (service, mut removed_so_far) = (self.service, RemovedSoFar::default());
        if days == 0 {
            return Ok(removed_so_far.into_report(KIND, "kept for ever".into()));
        }
        for hash in service.content_repository.outgrown_contents(ROWS_PER_TRANSACTION).await? {
            let folders = {
                let _references = (
                    service.service_locks.lock_content_references().await?,
                    service.service_locks.lock_parse_references().await?,
                );
                service.content_repository.remove_outgrown(&hash).await?
            };
            removed_so_far.entries += u64::from(!folders.is_empty());
            removed_so_far.bytes += self.discard(folders).await?;
            self.mode.pause().await;
        }
        Ok(removed_so_far
            .into_report(KIND, "their scenes have grown, and no parse is of them any more".into()))
    }

    async fn remove_checkpoints(&mut self) -> Result<RetentionReport, Error> {
        let Retention { checkpoints_days: days, checkpoints_bytes: most, .. } =
            self.service.limits.retention;
        let blobs = self.service.blobs.clone();
        let kept = spawn_blocking(move || blobs.list_checkpoints()).await??;
        let oldest =
            if days == 0 { SystemTime::UNIX_EPOCH } else { SystemTime::now() - DAY * days };
        let mut removed_so_far = RemovedSoFar::default();
        for StoredCheckpoints { hash, bytes, .. } in expired_checkpoints(kept, oldest, most) {
            // The locks prevent a parse from starting between the check and the removal.
            let references = (
                self.service.service_locks.lock_content_references().await?,
                self.service.service_locks.lock_parse_references().await?,
            );
            if !self.service.retention_repository.contents_in_work().await?.contains(&hash) {
                self.discard(vec![self.service.blobs.checkpoints(&hash)]).await?;
                removed_so_far.entries += 1;
                removed_so_far.bytes += bytes;
            }
            drop(references);
            self.mode.pause().await;
        }
        Ok(removed_so_far.into_report(
            "checkpoints",
            format!(
                "not used for {days} days, or together more than {most} bytes; they only save time"
            ),
        ))
    }

    async fn collect_orphan_folders(&self) -> Result<RetentionReport, Error> {
        let (entries, bytes) =
            self.service.orphan_repository.collect_orphans(self.mode.min_age()).await?;
        Ok(RemovedSoFar { entries, bytes }.into_report(
            "quarantine",
            format!("no record speaks of them, for over {KEEP_QUARANTINE_DAYS} days"),
        ))
    }

    /// Removes orphan objects one by one. Each is checked again right before its removal.
    async fn remove_orphan_objects(&self) -> Result<RetentionReport, Error> {
        let (service, mut removed_so_far) = (self.service, RemovedSoFar::default());
        for orphan in service.orphan_repository.orphan_objects().await? {
            let references = (
                service.service_locks.lock_content_references().await?,
                service.service_locks.lock_parse_references().await?,
            );
            if service.orphan_repository.remove_orphan(&orphan).await? {
                removed_so_far.entries += 1;
                removed_so_far.bytes += orphan.bytes();
            }
            drop(references);
            self.mode.pause().await;
        }
        Ok(removed_so_far.into_report(
            "orphaned objects",
            "no record speaks of them, for longer than the grace period".into(),
        ))
    }

    /// Removes folders in the background. Returns their size in bytes.
    async fn discard(&mut self, folders: Vec<Utf8PathBuf>) -> Result<u64, Error> {
        let folders: Vec<_> =
            folders.into_iter().filter(|folder| self.folders.insert(folder.clone())).collect();
        let measured = folders.clone();
        let bytes = spawn_blocking(move || {
            measured.iter().map(|folder| size_of(folder)).sum::<std::io::Result<u64>>()
        })
        .await??;
        let aside = self.service.orphan_repository.set_aside(folders).await?;
        self.service.blobs.remove_later(aside);
        Ok(bytes)
    }
}

impl RemovedSoFar {
    /// Counts the expired rows that were removed.
    fn count(&mut self, due: &[ExpiredRow], removed: &[String]) {
        let removed: HashSet<&str> = removed.iter().map(String::as_str).collect();
        for due in due.iter().filter(|due| removed.contains(due.id.as_str())) {
            self.entries += 1;
            self.bytes += due.bytes;
        }
    }
}

/// Returns the checkpoints to remove, the longest unused first: those last used before `oldest`,
/// and those that exceed `most` bytes in total.
fn expired_checkpoints(
    kept: Vec<StoredCheckpoints>,
    oldest: SystemTime,
    most: u64,
) -> Vec<StoredCheckpoints> {
    let mut total: u64 = kept.iter().map(|kept| kept.bytes).sum();
    let mut going = Vec::new();
    for kept in kept {
        if kept.used < oldest || total > most {
            total -= kept.bytes;
            going.push(kept);
        }
    }
    going
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn checkpoints_expire_by_age_then_least_recently_used_to_fit_the_limit() {
        let at = |days: u32| SystemTime::UNIX_EPOCH + DAY * days;
        let kept = |hash: &str, days, bytes| StoredCheckpoints {
            hash: hash.into(),
            bytes,
            used: at(days),
        };
        let all = vec![
            kept("old", 1, 10),
            kept("large", 5, 1000),
            kept("small", 6, 10),
            kept("new", 9, 100),
        ];
        let going = |oldest, most| {
            expired_checkpoints(all.clone(), oldest, most)
                .into_iter()
                .map(|kept| kept.hash)
                .collect::<Vec<_>>()
        };
        assert_eq!(going(at(0), 2000), [""; 0]);
        assert_eq!(going(at(2), 2000), ["old"]);
        assert_eq!(going(at(0), 1110), ["old"]);
        assert_eq!(going(at(0), 500), ["old", "large"]);
        assert_eq!(going(at(0), 0), ["old", "large", "small", "new"]);
    }
}
