//! All errors of the use cases, without HTTP. `http/problem.rs` maps them once.

use std::io;
use uniground_geometry::scene::InstanceId;
use uniground_grounding::pipeline::QuestionError;
use uniground_ingest::{IngestError, IngestErrorKind};
use uniground_isolation::ReadError;
use uniground_jobs::JobsError;
use uniground_models::chat::{AskError, ChatError, ChatFailure, OverBudget};
use uniground_models::neural::ModelError;
use uniground_parsing::ParseError;
use uniground_parsing::changes::ChangesError;
use uniground_parsing::scan::ScanError;
use uniground_storage::{ObjectStoreUnavailable, StoreError, is_disk_full};
use uniground_types::problem::FieldError;

#[derive(Debug, thiserror::Error)]
pub enum Error {
    #[error(transparent)]
    Ingest(#[from] IngestError),
    #[error(transparent)]
    Parse(#[from] ParseError),
    #[error(transparent)]
    Jobs(#[from] JobsError),
    #[error(transparent)]
    Store(#[from] StoreError),
    #[error("there is no scene {id}")]
    SceneNotFound { id: String },
    #[error("several scenes are named {name:?}: use the id of one of them")]
    SceneNameAmbiguous { name: String },
    #[error("scene {scene_id} has no instance {id}")]
    InstanceNotFound { scene_id: String, id: InstanceId },
    #[error("instance {id} has {views} views, numbered from 0; there is no view {view}")]
    ViewNotFound { id: InstanceId, view: u32, views: usize },
    #[error("the scan has no photograph {index}; its frames tell which there are")]
    FrameNotFound { index: u32 },
    #[error("the parse report has no picture {name:?}")]
    ReportPictureNotFound { name: String },
    #[error("scene {scene_id} was parsed without an encoder and has no embeddings")]
    NoEmbeddings { scene_id: String },
    #[error(
        "scene {scene_id} has no scene_to_map: say where it lies in the map, PATCH /v1/scenes/{scene_id}"
    )]
    NoMap { scene_id: String },
    #[error(
        "scene {scene_id} was parsed before its files' own coordinates were kept: parse it again"
    )]
    NoSourceFrame { scene_id: String },
    #[error(
        "the scene has version {now}, but if_version is {asked}: fetch its objects again, then ask with if_version {now}"
    )]
    ParseChanged { asked: u32, now: u32 },
    #[error("there is no answer {id}")]
    AnswerNotFound { id: String },
    #[error("there is no key {id}")]
    KeyNotFound { id: String },
    #[error("the API key of this request has expired or was revoked")]
    KeyRefused,
    #[error(
        "this API key has reached its limit of {most} scenes (unfinished uploads count): delete a scene or ask an administrator to raise the limit"
    )]
    TooManyScenes { most: u32 },
    #[error("there is no correction {id} of this scene's current parse")]
    CorrectionNotFound { id: String },
    #[error("correction {by} builds on this one: undo that one first")]
    CorrectionInUse { by: String },
    #[error(
        "instance {id} cannot be merged: it is a part, a whole, found for a question, or gone, and its points are not known"
    )]
    NotAThing { id: InstanceId },
    #[error(
        "instance {id} cannot be split, because none of its parts are known: dismiss it, or parse the scene with finer settings"
    )]
    NoParts { id: InstanceId },
    #[error("instance {id} was made by a merge: undo the correction that merged it")]
    WasMerged { id: InstanceId },
    #[error("a parse has at most {most} corrections")]
    TooManyCorrections { most: u32 },
    #[error("there is no batch {id}")]
    BatchNotFound { id: String },
    #[error("batch {id} has already finished ({state}) and cannot be changed")]
    BatchOver { id: String, state: String },
    #[error("a batch has at most {most} questions")]
    TooManyItems { most: u32 },
    #[error("a batch holds at most {} MB: split it into several", most_bytes >> 20)]
    BatchTooLarge { most_bytes: u64 },
    #[error("an answer could not be stored; the question is asked again")]
    AnswerNotStored,
    #[error("scene {id} has not been parsed yet")]
    SceneNotReady { id: String, job_id: Option<String> },
    #[error("{pointer}: {detail}")]
    Invalid { pointer: String, detail: String },
    #[error(
        "no vision-language model is configured; use reasoner \"auto\" or \"builtin\", and parser \"builtin\""
    )]
    VlmNotConfigured,
    #[error("the vision-language model's server is down: the next attempt is in {again_in_s} s")]
    VlmDown { again_in_s: u64 },
    #[error("the vision-language model gave no usable reply in {attempts} attempts: {why}")]
    VlmFailed { why: String, attempts: u32 },
    #[error(transparent)]
    OverBudget(OverBudget),
    #[error("answer {id} has no prompt and no replies: no model was asked, or they have expired")]
    NoTranscript { id: String },
    #[error("answer {id} has no picture {name:?}")]
    AnswerPictureNotFound { id: String, name: String },
    #[error(transparent)]
    Model(#[from] ModelError),
    #[error(
        "the scene was parsed with the encoder {parsed_with}, but this server has {here}: parse it again, or set \"allow_builtin\""
    )]
    EncoderChanged { parsed_with: String, here: String },
    #[error("the question took longer than {seconds} s")]
    QuestionTimedOut { seconds: f32 },
    #[error("too many questions at once")]
    Overloaded,
    #[error(
        "the stored parse is damaged ({what}) and the scan is being parsed again: retry when the scene's job is done"
    )]
    ParseDamaged { parse_id: String, what: String },
    #[error("this Idempotency-Key was used with another request: use a new key for a new request")]
    IdempotencyKeyReused,
    #[error(
        "importing from the server's disk is disabled: its operator can enable it with --import-root"
    )]
    ImportNotAllowed,
    #[error("{path:?} does not exist below the import folder")]
    ImportNotFound { path: String },
    #[error("a scene can grow at most {most} times: upload the scan again, with all of its frames")]
    GrownTooOften { most: usize },
    #[error("another request has added frames to scene {id} meanwhile: try again")]
    GrowthOvertaken { id: String },
    #[error(
        "changes since version {since} are not known, because version {renumbered} was parsed again with new ids: ask for changes since {renumbered}"
    )]
    VersionsApart { since: u32, renumbered: u32 },
    #[error("scene {id} has no version {asked}: its current version is {version}")]
    NoVersion { id: String, asked: u32, version: u32 },
    #[error(
        "the two scans do not overlap: {:.0}% of the points of the first have a point of the second within 5 cm. Give both scenes a scene_to_map with the same map_frame_id, or scan them in one coordinate frame",
        overlap * 100.0
    )]
    ScansApart { overlap: f32 },
    #[error("comparing the two scans took longer than {seconds} s")]
    ComparisonTimedOut { seconds: u64 },
    #[error("too many {what} at once: the limit is {most}")]
    TooMany { what: &'static str, most: usize },
    #[error("{what}")]
    NoScan { what: &'static str },
    #[error(
        "the upload is too slow: send at least {bytes_per_s} bytes per second, with no pause of {silence_s} s"
    )]
    UploadTooSlow { bytes_per_s: u64, silence_s: u64 },
    #[error("the upload holds more than {max_bytes} bytes")]
    UploadTooLarge { max_bytes: u64 },
    #[error("there is no upload {id}")]
    UploadNotFound { id: String },
    #[error("upload {id} has expired: begin a new one")]
    UploadExpired { id: String },
    #[error(
        "upload {id} is in use: another request sends to it, or a scene is being made of it. Ask for its offset later"
    )]
    UploadBusy { id: String },
    #[error("the upload's current offset is {offset}: resume from there")]
    WrongOffset { offset: u64 },
    #[error("the checksum does not match the bytes received: send this part again")]
    ChecksumMismatch,
    #[error("at most {most} uploads may be unfinished at once: finish or delete one")]
    TooManyUploads { most: u32 },
    #[error("the upload was interrupted after {received} bytes")]
    UploadInterrupted { received: u64 },
    #[error("only {} MB are free on the server's disk", free >> 20)]
    DiskNearlyFull { free: u64 },
    #[error(
        "this parse needs about {} MB, and the server already uses {} of its {} MB: thin the cloud, or give the server more memory",
        wanted >> 20, resident >> 20, most >> 20
    )]
    MemoryShort { wanted: u64, resident: u64, most: u64 },
    #[error(
        "the process that decoded the scan was killed by the system, which may be out of memory"
    )]
    ReaderKilled,
    #[error("a file could not be read or written")]
    Io(#[from] io::Error),
    #[error("background work stopped unexpectedly")]
    Background(#[from] tokio::task::JoinError),
}

impl From<AskError> for Error {
    fn from(error: AskError) -> Self {
        match error {
            AskError::Budget(budget) => Self::OverBudget(budget),
            AskError::Chat(ChatFailure { error: ChatError::Down { again_in_s }, .. }) => {
                Self::VlmDown { again_in_s }
            }
            AskError::Chat(failure) => {
                Self::VlmFailed { why: failure.error.to_string(), attempts: failure.attempts }
            }
            AskError::CallsUsedUp { .. } => Self::VlmFailed { why: error.to_string(), attempts: 0 },
        }
    }
}

impl From<QuestionError> for Error {
    fn from(error: QuestionError) -> Self {
        match error {
            QuestionError::Encoder(error) => Self::Model(error),
            QuestionError::Photograph(error) => Self::Parse(error),
            QuestionError::Review(error) => error.into(),
            QuestionError::Unread(why) => Self::VlmFailed { why, attempts: 0 },
        }
    }
}

impl From<ReadError> for Error {
    fn from(error: ReadError) -> Self {
        match error {
            ReadError::Ingest(error) => Self::Ingest(error),
            ReadError::Killed => Self::ReaderKilled,
            ReadError::Process(error) => Self::Io(error),
        }
    }
}

impl From<ScanError> for Error {
    fn from(error: ScanError) -> Self {
        match error {
            ScanError::Ingest(error) => Self::Ingest(error),
            ScanError::Parse(error) => Self::Parse(error),
            ScanError::Io(error) => Self::Io(error),
            ScanError::NotImported => Self::Io(io::Error::other(error)),
        }
    }
}

impl From<FieldError> for Error {
    fn from(FieldError { pointer, detail }: FieldError) -> Self {
        Self::Invalid { pointer, detail }
    }
}

impl From<ChangesError> for Error {
    fn from(error: ChangesError) -> Self {
        match error {
            ChangesError::Frame(error) => Self::Parse(error.into()),
            ChangesError::Cancelled(cancelled) => Self::Parse(cancelled.into()),
        }
    }
}

impl From<serde_json::Error> for Error {
    fn from(error: serde_json::Error) -> Self {
        Self::Store(StoreError::Record(error))
    }
}

impl Error {
    pub fn invalid(pointer: impl Into<String>, detail: impl Into<String>) -> Self {
        Self::Invalid { pointer: pointer.into(), detail: detail.into() }
    }

    /// Returns whether a later retry may succeed: after a full disk, a locked database, or a model
    /// that did not answer.
    #[must_use]
    pub fn is_transient(&self) -> bool {
        matches!(
            self,
            Self::Store(_)
                | Self::Io(_)
                | Self::DiskNearlyFull { .. }
                | Self::MemoryShort { .. }
                | Self::ReaderKilled
                | Self::Overloaded
                | Self::AnswerNotStored
                | Self::VlmFailed { .. }
                | Self::VlmDown { .. }
                | Self::Jobs(JobsError::Store(_))
                | Self::Ingest(IngestError::Io { .. })
        )
    }

    /// Returns whether the disk is full.
    #[must_use]
    pub fn is_disk_full(&self) -> bool {
        match self {
            Self::Store(error) | Self::Jobs(JobsError::Store(error)) => error.is_full(),
            Self::Io(error) | Self::Ingest(IngestError::Io { source: error, .. }) => {
                is_disk_full(error)
            }
            Self::DiskNearlyFull { .. } => true,
            _ => false,
        }
    }

    /// Returns whether another connection holds the database for a moment.
    #[must_use]
    pub fn is_store_busy(&self) -> bool {
        matches!(self, Self::Store(error) | Self::Jobs(JobsError::Store(error)) if error.is_busy())
    }

    /// Returns whether the object store is temporarily unavailable.
    #[must_use]
    pub fn is_object_store_unavailable(&self) -> bool {
        match self {
            Self::Store(error) | Self::Jobs(JobsError::Store(error)) => {
                error.is_object_store_unavailable()
            }
            Self::Io(error) | Self::Ingest(IngestError::Io { source: error, .. }) => {
                ObjectStoreUnavailable::is_behind(error)
            }
            _ => false,
        }
    }

    /// Returns the stable code of this error, which is part of the API.
    #[must_use]
    pub fn code(&self) -> &'static str {
        use uniground_geometry::scene::FrameError;
        if self.is_disk_full() {
            return "storage_full";
        }
        if self.is_store_busy() {
            return "storage_busy";
        }
        if self.is_object_store_unavailable() {
            return "blobs_busy";
        }
        match self {
            Self::Ingest(error) => code_of_import(error),
            Self::Parse(error) => match error {
                ParseError::Frame(
                    FrameError::Unreadable { .. }
                    | FrameError::Undecodable { .. }
                    | FrameError::NotDepth { .. }
                    | FrameError::WrongSize { .. },
                ) => "frame_unreadable",
                ParseError::NoPoints => "cloud_empty",
                ParseError::Model(_) => "model_failed",
                ParseError::Cancelled(_) => "cancelled",
            },
            Self::Jobs(error) => match error {
                JobsError::NotFound { .. } => "job_not_found",
                JobsError::QueueFull { .. } => "queue_full",
                JobsError::Store(_) => "storage_failed",
            },
            Self::SceneNotFound { .. } => "scene_not_found",
            Self::SceneNameAmbiguous { .. } => "scene_name_ambiguous",
            Self::InstanceNotFound { .. } => "instance_not_found",
            Self::ViewNotFound { .. } => "view_not_found",
            Self::ReportPictureNotFound { .. } => "report_picture_not_found",
            Self::NoEmbeddings { .. } => "no_embeddings",
            Self::NoMap { .. } => "no_map",
            Self::ParseChanged { .. } => "parse_changed",
            Self::NoSourceFrame { .. } => "no_source_frame",
            Self::AnswerNotFound { .. } => "answer_not_found",
            Self::NoScan { .. } => "archive_unreadable",
            Self::FrameNotFound { .. } => "frame_not_found",
            Self::CorrectionNotFound { .. } => "correction_not_found",
            Self::CorrectionInUse { .. } => "correction_in_use",
            Self::NotAThing { .. } => "not_a_thing",
            Self::WasMerged { .. } => "was_merged",
            Self::NoParts { .. } => "no_parts",
            Self::TooManyCorrections { .. } => "too_many_corrections",
            Self::BatchNotFound { .. } => "batch_not_found",
            Self::KeyNotFound { .. } => "key_not_found",
            Self::KeyRefused => "key_refused",
            Self::TooManyScenes { .. } => "quota_used_up",
            Self::BatchOver { .. } => "batch_over",
            Self::TooManyItems { .. } => "too_many_items",
            Self::BatchTooLarge { .. } => "batch_too_large",
            Self::SceneNotReady { .. } => "scene_not_ready",
            Self::Invalid { .. } => "invalid_request",
            Self::VlmNotConfigured => "vlm_not_configured",
            Self::VlmFailed { .. } => "vlm_unavailable",
            Self::VlmDown { .. } => "vlm_down",
            Self::OverBudget(_) => "budget_spent",
            Self::NoTranscript { .. } => "no_transcript",
            Self::AnswerPictureNotFound { .. } => "answer_picture_not_found",
            Self::Model(_) => "model_failed",
            Self::EncoderChanged { .. } => "encoder_changed",
            Self::QuestionTimedOut { .. } => "question_timed_out",
            Self::ParseDamaged { .. } => "parse_damaged",
            Self::IdempotencyKeyReused => "idempotency_key_reused",
            Self::ImportNotAllowed => "import_not_allowed",
            Self::ImportNotFound { .. } => "import_not_found",
            Self::GrownTooOften { .. } => "grown_too_often",
            Self::GrowthOvertaken { .. } => "growth_overtaken",
            Self::VersionsApart { .. } => "versions_apart",
            Self::NoVersion { .. } => "no_version",
            Self::ScansApart { .. } => "scans_apart",
            Self::ComparisonTimedOut { .. } => "comparison_timed_out",
            Self::Overloaded | Self::TooMany { .. } => "overloaded",
            Self::UploadTooSlow { .. } => "upload_too_slow",
            Self::UploadTooLarge { .. } => "upload_too_large",
            Self::UploadInterrupted { .. } => "upload_interrupted",
            Self::UploadNotFound { .. } => "upload_not_found",
            Self::UploadExpired { .. } => "upload_expired",
            Self::UploadBusy { .. } => "upload_busy",
            Self::WrongOffset { .. } => "upload_offset_wrong",
            Self::ChecksumMismatch => "checksum_mismatch",
            Self::TooManyUploads { .. } => "too_many_uploads",
            Self::Store(_) | Self::Io(_) | Self::AnswerNotStored => "storage_failed",
            Self::DiskNearlyFull { .. } => "storage_full",
            Self::MemoryShort { .. } | Self::ReaderKilled => "memory_short",
            Self::Background(_) => "internal",
        }
    }
}

