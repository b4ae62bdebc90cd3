//! `uniground upload`: a scan to a running server, and its parse.

use super::output::print_json;
use super::scan_file::ScanFile;
use super::server::ServerArgs;
use super::{choosing, following, hints};
use camino::Utf8PathBuf;
use std::io::{self, Write};
use std::time::Instant;
use uniground_client::Client;
use uniground_types::geometry::up_axis::UpAxis;
use uniground_types::scenes::Created;

#[derive(Debug, clap::Args)]
pub struct UploadArgs {
    /// A scan: a folder, an archive, a .sens or .r3d file, a cloud or a mesh
    scan: Utf8PathBuf,
    /// What to call the scene [default: the file's name without its ending]
    #[arg(long)]
    name: Option<String>,
    /// The axis that points up in the scan: x, -x, y, -y, z or -z
    #[arg(long, allow_hyphen_values = true, value_parser = super::parse::up_axis)]
    up: Option<UpAxis>,
    /// Do not wait for the parse
    #[arg(long)]
    no_wait: bool,
    #[command(flatten)]
    server: ServerArgs,
    /// Print the scene as JSON
    #[arg(long)]
    json: bool,
}

pub async fn run(args: &UploadArgs) -> anyhow::Result<()> {
    let client = args.server.client()?;
    upload(&client, args).await.map_err(|error| hints::of_scan(error, &args.scan))
}

/// The id goes to standard output, and everything for people to stderr: `scene=$(uniground upload room.zip)`.
async fn upload(client: &Client, args: &UploadArgs) -> anyhow::Result<()> {
    let file = ScanFile::open(&args.scan)?;
    let name = args.name.as_deref().unwrap_or(&file.name);
    let up = args.up.map(|up| ("up", up.name()));
    let query: Vec<(&str, &str)> = [("name", name)].into_iter().chain(up).collect();
    let Created { scene, job } = following::send(client, &file, &query).await?;
    let begun = Instant::now();
    let (is_awaited, job) = (!args.no_wait, job.filter(|job| !job.state.is_final()));
    if let (true, Some(job)) = (is_awaited, &job) {
        eprintln!("uploaded as {}; parsing", scene.id);
        let told = following::outcome(&following::follow(client, &job.id).await?)?;
        eprintln!("parsed in {:.1} s: {told}", begun.elapsed().as_secs_f32());
    }
    let scene = client.scene(&scene.id).await?;
    match args.json {
        true => print_json(&scene)?,
        false => writeln!(io::stdout(), "{}", scene.id)?,
    }
    // Only a key that may not list has no names.
    let known = choosing::all(client).await.unwrap_or_default();
    let (named, flag) = (choosing::shortest(&known, &scene), args.server.flag());
    match is_awaited || job.is_none() {
        true => eprintln!("ask: uniground ground --scene {named}{flag} \"the chair next to the door\""),
        false => eprintln!("it is being parsed; ask: uniground ground --scene {named}{flag} --wait \"the chair next to the door\""),
    }
    Ok(())
}
