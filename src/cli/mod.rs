//! The command line: one file per subcommand.

mod backup;
mod batch;
mod demo;
mod doctor;
mod eval;
mod fetching;
mod gc;
mod ground;
mod import;
mod key;
mod mcp;
mod models;
mod openapi;
mod parse;
mod report_page;
mod restore;
mod serve;
mod table;

use crate::config::ServeConfig;
use clap::{Parser, Subcommand};

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
    /// Show the whole job on the sample scene
    Demo(demo::DemoArgs),
    /// Ask a running server one question
    Ground(ground::GroundArgs),
    /// Ask a running server many questions
    Batch(batch::BatchArgs),
    /// Serve a data folder to an agent on this machine: the Model Context Protocol over stdin and stdout
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
    /// Print the OpenAPI description of the service
    Openapi,
}

/// Runs the chosen subcommand.
///
/// # Errors
/// Whatever went wrong, for `main` to print.
pub fn run(cli: &Cli) -> anyhow::Result<()> {
    match &cli.command {
        Command::Serve(config) => {
            serve::fetch(config);
            asynchronous(serve::run(config))
        }
        Command::Demo(args) => asynchronous(demo::run(args)),
        Command::Ground(args) => asynchronous(ground::run(args)),
        Command::Batch(args) => asynchronous(batch::run(args)),
        Command::Mcp(config) => asynchronous(mcp::run(config)),
        Command::Key(args) => asynchronous(key::run(args)),
        Command::Import(args) => import::run(args),
        Command::Parse(args) => parse::run(args),
        Command::Eval(args) => eval::run(args),
        Command::Models(args) => models::run(args),
        Command::Doctor(args) => asynchronous(doctor::run(args)),
        Command::Gc(args) => asynchronous(gc::run(args)),
        Command::Backup(args) => asynchronous(backup::run(args)),
        Command::Restore(args) => asynchronous(restore::run(args)),
        Command::Openapi => openapi::run(),
    }
}

fn asynchronous(work: impl Future<Output = anyhow::Result<()>>) -> anyhow::Result<()> {
    tokio::runtime::Builder::new_multi_thread().enable_all().build()?.block_on(work)
}
