//! Parsing as a job: the same content with the same settings is parsed once.

use super::parse_settings::{ModelChoice, ParseModels, ParsePreset, ParseSettings, STAGE_1_VERSION};
use super::{Service, report_files};
use crate::error::Error;
use crate::ingest;
use crate::jobs::{Handler, Job, JobContext, JobFailure};
use crate::models::neural::Models;
use crate::progress::Progress;
use crate::scene::{FrameRef, ImportReport, ParsedScene, write_cloud_ply, write_instances_ply};
use crate::scene_parsing::checkpoints::Checkpoints;
use crate::scene_parsing::correction::Corrector;
use crate::scene_parsing::evidence::{EvidencePicture, Picture};
use crate::scene_parsing::masks::MaskSource;
use crate::scene_parsing::masks::rgbd::RgbdMasks;
use crate::scene_parsing::masks::sam::{EncodedFrames, SamMasks};
use crate::scene_parsing::{self, Outcome, ParseError, Perception, Stopwatch, evidence, report_pictures};
use crate::store::{NewParse, SceneRow, Scratch};
use camino::{Utf8Path, Utf8PathBuf};
use futures::FutureExt;
use serde::{Deserialize, Serialize};
use std::fs::{self, File};
use std::sync::Arc;
use tokio::task::spawn_blocking;
use uuid::Uuid;

/// Name of the job kind.
pub const PARSE_JOB: &str = "parse";

/// Files of a parse that an encoder took part in.
pub(super) const EMBEDDINGS_FILE: &str = "embeddings.npy";
pub(super) const NORMS_FILE: &str = "embedding_norms.npy";

#[derive(Serialize, Deserialize)]
struct Payload {
    scene_id: String,
    settings: ParseSettings,
}

/// What the blocking part of a parse produces.
struct Finished {
    import: ImportReport,
    parsed: ParsedScene,
    models: ParseModels,
    blobs: Scratch,
}

impl Service {
    /// The models a parse started now is made with, unless it asks for others.
    #[must_use]
    pub fn parse_models(&self) -> ParseModels {
        ParseModels::of(&self.models)
    }

    /// Parses a scene, in the background. A stored parse of the same content and settings is taken at once.
    ///
    /// # Errors
    /// [`Error`] when the scene is unknown or the queue is full.
    pub async fn start_parse(&self, scene_id: &str, settings: &ParseSettings) -> Result<Job, Error> {
        let scene = self.scene_row(scene_id).await?;
        let payload = serde_json::to_string(&Payload { scene_id: scene.id.clone(), settings: settings.clone() })?;
        let job = match self.stored_parse(&scene, settings).await? {
            Some(parse_id) => {
                let message = "the stored parse of the same content and settings is used";
                let job = self.jobs.submit_done(PARSE_JOB, &scene.id, &payload, message).await?;
                self.store.set_scene_parse(&scene.id, &parse_id, &job.id).await?;
                job
            }
            None => self.jobs.submit(PARSE_JOB, &scene.id, &payload).await?,
        };
        self.store.set_scene_job(&scene.id, &job.id).await?;
        Ok(job)
    }

    /// Parses a scene again: a preset with single values replaced. What is up was settled at the upload and stays, unless said.
    ///
    /// # Errors
    /// [`Error`] for settings that make no sense, an unknown scene or a full queue.
    pub async fn reparse(&self, scene_id: &str, preset: ParsePreset, overrides: Option<serde_json::Value>) -> Result<Job, Error> {
        let mut settings = ParseSettings::from_request(preset, overrides)?;
        let scene = self.scene_row(scene_id).await?;
        if settings.import.up.is_none()
            && let Some(job_id) = &scene.job_id
            && let Some(job) = self.store.job(job_id).await?
        {
            let Payload { settings: before, .. } = serde_json::from_str(&job.payload)?;
            settings.import.up = before.import.up;
        }
        self.start_parse(scene_id, &settings).await
    }

    async fn stored_parse(&self, scene: &SceneRow, settings: &ParseSettings) -> Result<Option<String>, Error> {
        let hash = settings.hash(&ParseModels::of(&settings.models.of(&self.models)))?;
        Ok(self.store.parse_of(&scene.content_hash, &hash).await?.map(|parse| parse.id))
    }

