//! `uniground demo`: the whole job on the sample scene, against a real server on a free loopback
//! port.

use super::private::PrivateServer;
use super::{job_progress, table};
use crate::config::{BUILTIN, BundlesConfig, ModelsConfig};
use crate::telemetry;
use anyhow::Context;
use camino::{Utf8Path, Utf8PathBuf};
use std::fs;
use std::time::Instant;
use uniground_client::Client;
use uniground_core::grounding::Status;
use uniground_core::ingest::archive::ArchiveKind;
use uniground_service::sample::LIVING_ROOM;
use uniground_types::answer::Answer;
use uniground_types::question::GroundRequest;
use uniground_types::scenes::Scene;

#[derive(Debug, clap::Args)]
pub struct DemoArgs {
    /// The scan to show [default: the sample scene, which is inside this program]
    #[arg(long, value_name = "FILE")]
    scene: Option<Utf8PathBuf>,
    /// Ask this instead of the four sample questions; may be given several times
    #[arg(long = "ask", value_name = "QUESTION")]
    questions: Vec<String>,
    /// Write pictures here
    #[arg(long, default_value = "demo-out", value_name = "FOLDER")]
    out: Utf8PathBuf,
    // Not of the environment: the demo is quick unless somebody says otherwise here.
    /// Where 2D masks come from: builtin, auto, or a bundle, as for the server; a segmenter takes
    /// seconds a frame
    #[arg(long, default_value = BUILTIN, value_name = "BUNDLE")]
    masks: String,
    /// What compares pictures and words: builtin, auto, or a bundle, as for the server
    #[arg(long, default_value = BUILTIN, value_name = "BUNDLE")]
    encoder: String,
    #[command(flatten)]
    bundles: BundlesConfig,
}

/// One unique object, one attribute, one relation, and one that is not in the room.
const QUESTIONS: [&str; 4] = [
    "find the coffee table",
    "the orange stool",
    "the mug on the coffee table",
    "the green fridge",
];
/// The sample scene: the demo runs from any folder.
/// How the same goes with models.
const WITH_MODELS: &str = "With two small networks more is found, in minutes instead of seconds:\n  uniground models fetch && uniground demo --masks auto --encoder auto";
/// How many of the found objects are listed.
const LISTED: usize = 12;

pub async fn run(args: &DemoArgs) -> anyhow::Result<()> {
    telemetry::start_quiet();
    let data = tempfile::tempdir()?;
    let models = ModelsConfig {
        masks: args.masks.clone(),
        encoder: args.encoder.clone(),
        bundles: args.bundles.clone(),
    };
    let service =
        PrivateServer::start(Utf8PathBuf::try_from(data.path().to_owned())?, models).await?;
    println!(
        "uniground {} on http://{}, data in a fresh folder\n",
        env!("CARGO_PKG_VERSION"),
        service.address
    );
    let shown = show(args, &service.client).await;
    service.stop().await?;
    shown?;
    println!("The service has stopped.");
    Ok(())
}

async fn show(args: &DemoArgs, client: &Client) -> anyhow::Result<()> {
    let scene = upload(client, args.scene.as_deref()).await?;
    print_found(client, &scene).await?;
    fs::create_dir_all(&args.out).with_context(|| args.out.to_string())?;
    let samples = QUESTIONS.map(str::to_owned).to_vec();
    let questions = if args.questions.is_empty() { &samples } else { &args.questions };
    let mut pictures = Vec::new();
    for (i, question) in questions.iter().enumerate() {
        let answer = client.ground(&scene.id, &GroundRequest::new(question)).await?;
        println!("{}\n", table::of_answer(&answer));
        if answer.status == Status::Ambiguous {
            println!("{}\n", table::of_alternatives(&answer.alternatives));
        }
        if let Some(path) = save_picture(client, &answer, &args.out, i + 1).await? {
            pictures.push(path);
        }
    }
    let used: Vec<String> =
        client.models().await?.models.into_iter().map(|model| model.name).collect();
    match used.is_empty() {
        true => {
            println!("Names come from sizes and colours only: no model was used. {WITH_MODELS}");
        }
        false => println!("Models that took part: {}.", used.join(", ")),
    }
    println!("Pictures of the room with each answer's box:");
    pictures.iter().for_each(|path| println!("  {path}"));
    Ok(())
}

async fn upload(client: &Client, archive: Option<&Utf8Path>) -> anyhow::Result<Scene> {
    let (name, kind, bytes) = match archive {
        None => ("the sample scene", ArchiveKind::Zip, LIVING_ROOM.to_vec()),
        Some(file) => {
            let kind = ArchiveKind::from_file_name(file.as_str())
                .with_context(|| format!("{file}: expected .zip, .tar or .tar.zst"))?;
            (file.as_str(), kind, fs::read(file).with_context(|| file.to_string())?)
        }
    };
    println!("Uploading {name} ({:.1} MB)", bytes.len() as f64 / 1e6);
    let start = Instant::now();
    let created = client.create_scene(None, kind.media_type(), bytes).await?;
    let job = created.job.context("the server did not start to parse")?;
    let told = job_progress::outcome(&job_progress::follow(client, &job.id).await?)?;
    println!("Parsed in {:.1} s: {told}\n", start.elapsed().as_secs_f32());
    Ok(client.scene(&created.scene.id).await?)
}

async fn print_found(client: &Client, scene: &Scene) -> anyhow::Result<()> {
    let instances = client.instances(&scene.id, 1000).await?.instances;
    let objects = instances.iter().filter(|i| i.structure.is_none());
    println!(
        "Found {} objects and {} parts of the building; the largest objects:",
        objects.clone().count(),
        instances.len() - objects.clone().count()
    );
    println!("{}\n", table::of_instances(objects.take(LISTED)));
    Ok(())
}

async fn save_picture(
    client: &Client,
    answer: &Answer,
    out: &Utf8Path,
    number: usize,
) -> anyhow::Result<Option<Utf8PathBuf>> {
    if answer.status == Status::NoMatch {
        return Ok(None);
    }
    let Some(picture) = answer.evidence.iter().flatten().next() else { return Ok(None) };
    let path = out.join(format!("answer-{number}.jpg"));
    fs::write(&path, client.bytes(picture).await?).with_context(|| path.to_string())?;
    Ok(Some(path))
}
