use clap::Parser;
use std::io;
use std::process::ExitCode;

fn main() -> ExitCode {
    match uniground::cli::run(&uniground::cli::Cli::parse()) {
        Ok(()) => ExitCode::SUCCESS,
        // A closed pipe, as with `| head`, is not an error.
        Err(error)
            if error
                .downcast_ref::<io::Error>()
                .is_some_and(|e| e.kind() == io::ErrorKind::BrokenPipe) =>
        {
            ExitCode::SUCCESS
        }
        Err(error) => {
            eprintln!("uniground: {}", uniground::telemetry::redact_secrets(&format!("{error:#}")));
            ExitCode::FAILURE
        }
    }
}
