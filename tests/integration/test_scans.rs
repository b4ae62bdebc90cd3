//! Small synthetic scans for tests: a ray-cast room with a few boxes, which parses quickly.

use std::collections::BTreeMap;
use std::io::{Cursor, Write};

const WIDTH: u32 = 120;
const HEIGHT: u32 = 90;
const FOCAL: f32 = 100.0;

/// An axis-aligned box in a room: minimum, maximum, color.
pub type Thing = ([f32; 3], [f32; 3], [u8; 3]);

/// The boxes of the test room.
pub const THINGS: [Thing; 4] = [
    ([-2.5, -2.5, -0.05], [2.5, 2.5, 0.0], [150, 130, 110]),
    // A red sofa, a blue box, a green trash can.
    ([-1.0, 0.6, 0.0], [1.0, 1.5, 0.8], [190, 30, 30]),
    ([0.8, -0.9, 0.0], [1.3, -0.5, 0.4], [30, 60, 190]),
    ([-1.3, -1.0, 0.0], [-1.0, -0.7, 0.4], [30, 150, 50]),
];

/// Eight camera positions around a room, as fractions of a full turn.
pub const EIGHTHS: [f32; 8] = [0.0, 0.125, 0.25, 0.375, 0.5, 0.625, 0.75, 0.875];

/// The files of a scan, by name. Tests modify single files.
#[derive(Clone)]
pub struct Scan(pub BTreeMap<String, Vec<u8>>);

impl Scan {
    /// Returns a scan in the layout `color/ depth/ pose/ intrinsic.txt`, without a cloud.
    pub fn frames_only() -> Self {
        Self::of_room(&THINGS, &EIGHTHS)
    }

    /// Renders these boxes from the given camera positions, as fractions of a full turn.
    pub fn of_room(things: &[Thing], around: &[f32]) -> Self {
        let mut files = BTreeMap::new();
        files.insert("intrinsic.txt".into(), intrinsics().into_bytes());
        for (i, share) in around.iter().enumerate() {
            let pose = pose(share * std::f32::consts::TAU);
            let (color, depth) = render(things, &pose);
            files.insert(format!("color/{i}.png"), color);
            files.insert(format!("depth/{i}.png"), depth);
            files.insert(format!("pose/{i}.txt"), format_pose(&pose).into_bytes());
        }
        Self(files)
    }

    /// Returns the same frames with a manifest instead of the folder convention.
    pub fn neutral() -> Self {
        let mut scan = Self::frames_only();
        scan.0.remove("intrinsic.txt");
        let frames: Vec<_> = (0..8)
            .map(|i| serde_json::json!({"color": format!("color/{i}.png"), "depth": format!("depth/{i}.png"), "pose": format!("pose/{i}.txt")}))
            .collect();
        let manifest = serde_json::json!({
            "format": "uniground-scene/1", "name": "test room", "up": "z",
            "intrinsics": {"width": WIDTH, "height": HEIGHT, "fx": FOCAL, "fy": FOCAL, "cx": 59.5, "cy": 44.5},
            "frames": frames,
        });
        scan.0.insert("scene.json".into(), serde_json::to_vec(&manifest).unwrap());
        scan
    }

    /// Returns a scan that is only a cloud.
    pub fn cloud_only() -> Self {
        Self(BTreeMap::from([("cloud.ply".into(), cloud())]))
    }

    pub fn with(mut self, name: &str, content: impl Into<Vec<u8>>) -> Self {
        self.0.insert(name.into(), content.into());
        self
    }

    pub fn without(mut self, name: &str) -> Self {
        assert!(self.0.remove(name).is_some(), "the scan has no {name}");
        self
    }

    /// Replaces a piece of a text file. Panics if it is not in the file.
    pub fn edit(mut self, name: &str, from: &str, to: &str) -> Self {
        let text = String::from_utf8(self.0[name].clone()).unwrap();
        assert!(text.contains(from), "{name} does not hold {from:?}");
        self.0.insert(name.into(), text.replace(from, to).into_bytes());
        self
    }

    pub fn zip(&self) -> Vec<u8> {
        let mut zip = zip::ZipWriter::new(Cursor::new(Vec::new()));
        for (name, content) in &self.0 {
            zip.start_file(name.as_str(), zip::write::SimpleFileOptions::default()).unwrap();
            zip.write_all(content).unwrap();
        }
        zip.finish().unwrap().into_inner()
    }

    pub fn tar(&self) -> Vec<u8> {
        let mut tar = tar::Builder::new(Vec::new());
        for (name, content) in &self.0 {
            let mut header = tar::Header::new_gnu();
            header.set_size(content.len() as u64);
            header.set_mode(0o644);
            tar.append_data(&mut header, name, &content[..]).unwrap();
        }
        tar.into_inner().unwrap()
    }

    pub fn tar_zst(&self) -> Vec<u8> {
        zstd::encode_all(&self.tar()[..], 3).unwrap()
    }
}

