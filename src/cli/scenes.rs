//! `uniground scenes`: lists the scenes of a server.

use super::output::print_json;
use super::server::ServerArgs;
use super::{resolve_scene, table};
use std::io::{self, Write};
use uniground_client::{Client, ClientError};
use uniground_types::job::JobState;
use uniground_types::scenes::{Scene, SceneStatus};

#[derive(Debug, clap::Args)]
pub struct ScenesArgs {
    #[command(flatten)]
    server: ServerArgs,
    /// Print the list as JSON
    #[arg(long)]
    json: bool,
}

pub async fn run(args: &ScenesArgs) -> anyhow::Result<()> {
    let client = args.server.client()?;
    let scenes = resolve_scene::list_scenes(&client).await?;
    if args.json {
        return print_json(&scenes);
    }
    if scenes.is_empty() {
        eprintln!(
            "no scenes at {} yet: uniground upload SCAN{}",
            args.server.address(),
            args.server.to_flag()
        );
        return Ok(());
    }
    let mut rows = Vec::with_capacity(scenes.len());
    for scene in &scenes {
        rows.push((scene, describe_state(&client, scene).await?));
    }
    Ok(writeln!(io::stdout(), "{}", table::scenes_table(&rows))?)
}

/// Returns the state of a scene as text, with the progress of its parse.
async fn describe_state(client: &Client, scene: &Scene) -> Result<String, ClientError> {
    Ok(match (scene.status, &scene.job_id, &scene.error) {
        (SceneStatus::Parsing, Some(job), _) => {
            let job = client.job(job).await?;
            match job.state {
                JobState::Queued => "queued".into(),
                _ => format!("parsing, {:.0} %", job.progress * 100.0),
            }
        }
        (SceneStatus::Parsing, None, _) => "parsing".into(),
        (SceneStatus::Ready, ..) => "ready".into(),
        (SceneStatus::Uploaded, ..) => "stored, not parsed".into(),
        (SceneStatus::Failed, _, Some(error)) => format!("failed: {}", error.code),
        (SceneStatus::Failed, _, None) => "parse cancelled".into(),
    })
}