/// Returns the stable code of an upload's error.
fn code_of_import(error: &IngestError) -> &'static str {
    match error.kind() {
        IngestErrorKind::ArchiveUnreadable => "archive_unreadable",
        IngestErrorKind::UnsafeEntry => "archive_entry_unsafe",
        IngestErrorKind::ArchiveTooLarge => "archive_too_large",
        IngestErrorKind::UnknownLayout => "unknown_layout",
        IngestErrorKind::Malformed => "scene_file_malformed",
        IngestErrorKind::MissingFile => "scene_file_missing",
        IngestErrorKind::MissingIntrinsics => "intrinsics_missing",
        IngestErrorKind::BadIntrinsics => "intrinsics_invalid",
        IngestErrorKind::FrameCountMismatch => "frame_count_mismatch",
        IngestErrorKind::BadPose => "pose_invalid",
        IngestErrorKind::EmptyCloud => "cloud_empty",
        IngestErrorKind::EmptyScene => "scene_empty",
        IngestErrorKind::NoUsableFrames => "no_usable_frames",
        IngestErrorKind::Frame => "frame_unreadable",
        IngestErrorKind::NothingFits => "convention_mismatch",
        IngestErrorKind::DoesNotBelong => "frames_do_not_fit",
        IngestErrorKind::IncompleteLayout => "layout_incomplete",
        IngestErrorKind::UpUnknown => "up_unknown",
        IngestErrorKind::UnitUnknown => "unit_unknown",
        IngestErrorKind::TooCostly => "scan_too_costly",
        IngestErrorKind::Io => "storage_failed",
        IngestErrorKind::Cancelled => "cancelled",
    }
}
