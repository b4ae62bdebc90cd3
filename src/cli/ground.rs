//! `uniground ground`: answers one question about a local scan or a scene of a running server.

use super::local::{self, LocalArgs};
use super::output::{in_red_on_terminal, print_json};
use super::server::ServerArgs;
use super::{exit_with_usage_error, hints, job_progress, resolve_scene, table};
use crate::words;
use camino::{Utf8Path, Utf8PathBuf};
use clap::error::ErrorKind;
use std::io::{self, Write};
use uniground_client::{Client, ClientError};
use uniground_core::grounding::Status;
use uniground_types::answer::Answer;
use uniground_types::question::{
    EvidenceMode, FrameChoice, GroundRequest, Observer, QuestionContext, ReasonerChoice, WaitFor,
};
use uniground_types::scene::InstanceId;
use uniground_types::scenes::{ParseQuality, Scene, SceneStatus};

#[allow(clippy::doc_markdown)] // Help is plain text.
#[derive(Debug, clap::Args)]
#[command(
    allow_missing_positional = true,
    override_usage = "uniground ground [OPTIONS] SCAN QUESTION\n       uniground ground [OPTIONS] --scene SCENE QUESTION",
    after_help = "Exit codes: 0 answered, even if nothing matches; 1 error; 2 invalid arguments."
)]
pub struct GroundArgs {
    /// Local scan to ask about, without a server: a folder, an archive, a .sens or .r3d file, a
    /// point cloud or a mesh
    #[arg(value_name = "SCAN", conflicts_with = "scene")]
    scan: Option<Utf8PathBuf>,
    /// Description of the object in English
    #[arg(value_name = "QUESTION", required = true)]
    query: String,
    /// Scene of a server to ask about: its name, its id, or the beginning of either
    #[arg(long)]
    scene: Option<String>,
    #[command(flatten)]
    server: ServerArgs,
    /// Wait for the scene if it is still being parsed; with =full, also for the full parse after a
    /// draft
    #[arg(long, requires = "scene", num_args = 0..=1, require_equals = true, default_missing_value = "draft", value_name = "PARSE", value_parser = words::wait())]
    wait: Option<ParseQuality>,
    /// Maximum number of candidates
    #[arg(long, default_value_t = 5)]
    top_k: u32,
    /// Which reasoner decides: a vision-language model if the server has one (auto), always, or
    /// never
    #[arg(long, default_value = "auto", value_parser = words::reasoner())]
    reasoner: ReasonerChoice,
    /// What the model is shown of each candidate
    #[arg(long, default_value = "full", value_parser = words::evidence())]
    evidence: EvidenceMode,
    /// Spending limit for the question, US dollars
    #[arg(long, value_name = "USD", value_parser = words::usd)]
    max_cost_usd: Option<f64>,
    /// Observer for "me", left and right: position in meters and view direction in degrees from +X
    /// towards +Y. Without Z, the eye height is 1.5 m
    #[arg(long, value_name = "X,Y[,Z],YAW", allow_hyphen_values = true, value_parser = parse_observer)]
    observer: Option<ObserverArg>,
    /// Coordinate frame of --observer, and an additional frame for the boxes of the answer
    #[arg(long, default_value = "scene", value_parser = words::frame())]
    frame: FrameChoice,
    /// Earlier answer that the question refers to ("and the blue one?", "how big is it?")
    #[arg(long, value_name = "ANSWER_ID", requires = "scene")]
    after: Option<String>,
    /// Conversation that the question belongs to: an id of your choice. The question follows the
    /// latest answer of the conversation
    #[arg(long, value_name = "SESSION", requires = "scene", conflicts_with = "after")]
    session: Option<String>,
    /// Instance that "this" in the question means
    #[arg(long, value_name = "INSTANCE")]
    this: Option<u32>,
    /// Print the answer as JSON
    #[arg(long)]
    json: bool,
    #[command(flatten, next_help_heading = "Options without a server")]
    local: LocalArgs,
}

/// The value of `--observer`.
#[derive(Debug, Clone, Copy, PartialEq)]
struct ObserverArg {
    at: [f64; 2],
    z: Option<f64>,
    yaw_deg: f64,
}

/// Default eye height above a floor at zero.
const EYE_HEIGHT_M: f64 = 1.5;

fn parse_observer(text: &str) -> Result<ObserverArg, String> {
    let numbers: Option<Vec<f64>> = text
        .split(',')
        .map(|number| number.trim().parse().ok().filter(|number: &f64| number.is_finite()))
        .collect();
    match numbers.as_deref() {
        Some(&[x, y, yaw_deg]) => Ok(ObserverArg { at: [x, y], z: None, yaw_deg }),
        Some(&[x, y, z, yaw_deg]) => Ok(ObserverArg { at: [x, y], z: Some(z), yaw_deg }),
        _ => Err(
            "expected x,y,yaw or x,y,z,yaw in meters, with the yaw in degrees from +X towards +Y"
                .into(),
        ),
    }
}

impl ObserverArg {
    fn to_observer(self) -> Observer {
        let [x, y] = self.at;
        Observer {
            position: [x, y, self.z.unwrap_or(EYE_HEIGHT_M)],
            yaw_rad: self.yaw_deg.to_radians() as f32,
        }
    }
}

