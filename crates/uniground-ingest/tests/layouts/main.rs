//! Writes one small room in every layout. Each must be read as the same canonical scene.

// A helper that fails aborts its test.
#![allow(clippy::unwrap_used)]

mod clouds;
mod mistakes;
mod room;
mod writers;

use camino::Utf8Path;
use nalgebra::{Isometry3, Vector3};
use room::{CAMERA, FRAMES, pose};
use serde_json::json;
use std::fs;
use std::io::Write as _;
use uniground_geometry::progress::Progress;
use uniground_geometry::scene::FrameRef;
use uniground_ingest::{IngestError, InspectedScan};
use uniground_types::findings::{FindingKind, FindingSubject};
use uniground_types::settings::ImportSettings;
use writers::Out;

/// Writes a scan, imports it, and checks the result before the folder is removed.
fn with_import<T>(
    write: impl Fn(&Out),
    look: impl FnOnce(Result<InspectedScan, IngestError>) -> T,
) -> T {
    let folder = tempfile::tempdir().unwrap();
    let root = Utf8Path::from_path(folder.path()).unwrap();
    write(&Out(root));
    look(uniground_ingest::open(root).and_then(|scan| {
        uniground_ingest::inspect(&scan, &ImportSettings::default(), &Progress::silent())
    }))
}

fn pose_difference(a: &Isometry3<f64>, b: &Isometry3<f64>) -> (f64, f64) {
    let distance = (a.translation.vector - b.translation.vector).norm();
    (distance, a.rotation.angle_to(&b.rotation).to_degrees())
}

fn camera_to_world(frame: &FrameRef) -> Isometry3<f64> {
    frame.camera_to_world.cast()
}

/// Compares the middle rows of a depth image with the true depth.
fn check_depth(what: &str, i: usize, frame: &FrameRef) {
    let depth = frame.decode_depth().unwrap();
    let expected = room::depth_m(&frame.depth_intrinsics, &pose(i));
    let off = depth
        .depth_m
        .iter()
        .zip(&expected)
        .filter(|(found, there)| (*found - *there).abs() > 0.002)
        .count();
    // Where a silhouette falls between two pixels, either depth is correct.
    assert!(off * 50 < expected.len(), "{what}, frame {i}: {off} of {} pixels", expected.len());
    assert!(frame.decode_color().is_ok(), "{what}, frame {i}");
}

type Write = fn(&Out);

/// Description, writer, and the format that must be recognized.
const LAYOUTS: [(&str, Write, &str); 26] = [
    ("plain", writers::plain, "color-depth-pose"),
    ("plain, paired by number", writers::plain_paired, "color-depth-pose"),
    ("plain, depth as EXR", writers::plain_exr, "color-depth-pose"),
    ("plain, depth as EXR of half floats", writers::plain_exr_halves, "color-depth-pose"),
    ("plain, depth as TIFF of floats", writers::plain_tiff, "color-depth-pose"),
    ("plain, depth as TIFF in millimeters", writers::plain_tiff_millimeters, "color-depth-pose"),
    ("ScanNet export", writers::scannet, "scannet-export"),
    ("TUM RGB-D", writers::tum, "tum-rgbd"),
    ("7-Scenes", writers::seven_scenes, "7-scenes"),
    ("3RScan", writers::three_rscan, "3rscan"),
    ("ARKitScenes", writers::arkit_scenes, "arkit-scenes"),
    ("Replica", writers::replica, "replica"),
    ("nerfstudio", writers::nerfstudio, "nerfstudio"),
    ("Polycam", writers::polycam, "polycam"),
    ("Stray Scanner", writers::stray_scanner, "stray-scanner"),
    ("3D Scanner App", writers::scanner_app, "3d-scanner-app"),
    ("Open3D log", writers::open3d, "open3d-log"),
    ("RTAB-Map", writers::rtabmap, "rtabmap"),
    ("nerfstudio on Windows", writers::nerfstudio_on_windows, "nerfstudio"),
    ("Polycam, partly corrected", writers::polycam_partly_corrected, "polycam"),
    ("TUM RGB-D, nanoseconds", writers::tum_nanoseconds, "tum-rgbd"),
    ("plain beside documents", writers::plain_beside_documents, "color-depth-pose"),
    ("ScanNet++ of an iPhone", writers::scannetpp, "scannetpp"),
    ("RTAB-Map, named by number", writers::rtabmap_by_number, "rtabmap"),
    ("plain, named parameters", writers::plain_with_named_parameters, "color-depth-pose"),
    ("plain, in capitals", writers::plain_in_capitals, "color-depth-pose"),
];

