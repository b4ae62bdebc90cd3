//! The jobs that parse a scene.

use super::plan::is_draft;
use super::previous_parse::PreviousParse;
use super::{files, settings_hash};
use crate::error::Error;
use crate::{
    Capacity, NamingService, ParsedScenes, SceneLookup, ServiceLocks, job_failure, until_cancelled,
};
use camino::Utf8Path;
use rayon::ThreadPool;
use serde::{Deserialize, Serialize};
use serde_json::{Value, json};
use std::io;
use std::sync::Arc;
use std::time::{Duration, Instant};
use tokio::task::spawn_blocking;
use tokio::time::{sleep, timeout};
use uniground_geometry::progress::Progress;
use uniground_ingest::GrownScan;
use uniground_isolation::{ScanReader, Task, TaskOutcome};
use uniground_jobs::{JobContext, JobFailure, JobKind, JobRequest, Jobs, Retry};
use uniground_models::neural::Models;
use uniground_parsing::checkpoints::Checkpoints;
use uniground_parsing::scan::{
    BUILTIN, ImportedScan, ParsedScan, STAGE_1_VERSION, import_share, load_stored_import,
    model_names, parse_imported_scan, select_models,
};
use uniground_storage::{
    Blobs, ContinuationReason, ContinuedParse, CorrectionRepository, HealthProbe, IdGenerator,
    NamedLock, NewParse, ParseRepository, SceneRepository, SceneRow,
};
use uniground_telemetry::metrics::Metrics;
use uniground_types::settings::{ParseModels, ParseSettings, rename_deprecated_settings};

/// Parses scenes one at a time, because a parse uses every core it gets.
pub struct ParseJob {
    pub runner: Arc<ParseRunner>,
    /// Names the objects of a scene right after its parse, if configured.
    pub naming: Arc<NamingService>,
}

/// Parses with neural networks, which take minutes, for scenes that already have a parse. New
/// scenes do not wait for them.
pub struct FullParseJob(pub ParseJob);

/// The result of a parse job that had nothing to do.
pub(super) const STORED_PARSE_USED: &str =
    "the stored parse of the same content and settings is used";

/// The payload of a parse job.
#[derive(Serialize, Deserialize)]
pub struct Payload {
    pub(super) scene_id: String,
    #[serde(deserialize_with = "settings_of_any_version")]
    pub(super) settings: ParseSettings,
    /// Jobs of earlier versions make full parses.
    #[serde(default)]
    pub(super) step: ParseStep,
}

/// What a parse job makes.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum ParseStep {
    /// A parse with everything that the settings select.
    #[default]
    Full,
    /// A parse with the built-in methods.
    Draft,
    /// The same. When it is done, a full parse is queued.
    DraftThenFull,
}

/// Reads the settings of a queued job. An earlier version, whose settings had other names, may have
/// written it.
fn settings_of_any_version<'de, D: serde::Deserializer<'de>>(
    deserializer: D,
) -> Result<ParseSettings, D::Error> {
    let mut settings = serde_json::Value::deserialize(deserializer)?;
    rename_deprecated_settings(&mut settings);
    serde_json::from_value(settings).map_err(serde::de::Error::custom)
}

/// The settings that say how the files of a scan are read. They do not depend on other settings.
const READING: [&str; 3] = ["up", "metres_per_unit", "levelling"];

/// Returns the requested settings. Where they do not say how files are read, that is taken from an
/// earlier job.
pub(super) fn with_import_settings_of(payload: &str, asked: Option<Value>) -> Option<Value> {
    let told: Option<Value> = serde_json::from_str(payload).ok();
    let Some(told) = told.as_ref().and_then(|told| told.pointer("/settings/import")) else {
        return asked;
    };
    let mut asked = asked.unwrap_or_else(|| json!({}));
    // A value that is not an object is rejected by the code that parses it, with its location.
    let import =
        asked.as_object_mut().map(|settings| settings.entry("import").or_insert_with(|| json!({})));
    if let Some(import) = import.and_then(Value::as_object_mut) {
        for name in READING {
            if let (Some(value), false) = (told.get(name), import.contains_key(name)) {
                import.insert(name.to_owned(), value.clone());
            }
        }
    }
    Some(asked)
}

