//! This project's steps compared with public libraries, on the same input and alternating: `make
//! bench-peers`, or `cargo bench --bench peers -- [--pcl PROGRAM] [--python PYTHON] [--write FILE]
//! [FOLDER]`.
//!
//! PCL's VCCS is the program built from `benches/peers/vccs.cpp`; `open3d` and `onnxruntime` run in
//! the given Python (`scripts/bench-peers.sh` makes one). A missing peer gets a row that says so.
//! The input is `room1` of `../shared/scenes` or of the given folder.

#![allow(missing_docs, clippy::unwrap_used)] // a bench that can not set up has nothing to time

#[path = "peers/duel.rs"]
mod duel;
#[path = "peers/process.rs"]
mod process;
#[path = "peers/rows.rs"]
mod rows;
#[path = "peers/sheet.rs"]
mod sheet;
#[path = "peers/vccs.rs"]
mod vccs;

use anyhow::Context;
use camino::{Utf8Path, Utf8PathBuf};
use duel::Comparison;
use image::{Rgb, RgbImage};
use process::Peer;
use rows::EncodedImage;
use rows::Input;
use uniground_core::models::neural::{Models, OnnxRuntime, RuntimeSettings};
use uniground_evaluation::annotated::AnnotatedRoom;
use vccs::Vccs;

#[derive(Default)]
struct Options {
    pcl: Option<String>,
    python: Option<String>,
    write: Option<Utf8PathBuf>,
    folder: Utf8PathBuf,
}

fn options() -> Options {
    let mut options = Options { folder: repository_path("../shared/scenes"), ..Options::default() };
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

fn repository_path(path: &str) -> Utf8PathBuf {
    Utf8Path::new(env!("CARGO_MANIFEST_DIR")).join(path)
}

fn main() {
    let Options { pcl, python, write, folder } = options();
    if !folder.join("room1.zip").exists() {
        println!("skipped: no annotated rooms in {folder}");
        return;
    }
    let load = sheet::load();
    let temporary = tempfile::tempdir().unwrap();
    let scratch = Utf8Path::from_path(temporary.path()).unwrap();
    let room = AnnotatedRoom::load(&folder, "room1", scratch).unwrap();
    let input = Input::new(room.bundle.cloud, scratch.join("written.ply"));

    let vccs = pcl
        .context("no --pcl PROGRAM given")
        .and_then(|program| Vccs::new(&program, &input.cloud, scratch));
    let open3d = Peer::start(python.as_deref(), "open3d_peer.py", &input.for_open3d());
    let bundle = repository_path("models/sam2-hiera-tiny");
    let asked = segmenter(&bundle);
    let onnxruntime = model(&bundle, python.as_deref());

    let mut comparisons = rows::superpoints(&input, &vccs);
    comparisons.push(rows::reading(&input, &open3d));
    comparisons.push(rows::thinning(&input, &open3d));
    comparisons.extend(rows::normals(&input, &open3d));
    comparisons.extend(rows::drawing(&input, &open3d));
    comparisons.extend(rows::perception(&asked, &onnxruntime));
    let outcomes: Vec<_> = comparisons.into_iter().map(Comparison::run).collect();

    let versions =
        [vccs.as_ref().ok().and_then(Vccs::version), open3d.versions(), onnxruntime.versions()];
    let text = sheet::format_report(
        &format!("room1's cloud, {} points", input.cloud.len()),
        &load,
        &versions,
        &outcomes,
    );
    println!("{text}");
    if let Some(file) = write {
        std::fs::write(file, text).unwrap();
    }
}

/// A segmenter with an encoded image: as many threads for its encoder as there are cores, one for
/// each of two decoders.
fn segmenter(bundle: &Utf8Path) -> anyhow::Result<EncodedImage> {
    let settings = RuntimeSettings {
        library: Some(repository_path(".onnxruntime/libonnxruntime.so")),
        threads: Some(THREADS),
        ..RuntimeSettings::default()
    };
    let models = Models::default().with_segmenter(&OnnxRuntime::load(&settings)?, bundle)?;
    let segmenter = models.segmenters.first().cloned().context("the bundle is a segmenter")?;
    let picture = RgbImage::from_fn(640, 480, |x, y| {
        Rgb([(x / 3) as u8, (y / 2) as u8, ((x * y) >> 6) as u8])
    });
    let encoded = segmenter.encode(&picture)?;
    Ok(EncodedImage { segmenter, picture, encoded })
}

const THREADS: usize = 2;

/// onnxruntime with the same bundle loaded.
fn model(bundle: &Utf8Path, python: Option<&str>) -> Peer {
    match bundle.join("model.json").exists() {
        true => Peer::start(python, "onnxruntime_peer.py", &[format!("load {bundle} {THREADS} 1")]),
        false => Peer::missing("make models fetches the bundle".into()),
    }
}
