//! Scans with mistakes that people make: each is found and named.

use crate::room::{self, CAMERA, FRAMES, pose};
use crate::with_import;
use crate::writers::{self, Out};
use nalgebra::Vector3;
use uniground_geometry::scene::Intrinsics;
use uniground_types::findings::{Finding, FindingSubject};

/// Replaces the poses of the plain layout.
fn replace_poses(out: &Out, pose_of: impl Fn(usize) -> nalgebra::Matrix4<f64>) {
    writers::plain(out);
    (0..FRAMES).for_each(|i| out.put(&format!("pose/{i}.txt"), room::rows(&pose_of(i))));
}

fn moved(i: usize, by: [f64; 3]) -> nalgebra::Matrix4<f64> {
    nalgebra::Matrix4::new_translation(&Vector3::from(by)) * writers::matrix(&pose(i))
}

/// Returns the warnings of a scan about what its frames show.
fn warnings(write: impl Fn(&Out)) -> Vec<String> {
    with_import(write, |found| {
        let subjects = [FindingSubject::Poses, FindingSubject::Frames, FindingSubject::Camera];
        let about = |f: &Finding| f.warning && subjects.contains(&f.about);
        found.unwrap().report.findings.into_iter().filter(about).map(|f| f.text).collect()
    })
}

#[test]
fn frames_that_contradict_the_others_are_named() {
    assert_eq!(warnings(writers::plain), [""; 0]);
    let one = warnings(|out| {
        replace_poses(out, |i| moved(i, if i == 5 { [0.6, 0.5, 0.0] } else { [0.0; 3] }));
    });
    assert!(
        one.iter().any(|w| w.starts_with("at least 1 of 12") && w.ends_with("color/5.jpg")),
        "{one:?}"
    );
    let depth = warnings(|out| {
        writers::plain(out);
        out.pictures(5, ("color/5.jpg", "depth/5.png"), &CAMERA, &CAMERA, 0.001 / 1.4);
    });
    assert!(depth.iter().any(|w| w.ends_with("color/5.jpg")), "{depth:?}");
    let every_second = warnings(|out| {
        replace_poses(out, |i| moved(i, if i % 2 == 0 { [0.0; 3] } else { [0.6, 0.5, 0.0] }));
    });
    assert!(every_second.iter().any(|w| w.contains("contradict")), "{every_second:?}");
}

#[test]
fn causes_of_wrong_poses_are_named() {
    let shifted =
        warnings(|out| replace_poses(out, |i| writers::matrix(&pose((i + 1).min(FRAMES - 1)))));
    assert!(shifted.iter().any(|w| w.contains("the pose of the previous one")), "{shifted:?}");
    let scalar_first = |out: &Out| {
        writers::plain(out);
        for i in 0..FRAMES {
            let (p, q) = (pose(i).translation.vector, pose(i).rotation.coords);
            let line = [p.x, p.y, p.z, q.w, q.x, q.y, q.z].map(|v| v.to_string()).join(" ");
            out.put(&format!("pose/{i}.txt"), line);
        }
    };
    with_import(scalar_first, |found| {
        let message = match found {
            Ok(found) => found.report.warnings.join("; "),
            Err(error) => error.to_string(),
        };
        assert!(message.contains("write them as x y z w"), "{message}");
    });
    let by_columns = |out: &Out| replace_poses(out, |i| writers::matrix(&pose(i)).transpose());
    with_import(by_columns, |found| {
        let message = found.map(|found| found.report).unwrap_err().to_string();
        assert!(message.contains("write matrices row by row"), "{message}");
    });
}

/// A single view agrees with itself under any convention.
#[test]
fn copies_of_one_frame_check_nothing() {
    let copies = warnings(|out| {
        writers::plain(out);
        for i in 1..FRAMES {
            out.pictures(
                0,
                (&format!("color/{i}.jpg"), &format!("depth/{i}.png")),
                &CAMERA,
                &CAMERA,
                0.001,
            );
            out.put(&format!("pose/{i}.txt"), room::rows(&writers::matrix(&pose(0))));
        }
    });
    assert!(copies.iter().any(|w| w.starts_with("all 12 frames are taken from")), "{copies:?}");
    let single = warnings(|out| {
        out.put("intrinsic.txt", writers::camera_matrix(&CAMERA));
        out.pictures(0, ("color/0.jpg", "depth/0.png"), &CAMERA, &CAMERA, 0.001);
        out.put("pose/0.txt", room::rows(&writers::matrix(&pose(0))));
    });
    assert!(single.iter().any(|w| w.starts_with("there is only one frame")), "{single:?}");
}

