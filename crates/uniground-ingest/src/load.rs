//! Turns a checked [`Scan`] into a canonical [`SceneBundle`].

use super::cloud_doubts::{self, Core};
use super::levelling::{self, UpDirection, UpHint};
use super::reprojection::{self, CheckedConvention, SourceConvention};
use super::scan::{RawFrame, Scan, Units};
use super::{IngestError, UPLOADED, clouds, frame_agreement, fusion, guess_units};
use camino::Utf8Path;
use clouds::{CloudBounds, CoordinateOrigin, LoadedCloud};
use uniground_geometry::progress::Progress;
use uniground_geometry::scene::{
    FrameRef, ImportReport, PointCloud, SceneBundle, SourceToScene, viewing_distance_m,
};
use uniground_geometry::{Isometry3, Point3, pose};
use uniground_types::findings::{Finding, FindingSubject};
use uniground_types::settings::ImportSettings;

/// A scan in canonical form. A cloud that has to be fused is still missing.
#[derive(Debug)]
pub struct InspectedScan {
    /// Frames in the scan's order, Z up, meters.
    pub frames: Vec<FrameRef>,
    /// The scan's own cloud.
    pub cloud: Option<PointCloud>,
    /// The results of the checks.
    pub report: ImportReport,
}

/// Reads or fuses the cloud, checks that cloud, poses and depth agree, and rotates everything level
/// with Z up.
///
/// # Errors
/// Returns the errors of [`inspect`], and errors for frames without depth or for too many frames
/// that cannot be decoded.
pub fn load(
    scan: &Scan,
    settings: &ImportSettings,
    progress: &Progress,
) -> Result<SceneBundle, IngestError> {
    let InspectedScan { mut frames, cloud, mut report } =
        inspect(scan, settings, &progress.sub_range(0.0, 0.2))?;
    let cloud = if let Some(cloud) = cloud {
        cloud
    } else {
        let mut findings = Vec::new();
        let cloud = fusion::fuse(
            &mut frames,
            &settings.fusion.in_detail(report.detail()),
            &mut findings,
            &progress.sub_range(0.2, 1.0),
        )?;
        warn_of_odd_size(&cloud.positions, &mut findings);
        report.add_findings(findings);
        report.count_undecodable(report.frames as usize - frames.len());
        cloud
    };
    Ok(SceneBundle { cloud, frames, report, additions: Vec::new() })
}

/// Does what [`inspect`] does, and decodes all pictures, so that damaged ones are found that
/// [`load`] would stop at or leave out.
///
/// # Errors
/// Returns the errors of [`inspect`], and an error for too many pictures that cannot be decoded.
pub fn check(
    scan: &Scan,
    settings: &ImportSettings,
    progress: &Progress,
) -> Result<InspectedScan, IngestError> {
    let mut inspected = inspect(scan, settings, &progress.sub_range(0.0, 0.3))?;
    let InspectedScan { frames, report, .. } = &mut inspected;
    let (before, mut findings) = (frames.len(), Vec::new());
    fusion::check_pictures(frames, &mut findings, &progress.sub_range(0.3, 1.0))?;
    report.add_findings(findings);
    report.count_undecodable(before - frames.len());
    Ok(inspected)
}

