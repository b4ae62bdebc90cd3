//! The command line: one file per subcommand.

mod parse;

use clap::{Parser, Subcommand};

#[derive(Debug, Parser)]
#[command(name = "uniground", version, about, max_term_width = 100)]
pub struct Cli {
    #[command(subcommand)]
    command: Command,
}

#[derive(Debug, Subcommand)]
enum Command {
    /// Cut a scan into instances, without a server
    Parse(parse::ParseArgs),
}

/// Runs the chosen subcommand.
///
/// # Errors
/// Whatever went wrong, for `main` to print.
pub fn run(cli: &Cli) -> anyhow::Result<()> {
    match &cli.command {
        Command::Parse(args) => parse::run(args),
    }
}