impl JobKind for ParseJob {
    const NAME: &'static str = "parse";
    const CONCURRENCY: usize = 1;
    /// A scan that failed to parse will fail again. A full disk may have room later.
    const RETRY: Retry = Retry { interrupted: 10, transient: 2, backoff: Duration::from_secs(5) };
    type Payload = Payload;

    async fn run(&self, job: JobContext<Payload>) -> Result<String, JobFailure> {
        self.run_in(job, &self.runner.parse_pool).await
    }
}

impl JobKind for FullParseJob {
    const NAME: &'static str = "full_parse";
    const CONCURRENCY: usize = 1;
    const RETRY: Retry = ParseJob::RETRY;
    type Payload = Payload;

    async fn run(&self, job: JobContext<Payload>) -> Result<String, JobFailure> {
        self.0.run_in(job, &self.0.runner.full_parse_pool).await
    }
}

impl ParseJob {
    async fn run_in(
        &self,
        job: JobContext<Payload>,
        pool: &Arc<ThreadPool>,
    ) -> Result<String, JobFailure> {
        let (scene_id, step) = (job.payload.scene_id.clone(), job.payload.step);
        let told = loop {
            match self.runner.run_parse(&job, pool).await {
                // Finished stages are stored as checkpoints, so nothing is computed twice.
                Err(error)
                    if error.is_object_store_unavailable()
                        && self.runner.wait_for_object_store(&job.progress).await =>
                {
                    tracing::warn!(
                        error = &error as &dyn std::error::Error,
                        "object store was unavailable; parse continues"
                    );
                }
                done => break done.map_err(job_failure)?,
            }
        };
        // Objects of the full parse are named when it is done.
        if step != ParseStep::DraftThenFull {
            self.naming.name_when_parsed(&scene_id).await;
        }
        Ok(told)
    }
}

/// Runs parse jobs.
#[derive(Clone)]
pub struct ParseRunner {
    pub(crate) blobs: Blobs,
    pub(crate) parse_repository: ParseRepository,
    pub(crate) correction_repository: CorrectionRepository,
    pub(crate) parsed_scenes: Arc<ParsedScenes>,
    pub(crate) health_probe: HealthProbe,
    pub(crate) ids: IdGenerator,
    pub(crate) scene_repository: SceneRepository,
    pub(crate) scene_lookup: Arc<SceneLookup>,
    pub(crate) models: Models,
    pub(crate) parse_pool: Arc<ThreadPool>,
    pub(crate) full_parse_pool: Arc<ThreadPool>,
    pub(crate) jobs: Jobs,
    pub(crate) capacity: Arc<Capacity>,
    pub(crate) metrics: Arc<Metrics>,
    pub(crate) reader: ScanReader,
    pub(crate) service_locks: Arc<ServiceLocks>,
}

impl ParseRunner {
    /// Waits until the object store is available again. Returns `false` if that takes too long or
    /// the job is cancelled.
    async fn wait_for_object_store(&self, progress: &Progress) -> bool {
        const OBJECT_STORE_TIMEOUT: Duration = Duration::from_mins(10);
        const POLL_INTERVAL: Duration = Duration::from_secs(2);
        let back = async {
            while self.health_probe.health().await.blobs.is_some() {
                sleep(POLL_INTERVAL).await;
            }
        };
        tokio::select! {
            back = timeout(OBJECT_STORE_TIMEOUT, back) => back.is_ok(),
            _ = until_cancelled(progress) => false,
        }
    }

