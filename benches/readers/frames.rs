//! Posed images of an empty room, in any number.

use camino::Utf8Path;
use image::{DynamicImage, ImageBuffer, ImageFormat, Luma, Rgb, RgbImage};
use std::f32::consts::TAU;
use std::fs;
use std::io::Cursor;

const WIDTH: u32 = 640;
const HEIGHT: u32 = 480;
const FOCAL: f32 = 525.0;
/// Number of views around the room; frames repeat them.
const VIEWS: usize = 20;
/// Corners of the room in meters; the camera is in its center.
const INSIDE: [[f32; 2]; 3] = [[-3.0, 3.0], [-2.5, 2.5], [-1.4, 1.2]];

/// Writes the plain layout with `count` frames, padded until all together have the requested size.
pub fn write(root: &Utf8Path, frames: usize, bytes: usize) {
    for name in ["color", "depth", "pose"] {
        fs::create_dir_all(root.join(name)).unwrap();
    }
    fs::write(root.join("intrinsic.txt"), format!("{FOCAL} 0 319.5\n0 {FOCAL} 239.5\n0 0 1\n"))
        .unwrap();
    let views: Vec<_> = (0..VIEWS).map(view).collect();
    let own: usize =
        views.iter().map(|(color, depth, _)| color.len() + depth.len()).sum::<usize>() / VIEWS;
    let more = (bytes / frames).saturating_sub(own);
    for i in 0..frames {
        let (color, depth, pose) = &views[i % VIEWS];
        fs::write(root.join(format!("color/{i}.jpg")), with_comment(color, more, i)).unwrap();
        fs::write(root.join(format!("depth/{i}.png")), depth).unwrap();
        fs::write(root.join(format!("pose/{i}.txt")), pose).unwrap();
    }
}

/// Pads a JPEG with comments after its first marker, with different bytes for every frame.
fn with_comment(jpeg: &[u8], mut more: usize, frame: usize) -> Vec<u8> {
    let mut out = jpeg[..2].to_vec();
    while more > 0 {
        let length = more.min(60_000);
        out.extend([0xff, 0xfe]);
        out.extend((length as u16 + 2).to_be_bytes());
        out.extend(
            (0..length).map(|i| ((i ^ frame).wrapping_mul(2_654_435_761) >> 13) as u8 & 0x7f),
        );
        more -= length;
    }
    out.extend(&jpeg[2..]);
    out
}

/// Returns color, depth and pose of a view.
fn view(i: usize) -> (Vec<u8>, Vec<u8>, String) {
    let (sin, cos) = (i as f32 / VIEWS as f32 * TAU).sin_cos();
    // Returns right, down and forward of a camera that looks along the floor; twenty steps make
    // half a turn.
    let axes = [[sin, -cos, 0.0], [0.0, 0.0, -1.0], [cos, sin, 0.0]];
    let rows: String =
        (0..3).map(|r| format!("{} {} {} 0\n", axes[0][r], axes[1][r], axes[2][r])).collect();
    let depth_m = |u: u32, v: u32| {
        let (x, y) = ((u as f32 - 319.5) / FOCAL, (v as f32 - 239.5) / FOCAL);
        let hit = |axis: usize| {
            let ray = x * axes[0][axis] + y * axes[1][axis] + axes[2][axis];
            INSIDE[axis][usize::from(ray > 0.0)] / ray
        };
        hit(0).min(hit(1)).min(hit(2))
    };
    let noise = |u: u32, v: u32| {
        (u.wrapping_mul(2_654_435_761) ^ v.wrapping_mul(2_246_822_519) ^ i as u32)
            .wrapping_mul(3_266_489_917)
            >> 28
    };
    let color = RgbImage::from_fn(WIDTH, HEIGHT, |u, v| {
        let shade = (depth_m(u, v) * 50.0) as u32 + noise(u, v);
        Rgb([shade, shade + 20, shade / 2 + 60].map(|c| c.min(255) as u8))
    });
    // The last millimeters of a sensor are noise.
    let depth = ImageBuffer::from_fn(WIDTH, HEIGHT, |u, v| {
        Luma([(depth_m(u, v) * 1000.0) as u16 + noise(u, v) as u16])
    });
    (
        encoded(color.into(), ImageFormat::Jpeg),
        encoded(depth.into(), ImageFormat::Png),
        format!("{rows}0 0 0 1\n"),
    )
}

fn encoded(picture: DynamicImage, format: ImageFormat) -> Vec<u8> {
    let mut bytes = Cursor::new(Vec::new());
    picture.write_to(&mut bytes, format).unwrap();
    bytes.into_inner()
}