/// Does everything except fusing a cloud: reads the scan's own cloud, chooses the interpretation of
/// poses and depth that fits a sample of frames, and rotates everything level with Z up.
///
/// # Errors
/// Returns [`IngestError`]: [`IngestError::NothingFits`] when poses and depth do not agree under
/// any interpretation, [`IngestError::ConventionUnclear`] when two do, [`IngestError::UnitUnknown`]
/// and [`IngestError::UpUnknown`] for a cloud whose unit or up direction cannot be determined.
pub fn inspect(
    scan: &Scan,
    settings: &ImportSettings,
    progress: &Progress,
) -> Result<InspectedScan, IngestError> {
    progress.report("import", 0.0)?;
    let mut findings = scan.findings.clone();
    let mut own_cloud =
        scan.cloud.as_ref().map(|file| read_own_cloud(scan, file, &mut findings)).transpose()?;
    let declared = SourceConvention {
        pose: scan.pose,
        axes: scan.camera_axes,
        depth_scale_m: scan.depth_scale_m,
        metres_per_unit: resolve_meters_per_unit(
            scan,
            settings,
            own_cloud.as_ref(),
            &mut findings,
        )?,
    };
    if let Some(own) = &mut own_cloud {
        rescale(&mut own.cloud, declared.metres_per_unit);
    }
    progress.report("check_reprojection", 0.5)?;
    let frames = frame_refs(scan, &declared)?;
    let CheckedConvention { reading, agreement } = reprojection::check(
        scan,
        declared,
        own_cloud.as_ref().map(|own| &own.cloud),
        &frames,
        &mut findings,
    )?;
    let mut frames = if reading == declared { frames } else { frame_refs(scan, &reading)? };
    if let Some(own) = &mut own_cloud {
        rescale(&mut own.cloud, reading.metres_per_unit / declared.metres_per_unit);
    }

    frame_agreement::check(scan, &frames, own_cloud.as_ref(), &mut findings)?;

    let of_format =
        own_cloud.as_ref().filter(|_| frames.is_empty()).and_then(|own| own.kind.up_axis());
    let said = UpHint {
        up: settings.up.or(scan.up).or(of_format),
        by_format: settings.up.or(scan.up).is_none(),
        // An axis given in the request takes precedence over the inertial sensor.
        by_gravity: scan.by_gravity && settings.up.is_none(),
        choice: settings.levelling,
    };
    let upright = match &own_cloud {
        Some(own) if frames.is_empty() => {
            levelling::find_up_of_cloud(&own.cloud, said, &mut findings)?
        }
        _ => levelling::find_up_of_frames(
            &frames,
            said,
            &mut findings,
            &progress.sub_range(0.5, 1.0),
        )?,
    };
    let to_scene = ToScene::new(scan, &upright, own_cloud.as_ref(), reading.metres_per_unit)?;
    for frame in &mut frames {
        frame.camera_to_world = to_scene.turn * frame.camera_to_world;
    }
    let cloud = own_cloud.map(|own| own.cloud).map(|mut cloud| {
        cloud.positions.iter_mut().for_each(|p| *p = to_scene.turn * *p);
        cloud
    });
    if let Some(cloud) = &cloud {
        warn_of_odd_size(&cloud.positions, &mut findings);
    }
    let mut report = ImportReport {
        format: scan.format.into(),
        up: upright.axis,
        source_to_scene: Some(to_scene.source),
        levelling: upright.report,
        pose: reading.pose,
        camera_axes: reading.axes.as_str().into(),
        frames: frames.len() as u32,
        frames_skipped: scan.frames_skipped,
        cloud_points: cloud.as_ref().map(|cloud| cloud.len() as u64),
        reprojection_agreement: agreement,
        viewing_distance_m: viewing_distance_m(&frames),
        warnings: Vec::new(),
        findings: Vec::new(),
    };
    if let (Some(distance), detail) = (report.viewing_distance_m, report.detail())
        && detail > 1.0
    {
        let text = format!(
            "the frames show things from {distance:.1} m away: segmented {detail} times as fine as \
             a room"
        );
        findings.push(Finding::assumed(FindingSubject::Frames, text).without_warning());
    }
    report.add_findings(findings);
    Ok(InspectedScan { frames, cloud, report })
}

/// Reads a cloud that this service wrote. It is canonical already.
///
/// # Errors
/// Returns an [`IngestError`] that names the file.
pub fn read_cloud(file: &Utf8Path) -> Result<PointCloud, IngestError> {
    let (root, name) =
        (file.parent().unwrap_or(file), Utf8Path::new(file.file_name().unwrap_or_default()));
    Ok(clouds::read(root, name, &CloudBounds::OWN, CoordinateOrigin::At([0.0; 3]))?.cloud)
}

/// Reads the scan's own cloud, in the files' units, with the scan's origin subtracted.
fn read_own_cloud(
    scan: &Scan,
    file: &Utf8Path,
    findings: &mut Vec<Finding>,
) -> Result<LoadedCloud, IngestError> {
    let origin = if scan.frames.is_empty() {
        CoordinateOrigin::Free
    } else {
        CoordinateOrigin::At(scan.origin)
    };
    let loaded = clouds::read(&scan.root, file, &UPLOADED, origin)?;
    let LoadedCloud { dropped, without_color, has_color, thinned, .. } = loaded;
    let mut add = |finding: Finding| {
        let text = format!("{file}: {}", finding.text);
        findings.push(Finding { text, ..finding.in_file(file.as_str()) });
    };
    loaded.findings.iter().cloned().for_each(&mut add);
    if without_color > 0 {
        let text = format!("the colors of {without_color} points are not numbers: shown as gray");
        add(Finding::unusual(FindingSubject::Color, text).counting(without_color));
    }
    if dropped > 0 {
        let text = format!("{dropped} points dropped, their coordinates are not finite");
        add(Finding::left_out(FindingSubject::Cloud, text).counting(dropped));
    }
    if !has_color {
        let text = "no color; points are shown gray and questions about colors cannot be answered";
        add(Finding::unusual(FindingSubject::Color, text));
    }
    cloud_doubts::find(&loaded).into_iter().for_each(&mut add);
    if thinned > 1 {
        let text = format!("downsampled, one of {thinned} points is kept");
        add(Finding::changed(FindingSubject::Cloud, text));
    }
    if loaded.offset != [0.0; 3] && scan.frames.is_empty() {
        let [x, y, z] = loaded.offset;
        let text =
            format!("in map coordinates; {x} {y} {z} was subtracted, see import.source_to_scene");
        add(Finding::changed(FindingSubject::Cloud, text));
    }
    Ok(loaded)
}