    /// The handler of [`PARSE_JOB`].
    #[must_use]
    pub fn parse_handler(&self) -> Handler {
        let service = self.clone();
        Arc::new(move |context| {
            let service = service.clone();
            async move {
                service.run_parse(context).await.map_err(|error| match error.code() {
                    "cancelled" => JobFailure::Cancelled,
                    code => {
                        tracing::warn!(error = &error as &dyn std::error::Error, "parse failed");
                        JobFailure::Failed { code: code.to_owned(), detail: error.to_string() }
                    }
                })
            }
            .boxed()
        })
    }

    async fn run_parse(&self, JobContext { id: job_id, payload, progress }: JobContext) -> Result<String, Error> {
        let Payload { scene_id, settings } = serde_json::from_str(&payload)?;
        let scene = self.scene_row(&scene_id).await?;
        if let Some(parse_id) = self.stored_parse(&scene, &settings).await? {
            self.store.set_scene_parse(&scene_id, &parse_id, &job_id).await?;
            return Ok("the stored parse of the same content and settings is used".into());
        }
        let (content, scratch) = (self.store.blobs.content(&scene.content_hash), self.store.blobs.scratch()?);
        // Every stage works on what the import made of the content.
        let origin = serde_json::to_string(&(STAGE_1_VERSION, &scene.content_hash, &settings.import))?;
        let kept_in = self.store.blobs.checkpoints(&scene.content_hash);
        fs::create_dir_all(&kept_in)?;
        let checkpoints = Checkpoints::kept_in(&kept_in, &origin);
        let (job_settings, models) = (settings.clone(), self.models.clone());
        let parse = move || parse_content(&content, &job_settings, &models, &checkpoints, scratch, &progress);
        let Finished { import, parsed, models, blobs } = spawn_blocking(parse).await??;

        let id = Uuid::now_v7().to_string();
        self.store.blobs.publish(blobs, &self.store.blobs.parse(&id))?;
        let inserted = self
            .store
            .insert_parse(NewParse {
                id: &id,
                content_hash: &scene.content_hash,
                settings_hash: &settings.hash(&models)?,
                settings: serde_json::to_string(&settings)?,
                models: serde_json::to_string(&models)?,
                import_report: serde_json::to_string(&import)?,
                parse_report: serde_json::to_string(&parsed.report)?,
                extent: serde_json::to_string(&parsed.extent)?,
                instances: &parsed.instances,
            })
            .await?;
        if !inserted {
            self.store.blobs.remove(&self.store.blobs.parse(&id))?;
        }
        let parse_id = match inserted {
            true => id,
            // Somebody parsed the same meanwhile, or the scene is gone.
            false => self.stored_parse(&scene, &settings).await?.ok_or(Error::SceneNotFound { id: scene_id.clone() })?,
        };
        self.store.set_scene_parse(&scene_id, &parse_id, &job_id).await?;
        let report = &parsed.report;
        Ok(format!("{} instances from {} points and {} frames", report.instances, report.points, report.frames_used))
    }
}

/// A scan brought in and cut into instances.
pub struct ParsedScan {
    pub import: ImportReport,
    pub frames: Vec<FrameRef>,
    pub scene: ParsedScene,
    /// What it was made with.
    pub models: ParseModels,
}

/// Import and stage 1 of an unpacked archive; blocks, and uses all of rayon's threads.
///
/// # Errors
/// [`Error`] naming the file, frame or model at fault, or cancellation.
pub fn parse_scan(
    content: &Utf8Path,
    settings: &ParseSettings,
    models: &Models,
    checkpoints: &Checkpoints,
    progress: &Progress,
) -> Result<ParsedScan, Error> {
    match parse_with(content, settings, &settings.models.of(models), checkpoints, progress) {
        Err(Error::Parse(ParseError::Model(error))) if settings.models.allow_builtin => {
            let mut scan = parse_with(content, settings, &ModelChoice::BUILTIN.of(models), checkpoints, progress)?;
            scan.scene
                .report
                .warnings
                .push(format!("a model failed and the built-in parts did the work: {error}"));
            Ok(scan)
        }
        parsed => parsed,
    }
}

