//! Orphans in the object store: folders whose scene is deleted, or whose writer ended before it
//! wrote the row, and editions that were never sealed. Nothing is removed if the database is empty
//! or younger than the object, or if the object is younger than the grace period. Publishing must
//! finish within half of that period, and fails after it.

use super::blobs::KINDS;
use super::blobs::objects::{FolderName, FoundFolder, Seal, parse_edition};
use super::orphan_folders::OrphanRule;
use super::{OrphanRepository, StoreError};
use std::time::SystemTime;

/// A folder in the object store, or an edition of one, that nothing refers to.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct OrphanObject {
    folder: FolderName,
    /// Set if only this edition is an orphan.
    edition: Option<String>,
    found: FoundFolder,
}

impl OrphanObject {
    /// Returns the bytes of its objects, as far as they were counted.
    #[must_use]
    pub fn bytes(&self) -> u64 {
        if self.edition.is_some() { 0 } else { self.found.bytes }
    }
}

impl OrphanRepository {
    /// Finds orphans; empty if there is no object store.
    ///
    /// # Errors
    /// [`StoreError`].
    pub async fn orphan_objects(&self) -> Result<Vec<OrphanObject>, StoreError> {
        let Some(objects) = self.blobs.objects() else { return Ok(Vec::new()) };
        let OrphanRule { since, knows_nothing } = self.orphan_rule().await?;
        let mut orphan_objects = Vec::new();
        if knows_nothing {
            return Ok(orphan_objects);
        }
        let is_judged = |put: SystemTime| {
            since.is_some_and(|since| put >= since)
                && put.elapsed().unwrap_or_default() > objects.grace
        };
        for kind in KINDS {
            let mut found = objects.folders(kind).await?;
            for name in self.find_unreferenced(kind, found.keys().cloned().collect()).await? {
                if let Some(found) = found.remove(&name).filter(|found| is_judged(found.newest())) {
                    orphan_objects.push(OrphanObject {
                        folder: FolderName { kind, name },
                        edition: None,
                        found,
                    });
                }
            }
            // Unused editions of folders in use: they lost a race, or were replaced.
            for (name, found) in found
                .into_iter()
                .filter(|(_, found)| found.sealed.is_some() && found.editions.len() > 1)
            {
                let folder = FolderName { kind, name };
                let Some(seal) = objects.seal(&folder).await? else { continue };
                let others = found.editions.iter().filter(|(edition, put)| {
                    parse_edition(&seal.text) != Some(edition) && is_judged(**put)
                });
                let others: Vec<String> = others.map(|(edition, _)| edition.clone()).collect();
                orphan_objects.extend(others.into_iter().map(|edition| OrphanObject {
                    folder: folder.clone(),
                    edition: Some(edition),
                    found: found.clone(),
                }));
            }
        }
        Ok(orphan_objects)
    }

    /// Removes an orphan, if it still is one. Returns whether it was removed. The caller must
    /// prevent new references to it meanwhile.
    ///
    /// # Errors
    /// [`StoreError`].
    pub async fn remove_orphan(
        &self,
        OrphanObject { folder, edition, found }: &OrphanObject,
    ) -> Result<bool, StoreError> {
        let Some(objects) = self.blobs.objects() else { return Ok(false) };
        if let Some(edition) = edition {
            objects.unsealed_edition(folder, edition).remove().await?;
            return Ok(true);
        }
        if self.find_unreferenced(folder.kind, vec![folder.name.clone()]).await?.is_empty() {
            return Ok(false);
        }
        if folder.kind == "checkpoints" {
            objects.unsealed_checkpoints(&folder.name).remove().await?;
            return Ok(true);
        }
        // Another process may have published it again since it was found.
        let is_young = |seal: Seal| seal.made.elapsed().unwrap_or_default() <= objects.grace;
        if objects.seal(folder).await?.is_some_and(is_young) {
            return Ok(false);
        }
        drop(objects.unseal(folder).await?);
        for edition in found.editions.keys() {
            objects.unsealed_edition(folder, edition).remove().await?;
        }
        Ok(true)
    }
}
