//! `uniground ground`: one question, about a scan in this process or to a running server.

use super::local::{self, LocalArgs};
use super::output::{alarming, print_json};
use super::server::ServerArgs;
use super::{hints, job_progress, resolve_scene, table, wrong_usage};
use crate::words;
use camino::{Utf8Path, Utf8PathBuf};
use clap::error::ErrorKind;
use std::io::{self, Write};
use uniground_client::{Client, ClientError};
use uniground_core::grounding::Status;
use uniground_types::answer::Answer;
use uniground_types::question::{
    EvidenceMode, FrameChoice, GroundRequest, Observer, ReasonerChoice,
};
use uniground_types::scenes::{Scene, SceneStatus};

#[allow(clippy::doc_markdown)] // Help is no Markdown.
#[derive(Debug, clap::Args)]
#[command(
    allow_missing_positional = true,
    override_usage = "uniground ground [OPTIONS] SCAN QUESTION\n       uniground ground [OPTIONS] --scene SCENE QUESTION",
    after_help = "Exit codes: 0 answered, whatever the status (no match, too); 1 not answered; 2 wrong usage."
)]
pub struct GroundArgs {
    /// A scan to ask about without a server: a folder, an archive, a .sens or .r3d file, a cloud
    /// or a mesh
    #[arg(value_name = "SCAN", conflicts_with = "scene")]
    scan: Option<Utf8PathBuf>,
    /// What to find, in plain English
    #[arg(value_name = "QUESTION", required = true)]
    query: String,
    /// A scene of a server to ask about: its name, its id, or how one of them begins
    #[arg(long)]
    scene: Option<String>,
    #[command(flatten)]
    server: ServerArgs,
    /// Wait for a scene that is still being parsed
    #[arg(long, requires = "scene")]
    wait: bool,
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
    #[arg(long, value_name = "USD", value_parser = words::usd)]
    max_cost_usd: Option<f64>,
    /// Who "me" is, and from where left and right are seen: metres, and the direction of view in
    /// degrees from +X towards +Y. Without Z, eyes are at 1.5 m
    #[arg(long, value_name = "X,Y[,Z],YAW", allow_hyphen_values = true, value_parser = eyes)]
    observer: Option<ObserverArg>,
    /// Whose coordinates --observer is in, and boxes are told in beside the scene's own
    #[arg(long, default_value = "scene", value_parser = words::frame())]
    frame: FrameChoice,
    /// Print the answer as JSON
    #[arg(long)]
    json: bool,
    #[command(flatten, next_help_heading = "Options without a server")]
    local: LocalArgs,
}

/// Somebody who stands in the room, as the command line has it.
#[derive(Debug, Clone, Copy, PartialEq)]
struct ObserverArg {
    at: [f64; 2],
    z: Option<f64>,
    yaw_deg: f64,
}

/// Above a floor at zero, where nobody says.
const EYE_HEIGHT_M: f64 = 1.5;

fn eyes(text: &str) -> Result<ObserverArg, String> {
    let numbers: Option<Vec<f64>> = text
        .split(',')
        .map(|number| number.trim().parse().ok().filter(|number: &f64| number.is_finite()))
        .collect();
    match numbers.as_deref() {
        Some(&[x, y, yaw_deg]) => Ok(ObserverArg { at: [x, y], z: None, yaw_deg }),
        Some(&[x, y, z, yaw_deg]) => Ok(ObserverArg { at: [x, y], z: Some(z), yaw_deg }),
        _ => Err("expected x,y,yaw or x,y,z,yaw: metres, and degrees from +X towards +Y".into()),
    }
}

impl ObserverArg {
    fn observer(self) -> Observer {
        let [x, y] = self.at;
        Observer {
            position: [x, y, self.z.unwrap_or(EYE_HEIGHT_M)],
            yaw_rad: self.yaw_deg.to_radians() as f32,
        }
    }
}

