//! The command line: one file per subcommand.

mod backup;
mod batch;
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

#[derive(Debug, Parser)]
#[command(name = "uniground", version, about, max_term_width = 100)]
pub struct Cli {
    #[command(subcommand)]
    command: Command,
}

#[derive(Debug, Subcommand)]
enum Command {
    /// Run the service
    Serve(Box<ServeConfig>),
    /// Do jobs beside servers over the same PostgreSQL: parses, names, batches. Takes what serve
    /// takes
    Worker(Box<WorkerConfig>),
    /// Show the whole job on the sample scene
    Demo(demo::DemoArgs),
    /// Ask one question: about a scan on the disk, without a server, or about a scene of a running
    /// one
    Ground(Box<ground::GroundArgs>),
    /// Bring a scan to a running server, and wait for its parse
    Upload(upload::UploadArgs),
    /// Find out in which scene of a running server something is
    Find(find::FindArgs),
    /// List the scenes of a running server
    Scenes(scenes::ScenesArgs),
    /// Ask a running server many questions
    Batch(batch::BatchArgs),
    /// Serve a data folder to an agent on this machine: the Model Context Protocol over stdin and
    /// stdout. The page and the API are at a port of loopback beside it that the system picks,
    /// whatever --listen says
    Mcp(Box<ServeConfig>),
    /// Make, list and revoke the keys of callers
    Key(key::KeyArgs),
    /// Look how a scan of any layout is read, and write it in the neutral one
    Import(import::ImportArgs),
    /// Cut a scan into instances, without a server
    Parse(parse::ParseArgs),
    /// Score expressions with known answers
    Eval(Box<eval::EvalArgs>),
    /// Fetch, list and verify model bundles
    Models(models::ModelsArgs),
    /// Look whether a data folder is whole, and repair what can be
    Doctor(doctor::DoctorArgs),
    /// Let a stopped server's folder go of everything that was kept long enough
    Gc(Box<gc::GcArgs>),
    /// Copy everything that is stored, also while the server runs
    Backup(backup::BackupArgs),
    /// Make a data folder of a backup
    Restore(restore::RestoreArgs),
    /// Move everything that is stored to another data folder, another database, or both, and back
    Migrate(migrate::MigrateArgs),
    /// Print the OpenAPI description of the service
    Openapi,
    /// Print what a shell needs to complete the words of this program
    Completions(completions::CompletionsArgs),
    /// Print or write pages for man
    Man(man::ManArgs),
    /// Read one uploaded scan for the service that started this process
    #[command(hide = true)]
    IsolatedReader,
}

/// Runs the chosen subcommand.
///
/// # Errors
/// Whatever went wrong, for `main` to print.
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

/// Ends the program as clap does where what was typed does not go together: the message, how it is
/// used, and 2.
fn exit_with_usage_error(subcommand: &str, kind: ErrorKind, message: &str) -> ! {
    let mut cli = Cli::command();
    // Without that a subcommand does not know what comes before its name.
    cli.build();
    match cli.find_subcommand_mut(subcommand) {
        Some(subcommand) => subcommand.error(kind, message).exit(),
        None => cli.error(kind, message).exit(),
    }
}

fn run_async(work: impl Future<Output = anyhow::Result<()>>) -> anyhow::Result<()> {
    tokio::runtime::Builder::new_multi_thread().enable_all().build()?.block_on(work)
}
