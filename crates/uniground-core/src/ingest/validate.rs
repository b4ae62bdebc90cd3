//! Checks that need no decoded picture: sizes from headers, intrinsics that fit, poses that are rigid.

use super::scan::{Scan, picture_size};
use super::{IngestError, MAX_POINTS, clouds};
use crate::geometry::pose;
use crate::scene::{FrameIndex, Intrinsics};
use camino::Utf8Path;
use std::fs::File;
use std::io::{Read, Seek, SeekFrom};

/// Checks a scan and drops the frames whose pose the tracker itself marked as lost.
///
/// A pose of infinities only is that mark (ScanNet writes it): the frame is skipped and counted. Any other value that is
/// not finite is damage and refused.
pub(super) fn check(scan: &mut Scan) -> Result<(), IngestError> {
    // Frames keep their place in the scan's own list when others are skipped.
    for (frame, i) in scan.frames.iter_mut().zip(0..) {
        frame.index = FrameIndex(i);
    }
    let before = scan.frames.len();
    scan.frames.retain(|frame| !frame.pose.iter().all(|v| v.is_infinite()));
    let skipped = before - scan.frames.len();
    scan.frames_skipped = skipped as u32;
    if skipped > 0 {
        scan.warnings
            .push(format!("{skipped} of {before} frames skipped: their pose is marked as lost (infinite)"));
    }
    if before == 0 && scan.cloud.is_none() {
        return Err(IngestError::EmptyScene);
    }
    if before > 0 && scan.frames.is_empty() {
        return Err(IngestError::NoUsableFrames { reason: format!("all {before} poses are marked as lost (infinite)") });
    }
    if let Some(cloud) = &scan.cloud {
        clouds::ply::check(&scan.root, cloud, MAX_POINTS)?;
    }
    for frame in &mut scan.frames {
        let bad_pose = |source| IngestError::BadPose { frame: frame.index, file: frame.pose_file.clone(), source };
        pose::rigid(&frame.pose).map_err(bad_pose)?;
        if frame.pose.row(3).iter().zip([0.0, 0.0, 0.0, 1.0]).any(|(v, expected)| (v - expected).abs() > 1e-3) {
            return Err(IngestError::malformed(frame.pose_file.clone(), "the last row of a pose must be 0 0 0 1"));
        }
        frame.colour_intrinsics = fit(&scan.root, &frame.colour, frame.colour_intrinsics)?;
        refuse_truncated_jpeg(&scan.root, &frame.colour)?;
        frame.depth_intrinsics = fit(&scan.root, &frame.depth, frame.depth_intrinsics)?;
    }
    Ok(())
}

/// The intrinsics at the picture's own resolution. A picture of the same shape may be smaller or larger than they say.
fn fit(root: &Utf8Path, file: &Utf8Path, intrinsics: Intrinsics) -> Result<Intrinsics, IngestError> {
    let bad = |reason: String| IngestError::BadIntrinsics { file: file.to_owned(), reason };
    let Intrinsics { width, height, fx, fy, cx, cy } = intrinsics;
    if ![fx, fy, cx, cy].iter().all(|v| v.is_finite()) || fx <= 0.0 || fy <= 0.0 || width == 0 || height == 0 {
        return Err(bad(format!("fx {fx}, fy {fy}, cx {cx}, cy {cy} at {width}x{height}")));
    }
    let widest = width.max(height) as f32;
    if ![fx, fy].iter().all(|f| (widest * SHORTEST_FOCAL..=widest * LONGEST_FOCAL).contains(f)) {
        return Err(bad(format!("a focal length of {fx} x {fy} pixels makes no camera of {width}x{height}")));
    }
    if !(0.0..=width as f32).contains(&cx) || !(0.0..=height as f32).contains(&cy) {
        return Err(bad(format!("the principal point ({cx}, {cy}) lies outside {width}x{height}")));
    }
    let (found_width, found_height) = picture_size(root, file)?;
    if (found_width, found_height) == (width, height) {
        return Ok(intrinsics);
    }
    let stretch = (found_width as f32 / width as f32) / (found_height as f32 / height as f32);
    if (stretch - 1.0).abs() > SHAPE_TOLERANCE {
        return Err(bad(format!("the picture is {found_width}x{found_height}, the intrinsics are for {width}x{height}")));
    }
    Ok(intrinsics.scaled_to(found_width, found_height))
}

/// Focal lengths of real cameras, in picture widths: from a 168 degree fisheye to a telescope.
const SHORTEST_FOCAL: f32 = 0.05;
const LONGEST_FOCAL: f32 = 50.0;
/// Relative difference of aspect ratios that still counts as the same camera read out at another size.
const SHAPE_TOLERANCE: f32 = 0.02;

/// A JPEG that was cut short still decodes, with grey where the rest was: look for its end mark.
fn refuse_truncated_jpeg(root: &Utf8Path, file: &Utf8Path) -> Result<(), IngestError> {
    const TAIL: u64 = 4096;
    if !file.extension().is_some_and(|e| e.eq_ignore_ascii_case("jpg") || e.eq_ignore_ascii_case("jpeg")) {
        return Ok(());
    }
    let read_tail = || {
        let mut picture = File::open(root.join(file))?;
        let length = picture.metadata()?.len();
        picture.seek(SeekFrom::Start(length.saturating_sub(TAIL)))?;
        let mut tail = Vec::new();
        picture.read_to_end(&mut tail)?;
        Ok(tail)
    };
    let tail = read_tail().map_err(|source| IngestError::reading(file, source))?;
    match tail.windows(2).any(|pair| pair == [0xff, 0xd9]) {
        true => Ok(()),
        false => Err(IngestError::malformed(file, "the JPEG is cut short: it has no end mark")),
    }
}
