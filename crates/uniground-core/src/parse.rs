//! Stage 1 from end to end: an unpacked scan to a [`ParsedScene`], with the models that are at hand.

use crate::ingest::{self, IngestError};
use crate::models::attributes;
use crate::models::neural::{Models, Role};
use crate::progress::Progress;
use crate::scene::{FrameRef, ImportReport, ParsedScene};
use crate::scene_parsing::checkpoints::Checkpoints;
use crate::scene_parsing::correction::Corrector;
use crate::scene_parsing::masks::rgbd::RgbdMasks;
use crate::scene_parsing::masks::sam::{EncodedFrames, SamMasks};
use crate::scene_parsing::masks::{MaskSource, Together};
use crate::scene_parsing::{self, ParseError, Perception, StageOutcome, Stopwatch};
use camino::Utf8Path;
use uniground_types::settings::{ModelChoice, ParseModels, ParseSettings, PartChoice};

/// Raised when stage 1 changes what it computes: older parses are kept, but not taken for new ones.
pub const STAGE_1_VERSION: u32 = 5;

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

const BUILTIN: ModelChoice = ModelChoice { masks: PartChoice::Builtin, encoder: PartChoice::Builtin, allow_builtin: false };

/// Import and stage 1 of an unpacked scan; blocks, and uses the threads of the rayon pool it is called in.
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
    match parse_with(content, settings, &chosen(settings.models, models), checkpoints, progress) {
        Err(ScanError::Parse(ParseError::Model(error))) if settings.models.allow_builtin => {
            let mut scan = parse_with(content, settings, &chosen(BUILTIN, models), checkpoints, progress)?;
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
) -> Result<ParsedScan, ScanError> {
    let mut watch = Stopwatch::default();
    let imported = if models.loaded.is_empty() { 0.25 } else { 0.01 };
    let bundle = watch.time("import", |outcome| {
        // Kept with paths relative to the content, whose folder may lie elsewhere tomorrow.
        let load = || {
            let bundle = ingest::load(&ingest::open(content)?, &settings.import, &progress.part(0.0, imported))?;
            Ok::<_, ScanError>(bundle.with_paths(|path| path.strip_prefix(content).unwrap_or(path).to_owned()))
        };
        let (bundle, reused) = checkpoints.once("import", &(), load)?;
        *outcome = StageOutcome { produced: bundle.cloud.len(), reused };
        Ok::<_, ScanError>(bundle.with_paths(|path| content.join(path)))
    })?;
    let (import, frames) = (bundle.report.clone(), bundle.frames.clone());
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
        .map(|(i, segmenter)| EncodedFrames::new(segmenter.clone(), checkpoints.folder(), if i == 0 { max_bytes } else { 0 }))
        .collect::<Result<Vec<_>, _>>()?;
    let sam: Vec<SamMasks> = encoded
        .iter()
        .map(|frames| SamMasks { frames, settings: parsing.sam_masks, segments: parsing.rgbd_masks, name: names.masks.clone() })
        .collect();
    let together = Together { sources: sam.iter().map(|sam| sam as &dyn MaskSource).collect(), name: names.masks.clone() };
    let perception = Perception {
        masks: if sam.is_empty() { &rgbd } else { &together },
        corrector: encoded
            .first()
            .filter(|_| corrects)
            .map(|frames| Corrector { frames, settings: parsing.correction }),
        encoder: models.encoder.as_deref(),
    };
    let mut scene = scene_parsing::parse(bundle, &perception, parsing, checkpoints, &progress.part(imported, 1.0))?;
    scene.report.stages.splice(0..0, watch.stages);
    Ok(ParsedScan { import, frames, scene, models: names })
}