/// Returns the length of the files' unit: as requested, or guessed for a cloud that would be far
/// too large.
fn resolve_meters_per_unit(
    scan: &Scan,
    settings: &ImportSettings,
    own: Option<&LoadedCloud>,
    findings: &mut Vec<Finding>,
) -> Result<f64, IngestError> {
    if let Some(asked) = settings.metres_per_unit {
        return match asked.is_finite() && (1e-6..=1e6).contains(&asked) {
            true => Ok(asked),
            false => Err(IngestError::malformed(
                "metres_per_unit",
                format!("{asked} is not between 1e-6 and 1e6"),
            )),
        };
    }
    if !scan.has_scale {
        let missing = "it has no scale: set metres_per_unit to the length of its unit".into();
        return Err(IngestError::IncompleteLayout {
            looks_like: "a COLMAP reconstruction",
            missing,
        });
    }
    match (&scan.cloud, own.filter(|own| scan.frames.is_empty() && !own.kind.is_metric())) {
        (Some(file), Some(own)) => {
            guess_units::guess_meters_per_unit(file, &own.cloud.positions, findings)
        }
        _ => Ok(1.0),
    }
}

fn rescale(cloud: &mut PointCloud, by: f64) {
    if by != 1.0 {
        cloud.positions.iter_mut().for_each(|p| p.coords *= by as f32);
    }
}

pub(super) fn frame_refs(
    scan: &Scan,
    reading: &SourceConvention,
) -> Result<Vec<FrameRef>, IngestError> {
    let units = Units { origin: scan.origin, metres_per_unit: reading.metres_per_unit };
    scan.frames.iter().map(|frame| frame_ref(scan, frame, reading, &units)).collect()
}

/// Builds a frame with its pose in the chosen convention, still in the file's world.
fn frame_ref(
    scan: &Scan,
    raw: &RawFrame,
    reading: &SourceConvention,
    units: &Units,
) -> Result<FrameRef, IngestError> {
    let camera_to_world =
        raw.camera_to_world(reading.pose, reading.axes, units).map_err(|source| {
            IngestError::BadPose { frame: raw.index, file: raw.pose_file.clone(), source }
        })?;
    let mut optics = raw.optics.clone();
    if let Some(confidence) = &mut optics.confidence {
        confidence.file = scan.root.join(&confidence.file);
    }
    Ok(FrameRef {
        index: raw.index,
        time_s: raw.time_s,
        color: scan.root.join(&raw.color),
        depth: scan.root.join(&raw.depth),
        color_intrinsics: raw.color_intrinsics,
        depth_intrinsics: raw.depth_intrinsics,
        depth_scale_m: reading.depth_scale_m,
        camera_to_world,
        optics,
    })
}

/// The transform from the files to the scene.
struct ToScene {
    /// Transform from meters near the origin, in the files' axes, to the scene.
    turn: Isometry3<f32>,
    /// The same transform from the files' own coordinates, exact.
    source: SourceToScene,
}

impl ToScene {
    fn new(
        scan: &Scan,
        upright: &UpDirection,
        own: Option<&LoadedCloud>,
        metres_per_unit: f64,
    ) -> Result<Self, IngestError> {
        let mut turn = upright.turn;
        if let Some(alignment) = &scan.alignment {
            let bad = |source| IngestError::malformed("axisAlignment", source);
            turn *= pose::rigid(&alignment.cast()).map_err(bad)?;
        }
        let offset = own.filter(|_| scan.frames.is_empty()).map_or(scan.origin, |own| own.offset);
        let exact =
            |v: f32| if (v - v.round()).abs() < 1e-6 { f64::from(v.round()) } else { f64::from(v) };
        let matrix = turn.rotation.to_rotation_matrix();
        let rotation: [[f64; 3]; 3] =
            std::array::from_fn(|row| std::array::from_fn(|column| exact(matrix[(row, column)])));
        let translation_m = std::array::from_fn(|row| {
            f64::from(turn.translation.vector[row])
                - (0..3).map(|i| rotation[row][i] * offset[i] * metres_per_unit).sum::<f64>()
        });
        Ok(Self { turn, source: SourceToScene { rotation, translation_m, metres_per_unit } })
    }
}

fn warn_of_odd_size(positions: &[Point3<f32>], findings: &mut Vec<Finding>) {
    let across = Core::of(positions).longest();
    let size = match across {
        a if a < 1.0 => format!("only {a:.3}"),
        a if a > 200.0 => format!("{a:.0}"),
        _ => return,
    };
    let text =
        format!("the scene is {size} m across: set metres_per_unit if its lengths are not meters");
    findings.push(Finding::unusual(FindingSubject::Units, text).stated_with("metres_per_unit"));
}
