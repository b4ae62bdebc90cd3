//! The plain layout: `color/ depth/ pose/ intrinsic.txt` and, optionally, a cloud. Folders are
//! found by their usual names. Files are matched by name, number or time. All poses can be in one
//! file. Order is by number, so `10` follows `9`.

use super::files::{DEPTHS, FolderListing, PICTURES};
use super::numbers::read_pose;
use super::trajectory::{self, TimedPose, Trajectory};
use super::{entry_path, intrinsics, pairing};
use crate::IngestError;
use crate::scan::{RawFrame, Scan, usual_depth_scale_m};
use camino::Utf8PathBuf;
use std::collections::BTreeMap;
use uniground_geometry::scene::{Confidence, FrameIndex, Intrinsics, Optics};
use uniground_types::findings::{Finding, FindingSubject};

const LOOKS_LIKE: &str = "a folder of pictures";
const NO_POSES: &str = "camera poses are needed: add pose/ with a 4x4 camera-to-world matrix for each picture, or poses.txt. Scanner apps and SLAM programs write them";
const NO_DEPTH: &str = "depth pictures are needed: add depth/ with 16-bit pictures in millimeters, or upload a point cloud alone";
const COLOR: &[&str] = &["color", "colour", "rgb", "image", "images"];
const DEPTH: &[&str] = &["depth", "depths"];
const POSE: &[&str] = &["pose", "poses"];
const CONFIDENCE: &[&str] = &["confidence", "conf"];
const TRAJECTORIES: &[&str] =
    &["poses.txt", "pose.txt", "traj.txt", "trajectory.txt", "groundtruth.txt", "trajectory.log"];
/// Accepted names of a cloud next to posed pictures. Other clouds could be anything.
pub(super) const CLOUD: &[&str] =
    &["cloud.", "pointcloud.", "point_cloud.", "points.", "mesh.", "scene."];

pub(super) fn can_read_posed(folder: &FolderListing) -> bool {
    folder.first_folder(COLOR).is_some()
        && folder.first_folder(DEPTH).is_some()
        && (folder.first_folder(POSE).is_some() || folder.first_file(TRAJECTORIES).is_some())
}

pub(super) fn can_read(folder: &FolderListing) -> bool {
    [COLOR, DEPTH, POSE].iter().any(|names| folder.first_folder(names).is_some())
}

pub(super) fn read(folder: &FolderListing) -> Result<Scan, IngestError> {
    let mut scan = Scan::new(&folder.root, "color-depth-pose");
    scan.cloud = find_cloud(folder);
    let list = |names: &[&str], endings: &[&str]| {
        folder.first_folder(names).map_or(Ok(Vec::new()), |name| folder.files(name, endings))
    };
    let pictures = ScanImages {
        color: list(COLOR, PICTURES)?,
        depth: list(DEPTH, DEPTHS)?,
        confidence: list(CONFIDENCE, &["png"])?,
    };
    scan.depth_scale_m = usual_depth_scale_m(&folder.root, &pictures.depth);
    let poses = match folder.first_folder(POSE) {
        Some(name) => PoseFiles::Files(folder.files(name, &["txt"])?),
        None => match folder.first_file(TRAJECTORIES) {
            Some(file) => PoseFiles::List(trajectory::read(&folder.root, &file)?, file),
            None => PoseFiles::Files(Vec::new()),
        },
    };
    check_kinds(folder, COLOR, &pictures.color, PICTURES)?;
    check_kinds(folder, DEPTH, &pictures.depth, DEPTHS)?;
    if let PoseFiles::Files(files) = &poses {
        check_kinds(folder, POSE, files, &["txt"])?;
    }
    let has_poses = match &poses {
        PoseFiles::Files(files) => !files.is_empty(),
        PoseFiles::List(..) => true,
    };
    let has_pictures = !pictures.color.is_empty() || !pictures.depth.is_empty();
    if has_pictures && !has_poses {
        return Err(super::incomplete(LOOKS_LIKE, NO_POSES));
    }
    if pictures.depth.is_empty() && !pictures.color.is_empty() {
        return Err(super::incomplete(LOOKS_LIKE, NO_DEPTH));
    }
    // A single odd picture must not decide for all.
    let Some(first) = folder.typical_picture(&pictures.color) else {
        return match pictures.depth.first() {
            Some(depth) => Err(pictures.count_mismatch_error(&poses, depth.clone())),
            None => Ok(scan),
        };
    };
    let color = intrinsics::read_color_intrinsics(folder, first)?;
    add_frames(
        &mut scan,
        &pictures,
        &poses,
        &FrameCameras { color, depth: None },
        UnmatchedImages::Damaged,
    )?;
    Ok(scan)
}

