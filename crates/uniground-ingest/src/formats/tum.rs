//! TUM RGB-D: `rgb.txt`, `depth.txt` and `groundtruth.txt` list pictures and poses by time. Depth
//! is in 1/5000 m and registered to the color picture. The cameras are known from the number of the
//! Kinect in the sequence's name.

use super::files::{FolderListing, TextFiles};
use super::trajectory::{self, Trajectory};
use super::{entry_path, incomplete, intrinsics, pairing};
use crate::scan::{RawFrame, Scan};
use crate::{IngestError, MAX_FRAMES};
use camino::{Utf8Path, Utf8PathBuf};
use uniground_geometry::scene::{FrameIndex, Intrinsics, Lens, Optics};
use uniground_types::findings::{Finding, FindingSubject};

const LOOKS_LIKE: &str = "a TUM RGB-D sequence";
const MAX_LIST_BYTES: u64 = 32 << 20;
const POSES: &[&str] =
    &["groundtruth.txt", "CameraTrajectory.txt", "KeyFrameTrajectory.txt", "trajectory.txt"];
const SIZE: (u32, u32) = (640, 480);

pub(super) fn can_read(folder: &FolderListing) -> bool {
    let lists = ["rgb.txt", "depth.txt", "groundtruth.txt"]
        .iter()
        .filter(|name| folder.has_file(name))
        .count();
    folder.has_folder("depth")
        && folder.has_folder("rgb")
        && lists >= 1
        && (folder.has_file("rgb.txt") || folder.has_file("depth.txt"))
        || lists == 3
}

pub(super) fn read(folder: &FolderListing) -> Result<Scan, IngestError> {
    let root = &folder.root;
    let [color, depth] = ["rgb.txt", "depth.txt"].map(|name| match folder.has_file(name) {
        true => read_picture_list(root, name),
        false => Err(incomplete(LOOKS_LIKE, format!("{name} is missing"))),
    });
    let ((color, heading), (depth, _)) = (color?, depth?);
    let poses_file = folder.first_file(POSES).ok_or_else(|| {
        incomplete(LOOKS_LIKE, "groundtruth.txt is missing: add a trajectory in its format (timestamp tx ty tz qx qy qz qw)")
    })?;
    let Trajectory::Timed(mut poses) = trajectory::read(root, &poses_file)? else {
        return Err(IngestError::malformed(
            poses_file,
            "its lines must be: timestamp tx ty tz qx qy qz qw",
        ));
    };
    poses.sort_by(|a, b| a.time_s.total_cmp(&b.time_s));
    let mut scan = Scan::new(root, "tum-rgbd");
    scan.depth_scale_m = 1.0 / 5000.0;
    let pictures: Vec<Utf8PathBuf> = color.iter().map(|(_, picture)| picture.clone()).collect();
    let Some(typical) = folder.typical_picture(&pictures) else {
        return Err(incomplete(LOOKS_LIKE, "rgb.txt lists no pictures"));
    };
    let (camera, lens) = read_camera(folder, &heading, typical, &mut scan)?;
    let times =
        |list: &[(f64, Utf8PathBuf)]| list.iter().map(|(t, _)| Some(*t)).collect::<Vec<_>>();
    let partner =
        pairing::match_nearest_times(&times(&color), &times(&depth), pairing::SAME_MOMENT_S);
    let (mut alone, mut untracked) = (0, 0);
    for ((time, picture), partner) in color.iter().zip(partner) {
        let Some(partner) = partner else {
            alone += 1;
            continue;
        };
        let Some(pose) = trajectory::pose_at(&poses, *time, pairing::SAME_MOMENT_S) else {
            untracked += 1;
            continue;
        };
        scan.frames.push(RawFrame {
            index: FrameIndex(0),
            time_s: pairing::since_1970(*time),
            color: picture.clone(),
            depth: depth[partner].1.clone(),
            pose_file: entry_path(&poses_file, format_args!("time {time}")),
            pose,
            color_intrinsics: camera,
            depth_intrinsics: camera,
            optics: Optics { color_lens: lens, depth_lens: lens, ..Optics::default() },
        });
    }
    if alone + untracked > 0 {
        let text = format!(
            "of {} color pictures, {alone} without a depth picture and {untracked} without a pose within {} ms are skipped",
            color.len(),
            pairing::SAME_MOMENT_S * 1000.0
        );
        scan.findings
            .push(Finding::left_out(FindingSubject::Frames, text).counting(alone + untracked));
    }
    match scan.frames.is_empty() {
        true => Err(incomplete(
            LOOKS_LIKE,
            "no color picture has a depth picture and a pose at the same time",
        )),
        false => Ok(scan),
    }
}

/// Reads a list of `time file`, and the text of its heading.
fn read_picture_list(
    root: &TextFiles,
    name: &str,
) -> Result<(Vec<(f64, Utf8PathBuf)>, String), IngestError> {
    let file = Utf8Path::new(name);
    let text = root.read_text(file, MAX_LIST_BYTES)?;
    let (mut list, mut heading) = (Vec::new(), String::new());
    for (number, line) in text.lines().enumerate() {
        let line = line.trim();
        if line.is_empty() || line.starts_with('#') {
            heading.push_str(line);
            continue;
        }
        let malformed = || {
            IngestError::malformed(file, format!("line {} is not `timestamp filename`", number + 1))
        };
        let (time, path) = line.split_once([' ', '\t']).ok_or_else(malformed)?;
        let path = Utf8PathBuf::from(path.trim());
        super::files::check_inside(&path, "named in a list points outside the archive")?;
        list.push((time.parse().map_err(|_| malformed())?, path));
        if list.len() > MAX_FRAMES {
            return Err(IngestError::malformed(file, format!("more than {MAX_FRAMES} pictures")));
        }
    }
    list.sort_by(|a: &(f64, Utf8PathBuf), b| a.0.total_cmp(&b.0));
    Ok((list, heading))
}

/// Reads a camera matrix next to the lists. Otherwise returns that of the benchmark's Kinect, by
/// name.
fn read_camera(
    folder: &FolderListing,
    heading: &str,
    picture: &Utf8Path,
    scan: &mut Scan,
) -> Result<(Intrinsics, Option<Lens>), IngestError> {
    if intrinsics::find_color_file(folder).is_some() {
        return Ok((intrinsics::read_color_intrinsics(folder, picture)?, None));
    }
    let (width, height) = SIZE;
    let of = |fx, fy, cx, cy| Intrinsics { width, height, fx, fy, cx, cy };
    let lens = |k1, k2, p1, p2, k3| Some(Lens { k1, k2, p1, p2, k3, ..Lens::default() });
    let named = |number: u32| {
        let name = format!("freiburg{number}");
        heading.contains(&name) || folder.root.as_str().contains(&name)
    };
    Ok(if named(1) {
        (of(517.3, 516.5, 318.6, 255.3), lens(0.2624, -0.9531, -0.0054, 0.0026, 1.1633))
    } else if named(2) {
        (of(520.9, 521.0, 325.1, 249.7), lens(0.2312, -0.7849, -0.0033, -0.0001, 0.9172))
    } else if named(3) {
        (of(535.4, 539.2, 320.1, 247.6), None)
    } else {
        scan.findings.push(
            Finding::assumed(
                FindingSubject::Camera,
                "unknown camera: a Kinect (525 525 319.5 239.5) is assumed; add intrinsic.txt beside the lists if that is wrong",
            )
            .stated_with("intrinsic.txt"),
        );
        (of(525.0, 525.0, 319.5, 239.5), None)
    })
}
