//! `uniground eval`: runs an evaluation suite and compares two reports.

use super::Cli;
use crate::config::{BundlesConfig, VlmConfig};
use crate::words;
use anyhow::{Context, ensure};
use camino::{Utf8Path, Utf8PathBuf};
use clap::error::ErrorKind;
use clap::{Args, CommandFactory, Subcommand};
use std::collections::HashMap;
use std::fs;
use std::io::{self, IsTerminal, Write};
use uniground_endpoints::chat::{ChatClient, ReplayCache};
use uniground_evaluation::comparison::{
    Baseline, Change, describe, expression_key as comparison_key,
};
use uniground_evaluation::configuration::{self, Configuration};
use uniground_evaluation::report::{Report, RunFacts};
use uniground_evaluation::run::{RunOptions, Step, run as run_suite};
use uniground_evaluation::suite::{Suite, SuiteOptions};
use uniground_evaluation::systems::{InProcess, ModelUse, Server, System};

#[derive(Debug, Args)]
#[command(args_conflicts_with_subcommands = true)]
pub struct EvalArgs {
    #[command(subcommand)]
    command: Option<EvalCommand>,
    #[command(flatten)]
    run: RunArgs,
}

#[derive(Debug, Subcommand)]
enum EvalCommand {
    /// Compare two reports and list the expressions whose result changed
    Diff(DiffArgs),
}

#[derive(Debug, Args)]
struct DiffArgs {
    /// Earlier report (its folder or report.json), or a baseline file
    before: Utf8PathBuf,
    /// Later report
    after: Utf8PathBuf,
    /// Print the comparison as JSON
    #[arg(long)]
    json: bool,
}

// clap prints the help without Markdown rendering, so backticks are omitted.
#[allow(clippy::doc_markdown)]
#[derive(Debug, Args)]
struct RunArgs {
    /// Suite to run: a folder with *.queries.json, suite.json or task folders; a list (ScanRefer,
    /// EmbodiedScan); or a table (Nr3D, Sr3D, VLM-Grounder)
    suite: Option<Utf8PathBuf>,
    /// Output folder for report.json, report.md and index.html. Replies are stored there too, so an
    /// interrupted run resumes
    #[arg(long, default_value = "eval-out")]
    out: Utf8PathBuf,
    /// Folder with the scans and annotations of the scenes [default: next to the suite]
    #[arg(long, value_name = "FOLDER")]
    scenes: Option<Utf8PathBuf>,
    /// Configurations to compare: axis=value,value;axis=… with the axes source, names, preset,
    /// masks, encoder, parser, reasoner, candidates, query_text, prompt, ablation, evidence, top_k,
    /// convention, and parse settings such as parsing.merging.max_hop
    #[arg(long, default_value = "", value_parser = check_matrix)]
    matrix: String,
    /// Evaluate a running server instead of this executable. Its key is read from UNIGROUND_API_KEY
    #[arg(long, value_name = "URL")]
    server: Option<String>,
    #[command(flatten)]
    models: BundlesConfig,
    #[command(flatten)]
    vlm: VlmConfig,
    /// Record model replies in this file. Recorded requests are not sent again
    #[arg(long, value_name = "FILE", conflicts_with_all = ["replay", "server"])]
    record: Option<Utf8PathBuf>,
    /// Replay model replies from this file. Sends no requests and costs nothing
    #[arg(long, value_name = "FILE", conflicts_with = "server")]
    replay: Option<Utf8PathBuf>,
    /// Model spending limit for this run, US dollars. Questions beyond it fail
    #[arg(long, value_name = "USD", value_parser = words::usd, conflicts_with = "server")]
    max_usd: Option<f64>,
    /// Number of questions answered in parallel. Use 1 to measure latency
    #[arg(long, default_value_t = 1, value_parser = clap::value_parser!(u16).range(1..=256))]
    concurrency: u16,
    /// Score a random sample of this many expressions. See --seed
    #[arg(long, value_name = "COUNT", value_parser = clap::value_parser!(u32).range(1..))]
    sample: Option<u32>,
    /// Score the expressions of this many random scenes. --sample then draws from these
    #[arg(long, value_name = "COUNT", value_parser = clap::value_parser!(u32).range(1..))]
    sample_scenes: Option<u32>,
    /// Random seed of the sample and the bootstrap
    #[arg(long, default_value_t = 0)]
    seed: u64,
    /// Path of ScanNet's scannetv2-labels.combined.tsv. Splits results into unique and multiple by
    /// ScanRefer's eighteen classes
    #[arg(long, value_name = "FILE")]
    label_map: Option<Utf8PathBuf>,
    /// Pass annotated target classes and anchors to the system, as the paper's code does. The
    /// report states this
    #[arg(long)]
    paper_compatible: bool,
    /// Label of this run in the report, for example the commit
    #[arg(long)]
    label: Option<String>,
    /// Number of failure pictures embedded in the page per cell. Others are linked
    #[arg(long, default_value_t = 200, value_name = "COUNT")]
    embed: usize,
    /// Fail when a cell is significantly worse than in this baseline or report
    #[arg(long, value_name = "FILE")]
    baseline: Option<Utf8PathBuf>,
    /// Write a baseline file for later runs
    #[arg(long, value_name = "FILE")]
    write_baseline: Option<Utf8PathBuf>,
}