#[test]
fn every_layout_gives_the_same_scene() {
    for (what, write, format) in LAYOUTS {
        with_import(write, |found| {
            let InspectedScan { frames, report, .. } =
                found.unwrap_or_else(|e| panic!("{what}: {e}"));
            assert_eq!(
                (report.format.as_str(), frames.len()),
                (format, FRAMES),
                "{what}: {report:?}"
            );
            assert!(report.reprojection_agreement.unwrap() > 0.8, "{what}: {report:?}");
            for (i, frame) in frames.iter().enumerate() {
                let (metres, degrees) = pose_difference(&camera_to_world(frame), &pose(i));
                assert!(
                    metres < 1e-3 && degrees < 0.1,
                    "{what}, frame {i}: {metres} m and {degrees} degrees off: {report:?}"
                );
                check_depth(what, i, frame);
            }
        });
    }
}

/// Files that no frame uses, assumptions and what was read are in the report.
#[test]
fn findings_name_what_was_read_left_out_and_assumed() {
    let write = |out: &Out| {
        writers::plain(out);
        out.put("thumbnails/1.jpg", "a picture");
        out.put("thumbnails/2.jpg", "a picture");
        out.put("video.mp4", "a video");
        out.put("depth_to_color.txt", "1 0 0 0");
        out.put("README.txt", "for people");
    };
    with_import(write, |found| {
        let report = found.unwrap().report;
        let of = |kind: FindingKind, about: FindingSubject| {
            let mut found = report.findings.iter().filter(|f| (f.kind, f.about) == (kind, about));
            let finding = found.next().unwrap_or_else(|| panic!("{kind:?} {about:?} {report:?}"));
            (finding.clone(), found.next().cloned())
        };
        let (frames, _) = of(FindingKind::Read, FindingSubject::Frames);
        assert_eq!(frames.count, Some(FRAMES as u64));
        assert!(frames.text.contains("color/*.jpg"), "{}", frames.text);
        assert!(frames.text.ends_with("described by intrinsic.txt"), "{}", frames.text);
        let left_out: Vec<(&str, u64)> = report
            .findings
            .iter()
            .filter(|finding| finding.kind == FindingKind::LeftOut)
            .map(|finding| (finding.text.as_str(), finding.count.unwrap()))
            .collect();
        assert_eq!(
            left_out,
            [
                ("thumbnails/*.jpg: 2 files are not used", 2),
                ("video.mp4 is not used", 1),
                ("depth_to_color.txt is not used", 1),
            ]
        );
        let (pairs, _) = of(FindingKind::Assumed, FindingSubject::Frames);
        assert!(pairs.text.contains("by name"), "{}", pairs.text);
        let (poses, _) = of(FindingKind::Assumed, FindingSubject::Poses);
        assert!(poses.confidence.unwrap() > 0.75, "{poses:?}");
        let (up, _) = of(FindingKind::Assumed, FindingSubject::Up);
        assert!(up.confidence.unwrap() > 0.5 && up.state_with.as_deref() == Some("up"), "{up:?}");
        let warnings = report.findings.iter().filter(|finding| finding.warning);
        assert!(warnings.map(|finding| &finding.text).eq(&report.warnings), "{report:?}");
    });
}

/// A check decodes every picture, so it finds what the parse would leave out.
#[test]
fn a_check_finds_pictures_that_cannot_be_decoded() {
    let folder = tempfile::tempdir().unwrap();
    let root = Utf8Path::from_path(folder.path()).unwrap();
    let frames = 2 * FRAMES.max(10);
    for i in 0..frames {
        let out = Out(root);
        let (color, depth) = (format!("color/{i}.jpg"), format!("depth/{i}.png"));
        out.pictures(i % FRAMES, (&color, &depth), &CAMERA, &CAMERA, 0.001);
        out.put(&format!("pose/{i}.txt"), room::rows(&writers::matrix(&pose(i % FRAMES))));
    }
    Out(root).put("intrinsic.txt", writers::camera_matrix(&CAMERA));
    // The middle of the compressed data, so that header and end marker are right.
    let file = root.join("depth/3.png");
    let mut bytes = fs::read(&file).unwrap();
    let middle = bytes.len() / 2;
    bytes[middle..middle + 40].fill(0xa5);
    fs::write(&file, bytes).unwrap();
    let scan = uniground_ingest::open(root).unwrap();
    let settings = ImportSettings::default();
    let found = uniground_ingest::check(&scan, &settings, &Progress::silent()).unwrap();
    assert_eq!((found.frames.len(), found.report.frames_skipped), (frames - 1, 1));
    assert!(found.report.warnings.iter().any(|w| w.contains("depth/3.png")), "{:?}", found.report);
}

