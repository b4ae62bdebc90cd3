//! Checks that do not need decoded pictures: sizes from headers, matching intrinsics, rigid poses,
//! complete files.

mod whole;

use super::scan::{Scan, Units, picture_size};
use super::{IngestError, UPLOADED, clouds};
use crate::scan::RawFrame;
use camino::Utf8Path;
use image::{ColorType, ImageDecoder, ImageReader};
use rayon::prelude::*;
use uniground_geometry::MAX_COORDINATE_M;
use uniground_geometry::scene::{
    DepthSensor, FrameIndex, Intrinsics, LEAST_UNIT_OF_BYTES_M, PoseConvention,
};
use uniground_types::findings::{Finding, FindingSubject};

/// Maximum share of damaged frames that are left out. With more, the scan is refused.
const MAX_DAMAGED: f32 = 0.1;

/// Checks a scan. Drops the frames whose pose the tracker marked as lost, and the damaged frames if
/// they are few.
///
/// A lost pose consists of infinities only (as ScanNet writes it). The frame is skipped and
/// counted. Any other non-finite value is damage.
pub(super) fn check(scan: &mut Scan) -> Result<(), IngestError> {
    // Frames keep their index in the scan's own list when others are skipped.
    for (frame, i) in scan.frames.iter_mut().zip(0..) {
        frame.index = FrameIndex(i);
    }
    let before = scan.frames.len();
    scan.frames.retain(|frame| !frame.pose.iter().all(|v| v.is_infinite()));
    let lost = before - scan.frames.len();
    if lost > 0 {
        let text =
            format!("{lost} of {before} frames skipped: their pose is marked as lost (infinite)");
        scan.findings.push(Finding::left_out(FindingSubject::Frames, text).counting(lost));
    }
    if before == 0 && scan.cloud.is_none() {
        return Err(scan.damage.first.drain(..).next().unwrap_or(IngestError::EmptyScene));
    }
    if before > 0 && scan.frames.is_empty() {
        return Err(IngestError::NoUsableFrames {
            reason: format!("all {before} poses are marked as lost (infinite)"),
        });
    }
    if let Some(cloud) = &scan.cloud {
        clouds::check(&scan.root, cloud, &UPLOADED)?;
    }
    if scan.pose == PoseConvention::CameraToWorld {
        scan.origin = origin_of(&scan.frames);
    }
    let units = Units { origin: scan.origin, metres_per_unit: 1.0 };
    let root = &scan.root;
    let checked: Vec<Result<RawFrame, IngestError>> = std::mem::take(&mut scan.frames)
        .into_par_iter()
        .map(|frame| checked(root, frame, scan.pose, &units, scan.depth_scale_m))
        .collect();
    for frame in checked {
        scan.add(frame)?;
    }
    leave_out_damaged(scan)?;
    scan.frames_skipped = (lost + scan.damage.count) as u32;
    Ok(())
}

/// Returns the offset of positions in map coordinates, or zero for other scans.
fn origin_of(frames: &[RawFrame]) -> [f64; 3] {
    let at = |frame: &RawFrame| [0, 1, 2].map(|axis| frame.pose[(axis, 3)]);
    let far = |at: &[f64; 3]| {
        at.iter().all(|c| c.is_finite() && c.abs() < 1e8)
            && at.iter().any(|c| c.abs() > f64::from(MAX_COORDINATE_M))
    };
    // A single outlier pose must not move the origin.
    let mut all: Vec<[f64; 3]> = frames.iter().map(at).filter(far).collect();
    if all.len() * 2 <= frames.len() {
        return [0.0; 3];
    }
    all.sort_by(|a, b| a[0].total_cmp(&b[0]));
    all[all.len() / 2].map(|c| (c / 100.0).round() * 100.0)
}

/// Leaves out damaged frames up to the allowed share, with a warning that names it.
fn leave_out_damaged(scan: &mut Scan) -> Result<(), IngestError> {
    let (damaged, total) = (scan.damage.count, scan.damage.count + scan.frames.len());
    if damaged == 0 {
        return Ok(());
    }
    if damaged as f32 > MAX_DAMAGED * total as f32 {
        let first = scan.damage.first.swap_remove(0);
        // With only a few frames, the error of the single damaged one is the best message.
        return Err(match damaged == 1 || total < 10 {
            true => first,
            false => IngestError::TooManyDamaged { damaged, total, first: Box::new(first) },
        });
    }
    let named: Vec<String> = scan.damage.first.iter().map(ToString::to_string).collect();
    let more = if damaged > named.len() {
        format!(" and {} more", damaged - named.len())
    } else {
        String::new()
    };
    let text = format!(
        "{damaged} of {total} frames skipped, damaged or incomplete: {}{more}",
        named.join("; ")
    );
    scan.findings.push(Finding::left_out(FindingSubject::Frames, text).counting(damaged));
    Ok(())
}

