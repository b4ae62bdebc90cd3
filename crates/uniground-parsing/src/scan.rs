//! Stage 1 from end to end: an unpacked scan to a [`ParsedScene`], with the models that are at
//! hand.

use crate::checkpoints::Checkpoints;
use crate::correction::Corrector;
use crate::masks::rgbd::RgbdMasks;
use crate::masks::sam::{EncodedFrames, SamMasks};
use crate::masks::{CombinedMasks, MaskSource};
use crate::{ParseError, Perception, StageOutcome, Stopwatch};
use camino::Utf8Path;
use uniground_geometry::progress::{Cancelled, Progress};
use uniground_geometry::scene::{
    FrameRef, ImportReport, ParsedScene, SceneBundle, SourceToScene, stream_frames,
};
use uniground_ingest::{GrownScan, IngestError, part_folder};
use uniground_models::attributes;
use uniground_models::neural::{Models, Role};
use uniground_types::scene::StageReport;
use uniground_types::settings::{
    ImportSettings, ModelChoice, ParseModels, ParseSettings, PartChoice,
};

/// Raised when stage 1 changes what it computes: older parses are kept, but not taken for new ones.
pub const STAGE_1_VERSION: u32 = 9;

/// Why a scan could not be parsed. Messages name the file, frame or model at fault.
#[derive(Debug, thiserror::Error)]
pub enum ScanError {
    /// The import failed or was cancelled; the messages name the file at fault.
    #[error(transparent)]
    Ingest(#[from] IngestError),
    /// Stage 1 failed or was cancelled.
    #[error(transparent)]
    Parse(#[from] ParseError),
    /// A working folder for encoded pictures could not be made.
    #[error("a file of the parse could not be read or written")]
    Io(#[from] std::io::Error),
    /// The import is not stored: it has to be made.
    #[error("the scan's import is not stored")]
    NotImported,
}

/// Of the models at hand, those that the settings let take part.
#[must_use]
pub fn chosen(choice: ModelChoice, models: &Models) -> Models {
    models.only(choice.masks == PartChoice::Configured, choice.encoder == PartChoice::Configured)
}

/// Name and version of what takes part: models, or the built-in parts in their place.
#[must_use]
pub fn names_of(models: &Models) -> ParseModels {
    ParseModels {
        masks: models.label(Role::Masks).unwrap_or_else(|| RgbdMasks::default().name().to_owned()),
        encoder: models.label(Role::Encoder).unwrap_or_else(|| attributes::NAME.to_owned()),
    }
}

/// A scan brought in and cut into instances.
pub struct ParsedScan {
    /// What the import found and did.
    pub import: ImportReport,
    /// All frames of the scan, with the paths of their picture files.
    pub frames: Vec<FrameRef>,
    /// Cloud, instances and embeddings.
    pub scene: ParsedScene,
    /// Name and version of the mask source and the encoder that made it.
    pub models: ParseModels,
}

const BUILTIN: ModelChoice =
    ModelChoice { masks: PartChoice::Builtin, encoder: PartChoice::Builtin, allow_builtin: false };

/// Import and stage 1 of an unpacked scan; blocks, and uses the threads of the rayon pool it is
/// called in.
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
    let imported = share_of_import(&chosen(settings.models, models));
    let scan = import_scan(content, &settings.import, checkpoints, &progress.part(0.0, imported))?;
    cut_scan(scan, settings, models, checkpoints, &progress.part(imported, 1.0))
}

/// How much of the time of a parse with these models goes into the import: networks take nearly all
/// of it where they take part.
#[must_use]
pub fn share_of_import(models: &Models) -> f32 {
    if models.loaded.is_empty() { 0.25 } else { 0.01 }
}

/// A scan that was brought in, to be cut into instances.
pub struct ImportedScan {
    bundle: SceneBundle,
    stages: Vec<StageReport>,
}

/// Bytes that stage 1 takes for a point, beside the point itself: measured with clouds of one to
/// eight million (105 at most).
const BYTES_PER_POINT: u64 = 120;
/// Bytes it takes for a pixel of a frame that is looked at, one a thread.
const BYTES_PER_PIXEL: u64 = 64;

impl ImportedScan {
    /// What cutting it will take in the present pool of threads, bytes, without what networks take:
    /// an estimate.
    #[must_use]
    pub fn memory_wanted(&self) -> u64 {
        let (_, frames) = self.bundle.in_all();
        let pixels = |frame: &FrameRef| {
            u64::from(frame.colour_intrinsics.width) * u64::from(frame.colour_intrinsics.height)
        };
        let largest = frames.iter().map(pixels).max().unwrap_or(0);
        self.bundle.points() as u64 * BYTES_PER_POINT
            + largest * BYTES_PER_PIXEL * rayon::current_num_threads() as u64
    }

    /// What the import took, for the report of the parse.
    #[must_use]
    pub fn stages(&self) -> &[StageReport] {
        &self.stages
    }

    /// The same scan with the stages of an import that another process has made.
    #[must_use]
    pub fn with_stages(self, stages: Vec<StageReport>) -> Self {
        Self { stages, ..self }
    }

    /// Decodes every picture that the import has not decoded and lets go of it. Pictures that are
    /// damaged are no error: stage 1 names those it meets. Run where a fault does no harm, this
    /// shows that none of them crashes its decoder or takes too much memory.
    ///
    /// # Errors
    /// [`ScanError::Ingest`] when the work was cancelled.
    pub fn try_pictures(&self, progress: &Progress) -> Result<(), ScanError> {
        let SceneBundle { frames, report, .. } = &self.bundle;
        // Without a cloud of its own the scan was fused from all its frames, and so was what was
        // added.
        let frames = if report.cloud_points.is_some() { &frames[..] } else { &[] };
        let all = frames.len().max(1) as f32;
        stream_frames(
            frames,
            |frame| {
                progress.check()?;
                drop((frame.decode_colour(), frame.decode_depth()));
                Ok::<_, Cancelled>(())
            },
            |at, ()| progress.report("check_pictures", at as f32 / all),
        )
        .map_err(|cancelled| ScanError::Ingest(cancelled.into()))
    }
}

/// Import of an unpacked scan: reads or fuses its cloud, and checks that cloud, poses and depth
/// agree; blocks.
///
/// # Errors
/// [`ScanError::Ingest`], also when the work was cancelled.
pub fn import_scan(
    content: &Utf8Path,
    settings: &ImportSettings,
    checkpoints: &Checkpoints,
    progress: &Progress,
) -> Result<ImportedScan, ScanError> {
    timed_import(content, settings, checkpoints, progress, MissingStage::Made)
}

/// The import of a scan as it is stored in its checkpoints; `None` where it is not. Nothing of the
/// scan itself is decoded.
///
/// # Errors
/// [`ScanError::Ingest`] where the list of a scan's parts can not be read.
pub fn stored_import(
    content: &Utf8Path,
    settings: &ImportSettings,
    checkpoints: &Checkpoints,
) -> Result<Option<ImportedScan>, ScanError> {
    match timed_import(content, settings, checkpoints, &Progress::silent(), MissingStage::Refused) {
        Ok(scan) => Ok(Some(scan)),
        Err(ScanError::NotImported) => Ok(None),
        Err(error) => Err(error),
    }
}

/// What happens to a part of an import that no checkpoint holds.
#[derive(Clone, Copy, PartialEq, Eq)]
enum MissingStage {
    Made,
    Refused,
}

fn timed_import(
    content: &Utf8Path,
    settings: &ImportSettings,
    checkpoints: &Checkpoints,
    progress: &Progress,
    missing: MissingStage,
) -> Result<ImportedScan, ScanError> {
    let mut watch = Stopwatch::default();
    let bundle = watch.time("import", |outcome| {
        let (bundle, reused) = import(content, settings, checkpoints, progress, missing)?;
        *outcome = StageOutcome { produced: bundle.points(), reused };
        Ok::<_, ScanError>(bundle)
    })?;
    Ok(ImportedScan { bundle, stages: watch.stages })
}

/// Stage 1 of a scan that was brought in; blocks, and uses the threads of the rayon pool it is
/// called in.
///
/// # Errors
/// [`ScanError`], also when the work was cancelled.
pub fn cut_scan(
    scan: ImportedScan,
    settings: &ParseSettings,
    models: &Models,
    checkpoints: &Checkpoints,
    progress: &Progress,
) -> Result<ParsedScan, ScanError> {
    let ImportedScan { bundle, stages } = scan;
    let again = settings.models.allow_builtin.then(|| bundle.clone());
    let mut scan = match (
        cut_with(bundle, settings, &chosen(settings.models, models), checkpoints, progress),
        again,
    ) {
        (Err(ScanError::Parse(ParseError::Model(error))), Some(bundle)) => {
            let mut scan =
                cut_with(bundle, settings, &chosen(BUILTIN, models), checkpoints, progress)?;
            scan.scene
                .report
                .warnings
                .push(format!("a model failed and the built-in parts did the work: {error}"));
            scan
        }
        (cut, _) => cut?,
    };
    scan.scene.report.stages.splice(0..0, stages);
    Ok(scan)
}

/// A scan and what was added to it since; the flag tells whether all of it was kept from before.
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
    // Kept with paths relative to the folder, which may lie elsewhere tomorrow.
    let below =
        |folder: &Utf8Path, path: &Utf8Path| path.strip_prefix(folder).unwrap_or(path).to_owned();
    let load = || {
        may_load()?;
        let bundle = uniground_ingest::load(
            &uniground_ingest::open(&first)?,
            settings,
            &progress.part(0.0, share(1)),
        )?;
        Ok::<_, ScanError>(bundle.with_paths(|path| below(&first, path)))
    };
    let (bundle, mut all_reused) = checkpoints.once("import", &(), load)?;
    let mut bundle = bundle.with_paths(|path| first.join(path));
    let to_scene = bundle.report.source_to_scene.unwrap_or(SourceToScene::IDENTITY);
    let (mut checkpoints, mut known) = (checkpoints.clone(), None);
    for (part, number) in added.iter().zip(1..) {
        let folder = part_folder(content, number);
        let made_of = format!(";{}", serde_json::to_string(part).map_err(std::io::Error::from)?);
        checkpoints = checkpoints.depending_on(&made_of);
        let cloud = known.as_ref().unwrap_or(&bundle.cloud);
        let load = || {
            may_load()?;
            let (first, looking) =
                (bundle.next_frame(), progress.part(share(number), share(number + 1)));
            let to_scene = part.to_scene.unwrap_or(to_scene);
            let addition = uniground_ingest::add(
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
        let (addition, reused) = checkpoints.once(&format!("import{number}"), &(), load)?;
        all_reused &= reused;
        known = Some(addition.applied_to(cloud));
        bundle.additions.push(addition.with_paths(|path| folder.join(path)));
    }
    Ok((bundle, all_reused))
}

fn cut_with(
    bundle: SceneBundle,
    settings: &ParseSettings,
    models: &Models,
    checkpoints: &Checkpoints,
    progress: &Progress,
) -> Result<ParsedScan, ScanError> {
    let (import, frames) = bundle.in_all();
    let names = names_of(models);
    let parsing = &settings.parsing;
    let rgbd = RgbdMasks { settings: parsing.rgbd_masks };
    // Encoded pictures are kept for correction alone.
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
