//! `uniground demo`: runs upload, parse and questions on the sample scene, against a real server on
//! a free loopback port.

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
    /// Scan to use instead of the built-in sample scene
    #[arg(long, value_name = "FILE")]
    scene: Option<Utf8PathBuf>,
    /// Ask this question instead of the four sample questions. May be repeated
    #[arg(long = "ask", value_name = "QUESTION")]
    questions: Vec<String>,
    /// Folder for the result pictures
    #[arg(long, default_value = "demo-out", value_name = "FOLDER")]
    out: Utf8PathBuf,
    // Ignores the environment, so that the demo is fast by default.
    /// Source of 2D masks: builtin, auto, or a bundle name. A segmentation model takes seconds per
    /// frame
    #[arg(long, default_value = BUILTIN, value_name = "BUNDLE")]
    masks: String,
    /// Image and text encoder: builtin, auto, or a bundle name
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
/// Hint on how to run the demo with models.
const WITH_MODELS: &str = "With two small models it finds more objects but takes minutes:\n  \
                           uniground models fetch && uniground demo --masks auto --encoder auto";
/// Maximum number of objects to list.
const MAX_LISTED: usize = 12;

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
        println!("{}\n", table::answer_table(&answer));
        if answer.status == Status::Ambiguous {
            println!("{}\n", table::alternatives_table(&answer.alternatives));
        }
        if let Some(path) = save_picture(client, &answer, &args.out, i + 1).await? {
            pictures.push(path);
        }
    }
    let used: Vec<String> =
        client.models().await?.models.into_iter().map(|model| model.name).collect();
    match used.is_empty() {
        true => {
            println!("No model was used, so names come from size and color only. {WITH_MODELS}");
        }
        false => println!("Models used: {}.", used.join(", ")),
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
                .with_context(|| format!("{file}: expected .zip, .tar, .tar.gz or .tar.zst"))?;
            (file.as_str(), kind, fs::read(file).with_context(|| file.to_string())?)
        }
    };
    println!("Uploading {name} ({:.1} MB)", bytes.len() as f64 / 1e6);
    let start = Instant::now();
    let created = client.create_scene(None, kind.media_type(), bytes).await?;
    let job = created.job.context("the server did not start a parse")?;
    let outcome =
        job_progress::describe_outcome(&job_progress::follow_job(client, &job.id).await?)?;
    println!("Parsed in {:.1} s: {outcome}\n", start.elapsed().as_secs_f32());
    Ok(client.scene(&created.scene.id).await?)
}

async fn print_found(client: &Client, scene: &Scene) -> anyhow::Result<()> {
    let instances = client.instances(&scene.id, 1000).await?.instances;
    let objects = instances.iter().filter(|i| i.structure.is_none());
    println!(
        "Found {} objects and {} building elements (walls, floor, ceiling). Largest objects:",
        objects.clone().count(),
        instances.len() - objects.clone().count()
    );
    println!("{}\n", table::instances_table(objects.take(MAX_LISTED)));
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