/// The declared unit of depth cannot be right, and the true one lies between two common ones.
#[test]
fn conventions_that_fit_alike_are_refused_with_both() {
    let write = |out: &Out| {
        writers::plain(out);
        let mut frames = Vec::new();
        for i in 0..FRAMES {
            let (color, depth) = (format!("color/{i}.jpg"), format!("depth/{i}.png"));
            out.pictures(i, (&color, &depth), &CAMERA, &CAMERA, 1.0 / 4472.0);
            frames.push(json!({"color": color, "depth": depth, "pose": format!("pose/{i}.txt")}));
        }
        let manifest = json!({"format": "uniground-scene/1", "intrinsics": CAMERA,
            "depth_scale_m": 1.0, "frames": frames});
        out.put("scene.json", manifest.to_string());
    };
    with_import(write, |found| {
        let message = found.map(|found| found.report).unwrap_err().to_string();
        assert!(message.contains("fit about equally well"), "{message}");
        let both = ["depth_scale_m 0.00025", "depth_scale_m 0.0002"];
        assert!(both.iter().all(|scale| message.contains(scale)), "{message}");
    });
}

/// Zip programs choose the compression themselves.
#[test]
fn zip_entries_compressed_with_bzip2_are_read() {
    let folder = tempfile::tempdir().unwrap();
    let root = Utf8Path::from_path(folder.path()).unwrap();
    writers::plain(&Out(&root.join("scan")));
    let archive = root.join("scan.zip");
    let mut zip = zip::ZipWriter::new(fs::File::create(&archive).unwrap());
    let options =
        zip::write::SimpleFileOptions::default().compression_method(zip::CompressionMethod::Bzip2);
    for part in ["color", "depth", "pose"] {
        for entry in root.join("scan").join(part).read_dir_utf8().unwrap() {
            let entry = entry.unwrap();
            zip.start_file(format!("{part}/{}", entry.file_name()), options).unwrap();
            zip.write_all(&fs::read(entry.path()).unwrap()).unwrap();
        }
    }
    zip.start_file("intrinsic.txt", options).unwrap();
    zip.write_all(&fs::read(root.join("scan/intrinsic.txt")).unwrap()).unwrap();
    zip.finish().unwrap();
    let unpacked = uniground_ingest::ScanFolder::open(&archive).unwrap();
    assert_eq!(uniground_ingest::open(&unpacked.path).unwrap().frames.len(), FRAMES);
}

/// Eight-bit images are read as depth only if their unit is given.
#[test]
fn eight_bit_depth_requires_a_unit() {
    let write = |unit_m: Option<f32>| {
        move |out: &Out| {
            writers::plain(out);
            let mut frames = Vec::new();
            for i in 0..FRAMES {
                let bytes = room::depth_m(&CAMERA, &pose(i))
                    .into_iter()
                    .map(|z| (z / 0.02).round() as u8)
                    .collect();
                let grey = image::GrayImage::from_raw(CAMERA.width, CAMERA.height, bytes).unwrap();
                out.put(
                    &format!("depth/{i}.png"),
                    room::encoded(&grey.into(), image::ImageFormat::Png),
                );
                frames.push(json!({"color": format!("color/{i}.jpg"), "depth": format!("depth/{i}.png"), "pose": format!("pose/{i}.txt")}));
            }
            let mut manifest =
                json!({"format": "uniground-scene/1", "intrinsics": CAMERA, "frames": frames});
            if let Some(unit_m) = unit_m {
                manifest["depth_scale_m"] = json!(unit_m);
            }
            out.put("scene.json", manifest.to_string());
        }
    };
    with_import(write(Some(0.02)), |found| {
        let InspectedScan { frames, report, .. } = found.unwrap();
        assert!(report.reprojection_agreement.unwrap() > 0.8, "{report:?}");
        let (found, there) = (frames[0].decode_depth().unwrap(), room::depth_m(&CAMERA, &pose(0)));
        assert!(
            found.depth_m.iter().zip(&there).all(|(found, there)| (found - there).abs() < 0.011)
        );
    });
    with_import(write(None), |found| {
        let message = found.unwrap_err().to_string();
        assert!(message.contains("depth/0.png") && message.contains("depth_scale_m"), "{message}");
    });
}

