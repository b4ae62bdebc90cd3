//! Parses a scan and answers questions about it, all in this process: no server, no database, no
//! model.
//!
//! `cargo run --release -p uniground-core --example ground -- examples/living_room.zip "the mug on
//! the coffee table"`

use camino::Utf8PathBuf;
use futures::executor::block_on;
use uniground_core::grounding::memory_scene::MemoryScene;
use uniground_core::grounding::pipeline::{Ask, answer};
use uniground_core::grounding::{Question, Status};
use uniground_core::ingest::ScanFolder;
use uniground_core::models::neural::Models;
use uniground_core::parsing::checkpoints::Checkpoints;
use uniground_core::progress::Progress;
use uniground_core::scan::parse_scan;
use uniground_core::types::settings::ParseSettings;

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let mut arguments = std::env::args().skip(1);
    let scan = Utf8PathBuf::from(
        arguments.next().ok_or("expected a scan (a folder, an archive or a .ply) and questions")?,
    );

    // Stage 1: the scan, cut into instances.
    let folder = ScanFolder::open(&scan)?;
    let (settings, models) = (ParseSettings::default(), Models::default());
    let progress =
        Progress::new(|stage, done| eprint!("\r{:3.0} % {stage:<24}", done * 100.0), || false);
    let parsed = parse_scan(&folder.path, &settings, &models, &Checkpoints::disabled(), &progress)?;
    eprintln!(
        "\r{} instances from {} points{:20}",
        parsed.scene.instances.len(),
        parsed.scene.cloud.len(),
        ""
    );

    // Stage 2: questions. The pipeline is a future; without a chat model it never waits.
    let scene = MemoryScene::of(parsed, &models);
    for query in arguments {
        let grounding = block_on(answer(&scene, Ask::of(Question::of(&query))))?.grounding;
        match (grounding.status, grounding.oriented_box) {
            (Status::Grounded | Status::Uncertain, Some(found)) => {
                let (at, size) = (found.center.coords.as_slice(), found.size.as_slice());
                println!(
                    "{query}: at {at:.2?} m, size {size:.2?} m, turned by {:.2} rad",
                    found.yaw_rad
                );
            }
            (status, _) => println!("{query}: {status:?}"),
        }
        println!("  {}", grounding.answer.explanation);
    }
    Ok(())
}
