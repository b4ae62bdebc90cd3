//! Answers a question about a local scan. A private service in this process parses the scan,
//! answers and stops.
//!
//! The cache folder is reused: a scan with the same bytes and settings is found by its hash and is
//! not parsed again.

use super::private::PrivateServer;
use super::scan_file::ScanFile;
use super::{hints, job_progress, resolve_scene};
use crate::config::{BUILTIN, BundlesConfig, ModelsConfig};
use crate::telemetry;
use anyhow::Context;
use camino::{Utf8Path, Utf8PathBuf};
use serde_json::json;
use std::time::{Duration, Instant};
use tokio::time::sleep;
use uniground_client::{Client, ClientError};
use uniground_storage::StoreError;
use uniground_types::answer::Answer;
use uniground_types::geometry::up_axis::UpAxis;
use uniground_types::question::{GroundRequest, Include};
use uniground_types::scenes::Scene;

#[allow(clippy::doc_markdown)] // Help is plain text.
#[derive(Debug, clap::Args)]
pub struct LocalArgs {
    /// Cache folder for parses. May be deleted at any time [default: uniground in $XDG_CACHE_HOME,
    /// or in ~/.cache]
    #[arg(long, value_name = "FOLDER", conflicts_with = "scene")]
    cache: Option<Utf8PathBuf>,
    /// Axis that points up in the scan: x, -x, y, -y, z or -z
    #[arg(long, allow_hyphen_values = true, value_parser = super::parse::up_axis, conflicts_with = "scene")]
    up: Option<UpAxis>,
    // Ignores the environment, so that the default answers in seconds.
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

/// Delay between attempts to open a folder that another process uses.
const AGAIN: Duration = Duration::from_millis(200);
/// Hint on how to ask with models.
const WITH_MODELS: &str = "Names come from size and color only. Two small models find more \
                           objects but take minutes: run `uniground models fetch`, then use --masks \
                           auto --encoder auto";

/// # Errors
/// Returns an error if the scan, the folder or the question is invalid.
pub async fn answer(
    scan: &Utf8Path,
    args: &LocalArgs,
    request: GroundRequest,
) -> anyhow::Result<Answer> {
    telemetry::start_quiet_about_jobs();
    let file = ScanFile::open(scan)?;
    let hash = file.hash()?;
    let cache = args.cache.clone().map_or_else(default_cache_folder, Ok)?;
    let service = start(&cache, args).await?;
    let answered =
        ask(&service.client, &LocalQuestion { scan, file, hash, cache: &cache, args }, request)
            .await;
    service.stop().await?;
    answered
}

struct LocalQuestion<'a> {
    scan: &'a Utf8Path,
    file: ScanFile,
    hash: String,
    cache: &'a Utf8Path,
    args: &'a LocalArgs,
}

fn default_cache_folder() -> anyhow::Result<Utf8PathBuf> {
    let folder =
        |name| std::env::var(name).ok().map(Utf8PathBuf::from).filter(|path| path.is_absolute());
    let caches =
        folder("XDG_CACHE_HOME").or_else(|| folder("HOME").map(|home| home.join(".cache")));
    Ok(caches
        .context("--cache FOLDER is required because neither XDG_CACHE_HOME nor HOME is set")?
        .join("uniground"))
}

/// Starts the private service. Waits while another process uses the same folder.
async fn start(
    cache: &Utf8Path,
    LocalArgs { masks, encoder, bundles, .. }: &LocalArgs,
) -> anyhow::Result<PrivateServer> {
    let models =
        ModelsConfig { masks: masks.clone(), encoder: encoder.clone(), bundles: bundles.clone() };
    let is_used = |error: &anyhow::Error| {
        error.chain().any(|cause| matches!(cause.downcast_ref(), Some(StoreError::InUse)))
    };
    let mut is_told = false;
    loop {
        match PrivateServer::start(cache.to_owned(), models.clone()).await {
            Err(error) if is_used(&error) => {
                if !std::mem::replace(&mut is_told, true) {
                    eprintln!(
                        "{cache} is in use by another uniground process; waiting (--cache FOLDER \
                         selects another folder)"
                    );
                }
                sleep(AGAIN).await;
            }
            started => return started,
        }
    }
}

async fn ask(
    client: &Client,
    asked: &LocalQuestion<'_>,
    request: GroundRequest,
) -> anyhow::Result<Answer> {
    let scene = ensure_parsed(client, asked)
        .await
        .map_err(|error| hints::with_scan_hint(error, asked.scan))?;
    // The evidence pictures are left out, because the service that stores them stops.
    let include = Some(vec![Include::Candidates, Include::Trace]);
    Ok(client.ground(&scene, &GroundRequest { include, ..request }).await?)
}

/// Returns the id of the scene of this scan, parsed with the requested settings.
async fn ensure_parsed(
    client: &Client,
    LocalQuestion { scan, file, hash, cache, args }: &LocalQuestion<'_>,
) -> anyhow::Result<String> {
    let begun = Instant::now();
    cancel_other_jobs(client).await?;
    let scene = match find_scene(client, hash).await? {
        Some(scene) => scene,
        None => {
            job_progress::upload_scan(
                client,
                file,
                &[("name", file.name.as_str()), ("parse", "false")],
            )
            .await?
            .scene
        }
    };
    let settings =
        args.up.map_or_else(|| json!({}), |up| json!({"settings": {"import": {"up": up}}}));
    let job = client.parse(&scene.id, &settings).await?;
    if job.state.is_final() {
        job_progress::describe_outcome(&job)?;
        return Ok(scene.id);
    }
    eprintln!("parsing {scan}");
    let outcome =
        job_progress::describe_outcome(&job_progress::follow_job(client, &job.id).await?)?;
    eprintln!(
        "parsed in {:.1} s: {outcome}; cached in {cache} for the next question",
        begun.elapsed().as_secs_f32()
    );
    if client.models().await?.models.is_empty() {
        eprintln!("{WITH_MODELS}");
    }
    Ok(scene.id)
}

/// Returns the scene that was created from the same bytes, if any.
async fn find_scene(client: &Client, hash: &str) -> Result<Option<Scene>, ClientError> {
    Ok(resolve_scene::list_scenes(client)
        .await?
        .into_iter()
        .find(|scene| scene.content_hash == *hash))
}

/// Cancels other unfinished jobs. They resume when their scan is requested again.
async fn cancel_other_jobs(client: &Client) -> Result<(), ClientError> {
    for state in ["running", "queued"] {
        for job in client.jobs(&[("kind", "parse"), ("state", state)]).await?.jobs {
            client.cancel_job(&job.id).await?;
        }
    }
    Ok(())
}
