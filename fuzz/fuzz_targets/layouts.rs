//! Native layouts beside honest pictures: one list, trajectory, camera or description of anybody's making. The first byte says which.
#![no_main]

use camino::Utf8Path;
use libfuzzer_sys::fuzz_target;
use uniground_core::ingest;
use uniground_core::progress::Progress;
use uniground_types::settings::ImportSettings;

/// The file that is fuzzed, and honest ones beside it.
const LAYOUTS: [(&str, &[(&str, &str)]); 17] = [
    ("rgb.txt", &[("depth.txt", "1 depth/1.png\n"), ("groundtruth.txt", "1 0 0 0 0 0 0 1\n")]),
    ("groundtruth.txt", &[("rgb.txt", "1 rgb/1.png\n"), ("depth.txt", "1 depth/1.png\n")]),
    ("transforms.json", &[]),
    ("keyframes/cameras/1.json", &[]),
    ("metadata", &[]),
    ("lowres_wide.traj", &[("lowres_wide_intrinsics/1.pincam", "4 4 2 2 1 1")]),
    ("lowres_wide_intrinsics/1.pincam", &[("lowres_wide.traj", "1 0 0 0 0 0 0\n")]),
    ("odometry.csv", &[("camera_matrix.csv", "2,0,1\n0,2,1\n0,0,1\n")]),
    (
        "traj.txt",
        &[(
            "cam_params.json",
            r#"{"camera":{"w":4,"h":4,"fx":2,"fy":2,"cx":1,"cy":1,"scale":1000}}"#,
        )],
    ),
    ("cam_params.json", &[("traj.txt", "1 0 0 0 0 1 0 0 0 0 1 0 0 0 0 1\n")]),
    ("frame_1.json", &[]),
    ("_info.txt", &[("frame-1.pose.txt", "1 0 0 0 0 1 0 0 0 0 1 0 0 0 0 1\n")]),
    ("trajectory.log", &[("intrinsic.txt", "2 0 1\n0 2 1\n0 0 1\n")]),
    ("scan_calib/1.yaml", &[("scan_camera_poses.txt", "1 0 0 0 0 0 0 1\n")]),
    (
        "scan_camera_poses.txt",
        &[(
            "scan_calib/1.yaml",
            "image_width: 4\nimage_height: 4\ncamera_matrix:\n  data: [ 2., 0., 1., 0., 2., 1., 0., 0., 1. ]\n",
        )],
    ),
    (
        "scene0000_00.txt",
        &[
            ("intrinsic/intrinsic_color.txt", "2 0 1\n0 2 1\n0 0 1\n"),
            ("pose/1.txt", "1 0 0 0 0 1 0 0 0 0 1 0 0 0 0 1\n"),
        ],
    ),
    ("camera_intrinsic.json", &[("trajectory.log", "0 0 1\n1 0 0 0\n0 1 0 0\n0 0 1 0\n0 0 0 1\n")]),
];
const COLORS: [&str; 10] = [
    "rgb/1.png",
    "images/1.png",
    "keyframes/images/1.png",
    "rgbd/0.jpg",
    "lowres_wide/1.png",
    "results/frame1.png",
    "frame_1.png",
    "frame-1.color.png",
    "color/1.png",
    "scan_rgb/1.png",
];
const DEPTHS: [&str; 7] = [
    "depth/1.png",
    "keyframes/depth/1.png",
    "lowres_depth/1.png",
    "results/depth1.png",
    "depth_1.png",
    "frame-1.depth.png",
    "scan_depth/1.png",
];

fuzz_target!(|data: &[u8]| {
    let Some((which, bytes)) = data.split_first() else { return };
    let (name, beside) = LAYOUTS[usize::from(*which) % LAYOUTS.len()];
    let folder = tempfile::tempdir().unwrap();
    let root = Utf8Path::from_path(folder.path()).unwrap();
    let put = |name: &str, bytes: &[u8]| {
        let path = root.join(name);
        std::fs::create_dir_all(path.parent().unwrap()).unwrap();
        std::fs::write(path, bytes).unwrap();
    };
    let png = |picture: image::DynamicImage| {
        let mut bytes = std::io::Cursor::new(Vec::new());
        picture.write_to(&mut bytes, image::ImageFormat::Png).unwrap();
        bytes.into_inner()
    };
    let color = png(image::RgbImage::new(4, 4).into());
    let depth = png(image::ImageBuffer::from_pixel(4, 4, image::Luma([1000_u16])).into());
    // Pictures of the other layouts would be recognised first.
    let family = name.split(['/', '.', '_', '-']).next().unwrap_or_default();
    let own = |other: &&str| match family {
        "rgb" | "groundtruth" | "odometry" => {
            other.starts_with("rgb/") || other.starts_with("depth/")
        }
        "transforms" => other.starts_with("images/") || other.starts_with("depth/"),
        "keyframes" => other.starts_with("keyframes/"),
        "metadata" => other.starts_with("rgbd/"),
        "lowres" => other.starts_with("lowres"),
        "camera" => other.starts_with("color/") || other.starts_with("depth/"),
        "traj" | "cam" => other.starts_with("results/"),
        "frame" => other.starts_with("frame_") || other.starts_with("depth_"),
        "" => other.starts_with("frame-"),
        "trajectory" | "scene0000" => other.starts_with("color/") || other.starts_with("depth/"),
        _ => other.starts_with("scan_"),
    };
    COLORS.iter().filter(|other| own(other)).for_each(|other| put(other, &color));
    DEPTHS.iter().filter(|other| own(other)).for_each(|other| put(other, &depth));
    beside.iter().for_each(|(name, text)| put(name, text.as_bytes()));
    put(name, bytes);
    if let Ok(scan) = ingest::open(root) {
        let _ = ingest::inspect(&scan, &ImportSettings::default(), &Progress::silent());
    }
});
