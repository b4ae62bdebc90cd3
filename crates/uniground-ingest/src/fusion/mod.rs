//! Fuses a cloud from posed depth, for scans without a cloud of their own. Measurements are
//! averaged along the view into a truncated signed distance volume (Curless and Levoy 1996), whose
//! zero crossings are the points. The noise of a depth sensor lies along the view, so a wall
//! becomes one thin sheet. Averaging the points themselves would leave a layer of some centimeters.

mod frame;
mod volume;

use super::IngestError;
use frame::FusionFrame;
use uniground_geometry::progress::Progress;
use uniground_geometry::scene::{FrameError, FrameIndex, FrameRef, PointCloud, stream_frames};
use uniground_types::findings::{Finding, FindingSubject};
use uniground_types::settings::FusionSettings;
use volume::{Volume, VolumeFull};

/// Factor by which voxels grow until a scan that is too large fits.
const COARSER: f32 = 1.5;

/// Fuses all frames, Z-up world, meters. Frames are integrated one by one in order, so the result
/// does not depend on the number of threads. One frame per thread and the volume (at most 2 GB) are
/// in memory. The few frames that cannot be decoded are removed from `frames`, with a warning.
///
/// # Errors
/// Returns an [`IngestError`] for unreadable frames, cancellation, or frames without any depth.
pub fn fuse(
    frames: &mut Vec<FrameRef>,
    settings: &FusionSettings,
    findings: &mut Vec<Finding>,
    progress: &Progress,
) -> Result<PointCloud, IngestError> {
    let mut settings = *settings;
    loop {
        let mut damaged = Vec::new();
        if let Some(cloud) =
            try_fuse(frames, &settings, volume::MAX_BLOCKS, &mut damaged, progress)?
        {
            remove_damaged(frames, damaged, findings)?;
            return match cloud.is_empty() {
                true => Err(IngestError::NoUsableFrames {
                    reason: "no depth measurement is confirmed by another picture".into(),
                }),
                false => Ok(cloud),
            };
        }
        settings.voxel_m *= COARSER;
        let text =
            format!("the scan is large: fused with voxels of {:.0} mm", settings.voxel_m * 1e3);
        findings.push(Finding::changed(FindingSubject::Cloud, text));
    }
}

/// Fuses the frames. Returns `None` when the scan does not fit into `most_blocks` blocks.
fn try_fuse(
    frames: &[FrameRef],
    settings: &FusionSettings,
    most_blocks: usize,
    damaged: &mut Vec<(FrameIndex, FrameError)>,
    progress: &Progress,
) -> Result<Option<PointCloud>, IngestError> {
    let mut volume = Volume::new(settings, most_blocks);
    let mut full = false;
    stream_frames(
        frames,
        |frame| {
            Ok::<_, IngestError>(frame.decode().map(|frame| FusionFrame::new(&frame, settings)))
        },
        |i, look| {
            progress.report("fuse_cloud", i as f32 / frames.len() as f32)?;
            match look {
                Ok(look) if !full => full = volume.integrate(&look) == Err(VolumeFull),
                Ok(_) => {}
                Err(error) => damaged.push((frames[i].index, error)),
            }
            Ok(())
        },
    )?;
    Ok((!full).then(|| volume.extract_surface()))
}

/// Decodes all pictures, and removes the few frames that cannot be decoded from `frames`, with a
/// warning, as [`fuse`] does.
///
/// # Errors
/// Returns an [`IngestError`] if more than a tenth of the frames cannot be decoded, and
/// cancellation.
pub fn check_pictures(
    frames: &mut Vec<FrameRef>,
    findings: &mut Vec<Finding>,
    progress: &Progress,
) -> Result<(), IngestError> {
    let mut damaged = Vec::new();
    stream_frames(
        frames,
        |frame| Ok::<_, IngestError>(frame.decode().map(drop)),
        |i, decoded| {
            progress.report("check_pictures", i as f32 / frames.len() as f32)?;
            damaged.extend(decoded.err().map(|error| (frames[i].index, error)));
            Ok(())
        },
    )?;
    remove_damaged(frames, damaged, findings)
}

