//! `uniground eval`: a suite through the system, and two reports side by side.

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
    /// Compare two reports: which expressions flipped
    Diff(DiffArgs),
}

#[derive(Debug, Args)]
struct DiffArgs {
    /// The earlier report (its folder or report.json), or a baseline
    before: Utf8PathBuf,
    /// The later report
    after: Utf8PathBuf,
    /// Print the comparison as JSON
    #[arg(long)]
    json: bool,
}

// Help is read on a terminal, where backticks are noise.
#[allow(clippy::doc_markdown)]
#[derive(Debug, Args)]
struct RunArgs {
    /// A folder with *.queries.json, suite.json or task folders; or a list (ScanRefer,
    /// EmbodiedScan) or table (Nr3D, Sr3D, VLM-Grounder)
    suite: Option<Utf8PathBuf>,
    /// Write report.json, report.md, index.html here; replies are kept here too, so that a run
    /// goes on where it stopped
    #[arg(long, default_value = "eval-out")]
    out: Utf8PathBuf,
    /// Where scans and annotations of the scenes lie, if not beside the suite
    #[arg(long, value_name = "FOLDER")]
    scenes: Option<Utf8PathBuf>,
    /// What to vary: `axis=value,value;axis=…` over source, names, preset, masks, encoder, parser,
    /// reasoner, candidates, query_text, prompt, ablation, evidence, top_k, convention, and
    /// settings of a parse like parsing.merging.max_hop
    #[arg(long, default_value = "", value_parser = check_matrix)]
    matrix: String,
    /// Ask a running server instead of this executable (its key: UNIGROUND_API_KEY)
    #[arg(long, value_name = "URL")]
    server: Option<String>,
    #[command(flatten)]
    models: BundlesConfig,
    #[command(flatten)]
    vlm: VlmConfig,
    /// Record every answer of the model here; what is recorded already is not asked again
    #[arg(long, value_name = "FILE", conflicts_with_all = ["replay", "server"])]
    record: Option<Utf8PathBuf>,
    /// Take the model's answers from this record: nothing is asked and nothing costs
    #[arg(long, value_name = "FILE", conflicts_with = "server")]
    replay: Option<Utf8PathBuf>,
    /// Most the model may cost in this run, US dollars: questions past that fail
    #[arg(long, value_name = "USD", value_parser = words::usd, conflicts_with = "server")]
    max_usd: Option<f64>,
    /// Questions asked at once; latencies are honest with one
    #[arg(long, default_value_t = 1, value_parser = clap::value_parser!(u16).range(1..=256))]
    concurrency: u16,
    /// Score this many expressions, drawn by --seed
    #[arg(long, value_name = "COUNT", value_parser = clap::value_parser!(u32).range(1..))]
    sample: Option<u32>,
    /// Score the expressions of this many scenes, drawn by --seed; --sample then draws among these
    #[arg(long, value_name = "COUNT", value_parser = clap::value_parser!(u32).range(1..))]
    sample_scenes: Option<u32>,
    /// Of the sample and of the bootstrap
    #[arg(long, default_value_t = 0)]
    seed: u64,
    /// ScanNet's scannetv2-labels.combined.tsv: tells unique from multiple by ScanRefer's eighteen
    /// classes
    #[arg(long, value_name = "FILE")]
    label_map: Option<Utf8PathBuf>,
    /// Hand over annotated target classes and anchors, as the paper's code does; the report says
    /// so
    #[arg(long)]
    paper_compatible: bool,
    /// What to call this run in the report, e.g. the commit
    #[arg(long)]
    label: Option<String>,
    /// Pictures of failures that become part of the page, per cell; the rest are links
    #[arg(long, default_value_t = 200, value_name = "COUNT")]
    embed: usize,
    /// Fail when a cell is worse than in this baseline or report by more than luck
    #[arg(long, value_name = "FILE")]
    baseline: Option<Utf8PathBuf>,
    /// Write what later runs are held against
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
            .error(ErrorKind::MissingRequiredArgument, "a suite is needed: uniground eval SUITE")
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
        let usage = ModelUse { max_usd: args.max_usd, json: args.vlm.vlm_json };
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
        "nothing was scored: every expression was left out"
    );
    let now = Baseline::from_report(&report);
    if let Some(file) = &args.write_baseline {
        now.write(file)?;
    }
    baseline.map_or(Ok(()), |baseline| compare_with_baseline(&baseline, &now, &report, &mut out))
}

/// What was left out or failed, on the error stream: figures alone do not show it.
fn print_losses(report: &Report) {
    for cell in &report.cells {
        let all = cell.outcomes.len() + cell.left_out.len();
        if let Some(first) = cell.left_out.first() {
            eprintln!(
                "{}: {} of {all} expressions left out: {}",
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

/// The model, live or from recorded answers; these know their model.
fn vlm_client(args: &RunArgs) -> anyhow::Result<Option<ChatClient>> {
    if let Some(file) = &args.replay {
        let (notify_worker, model) = ReplayCache::replay(file).context("--replay")?;
        let vlm_model = args.vlm.vlm_model.clone().or(Some(model));
        // Nobody is asked: any address will do.
        let vlm_url = args.vlm.vlm_url.clone().or_else(|| Some("http://localhost".into()));
        return VlmConfig { vlm_url, vlm_model, ..args.vlm.clone() }.client(notify_worker);
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

/// Fails on a drop, and on cells or expressions the baseline has and the run has not: what is not
/// measured can not be held.
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
    ensure!(missing.is_empty(), "the baseline has cells this run has not: {missing:?}");
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
    ensure!(drops.is_empty(), "worse than the baseline by more than luck: {}", drops.join("; "));
    Ok(())
}

fn compare(args: &DiffArgs) -> anyhow::Result<()> {
    let (before, after) = (Baseline::read(&args.before)?, Baseline::read(&args.after)?);
    let (changes, unpaired) = before.compare_with(&after);
    let mut out = io::stdout().lock();
    if args.json {
        writeln!(out, "{}", serde_json::to_string_pretty(&changes)?)?;
    } else {
        // Either may be a baseline, which knows no words.
        let known: HashMap<String, String> = [&args.before, &args.after]
            .into_iter()
            .filter_map(|path| Report::read(path).ok())
            .flat_map(|report| queries_by_key(&report))
            .collect();
        write!(out, "{}", describe(&changes, |id| known.get(id).cloned()))?;
        unpaired.iter().try_for_each(|cell| writeln!(out, "{cell}: in one of the two only"))?;
    }
    ensure!(!changes.is_empty(), "the two have no cell in common");
    Ok(())
}

fn queries_by_key(report: &Report) -> HashMap<String, String> {
    let outcomes = report.cells.iter().flat_map(|cell| &cell.outcomes);
    outcomes.map(|o| (comparison_key(o), o.query.clone())).collect()
}

/// One line that is written over; nothing where nobody watches.
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
