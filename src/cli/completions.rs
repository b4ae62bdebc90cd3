//! `uniground completions`: prints a completion script for a shell.

use super::Cli;
use clap::CommandFactory;
use clap_complete::{Shell, generate};
use std::io::{self, Write};

#[derive(Debug, clap::Args)]
#[command(after_help = "\
bash: uniground completions bash > ~/.local/share/bash-completion/completions/uniground
zsh:  uniground completions zsh > a folder of $fpath, as _uniground
fish: uniground completions fish > ~/.config/fish/completions/uniground.fish")]
pub struct CompletionsArgs {
    /// Shell to generate the script for
    shell: Shell,
}

pub fn run(CompletionsArgs { shell }: &CompletionsArgs) -> anyhow::Result<()> {
    // The generator panics when standard output is closed early, so the script is built in memory.
    let mut script = Vec::new();
    generate(*shell, &mut Cli::command(), "uniground", &mut script);
    Ok(io::stdout().write_all(&script)?)
}