#[test]
fn depth_pictures_without_a_measurement_are_named() {
    let empty = |out: &Out, i: usize| {
        let nothing = image::ImageBuffer::<image::Luma<u16>, _>::new(CAMERA.width, CAMERA.height);
        let picture = room::encoded(&nothing.into(), image::ImageFormat::Png);
        out.put(&format!("depth/{i}.png"), picture);
    };
    let one = warnings(|out| {
        writers::plain(out);
        empty(out, 3);
    });
    assert!(
        one.iter().any(|w| w.contains("no measurement") && w.ends_with("color/3.jpg")),
        "{one:?}"
    );
    let all = |out: &Out| {
        writers::plain(out);
        (0..FRAMES).for_each(|i| empty(out, i));
    };
    with_import(all, |found| {
        let message = found.map(|found| found.report).unwrap_err().to_string();
        assert!(message.contains("the depth pictures have no measurement"), "{message}");
    });
    let doubtful = |out: &Out| {
        writers::plain(out);
        let none = image::GrayImage::new(CAMERA.width, CAMERA.height);
        let picture = room::encoded(&none.into(), image::ImageFormat::Png);
        (0..FRAMES).for_each(|i| out.put(&format!("confidence/{i}.png"), &picture));
    };
    with_import(doubtful, |found| {
        let message = found.map(|found| found.report).unwrap_err().to_string();
        assert!(message.contains("no measurement above the confidence level 1"), "{message}");
    });
}

#[test]
fn two_scans_in_one_archive_are_named() {
    let write = |out: &Out| {
        writers::plain(&Out(&out.0.join("monday")));
        writers::plain(&Out(&out.0.join("tuesday")));
    };
    with_import(write, |found| {
        let message = found.map(|found| found.report).unwrap_err().to_string();
        assert!(message.contains("2 scans (monday/, tuesday/)"), "{message}");
    });
}

#[test]
fn intrinsics_for_another_picture_size_are_explained() {
    let write = |out: &Out| {
        writers::plain(out);
        out.put("intrinsic.txt", writers::camera_matrix(&CAMERA.scaled_to(640, 480)));
    };
    with_import(write, |found| {
        let message = found.map(|found| found.report).unwrap_err().to_string();
        assert!(
            message.contains("scale intrinsics that are for another picture size"),
            "{message}"
        );
    });
}

/// Opening a pipe would wait for ever.
#[test]
fn pipes_in_a_folder_are_skipped() {
    with_import(
        |out| {
            writers::plain(out);
            for name in ["notes.png", "color/99.jpg", "cloud.ply"] {
                let made = std::process::Command::new("mkfifo").arg(out.0.join(name)).status();
                assert!(made.unwrap().success());
            }
        },
        |found| assert_eq!(found.unwrap().frames.len(), FRAMES),
    );
}

/// Depth that is cut off agrees with itself wherever the cameras are.
#[test]
fn depth_that_is_cut_off_is_named_and_not_compared() {
    let cut = |out: &Out| {
        writers::plain(out);
        for i in 0..FRAMES {
            let millimeters = room::depth_m(&CAMERA, &pose(i))
                .into_iter()
                .map(|z| (z.min(1.6) * 1000.0).round() as u16)
                .collect();
            let picture = image::ImageBuffer::<image::Luma<u16>, Vec<u16>>::from_raw(
                CAMERA.width,
                CAMERA.height,
                millimeters,
            );
            let picture = room::encoded(&picture.unwrap().into(), image::ImageFormat::Png);
            out.put(&format!("depth/{i}.png"), picture);
        }
    };
    let found = warnings(cut);
    assert!(found.iter().any(|w| w.contains("one value (1.600 m)")), "{found:?}");
    assert!(!found.iter().any(|w| w.contains("which is used")), "{found:?}");
}

#[test]
fn frames_in_other_coordinates_are_named() {
    let parts = warnings(|out| {
        replace_poses(out, |i| moved(i, if i < 6 { [0.0; 3] } else { [50.0, 0.0, 0.0] }));
    });
    assert!(parts.iter().any(|w| w.contains("in 2 parts that never see")), "{parts:?}");
    let overlapping = warnings(|out| {
        replace_poses(out, |i| moved(i, if i < 6 { [0.0; 3] } else { [1.1, 0.8, 0.5] }));
    });
    assert!(
        overlapping.iter().any(|w| w.contains("in 2 parts that do not fit")),
        "{overlapping:?}"
    );
}

