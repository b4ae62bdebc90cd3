//! Writers of the small room, one for every supported layout.

use super::room::{CAMERA, FRAMES, color, depth, depth_m, encoded, opengl, pose, rows, y_up};
use camino::Utf8Path;
use image::ImageFormat::{Jpeg, Png, Pnm};
use nalgebra::{Isometry3, Matrix4, UnitQuaternion};
use serde_json::{Value, json};
use std::fmt::Write;
use std::fs;
use uniground_geometry::scene::Intrinsics;

/// The folder that a layout is written into.
pub struct Out<'a>(pub &'a Utf8Path);

impl Out<'_> {
    pub fn put(&self, name: &str, bytes: impl AsRef<[u8]>) {
        let path = self.0.join(name);
        fs::create_dir_all(path.parent().unwrap()).unwrap();
        fs::write(path, bytes).unwrap();
    }

    pub fn pictures(
        &self,
        frame: usize,
        (color_name, depth_name): (&str, &str),
        camera: &Intrinsics,
        depth_camera: &Intrinsics,
        scale_m: f32,
    ) {
        let kind = |name: &str| match Utf8Path::new(name).extension() {
            Some("jpg") => Jpeg,
            Some("pgm") => Pnm,
            _ => Png,
        };
        self.put(color_name, encoded(&color(camera, &pose(frame)), kind(color_name)));
        self.put(
            depth_name,
            encoded(&depth(depth_camera, &pose(frame), scale_m), kind(depth_name)),
        );
    }
}

fn half() -> Intrinsics {
    CAMERA.scaled_to(80, 60)
}

pub fn matrix(pose: &Isometry3<f64>) -> Matrix4<f64> {
    pose.to_homogeneous()
}

pub fn camera_matrix(c: &Intrinsics) -> String {
    format!("{} 0 {} 0\n0 {} {} 0\n0 0 1 0\n0 0 0 1\n", c.fx, c.cx, c.fy, c.cy)
}

/// Returns the position and the quaternion `x y z w`.
fn position_and_quaternion(m: &Matrix4<f64>) -> [f64; 7] {
    let rotation = UnitQuaternion::from_matrix(&m.fixed_view::<3, 3>(0, 0).into_owned());
    let q = rotation.coords;
    [m[(0, 3)], m[(1, 3)], m[(2, 3)], q.x, q.y, q.z, q.w]
}

pub fn plain(out: &Out) {
    out.put("intrinsic.txt", camera_matrix(&CAMERA));
    for i in 0..FRAMES {
        out.pictures(
            i,
            (&format!("color/{i}.jpg"), &format!("depth/{i}.png")),
            &CAMERA,
            &CAMERA,
            0.001,
        );
        out.put(&format!("pose/{i}.txt"), rows(&matrix(&pose(i))));
    }
}

/// Writes the plain layout with other folder names, padded numbers on one side only, and all poses
/// in one file.
pub fn plain_paired(out: &Out) {
    out.put("intrinsics.txt", camera_matrix(&CAMERA));
    let mut list = String::new();
    for i in 0..FRAMES {
        out.pictures(
            i,
            (&format!("rgb/frame_{i:05}.png"), &format!("depth/depth_{i}.png")),
            &CAMERA,
            &half(),
            0.001,
        );
        let _ = writeln!(list, "{}", rows(&matrix(&pose(i))).replace('\n', " "));
    }
    out.put("poses.txt", list);
}

/// Writes the plain layout with other depth files. `encode` receives meters, row-major.
fn plain_with_depth(out: &Out, ending: &str, encode: impl Fn(&Intrinsics, Vec<f32>) -> Vec<u8>) {
    plain(out);
    for i in 0..FRAMES {
        fs::remove_file(out.0.join(format!("depth/{i}.png"))).unwrap();
        out.put(&format!("depth/{i}.{ending}"), encode(&half(), depth_m(&half(), &pose(i))));
    }
}

