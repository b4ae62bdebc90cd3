//! `uniground upload`: uploads a scan to a running server, or adds frames to an existing scene, and
//! waits for the parse.

use super::output::print_json;
use super::scan_file::ScanFile;
use super::server::ServerArgs;
use super::{hints, job_progress, resolve_scene, table};
use crate::words;
use camino::Utf8PathBuf;
use std::io::{self, Write};
use std::time::Instant;
use uniground_client::Client;
use uniground_types::geometry::up_axis::UpAxis;
use uniground_types::placement::FrameChoice;
use uniground_types::scenes::{Created, ParseQuality, Scene};

#[derive(Debug, clap::Args)]
pub struct UploadArgs {
    /// Scan to upload: a folder, an archive, a .sens or .r3d file, a point cloud or a mesh
    scan: Utf8PathBuf,
    /// Add the frames to this scene (name or id) instead of creating one. Unchanged objects keep
    /// their ids, and the changes are printed
    #[arg(long, value_name = "SCENE", conflicts_with_all = ["name", "up", "metres_per_unit", "no_levelling"])]
    to: Option<String>,
    /// Coordinate frame of the poses, with --to: the frame of the scene's original files, the
    /// scene's own frame, or the frame of its map
    #[arg(long, requires = "to", default_value = "source", value_parser = words::frame())]
    world: FrameChoice,
    /// Name of the scene [default: the file name without its extension]
    #[arg(long)]
    name: Option<String>,
    /// Axis that points up in the scan: x, -x, y, -y, z or -z
    #[arg(long, allow_hyphen_values = true, value_parser = super::parse::up_axis)]
    up: Option<UpAxis>,
    /// Length of one unit of the scan's cloud and poses, meters
    #[arg(long, value_name = "METERS", value_parser = words::meters_per_unit)]
    metres_per_unit: Option<f64>,
    /// Keep the tilt of the scan instead of leveling it
    #[arg(long)]
    no_levelling: bool,
    /// Do not wait for the parse
    #[arg(long)]
    no_wait: bool,
    /// Which parse to wait for. A server with neural networks makes a draft first
    #[arg(long, default_value = "draft", conflicts_with = "no_wait", value_name = "PARSE", value_parser = words::wait())]
    wait: ParseQuality,
    #[command(flatten)]
    server: ServerArgs,
    /// Print the scene as JSON
    #[arg(long)]
    json: bool,
}

pub async fn run(args: &UploadArgs) -> anyhow::Result<()> {
    let client = args.server.client()?;
    let done = match &args.to {
        Some(scene) => add_frames(&client, scene, args).await,
        None => upload(&client, args).await,
    };
    done.map_err(|error| hints::with_scan_hint(error, &args.scan))
}

/// Adds frames to an existing scene.
async fn add_frames(client: &Client, scene: &str, args: &UploadArgs) -> anyhow::Result<()> {
    let id = resolve_scene::resolve_id(client, scene).await?;
    let before = client.scene(&id).await?;
    let file = ScanFile::open(&args.scan)?;
    let sent = job_progress::add_frames(client, &file, &id, args.world).await;
    let Created { scene, job } =
        sent.map_err(|error| error.context(format!("nothing was added to {}", before.name)))?;
    let Some(job) = job.filter(|_| !args.no_wait) else {
        return if args.json { print_json(&scene) } else { Ok(writeln!(io::stdout(), "{id}")?) };
    };
    let told = job_progress::describe_outcome(&job_progress::follow_job(client, &job.id).await?)?;
    eprintln!("parsed: {told}");
    let changes = client.changes_since(&id, before.parse_version).await?;
    match (args.json, changes.changes.is_empty()) {
        (true, _) => print_json(&changes),
        (false, true) => Ok(writeln!(
            io::stdout(),
            "nothing changed: {} objects unchanged",
            changes.changes.unchanged
        )?),
        (false, false) => Ok(writeln!(io::stdout(), "{}", table::changes_table(&changes.changes))?),
    }
}

/// Waits for the full parse of a scene, or says that it follows. Returns the scene after that.
async fn after_draft(
    client: &Client,
    scene: Scene,
    wait: ParseQuality,
    begun: Instant,
) -> anyhow::Result<Scene> {
    let Some(job_id) = &scene.job_id else { return Ok(scene) };
    if client.job(job_id).await?.state.is_final() {
        return Ok(scene);
    }
    if wait == ParseQuality::Draft {
        eprintln!("this is a draft; the full parse follows, and objects keep their ids");
        return Ok(scene);
    }
    eprintln!("the draft can be asked; making the full parse");
    let told = job_progress::describe_outcome(&job_progress::follow_job(client, job_id).await?)?;
    eprintln!("fully parsed in {:.1} s: {told}", begun.elapsed().as_secs_f32());
    Ok(client.scene(&scene.id).await?)
}

/// Uploads a scan. Prints the id to standard output and everything else to stderr, for use as
/// `scene=$(uniground upload room.zip)`.
async fn upload(client: &Client, args: &UploadArgs) -> anyhow::Result<()> {
    let file = ScanFile::open(&args.scan)?;
    let name = args.name.as_deref().unwrap_or(&file.name);
    let up = args.up.map(|up| ("up", up.name()));
    let metres_per_unit = args.metres_per_unit.map(|metres| metres.to_string());
    let metres_per_unit = metres_per_unit.as_deref().map(|metres| ("metres_per_unit", metres));
    let levelling = args.no_levelling.then_some(("levelling", "off"));
    let query: Vec<(&str, &str)> =
        [("name", name)].into_iter().chain(up).chain(metres_per_unit).chain(levelling).collect();
    let Created { scene, job } = job_progress::upload_scan(client, &file, &query).await?;
    let begun = Instant::now();
    let (is_awaited, job) = (!args.no_wait, job.filter(|job| !job.state.is_final()));
    if let (true, Some(job)) = (is_awaited, &job) {
        eprintln!("uploaded as {}; parsing", scene.id);
        let told =
            job_progress::describe_outcome(&job_progress::follow_job(client, &job.id).await?)?;
        eprintln!("parsed in {:.1} s: {told}", begun.elapsed().as_secs_f32());
    }
    let mut scene = client.scene(&scene.id).await?;
    if is_awaited && scene.quality == Some(ParseQuality::Draft) {
        scene = after_draft(client, scene, args.wait, begun).await?;
    }
    for warning in scene.import.iter().flat_map(|import| &import.warnings) {
        eprintln!("warning: {warning}");
    }
    match args.json {
        true => print_json(&scene)?,
        false => writeln!(io::stdout(), "{}", scene.id)?,
    }
    // A key without permission to list scenes gets no names.
    let known = resolve_scene::list_scenes(client).await.unwrap_or_default();
    let (named, flag) = (resolve_scene::shortest_reference(&known, &scene), args.server.to_flag());
    let (running, wait) = match is_awaited || job.is_none() {
        true => ("", ""),
        false => ("the parse is running; ", " --wait"),
    };
    eprintln!("{running}ask: uniground ground --scene {named}{flag}{wait} \"the largest table\"");
    Ok(())
}
