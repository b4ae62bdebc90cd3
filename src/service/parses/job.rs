//! Parsing as a job.

use super::{files, settings_hash};
use crate::error::Error;
use crate::jobs::{JobContext, JobFailure, JobKind, Retry};
use crate::service::{Service, job_failure};
use crate::store::{NewParse, SceneRow, Scratch};
use camino::Utf8Path;
use serde::{Deserialize, Serialize};
use std::time::{Duration, Instant};
use tokio::task::spawn_blocking;
use uniground_core::geometry::up_axis::UpAxis;
use uniground_core::models::neural::Models;
use uniground_core::parse::{ParsedScan, STAGE_1_VERSION, parse_scan};
use uniground_core::progress::Progress;
use uniground_core::scene_parsing::checkpoints::Checkpoints;
use uniground_types::settings::{ParseSettings, with_names_of_today};

/// Parses scenes, one at a time: a parse uses every core it gets.
pub struct ParseJob(pub Service);

/// What came of a parse that was not needed.
pub(super) const STORED_PARSE_USED: &str = "the stored parse of the same content and settings is used";

/// What a parse is asked to do.
#[derive(Serialize, Deserialize)]
pub struct Payload {
    pub(super) scene_id: String,
    #[serde(deserialize_with = "settings_of_any_version")]
    pub(super) settings: ParseSettings,
}

/// A job that waits may have been written by a server whose settings had other names.
fn settings_of_any_version<'de, D: serde::Deserializer<'de>>(deserializer: D) -> Result<ParseSettings, D::Error> {
    let mut settings = serde_json::Value::deserialize(deserializer)?;
    with_names_of_today(&mut settings);
    serde_json::from_value(settings).map_err(serde::de::Error::custom)
}

/// The axis a finished job was told to take for up; nothing where its payload is of another version.
pub(super) fn up_asked_for(payload: &str) -> Option<UpAxis> {
    let payload: serde_json::Value = serde_json::from_str(payload).ok()?;
    serde_json::from_value(payload.pointer("/settings/import/up")?.clone()).ok()
}

impl JobKind for ParseJob {
    const NAME: &'static str = "parse";
    const CONCURRENCY: usize = 1;
    /// A scan that could not be parsed can not be parsed tomorrow; a disk that was full may have room.
    const RETRY: Retry = Retry { interrupted: 10, transient: 2, backoff: Duration::from_secs(5) };
    type Payload = Payload;

    async fn run(&self, job: JobContext<Payload>) -> Result<String, JobFailure> {
        let scene_id = job.payload.scene_id.clone();
        let told = self.0.run_parse(job).await.map_err(job_failure)?;
        self.0.name_when_parsed(&scene_id).await;
        Ok(told)
    }
}

impl Service {
    async fn run_parse(&self, JobContext { id: job_id, payload, progress }: JobContext<Payload>) -> Result<String, Error> {
        let Payload { scene_id, settings } = payload;
        let scene = self.scene_row(&scene_id).await?;
        if self.take_stored_parse(&scene, &settings, &job_id).await? {
            return Ok(STORED_PARSE_USED.into());
        }
        let (content, hash) = (self.store.blobs.content(&scene.content_hash), scene.content_hash.clone());
        // Every stage works on what the import made of the content.
        let origin = serde_json::to_string(&(STAGE_1_VERSION, &scene.content_hash, &settings.import))?;
        let (blobs, pool, models, job_settings) = (self.store.blobs.clone(), self.parsing.clone(), self.models.clone(), settings.clone());
        let (span, new_id, start) = (tracing::Span::current(), self.store.new_id(), Instant::now());
        let work = move || {
            let _entered = span.enter();
            let kept_in = blobs.use_checkpoints(&hash)?;
            let (folder, checkpoints) = (blobs.scratch()?, Checkpoints::kept_in(&kept_in, &origin));
            // In the pool of parses: what it does in parallel stays there, and gives way.
            let scan = pool.install(|| parse_content(&content, &job_settings, &models, &checkpoints, &folder, &progress))?;
            let id = new_id;
            blobs.publish(folder, &blobs.parse(&id))?;
            Ok::<_, Error>((id, scan))
        };
        let (id, ParsedScan { import, scene: parsed, models, .. }) = spawn_blocking(work).await??;

        let inserted = self
            .store
            .insert_parse(NewParse {
                id: &id,
                content_hash: &scene.content_hash,
                settings_hash: &settings_hash(&settings, &models)?,
                settings: &settings,
                models: &models,
                import: &import,
                report: &parsed.report,
                extent: &parsed.extent,
                instances: &parsed.instances,
            })
            .await?;
        if inserted {
            self.store.set_scene_parse(&scene_id, &id, &job_id).await?;
        } else {
            // Somebody parsed the same meanwhile, or the scene is gone.
            self.store.blobs.discard(self.store.blobs.parse(&id)).await?;
            if !self.take_stored_parse(&scene, &settings, &job_id).await? {
                return Err(Error::SceneNotFound { id: scene_id });
            }
        }
        let report = &parsed.report;
        let computed = report.stages.iter().filter(|stage| !stage.reused);
        self.metrics
            .questions
            .parsed(start.elapsed(), computed.map(|stage| (stage.stage.as_str(), stage.seconds)));
        Ok(format!("{} instances from {} points and {} frames", report.instances, report.points, report.frames_used))
    }

    /// Makes a stored parse of the same content and settings the scene's own, where there is one.
    async fn take_stored_parse(&self, scene: &SceneRow, settings: &ParseSettings, job_id: &str) -> Result<bool, Error> {
        // It stays until the scene refers to it.
        let _references = self.parse_references.lock().await;
        let Some(parse_id) = self.stored_parse(&scene.content_hash, settings).await? else { return Ok(false) };
        self.store.set_scene_parse(&scene.id, &parse_id, job_id).await?;
        Ok(true)
    }
}

/// Import and stage 1 from an unpacked archive to files in `folder`.
fn parse_content(
    content: &Utf8Path,
    settings: &ParseSettings,
    models: &Models,
    checkpoints: &Checkpoints,
    folder: &Scratch,
    progress: &Progress,
) -> Result<ParsedScan, Error> {
    // Networks take nearly all of the time where they take part.
    let (parsed_by, drawn_by) = if models.loaded.is_empty() { (0.8, 0.85) } else { (0.98, 0.985) };
    let scan = parse_scan(content, settings, models, checkpoints, &progress.part(0.0, parsed_by))?;
    files::write(&scan, content, folder, &progress.part(parsed_by, drawn_by), &progress.part(drawn_by, 1.0))?;
    Ok(scan)
}