    async fn run_parse(
        &self,
        JobContext { lease, payload, progress, .. }: &JobContext<Payload>,
        pool: &Arc<ThreadPool>,
    ) -> Result<String, Error> {
        let (Payload { scene_id, settings, step }, job_id, progress) =
            (payload, lease.job_id.as_str(), progress.clone());
        let scene = self.scene_lookup.scene_row(scene_id).await?;
        // A draft is not needed where the full parse is stored.
        if self.reuse_stored_parse(&scene, payload, ParseStep::Full, job_id).await?
            || (*step != ParseStep::Full
                && self.reuse_stored_parse(&scene, payload, *step, job_id).await?)
        {
            return Ok(STORED_PARSE_USED.into());
        }
        let used_settings = match step {
            ParseStep::Full => settings.clone(),
            ParseStep::Draft | ParseStep::DraftThenFull => {
                ParseSettings { models: BUILTIN, ..settings.clone() }
            }
        };
        let (blobs, content, hash) = (
            self.blobs.clone(),
            self.blobs.content(&scene.content_hash),
            scene.content_hash.clone(),
        );
        // Pinned from the import until the pictures of the report are done.
        let content = Arc::new(spawn_blocking(move || blobs.pin_folder(&content)).await??);
        // All stages depend on the import of the content. The stages of a grown scan depend on the
        // import of its first upload.
        let grown_from = first_upload(&content).await?;
        let origin = serde_json::to_string(&(
            STAGE_1_VERSION,
            grown_from.as_ref().unwrap_or(&scene.content_hash),
            &settings.import,
        ))?;
        let (span, start) = (tracing::Span::current(), Instant::now());
        // Networks, where they are used, take nearly all of the time.
        let selected = select_models(used_settings.models, &self.models);
        let parsed_by = if selected.loaded.is_empty() { 0.9 } else { 0.99 };
        let imported = import_share(&selected);
        let (blobs, stage_pool, models) = (self.blobs.clone(), pool.clone(), self.models.clone());
        let how = used_settings.parsing.instances;
        let (service, entered, scan_folder, parsing) =
            (self.clone(), span.clone(), content.clone(), progress.sub_range(0.0, parsed_by));
        // A scene with a parse shows that one.
        let is_first_parse = scene.parse_id.is_none();
        let work = move || {
            let _entered = entered.enter();
            let folder = blobs.open_checkpoints(&hash)?;
            let checkpoints = Checkpoints::in_folder(&folder, &origin);
            let draft = files::draft_points(&folder);
            let scan = if let Some(scan) =
                load_stored_import(&scan_folder, &used_settings.import, &checkpoints)?
            {
                scan
            } else {
                let (content, settings) = (scan_folder.to_path_buf(), used_settings.import.clone());
                let task = Task::Import { content, settings, checkpoints: folder, origin };
                service.import(&task, &checkpoints, &parsing.sub_range(0.0, imported))?
            };
            if is_first_parse && let Err(error) = files::write_draft(&scan, &blobs, &draft) {
                tracing::warn!(%draft, %error, "draft of the cloud could not be written; viewers show no points until the parse is done");
            }
            // Parallel work stays in the pool of parses, whose threads have a low priority.
            stage_pool.install(|| {
                service.capacity.check_memory(scan.estimate_memory())?;
                Ok::<_, Error>(parse_imported_scan(
                    scan,
                    &used_settings,
                    &models,
                    &checkpoints,
                    &parsing.sub_range(imported, 1.0),
                )?)
            })
        };
        let stages = self.blobs.upload_stages(&scene.content_hash);
        let cut = spawn_blocking(work).await?;
        stages.finish().await;
        let mut scan = cut?;
        let previous =
            self.parse_to_continue(payload, &scene.content_hash, grown_from.is_some()).await?;
        // The lock makes corrections wait from here on. They then apply to the parse that is being
        // written.
        let (previous, parse_lock) = previous.unzip();
        if previous.as_ref().is_some_and(|previous| previous.is_draft)
            && scan.models == builtin_models()
        {
            let why = scan.scene.report.warnings.pop().unwrap_or_default();
            return Ok(format!("the draft stays: {why}"));
        }
        let (blobs, pool, id) = (self.blobs.clone(), pool.clone(), self.ids.new_id());
        let place = blobs.parse(&id);
        let work = move || {
            let _entered = span.enter();
            let folder = blobs.scratch()?;
            let inherited = pool.install(|| {
                let inherited = previous
                    .map(|previous| {
                        let comparing = progress.sub_range(parsed_by, parsed_by);
                        previous.continue_in(&mut scan, &how, &comparing)
                    })
                    .transpose()?;
                files::write(&scan, &content, &folder, &progress.sub_range(parsed_by, 1.0))?;
                Ok::<_, Error>(inherited)
            })?;
            blobs.publish(folder, &place)?;
            Ok::<_, Error>((scan, inherited))
        };
        let (ParsedScan { import, scene: parsed, models, .. }, inherited) =
            spawn_blocking(work).await??;

        let inserted = self
            .parse_repository
            .insert_parse(NewParse {
                id: &id,
                content_hash: &scene.content_hash,
                settings_hash: &settings_hash(settings, &models)?,
                settings,
                models: &models,
                import: &import,
                report: &parsed.report,
                extent: &parsed.extent,
                instances: &parsed.instances,
                lease,
                continued: inherited.as_ref().map(|inherited| ContinuedParse {
                    from_parse: &inherited.parse_id,
                    changes: &inherited.changes,
                    corrections: &inherited.corrections,
                    reason: match inherited.from_draft {
                        true => ContinuationReason::Draft,
                        false => ContinuationReason::Growth { scene_id },
                    },
                }),
            })
            .await?;
        if inserted {
            self.set_scene_parse(payload, *step, &id, job_id).await?;
        } else {
            // Another job stored the same parse in the meantime, or the scene was deleted.
            self.blobs.discard(self.blobs.parse(&id)).await?;
            if !self.reuse_stored_parse(&scene, payload, *step, job_id).await? {
                return Err(Error::SceneNotFound { id: scene_id.clone() });
            }
        }
        drop(parse_lock);
        let report = &parsed.report;
        let computed = report.stages.iter().filter(|stage| !stage.reused);
        self.metrics.questions.record_parse(
            start.elapsed(),
            computed.map(|stage| (stage.stage.as_str(), stage.seconds)),
        );
        Ok(format!(
            "{} instances from {} points and {} frames",
            report.instances, report.points, report.frames_used
        ))
    }