/// Refuses a folder that holds only files of kinds that are not read, such as `.npy` or `.webp`.
fn check_kinds(
    folder: &FolderListing,
    names: &[&str],
    found: &[Utf8PathBuf],
    kinds: &[&str],
) -> Result<(), IngestError> {
    let Some(name) = folder.first_folder(names).filter(|_| found.is_empty()) else {
        return Ok(());
    };
    let Some(kind) = folder.most_frequent_ending(name)? else { return Ok(()) };
    Err(IngestError::malformed(
        name,
        format!("its files end in .{kind}, which is not read; expected {}", kinds.join(", ")),
    ))
}

/// Returns the cloud next to posed pictures, found by its name.
pub(super) fn find_cloud(folder: &FolderListing) -> Option<Utf8PathBuf> {
    folder
        .clouds(CLOUD)
        .into_iter()
        .find(|file| CLOUD.iter().any(|name| file.as_str().starts_with(name)))
}

/// Pictures of a scan, each list in natural order.
pub(super) struct ScanImages {
    pub color: Vec<Utf8PathBuf>,
    pub depth: Vec<Utf8PathBuf>,
    /// Confidence of the depth pictures. Frames without it are accepted.
    pub confidence: Vec<Utf8PathBuf>,
}

/// The location of the poses.
pub(super) enum PoseFiles {
    /// One file per frame.
    Files(Vec<Utf8PathBuf>),
    /// All poses in this file.
    List(Trajectory, Utf8PathBuf),
}

/// Cameras of all frames. If there is no separate depth camera, the color camera is used for depth.
pub(super) struct FrameCameras {
    pub color: Intrinsics,
    pub depth: Option<Intrinsics>,
}

/// How to treat pictures without a matching picture or pose.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) enum UnmatchedImages {
    /// As damage: every picture should have a match.
    Damaged,
    /// Left out silently: the cameras run at different rates.
    LeftOut,
}

/// Minimum confidence of a measurement. Of three levels, the lowest is rejected.
pub(super) const LEAST_CONFIDENCE: u8 = 1;

impl ScanImages {
    fn count_mismatch_error(&self, poses: &PoseFiles, first: Utf8PathBuf) -> IngestError {
        let pose = match poses {
            PoseFiles::Files(files) => files.len(),
            PoseFiles::List(Trajectory::Ordered(poses), _) => poses.len(),
            PoseFiles::List(Trajectory::Timed(poses), _) => poses.len(),
        };
        IngestError::FrameCountMismatch {
            color: self.color.len(),
            depth: self.depth.len(),
            pose,
            first,
        }
    }
}

