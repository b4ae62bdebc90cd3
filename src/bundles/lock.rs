//! `models.lock`: what is installed in a folder of bundles, so that it can be installed again.

use super::AddError;
use super::source::check_name;
use super::transfer::hashes_of;
use camino::{Utf8Path, Utf8PathBuf};
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::fs::{self, Permissions};
use std::io::{self, Write};
use std::os::unix::fs::PermissionsExt;
use uniground_core::models::neural::layouts::Precision;

/// Name of the file, in the folder of bundles.
pub const LOCK: &str = "models.lock";

/// The content of `models.lock`.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Lock {
    /// The format of the file: 1.
    pub version: u32,
    /// Bundles by name.
    pub bundles: BTreeMap<String, LockedBundle>,
}

/// An installed bundle.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct LockedBundle {
    /// `hub:OWNER/NAME`, the address of a zip file, or a folder.
    pub source: String,
    /// The branch, tag or commit that was asked for, if one was named.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub requested: Option<String>,
    /// The hub's commit.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub revision: Option<String>,
    /// Precision of the networks. `None` for a bundle that had a manifest of its own.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub precision: Option<Precision>,
    /// As the authors state it. Empty if they do not.
    #[serde(default)]
    pub license: String,
    /// Files by their names in the bundle's folder.
    pub files: BTreeMap<String, LockedFile>,
}

/// A file of an installed bundle.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct LockedFile {
    /// Its path at the source.
    pub path: String,
    pub bytes: u64,
    /// Hexadecimal.
    pub sha256: String,
}

const VERSION: u32 = 1;

impl Default for Lock {
    fn default() -> Self {
        Self { version: VERSION, bundles: BTreeMap::new() }
    }
}

impl Lock {
    /// Reads the lock of a folder of bundles. Empty if there is none.
    ///
    /// # Errors
    /// Returns an error for a file that cannot be read or is not valid.
    pub fn read(models: &Utf8Path) -> Result<Self, AddError> {
        let file = models.join(LOCK);
        let wrong = |why: io::Error| AddError::File { file: file.clone(), why };
        let text = match fs::read_to_string(&file) {
            Err(error) if error.kind() == io::ErrorKind::NotFound => return Ok(Self::default()),
            text => text.map_err(wrong)?,
        };
        let unreadable = |why: String| {
            wrong(io::Error::other(format!(
                "{why}. Repair the file, or delete it: `uniground models add` writes it again"
            )))
        };
        let lock: Self = serde_json::from_str(&text).map_err(|e| unreadable(e.to_string()))?;
        if lock.version != VERSION {
            return Err(unreadable(format!("version {} is not supported", lock.version)));
        }
        match lock.bundles.keys().find_map(|name| check_name(name).err()) {
            None => Ok(lock),
            Some(why) => Err(unreadable(why)),
        }
    }

    /// Replaces the lock of a folder of bundles in one step.
    ///
    /// # Errors
    /// Returns an error if the file cannot be written.
    pub fn write(&self, models: &Utf8Path) -> Result<(), AddError> {
        let file = models.join(LOCK);
        let write = || {
            let mut text = serde_json::to_string_pretty(self)?;
            text.push('\n');
            let mut new = tempfile::NamedTempFile::new_in(models)?;
            new.write_all(text.as_bytes())?;
            // Like every other file of a bundle: readable by whoever runs the service.
            new.as_file().set_permissions(Permissions::from_mode(0o644))?;
            new.as_file().sync_all()?;
            new.persist(&file)?;
            Ok(())
        };
        write().map_err(|why| AddError::File { file: file.clone(), why })
    }
}

impl LockedBundle {
    /// Returns whether a branch, tag or commit was installed, as far as is known without asking.
    #[must_use]
    pub fn has_revision(&self, revision: &str) -> bool {
        [&self.requested, &self.revision].into_iter().flatten().any(|there| there == revision)
    }

    /// Checks that the files of an installed bundle are the pinned ones.
    ///
    /// # Errors
    /// Returns an error that names the first file that is missing or differs.
    pub fn verify(&self, folder: &Utf8Path) -> Result<(), AddError> {
        for (name, file) in &self.files {
            let path = folder.join(name);
            let found =
                hashes_of(&path).map_err(|why| AddError::File { file: path.clone(), why })?;
            if found.sha256 != file.sha256 {
                return Err(AddError::Source {
                    source_name: path.to_string(),
                    why: format!(
                        "was changed after installation: the SHA-256 is {}, pinned is {}. Remove \
                         the folder, and `uniground models add` installs it again",
                        found.sha256, file.sha256
                    ),
                });
            }
        }
        Ok(())
    }

    /// Returns the first file that is missing or has another size, if any.
    #[must_use]
    pub fn missing_file(&self, folder: &Utf8Path) -> Option<Utf8PathBuf> {
        self.files
            .iter()
            .map(|(name, file)| (folder.join(name), file))
            .find(|(path, file)| !path.metadata().is_ok_and(|m| m.len() == file.bytes))
            .map(|(path, _)| path)
    }
}
