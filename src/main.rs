use clap::Parser;
use std::process::ExitCode;

fn main() -> ExitCode {
    match uniground::cli::run(&uniground::cli::Cli::parse()) {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            eprintln!("uniground: {error:#}");
            ExitCode::FAILURE
        }
    }
}
