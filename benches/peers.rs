//! Our parts beside the public ones, on the same input and in turns: `make bench-peers`, or
//! `cargo bench --bench peers -- [--pcl PROGRAM] [--python PYTHON] [--write FILE] [FOLDER]`.
//!
//! PCL's VCCS is the program built from `benches/peers/vccs.cpp`; Open3D and onnxruntime answer from the Python given
//! (`scripts/bench-peers.sh` makes one). A peer that is not there is a row that says so. `room1` of `../shared/scenes`, or of
//! the folder given.

#![allow(missing_docs, clippy::unwrap_used)] // a bench that can not set up has nothing to time

#[path = "peers/duel.rs"]
mod duel;
#[path = "peers/process.rs"]
mod process;
#[path = "peers/sheet.rs"]
mod sheet;
#[path = "peers/vccs.rs"]
mod vccs;

use anyhow::{Context, anyhow, ensure};
use camino::{Utf8Path, Utf8PathBuf};
use duel::{Comparison, Ours, Run, Side};
use process::Process;
use std::cell::RefCell;
use std::time::Instant;
use uniground::evaluation::annotated::Room;
use uniground::geometry::Vector3;
use uniground::geometry::boxes::Aabb;
use uniground::geometry::statistics::quantile;
use uniground::geometry::voxels::{VoxelGrid, typical_spacing_m};
use uniground::ingest::read_cloud;
use uniground::progress::Progress;
use uniground::render::{ROOM_VIEW, scene_picture};
use uniground::scene::PointCloud;
use uniground::scene::export::write_cloud_ply;
use uniground::scene_parsing::superpoints::{self, SuperpointSettings};
use vccs::Vccs;

/// Edge of the voxels a cloud is thinned to, metres.
const THINNED_M: f32 = 0.05;
/// What `scene_picture` leaves empty, and cuts off and widens by; the peers are given the same.
const BACKGROUND: [u8; 3] = [250, 250, 250];
const CEILING_PERCENTILE: f32 = 0.95;
const SPLAT_OVERLAP: f32 = 1.6;

#[derive(Default)]
struct Options {
    pcl: Option<String>,
    python: Option<String>,
    write: Option<Utf8PathBuf>,
    folder: Utf8PathBuf,
}

fn options() -> Options {
    let mut options = Options { folder: beside("../shared/scenes"), ..Options::default() };
    let mut args = std::env::args().skip(1).filter(|a| a != "--bench");
    while let Some(arg) = args.next() {
        match arg.as_str() {
            "--pcl" => options.pcl = args.next(),
            "--python" => options.python = args.next(),
            "--write" => options.write = args.next().map(Into::into),
            folder => options.folder = folder.into(),
        }
    }
    options
}

fn beside(path: &str) -> Utf8PathBuf {
    Utf8Path::new(env!("CARGO_MANIFEST_DIR")).join(path)
}

fn main() {
    let Options { pcl, python, write, folder } = options();
    if !folder.join("room1.zip").exists() {
        println!("left out: no annotated rooms in {folder}");
        return;
    }
    let temporary = tempfile::tempdir().unwrap();
    let scratch = Utf8Path::from_path(temporary.path()).unwrap();
    let room = Room::load(&folder, "room1", scratch).unwrap();
    let cloud = &room.bundle.cloud;
    let file = scratch.join("written.ply");
    write_cloud_ply(cloud, std::fs::File::create(&file).unwrap()).unwrap();

    let vccs = pcl.context("no --pcl PROGRAM given").and_then(|program| Ok(Vccs::new(&program, cloud, scratch)?));
    let open3d = Peer::start(python.as_deref(), "open3d_peer.py");
    let onnxruntime = Peer::start(python.as_deref(), "onnxruntime_peer.py");
    let squares = set_up_open3d(&open3d, cloud, &file);
    let model = beside("../shared/models/tiny-dual-encoder");
    let loaded = set_up_onnxruntime(&onnxruntime, &model);

    let mut comparisons = superpoint_rows(cloud, &vccs);
    comparisons.push(reading(&file, &open3d));
    comparisons.push(thinning(cloud, &open3d));
    comparisons.extend(normals(cloud, &open3d));
    comparisons.extend(drawing(cloud, &open3d, &squares));
    comparisons.extend(encoding(&onnxruntime, &loaded));
    let outcomes: Vec<_> = comparisons.into_iter().map(Comparison::run).collect();

    let versions = [pcl_version(&vccs), open3d.told(), onnxruntime.told()];
    let text = sheet::written(&format!("room1's cloud, {} points", cloud.len()), &versions, &outcomes);
    print!("{text}");
    if let Some(file) = write {
        std::fs::write(file, text).unwrap();
    }
}