pub async fn run(args: &GroundArgs) -> anyhow::Result<()> {
    let usage = |kind, message: &str| -> ! { wrong_usage("ground", kind, message) };
    if args.frame == FrameChoice::Source && args.observer.is_some_and(|eyes| eyes.z.is_none()) {
        // Files may have another axis up, and other units.
        usage(
            ErrorKind::ValueValidation,
            "--observer: in the files' own coordinates all of x,y,z,yaw are wanted",
        );
    }
    let request = GroundRequest {
        top_k: args.top_k,
        reasoner: args.reasoner,
        evidence: args.evidence,
        max_cost_usd: args.max_cost_usd,
        observer: args.observer.map(ObserverArg::observer),
        frame: args.frame,
        ..GroundRequest::new(&args.query)
    };
    let answer = match (&args.scan, &args.scene) {
        (Some(_), _) if args.server.given().is_some() => usage(
            ErrorKind::ArgumentConflict,
            "a scan is asked about in this process, without --server; to ask a server: uniground upload SCAN, then \
             uniground ground --scene SCENE QUESTION",
        ),
        (Some(_), _) if args.frame == FrameChoice::Map => usage(
            ErrorKind::ArgumentConflict,
            "a scan on the disk lies in no map: --frame map is for scenes of a server that were told where",
        ),
        (Some(scan), _) => Box::pin(local::answer(scan, &args.local, request)).await?,
        (None, Some(scene)) => ask(args, scene, &request).await?,
        (None, None) if Utf8Path::new(&args.query).exists() => usage(
            ErrorKind::MissingRequiredArgument,
            &format!("what is to be found in {}? The question comes after the scan", args.query),
        ),
        (None, None) => usage(
            ErrorKind::MissingRequiredArgument,
            "where is it to be found? uniground ground SCAN QUESTION asks about a scan on the disk, --scene SCENE about one of a server",
        ),
    };
    match args.json {
        true => print_json(&answer),
        false => print(&answer),
    }
}

async fn ask(args: &GroundArgs, scene: &str, request: &GroundRequest) -> anyhow::Result<Answer> {
    let client = args.server.client()?;
    let id = resolve_scene::id_of(&client, scene).await?;
    let asked = match client.ground(&id, request).await {
        Err(ClientError::Problem(problem)) if problem.code == "scene_not_ready" => {
            match (args.wait, &problem.job_id) {
                (true, Some(job)) => {
                    wait(&client, job).await?;
                    client.ground(&id, request).await
                }
                _ => return Err(not_ready(&client, &id, ClientError::Problem(problem)).await),
            }
        }
        asked => asked,
    };
    match asked {
        Ok(answer) => Ok(answer),
        Err(error) => Err(resolve_scene::known_or(&client, scene, error).await),
    }
}

/// Why a scene has no parse, and what helps.
async fn not_ready(client: &Client, id: &str, error: ClientError) -> anyhow::Error {
    match client.scene(id).await {
        Ok(Scene { error: Some(why), .. }) => hints::ParseFailed(why).into(),
        Ok(Scene { status: SceneStatus::Parsing, .. }) => hints::ended(
            &error.into(),
            "--wait waits until it is; `uniground scenes` tells how far it has come",
        ),
        _ => error.into(),
    }
}

async fn wait(client: &Client, job_id: &str) -> anyhow::Result<()> {
    eprintln!("waiting for the parse");
    job_progress::outcome(&job_progress::follow(client, job_id).await?).map(drop)
}

fn print(answer: &Answer) -> anyhow::Result<()> {
    let mut out = io::stdout().lock();
    writeln!(out, "{}", table::of_answer(answer))?;
    if answer.status == Status::Ambiguous {
        writeln!(out, "{}", table::of_alternatives(&answer.alternatives))?;
    }
    if answer.degraded {
        writeln!(out, "{}", alarming(&without_model(answer)))?;
    }
    Ok(())
}

/// That a built-in part answered where a model was to, and why.
fn without_model(answer: &Answer) -> String {
    let why = answer.trace.iter().flat_map(|trace| &trace.corrections).map(String::as_str);
    std::iter::once("DEGRADED: a model was to take part in this answer and did not; built-in parts took its place")
        .chain(why)
        .collect::<Vec<_>>()
        .join("\n  ")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_observer_has_a_place_and_looks_somewhere() {
        let observer = eyes("1, -2.5,90").unwrap().observer();
        assert_eq!(observer.position, [1.0, -2.5, EYE_HEIGHT_M]);
        assert!((observer.yaw_rad - std::f32::consts::FRAC_PI_2).abs() < 1e-6);
        assert_eq!(eyes("1,2,0.4,0").unwrap().observer().position[2], 0.4);
        for wrong in ["", "1,2", "1,2,3,4,5", "1,2,north", "1,2,inf"] {
            assert!(eyes(wrong).is_err(), "{wrong}");
        }
    }
}
