//! `uniground batch`: lists of questions to a running server.

use super::output::print_json;
use super::resolve_scene;
use super::server::ServerArgs;
use crate::words;
use anyhow::{Context, bail};
use camino::{Utf8Path, Utf8PathBuf};
use indicatif::{ProgressBar, ProgressDrawTarget, ProgressStyle};
use serde_json::json;
use sha2::{Digest, Sha256};
use std::fs::{self, File, OpenOptions};
use std::io::{self, Write};
use std::time::Duration;
use uniground_client::{Client, ClientError};
use uniground_types::batch::{Batch, BatchState};

#[derive(Debug, clap::Args)]
pub struct BatchArgs {
    #[command(subcommand)]
    command: Command,
}

#[derive(Debug, clap::Subcommand)]
enum Command {
    /// Ask every question of a file and write the answers, in order; the same command again goes on
    /// where it stopped
    Run(RunArgs),
}

#[derive(Debug, clap::Args)]
struct RunArgs {
    /// Questions, a line each: plain, or as JSON with a scene of their own and whatever else a
    /// question may have
    file: Utf8PathBuf,
    /// The scene of lines that name none: its name, its id, or how one of them begins
    #[arg(long)]
    scene: Option<String>,
    /// Where results go, a line of JSON each; default: standard output
    #[arg(long)]
    out: Option<Utf8PathBuf>,
    /// For people
    #[arg(long)]
    label: Option<String>,
    /// Questions asked at once
    #[arg(long)]
    concurrency: Option<u32>,
    /// Most that all questions together may cost, US dollars
    #[arg(long, value_name = "USD", value_parser = words::usd)]
    max_cost_usd: Option<f64>,
    #[command(flatten)]
    server: ServerArgs,
    /// Print what became of the batch as JSON; results then go to --out
    #[arg(long, requires = "out")]
    json: bool,
}

pub async fn run(BatchArgs { command: Command::Run(args) }: &BatchArgs) -> anyhow::Result<()> {
    let client = args.server.client()?;
    let lines =
        to_json_lines(&fs::read_to_string(&args.file).with_context(|| args.file.to_string())?);
    let mut out = ResultWriter::open(args.out.as_deref())?;
    let scene = match &args.scene {
        Some(scene) => Some(resolve_scene::resolve_id(&client, scene).await?),
        None => None,
    };
    let mut batch = submit(&client, args, scene, lines).await?;
    let bar = progress_bar(batch.items);
    loop {
        bar.set_position(u64::from(out.lines));
        let read = client.batch_results(&batch.id, out.lines, true, |line, result| {
            out.write(line)?;
            bar.set_position(u64::from(result.item) + 1);
            Ok::<(), anyhow::Error>(())
        });
        // A server that is restarted goes on with the batch; so does this.
        if let Err(error) = read.await
            && !error.downcast_ref::<ClientError>().is_some_and(is_transient)
        {
            return Err(error);
        }
        batch = match client.batch(&batch.id).await {
            Err(error) if is_transient(&error) => {
                bar.set_message("the server is away");
                tokio::time::sleep(AWAY).await;
                continue;
            }
            batch => batch?,
        };
        bar.set_message(format_cost(&batch));
        let is_over = batch.state.is_final() && out.lines >= batch.done;
        if is_over || batch.state == BatchState::Paused || batch.state == BatchState::Cancelled {
            break;
        }
    }
    bar.finish_and_clear();
    eprintln!("{}", describe_batch(&batch));
    if args.json {
        print_json(&batch)?;
    }
    match batch.state {
        BatchState::Paused => {
            let why = batch.reason.unwrap_or_else(|| "somebody paused it".into());
            bail!("the batch is paused ({why}): the same command goes on with it")
        }
        BatchState::Cancelled => bail!("the batch was cancelled"),
        BatchState::Running | BatchState::Succeeded => Ok(()),
    }
}

/// How long a server that is away is waited for before it is asked again.
const AWAY: Duration = Duration::from_secs(1);

/// The same questions under the same options are the same batch, however often they are submitted.
async fn submit(
    client: &Client,
    args: &RunArgs,
    scene: Option<String>,
    lines: String,
) -> anyhow::Result<Batch> {
    let options = [
        ("scene_id", scene),
        ("label", args.label.clone()),
        ("concurrency", args.concurrency.map(|c| c.to_string())),
        ("max_cost_usd", args.max_cost_usd.map(|usd| usd.to_string())),
    ];
    let query: Vec<(&str, String)> =
        options.into_iter().filter_map(|(name, value)| Some((name, value?))).collect();
    let digest = Sha256::digest(serde_json::to_vec(&(&lines, &query))?);
    let key: String = digest.iter().map(|byte| format!("{byte:02x}")).collect();
    let batch = client.create_batch_of_lines(lines, &query, Some(&key)).await?;
    match batch.state {
        BatchState::Paused => Ok(client.control_batch(&batch.id, "resume").await?),
        _ => Ok(batch),
    }
}

/// JSONL of a file's lines; a line that is no JSON object is a question.
fn to_json_lines(text: &str) -> String {
    let lines = text.lines().map(str::trim).filter(|line| !line.is_empty());
    let item = |line: &str| {
        if line.starts_with('{') { line.to_owned() } else { json!({"query": line}).to_string() }
    };
    lines.map(|line| item(line) + "\n").collect()
}

/// Results that are written, and how many there are.
struct ResultWriter {
    to: Box<dyn Write>,
    lines: u32,
}

impl ResultWriter {
    /// Goes on behind the last whole line.
    fn open(path: Option<&Utf8Path>) -> anyhow::Result<Self> {
        let Some(path) = path else { return Ok(Self { to: Box::new(io::stdout()), lines: 0 }) };
        let before = if path.exists() {
            fs::read(path).with_context(|| path.to_string())?
        } else {
            Vec::new()
        };
        let whole = before.iter().rposition(|byte| *byte == b'\n').map_or(0, |end| end + 1);
        let lines = before[..whole].split_inclusive(|byte| *byte == b'\n').count();
        let file: File = OpenOptions::new()
            .create(true)
            .append(true)
            .open(path)
            .with_context(|| path.to_string())?;
        file.set_len(whole as u64)?;
        Ok(Self { to: Box::new(file), lines: u32::try_from(lines)? })
    }

    fn write(&mut self, line: &[u8]) -> io::Result<()> {
        self.to.write_all(line)?;
        self.lines += 1;
        Ok(())
    }
}

/// Whether the server may be there again in a moment.
fn is_transient(error: &ClientError) -> bool {
    match error {
        ClientError::Transport(_) => true,
        ClientError::Problem(problem) => problem.retry_after_s.is_some(),
        _ => false,
    }
}

fn progress_bar(items: u32) -> ProgressBar {
    let bar = ProgressBar::with_draw_target(Some(u64::from(items)), ProgressDrawTarget::stderr());
    if let Ok(style) =
        ProgressStyle::with_template("{bar:40} {pos}/{len}  {per_sec}  {eta} left  {msg}")
    {
        bar.set_style(style);
    }
    bar
}

fn format_cost(batch: &Batch) -> String {
    format!("{:.4} USD", batch.cost_usd)
}

fn describe_batch(batch: &Batch) -> String {
    let statuses: Vec<String> =
        batch.by_status.iter().map(|(status, number)| format!("{number} {status}")).collect();
    format!(
        "batch {}: {} of {} questions asked ({}), {}",
        batch.id,
        batch.done,
        batch.items,
        statuses.join(", "),
        format_cost(batch)
    )
}