fn check_matrix(matrix: &str) -> Result<String, String> {
    configuration::expand_matrix(matrix, &Configuration::default())
        .map(|_| matrix.to_owned())
        .map_err(|error| error.to_string())
}

pub fn run(args: &EvalArgs) -> anyhow::Result<()> {
    match (&args.command, &args.run.suite) {
        (Some(EvalCommand::Diff(diff)), _) => compare(diff),
        (None, Some(suite)) => evaluate(suite, &args.run),
        (None, None) => Cli::command()
            .error(ErrorKind::MissingRequiredArgument, "a suite is required: uniground eval SUITE")
            .exit(),
    }
}

fn evaluate(suite: &Utf8Path, args: &RunArgs) -> anyhow::Result<()> {
    let base =
        Configuration { paper_compatible: args.paper_compatible, ..Configuration::default() };
    let cells = configuration::expand_matrix(&args.matrix, &base)?;
    let baseline =
        args.baseline.as_deref().map(Baseline::read).transpose().context("--baseline")?;
    let options = SuiteOptions { scenes: args.scenes.clone(), label_map: args.label_map.clone() };
    let mut suite = Suite::open(suite, &options)?;
    if let Some(count) = args.sample_scenes {
        suite = suite.sample_by_scene(count as usize, args.seed);
    }
    if let Some(count) = args.sample {
        suite = suite.sample(count as usize, args.seed);
    }
    let system: Box<dyn System> = if let Some(address) = &args.server {
        Box::new(Server::connect(address, std::env::var("UNIGROUND_API_KEY").ok())?)
    } else {
        let usage = ModelUse {
            max_usd: args.max_usd,
            json: args.vlm.vlm_json,
            points: args.vlm.vlm_points.into(),
            limits: args.vlm.picture_limits(),
        };
        let system = InProcess::new(
            &args.models.models,
            args.models.loader(),
            vlm_client(args)?,
            args.record.as_deref(),
            usage,
        )?;
        Box::new(system.with_parse_cache(&args.out.join("parses")))
    };
    suite.omissions.iter().for_each(|omission| eprintln!("left out: {omission}"));
    let run = RunOptions {
        out: &args.out,
        cells: &cells,
        concurrency: args.concurrency.into(),
        progress: &show_progress,
    };
    let results = run_suite(&suite, system.as_ref(), &run)?;
    let facts = RunFacts {
        system: system.name(),
        version: env!("CARGO_PKG_VERSION").into(),
        label: args.label.clone(),
        machine: machine_name(),
        written_at: jiff::Timestamp::now().strftime("%Y-%m-%dT%H:%M:%SZ").to_string(),
        paper_compatible: args.paper_compatible,
        seed: args.seed,
    };
    let report = Report::new(&suite, facts, results);
    report.write(&args.out, args.embed)?;
    let mut out = io::stdout().lock();
    writeln!(out, "{}", report.markdown())?;
    writeln!(out, "{}", args.out.join("index.html"))?;
    print_losses(&report);
    ensure!(
        report.cells.iter().any(|cell| !cell.outcomes.is_empty()),
        "nothing was scored: every expression was skipped"
    );
    let now = Baseline::from_report(&report);
    if let Some(file) = &args.write_baseline {
        now.write(file)?;
    }
    baseline.map_or(Ok(()), |baseline| compare_with_baseline(&baseline, &now, &report, &mut out))
}

/// Prints what was skipped or failed to stderr, since the scores do not show it.
fn print_losses(report: &Report) {
    for cell in &report.cells {
        let all = cell.outcomes.len() + cell.left_out.len();
        if let Some(first) = cell.left_out.first() {
            eprintln!(
                "{}: {} of {all} expressions skipped: {}",
                cell.name,
                cell.left_out.len(),
                first.reason
            );
        }
        let mut errors = cell.outcomes.iter().filter_map(|o| o.error.as_ref());
        if let Some(first) = errors.next() {
            eprintln!("{}: {} of {all} questions failed: {first}", cell.name, errors.count() + 1);
        }
    }
}