/// Writes EXR depth as renderers do: next to color channels, and without values in one corner.
pub fn plain_exr(out: &Out) {
    plain_with_depth(out, "exr", |camera, mut depth| {
        (depth[0], depth[1], depth[2]) = (f32::INFINITY, 1e10, f32::NAN);
        exr_of(
            camera,
            [
                ("B", exr::image::FlatSamples::F16(vec![half::f16::ONE; depth.len()])),
                ("View.Z", exr::image::FlatSamples::F32(depth)),
            ],
        )
    });
}

pub fn plain_exr_halves(out: &Out) {
    plain_with_depth(out, "exr", |camera, depth| {
        let halves = depth.into_iter().map(half::f16::from_f32).collect();
        exr_of(camera, [("Y", exr::image::FlatSamples::F16(halves))])
    });
}

fn exr_of<const N: usize>(
    camera: &Intrinsics,
    channels: [(&'static str, exr::image::FlatSamples); N],
) -> Vec<u8> {
    use exr::prelude::{AnyChannel, AnyChannels, Image, WritableImage};
    let channels =
        channels.into_iter().map(|(name, samples)| AnyChannel::new(name, samples)).collect();
    let image = Image::from_channels(
        (camera.width as usize, camera.height as usize),
        AnyChannels::sort(channels),
    );
    let mut bytes = std::io::Cursor::new(Vec::new());
    image.write().non_parallel().to_buffered(&mut bytes).unwrap();
    bytes.into_inner()
}

pub fn plain_tiff(out: &Out) {
    plain_with_depth(out, "tiff", |camera, depth| {
        tiff_of::<tiff::encoder::colortype::Gray32Float>(camera, &depth)
    });
}

pub fn plain_tiff_millimeters(out: &Out) {
    plain_with_depth(out, "tif", |camera, depth| {
        let units: Vec<u16> = depth.into_iter().map(|z| (z * 1000.0).round() as u16).collect();
        tiff_of::<tiff::encoder::colortype::Gray16>(camera, &units)
    });
}

fn tiff_of<C: tiff::encoder::colortype::ColorType>(
    camera: &Intrinsics,
    numbers: &[C::Inner],
) -> Vec<u8>
where
    [C::Inner]: tiff::encoder::TiffValue,
{
    let mut bytes = std::io::Cursor::new(Vec::new());
    let mut encoder = tiff::encoder::TiffEncoder::new(&mut bytes).unwrap();
    encoder.write_image::<C>(camera.width, camera.height, numbers).unwrap();
    bytes.into_inner()
}

pub fn scannet(out: &Out) {
    out.put("intrinsic/intrinsic_color.txt", camera_matrix(&CAMERA));
    out.put("intrinsic/intrinsic_depth.txt", camera_matrix(&half()));
    // The files' world is rotated and shifted; the alignment file reverses that.
    let alignment = Isometry3::rotation(nalgebra::Vector3::z() * 0.7).to_homogeneous()
        * Matrix4::new_translation(&nalgebra::Vector3::new(1.0, 2.0, 0.1));
    let text = rows(&alignment).replace('\n', " ");
    out.put("scene0000_00.txt", format!("axisAlignment = {text}\ncolorHeight = 968\n"));
    let back = alignment.try_inverse().unwrap();
    for i in 0..FRAMES {
        out.pictures(
            i,
            (&format!("color/{}.jpg", i * 20), &format!("depth/{}.png", i * 20)),
            &CAMERA,
            &half(),
            0.001,
        );
        out.put(&format!("pose/{}.txt", i * 20), rows(&(back * matrix(&pose(i)))));
    }
}

pub fn tum(out: &Out) {
    // The benchmark's third Kinect, at a quarter of its size.
    let camera = Intrinsics { width: 640, height: 480, fx: 535.4, fy: 539.2, cx: 320.1, cy: 247.6 }
        .scaled_to(160, 120);
    let (mut rgb, mut deep, mut truth) =
        (String::new(), String::new(), String::from("# timestamp tx ty tz qx qy qz qw\n"));
    rgb.push_str(
        "# color images\n# file: 'rgbd_dataset_freiburg3_room.bag'\n# timestamp filename\n",
    );
    for i in 0..FRAMES {
        let time = 1_305_031_102.175_304 + i as f64 * 0.033;
        let (color, depth) =
            (format!("rgb/{time:.6}.png"), format!("depth/{:.6}.png", time + 0.006));
        out.pictures(i, (&color, &depth), &camera, &camera, 1.0 / 5000.0);
        let _ = writeln!(rgb, "{time:.6} {color}");
        let _ = writeln!(deep, "{:.6} {depth}", time + 0.006);
        let [x, y, z, qx, qy, qz, qw] = position_and_quaternion(&matrix(&pose(i)));
        let _ = writeln!(
            truth,
            "{:.4} {x:.7} {y:.7} {z:.7} {qx:.8} {qy:.8} {qz:.8} {qw:.8}",
            time + 0.003
        );
    }
    [("rgb.txt", rgb), ("depth.txt", deep), ("groundtruth.txt", truth)]
        .into_iter()
        .for_each(|(name, text)| out.put(name, text));
}

pub fn seven_scenes(out: &Out) {
    let camera = Intrinsics { width: 640, height: 480, fx: 585.0, fy: 585.0, cx: 320.0, cy: 240.0 }
        .scaled_to(160, 120);
    for i in 0..FRAMES {
        let name = format!("seq-01/frame-{i:06}");
        out.pictures(
            i,
            (&format!("{name}.color.png"), &format!("{name}.depth.png")),
            &camera,
            &camera,
            0.001,
        );
        out.put(&format!("{name}.pose.txt"), rows(&matrix(&pose(i))));
    }
}

pub fn three_rscan(out: &Out) {
    let text = |m: &Intrinsics| camera_matrix(m).replace('\n', " ");
    out.put(
        "sequence/_info.txt",
        format!(
            "m_versionNumber = 4\nm_colorWidth = 160\nm_colorHeight = 120\nm_depthWidth = 80\nm_depthHeight = 60\nm_depthShift = 1000\n\
             m_calibrationColorIntrinsic = {}\nm_calibrationDepthIntrinsic = {}\nm_frames.size = {FRAMES}\n",
            text(&CAMERA),
            text(&half())
        ),
    );
    for i in 0..FRAMES {
        let name = format!("sequence/frame-{i:06}");
        out.pictures(
            i,
            (&format!("{name}.color.jpg"), &format!("{name}.depth.pgm")),
            &CAMERA,
            &half(),
            0.001,
        );
        out.put(&format!("{name}.pose.txt"), rows(&matrix(&pose(i))));
    }
}

pub fn arkit_scenes(out: &Out) {
    let mut list = String::new();
    for i in 0..FRAMES {
        let time = 5000.1 + i as f64 * 0.1;
        let stem = format!("41069021_{time:.3}");
        let at = |folder: &str| format!("41069021_frames/{folder}/{stem}.png");
        out.pictures(i, (&at("lowres_wide"), &at("lowres_depth")), &CAMERA, &CAMERA, 0.001);
        out.put(
            &at("confidence"),
            encoded(&image::GrayImage::from_pixel(160, 120, image::Luma([2])).into(), Png),
        );
        let c = CAMERA;
        let later =
            format!("41069021_frames/lowres_wide_intrinsics/41069021_{:.3}.pincam", time + 0.001);
        out.put(&later, format!("160 120 {} {} {} {}", c.fx, c.fy, c.cx, c.cy));
        let w2c = pose(i).inverse();
        let (axis, t) = (w2c.rotation.scaled_axis(), w2c.translation.vector);
        let _ = writeln!(
            list,
            "{:.4} {:.9} {:.9} {:.9} {:.9} {:.9} {:.9}",
            time + 0.002,
            axis.x,
            axis.y,
            axis.z,
            t.x,
            t.y,
            t.z
        );
    }
    out.put("41069021_frames/lowres_wide.traj", list);
}

pub fn replica(out: &Out) {
    let c = CAMERA;
    out.put(
        "cam_params.json",
        json!({"camera": {"w": 160, "h": 120, "fx": c.fx, "fy": c.fy, "cx": c.cx, "cy": c.cy, "scale": 6553.5}}).to_string(),
    );
    let mut list = String::new();
    for i in 0..FRAMES {
        let at = |part: &str, ending: &str| format!("room0/results/{part}{i:06}.{ending}");
        out.pictures(i, (&at("frame", "jpg"), &at("depth", "png")), &CAMERA, &CAMERA, 1.0 / 6553.5);
        let _ = writeln!(list, "{}", rows(&matrix(&pose(i))).replace('\n', " "));
    }
    out.put("room0/traj.txt", list);
}

fn nested(m: &Matrix4<f64>) -> Vec<Vec<f64>> {
    m.row_iter().map(|row| row.iter().copied().collect()).collect()
}

pub fn nerfstudio(out: &Out) {
    let c = CAMERA;
    let frames: Vec<Value> = (0..FRAMES)
        .map(|i| {
            let (color, depth) = (format!("images/frame_{i:05}.png"), format!("depths/frame_{i:05}.png"));
            out.pictures(i, (&color, &depth), &CAMERA, &half(), 0.001);
            json!({"file_path": format!("./{color}"), "depth_file_path": depth, "transform_matrix": nested(&(matrix(&pose(i)) * opengl()))})
        })
        .collect();
    let transforms = json!({"camera_model": "OPENCV", "fl_x": c.fx, "fl_y": c.fy, "cx": c.cx, "cy": c.cy, "w": 160, "h": 120, "k1": 0.0, "frames": frames});
    out.put("transforms.json", transforms.to_string());
}

pub fn polycam(out: &Out) {
    for i in 0..FRAMES {
        let at = |folder: &str, ending: &str| {
            format!("keyframes/{folder}/{}.{ending}", 18_000_000_000_u64 + i as u64 * 333_333)
        };
        out.pictures(
            i,
            (&at("corrected_images", "jpg"), &at("depth", "png")),
            &CAMERA,
            &half(),
            0.001,
        );
        out.put(
            &at("confidence", "png"),
            encoded(&image::GrayImage::from_pixel(80, 60, image::Luma([255])).into(), Png),
        );
        let m = y_up() * matrix(&pose(i)) * opengl();
        let mut camera = json!({"width": 160, "height": 120, "fx": CAMERA.fx, "fy": CAMERA.fy, "cx": CAMERA.cx, "cy": CAMERA.cy, "blur_score": 90.0});
        for (r, c) in (0..3).flat_map(|r| (0..4).map(move |c| (r, c))) {
            camera[format!("t_{r}{c}")] = json!(m[(r, c)]);
        }
        out.put(&at("corrected_cameras", "json"), camera.to_string());
    }
}

/// Writes a Record3D scan in the world of the first camera, as the app does.
pub fn record3d(out: &Out) {
    let first = (matrix(&pose(0)) * opengl()).try_inverse().unwrap();
    let mut poses = Vec::new();
    for i in 0..FRAMES {
        out.put(&format!("rgbd/{i}.jpg"), encoded(&color(&CAMERA, &pose(i)), Jpeg));
        let floats: Vec<u8> =
            depth_m(&half(), &pose(i)).iter().flat_map(|z| z.to_le_bytes()).collect();
        let (mut depth, mut sure) = (Vec::new(), Vec::new());
        lzfse_rust::encode_bytes(&floats, &mut depth).unwrap();
        lzfse_rust::encode_bytes(&[2; 80 * 60], &mut sure).unwrap();
        out.put(&format!("rgbd/{i}.depth"), depth);
        out.put(&format!("rgbd/{i}.conf"), sure);
        let [x, y, z, qx, qy, qz, qw] =
            position_and_quaternion(&(first * matrix(&pose(i)) * opengl()));
        poses.push([qx, qy, qz, qw, x, y, z]);
    }
    let c = CAMERA;
    let k = [c.fx, 0.0, 0.0, 0.0, c.fy, 0.0, c.cx, c.cy, 1.0];
    out.put(
        "metadata",
        json!({"w": 160, "h": 120, "dw": 80, "dh": 60, "K": k, "fps": 30, "poses": poses})
            .to_string(),
    );
}

pub fn stray_scanner(out: &Out) {
    out.put(
        "camera_matrix.csv",
        format!("{}, 0, {}\n0, {}, {}\n0, 0, 1\n", CAMERA.fx, CAMERA.cx, CAMERA.fy, CAMERA.cy),
    );
    let mut odometry = String::from("timestamp, frame, x, y, z, qx, qy, qz, qw\n");
    for i in 0..FRAMES {
        out.pictures(
            i,
            (&format!("rgb/{i:06}.jpg"), &format!("depth/{i:06}.png")),
            &CAMERA,
            &half(),
            0.001,
        );
        let [x, y, z, qx, qy, qz, qw] = position_and_quaternion(&(y_up() * matrix(&pose(i))));
        let _ = writeln!(
            odometry,
            "{}, {i:06}, {x:.9}, {y:.9}, {z:.9}, {qx:.9}, {qy:.9}, {qz:.9}, {qw:.9}",
            100.0 + i as f64 / 60.0
        );
    }
    out.put("odometry.csv", odometry);
}

pub fn scanner_app(out: &Out) {
    for i in 0..FRAMES {
        out.pictures(
            i,
            (&format!("frame_{i:05}.jpg"), &format!("depth_{i:05}.png")),
            &CAMERA,
            &half(),
            0.001,
        );
        let m = y_up() * matrix(&pose(i)) * opengl();
        let flat: Vec<f64> = m.transpose().iter().copied().collect();
        let c = CAMERA;
        let taken = json!({"cameraPoseARFrame": flat, "intrinsics": [c.fx, 0.0, c.cx, 0.0, c.fy, c.cy, 0.0, 0.0, 1.0], "time": i});
        out.put(&format!("frame_{i:05}.json"), taken.to_string());
    }
    out.put("info.json", "{}");
}

pub fn open3d(out: &Out) {
    let camera = Intrinsics { width: 640, height: 480, fx: 525.0, fy: 525.0, cx: 319.5, cy: 239.5 }
        .scaled_to(160, 120);
    let mut log = String::new();
    for i in 0..FRAMES {
        out.pictures(
            i,
            (&format!("color/{i:05}.jpg"), &format!("depth/{i:05}.png")),
            &camera,
            &camera,
            0.001,
        );
        let _ = write!(log, "{i} {i} {}\n{}", i + 1, rows(&matrix(&pose(i))));
    }
    out.put("trajectory.log", log);
}

pub fn rtabmap(out: &Out) {
    let c = CAMERA;
    let mut poses = String::from("#timestamp x y z qx qy qz qw\n");
    for i in 0..FRAMES {
        let time = 1_600_000_000.25 + i as f64;
        out.pictures(
            i,
            (&format!("scan_rgb/{time:.6}.jpg"), &format!("scan_depth/{time:.6}.png")),
            &CAMERA,
            &half(),
            0.001,
        );
        let [x, y, z, qx, qy, qz, qw] = position_and_quaternion(&matrix(&pose(i)));
        let _ = writeln!(poses, "{time:.6} {x:.9} {y:.9} {z:.9} {qx:.9} {qy:.9} {qz:.9} {qw:.9}");
    }
    out.put("scan_camera_poses.txt", poses);
    out.put(
        "scan_calib/1600000000.250000.yaml",
        format!(
            "%YAML:1.0\n---\ncamera_name: phone\nimage_width: 160\nimage_height: 120\ncamera_matrix:\n   rows: 3\n   cols: 3\n   data: [ {}, 0., {}, 0.,\n       {}, {}, 0., 0., 1. ]\n",
            c.fx, c.cx, c.fy, c.cy
        ),
    );
}

/// RTAB-Map, whose pictures are named by the numbers at the end of the poses' lines.
pub fn rtabmap_by_number(out: &Out) {
    rtabmap(out);
    let poses = fs::read_to_string(out.0.join("scan_camera_poses.txt")).unwrap();
    let mut numbered = String::new();
    for (i, line) in poses.lines().enumerate() {
        match i {
            0 => numbered += "#timestamp x y z qx qy qz qw id\n",
            _ => writeln!(numbered, "{line} {}", i * 7).unwrap(),
        }
    }
    out.put("scan_camera_poses.txt", numbered);
    for folder in ["scan_rgb", "scan_depth"] {
        let mut names: Vec<_> =
            fs::read_dir(out.0.join(folder)).unwrap().map(|entry| entry.unwrap().path()).collect();
        names.sort();
        for (i, path) in names.iter().enumerate() {
            let ending = path.extension().unwrap().to_str().unwrap();
            fs::rename(path, path.with_file_name(format!("{}.{ending}", (i + 1) * 7))).unwrap();
        }
    }
}

/// The plain layout with named camera parameters.
pub fn plain_with_named_parameters(out: &Out) {
    plain(out);
    let Intrinsics { width, height, fx, fy, cx, cy } = CAMERA;
    fs::remove_file(out.0.join("intrinsic.txt")).unwrap();
    let camera = format!(
        "{{\"fx\": {fx}, \"fy\": {fy}, \"cx\": {cx}, \"cy\": {cy}, \"width\": {width}, \"height\": {height}}}"
    );
    out.put("intrinsics.json", camera);
}

/// The plain layout with folders in capitals, the camera in `K.txt`, and poses as positions and
/// quaternions.
pub fn plain_in_capitals(out: &Out) {
    plain(out);
    for i in 0..FRAMES {
        let numbers = position_and_quaternion(&matrix(&pose(i))).map(|v| format!("{v:.9}"));
        out.put(&format!("pose/{i}.txt"), numbers.join(" "));
    }
    // numpy prints brackets.
    let camera =
        format!("[[{} 0 {}]\n [0 {} {}]\n [0 0 1]]", CAMERA.fx, CAMERA.cx, CAMERA.fy, CAMERA.cy);
    out.put("intrinsic.txt", camera);
    for (from, to) in
        [("color", "Color"), ("depth", "Depth"), ("pose", "Pose"), ("intrinsic.txt", "K.txt")]
    {
        fs::rename(out.0.join(from), out.0.join(to)).unwrap();
    }
}

/// nerfstudio, as programs on Windows write it: backslashes, and a byte order mark.
pub fn nerfstudio_on_windows(out: &Out) {
    nerfstudio(out);
    let file = out.0.join("transforms.json");
    let text = fs::read_to_string(&file).unwrap().replace('/', "\\\\");
    fs::write(file, format!("\u{feff}{text}")).unwrap();
}

/// A folder beside documents, with files that systems and editors add.
pub fn plain_beside_documents(out: &Out) {
    let folder = out.0.join("my room");
    plain(&Out(&folder));
    let intrinsics = folder.join("intrinsic.txt");
    let text = fs::read_to_string(&intrinsics).unwrap();
    fs::write(intrinsics, format!("\u{feff}{text}")).unwrap();
    for name in ["README.txt", "desktop.ini", "my room/Thumbs.db", "my room/color/Thumbs.db"] {
        out.put(name, "made by somebody");
    }
}

/// Polycam data of which its optimization corrected all frames but two.
pub fn polycam_partly_corrected(out: &Out) {
    polycam(out);
    for (corrected, original) in [("corrected_images", "images"), ("corrected_cameras", "cameras")]
    {
        let corrected = out.0.join("keyframes").join(corrected);
        let mut names: Vec<_> =
            corrected.read_dir_utf8().unwrap().map(|entry| entry.unwrap()).collect();
        names.sort_by_key(|entry| entry.file_name().to_owned());
        for (i, entry) in names.iter().enumerate() {
            let bytes = fs::read(entry.path()).unwrap();
            out.put(&format!("keyframes/{original}/{}", entry.file_name()), bytes);
            if i < 2 {
                fs::remove_file(entry.path()).unwrap();
            }
        }
    }
}

/// TUM's layout with the times of the poses in nanoseconds.
pub fn tum_nanoseconds(out: &Out) {
    tum(out);
    let file = out.0.join("groundtruth.txt");
    let text: String = fs::read_to_string(&file)
        .unwrap()
        .lines()
        .map(|line| match line.split_once(' ') {
            Some((time, rest)) if !line.starts_with('#') => {
                format!("{:.0} {rest}\n", time.parse::<f64>().unwrap() * 1e9)
            }
            _ => format!("{line}\n"),
        })
        .collect();
    fs::write(file, text).unwrap();
}

/// Writes the plain layout with another depth unit and a cloud in meters.
pub fn plain_with_cloud(out: &Out, scale_m: f32) {
    plain(out);
    let mut points = String::new();
    let mut count = 0;
    for i in 0..FRAMES {
        out.put(&format!("depth/{i}.png"), encoded(&depth(&CAMERA, &pose(i), scale_m), Png));
        let depth = depth_m(&CAMERA, &pose(i));
        for (at, z) in depth.iter().enumerate().step_by(23).filter(|(_, z)| **z > 0.0) {
            let (u, v) = (at as u32 % CAMERA.width, at as u32 / CAMERA.width);
            let point = pose(i).cast::<f32>() * CAMERA.unproject(u as f32, v as f32, *z);
            let _ = writeln!(points, "{} {} {} 120 110 100", point.x, point.y, point.z);
            count += 1;
        }
    }
    let header = format!(
        "ply\nformat ascii 1.0\nelement vertex {count}\nproperty float x\nproperty float y\nproperty float z\n\
         property uchar red\nproperty uchar green\nproperty uchar blue\nend_header\n"
    );
    out.put("cloud.ply", header + &points);
}

/// Writes Record3D's export as EXR and JPEG.
pub fn record3d_export(out: &Out) {
    let first = (matrix(&pose(0)) * opengl()).try_inverse().unwrap();
    let mut poses = Vec::new();
    for i in 0..FRAMES {
        out.put(&format!("EXR_RGBD/rgb/{i}.jpg"), encoded(&color(&CAMERA, &pose(i)), Jpeg));
        let depth = exr::image::FlatSamples::F32(depth_m(&half(), &pose(i)));
        out.put(&format!("EXR_RGBD/depth/{i}.exr"), exr_of(&half(), [("Y", depth)]));
        let [x, y, z, qx, qy, qz, qw] =
            position_and_quaternion(&(first * matrix(&pose(i)) * opengl()));
        poses.push([qx, qy, qz, qw, x, y, z]);
    }
    let c = CAMERA;
    let k = [c.fx, 0.0, 0.0, 0.0, c.fy, 0.0, c.cx, c.cy, 1.0];
    out.put(
        "EXR_RGBD/metadata.json",
        json!({"w": 160, "h": 120, "K": k, "fps": 60, "poses": poses}).to_string(),
    );
}

/// Writes `ScanNet`++ of an iPhone: every second frame is extracted, and poses are of all.
pub fn scannetpp(out: &Out) {
    let c = CAMERA;
    let mut entries = json!({});
    for i in 0..FRAMES {
        out.pictures(
            i,
            (
                &format!("iphone/rgb/frame_{:06}.jpg", 2 * i),
                &format!("iphone/depth/frame_{:06}.png", 2 * i),
            ),
            &CAMERA,
            &half(),
            0.001,
        );
        let m = matrix(&pose(i));
        let rows: Vec<Vec<f64>> =
            (0..4).map(|row| (0..4).map(|column| m[(row, column)]).collect()).collect();
        let entry = json!({
            "timestamp": i, "pose": rows, "aligned_pose": rows,
            "intrinsic": [[c.fx, 0.0, c.cx], [0.0, c.fy, c.cy], [0.0, 0.0, 1.0]],
        });
        entries[format!("frame_{:06}", 2 * i)] = entry.clone();
        entries[format!("frame_{:06}", 2 * i + 1)] = entry;
    }
    out.put("iphone/pose_intrinsic_imu.json", entries.to_string());
}
