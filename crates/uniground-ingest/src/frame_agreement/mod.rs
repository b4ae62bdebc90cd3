//! Compares frames with each other and with the scan's own cloud.
//!
//! A wrong pose or depth puts a frame's surfaces into space that other frames saw to be free, and
//! the other way around. Surfaces behind others tell nothing: they are hidden. So the measure does
//! not depend on how much frames hide of each other. Where frames see the same surface, its colors
//! must be alike.

mod agreement;
mod cloud;
mod colors;
mod groups;
mod outliers;
mod pictures;
mod shared_errors;
mod sketch;

use super::IngestError;
use super::clouds::LoadedCloud;
use super::reprojection::{CONSTANT_SHARE, most_frequent};
use super::scan::Scan;
use agreement::Comparison;
use cloud::CloudSample;
use outliers::{median_agreement, remove_outliers};
use rayon::prelude::*;
use shared_errors::RoughFit;
use sketch::FrameSketch;
use uniground_geometry::scene::FrameRef;
use uniground_types::findings::{Finding, FindingSubject};

/// Maximum number of frames whose depth is compared, and whose color pictures are.
const MAX_FRAMES: usize = 150;
const MAX_COLOR_FRAMES: usize = 60;
/// A frame whose agreement is this much below the median contradicts the others. Frames of correct
/// scans agree by 0.91 to 1; a frame that is half a meter off, by 0.4 to 0.7.
const BELOW_MEDIAN: f32 = 0.08;
/// If half of the frames agree by less than this, many of them are wrong.
const MANY_WRONG: f32 = 0.88;
/// Share of the measured pixels from which a value that is far from all others marks no
/// measurement.
const MARKER_SHARE: f32 = 0.01;
/// Maximum number of frames that are named.
const MAX_NAMED: usize = 5;

/// Compares frames with each other and with the scan's own cloud (in the world of the frames). Adds
/// findings for frames and clouds that contradict the others, for errors that all frames share, and
/// for pictures without content.
///
/// # Errors
/// Returns [`IngestError::NoUsableFrames`] if no depth picture has a measurement.
pub(super) fn check(
    scan: &Scan,
    frames: &[FrameRef],
    own_cloud: Option<&LoadedCloud>,
    findings: &mut Vec<Finding>,
) -> Result<(), IngestError> {
    let mut sketches = draw(frames);
    check_measurements(scan, &sketches, findings)?;
    take_out_constant(&mut sketches, findings);
    let in_color = |used: &[bool]| -> Vec<&FrameSketch> {
        let is_used = |i: &usize| used[*i] && !sketches[*i].tones.is_empty();
        (0..sketches.len()).filter(is_used).map(|i| &sketches[i]).collect()
    };
    let mut used = vec![true; sketches.len()];
    pictures::check(scan, &in_color(&used), findings);
    let cloud = own_cloud.map(CloudSample::new);
    let comparison = Comparison::new(&sketches, cloud.as_ref());
    let (of_cloud, of_frames) = comparison.totals();
    let cloud_fits = cloud::check_fit(&of_cloud, &of_frames, findings);
    let everyone: Vec<&FrameSketch> = sketches.iter().collect();
    let rough = RoughFit::of(&everyone);
    groups::check(&comparison, scan, &sketches, rough.is_some(), findings);
    let agreement = |i: usize, used: &[bool]| comparison.share(i, used);
    let Some(middle) = median_agreement(&used, agreement) else { return Ok(()) };
    if middle < MANY_WRONG {
        let text = format!(
            "frames contradict each other: in half of them, {:.0}% or more of the compared points lie where another frame sees through (correct scans: less than 10%); {}",
            (1.0 - middle) * 100.0,
            rough.and_then(|rough| rough.cause).unwrap_or_else(|| {
                "poses or depth of some frames are wrong, the poses drift, or the intrinsics are wrong".into()
            })
        );
        findings.push(Finding::unusual(FindingSubject::Poses, text));
        return Ok(());
    }
    let wrong =
        remove_outliers(&mut used, agreement, |lowest, middle| lowest < middle - BELOW_MEDIAN);
    if !wrong.is_empty() {
        let at: Vec<usize> = wrong.iter().map(|&i| sketches[i].at).collect();
        let text = format!(
            "at least {} of {} compared frames contradict the others: their pose, depth or intrinsics are wrong, or something moved: {}",
            wrong.len(),
            sketches.len(),
            name_frames(scan, &at)
        );
        findings.push(Finding::unusual(FindingSubject::Poses, text).counting(wrong.len()));
    }
    let pictures = in_color(&used);
    match rough {
        // Which surface a picture shows is then uncertain.
        Some(rough) => findings.push(rough.as_finding()),
        None => colors::check(scan, &pictures, pictures.len() == frames.len(), findings),
    }
    if let (Some(own), Some(cloud)) = (own_cloud, &cloud)
        && cloud_fits
    {
        cloud::check_extent(&own.cloud.positions, &sketches, findings);
        cloud.check_colors(&pictures, findings);
    }
    Ok(())
}