/// A unit of depth that nobody uses follows from the cloud.
#[test]
fn the_unit_of_depth_is_fitted_to_the_cloud() {
    // That of a RealSense L515, and one that nobody uses.
    for (scale_m, used) in
        [(1.0 / 4000.0, "depth_scale_m 0.00025"), (1.0 / 2700.0, "depth_scale_m 0.0003")]
    {
        with_import(
            |out| writers::plain_with_cloud(out, scale_m),
            |found| {
                let InspectedScan { report, frames, .. } = found.unwrap();
                assert!(report.reprojection_agreement.unwrap() > 0.8, "{report:?}");
                assert!(report.warnings.iter().any(|w| w.contains(used)), "{report:?}");
                let found = frames[0].decode_depth().unwrap();
                let there = room::depth_m(&CAMERA, &pose(0));
                let off = |(a, b): (&f32, &f32)| (a - b).abs() > 0.03 * b;
                let wrong = found.depth_m.iter().zip(&there).filter(|pair| off(*pair)).count();
                assert!(wrong * 50 < there.len(), "{wrong} of {}", there.len());
            },
        );
    }
}

/// What cannot be depth, and files of kinds that are not read, are refused before a parse, by name.
#[test]
fn pictures_of_other_kinds_are_named() {
    let replaced = |folder: &'static str, from: &'static str, to: &'static str| {
        move |out: &Out| {
            writers::plain(out);
            for i in 0..FRAMES {
                fs::rename(
                    out.0.join(format!("{folder}/{i}.{from}")),
                    out.0.join(format!("{folder}/{i}.{to}")),
                )
                .unwrap();
            }
        }
    };
    for (folder, from, to) in
        [("depth", "png", "npy"), ("color", "jpg", "webp"), ("pose", "txt", "npy")]
    {
        with_import(replaced(folder, from, to), |found| {
            let message = found.unwrap_err().to_string();
            assert!(
                message.contains(folder) && message.contains(&format!("end in .{to}")),
                "{message}"
            );
        });
    }
    let colored = |out: &Out| {
        writers::plain(out);
        for i in 0..FRAMES {
            let picture = room::encoded(&room::color(&CAMERA, &pose(i)), image::ImageFormat::Png);
            out.put(&format!("depth/{i}.png"), picture);
        }
    };
    with_import(colored, |found| {
        let message = found.unwrap_err().to_string();
        assert!(message.contains("not a depth picture") && message.contains("Rgb8"), "{message}");
    });
}

/// The size in a header is checked before memory is allocated.
#[test]
fn float_images_with_false_headers_are_refused() {
    let broken = |write: Write, name: &'static str, at: fn(&[u8]) -> usize, with: &'static [u8]| {
        move |out: &Out| {
            write(out);
            let mut bytes = fs::read(out.0.join(name)).unwrap();
            let at = at(&bytes);
            bytes[at..at + with.len()].copy_from_slice(with);
            (0..FRAMES).for_each(|i| out.put(&name.replace('0', &i.to_string()), &bytes));
        }
    };
    // The last column of the data window: attribute name and type, size, three numbers.
    let window: fn(&[u8]) -> usize =
        |bytes| bytes.windows(10).position(|w| w == b"dataWindow").unwrap() + 10 + 1 + 6 + 4 + 8;
    // The value of the first tag, which is the width.
    let width: fn(&[u8]) -> usize =
        |bytes| bytes.windows(4).position(|w| w == [0, 1, 4, 0]).unwrap() + 8;
    for (write, name, at) in [
        (writers::plain_exr as Write, "depth/0.exr", window),
        (writers::plain_tiff, "depth/0.tiff", width),
    ] {
        with_import(broken(write, name, at, &[0xff, 0xff, 0xff, 0x3f]), |found| {
            let message = found.unwrap_err().to_string();
            assert!(message.contains("frames") && message.contains("depth/"), "{message}");
        });
    }
}

/// The world is that of the first camera. The import levels it and keeps the frames' relative
/// poses.
#[test]
fn a_recording_without_gravity_is_leveled() {
    for write in [writers::record3d as Write, writers::record3d_export] {
        check_leveled(write);
    }
}

