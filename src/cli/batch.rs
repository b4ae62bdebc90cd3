//! `uniground batch`: sends lists of questions to a running server.

use super::output::print_json;
use super::resolve_scene;
use super::server::ServerArgs;
use crate::words;
use anyhow::{Context, bail, ensure};
use camino::{Utf8Path, Utf8PathBuf};
use indicatif::{ProgressBar, ProgressDrawTarget, ProgressStyle};
use serde_json::{Map, Value, json};
use sha2::{Digest, Sha256};
use std::collections::BTreeMap;
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
    /// Answer every question in a file and write the results in order. Running the same command
    /// again resumes where it stopped
    Run(RunArgs),
}

#[derive(Debug, clap::Args)]
struct RunArgs {
    /// File with one question per line: plain text, or a JSON object with its own scene and any
    /// other request fields. A .csv file names its columns in the first line: question, scene, …
    file: Utf8PathBuf,
    /// Scene for lines that name none: its name, its id, or the beginning of either
    #[arg(long)]
    scene: Option<String>,
    /// Write results to this file, one JSON object per line, or as a table if it ends in .csv
    /// [default: standard output]
    #[arg(long)]
    out: Option<Utf8PathBuf>,
    /// Display name of the batch
    #[arg(long)]
    label: Option<String>,
    /// Number of questions answered in parallel, 1 to 64 [default: 4]
    #[arg(long)]
    concurrency: Option<u32>,
    /// Spending limit for the whole batch, US dollars
    #[arg(long, value_name = "USD", value_parser = words::usd)]
    max_cost_usd: Option<f64>,
    #[command(flatten)]
    server: ServerArgs,
    /// Print the final state of the batch as JSON. Requires --out for the results
    #[arg(long, requires = "out")]
    json: bool,
}

pub async fn run(BatchArgs { command: Command::Run(args) }: &BatchArgs) -> anyhow::Result<()> {
    let client = args.server.client()?;
    let text = fs::read_to_string(&args.file).with_context(|| args.file.to_string())?;
    let lines = match is_csv(&args.file) {
        true => {
            let items = items_of_csv(&text).with_context(|| args.file.to_string())?;
            with_scene_ids(&client, items).await?
        }
        false => to_json_lines(&text),
    };
    let table = args.out.as_deref().filter(|out| is_csv(out));
    let mut out = match table {
        Some(_) => ResultWriter::counting(),
        None => ResultWriter::open(args.out.as_deref())?,
    };
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
        // The server resumes the batch after a restart, so the client keeps polling.
        if let Err(error) = read.await
            && !error.downcast_ref::<ClientError>().is_some_and(is_transient)
        {
            return Err(error);
        }
        batch = match client.batch(&batch.id).await {
            Err(error) if is_transient(&error) => {
                bar.set_message("server unavailable, retrying");
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
    if let Some(table) = table {
        fs::write(table, client.batch_table(&batch.id).await?)
            .with_context(|| table.to_string())?;
    }
    eprintln!("{}", describe_batch(&batch));
    if args.json {
        print_json(&batch)?;
    }
    match batch.state {
        BatchState::Paused => {
            let why = batch.reason.unwrap_or_else(|| "by a user".into());
            bail!("the batch is paused ({why}). Run the same command again to resume it.")
        }
        BatchState::Cancelled => bail!("the batch was cancelled"),
        BatchState::Running | BatchState::Succeeded => Ok(()),
    }
}

/// Delay before the client contacts an unavailable server again.
const AWAY: Duration = Duration::from_secs(1);

/// Submits the batch. The idempotency key is a hash of the questions and options, so submitting the
/// same input again returns the same batch.
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

/// Converts the lines of a file to JSONL. A line that is not a JSON object becomes a question.
fn to_json_lines(text: &str) -> String {
    let lines = text.lines().map(str::trim).filter(|line| !line.is_empty());
    let item = |line: &str| {
        if line.starts_with('{') { line.to_owned() } else { json!({"query": line}).to_string() }
    };
    lines.map(|line| item(line) + "\n").collect()
}

fn is_csv(file: &Utf8Path) -> bool {
    file.extension().is_some_and(|extension| extension.eq_ignore_ascii_case("csv"))
}

/// Items of a table whose header names their fields. A `question` is a `query`, a `scene` a
/// `scene_id`. Empty cells are left out.
fn items_of_csv(text: &str) -> anyhow::Result<Vec<Map<String, Value>>> {
    let mut table = csv::ReaderBuilder::new()
        .trim(csv::Trim::All)
        .from_reader(text.trim_start_matches('\u{feff}').as_bytes());
    let header: Vec<String> = table.headers()?.iter().map(str::to_lowercase).collect();
    let names: Vec<&str> = header
        .iter()
        .map(|name| match name.as_str() {
            "question" => "query",
            "scene" => "scene_id",
            name => name,
        })
        .collect();
    ensure!(
        names.contains(&"query"),
        "the first line must name the columns, one of them \"query\" or \"question\""
    );
    let mut items = Vec::new();
    for row in table.records() {
        let row = row?;
        let cells = names.iter().zip(row.iter()).filter(|(_, cell)| !cell.is_empty());
        items.push(cells.map(|(name, cell)| ((*name).to_owned(), value_of(name, cell))).collect());
    }
    Ok(items)
}

/// Words stay text; numbers, `true`, `false` and JSON become what they say.
fn value_of(name: &str, cell: &str) -> Value {
    match name {
        "query" | "scene_id" | "id" => Value::from(cell),
        _ => serde_json::from_str(cell).unwrap_or_else(|_| Value::from(cell)),
    }
}

/// JSONL of items, with the names of scenes replaced by their ids.
async fn with_scene_ids(client: &Client, items: Vec<Map<String, Value>>) -> anyhow::Result<String> {
    let mut ids: BTreeMap<String, String> = BTreeMap::new();
    let mut lines = String::new();
    for mut item in items {
        if let Some(Value::String(scene)) = item.get_mut("scene_id") {
            let id = match ids.get(scene) {
                Some(id) => id.clone(),
                None => resolve_scene::resolve_id(client, scene).await?,
            };
            ids.insert(scene.clone(), id.clone());
            *scene = id;
        }
        lines += &serde_json::to_string(&item)?;
        lines.push('\n');
    }
    Ok(lines)
}

/// Writes results and counts them.
struct ResultWriter {
    to: Box<dyn Write>,
    lines: u32,
}

impl ResultWriter {
    /// Counts results and writes them nowhere.
    fn counting() -> Self {
        Self { to: Box::new(io::sink()), lines: 0 }
    }

    /// Opens the output for appending after the last complete line.
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

/// Whether retrying the request may succeed.
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
        "batch {}: {} of {} questions done ({}), {}",
        batch.id,
        batch.done,
        batch.items,
        statuses.join(", "),
        format_cost(batch)
    )
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rows_of_a_table_become_items_named_by_its_header() {
        let items = items_of_csv(
            "\u{feff}Question, scene,top_k,id\n\"the mug, red\",kitchen,3,7\nthe sofa,,,\n",
        );
        let items = serde_json::to_value(items.unwrap()).unwrap();
        let expected = json!([
            {"query": "the mug, red", "scene_id": "kitchen", "top_k": 3, "id": "7"},
            {"query": "the sofa"},
        ]);
        assert_eq!(items, expected);
    }

    #[test]
    fn a_table_without_a_column_of_questions_is_an_error() {
        let error = items_of_csv("the mug\nthe sofa\n").unwrap_err().to_string();
        assert!(error.contains("first line"), "{error}");
    }
}
