//! Orphan folders: folders that no row refers to. They are never removed at once: if a database was
//! lost, replaced or restored, the database is wrong and not the folder. Orphans go to quarantine,
//! and are removed from there after a week. Where the database cannot judge a folder, it stays in
//! place.

use super::blobs::{KINDS, remove_tree, size_of};
use super::data_folder::DataFolder;
use super::database::Database;
use super::{Blobs, Scratch, StoreError, now};
use camino::Utf8PathBuf;
use jiff::Timestamp;
use jiff::civil::Date;
use std::sync::Arc;
use std::time::{Duration, SystemTime};
use std::{fs, io};
use tokio::task::spawn_blocking;

/// Days in quarantine.
const QUARANTINE_DAYS: i64 = 7;
/// Days in quarantine, for reports.
pub const KEEP_QUARANTINE_DAYS: u32 = QUARANTINE_DAYS as u32;
/// Names looked up in one query.
const CHUNK: usize = 500;

/// Which files a database may judge: none that are older than `since`, and none at all if it is
/// empty.
pub(super) struct OrphanRule {
    pub since: Option<SystemTime>,
    pub knows_nothing: bool,
}

/// Folders that no row refers to.
#[derive(Debug, Default, Clone, PartialEq, Eq)]
pub struct OrphanFolders {
    /// Orphans that may be removed: kind and name.
    pub unclaimed: Vec<(&'static str, String)>,
    /// Folders the database cannot judge, because it is younger or empty.
    pub unjudged: Vec<(&'static str, String)>,
}

/// Repository of orphans: finds folders and objects without rows, quarantines and removes them.
#[derive(Clone)]
pub struct OrphanRepository {
    pub(super) database: Arc<Database>,
    pub(super) blobs: Blobs,
    pub(super) folder: DataFolder,
}

impl OrphanRepository {
    /// Finds orphan folders. A folder is put in place before its row is written, so while a server
    /// runs, folders younger than `settled` are not orphans.
    ///
    /// # Errors
    /// [`StoreError`].
    pub async fn orphan_folders(&self, settled: Duration) -> Result<OrphanFolders, StoreError> {
        let OrphanRule { since, knows_nothing } = self.orphan_rule().await?;
        let mut unknown: Vec<(&'static str, String)> = Vec::new();
        for kind in KINDS {
            let names = self.blobs.names(kind)?;
            unknown.extend(
                self.find_unreferenced(kind, names).await?.into_iter().map(|name| (kind, name)),
            );
        }
        let mut orphan_folders = OrphanFolders::default();
        for (kind, name) in unknown {
            let made = match fs::metadata(self.blobs.folder_path(kind, &name)) {
                // Another process removed it meanwhile.
                Err(error) if error.kind() == io::ErrorKind::NotFound => continue,
                made => made?.modified()?,
            };
            // A time in the future counts as young, too.
            if !settled.is_zero() && made.elapsed().unwrap_or_default() < settled {
                continue;
            }
            match knows_nothing || since.is_none_or(|since| made < since) {
                true => orphan_folders.unjudged.push((kind, name)),
                false => orphan_folders.unclaimed.push((kind, name)),
            }
        }
        Ok(orphan_folders)
    }

    /// Returns which files the database may judge.
    pub(super) async fn orphan_rule(&self) -> Result<OrphanRule, StoreError> {
        let since: Option<String> = sqlx::query_scalar("SELECT since FROM data_folder")
            .fetch_optional(&self.database.reader)
            .await?;
        let since = since.and_then(|since| since.parse::<Timestamp>().ok()).map(SystemTime::from);
        let any: Option<String> = sqlx::query_scalar("SELECT hash FROM contents LIMIT 1")
            .fetch_optional(&self.database.reader)
            .await?;
        Ok(OrphanRule { since, knows_nothing: any.is_none() })
    }

    /// Returns the names of those folders of a kind that no row refers to.
    pub(super) async fn find_unreferenced(
        &self,
        kind: &str,
        names: Vec<String>,
    ) -> Result<Vec<String>, StoreError> {
        let (table, key) = match kind {
            "contents" | "checkpoints" => ("contents", "hash"),
            kind => (kind, "id"),
        };
        let here = self.database.engine.json_texts("$1");
        let sql = format!(
            "SELECT value FROM {here} AS here WHERE NOT EXISTS (SELECT 1 FROM {table} WHERE {key} = value)"
        );
        let mut unknown = Vec::new();
        for names in names.chunks(CHUNK) {
            let names = serde_json::to_string(names)?;
            let missing: Vec<String> = sqlx::query_scalar(sqlx::AssertSqlSafe(sql.clone()))
                .bind(names)
                .fetch_all(&self.database.reader)
                .await?;
            unknown.extend(missing);
        }
        Ok(unknown)
    }

    /// Moves orphan folders to quarantine, and removes those whose time in quarantine is over.
    /// Returns the number of removed days and bytes. `settled` as for
    /// [`orphan_folders`](Self::orphan_folders).
    ///
    /// # Errors
    /// [`StoreError`].
    pub async fn collect_orphans(&self, settled: Duration) -> Result<(u64, u64), StoreError> {
        let OrphanFolders { unclaimed, unjudged } = self.orphan_folders(settled).await?;
        if self.blobs.is_cache() {
            let places = unclaimed
                .iter()
                .chain(&unjudged)
                .map(|(kind, name)| self.blobs.folder_path(kind, name))
                .collect();
            self.blobs.remove_later(self.blobs.evict_copies(places).await?);
            return self.empty_quarantine().await;
        }
        if !unjudged.is_empty() {
            let folders = unjudged.len();
            tracing::warn!(
                folders,
                "keeping scans or parses without a row: the database is empty or newer than they are; \
                 `uniground doctor` lists them"
            );
        }
        if !unclaimed.is_empty() {
            tracing::warn!(
                folders = unclaimed.len(),
                days = QUARANTINE_DAYS,
                "moving orphan folders to the quarantine"
            );
            self.quarantine(unclaimed).await?;
        }
        if unjudged.is_empty() { self.empty_quarantine().await } else { Ok((0, 0)) }
    }

    /// Moves folders away whose rows were just removed. They are removed when the result is
    /// dropped. The name of a content is its hash: if this process hung for longer than a lease
    /// between rows and folders, the same content may have been uploaded again, and its folder is
    /// put back.
    ///
    /// # Errors
    /// [`StoreError`].
    pub async fn set_aside(&self, folders: Vec<Utf8PathBuf>) -> Result<Vec<Scratch>, StoreError> {
        let (contents, others): (Vec<_>, Vec<_>) =
            folders.into_iter().partition(|folder| self.blobs.is_content(folder));
        let mut aside = self.blobs.set_aside(others).await?;
        for content in contents {
            let hash = content.file_name().unwrap_or_default().to_owned();
            for taken in self.blobs.set_aside(vec![content.clone()]).await? {
                match self.find_unreferenced("contents", vec![hash.clone()]).await {
                    Ok(unknown) if !unknown.is_empty() => aside.push(taken),
                    // If the rows cannot be read, the folder is left to orphan collection.
                    claimed => {
                        tracing::warn!(
                            hash,
                            is_known = claimed.is_ok(),
                            "scan may have been uploaded again while its last scene was deleted; keeping it"
                        );
                        self.blobs.put_back(taken, content.clone()).await?;
                    }
                }
            }
        }
        Ok(aside)
    }

    /// Moves folders out of `blobs/` to quarantine, from where they can be recovered. Folders that
    /// have a row again are put back.
    ///
    /// # Errors
    /// Errors of the file system.
    pub async fn quarantine(&self, folders: Vec<(&'static str, String)>) -> Result<(), StoreError> {
        if !self.blobs.is_writable() {
            return Ok(());
        }
        let today = self.folder.path().join("quarantine").join(&now()[..10]);
        for (kind, name) in folders {
            fs::create_dir_all(today.join(kind))?;
            let (from, to) = (self.blobs.folder_path(kind, &name), today.join(kind).join(&name));
            if to.exists() {
                // The same folder twice in a day: the first one stays.
                remove_tree(&from, self.blobs.tmp())?;
            } else {
                fs::rename(&from, &to)?;
                if self.find_unreferenced(kind, vec![name.clone()]).await?.is_empty() {
                    tracing::warn!(kind, name, "folder is referenced again; keeping it");
                    fs::rename(&to, &from)
                        .or_else(|error| if from.exists() { Ok(()) } else { Err(error) })?;
                }
            }
        }
        Ok(())
    }

    async fn empty_quarantine(&self) -> Result<(u64, u64), StoreError> {
        let (quarantine, blobs) = (self.folder.path().join("quarantine"), self.blobs.clone());
        let today: Date = Timestamp::now().to_zoned(jiff::tz::TimeZone::UTC).date();
        let removed = spawn_blocking(move || {
            let (mut removed, mut bytes) = (0, 0);
            let days = match quarantine.read_dir_utf8() {
                Err(error) if error.kind() == io::ErrorKind::NotFound => return Ok((0, 0)),
                days => days?,
            };
            for day in days {
                let day = day?;
                let age =
                    day.file_name().parse::<Date>().ok().and_then(|date| today.since(date).ok());
                if age.is_some_and(|age| i64::from(age.get_days()) > QUARANTINE_DAYS) {
                    bytes += size_of(day.path())?;
                    removed += 1;
                    if blobs.is_writable() {
                        remove_tree(day.path(), blobs.tmp())?;
                    }
                }
            }
            Ok::<_, io::Error>((removed, bytes))
        });
        Ok(removed.await.map_err(io::Error::other)??)
    }
}

#[cfg(test)]
mod tests {
    use super::super::{BlobHome, Location, Store};
    use super::*;
    use camino::Utf8Path;

    /// A folder stays in place if its content was uploaded again after its row was removed.
    #[tokio::test]
    async fn folders_with_a_row_are_neither_removed_nor_quarantined() {
        let folder = tempfile::tempdir().unwrap();
        let data = Utf8Path::from_path(folder.path()).unwrap();
        let store = Store::open(data, &Location::Folder, &BlobHome::Folder).await.unwrap();
        let [again, gone] = ["a", "b"].map(|hash| store.blobs.content(hash));
        let make = |place: &Utf8Path| {
            fs::create_dir_all(place).unwrap();
            fs::write(place.join("cloud.ply"), place.as_str()).unwrap();
        };
        make(&again);
        make(&gone);
        let row = sqlx::query("INSERT INTO contents (hash, bytes, created_at) VALUES ('a', 1, $1)")
            .bind(now());
        row.execute(store.database.writer.pool()).await.unwrap();
        drop(store.orphans.set_aside(vec![again.clone(), gone.clone()]).await.unwrap());
        assert!(
            fs::read_to_string(again.join("cloud.ply")).unwrap() == again.as_str()
                && !gone.exists()
        );
        make(&gone);
        store
            .orphans
            .quarantine(vec![("contents", "a".into()), ("contents", "b".into())])
            .await
            .unwrap();
        assert!(again.join("cloud.ply").exists() && !gone.exists());
        assert!(data.join("quarantine").join(&now()[..10]).join("contents/b/cloud.ply").exists());
    }
}
