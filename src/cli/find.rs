//! `uniground find`: finds the scenes of a server that contain an object.

use super::output::print_json;
use super::server::ServerArgs;
use super::{resolve_scene, table};
use crate::words;
use anyhow::bail;
use std::io::{self, Write};
use uniground_types::answer::Status;
use uniground_types::labels::{Labels, read_labels};
use uniground_types::many::{ManyAnswers, ManyGroundRequest, SceneAnswer};
use uniground_types::question::ReasonerChoice;

#[allow(clippy::doc_markdown)] // Help is plain text.
#[derive(Debug, clap::Args)]
#[command(
    after_help = "Exit codes: 0 found, surely or not; 1 found in no scene, or an error; 2 invalid arguments."
)]
pub struct FindArgs {
    /// Description of the object in English
    #[arg(value_name = "QUESTION")]
    query: String,
    /// Search only this scene: its name, its id, or the beginning of either. May be repeated
    #[arg(long, value_name = "SCENE")]
    scene: Vec<String>,
    /// Search only scenes with all of these labels
    #[arg(long, value_name = "NAME=VALUE,...", value_parser = parse_labels)]
    labels: Option<Labels>,
    /// Number of scenes answered in full
    #[arg(long, default_value_t = 3, value_parser = clap::value_parser!(u32).range(1..=20))]
    top_k: u32,
    /// Which reasoner decides: a vision-language model if the server has one (auto), always, or
    /// never
    #[arg(long, default_value = "auto", value_parser = words::reasoner())]
    reasoner: ReasonerChoice,
    /// Spending limit for the whole search, US dollars
    #[arg(long, value_name = "USD", value_parser = words::usd)]
    max_cost_usd: Option<f64>,
    /// Print the answers as JSON
    #[arg(long)]
    json: bool,
    #[command(flatten)]
    server: ServerArgs,
}

fn parse_labels(text: &str) -> Result<Labels, String> {
    read_labels("labels", text).map_err(|error| error.detail)
}

pub async fn run(args: &FindArgs) -> anyhow::Result<()> {
    let client = args.server.client()?;
    let mut scenes = Vec::new();
    for scene in &args.scene {
        scenes.push(resolve_scene::resolve_id(&client, scene).await?);
    }
    let request = ManyGroundRequest {
        scenes: Some(scenes).filter(|scenes| !scenes.is_empty()),
        labels: args.labels.clone().unwrap_or_default(),
        top_k: args.top_k,
        reasoner: args.reasoner,
        max_cost_usd: args.max_cost_usd,
        ..ManyGroundRequest::new(&args.query)
    };
    let found = client.ground_many(&request).await?;
    match args.json {
        true => print_json(&found)?,
        false => print(&found)?,
    }
    let is_found = |of: &SceneAnswer| of.answer.status != Status::NoMatch;
    if !found.answers.iter().any(is_found) {
        bail!("\"{}\" was found in none of the scenes", args.query);
    }
    Ok(())
}

fn print(found: &ManyAnswers) -> anyhow::Result<()> {
    if !found.answers.is_empty() {
        writeln!(io::stdout(), "{}", table::many_answers_table(found))?;
    }
    let left_out = match found.not_asked.len() {
        0 => String::new(),
        left_out => format!(", {left_out} could not be searched: {}", found.not_asked[0].detail),
    };
    let narrowed = if found.narrowed { ", the most likely of more than 1,000" } else { "" };
    eprintln!("{} searched{narrowed}{left_out}", count_of_scenes(found.looked_into));
    Ok(())
}

fn count_of_scenes(scenes: u32) -> String {
    format!("{scenes} scene{}", if scenes == 1 { "" } else { "s" })
}
