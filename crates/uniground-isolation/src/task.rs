//! Tasks that run in isolation.

use camino::{Utf8Path, Utf8PathBuf};
use serde::{Deserialize, Serialize};
use std::time::Duration;
use uniground_geometry::progress::Progress;
use uniground_geometry::scene::SourceToScene;
use uniground_ingest::archive::UnpackLimits;
use uniground_ingest::{ArchiveFormat, IngestError, describe_content, read_head};
use uniground_parsing::checkpoints::Checkpoints;
use uniground_parsing::scan::{ScanError, import_scan};
use uniground_types::scene::StageReport;
use uniground_types::settings::ImportSettings;

/// A task of reading a scan.
#[derive(Debug, Clone, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Task {
    /// Unpacks an upload into an empty folder and checks it as a scan. If the content does not
    /// reveal the format, the file name extension decides.
    Unpack { archive: Utf8PathBuf, file_name: String, folder: Utf8PathBuf, limits: UnpackLimits },
    /// Checks an unpacked scan again.
    Inspect { folder: Utf8PathBuf },
    /// Checks that the frames of an unpacked scan fit the scene with this point cloud, which is a
    /// file of the service.
    CheckFit { folder: Utf8PathBuf, cloud: Utf8PathBuf, to_scene: SourceToScene },
    /// Imports an unpacked scan into its checkpoints, and decodes every picture.
    Import {
        content: Utf8PathBuf,
        settings: ImportSettings,
        checkpoints: Utf8PathBuf,
        origin: String,
    },
}

/// The result of a task.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum TaskOutcome {
    /// A valid scan, with its name if it contains one.
    Scan { name: Option<String> },
    /// The frames fit the scene.
    Fits,
    /// The import is in the checkpoints. The stages report how long they took.
    Imported { stages: Vec<StageReport> },
}

/// Time limit of a check, without the time for unpacking.
const CHECK_TIME: Duration = Duration::from_mins(2);
/// Minimum speed of unpacking that the time limit allows for, bytes per second.
const UNPACKED_BYTES_PER_S: u64 = 4 << 20;
/// Time limit of an import.
const IMPORT_TIME: Duration = Duration::from_hours(2);

impl Task {
    /// Runs the task in this process; blocks.
    ///
    /// # Errors
    /// [`IngestError`].
    pub fn run(&self, progress: &Progress) -> Result<TaskOutcome, IngestError> {
        match self {
            Self::Unpack { archive, file_name, folder, limits } => {
                let head = read_head(archive);
                let packed = ArchiveFormat::from_head(&head, file_name)
                    .ok_or_else(|| unreadable(file_name, describe_content(&head)))?;
                packed.unpack(archive, folder, limits)?;
                Ok(with_name(uniground_ingest::open(folder)?.name))
            }
            Self::Inspect { folder } => Ok(with_name(uniground_ingest::open(folder)?.name)),
            Self::CheckFit { folder, cloud, to_scene } => {
                let (scan, known) =
                    (uniground_ingest::open(folder)?, uniground_ingest::read_cloud(cloud)?);
                uniground_ingest::check_fit(scan, to_scene, &known, 0).map(|_| TaskOutcome::Fits)
            }
            Self::Import { content, settings, checkpoints, origin } => {
                let checkpoints = Checkpoints::in_folder(checkpoints, origin);
                let imported =
                    import_scan(content, settings, &checkpoints, &progress.sub_range(0.0, 0.8))
                        .and_then(|scan| {
                            scan.check_pictures(&progress.sub_range(0.8, 1.0))?;
                            Ok(TaskOutcome::Imported { stages: scan.stages().to_vec() })
                        });
                imported.map_err(|error| to_ingest_error(error, content))
            }
        }
    }

    /// Returns the time limit of the task.
    pub(super) fn time_limit(&self) -> Duration {
        match self {
            Self::Unpack { archive, .. } => {
                let bytes = archive.metadata().map_or(0, |file| file.len());
                CHECK_TIME + Duration::from_secs(bytes / UNPACKED_BYTES_PER_S)
            }
            Self::Inspect { .. } | Self::CheckFit { .. } => CHECK_TIME,
            Self::Import { .. } => IMPORT_TIME,
        }
    }

    /// Returns the subject of errors about the whole task: for an upload, the file name that the
    /// caller gave.
    pub(super) fn subject(&self) -> Utf8PathBuf {
        match self {
            Self::Unpack { file_name, .. } if !file_name.is_empty() => Utf8PathBuf::from(file_name),
            _ => Utf8PathBuf::from("the scan"),
        }
    }
}

/// Maximum length of a scan's name in bytes. Longer names are ignored.
const MAX_NAME_BYTES: usize = 4 << 10;

fn with_name(name: Option<String>) -> TaskOutcome {
    TaskOutcome::Scan { name: name.filter(|name| name.len() <= MAX_NAME_BYTES) }
}

fn unreadable(file_name: &str, reason: &str) -> IngestError {
    IngestError::Malformed { file: file_name.into(), reason: reason.to_owned() }
}

fn to_ingest_error(error: ScanError, content: &Utf8Path) -> IngestError {
    match error {
        ScanError::Ingest(error) => error,
        ScanError::Io(source) => IngestError::Io { file: content.to_owned(), source },
        other => IngestError::Io { file: content.to_owned(), source: std::io::Error::other(other) },
    }
}
