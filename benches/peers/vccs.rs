//! PCL's VCCS as a separate program (`vccs.cpp`), one process per run, which times itself.

use anyhow::{Context, ensure};
use camino::{Utf8Path, Utf8PathBuf};
use std::process::Command;
use uniground_core::scene::PointCloud;

/// The built program and the files it shares with the bench.
pub struct Vccs {
    program: String,
    cloud: Utf8PathBuf,
    labels: Utf8PathBuf,
}

impl Vccs {
    /// Writes the cloud where the program reads it.
    pub fn new(program: &str, cloud: &PointCloud, scratch: &Utf8Path) -> anyhow::Result<Self> {
        let file = scratch.join("cloud.f32");
        std::fs::write(&file, raw_floats(cloud))?;
        Ok(Self { program: program.to_owned(), cloud: file, labels: scratch.join("labels.i32") })
    }

    /// Returns the seconds from points in memory to labels in memory, and the labels; 0 means none.
    pub fn run(&self, voxel: &str, seed: &str) -> anyhow::Result<(f32, Vec<u32>)> {
        let output = Command::new(&self.program)
            .args([self.cloud.as_str(), voxel, seed, self.labels.as_str()])
            .output()
            .with_context(|| self.program.clone())?;
        ensure!(output.status.success(), "{}: {}", self.program, output.status);
        // The output contains `... extract 236 ms label-back 18 ms ...`.
        let text = String::from_utf8(output.stdout)?;
        let mut words = text.split_whitespace();
        let mut after = |word: &str| -> anyhow::Result<f32> {
            words.find(|w| *w == word).with_context(|| format!("no {word} in {text:?}"))?;
            Ok(words.next().unwrap_or_default().parse()?)
        };
        let seconds = (after("extract")? + after("label-back")?) / 1000.0;
        let bytes = std::fs::read(&self.labels)?;
        let labels =
            bytes.chunks_exact(4).map(|b| u32::from_le_bytes([b[0], b[1], b[2], b[3]])).collect();
        Ok((seconds, labels))
    }

    /// Returns the PCL version it was built with, from its output without arguments.
    pub fn version(&self) -> Option<String> {
        let output = Command::new(&self.program).output().ok()?;
        let version = String::from_utf8(output.stdout).ok().filter(|_| output.status.success())?;
        Some(version.trim().to_owned())
    }
}

/// Returns rows of `x y z r g b` in the program's format.
fn raw_floats(cloud: &PointCloud) -> Vec<u8> {
    let rows = cloud.positions.iter().zip(&cloud.colors);
    rows.flat_map(|(p, c)| [p.x, p.y, p.z, f32::from(c[0]), f32::from(c[1]), f32::from(c[2])])
        .flat_map(f32::to_le_bytes)
        .collect()
}
