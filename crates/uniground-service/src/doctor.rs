//! Whether what is stored is whole: database against files, files against their sums. What can be
//! made again is.

use super::{Caller, ParseJob};
use crate::error::Error;
use crate::{ParseService, ParsedScenes};
use std::fmt;
use std::time::Duration;
use tokio::task::spawn_blocking;
use uniground_jobs::JobKind;
use uniground_storage::{
    Blobs, BrokenReference, CheckDepth, ContentRepository, DamagedFile, IntegrityRepository,
    JobRepository, OrphanFolders, OrphanRepository, ParseRepository,
};
use uniground_types::settings::ParseSettings;

/// Something that is not as it should be.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Finding {
    pub trouble: FindingKind,
    /// In plain words, with the file or id.
    pub detail: String,
}

/// Kinds of trouble, and what can be done.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum FindingKind {
    /// The database itself. Nothing is done: restore a backup.
    Database,
    /// Rows that refer to rows which do not exist: the reference is cleared or the rows are
    /// removed; scenes without a parse are parsed again.
    References,
    /// A scan's files. They can not be made again: upload the scan once more.
    Content { hash: String },
    /// A parse's files: it is made again.
    Parse { id: String },
    /// A folder no record speaks of: it goes to the quarantine.
    Unclaimed { kind: &'static str, name: String },
    /// A folder the database can not judge, being empty or younger. Nothing is done: it may be the
    /// database that is wrong.
    Unjudged,
    /// A file where only folders belong. Nothing is done: it is somebody else's.
    StrayFile,
    /// A job of a scene that is gone: it ends.
    Job { id: String },
}

impl FindingKind {
    /// What repairing does about it; `None`: that is for people.
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

/// Examines and repairs what is stored.
#[derive(Clone)]
pub struct DoctorService {
    pub(crate) integrity_repository: IntegrityRepository,
    pub(crate) content_repository: ContentRepository,
    pub(crate) blobs: Blobs,
    pub(crate) parse_repository: ParseRepository,
    pub(crate) orphan_repository: OrphanRepository,
    pub(crate) job_repository: JobRepository,
    pub(crate) parsed_scenes: ParsedScenes,
    pub(crate) parse_service: ParseService,
}

impl DoctorService {
    /// Looks at everything that is stored, every byte of it.
    ///
    /// # Errors
    /// [`Error`] where it can not be looked at at all.
    pub async fn examine(&self) -> Result<Vec<Finding>, Error> {
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
            let wrong = spawn_blocking(move || blobs.look(&place, CheckDepth::Bytes)).await??;
            if let Some(detail) = told(&wrong) {
                found(
                    FindingKind::Content { hash: hash.clone() },
                    format!("{hash}: {detail}; upload the scan again"),
                );
            }
        }
        for parse in self.parse_repository.all_parses().await? {
            let wrong = self.parsed_scenes.look_at_parse(&parse.id, CheckDepth::Bytes).await?;
            if let Some(detail) = told(&wrong)
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

    /// Does what can be done about findings.
    ///
    /// # Errors
    /// [`Error`] of the store; what was done stays done.
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
                    self.orphan_repository.quarantine(vec![(kind, name.clone())]).await?
                }
                FindingKind::Job { id } => self.job_repository.end_orphan(id).await?,
                FindingKind::Database
                | FindingKind::References
                | FindingKind::Content { .. }
                | FindingKind::Unjudged
                | FindingKind::StrayFile => {}
            }
        }
        Ok(())
    }

    /// Jobs that wait for a server: what was repaired is finished by the next one.
    ///
    /// # Errors
    /// [`Error::Store`].
    pub async fn waiting_parses(&self) -> Result<u32, Error> {
        Ok(self.job_repository.queued_jobs(ParseJob::NAME, None).await?.all)
    }
}

/// The first thing that is wrong, and how many more; strays hurt nobody.
fn told(wrong: &[DamagedFile]) -> Option<String> {
    let mut wrong = wrong.iter().filter(|damage| damage.what != "stray");
    let DamagedFile { file, what } = wrong.next()?;
    let more = match wrong.count() {
        0 => String::new(),
        n => format!(", and {n} more"),
    };
    Some(format!("{file} {what}{more}").trim().to_owned())
}
