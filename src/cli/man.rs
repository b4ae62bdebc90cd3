//! `uniground man`: prints or writes man pages, generated from the help texts.

use super::Cli;
use anyhow::Context;
use camino::Utf8PathBuf;
use clap::CommandFactory;
use std::fs;
use std::io::{self, Write};

#[derive(Debug, clap::Args)]
pub struct ManArgs {
    /// Write a page per command to this folder. Without it, the main page goes to standard output:
    /// uniground man | man -l -
    #[arg(long, value_name = "FOLDER")]
    out: Option<Utf8PathBuf>,
}

pub fn run(ManArgs { out }: &ManArgs) -> anyhow::Result<()> {
    // Pages for the `help` subcommand would be redundant.
    let command = Cli::command().disable_help_subcommand(true);
    let Some(out) = out else {
        let mut page = Vec::new();
        clap_mangen::Man::new(command).render(&mut page)?;
        return Ok(io::stdout().write_all(&page)?);
    };
    fs::create_dir_all(out).with_context(|| format!("--out {out}"))?;
    clap_mangen::generate_to(command, out).with_context(|| format!("--out {out}"))
}
