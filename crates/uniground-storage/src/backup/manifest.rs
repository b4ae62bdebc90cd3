//! The manifest of a backup: what belongs to it.

use super::{BackupError, KINDS};
use camino::{Utf8Component, Utf8Path};
use serde::{Deserialize, Serialize};
use serde_json::value::RawValue;
use sha2::{Digest, Sha256};
use std::io;

pub const FILE: &str = "manifest.json";
pub const FORMAT: u32 = 1;

#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Manifest {
    /// Version of this layout.
    pub format: u32,
    /// Version of the program that made it.
    pub program: String,
    /// The database's last migration.
    pub schema: i64,
    /// When the snapshot of the database was taken.
    pub taken_at: String,
    /// Id of the data folder that was backed up.
    pub data_folder: String,
    pub database: DatabaseEntry,
    pub scenes: u64,
    pub answers: u64,
    pub folders: Vec<BackupFolder>,
    /// Folders that were lost or damaged before the backup was taken.
    pub left_out: Vec<OmittedFolder>,
}

#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct DatabaseEntry {
    pub file: String,
    pub sha256: String,
    pub bytes: u64,
}

/// A published folder in the backup.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct BackupFolder {
    pub kind: String,
    pub name: String,
    /// SHA-256 of its `.sha256sums`, which lists the checksums of its files.
    pub sha256: String,
    pub files: u64,
    pub bytes: u64,
    /// When it was published, seconds since 1970. Restoring keeps it, so that retention counts from
    /// the original time.
    pub published_s: u64,
}

#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct OmittedFolder {
    pub folder: String,
    pub why: String,
}

/// A manifest with its own checksum, so that damage to it is detected too.
#[derive(Serialize, Deserialize)]
struct SealedManifest {
    sha256: String,
    backup: Box<RawValue>,
}

impl Manifest {
    pub fn to_sealed_bytes(&self) -> io::Result<Vec<u8>> {
        let text = serde_json::to_string(self)?;
        let sha256 = hex(&Sha256::digest(&text));
        Ok(serde_json::to_vec(&SealedManifest { sha256, backup: RawValue::from_string(text)? })?)
    }

    /// Reads a manifest and checks it: checksums match, and no name leads out of the backup.
    pub fn from_sealed_bytes(bytes: &[u8]) -> Result<Self, BackupError> {
        let damaged = |what: &str| BackupError::Damaged { what: format!("{FILE}: {what}") };
        let SealedManifest { sha256, backup } =
            serde_json::from_slice(bytes).map_err(|_| damaged("it cannot be parsed"))?;
        if hex(&Sha256::digest(backup.get())) != sha256 {
            return Err(damaged("its checksum does not match"));
        }
        let manifest: Self = serde_json::from_str(backup.get())
            .map_err(|error| BackupError::Unknown { why: error.to_string() })?;
        if manifest.format != FORMAT {
            return Err(BackupError::Newer { program: manifest.program });
        }
        let strange = manifest
            .folders
            .iter()
            .find(|kept| !KINDS.contains(&kept.kind.as_str()) || !is_plain_name(&kept.name));
        if let Some(BackupFolder { kind, name, .. }) = strange {
            return Err(damaged(&format!("it lists the invalid folder {kind}/{name}")));
        }
        if !is_plain_name(&manifest.database.file) {
            return Err(damaged("its database file name is invalid"));
        }
        Ok(manifest)
    }
}

/// Returns whether a name is a single path component.
fn is_plain_name(name: &str) -> bool {
    let mut steps = Utf8Path::new(name).components();
    matches!((steps.next(), steps.next()), (Some(Utf8Component::Normal(step)), None) if step == name)
}

pub fn hex(digest: &[u8]) -> String {
    digest.iter().map(|byte| format!("{byte:02x}")).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn manifest(name: &str) -> Manifest {
        let database =
            DatabaseEntry { file: "uniground-1.sqlite".into(), sha256: "0".into(), bytes: 1 };
        let kept = BackupFolder {
            kind: "parses".into(),
            name: name.into(),
            sha256: "0".into(),
            files: 1,
            bytes: 1,
            published_s: 0,
        };
        Manifest {
            format: FORMAT,
            program: "0".into(),
            schema: 1,
            taken_at: "2026-11-22T00:00:00Z".into(),
            data_folder: "x".into(),
            database,
            scenes: 1,
            answers: 0,
            folders: vec![kept],
            left_out: Vec::new(),
        }
    }

    #[test]
    fn a_manifest_round_trips() {
        assert_eq!(
            Manifest::from_sealed_bytes(&manifest("p").to_sealed_bytes().unwrap()).unwrap(),
            manifest("p")
        );
    }

    #[test]
    fn a_manifest_with_any_flipped_byte_is_rejected() {
        let whole = manifest("p").to_sealed_bytes().unwrap();
        for at in 0..whole.len() {
            let mut bytes = whole.clone();
            bytes[at] ^= 1;
            assert!(
                Manifest::from_sealed_bytes(&bytes).is_err(),
                "byte {at}: {}",
                String::from_utf8_lossy(&bytes)
            );
        }
    }

    #[test]
    fn manifest_names_cannot_leave_the_backup() {
        for name in ["..", ".", "", "a/b", "/a", "../a", "a/"] {
            assert!(
                matches!(
                    Manifest::from_sealed_bytes(&manifest(name).to_sealed_bytes().unwrap()),
                    Err(BackupError::Damaged { .. })
                ),
                "{name}"
            );
        }
    }
}
