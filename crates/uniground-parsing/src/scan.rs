//! Stage 1 from end to end: an unpacked scan to a [`ParsedScene`], with the configured models.

use crate::checkpoints::Checkpoints;
use crate::correction::Corrector;
use crate::masks::rgbd::RgbdMasks;
use crate::masks::sam::{EncodedFrames, SamMasks};
use crate::masks::{CombinedMasks, MaskSource};
use crate::{ParseError, Perception, StageOutcome, Stopwatch};
use camino::Utf8Path;
use uniground_geometry::progress::{Cancelled, Progress};
use uniground_geometry::scene::{
    FrameRef, ImportReport, ParsedScene, PointCloud, SceneBundle, SourceToScene, stream_frames,
};
use uniground_ingest::{GrownScan, IngestError, part_folder};
use uniground_models::attributes;
use uniground_models::neural::{Models, Role};
use uniground_types::scene::StageReport;
use uniground_types::settings::{
    ImportSettings, ModelChoice, ParseModels, ParseSettings, PartChoice,
};

/// Version of stage 1, raised when its results change: older parses stay stored but are not reused
/// as new ones.
pub const STAGE_1_VERSION: u32 = 13;

/// Why a scan could not be parsed. Messages name the file, frame or model at fault.
#[derive(Debug, thiserror::Error)]
pub enum ScanError {
    /// The import failed or was cancelled; the messages name the file at fault.
    #[error(transparent)]
    Ingest(#[from] IngestError),
    /// Stage 1 failed or was cancelled.
    #[error(transparent)]
    Parse(#[from] ParseError),
    /// A temporary folder for encoded pictures could not be created.
    #[error("a file of the parse could not be read or written")]
    Io(#[from] std::io::Error),
    /// The import has no checkpoint and must be made first.
    #[error("the scan has not been imported")]
    NotImported,
}

/// Returns the available models that the settings enable.
#[must_use]
pub fn select_models(choice: ModelChoice, models: &Models) -> Models {
    models.select_roles(
        choice.masks == PartChoice::Configured,
        choice.encoder == PartChoice::Configured,
    )
}

/// Returns the name and version of the models in use, or of the built-in methods in their place.
#[must_use]
pub fn model_names(models: &Models) -> ParseModels {
    ParseModels {
        masks: models.label(Role::Masks).unwrap_or_else(|| RgbdMasks::default().name().to_owned()),
        encoder: models.label(Role::Encoder).unwrap_or_else(|| attributes::NAME.to_owned()),
    }
}

/// A scan after import and parsing.
pub struct ParsedScan {
    /// What the import found and did.
    pub import: ImportReport,
    /// All frames of the scan, with the paths of their picture files.
    pub frames: Vec<FrameRef>,
    /// Cloud, instances and embeddings.
    pub scene: ParsedScene,
    /// Name and version of the mask source and encoder that were used.
    pub models: ParseModels,
}

/// The built-in methods only. A parse takes seconds then.
pub const BUILTIN: ModelChoice =
    ModelChoice { masks: PartChoice::Builtin, encoder: PartChoice::Builtin, allow_builtin: false };

/// Imports an unpacked scan and runs stage 1. Blocks, and uses the threads of the current rayon
/// pool.
///
/// # Errors
/// [`ScanError`], also when the work was cancelled.
pub fn parse_scan(
    content: &Utf8Path,
    settings: &ParseSettings,
    models: &Models,
    checkpoints: &Checkpoints,
    progress: &Progress,
) -> Result<ParsedScan, ScanError> {
    let imported = import_share(&select_models(settings.models, models));
    let scan =
        import_scan(content, &settings.import, checkpoints, &progress.sub_range(0.0, imported))?;
    parse_imported_scan(scan, settings, models, checkpoints, &progress.sub_range(imported, 1.0))
}

/// Returns the share of a parse's time that the import takes with these models. Networks, if used,
/// take nearly all of the time.
#[must_use]
pub fn import_share(models: &Models) -> f32 {
    if models.loaded.is_empty() { 0.25 } else { 0.01 }
}

/// An imported scan, ready to be parsed.
pub struct ImportedScan {
    bundle: SceneBundle,
    stages: Vec<StageReport>,
}

/// Memory that stage 1 takes per point, bytes, besides the point itself. Measured with clouds of
/// one to eight million points (105 at most).
const BYTES_PER_POINT: u64 = 120;
/// Memory per pixel of a frame in process, bytes; one frame per thread.
const BYTES_PER_PIXEL: u64 = 64;

impl ImportedScan {
    /// Estimates the memory that parsing takes in the current thread pool, bytes, without networks.
    #[must_use]
    pub fn estimate_memory(&self) -> u64 {
        let (_, frames) = self.bundle.combine_additions();
        let pixels = |frame: &FrameRef| {
            u64::from(frame.color_intrinsics.width) * u64::from(frame.color_intrinsics.height)
        };
        let largest = frames.iter().map(pixels).max().unwrap_or(0);
        self.bundle.points() as u64 * BYTES_PER_POINT
            + largest * BYTES_PER_PIXEL * rayon::current_num_threads() as u64
    }

    /// Returns the time and memory of the import, for the report of the parse.
    #[must_use]
    pub fn stages(&self) -> &[StageReport] {
        &self.stages
    }

    /// The cloud of the scan's first upload, before any instance is found.
    #[must_use]
    pub fn cloud(&self) -> &PointCloud {
        &self.bundle.cloud
    }

    /// Returns the same scan with the stage reports of an import that another process has made.
    #[must_use]
    pub fn with_stages(self, stages: Vec<StageReport>) -> Self {
        Self { stages, ..self }
    }

    /// Decodes every picture that the import has not decoded, and discards it. Damaged pictures are
    /// no error: stage 1 names those it meets. Run this in an isolated process to verify that no
    /// picture crashes its decoder or takes too much memory.
    ///
    /// # Errors
    /// [`ScanError::Ingest`] when the work was cancelled.
    pub fn check_pictures(&self, progress: &Progress) -> Result<(), ScanError> {
        let SceneBundle { frames, report, .. } = &self.bundle;
        // A scan without its own cloud was fused from all its frames, as were additions: those are
        // already decoded.
        let frames = if report.cloud_points.is_some() { &frames[..] } else { &[] };
        let all = frames.len().max(1) as f32;
        stream_frames(
            frames,
            |frame| {
                progress.check()?;
                drop((frame.decode_color(), frame.decode_depth()));
                Ok::<_, Cancelled>(())
            },
            |at, ()| progress.report("check_pictures", at as f32 / all),
        )
        .map_err(|cancelled| ScanError::Ingest(cancelled.into()))
    }
}

/// Imports an unpacked scan: reads or fuses its cloud, and checks that cloud, poses and depth
/// agree. Blocks.
///
/// # Errors
/// [`ScanError::Ingest`], also when the work was cancelled.
pub fn import_scan(
    content: &Utf8Path,
    settings: &ImportSettings,
    checkpoints: &Checkpoints,
    progress: &Progress,
) -> Result<ImportedScan, ScanError> {
    load_or_import(content, settings, checkpoints, progress, MissingStage::Made)
}

/// Loads the import of a scan from its checkpoints; `None` if it is not stored. Decodes nothing of
/// the scan itself.
///
/// # Errors
/// [`ScanError::Ingest`] if the list of a scan's parts cannot be read.
pub fn load_stored_import(
    content: &Utf8Path,
    settings: &ImportSettings,
    checkpoints: &Checkpoints,
) -> Result<Option<ImportedScan>, ScanError> {
    match load_or_import(content, settings, checkpoints, &Progress::silent(), MissingStage::Refused)
    {
        Ok(scan) => Ok(Some(scan)),
        Err(ScanError::NotImported) => Ok(None),
        Err(error) => Err(error),
    }
}

/// What to do with a part of an import that has no checkpoint.
#[derive(Clone, Copy, PartialEq, Eq)]
enum MissingStage {
    Made,
    Refused,
}

fn load_or_import(
    content: &Utf8Path,
    settings: &ImportSettings,
    checkpoints: &Checkpoints,
    progress: &Progress,
    missing: MissingStage,
) -> Result<ImportedScan, ScanError> {
    let mut watch = Stopwatch::default();
    let bundle = watch.time("import", |outcome| {
        let (bundle, reused) = import(content, settings, checkpoints, progress, missing)?;
        *outcome = StageOutcome { produced: bundle.points(), reused, ..StageOutcome::default() };
        Ok::<_, ScanError>(bundle)
    })?;
    Ok(ImportedScan { bundle, stages: watch.stages })
}

/// Runs stage 1 of an imported scan. Blocks, and uses the threads of the current rayon pool.
///
/// # Errors
/// [`ScanError`], also when the work was cancelled.
pub fn parse_imported_scan(
    scan: ImportedScan,
    settings: &ParseSettings,
    models: &Models,
    checkpoints: &Checkpoints,
    progress: &Progress,
) -> Result<ParsedScan, ScanError> {
    let ImportedScan { bundle, stages } = scan;
    let again = settings.models.allow_builtin.then(|| bundle.clone());
    let mut scan = match (
        parse_bundle(
            bundle,
            settings,
            &select_models(settings.models, models),
            checkpoints,
            progress,
        ),
        again,
    ) {
        (Err(ScanError::Parse(ParseError::Model(error))), Some(bundle)) => {
            let mut scan = parse_bundle(
                bundle,
                settings,
                &select_models(BUILTIN, models),
                checkpoints,
                progress,
            )?;
            scan.scene
                .report
                .warnings
                .push(format!("a model failed; the built-in methods were used instead: {error}"));
            scan
        }
        (cut, _) => cut?,
    };
    scan.scene.report.stages.splice(0..0, stages);
    Ok(scan)
}

/// Imports a scan and its additions. The flag is `true` if all of it came from checkpoints.
fn import(
    content: &Utf8Path,
    settings: &ImportSettings,
    checkpoints: &Checkpoints,
    progress: &Progress,
    missing: MissingStage,
) -> Result<(SceneBundle, bool), ScanError> {
    let may_load =
        || if missing == MissingStage::Made { Ok(()) } else { Err(ScanError::NotImported) };
    let added = GrownScan::read(content)?
        .map_or_else(Vec::new, |grown| grown.parts.into_iter().skip(1).collect());
    let first = if added.is_empty() { content.to_owned() } else { part_folder(content, 0) };
    let share = |parts: usize| parts as f32 / (added.len() + 1) as f32;
    // Stored with paths relative to the folder, which can be elsewhere next time.
    let below =
        |folder: &Utf8Path, path: &Utf8Path| path.strip_prefix(folder).unwrap_or(path).to_owned();
    let load = || {
        may_load()?;
        let bundle = uniground_ingest::load(
            &uniground_ingest::open(&first)?,
            settings,
            &progress.sub_range(0.0, share(1)),
        )?;
        Ok::<_, ScanError>(bundle.with_paths(|path| below(&first, path)))
    };
    let (bundle, mut all_reused) = checkpoints.load_or_compute("import", &(), load)?;
    let mut bundle = bundle.with_paths(|path| first.join(path));
    let to_scene = bundle.report.source_to_scene.unwrap_or(SourceToScene::IDENTITY);
    let (mut checkpoints, mut known) = (checkpoints.clone(), None);
    for (part, number) in added.iter().zip(1..) {
        let folder = part_folder(content, number);
        let made_of = format!(";{}", serde_json::to_string(part).map_err(std::io::Error::from)?);
        checkpoints = checkpoints.with_dependency(&made_of);
        let cloud = known.as_ref().unwrap_or(&bundle.cloud);
        let load = || {
            may_load()?;
            let (first, looking) =
                (bundle.next_frame(), progress.sub_range(share(number), share(number + 1)));
            let to_scene = part.to_scene.unwrap_or(to_scene);
            let addition = uniground_ingest::add_scan(
                uniground_ingest::open(&folder)?,
                made_of,
                &to_scene,
                cloud,
                first,
                settings,
                &looking,
            )?;
            Ok::<_, ScanError>(addition.with_paths(|path| below(&folder, path)))
        };
        let (addition, reused) =
            checkpoints.load_or_compute(&format!("import{number}"), &(), load)?;
        all_reused &= reused;
        known = Some(addition.apply_to(cloud));
        bundle.additions.push(addition.with_paths(|path| folder.join(path)));
    }
    Ok((bundle, all_reused))
}

fn parse_bundle(
    bundle: SceneBundle,
    settings: &ParseSettings,
    models: &Models,
    checkpoints: &Checkpoints,
    progress: &Progress,
) -> Result<ParsedScan, ScanError> {
    let (import, frames) = bundle.combine_additions();
    let names = model_names(models);
    let parsing = &settings.parsing;
    let rgbd = RgbdMasks { settings: parsing.rgbd_masks };
    // Only correction needs encoded pictures.
    let corrects = parsing.correction.rounds > 0;
    let max_bytes = if corrects { u64::from(parsing.sam_masks.cache_mb) << 20 } else { 0 };
    let encoded = models
        .segmenters
        .iter()
        .enumerate()
        .map(|(i, segmenter)| {
            EncodedFrames::new(
                segmenter.clone(),
                checkpoints.folder(),
                if i == 0 { max_bytes } else { 0 },
            )
        })
        .collect::<Result<Vec<_>, _>>()?;
    let sam: Vec<SamMasks> = encoded
        .iter()
        .map(|frames| SamMasks {
            frames,
            settings: parsing.sam_masks,
            segments: parsing.rgbd_masks,
            name: names.masks.clone(),
        })
        .collect();
    let together = CombinedMasks {
        sources: sam.iter().map(|sam| sam as &dyn MaskSource).collect(),
        name: names.masks.clone(),
    };
    let perception = Perception {
        masks: if sam.is_empty() { &rgbd } else { &together },
        corrector: encoded
            .first()
            .filter(|_| corrects)
            .map(|frames| Corrector { frames, settings: parsing.correction }),
        encoder: models.encoder.as_deref(),
    };
    let scene = crate::parse(bundle, &perception, parsing, checkpoints, progress)?;
    Ok(ParsedScan { import, frames, scene, models: names })
}
