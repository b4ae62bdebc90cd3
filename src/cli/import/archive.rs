//! Writes an imported scan in the neutral layout.

use anyhow::Context;
use camino::Utf8Path;
use serde_json::json;
use std::fs::{self, File};
use std::io::{BufWriter, Cursor, Write};
use uniground_core::scene::{FrameRef, Intrinsics, Optics, PointCloud, write_cloud_ply};
use zip::ZipWriter;
use zip::write::SimpleFileOptions;

/// Writes a zip with `scene.json`, the cloud, and every frame: rectified color, registered depth in
/// millimeters, and its pose.
pub(super) fn write(out: &Utf8Path, frames: &[FrameRef], cloud: &PointCloud) -> anyhow::Result<()> {
    let mut zip = ZipWriter::new(BufWriter::new(File::create(out)?));
    let stored = SimpleFileOptions::default().compression_method(zip::CompressionMethod::Stored);
    let mut put = |name: &str, bytes: &[u8]| -> anyhow::Result<()> {
        zip.start_file(name, stored)?;
        zip.write_all(bytes)?;
        Ok(())
    };
    let mut listed = Vec::new();
    for (i, frame) in frames.iter().enumerate() {
        let ending = if frame.optics == Optics::default() {
            frame.color.extension().unwrap_or("jpg")
        } else {
            "png"
        };
        let (color, depth, pose) =
            (format!("color/{i}.{ending}"), format!("depth/{i}.png"), format!("pose/{i}.txt"));
        // Pictures without lens distortion are copied, not encoded again.
        let bytes = match &frame.optics.color_lens {
            None if ending != "png" || frame.color.extension() == Some("png") => {
                fs::read(&frame.color)?
            }
            _ => encode_png(frame.decode_color()?.into())?,
        };
        put(&color, &bytes)?;
        let measured = frame.decode_depth()?;
        let units = measured
            .depth_m
            .iter()
            .map(|z| if *z < 65.5 { (z * 1000.0).round() as u16 } else { 0 })
            .collect();
        let picture = image::ImageBuffer::<image::Luma<u16>, Vec<u16>>::from_raw(
            measured.width,
            measured.height,
            units,
        );
        put(
            &depth,
            &encode_png(picture.context("the size of the depth picture does not match")?.into())?,
        )?;
        let m = frame.camera_to_world.to_homogeneous();
        let rows: String =
            m.row_iter().map(|r| format!("{} {} {} {}\n", r[0], r[1], r[2], r[3])).collect();
        put(&pose, rows.as_bytes())?;
        listed.push(json!({
            "color": color, "depth": depth, "pose": pose,
            "intrinsics": camera_json(&frame.color_intrinsics), "depth_intrinsics": camera_json(&frame.depth_intrinsics),
        }));
    }
    let mut ply = Vec::new();
    write_cloud_ply(cloud, &mut ply)?;
    put("cloud.ply", &ply)?;
    let manifest =
        json!({"format": "uniground-scene/1", "up": "z", "cloud": "cloud.ply", "frames": listed});
    put("scene.json", &serde_json::to_vec_pretty(&manifest)?)?;
    zip.finish()?.flush()?;
    Ok(())
}

fn camera_json(intrinsics: &Intrinsics) -> serde_json::Value {
    let Intrinsics { width, height, fx, fy, cx, cy } = *intrinsics;
    json!({"width": width, "height": height, "fx": fx, "fy": fy, "cx": cx, "cy": cy})
}

fn encode_png(picture: image::DynamicImage) -> anyhow::Result<Vec<u8>> {
    let mut bytes = Cursor::new(Vec::new());
    picture.write_to(&mut bytes, image::ImageFormat::Png)?;
    Ok(bytes.into_inner())
}