fn parse_with(
    content: &Utf8Path,
    settings: &ParseSettings,
    models: &Models,
    checkpoints: &Checkpoints,
    progress: &Progress,
) -> Result<ParsedScan, Error> {
    let mut watch = Stopwatch::default();
    let imported = if models.loaded.is_empty() { 0.25 } else { 0.01 };
    let bundle = watch.time("import", |outcome| {
        // Kept with paths relative to the content, whose folder may lie elsewhere tomorrow.
        let load = || {
            let bundle = ingest::load(&ingest::open(content)?, &settings.import, &progress.part(0.0, imported))?;
            Ok::<_, Error>(bundle.with_paths(|path| path.strip_prefix(content).unwrap_or(path).to_owned()))
        };
        let (bundle, reused) = checkpoints.once("import", &(), load)?;
        *outcome = Outcome { produced: bundle.cloud.len(), reused };
        Ok::<_, Error>(bundle.with_paths(|path| content.join(path)))
    })?;
    let (import, frames) = (bundle.report.clone(), bundle.frames.clone());
    let names = ParseModels::of(models);
    let parsing = &settings.parsing;
    let rgbd = RgbdMasks { settings: parsing.rgbd_masks };
    // Encoded pictures are kept for correction alone.
    let corrects = parsing.correction.rounds > 0;
    let max_bytes = if corrects { u64::from(parsing.sam_masks.cache_mb) << 20 } else { 0 };
    let encoded = models
        .segmenter
        .clone()
        .map(|segmenter| EncodedFrames::new(segmenter, checkpoints.folder(), max_bytes))
        .transpose()?;
    let sam = encoded
        .as_ref()
        .map(|frames| SamMasks { frames, settings: parsing.sam_masks, name: names.masks.clone() });
    let perception = Perception {
        masks: sam.as_ref().map_or(&rgbd, |sam| sam as &dyn MaskSource),
        corrector: encoded
            .as_ref()
            .filter(|_| corrects)
            .map(|frames| Corrector { frames, settings: parsing.correction }),
        encoder: models.encoder.as_deref(),
    };
    let mut scene = scene_parsing::parse(bundle, &perception, parsing, checkpoints, &progress.part(imported, 1.0))?;
    scene.report.stages.splice(0..0, watch.stages);
    Ok(ParsedScan { import, frames, scene, models: names })
}

/// Import and stage 1 from an unpacked archive to files in `blobs`.
fn parse_content(
    content: &Utf8Path,
    settings: &ParseSettings,
    models: &Models,
    checkpoints: &Checkpoints,
    blobs: Scratch,
    progress: &Progress,
) -> Result<Finished, Error> {
    // Networks take nearly all of the time where they take part.
    let (parsed_by, drawn_by) = if models.loaded.is_empty() { (0.8, 0.85) } else { (0.98, 0.985) };
    let ParsedScan { import, frames, scene: parsed, models } =
        parse_scan(content, settings, models, checkpoints, &progress.part(0.0, parsed_by))?;
    let writing = progress.part(parsed_by, drawn_by);
    writing.report("write_clouds", 0.0).map_err(ParseError::from)?;
    write_cloud_ply(&parsed.cloud, File::create(blobs.path().join("cloud.ply"))?)?;
    write_instances_ply(&parsed, File::create(blobs.path().join("instances.ply"))?)?;
    if let Some(embeddings) = &parsed.embeddings {
        embeddings.write_rows(File::create(blobs.path().join(EMBEDDINGS_FILE))?)?;
        embeddings.write_norms(File::create(blobs.path().join(NORMS_FILE))?)?;
    }
    writing.report("draw_report", 0.5).map_err(ParseError::from)?;
    report_files::write(blobs.path(), report_pictures::render(&parsed, &frames, &writing)?)?;
    writing.check().map_err(ParseError::from)?;
    let views = blobs.path().join("views");
    fs::create_dir(&views)?;
    evidence::render(
        &frames,
        &parsed.instances,
        &progress.part(drawn_by, 1.0),
        |EvidencePicture { instance, view, picture, jpeg }| {
            Ok::<_, Error>(fs::write(views.join(view_file(instance.0, view, picture)), jpeg)?)
        },
    )?;
    Ok(Finished { import, parsed, models, blobs })
}

/// Name of an evidence picture within a parse's `views/`.
pub(super) fn view_file(instance: u32, view: usize, picture: Picture) -> Utf8PathBuf {
    let kind = match picture {
        Picture::Crop => "crop",
        Picture::Frame => "frame",
    };
    format!("{instance}-{view}-{kind}.jpg").into()
}
