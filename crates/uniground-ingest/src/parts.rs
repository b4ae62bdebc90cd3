//! The stored form of a scan that has grown: the first upload and the frames added later, each in a
//! folder of its own.
//!
//! ```text
//! grown.json     the parts in order of time, and the transform of their poses
//! parts/0/ …     the first upload, as it was unpacked
//! parts/1/ …     the first addition
//! ```

use super::IngestError;
use camino::{Utf8Path, Utf8PathBuf};
use serde::{Deserialize, Serialize};
use std::{fs, io};
use uniground_geometry::scene::SourceToScene;

/// The file that distinguishes a scan that has grown from a single upload.
pub const GROWN: &str = "grown.json";
const FORMAT: &str = "uniground-grown/1";

/// The parts of a scan, in order of time.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct GrownScan {
    format: String,
    /// The parts. At least one: the first upload.
    pub parts: Vec<ScanPart>,
}

/// One upload.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ScanPart {
    /// SHA-256 of the upload's bytes, hexadecimal.
    pub hash: String,
    /// Transform from the upload's poses to the scene. `None`: its poses are in the same world as
    /// the files of the first upload.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub to_scene: Option<SourceToScene>,
}

impl GrownScan {
    /// Creates a scan with one part.
    #[must_use]
    pub fn from_upload(hash: &str) -> Self {
        Self {
            format: FORMAT.into(),
            parts: vec![ScanPart { hash: hash.to_owned(), to_scene: None }],
        }
    }

    /// Reads a scan's folder. Returns `None` for a scan that has not grown.
    ///
    /// # Errors
    /// Returns an [`IngestError`] for a damaged file.
    pub fn read(content: &Utf8Path) -> Result<Option<Self>, IngestError> {
        let text = match fs::read(content.join(GROWN)) {
            Ok(text) => text,
            Err(error) if error.kind() == io::ErrorKind::NotFound => return Ok(None),
            Err(error) => return Err(IngestError::reading(GROWN, error)),
        };
        let grown: Self =
            serde_json::from_slice(&text).map_err(|error| IngestError::malformed(GROWN, error))?;
        match grown.format == FORMAT && !grown.parts.is_empty() {
            true => Ok(Some(grown)),
            false => Err(IngestError::malformed(GROWN, format!("its format is not {FORMAT}"))),
        }
    }

    /// Writes the list of parts into a scan's folder.
    ///
    /// # Errors
    /// Returns errors of the file system.
    pub fn write(&self, content: &Utf8Path) -> io::Result<()> {
        fs::write(content.join(GROWN), serde_json::to_vec_pretty(self)?)
    }
}

/// The folder that contains the parts.
const PARTS: &str = "parts";
/// The file of checksums that the store adds to a scan's folder.
const CHECKSUMS: &str = ".sha256sums";

/// Returns the folder of a part, counted from 0.
#[must_use]
pub fn part_folder(content: &Utf8Path, part: usize) -> Utf8PathBuf {
    content.join(PARTS).join(part.to_string())
}

/// Returns whether a path of an upload, relative to its root and without `.` or `..`, is a name
/// that stored scans use for their own files.
///
/// [`GROWN`] is reserved in a folder of the root as well, because archives are often made of one
/// folder. Ignores case, because some file systems do.
#[must_use]
pub fn is_reserved(path: &Utf8Path) -> bool {
    let names: Vec<String> = path.iter().map(fold_case).collect();
    match &names[..] {
        [name] => is_name(name, GROWN) || is_name(name, CHECKSUMS),
        [_, name] if is_name(name, GROWN) => true,
        [folder, part, ..] => {
            is_name(folder, PARTS) && part.bytes().all(|byte| byte.is_ascii_digit())
        }
        [] => false,
    }
}

fn is_name(folded: &str, name: &str) -> bool {
    folded == fold_case(name)
}

/// Returns a name in the form that a case-insensitive file system compares. Both conversions are
/// needed: some letters share only their lower case, some only their upper case.
fn fold_case(name: &str) -> String {
    name.to_lowercase().to_uppercase()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn written_parts_are_read_back_and_damaged_files_are_refused() {
        let folder = tempfile::tempdir().unwrap();
        let folder = Utf8Path::from_path(folder.path()).unwrap();
        assert_eq!(GrownScan::read(folder).unwrap(), None);
        let mut grown = GrownScan::from_upload("aa");
        grown.parts.push(ScanPart { hash: "bb".into(), to_scene: Some(SourceToScene::IDENTITY) });
        grown.write(folder).unwrap();
        assert_eq!(GrownScan::read(folder).unwrap(), Some(grown));
        for damaged in [
            "",
            "{}",
            r#"{"format": "uniground-grown/2", "parts": [{"hash": "aa"}]}"#,
            r#"{"format": "uniground-grown/1", "parts": []}"#,
        ] {
            fs::write(folder.join(GROWN), damaged).unwrap();
            assert!(
                matches!(GrownScan::read(folder), Err(IngestError::Malformed { .. })),
                "{damaged}"
            );
        }
    }

    #[test]
    fn only_names_of_the_stored_layout_are_reserved() {
        for (path, expected) in [
            (GROWN, true),
            ("Grown.JSON", true),
            ("room/grown.json", true),
            (".sha256sums", true),
            (".SHA256SUM\u{17f}", true),
            ("parts/0/color/1.png", true),
            ("PARTS/17", true),
            ("a/b/grown.json", false),
            ("grown.json.txt", false),
            ("parts/cloud.ply", false),
            ("room/parts/0/cloud.ply", false),
            ("parts", false),
            ("scene.json", false),
        ] {
            assert_eq!(is_reserved(Utf8Path::new(path)), expected, "{path}");
        }
        assert!(is_reserved(&part_folder(Utf8Path::new(""), 12)));
    }
}
