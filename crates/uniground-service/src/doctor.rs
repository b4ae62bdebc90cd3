//! Checks stored data: the database against files, and files against their checksums. Repairs what
//! can be recreated.

use super::{Caller, ParseJob};
use crate::error::Error;
use crate::{ParseService, ParsedScenes};
use std::fmt;
use std::sync::Arc;
use std::time::Duration;
use tokio::task::spawn_blocking;
use uniground_jobs::JobKind;
use uniground_storage::{
    Blobs, BrokenReference, CheckDepth, ContentRepository, DamagedFile, IntegrityRepository,
    JobRepository, OrphanFolders, OrphanRepository, ParseRepository,
};
use uniground_types::settings::ParseSettings;

/// A problem that was found.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Finding {
    pub trouble: FindingKind,
    /// A description in plain words, with the file or id.
    pub detail: String,
}

/// Kinds of problems and their remedies.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum FindingKind {
    /// The database itself is damaged. Not repaired: restore a backup.
    Database,
    /// Rows refer to rows that do not exist. The reference is cleared or the rows are removed.
    /// Scenes without a parse are parsed again.
    References,
    /// A scan's files are damaged. They cannot be recreated: upload the scan again.
    Content { hash: String },
    /// A parse's files are damaged. The parse is made again.
    Parse { id: String },
    /// A folder without a record. It is moved to the quarantine.
    Unclaimed { kind: &'static str, name: String },
    /// A folder that cannot be judged, because the database is empty or younger. Not repaired: the
    /// database may be the wrong one.
    Unjudged,
    /// A file where only folders belong. Not repaired: its owner is unknown.
    StrayFile,
    /// A job of a scene that was deleted. The job is ended.
    Job { id: String },
}

impl FindingKind {
    /// Returns what a repair does about this. `None` means that a person must act.
    #[must_use]
    pub fn remedy(&self) -> Option<&'static str> {
        match self {
            Self::References => Some("clear or remove"),
            Self::Parse { .. } => Some("parse again"),
            Self::Unclaimed { .. } => Some("to the quarantine"),
            Self::Job { .. } => Some("end"),
            Self::Database | Self::Content { .. } | Self::Unjudged | Self::StrayFile => None,
        }
    }
}

impl fmt::Display for FindingKind {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Database => "database",
            Self::References => "references",
            Self::Content { .. } => "scan",
            Self::Parse { .. } => "parse",
            Self::Unclaimed { .. } => "unclaimed folder",
            Self::Unjudged => "unknown folder",
            Self::StrayFile => "stray file",
            Self::Job { .. } => "job",
        })
    }
}

/// Checks and repairs stored data.
#[derive(Clone)]
pub struct DoctorService {
    pub(crate) integrity_repository: IntegrityRepository,
    pub(crate) content_repository: ContentRepository,
    pub(crate) blobs: Blobs,
    pub(crate) parse_repository: ParseRepository,
    pub(crate) orphan_repository: OrphanRepository,
    pub(crate) job_repository: JobRepository,
    pub(crate) parsed_scenes: Arc<ParsedScenes>,
    pub(crate) parse_service: Arc<ParseService>,
}

impl DoctorService {
    /// Checks all stored data, every byte of it.
    ///
    /// # Errors
    /// [`Error`] if the check cannot run at all.
    pub async fn check_all_data(&self) -> Result<Vec<Finding>, Error> {
        let mut findings = Vec::new();
        let mut found = |trouble, detail: String| findings.push(Finding { trouble, detail });
        for complaint in self.integrity_repository.integrity().await? {
            found(FindingKind::Database, complaint);
        }
        for BrokenReference { table, column, parent, is_optional, rows, .. } in
            self.integrity_repository.broken_references().await?
        {
            let remedy =
                if is_optional { "the reference is cleared" } else { "the rows are removed" };
            found(
                FindingKind::References,
                format!(
                    "{rows} rows of {table} refer by {column} to rows of {parent} that do not exist; repair: {remedy}"
                ),
            );
        }
        for hash in self.content_repository.all_contents().await? {
            let (blobs, place) = (self.blobs.clone(), self.blobs.content(&hash));
            let wrong =
                spawn_blocking(move || blobs.check_folder(&place, CheckDepth::Bytes)).await??;
            if let Some(detail) = describe_damage(&wrong) {
                found(
                    FindingKind::Content { hash: hash.clone() },
                    format!("{hash}: {detail}; upload the scan again"),
                );
            }
        }
        for parse in self.parse_repository.all_parses().await? {
            let wrong = self.parsed_scenes.check_parse_files(&parse.id, CheckDepth::Bytes).await?;
            if let Some(detail) = describe_damage(&wrong)
                && !parse.is_retired()
            {
                found(
                    FindingKind::Parse { id: parse.id.clone() },
                    format!("{}: {detail}", parse.id),
                );
            }
        }
        let OrphanFolders { unclaimed, unjudged } =
            self.orphan_repository.orphan_folders(Duration::ZERO).await?;
        for (kind, name) in unclaimed {
            let detail = format!("blobs/{kind}/{name}: no record speaks of it");
            found(FindingKind::Unclaimed { kind, name }, detail);
        }
        for (kind, name) in unjudged {
            found(
                FindingKind::Unjudged,
                format!("blobs/{kind}/{name}: older than the database, or the database is empty"),
            );
        }
        for file in self.blobs.stray_files()? {
            found(FindingKind::StrayFile, format!("{file}: no folder; it is left alone"));
        }
        for (id, subject) in self.job_repository.jobs_without_scene().await? {
            found(
                FindingKind::Job { id: id.clone() },
                format!("{id}: its scene {subject} is gone"),
            );
        }
        Ok(findings)
    }

    /// Repairs the findings that can be repaired.
    ///
    /// # Errors
    /// [`Error`] of the store. What was done stays done.
    pub async fn repair(&self, findings: &[Finding]) -> Result<(), Error> {
        if findings.iter().any(|finding| finding.trouble == FindingKind::References) {
            for scene_id in self.integrity_repository.repair_references().await? {
                self.parse_service
                    .start_parse(&scene_id, &ParseSettings::default(), &Caller::operator())
                    .await?;
            }
        }
        for Finding { trouble, .. } in findings {
            match trouble {
                FindingKind::Parse { id } => self.parsed_scenes.retire_parse(id).await?,
                FindingKind::Unclaimed { kind, name } => {
                    self.orphan_repository.quarantine(vec![(kind, name.clone())]).await?;
                }
                FindingKind::Job { id } => self.job_repository.cancel_orphan_job(id).await?,
                FindingKind::Database
                | FindingKind::References
                | FindingKind::Content { .. }
                | FindingKind::Unjudged
                | FindingKind::StrayFile => {}
            }
        }
        Ok(())
    }

    /// Returns the number of queued parses. The next server that starts runs them and so completes
    /// the repair.
    ///
    /// # Errors
    /// [`Error::Store`].
    pub async fn waiting_parses(&self) -> Result<u32, Error> {
        Ok(self.job_repository.queued_jobs(ParseJob::NAME, None).await?.all)
    }
}

/// Describes the first damaged file and how many more there are. Stray files are ignored because
/// they do no harm.
fn describe_damage(wrong: &[DamagedFile]) -> Option<String> {
    let mut wrong = wrong.iter().filter(|damage| damage.what != "stray");
    let DamagedFile { file, what } = wrong.next()?;
    let more = match wrong.count() {
        0 => String::new(),
        n => format!(", and {n} more"),
    };
    Some(format!("{file} {what}{more}").trim().to_owned())
}