/// Returns the client of the model, either live or replaying a record. A record names its model.
fn vlm_client(args: &RunArgs) -> anyhow::Result<Option<ChatClient>> {
    if let Some(file) = &args.replay {
        let (recorded, model) = ReplayCache::replay(file).context("--replay")?;
        let vlm_model = args.vlm.vlm_model.clone().or(Some(model));
        // A replay sends no requests, so any address works.
        let vlm_url = args.vlm.vlm_url.clone().or_else(|| Some("http://localhost".into()));
        return VlmConfig { vlm_url, vlm_model, ..args.vlm.clone() }.client(recorded);
    }
    let cache = args
        .record
        .as_deref()
        .map_or(Ok(ReplayCache::Off), ReplayCache::record)
        .context("--record")?;
    let client = args.vlm.client(cache)?;
    ensure!(
        args.record.is_none() || client.is_some(),
        "--record: no model is configured (--vlm-url, --vlm-model)"
    );
    Ok(client)
}

/// Fails on a significant drop, and when the run lacks cells or expressions of the baseline.
fn compare_with_baseline(
    baseline: &Baseline,
    now: &Baseline,
    report: &Report,
    out: &mut impl Write,
) -> anyhow::Result<()> {
    let queries = queries_by_key(report);
    let (changes, _) = baseline.compare_with(now);
    writeln!(
        out,
        "\nAgainst the baseline{}:\n",
        baseline.label.as_ref().map_or_else(String::new, |label| format!(" ({label})"))
    )?;
    writeln!(out, "{}", describe(&changes, |id| queries.get(id).cloned()))?;
    let missing: Vec<&String> =
        baseline.cells.keys().filter(|name| !now.cells.contains_key(*name)).collect();
    ensure!(missing.is_empty(), "this run lacks cells of the baseline: {missing:?}");
    for (name, before) in &baseline.cells {
        let gone =
            before.right.keys().filter(|id| !now.cells[name].right.contains_key(*id)).count();
        ensure!(gone == 0, "{name}: {gone} expressions of the baseline were not scored");
    }
    let drops: Vec<&str> = changes
        .iter()
        .filter(|c| c.thresholds.iter().any(Change::is_drop))
        .map(|c| c.cell.as_str())
        .collect();
    ensure!(drops.is_empty(), "significantly worse than the baseline: {}", drops.join("; "));
    Ok(())
}

fn compare(args: &DiffArgs) -> anyhow::Result<()> {
    let (before, after) = (Baseline::read(&args.before)?, Baseline::read(&args.after)?);
    let (changes, unpaired) = before.compare_with(&after);
    let mut out = io::stdout().lock();
    if args.json {
        writeln!(out, "{}", serde_json::to_string_pretty(&changes)?)?;
    } else {
        // A baseline stores no query texts.
        let known: HashMap<String, String> = [&args.before, &args.after]
            .into_iter()
            .filter_map(|path| Report::read(path).ok())
            .flat_map(|report| queries_by_key(&report))
            .collect();
        write!(out, "{}", describe(&changes, |id| known.get(id).cloned()))?;
        unpaired
            .iter()
            .try_for_each(|cell| writeln!(out, "{cell}: only in one of the two reports"))?;
    }
    ensure!(!changes.is_empty(), "the two reports have no cell in common");
    Ok(())
}

fn queries_by_key(report: &Report) -> HashMap<String, String> {
    let outcomes = report.cells.iter().flat_map(|cell| &cell.outcomes);
    outcomes.map(|o| (comparison_key(o), o.query.clone())).collect()
}

/// Prints progress on one line that is overwritten. Prints nothing when stderr is not a terminal.
fn show_progress(step: &Step) {
    if io::stderr().is_terminal() {
        eprint!("\r{:>4} of {} {:<24.24} {:<48.48}\r", step.done, step.of, step.scene, step.cell);
    }
}

/// "AMD EPYC 7763, 2 cores"
fn machine_name() -> String {
    let cores = std::thread::available_parallelism().map_or(1, std::num::NonZero::get);
    let info = fs::read_to_string("/proc/cpuinfo").unwrap_or_default();
    let model = info.lines().find_map(|line| line.strip_prefix("model name")?.split_once(':'));
    format!("{}, {cores} cores", model.map_or(std::env::consts::ARCH, |(_, name)| name.trim()))
}