/// Removes damaged frames. At most a tenth may be damaged; the first few are named.
fn remove_damaged(
    frames: &mut Vec<FrameRef>,
    damaged: Vec<(FrameIndex, FrameError)>,
    findings: &mut Vec<Finding>,
) -> Result<(), IngestError> {
    const MAX_NAMED: usize = 5;
    let (count, total) = (damaged.len(), frames.len());
    if count * 10 > total {
        return Err(damaged
            .into_iter()
            .next()
            .map_or(IngestError::EmptyScene, |(_, error)| error.into()));
    }
    if count > 0 {
        let named: Vec<String> =
            damaged.iter().take(MAX_NAMED).map(|(_, error)| error.to_string()).collect();
        let text = format!(
            "{count} of {total} frames skipped, they cannot be decoded: {}",
            named.join("; ")
        );
        findings.push(Finding::left_out(FindingSubject::Frames, text).counting(count));
        frames.retain(|frame| damaged.iter().all(|(index, _)| *index != frame.index));
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;
    use camino::Utf8Path;
    use image::{ImageBuffer, Luma, RgbImage};
    use nalgebra::{Translation3, UnitQuaternion, Vector3};
    use uniground_geometry::Isometry3;
    use uniground_geometry::scene::Intrinsics;

    const SIZE: u32 = 64;

    /// Creates a frame that looks along +Y from this position. Its depth has uniform noise of up to
    /// `noise_mm` in both directions.
    fn frame(
        folder: &Utf8Path,
        index: u32,
        at: Vector3<f32>,
        noise_mm: u32,
        depth_mm: impl Fn(u32, u32) -> u32,
    ) -> FrameRef {
        let (color, depth) =
            (folder.join(format!("{index}.png")), folder.join(format!("{index}-depth.png")));
        RgbImage::from_pixel(SIZE, SIZE, image::Rgb([10, 200, 30])).save(&color).unwrap();
        let shake = |u: u32, v: u32| {
            let mixed = (u * 7919 + v * 104_729 + index * 31_337).wrapping_mul(2_654_435);
            mixed % (2 * noise_mm + 1)
        };
        let picture = ImageBuffer::<Luma<u16>, _>::from_fn(SIZE, SIZE, |u, v| {
            Luma([(depth_mm(u, v) + shake(u, v) - noise_mm) as u16])
        });
        picture.save(&depth).unwrap();
        let intrinsics =
            Intrinsics { width: SIZE, height: SIZE, fx: 64.0, fy: 64.0, cx: 31.5, cy: 31.5 };
        // Camera z to world y, camera y down.
        let turn =
            UnitQuaternion::from_axis_angle(&Vector3::x_axis(), -std::f32::consts::FRAC_PI_2);
        FrameRef {
            index: FrameIndex(index),
            time_s: None,
            color,
            depth,
            color_intrinsics: intrinsics,
            depth_intrinsics: intrinsics,
            depth_scale_m: 0.001,
            camera_to_world: Isometry3::from_parts(Translation3::from(at), turn),
            optics: uniground_geometry::scene::Optics::default(),
        }
    }

    fn settings() -> FusionSettings {
        FusionSettings { voxel_m: 0.03, ..FusionSettings::default() }
    }

    #[test]
    fn averaging_removes_noise_along_the_view() {
        let folder = tempfile::tempdir().unwrap();
        let folder = Utf8Path::from_path(folder.path()).unwrap();
        let mut frames: Vec<_> = (0..12)
            .map(|i| frame(folder, i, Vector3::new(i as f32 * 0.05, 0.0, 0.0), 40, |_, _| 2000))
            .collect();
        let cloud = fuse(&mut frames, &settings(), &mut Vec::new(), &Progress::silent()).unwrap();
        assert!(cloud.len() > 1000, "{} points", cloud.len());
        let off = |p: &uniground_geometry::Point3<f32>| (p.y - 2.0).abs();
        let mean = cloud.positions.iter().map(off).sum::<f32>() / cloud.len() as f32;
        assert!(mean < 0.01, "{mean} m from the wall on average; a measurement is 0.02 m off");
        assert!(cloud.colors.iter().all(|c| *c == [10, 200, 30]));
        let again = fuse(&mut frames, &settings(), &mut Vec::new(), &Progress::silent()).unwrap();
        assert_eq!(cloud, again);
    }

    #[test]
    fn a_surface_that_other_frames_see_through_is_removed() {
        let folder = tempfile::tempdir().unwrap();
        let folder = Utf8Path::from_path(folder.path()).unwrap();
        // A person walks through one of eight pictures, a meter in front of the wall.
        let blob = |u: u32, v: u32| {
            if (20..44).contains(&u) && (20..44).contains(&v) { 1000 } else { 2000 }
        };
        let mut frames: Vec<_> = (0..8)
            .map(|i| {
                frame(folder, i, Vector3::zeros(), 5, |u, v| if i == 3 { blob(u, v) } else { 2000 })
            })
            .collect();
        let cloud = fuse(&mut frames, &settings(), &mut Vec::new(), &Progress::silent()).unwrap();
        assert!(cloud.positions.iter().all(|p| p.y > 1.5), "the person must not be in the cloud");
    }

    #[test]
    fn a_scan_that_exceeds_the_block_limit_is_not_fused() {
        let folder = tempfile::tempdir().unwrap();
        let folder = Utf8Path::from_path(folder.path()).unwrap();
        let frames = [frame(folder, 0, Vector3::zeros(), 5, |_, _| 2000)];
        assert!(
            try_fuse(&frames, &settings(), 10, &mut Vec::new(), &Progress::silent())
                .unwrap()
                .is_none()
        );
        assert!(
            try_fuse(&frames, &settings(), 10_000, &mut Vec::new(), &Progress::silent())
                .unwrap()
                .is_some()
        );
    }
}