pub async fn run(args: &GroundArgs) -> anyhow::Result<()> {
    let usage = |kind, message: &str| -> ! { exit_with_usage_error("ground", kind, message) };
    if args.frame == FrameChoice::Source && args.observer.is_some_and(|eyes| eyes.z.is_none()) {
        // The files may have another up axis and other units.
        usage(ErrorKind::ValueValidation, "--observer: with --frame source, give all of x,y,z,yaw");
    }
    let request = GroundRequest {
        top_k: args.top_k,
        reasoner: args.reasoner,
        evidence: args.evidence,
        max_cost_usd: args.max_cost_usd,
        observer: args.observer.map(ObserverArg::to_observer),
        frame: args.frame,
        wait: args.wait.filter(|wait| *wait == ParseQuality::Full).map(|_| WaitFor::Full),
        context: Some(QuestionContext {
            answer_id: args.after.clone(),
            session: args.session.clone(),
            instance: args.this.map(InstanceId),
            item: None,
        })
        .filter(|context| *context != QuestionContext::default()),
        ..GroundRequest::new(&args.query)
    };
    let answer = match (&args.scan, &args.scene) {
        (Some(_), _) if args.server.explicit_address().is_some() => usage(
            ErrorKind::ArgumentConflict,
            "a local scan is processed without a server, so --server cannot be used. To ask a \
             server, run uniground upload SCAN, then uniground ground --scene SCENE QUESTION",
        ),
        (Some(_), _) if args.frame == FrameChoice::Map => usage(
            ErrorKind::ArgumentConflict,
            "--frame map cannot be used with a local scan. It needs a scene of a server that has a \
             map transform.",
        ),
        (Some(scan), _) => Box::pin(local::answer(scan, &args.local, request)).await?,
        (None, Some(scene)) => ask(args, scene, &request).await?,
        (None, None) if Utf8Path::new(&args.query).exists() => usage(
            ErrorKind::MissingRequiredArgument,
            &format!("the question is missing. Give it after the scan {}.", args.query),
        ),
        (None, None) => usage(
            ErrorKind::MissingRequiredArgument,
            "the scan or the scene is missing. Use uniground ground SCAN QUESTION for a local \
             scan, or --scene SCENE for a scene of a server.",
        ),
    };
    match args.json {
        true => print_json(&answer),
        false => print(&answer),
    }
}

async fn ask(args: &GroundArgs, scene: &str, request: &GroundRequest) -> anyhow::Result<Answer> {
    let client = args.server.client()?;
    let id = resolve_scene::resolve_id(&client, scene).await?;
    let asked = match client.ground(&id, request).await {
        Err(ClientError::Problem(problem)) if problem.code == "scene_not_ready" => {
            match (args.wait, &problem.job_id) {
                (Some(_), Some(job)) => {
                    wait(&client, job).await?;
                    client.ground(&id, request).await
                }
                _ => {
                    return Err(
                        explain_not_ready(&client, &id, ClientError::Problem(problem)).await
                    );
                }
            }
        }
        asked => asked,
    };
    match asked {
        Ok(answer) => Ok(answer),
        Err(error) => Err(resolve_scene::explain_unknown_scene(&client, scene, error).await),
    }
}

/// Returns why a scene has no parse, with a hint.
async fn explain_not_ready(client: &Client, id: &str, error: ClientError) -> anyhow::Error {
    match client.scene(id).await {
        Ok(Scene { error: Some(why), .. }) => hints::ParseFailed(why).into(),
        Ok(Scene { status: SceneStatus::Parsing, .. }) => hints::with_last_line(
            &error.into(),
            "--wait waits until it is ready; `uniground scenes` shows the progress",
        ),
        _ => error.into(),
    }
}

async fn wait(client: &Client, job_id: &str) -> anyhow::Result<()> {
    eprintln!("waiting for the parse");
    job_progress::describe_outcome(&job_progress::follow_job(client, job_id).await?).map(drop)
}

fn print(answer: &Answer) -> anyhow::Result<()> {
    let mut out = io::stdout().lock();
    writeln!(out, "{}", answer.text)?;
    writeln!(out, "{}", table::answer_table(answer))?;
    if answer.status == Status::Ambiguous {
        writeln!(out, "{}", table::alternatives_table(&answer.alternatives))?;
    }
    if answer.degraded {
        writeln!(out, "{}", in_red_on_terminal(&describe_fallback(answer)))?;
    }
    Ok(())
}

/// Returns a warning that a built-in component replaced a model, with the reasons.
fn describe_fallback(answer: &Answer) -> String {
    let why = answer.trace.iter().flat_map(|trace| &trace.corrections).map(String::as_str);
    std::iter::once(
        "DEGRADED: a model could not be used for this answer; built-in components replaced it",
    )
    .chain(why)
    .collect::<Vec<_>>()
    .join("\n  ")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_observer_is_parsed_from_position_and_yaw() {
        let observer = parse_observer("1, -2.5,90").unwrap().to_observer();
        assert_eq!(observer.position, [1.0, -2.5, EYE_HEIGHT_M]);
        assert!((observer.yaw_rad - std::f32::consts::FRAC_PI_2).abs() < 1e-6);
        assert_eq!(parse_observer("1,2,0.4,0").unwrap().to_observer().position[2], 0.4);
        for wrong in ["", "1,2", "1,2,3,4,5", "1,2,north", "1,2,inf"] {
            assert!(parse_observer(wrong).is_err(), "{wrong}");
        }
    }
}