pub fn intrinsics() -> String {
    format!("{FOCAL} 0 59.5\n0 {FOCAL} 44.5\n0 0 1\n")
}

/// Returns camera-to-world columns (right, down, forward, position) at an angle around the room,
/// looking at its center.
type Pose = [[f32; 3]; 4];

fn pose(angle: f32) -> Pose {
    let position = [2.2 * angle.cos(), 2.2 * angle.sin(), 1.7];
    let to_middle = [-position[0], -position[1], 0.3 - position[2]];
    let length = to_middle.iter().map(|v| v * v).sum::<f32>().sqrt();
    let forward = to_middle.map(|v| v / length);
    let flat = forward[0].hypot(forward[1]);
    let right = [forward[1] / flat, -forward[0] / flat, 0.0];
    let down = [
        forward[1] * right[2] - forward[2] * right[1],
        forward[2] * right[0] - forward[0] * right[2],
        forward[0] * right[1] - forward[1] * right[0],
    ];
    [right, down, forward, position]
}

fn format_pose(pose: &Pose) -> String {
    let row = |i: usize| {
        format!("{:.6} {:.6} {:.6} {:.6}\n", pose[0][i], pose[1][i], pose[2][i], pose[3][i])
    };
    format!("{}{}{}0 0 0 1\n", row(0), row(1), row(2))
}

/// Renders the color and depth images as PNG.
fn render(things: &[Thing], pose: &Pose) -> (Vec<u8>, Vec<u8>) {
    let mut color = image::RgbImage::new(WIDTH, HEIGHT);
    let mut depth = image::ImageBuffer::<image::Luma<u16>, _>::new(WIDTH, HEIGHT);
    for v in 0..HEIGHT {
        for u in 0..WIDTH {
            let (x, y) = ((u as f32 - 59.5) / FOCAL, (v as f32 - 44.5) / FOCAL);
            let ray: [f32; 3] =
                std::array::from_fn(|i| pose[0][i] * x + pose[1][i] * y + pose[2][i]);
            // The ray has length 1 along the optical axis, so its parameter is the depth.
            if let Some((z, rgb)) = nearest_box(things, &pose[3], &ray) {
                color.put_pixel(u, v, image::Rgb(rgb));
                depth.put_pixel(u, v, image::Luma([(z * 1000.0).round() as u16]));
            }
        }
    }
    let png = |image: image::DynamicImage| {
        let mut bytes = Cursor::new(Vec::new());
        image.write_to(&mut bytes, image::ImageFormat::Png).unwrap();
        bytes.into_inner()
    };
    (png(color.into()), png(depth.into()))
}

/// Returns the nearest box along a ray: depth and shaded color.
fn nearest_box(things: &[Thing], origin: &[f32; 3], ray: &[f32; 3]) -> Option<(f32, [u8; 3])> {
    let enter = |(min, max, rgb): &Thing| {
        let (mut near, mut far, mut side) = (0.0_f32, f32::INFINITY, 0);
        for i in 0..3 {
            let (a, b) = ((min[i] - origin[i]) / ray[i], (max[i] - origin[i]) / ray[i]);
            if a.min(b) > near {
                near = a.min(b);
                side = i;
            }
            far = far.min(a.max(b));
        }
        let shade = [0.85, 0.92, 1.0][side];
        (near < far && near > 0.0).then(|| (near, rgb.map(|c| (f32::from(c) * shade) as u8)))
    };
    things.iter().filter_map(enter).min_by(|a, b| a.0.total_cmp(&b.0))
}

/// Returns the boxes' visible sides as a binary PLY, with points two centimeters apart.
pub fn cloud() -> Vec<u8> {
    let mut rows = Vec::new();
    let mut count = 0;
    for (min, max, rgb) in THINGS {
        let steps = |i: usize| ((max[i] - min[i]) / 0.02).round().max(1.0) as usize;
        let at = |i: usize, k: usize| min[i] + (max[i] - min[i]) * k as f32 / steps(i) as f32;
        for i in 0..=steps(0) {
            for j in 0..=steps(1) {
                for k in 0..=steps(2) {
                    let side = i == 0 || i == steps(0) || j == 0 || j == steps(1);
                    if k == steps(2) || (side && max[2] > 0.01) {
                        [at(0, i), at(1, j), at(2, k)]
                            .iter()
                            .for_each(|c| rows.extend(c.to_le_bytes()));
                        rows.extend(rgb);
                        count += 1;
                    }
                }
            }
        }
    }
    let mut ply = ply_header(count);
    ply.extend(rows);
    ply
}

pub fn ply_header(count: usize) -> Vec<u8> {
    let properties = "property float x\nproperty float y\nproperty float z\nproperty uchar red\nproperty uchar green\nproperty uchar blue\n";
    format!(
        "ply\nformat binary_little_endian 1.0\nelement vertex {count}\n{properties}end_header\n"
    )
    .into_bytes()
}