/// Decodes frames spread over the scan. Unreadable pictures are reported by another check.
fn draw(frames: &[FrameRef]) -> Vec<FrameSketch> {
    // Not every n-th frame: mistakes can be periodic.
    let count = frames.len().min(MAX_FRAMES);
    let in_color = count.min(MAX_COLOR_FRAMES);
    let has_color = |i: usize| (i * in_color).checked_rem(count).is_some_and(|r| r < in_color);
    let one = |i: usize| {
        let at = i * frames.len() / count;
        let frame = &frames[at];
        let mut sketch = FrameSketch::new(at, frame, &frame.decode_depth().ok()?);
        if has_color(i)
            && let Ok(picture) = frame.decode_color()
        {
            sketch.add_colors(&picture, &frame.color_intrinsics);
        }
        Some(sketch)
    };
    (0..count).into_par_iter().filter_map(one).collect()
}

/// Reports depth pictures without a measurement.
fn check_measurements(
    scan: &Scan,
    sketches: &[FrameSketch],
    findings: &mut Vec<Finding>,
) -> Result<(), IngestError> {
    let is_empty = |sketch: &&FrameSketch| sketch.points.is_empty();
    let empty: Vec<usize> = sketches.iter().filter(is_empty).map(|sketch| sketch.at).collect();
    let Some(first) = empty.first() else { return Ok(()) };
    let with_confidence = match &scan.frames[*first].optics.confidence {
        Some(confidence) => format!(" above the confidence level {}", confidence.at_least),
        None => String::new(),
    };
    if empty.len() == sketches.len() && scan.cloud.is_none() {
        let reason = format!("the depth pictures have no measurement{with_confidence}");
        return Err(IngestError::NoUsableFrames { reason });
    }
    let text = format!(
        "{} of {} examined depth pictures have no measurement{with_confidence}: {}",
        empty.len(),
        sketches.len(),
        name_frames(scan, &empty)
    );
    findings.push(Finding::unusual(FindingSubject::Frames, text).counting(empty.len()));
    Ok(())
}

/// Reports a value that fills much of many depth pictures, or that lies far from all others, and
/// takes it out: it would agree with itself wherever the cameras are.
fn take_out_constant(sketches: &mut [FrameSketch], findings: &mut Vec<Finding>) {
    let constant_of = |sketch: &FrameSketch| {
        let (value_m, share) = most_frequent(&sketch.depth_m)?;
        let stands_out = share >= CONSTANT_SHARE
            || share >= MARKER_SHARE && is_isolated(value_m, &sketch.depth_m);
        stands_out.then_some((value_m, share))
    };
    let mut found: Vec<(f32, f32)> = sketches.iter().filter_map(constant_of).collect();
    found.sort_by(|a, b| a.0.total_cmp(&b.0).then(a.1.total_cmp(&b.1)));
    let Some((value_m, _)) = found.get(found.len() / 2).copied() else { return };
    found.retain(|(other_m, share)| *share >= CONSTANT_SHARE || *other_m == value_m);
    if found.len() * 4 < sketches.len() {
        return;
    }
    let text = format!(
        "in {} of {} examined depth pictures, one value ({value_m:.3} m) fills up to {:.0}% of the measured pixels: depth seems to be cut off there, or this marks no measurement; write 0 where nothing was measured",
        found.len(),
        sketches.len(),
        found.iter().map(|(_, share)| *share).fold(0.0, f32::max) * 100.0
    );
    findings.push(Finding::unusual(FindingSubject::Frames, text).counting(found.len()));
    for sketch in sketches {
        if let Some((constant_m, share)) = constant_of(sketch)
            && (share >= CONSTANT_SHARE || constant_m == value_m)
        {
            sketch.remove_depth(constant_m);
        }
    }
}

/// Returns whether hardly any other depth is near a value.
fn is_isolated(value_m: f32, depth_m: &[f32]) -> bool {
    let near = |z: &&f32| (0.8 * value_m..1.25 * value_m).contains(*z);
    let equal = depth_m.iter().filter(|z| **z == value_m).count();
    depth_m.iter().filter(near).count() <= equal + equal / 10
}

/// Returns the color pictures of the first few frames.
fn name_frames(scan: &Scan, frames: &[usize]) -> String {
    let named = frames.iter().take(MAX_NAMED).map(|&at| scan.frames[at].color.as_str());
    let named = named.collect::<Vec<_>>().join(", ");
    match frames.len().saturating_sub(MAX_NAMED) {
        0 => named,
        more => format!("{named} and {more} more"),
    }
}