/// Matches color, depth and pose of each moment. Confidence is matched to depth by name, where it
/// exists.
pub(super) fn add_frames(
    scan: &mut Scan,
    pictures: &ScanImages,
    poses: &PoseFiles,
    cameras: &FrameCameras,
    unmatched: UnmatchedImages,
) -> Result<(), IngestError> {
    let ScanImages { color, depth, confidence } = pictures;
    let (depth_of, by) = pairing::match_files_by(color, depth);
    let found = depth_of.iter().flatten().count();
    let text = format!("color and depth pictures are paired by {by}: {found} of {}", color.len());
    scan.findings.push(
        Finding::assumed(FindingSubject::Frames, text)
            .without_warning()
            .counting(found)
            .stated_with("scene.json"),
    );
    let pose_of = match_poses(color, poses)?;
    let confidence_of = pairing::match_files(color, confidence);
    let mut alone: Vec<Utf8PathBuf> = Vec::new();
    for (i, picture) in color.iter().enumerate() {
        let (Some(depth_at), Some(pose)) = (depth_of[i], &pose_of[i]) else {
            alone.push(picture.clone());
            continue;
        };
        let root = scan.root.clone();
        let frame = || {
            let (pose, pose_file) = match pose {
                PoseSource::File(file) => (read_pose(&root, file)?, file.clone()),
                PoseSource::At(pose, name) => (*pose, name.clone()),
            };
            let confidence = confidence_of[i]
                .map(|at| Confidence { file: confidence[at].clone(), at_least: LEAST_CONFIDENCE });
            Ok(RawFrame {
                index: FrameIndex(0),
                time_s: pairing::parse_seconds(picture).and_then(pairing::since_1970),
                color: picture.clone(),
                depth: depth[depth_at].clone(),
                pose_file,
                pose,
                color_intrinsics: cameras.color,
                depth_intrinsics: cameras.depth.unwrap_or(cameras.color),
                optics: Optics { confidence, ..Optics::default() },
            })
        };
        scan.add(frame())?;
    }
    let mut seen = vec![false; depth.len()];
    depth_of.iter().flatten().for_each(|at| seen[*at] = true);
    alone.extend(depth.iter().zip(&seen).filter(|(_, seen)| !**seen).map(|(file, _)| file.clone()));
    if let PoseFiles::Files(files) = poses
        && unmatched == UnmatchedImages::Damaged
    {
        let used: std::collections::BTreeSet<&Utf8PathBuf> = pose_of
            .iter()
            .flatten()
            .filter_map(|p| if let PoseSource::File(file) = p { Some(file) } else { None })
            .collect();
        alone.extend(files.iter().filter(|file| !used.contains(file)).cloned());
    }
    match unmatched {
        UnmatchedImages::Damaged => {
            // Each moment counts once, however many of its files exist.
            let mut moments: Vec<_> =
                alone.into_iter().map(|file| (pairing::natural_sort_key(&file), file)).collect();
            moments.dedup_by(|a, b| a.0 == b.0);
            for (_, file) in moments {
                scan.damage.record(pictures.count_mismatch_error(poses, file))?;
            }
        }
        UnmatchedImages::LeftOut if scan.frames.is_empty() => {
            let first = alone.into_iter().next().unwrap_or_default();
            return Err(pictures.count_mismatch_error(poses, first));
        }
        UnmatchedImages::LeftOut if !alone.is_empty() => {
            let text = format!(
                "{} pictures skipped, no other file has the same time; the first: {}",
                alone.len(),
                alone[0]
            );
            scan.findings.push(
                Finding::left_out(FindingSubject::Frames, text)
                    .in_file(alone[0].as_str())
                    .counting(alone.len()),
            );
        }
        UnmatchedImages::LeftOut => {}
    }
    Ok(())
}

/// The location of a picture's pose.
enum PoseSource {
    File(Utf8PathBuf),
    At(nalgebra::Matrix4<f64>, Utf8PathBuf),
}

fn match_poses(
    color: &[Utf8PathBuf],
    poses: &PoseFiles,
) -> Result<Vec<Option<PoseSource>>, IngestError> {
    Ok(match poses {
        PoseFiles::Files(files) => {
            let at = pairing::match_files(color, files);
            at.into_iter().map(|at| at.map(|at| PoseSource::File(files[at].clone()))).collect()
        }
        PoseFiles::List(Trajectory::Ordered(poses), file) => {
            if poses.len() != color.len() {
                return Err(IngestError::malformed(
                    file,
                    format!("it has {} poses for {} color pictures", poses.len(), color.len()),
                ));
            }
            poses
                .iter()
                .enumerate()
                .map(|(i, pose)| {
                    Some(PoseSource::At(*pose, entry_path(file, format_args!("pose {i}"))))
                })
                .collect()
        }
        PoseFiles::List(Trajectory::Timed(poses), file) => {
            let mut poses = poses.clone();
            poses.sort_by(|a, b| a.time_s.total_cmp(&b.time_s));
            let at = |picture: &Utf8PathBuf| {
                let time = pairing::parse_seconds(picture)?;
                let pose = trajectory::pose_at(&poses, time, pairing::SAME_MOMENT_S)?;
                Some(PoseSource::At(pose, entry_path(file, format_args!("time {time}"))))
            };
            let by_time: Vec<_> = color.iter().map(at).collect();
            // Pictures can be named by the numbers in the list instead of by their times.
            let numbered: BTreeMap<u64, &TimedPose> =
                poses.iter().filter_map(|pose| Some((pose.id?, pose))).collect();
            let with_id = |picture: &Utf8PathBuf| {
                let id = pairing::last_number(picture)?;
                let pose = numbered.get(&id)?.pose;
                Some(PoseSource::At(pose, entry_path(file, format_args!("number {id}"))))
            };
            let by_id: Vec<_> = color.iter().map(with_id).collect();
            let found = |poses: &[Option<PoseSource>]| poses.iter().flatten().count();
            if found(&by_id) > found(&by_time) { by_id } else { by_time }
        }
    })
}
