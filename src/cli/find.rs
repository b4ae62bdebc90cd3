//! `uniground find`: in which of a server's scenes something is.

use super::output::print_json;
use super::server::ServerArgs;
use super::{resolve_scene, table};
use crate::words;
use std::io::{self, Write};
use uniground_types::labels::{Labels, read_labels};
use uniground_types::many::{ManyAnswers, ManyGroundRequest};
use uniground_types::question::ReasonerChoice;

#[allow(clippy::doc_markdown)] // Help is no Markdown.
#[derive(Debug, clap::Args)]
#[command(
    after_help = "Exit codes: 0 answered, whether it was found or not; 1 not answered; 2 wrong usage."
)]
pub struct FindArgs {
    /// What to find, in plain English
    #[arg(value_name = "QUESTION")]
    query: String,
    /// Look in this scene alone: its name, its id, or how one of them begins; may be given several
    /// times
    #[arg(long, value_name = "SCENE")]
    scene: Vec<String>,
    /// Look only in scenes with these labels
    #[arg(long, value_name = "NAME=VALUE,...", value_parser = labels)]
    labels: Option<Labels>,
    /// How many scenes are answered in full
    #[arg(long, default_value_t = 3, value_parser = clap::value_parser!(u32).range(1..=20))]
    top_k: u32,
    /// Who decides: a vision-language model where the server has one, or always, or never
    #[arg(long, default_value = "auto", value_parser = words::reasoner())]
    reasoner: ReasonerChoice,
    /// Most all of it may cost, US dollars
    #[arg(long, value_name = "USD", value_parser = words::usd)]
    max_cost_usd: Option<f64>,
    /// Print the answers as JSON
    #[arg(long)]
    json: bool,
    #[command(flatten)]
    server: ServerArgs,
}

fn labels(text: &str) -> Result<Labels, String> {
    read_labels("labels", text).map_err(|error| error.detail)
}

pub async fn run(args: &FindArgs) -> anyhow::Result<()> {
    let client = args.server.client()?;
    let mut scenes = Vec::new();
    for scene in &args.scene {
        scenes.push(resolve_scene::id_of(&client, scene).await?);
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
        true => print_json(&found),
        false => print(&found),
    }
}

fn print(found: &ManyAnswers) -> anyhow::Result<()> {
    if !found.answers.is_empty() {
        writeln!(io::stdout(), "{}", table::of_many(found))?;
    }
    let left_out = match found.not_asked.len() {
        0 => String::new(),
        left_out => format!(", {left_out} could not be asked: {}", found.not_asked[0].detail),
    };
    let narrowed =
        if found.narrowed { ", the likeliest of more than there is time for" } else { "" };
    eprintln!("{} looked into{narrowed}{left_out}", counted(found.looked_into));
    Ok(())
}

fn counted(scenes: u32) -> String {
    format!("{scenes} scene{}", if scenes == 1 { "" } else { "s" })
}