#[test]
fn copies_of_pictures_are_named() {
    let found = warnings(|out| {
        writers::plain(out);
        std::fs::copy(out.0.join("color/2.jpg"), out.0.join("color/7.jpg")).unwrap();
    });
    let expected = "1 of 12 frames repeat the color picture of another one";
    assert!(found.iter().any(|w| w.starts_with(expected)), "{found:?}");
}

/// A single odd picture must not decide about the intrinsics of all.
#[test]
fn intrinsics_belong_to_the_most_frequent_picture_size() {
    let write = |out: &Out| {
        writers::plain(out);
        let small = CAMERA.scaled_to(80, 60);
        out.pictures(0, ("color/0.jpg", "depth/unused.png"), &small, &small, 0.001);
        std::fs::remove_file(out.0.join("depth/unused.png")).unwrap();
    };
    with_import(write, |found| {
        let report = found.unwrap().report;
        assert!(report.reprojection_agreement.unwrap() > 0.8, "{report:?}");
    });
}

#[test]
fn a_cloud_of_another_unit_or_place_is_named() {
    let shifted = |out: &Out, by: f64, scale: f64| {
        writers::plain_with_cloud(out, 0.001);
        let points: crate::room::Points = room::cloud()
            .into_iter()
            .map(|(p, c)| (nalgebra::Point3::new(p.x * scale + by, p.y * scale, p.z * scale), c))
            .collect();
        out.put("cloud.ply", crate::clouds::ply(&points));
    };
    let about_cloud = |by: f64, scale: f64| {
        with_import(
            |out: &Out| shifted(out, by, scale),
            |found| match found {
                Ok(found) => found.report.warnings.join("; "),
                Err(error) => error.to_string(),
            },
        )
    };
    assert!(!about_cloud(0.0, 1.0).contains("cloud"), "{}", about_cloud(0.0, 1.0));
    assert!(about_cloud(0.8, 1.0).contains("fit each other"), "{}", about_cloud(0.8, 1.0));
    assert!(about_cloud(0.0, 1000.0).contains("another unit"), "{}", about_cloud(0.0, 1000.0));
}

/// Draws all color pictures again, changed.
fn redraw(out: &Out, change: impl Fn(usize, image::RgbImage) -> image::RgbImage) {
    for i in 0..FRAMES {
        let picture = change(i, room::color(&CAMERA, &pose(i)).into_rgb8());
        out.put(
            &format!("color/{i}.jpg"),
            room::encoded(&picture.into(), image::ImageFormat::Jpeg),
        );
    }
}

#[test]
fn color_pictures_of_something_else_are_named() {
    use image::imageops::{flip_horizontal, rotate180};
    let drawn = |change: fn(usize, image::RgbImage) -> image::RgbImage| {
        warnings(|out| {
            writers::plain(out);
            redraw(out, change);
        })
    };
    assert_eq!(drawn(|_, picture| picture), [""; 0]);
    let mirrored = drawn(|_, picture| flip_horizontal(&picture));
    assert!(mirrored.iter().any(|w| w.contains("were mirrored left to right")), "{mirrored:?}");
    let upside_down = drawn(|_, picture| rotate180(&picture));
    assert!(upside_down.iter().any(|w| w.contains("rotated by 180 degrees")), "{upside_down:?}");
    let mixed_up = drawn(|i, _| room::color(&CAMERA, &pose((i * 5 + 3) % FRAMES)).into_rgb8());
    assert!(mixed_up.iter().any(|w| w.contains("do not fit the depth")), "{mixed_up:?}");
    let one = drawn(|i, picture| if i == 4 { rotate180(&picture) } else { picture });
    let of_another = "the color pictures of 1 of 12 compared frames";
    assert!(one.iter().any(|w| w.starts_with(of_another) && w.ends_with("color/4.jpg")), "{one:?}");
    let swapped = drawn(|i, mut picture| {
        picture.pixels_mut().filter(|_| i == 4).for_each(|p| p.0.reverse());
        picture
    });
    assert!(
        swapped.iter().any(|w| w.starts_with("red, green and") && w.ends_with("color/4.jpg")),
        "{swapped:?}"
    );
}