    /// Imports a scan, in a child process if this service is configured to. Blocks.
    fn import(
        &self,
        task: &Task,
        checkpoints: &Checkpoints,
        progress: &Progress,
    ) -> Result<ImportedScan, Error> {
        let outcome = self.reader.import(task, progress)?;
        let (Task::Import { content, settings, .. }, TaskOutcome::Imported { stages }) =
            (task, outcome)
        else {
            return Err(Error::Io(io::Error::other(
                "the reader of scans answered another question",
            )));
        };
        let scan = load_stored_import(content, settings, checkpoints)?;
        // Most likely the disk is full: checkpoints are not written then.
        let scan = scan
            .ok_or_else(|| Error::Io(io::Error::other("the scan's import could not be stored")))?;
        Ok(scan.with_stages(stages))
    }

    /// Assigns a stored parse of the same content and settings to the scene. Returns `false` if
    /// there is none.
    async fn reuse_stored_parse(
        &self,
        scene: &SceneRow,
        payload: &Payload,
        step: ParseStep,
        job_id: &str,
    ) -> Result<bool, Error> {
        // The lock keeps the parse until the scene refers to it.
        let _references = self.service_locks.lock_parse_references().await?;
        let models = match step {
            ParseStep::Full => model_names(&select_models(payload.settings.models, &self.models)),
            ParseStep::Draft | ParseStep::DraftThenFull => builtin_models(),
        };
        let stored =
            self.parsed_scenes.stored_parse_by(&scene.content_hash, &payload.settings, &models);
        let Some(parse_id) = stored.await? else { return Ok(false) };
        self.set_scene_parse(payload, step, &parse_id, job_id).await?;
        Ok(true)
    }