fn check_leveled(write: Write) {
    with_import(write, |found| {
        let InspectedScan { frames, report, .. } = found.unwrap();
        assert_eq!((report.format.as_str(), frames.len()), ("record3d", FRAMES));
        let level = report.levelling.clone().unwrap();
        assert!(level.turned && level.tilt_deg > 10.0, "{report:?}");
        let turn = pose(0) * camera_to_world(&frames[0]).inverse();
        let tilt = (turn.rotation * Vector3::z()).angle(&Vector3::z()).to_degrees();
        assert!(tilt < 1.0, "{tilt} degrees off: {report:?}");
        for (i, frame) in frames.iter().enumerate() {
            let (metres, degrees) = pose_difference(&(turn * camera_to_world(frame)), &pose(i));
            assert!(
                metres < 1e-3 && degrees < 0.1,
                "frame {i}: {metres} m and {degrees} degrees off"
            );
            check_depth("Record3D", i, frame);
        }
        // From the files' axes to the scene's: the first camera is at the files' origin.
        let way = report.source_to_scene.unwrap();
        let eye = frames[0].camera_to_world.translation.vector;
        let found = way.apply([0.0; 3]);
        assert!((0..3).all(|i| (found[i] - f64::from(eye[i])).abs() < 1e-4), "{found:?} {eye}");
    });
}

/// Writes the plain layout with rewritten poses.
fn with_poses(rewrite: impl Fn(nalgebra::Matrix4<f64>) -> nalgebra::Matrix4<f64>) -> impl Fn(&Out) {
    move |out| {
        writers::plain(out);
        for i in 0..FRAMES {
            out.put(&format!("pose/{i}.txt"), room::rows(&rewrite(pose(i).to_homogeneous())));
        }
    }
}

#[test]
fn the_pose_convention_that_fits_is_used() {
    type Rewrite = fn(nalgebra::Matrix4<f64>) -> nalgebra::Matrix4<f64>;
    let cases: [(&str, Rewrite, &str); 3] = [
        ("world-to-camera", |m| m.try_inverse().unwrap(), "world_to_camera"),
        ("OpenGL cameras", |m| m * room::opengl(), "opengl"),
        (
            "millimeters",
            |mut m| {
                (0..3).for_each(|i| m[(i, 3)] *= 1000.0);
                m
            },
            "metres_per_unit 0.001",
        ),
    ];
    for (what, rewrite, words) in cases {
        with_import(with_poses(rewrite), |found| {
            let InspectedScan { frames, report, .. } =
                found.unwrap_or_else(|e| panic!("{what}: {e}"));
            assert!(report.warnings.iter().any(|w| w.contains(words)), "{what}: {report:?}");
            for (i, frame) in frames.iter().enumerate() {
                let (metres, degrees) = pose_difference(&camera_to_world(frame), &pose(i));
                assert!(
                    metres < 1e-3 && degrees < 0.1,
                    "{what}, frame {i}: {metres} m and {degrees} degrees off"
                );
            }
        });
    }
}

#[test]
fn a_tilted_world_is_leveled_and_a_level_one_is_unchanged() {
    let tilt = Isometry3::rotation(Vector3::new(0.3, 0.35, 0.0)).to_homogeneous();
    with_import(with_poses(move |m| tilt * m), |found| {
        let InspectedScan { frames, report, .. } = found.unwrap();
        let turn = pose(0) * camera_to_world(&frames[0]).inverse();
        let left = (turn.rotation * Vector3::z()).angle(&Vector3::z()).to_degrees();
        assert!(left < 1.0, "{left} degrees left: {report:?}");
        let level = report.levelling.unwrap();
        assert!(level.turned && (level.tilt_deg - 26.4).abs() < 1.0, "{level:?}");
    });
    with_import(writers::plain, |found| {
        let InspectedScan { frames, report, .. } = found.unwrap();
        assert!(!report.levelling.unwrap().turned);
        assert_eq!(
            report.source_to_scene.unwrap(),
            uniground_geometry::scene::SourceToScene::IDENTITY
        );
        // Bit-identical to the file.
        let written: Vec<f64> = room::rows(&pose(3).to_homogeneous())
            .split_whitespace()
            .map(|w| w.parse().unwrap())
            .collect();
        let t = frames[3].camera_to_world.translation.vector;
        assert_eq!([t.x, t.y, t.z], [written[3] as f32, written[7] as f32, written[11] as f32]);
    });
}