/// Returns a color picture whose brightness is a wave in the world.
fn wave(frame: usize) -> image::RgbImage {
    let (camera, depth_m) = (CAMERA, room::depth_m(&CAMERA, &pose(frame)));
    image::RgbImage::from_fn(camera.width, camera.height, |u, v| {
        let z = f64::from(depth_m[(v * camera.width + u) as usize]);
        let x = (f64::from(u) - f64::from(camera.cx)) / f64::from(camera.fx) * z;
        let y = (f64::from(v) - f64::from(camera.cy)) / f64::from(camera.fy) * z;
        let at = pose(frame) * nalgebra::Point3::new(x, y, z);
        let height = (4.0 * at.x).sin() + (4.0 * at.y).sin() + (4.0 * at.z).sin();
        image::Rgb([(128.0 + 40.0 * height) as u8; 3])
    })
}

#[test]
fn cropped_color_pictures_are_named() {
    use image::imageops::{FilterType, crop_imm, resize};
    let drawn = |change: fn(image::RgbImage) -> image::RgbImage| {
        warnings(|out| {
            writers::plain(out);
            redraw(out, |i, _| change(wave(i)));
        })
    };
    let cropped = drawn(|picture| {
        let (width, height) = picture.dimensions();
        let (x, y) = (width / 10, height / 10);
        let inner = crop_imm(&picture, x, y, width - 2 * x, height - 2 * y).to_image();
        resize(&inner, width, height, FilterType::Triangle)
    });
    assert!(cropped.iter().any(|w| w.contains("enlarged 0.8 times")), "{cropped:?}");
    let whole = drawn(|picture| picture);
    assert!(!whole.iter().any(|w| w.contains("another scale")), "{whole:?}");
}

#[test]
fn color_pictures_without_color_are_named() {
    let drawn = |change: fn(usize, [u8; 3]) -> [u8; 3]| {
        warnings(|out| {
            writers::plain(out);
            redraw(out, |i, mut picture| {
                picture.pixels_mut().for_each(|p| p.0 = change(i, p.0));
                picture
            });
        })
    };
    let gray = drawn(|_, [r, g, b]| [(u16::from(r) + u16::from(g) + u16::from(b)) as u8 / 3; 3]);
    assert!(gray.iter().any(|w| w.starts_with("the color pictures are gray")), "{gray:?}");
    let dark = drawn(|_, color| color.map(|c| c / 16));
    assert!(
        dark.iter().any(|w| w.contains("12 of 12 examined color pictures are nearly")),
        "{dark:?}"
    );
    let white = drawn(|_, _| [255; 3]);
    assert!(white.iter().any(|w| w.contains("show a single color")), "{white:?}");
    let bright = drawn(|_, color| if color[0] > 140 { [255; 3] } else { color });
    assert!(bright.iter().any(|w| w.contains("are overexposed")), "{bright:?}");
    let some = drawn(|i, [r, _, b]| if i < 3 { [r; 3] } else { [r, 120, b] });
    assert!(
        some.iter().any(|w| w.starts_with("3 of 12 examined color pictures are gray")),
        "{some:?}"
    );
    let single = drawn(|i, color| if i == 7 { [0; 3] } else { color });
    assert_eq!(single, ["1 of 12 examined color pictures show a single color: color/7.jpg"]);
    let depth = warnings(|out| {
        writers::plain(out);
        for i in 0..FRAMES {
            let levels = room::depth_m(&CAMERA, &pose(i)).into_iter().map(|z| (z * 60.0) as u8);
            let (width, height) = (CAMERA.width, CAMERA.height);
            let picture = image::GrayImage::from_raw(width, height, levels.collect()).unwrap();
            out.put(
                &format!("color/{i}.jpg"),
                room::encoded(&picture.into(), image::ImageFormat::Jpeg),
            );
        }
    });
    assert!(depth.iter().any(|w| w.starts_with("the color pictures show depth")), "{depth:?}");
}