    /// Assigns a parse to the scene of a job. Queues the full parse after a draft.
    async fn set_scene_parse(
        &self,
        Payload { scene_id, settings, .. }: &Payload,
        step: ParseStep,
        parse_id: &str,
        job_id: &str,
    ) -> Result<(), Error> {
        if step != ParseStep::DraftThenFull {
            return Ok(self.scene_repository.set_scene_parse(scene_id, parse_id, job_id).await?);
        }
        let next = Payload {
            scene_id: scene_id.clone(),
            settings: settings.clone(),
            step: ParseStep::Full,
        };
        let next = JobRequest::<FullParseJob>::new(&next, None)?.without_limit();
        let set =
            self.scene_repository.set_scene_parse_and_queue(scene_id, parse_id, job_id, next.row());
        self.jobs.enqueue(&next, set).await?;
        Ok(())
    }

    /// Returns the parse that the new parse of a job continues, and the lock on its data: a draft of
    /// the same scan, or the current parse of a scene that has grown.
    async fn parse_to_continue(
        &self,
        Payload { scene_id, settings, step }: &Payload,
        content_hash: &str,
        has_grown: bool,
    ) -> Result<Option<(PreviousParse, NamedLock)>, Error> {
        let is_parsed = self.scene_lookup.scene_row(scene_id).await?.parse_id.is_some();
        if !is_parsed || !(has_grown || *step == ParseStep::Full) {
            return Ok(None);
        }
        let (parse_id, lock) = self.scene_lookup.lock_current_parse(scene_id).await?;
        let is_draft = self.is_draft_of(&parse_id, content_hash, settings).await?;
        match is_draft || has_grown {
            true => Ok(Some((self.previous_parse(parse_id, is_draft).await?, lock))),
            false => Ok(None),
        }
    }

    /// Returns whether a parse is a draft of this content with these settings.
    async fn is_draft_of(
        &self,
        parse_id: &str,
        content_hash: &str,
        settings: &ParseSettings,
    ) -> Result<bool, Error> {
        let Some(parse) = self.parse_repository.parse(parse_id).await? else { return Ok(false) };
        let is_of_content = parse.content_hash == content_hash;
        let record = parse.record();
        Ok(is_of_content
            && record.settings == *settings
            && is_draft(&record.settings, &record.models, &self.models))
    }
}

/// Returns the names of the built-in methods, which make drafts.
fn builtin_models() -> ParseModels {
    model_names(&Models::default())
}

/// Returns the hash of the first upload of a scan that has grown since.
async fn first_upload(content: &Utf8Path) -> Result<Option<String>, Error> {
    let content = content.to_owned();
    let grown = spawn_blocking(move || GrownScan::read(&content)).await??;
    Ok(grown.and_then(|grown| grown.parts.into_iter().next()).map(|part| part.hash))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn import_settings_of_the_earlier_job_are_kept_unless_overridden() {
        let payload = r#"{"scene_id": "s", "settings": {"import": {"up": "y", "metres_per_unit": 0.01, "levelling": "off", "fusion": {"voxel_m": 0.03}}}}"#;
        let kept = json!({"import": {"up": "y", "metres_per_unit": 0.01, "levelling": "off"}});
        assert_eq!(with_import_settings_of(payload, None), Some(kept));
        let asked = json!({"import": {"up": null, "levelling": "auto"}, "parsing": {}});
        let expected = json!({"import": {"up": null, "metres_per_unit": 0.01, "levelling": "auto"}, "parsing": {}});
        assert_eq!(with_import_settings_of(payload, Some(asked)), Some(expected));
        assert_eq!(with_import_settings_of("of another version", None), None);
        assert_eq!(with_import_settings_of(payload, Some(json!([1]))), Some(json!([1])));
    }
}