/// One frame of twelve is more than a tenth, so the test doubles the number of frames.
#[test]
fn one_damaged_frame_in_ten_is_skipped_and_reported() {
    let longer = |out: &Out| {
        writers::plain(out);
        for i in FRAMES..2 * FRAMES {
            for (folder, ending) in [("color", "jpg"), ("depth", "png"), ("pose", "txt")] {
                out.put(
                    &format!("{folder}/{i}.{ending}"),
                    fs::read(out.0.join(format!("{folder}/{}.{ending}", i - FRAMES))).unwrap(),
                );
            }
        }
    };
    let one = |out: &Out| {
        longer(out);
        let jpeg = fs::read(out.0.join("color/5.jpg")).unwrap();
        out.put("color/5.jpg", &jpeg[..jpeg.len() / 2]);
        out.put("pose/9.txt", "nan ".repeat(16));
    };
    with_import(one, |found| {
        let InspectedScan { report, frames, .. } = found.unwrap();
        assert_eq!((frames.len(), report.frames_skipped), (22, 2));
        let named = |what: &str| report.warnings.iter().any(|w| w.contains(what));
        assert!(named("color/5.jpg") && named("pose/9.txt"), "{report:?}");
    });
    let four = |out: &Out| {
        longer(out);
        (0..4).for_each(|i| fs::remove_file(out.0.join(format!("depth/{i}.png"))).unwrap());
    };
    with_import(four, |found| {
        let message = found.unwrap_err().to_string();
        assert!(message.contains("4 of 24 frames") && message.contains("color/0.jpg"), "{message}");
    });
}

#[test]
fn an_incomplete_scan_is_refused_with_the_recognized_layout() {
    let without = |write: Write, gone: &'static str| {
        move |out: &Out| {
            write(out);
            let path = out.0.join(gone);
            if path.is_dir() {
                fs::remove_dir_all(path).unwrap();
            } else {
                fs::remove_file(path).unwrap();
            }
        }
    };
    let cases: [(Write, &str, &[&str]); 11] = [
        (writers::plain, "pose", &["camera poses are needed"]),
        (writers::plain, "depth", &["depth pictures are needed"]),
        (writers::tum, "groundtruth.txt", &["TUM RGB-D", "groundtruth.txt"]),
        (writers::tum, "rgb.txt", &["TUM RGB-D", "rgb.txt"]),
        (
            writers::arkit_scenes,
            "41069021_frames/lowres_wide.traj",
            &["ARKitScenes", "lowres_wide.traj"],
        ),
        (writers::replica, "room0/traj.txt", &["Replica", "traj.txt"]),
        (writers::stray_scanner, "rgb", &["Stray Scanner", "ffmpeg"]),
        (writers::polycam, "keyframes/depth", &["Polycam", "LiDAR"]),
        (writers::record3d, "metadata", &["Record3D", "metadata"]),
        (writers::scannet, "depth", &["ScanNet", "depth/"]),
        (writers::rtabmap, "scan_camera_poses.txt", &["RTAB-Map", "poses"]),
    ];
    for (write, gone, words) in cases {
        with_import(without(write, gone), |found| {
            let message = found.unwrap_err().to_string();
            assert!(words.iter().all(|word| message.contains(word)), "without {gone}: {message}");
        });
    }
    let pictures_alone = |out: &Out| {
        out.put(
            "transforms.json",
            r#"{"fl_x": 100, "frames": [{"file_path": "a.png", "transform_matrix": []}]}"#,
        );
    };
    with_import(pictures_alone, |found| {
        assert!(found.unwrap_err().to_string().contains("no depth_file_path"));
    });
    let fisheye = |out: &Out| {
        out.put(
            "transforms.json",
            r#"{"camera_model": "OPENCV_FISHEYE", "fl_x": 100, "frames": []}"#,
        );
    };
    with_import(fisheye, |found| {
        assert!(found.unwrap_err().to_string().contains("OPENCV_FISHEYE"));
    });
    let colmap = |out: &Out| out.put("sparse/0/cameras.bin", [0; 8]);
    with_import(colmap, |found| assert!(found.unwrap_err().to_string().contains("COLMAP")));
}

#[test]
fn picture_sizes_match_the_file_headers() {
    with_import(writers::plain, |found| {
        let frame = found.unwrap().frames.remove(0);
        assert_eq!(frame.decode_color().unwrap().dimensions(), (CAMERA.width, CAMERA.height));
    });
}