/// Errors that all frames share leave them in rough agreement.
#[test]
fn errors_that_all_frames_share_are_named() {
    let roughly = |write: &dyn Fn(&Out)| {
        with_import(write, |found| {
            found.unwrap().report.warnings.into_iter().find(|w| w.contains("compared points"))
        })
        .unwrap_or_default()
    };
    let depth_with = |out: &Out, change: &dyn Fn(f32, u32, u32) -> f32| {
        writers::plain(out);
        for i in 0..FRAMES {
            let picture =
                image::ImageBuffer::<image::Luma<u16>, _>::from_fn(CAMERA.width, CAMERA.height, {
                    let depth_m = room::depth_m(&CAMERA, &pose(i));
                    move |u, v| {
                        let z = depth_m[(v * CAMERA.width + u) as usize];
                        image::Luma([(change(z, u, v) * 1000.0).round() as u16])
                    }
                });
            out.put(
                &format!("depth/{i}.png"),
                room::encoded(&picture.into(), image::ImageFormat::Png),
            );
        }
    };
    assert_eq!(roughly(&|out| depth_with(out, &|z, _, _| z)), "");
    let along_ray = roughly(&|out| {
        depth_with(out, &|z, u, v| {
            let (x, y) = ((u as f32 - CAMERA.cx) / CAMERA.fx, (v as f32 - CAMERA.cy) / CAMERA.fy);
            z * (1.0 + x * x + y * y).sqrt()
        });
    });
    assert!(along_ray.contains("distances along the ray"), "{along_ray}");
    let scaled = roughly(&|out| depth_with(out, &|z, _, _| z / 1.25));
    assert!(scaled.contains("depth is multiplied by about 1.25"), "{scaled}");
    let focal = roughly(&|out| {
        writers::plain(out);
        let longer = Intrinsics { fx: CAMERA.fx * 1.25, fy: CAMERA.fy * 1.25, ..CAMERA };
        out.put("intrinsic.txt", writers::camera_matrix(&longer));
    });
    assert!(focal.contains("the focal length is multiplied by about 0.8"), "{focal}");
}

#[test]
fn depth_that_marks_no_measurement_is_named() {
    let marked = warnings(|out| {
        writers::plain(out);
        for i in 0..FRAMES {
            let mut depth = room::depth(&CAMERA, &pose(i), 0.001).into_luma16();
            let corner = |x: u32, y: u32| x < CAMERA.width / 8 && y < CAMERA.height / 4;
            depth
                .enumerate_pixels_mut()
                .filter(|(x, y, _)| corner(*x, *y))
                .for_each(|(_, _, p)| p.0 = [20_000]);
            out.put(
                &format!("depth/{i}.png"),
                room::encoded(&depth.into(), image::ImageFormat::Png),
            );
        }
    });
    assert!(marked.iter().any(|w| w.contains("one value (20.000 m)")), "{marked:?}");
}

#[test]
fn clouds_of_other_colors_or_extent_are_named() {
    let about_cloud = |change: &dyn Fn(crate::room::Points) -> crate::room::Points| {
        with_import(
            |out: &Out| {
                writers::plain_with_cloud(out, 0.001);
                out.put("cloud.ply", crate::clouds::ply(&change(room::cloud())));
            },
            |found| found.unwrap().report.warnings.join("; "),
        )
    };
    let recolored = |change: fn([u8; 3], usize) -> [u8; 3]| {
        about_cloud(&|points| {
            points.into_iter().enumerate().map(|(i, (p, c))| (p, change(c, i))).collect()
        })
    };
    assert_eq!(recolored(|color, _| color), recolored(|color, _| color.map(|c| c / 2 + 40)));
    let swapped = recolored(|[r, g, b], _| [b, g, r]);
    assert!(swapped.contains("red, green and blue have another order"), "{swapped}");
    let labels = recolored(|_, i| [[200, 30, 30], [30, 200, 30], [240, 240, 200]][i / 500 % 3]);
    assert!(labels.contains("not those of the color pictures"), "{labels}");
    let half = about_cloud(&|points| points.into_iter().filter(|(p, _)| p.x < -1.2).collect());
    assert!(half.contains("of the surfaces that the frames show"), "{half}");
    let beside = about_cloud(&|points| {
        points.into_iter().map(|(p, c)| (p + Vector3::new(0.12, 0.1, 0.06), c)).collect()
    });
    assert!(beside.contains("the cloud lies beside the surfaces"), "{beside}");
}

#[test]
fn a_camera_matrix_written_by_columns_is_read() {
    let by_columns = warnings(|out| {
        writers::plain(out);
        let c = CAMERA;
        let matrix = format!("{} 0 0\n0 {} 0\n{} {} 1\n", c.fx, c.fy, c.cx, c.cy);
        out.put("intrinsic.txt", matrix);
    });
    assert_eq!(by_columns, [""; 0]);
}

#[test]
fn pictures_rotated_against_their_intrinsics_are_explained() {
    let rotated = warnings(|out| {
        writers::plain(out);
        let picture = image::imageops::rotate90(&room::color(&CAMERA, &pose(3)).into_rgb8());
        out.put("color/3.jpg", room::encoded(&picture.into(), image::ImageFormat::Jpeg));
    });
    assert!(rotated.iter().any(|w| w.contains("rotated by 90 degrees")), "{rotated:?}");
}
