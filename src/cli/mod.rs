//! The command line: one file per subcommand.

mod approach;
mod backup;
mod batch;
mod check_vlm;
mod completions;
mod demo;
mod doctor;
mod eval;
mod fetching;
mod find;
mod gc;
mod ground;
mod hints;
mod import;
mod job_progress;
mod key;
mod local;
mod man;
mod mcp;
mod migrate;
mod models;
mod openapi;
mod output;
mod parse;
mod private;
mod report_page;
mod resolve_scene;
mod restore;
mod scan_file;
mod scenes;
mod serve;
mod server;
mod table;
mod upload;
mod worker;

use crate::config::{ServeConfig, WorkerConfig};
use crate::telemetry;
use clap::error::ErrorKind;
use clap::{CommandFactory, Parser, Subcommand};

/// What to try first, below the list of commands.
const FIRST_STEPS: &str = "\
First steps:
  uniground demo                              parse a sample scan and ask four questions
  uniground ground SCAN \"the red mug\"         ask about a scan of your own, without a server
  uniground serve                             run the service and its page at http://127.0.0.1:8080";

#[derive(Debug, Parser)]
#[command(name = "uniground", version, about, max_term_width = 100, after_help = FIRST_STEPS)]
pub struct Cli {
    #[command(subcommand)]
    command: Command,
}

#[derive(Debug, Subcommand)]
enum Command {
    /// Run the service
    Serve(Box<ServeConfig>),
    /// Run a worker that processes jobs (parses, naming, batches) for servers on the same
    /// PostgreSQL database. Takes the options of serve
    Worker(Box<WorkerConfig>),
    /// Run a complete example on the sample scene
    Demo(demo::DemoArgs),
    /// Answer one question about a local scan, or about a scene of a running server
    Ground(Box<ground::GroundArgs>),
    /// Upload a scan to a running server and wait for its parse
    Upload(upload::UploadArgs),
    /// Find the scenes of a running server that contain an object
    Find(find::FindArgs),
    /// Find where a robot can stand to see or reach an object
    Approach(approach::ApproachArgs),
    /// List the scenes of a running server
    Scenes(scenes::ScenesArgs),
    /// Run many questions on a server
    Batch(batch::BatchArgs),
    /// Serve a data folder to a local agent over the Model Context Protocol (stdin and stdout). The
    /// page and the API also run, on a free loopback port; --listen is ignored
    Mcp(Box<ServeConfig>),
    /// Create, list and revoke API keys
    Key(key::KeyArgs),
    /// Check how a scan is read, and convert it to the neutral layout
    Import(import::ImportArgs),
    /// Segment a scan into instances, without a server
    Parse(parse::ParseArgs),
    /// Evaluate on expressions with known answers
    Eval(Box<eval::EvalArgs>),
    /// Fetch, add, list and verify models, and check a vision-language model
    Models(models::ModelsArgs),
    /// Check the consistency of a data folder, and repair it
    Doctor(doctor::DoctorArgs),
    /// Remove expired data from the folder of a stopped server
    Gc(Box<gc::GcArgs>),
    /// Back up all data. The server may be running
    Backup(backup::BackupArgs),
    /// Restore a data folder from a backup
    Restore(restore::RestoreArgs),
    /// Move all data to another data folder, another database, or both
    Migrate(migrate::MigrateArgs),
    /// Print the OpenAPI description of the service
    Openapi,
    /// Print a shell completion script
    Completions(completions::CompletionsArgs),
    /// Print or write man pages
    Man(man::ManArgs),
    /// Read one uploaded scan in a sandboxed process. Started by the service
    #[command(hide = true)]
    IsolatedReader,
}

/// Runs the chosen subcommand.
///
/// # Errors
/// Returns the error of the subcommand, for `main` to print.
pub fn run(cli: &Cli) -> anyhow::Result<()> {
    run_command(&cli.command).map_err(hints::with_help)
}

fn run_command(command: &Command) -> anyhow::Result<()> {
    match command {
        Command::Serve(config) => {
            serve::fetch(config);
            run_async(serve::run(config))
        }
        Command::Worker(config) => {
            serve::fetch(&config.serve);
            run_async(worker::run(config))
        }
        Command::Demo(args) => run_async(demo::run(args)),
        Command::Ground(args) => run_async(ground::run(args)),
        Command::Upload(args) => run_async(upload::run(args)),
        Command::Find(args) => run_async(find::run(args)),
        Command::Approach(args) => run_async(approach::run(args)),
        Command::Scenes(args) => run_async(scenes::run(args)),
        Command::Batch(args) => run_async(batch::run(args)),
        Command::Mcp(config) => run_async(mcp::run(config)),
        Command::Key(args) => run_async(key::run(args)),
        Command::Import(args) => import::run(args),
        Command::Parse(args) => parse::run(args),
        Command::Eval(args) => eval::run(args),
        Command::Models(args) => models::run(args),
        Command::Doctor(args) => run_async(doctor::run(args)),
        Command::Gc(args) => run_async(gc::run(args)),
        Command::Backup(args) => run_async(backup::run(args)),
        Command::Restore(args) => run_async(restore::run(args)),
        Command::Migrate(args) => run_async(migrate::run(args)),
        Command::Openapi => openapi::run(),
        Command::Completions(args) => completions::run(args),
        Command::Man(args) => man::run(args),
        Command::IsolatedReader => {
            telemetry::start_quiet();
            Ok(uniground_isolation::run()?)
        }
    }
}

/// Exits like clap for invalid combinations of arguments: prints the message and the usage, and
/// exits with code 2.
fn exit_with_usage_error(subcommand: &str, kind: ErrorKind, message: &str) -> ! {
    let mut cli = Cli::command();
    // Builds the command tree, so that the usage of the subcommand includes the program name.
    cli.build();
    match cli.find_subcommand_mut(subcommand) {
        Some(subcommand) => subcommand.error(kind, message).exit(),
        None => cli.error(kind, message).exit(),
    }
}

fn run_async(work: impl Future<Output = anyhow::Result<()>>) -> anyhow::Result<()> {
    tokio::runtime::Builder::new_multi_thread().enable_all().build()?.block_on(work)
}
