//! `uniground parse`: parses a folder or an archive, without a server.

use super::{hints, report_page};
use crate::config::{BUILTIN, BundlesConfig, ChosenModels, ModelsConfig};
use crate::words;
use anyhow::{Context, ensure};
use camino::Utf8PathBuf;
use serde::Serialize;
use std::fs::{self, File};
use std::io::{self, IsTerminal, Write};
use uniground_core::geometry::up_axis::UpAxis;
use uniground_core::ingest::ScanFolder;
use uniground_core::parsing::checkpoints::Checkpoints;
use uniground_core::parsing::report_pictures;
use uniground_core::progress::Progress;
use uniground_core::scan::{ParsedScan, parse_scan};
use uniground_core::scene::{ImportReport, Instance, ParseReport, write_instances_ply};
use uniground_types::settings::{ParseModels, ParsePreset, ParseSettings};

#[derive(Debug, clap::Args)]
pub struct ParseArgs {
    /// Scan to parse: a folder, an archive, a .sens or .r3d file, a point cloud or a mesh
    scan: Utf8PathBuf,
    /// Write index.html with pictures of every step, report.json, instances.json, instances.ply and
    /// embeddings.npy to this folder
    #[arg(long, value_name = "FOLDER")]
    report: Option<Utf8PathBuf>,
    /// Preset of settings
    #[arg(long, default_value = "default", value_parser = words::preset())]
    preset: ParsePreset,
    /// JSON file with settings that override the preset, in the format of "settings" in the HTTP
    /// parse request
    #[arg(long, value_name = "FILE")]
    settings: Option<Utf8PathBuf>,
    /// Axis that points up in the scan: x, -x, y, -y, z or -z
    #[arg(long, allow_hyphen_values = true, value_parser = up_axis)]
    up: Option<UpAxis>,
    // Ignores the environment, like `ground`, so that the default takes seconds.
    /// Source of 2D masks: builtin, auto, or a bundle name. A segmentation model takes seconds per
    /// frame
    #[arg(long, default_value = BUILTIN, value_name = "BUNDLE")]
    masks: String,
    /// Image and text encoder: builtin, auto, or a bundle name
    #[arg(long, default_value = BUILTIN, value_name = "BUNDLE")]
    encoder: String,
    #[command(flatten)]
    bundles: BundlesConfig,
    /// Print the report as JSON
    #[arg(long)]
    json: bool,
}

#[derive(Serialize)]
struct Report<'a> {
    import: &'a ImportReport,
    models: &'a ParseModels,
    parse: &'a ParseReport,
}

pub(super) fn up_axis(text: &str) -> Result<UpAxis, String> {
    UpAxis::ALL
        .into_iter()
        .find(|axis| axis.name() == text)
        .ok_or_else(|| "expected x, -x, y, -y, z or -z".into())
}

pub fn run(args: &ParseArgs) -> anyhow::Result<()> {
    let overrides = match &args.settings {
        Some(file) => Some(
            serde_json::from_str(&fs::read_to_string(file).with_context(|| file.to_string())?)
                .with_context(|| file.to_string())?,
        ),
        None => None,
    };
    let mut settings = ParseSettings::from_request(args.preset, overrides)?;
    settings.import.up = args.up.or(settings.import.up);
    if let Some(out) = &args.report {
        ensure!(!out.as_str().is_empty(), "--report: the folder's name is empty");
        fs::create_dir_all(out).with_context(|| format!("--report {out}"))?;
    }
    ensure!(args.scan.exists(), "{}: no such file or folder", args.scan);
    let folder = ScanFolder::open(&args.scan)
        .map_err(|error| hints::with_scan_hint(error.into(), &args.scan))?;
    let ChosenModels { models, summary, warnings } = ModelsConfig {
        masks: args.masks.clone(),
        encoder: args.encoder.clone(),
        bundles: args.bundles.clone(),
    }
    .load()?;
    warnings.iter().for_each(|warning| eprintln!("warning: {warning}"));
    eprintln!("{summary}");

    let progress = Progress::new(show_progress, || false);
    let scan = parse_scan(&folder.path, &settings, &models, &Checkpoints::disabled(), &progress);
    show_progress("", 1.0);
    let ParsedScan { import, frames, scene: parsed, models } =
        scan.map_err(|error| hints::with_scan_hint(error.into(), &args.scan))?;

    let report = Report { import: &import, models: &models, parse: &parsed.report };
    if let Some(out) = &args.report {
        fs::write(out.join("report.json"), serde_json::to_vec_pretty(&report)?)?;
        fs::write(out.join("instances.json"), serde_json::to_vec_pretty(&parsed.instances)?)?;
        if let Some(embeddings) = &parsed.embeddings {
            embeddings.write_rows(File::create(out.join("embeddings.npy"))?)?;
        }
        write_instances_ply(&parsed, File::create(out.join("instances.ply"))?)?;
        let pictures = report_pictures::render(&parsed, &frames, &Progress::silent())?;
        for picture in &pictures {
            fs::write(out.join(format!("{}.jpg", picture.name)), &picture.jpeg)?;
        }
        fs::write(
            out.join("index.html"),
            report_page::render(&args.scan, &import, &parsed, &pictures),
        )?;
    }
    if args.json {
        writeln!(io::stdout(), "{}", serde_json::to_string_pretty(&report)?)?;
    } else {
        print_summary(&mut io::stdout().lock(), &report, &parsed.instances)?;
    }
    Ok(())
}

/// Prints progress on one line that is overwritten. Prints nothing when stderr is not a terminal.
fn show_progress(stage: &str, done: f32) {
    if std::io::stderr().is_terminal() {
        let percent =
            if stage.is_empty() { String::new() } else { format!("{:.1} %", done * 100.0) };
        eprint!("\r{percent:>7} {stage:<24}\r");
    }
}

fn print_summary(
    out: &mut impl Write,
    Report { import, models, parse }: &Report,
    instances: &[Instance],
) -> io::Result<()> {
    writeln!(
        out,
        "{} frames, {} points, {} superpoints, {} instances ({} structural), {} parts and wholes, {} regions dropped",
        parse.frames_used,
        parse.points,
        parse.superpoints,
        parse.instances,
        parse.structural,
        parse.parts_and_wholes,
        parse.dropped + parse.specks
    )?;
    writeln!(out, "masks {}, encoder {}", models.masks, models.encoder)?;
    for stage in &parse.stages {
        let memory = stage.peak_memory_mb.map_or_else(String::new, |mb| format!("{mb:>6} MB"));
        writeln!(
            out,
            "  {:<20} {:>7.2} s {memory} {:>9}",
            stage.stage, stage.seconds, stage.produced
        )?;
        for time in &stage.models {
            writeln!(out, "    {time}")?;
        }
    }
    for warning in import.warnings.iter().chain(&parse.warnings) {
        writeln!(out, "  warning: {warning}")?;
    }
    for instance in instances.iter().take(60) {
        let (center, size) = (instance.aabb.center, instance.aabb.size);
        writeln!(
            out,
            "  {:>3} {:<14} at ({:6.2} {:6.2} {:6.2}) size ({:.2} {:.2} {:.2}) {:>7} points",
            instance.id,
            instance.label(),
            center.x,
            center.y,
            center.z,
            size.x,
            size.y,
            size.z,
            instance.point_count
        )?;
    }
    Ok(())
}