fn checked(
    root: &Utf8Path,
    mut frame: RawFrame,
    pose: PoseConvention,
    units: &Units,
    depth_scale_m: f32,
) -> Result<RawFrame, IngestError> {
    let bad_pose =
        |source| IngestError::BadPose { frame: frame.index, file: frame.pose_file.clone(), source };
    frame.camera_to_world(pose, crate::scan::CameraAxes::Opencv, units).map_err(bad_pose)?;
    if frame
        .pose
        .row(3)
        .iter()
        .zip([0.0, 0.0, 0.0, 1.0])
        .any(|(v, expected)| (v - expected).abs() > 1e-3)
    {
        let last_column = frame.pose.column(3).iter().copied().collect::<Vec<f64>>();
        let reason = match last_column[..] == [0.0, 0.0, 0.0, 1.0] {
            true => "the last column of the pose is 0 0 0 1: write matrices row by row",
            false => "the last row of a pose must be 0 0 0 1",
        };
        return Err(IngestError::malformed(frame.pose_file.clone(), reason));
    }
    let lens_is_odd = [frame.optics.color_lens, frame.optics.depth_lens]
        .iter()
        .flatten()
        .any(|lens| !lens.is_plausible());
    if lens_is_odd {
        return Err(IngestError::BadIntrinsics {
            file: frame.color,
            reason: "its lens distortion is not plausible".into(),
        });
    }
    frame.color_intrinsics = fit(root, &frame.color, frame.color_intrinsics)?;
    whole::check_is_complete(root, &frame.color)?;
    match &mut frame.optics.depth_sensor {
        None => frame.depth_intrinsics = fit(root, &frame.depth, frame.depth_intrinsics)?,
        Some(sensor) => {
            let intrinsics = fit(root, &frame.depth, sensor.intrinsics)?;
            *sensor = DepthSensor { intrinsics, ..*sensor };
            frame.depth_intrinsics = sensor.registered_intrinsics(&frame.color_intrinsics);
        }
    }
    whole::check_is_complete(root, &frame.depth)?;
    check_depth_pixels(root, &frame.depth, depth_scale_m)?;
    if let Some(confidence) = &frame.optics.confidence {
        picture_size(root, &confidence.file)?;
    }
    Ok(frame)
}

/// Refuses a picture whose pixels are not distances, such as a colored one, from its header.
fn check_depth_pixels(
    root: &Utf8Path,
    file: &Utf8Path,
    depth_scale_m: f32,
) -> Result<(), IngestError> {
    // Other readers read floats and other formats, and report what they cannot read.
    let decoder = ImageReader::open(root.join(file))
        .and_then(ImageReader::with_guessed_format)
        .ok()
        .and_then(|reader| reader.into_decoder().ok());
    let found = match decoder.map(|decoder| decoder.color_type()) {
        None | Some(ColorType::L16) => return Ok(()),
        Some(ColorType::L8) if depth_scale_m >= LEAST_UNIT_OF_BYTES_M => return Ok(()),
        Some(ColorType::L8) => "8-bit gray with a smaller unit".into(),
        Some(other) => format!("{other:?}"),
    };
    Err(IngestError::malformed(
        file,
        format!(
            "not a depth picture: it must be 16-bit gray, floats (EXR, TIFF), or 8-bit gray with a `depth_scale_m` of \
             {LEAST_UNIT_OF_BYTES_M} or more; this is {found}"
        ),
    ))
}

/// Returns the intrinsics at the picture's own resolution. A picture of the same aspect ratio can
/// be smaller or larger than the intrinsics say.
fn fit(
    root: &Utf8Path,
    file: &Utf8Path,
    intrinsics: Intrinsics,
) -> Result<Intrinsics, IngestError> {
    let bad = |reason: String| IngestError::BadIntrinsics { file: file.to_owned(), reason };
    let Intrinsics { width, height, fx, fy, cx, cy } = intrinsics;
    if ![fx, fy, cx, cy].iter().all(|v| v.is_finite())
        || fx <= 0.0
        || fy <= 0.0
        || width == 0
        || height == 0
    {
        return Err(bad(format!("fx {fx}, fy {fy}, cx {cx}, cy {cy} at {width}x{height}")));
    }
    let widest = width.max(height) as f32;
    if ![fx, fy].iter().all(|f| (widest * SHORTEST_FOCAL..=widest * LONGEST_FOCAL).contains(f)) {
        return Err(bad(format!(
            "a focal length of {fx} x {fy} pixels is not plausible at {width}x{height}"
        )));
    }
    if !(0.0..=width as f32).contains(&cx) || !(0.0..=height as f32).contains(&cy) {
        return Err(bad(format!(
            "the principal point ({cx}, {cy}) lies outside {width}x{height}: check the order of the numbers, and scale intrinsics that are for another picture size"
        )));
    }
    let Some((found_width, found_height)) = picture_size(root, file)? else {
        return Ok(intrinsics);
    };
    if (found_width, found_height) == (width, height) {
        return Ok(intrinsics);
    }
    let is_turned =
        u64::from(height) * u64::from(found_height) == u64::from(width) * u64::from(found_width);
    if is_turned && width != height {
        return Err(bad(format!(
            "the picture is {found_width}x{found_height}, the intrinsics are for {width}x{height}: color pictures, depth pictures or intrinsics are rotated by 90 degrees; rotate them alike (the orientation that a photograph states is not used)"
        )));
    }
    let stretch = (found_width as f32 / width as f32) / (found_height as f32 / height as f32);
    if (stretch - 1.0).abs() > SHAPE_TOLERANCE {
        return Err(bad(format!(
            "the picture is {found_width}x{found_height}, the intrinsics are for {width}x{height}"
        )));
    }
    Ok(intrinsics.scaled_to(found_width, found_height))
}

/// Focal lengths of real cameras, in picture widths: from a 168 degree fisheye to a telephoto lens.
const SHORTEST_FOCAL: f32 = 0.05;
const LONGEST_FOCAL: f32 = 50.0;
/// Maximum relative difference of aspect ratios that still counts as the same camera at another
/// resolution.
const SHAPE_TOLERANCE: f32 = 0.02;
