//! `uniground ground`: one question to a running server.

use super::table;
use crate::words;
use std::io::{self, Write};
use uniground_client::Client;
use uniground_core::grounding::Status;
use uniground_types::question::{EvidenceMode, GroundRequest, ReasonerChoice};

#[derive(Debug, clap::Args)]
pub struct GroundArgs {
    /// What to find, in plain English
    query: String,
    /// Id of a parsed scene
    #[arg(long)]
    scene: String,
    /// Address of the server
    #[arg(long, env = "UNIGROUND_SERVER", default_value = "http://127.0.0.1:8080")]
    server: String,
    /// Candidates to keep
    #[arg(long, default_value_t = 5)]
    top_k: u32,
    /// Who decides: a vision-language model where the server has one, or always, or never
    #[arg(long, default_value = "auto", value_parser = words::reasoner())]
    reasoner: ReasonerChoice,
    /// What a model is shown of the candidates
    #[arg(long, default_value = "full", value_parser = words::evidence())]
    evidence: EvidenceMode,
    /// Most the question may cost, US dollars
    #[arg(long, value_name = "USD")]
    max_cost_usd: Option<f64>,
    /// Print the answer as JSON
    #[arg(long)]
    json: bool,
}

pub async fn run(args: &GroundArgs) -> anyhow::Result<()> {
    let client = Client::new(&args.server, std::env::var("UNIGROUND_API_KEY").ok())?;
    let request = GroundRequest {
        top_k: args.top_k,
        reasoner: args.reasoner,
        evidence: args.evidence,
        max_cost_usd: args.max_cost_usd,
        ..GroundRequest::of(&args.query)
    };
    let answer = client.ground(&args.scene, &request).await?;
    let mut out = io::stdout().lock();
    if args.json {
        writeln!(out, "{}", serde_json::to_string_pretty(&answer)?)?;
    } else {
        writeln!(out, "{}", table::of_answer(&answer))?;
        if answer.status == Status::Ambiguous {
            writeln!(out, "{}", table::of_alternatives(&answer.alternatives))?;
        }
    }
    Ok(())
}
