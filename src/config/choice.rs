//! Chooses the models of a process: the configured ones, or the bundles found in the models folder.

use super::hub::hub_settings;
use super::models::{BundlesConfig, ModelsConfig};
use super::{AUTO, BUILTIN, BUILTIN_ENCODER, BUILTIN_MASKS};
use crate::bundles::{self, AddOptions, BundleSource};
use crate::packages::Event;
use anyhow::{Context, ensure};
use camino::Utf8PathBuf;
use std::io;
use uniground_core::models::neural::bundle::Bundle;
use uniground_core::models::neural::{
    BundleListing, Engine, ModelError, Models, Provider, Role, bundle_folder, list,
};
use uniground_evaluation::systems::ModelLoader;

/// Warning about the speed of a segmentation model on the CPU. The built-in masks take about 0.1 s
/// per frame (docs/MODELS.md).
const SEGMENTER_COST: &str =
    "SAM 2 tiny takes about 5 s per frame on two cores; --masks builtin is fast";

/// The loaded models and the reasons for the choice.
#[derive(Debug)]
pub struct ChosenModels {
    pub models: Models,
    /// The chosen masks and encoder with the reasons, on one line.
    pub summary: String,
    /// Warnings about unusable bundles in the models folder.
    pub warnings: Vec<String>,
}

/// The value of `--masks` or `--encoder`.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum ModelChoice<'a> {
    Auto,
    Builtin,
    /// Bundles, by name or folder.
    Named(&'a str),
}

impl<'a> ModelChoice<'a> {
    /// Parses a flag. `own` is the name of the built-in component.
    fn parse(flag: &'a str, own: &str) -> Self {
        match flag {
            AUTO => Self::Auto,
            BUILTIN => Self::Builtin,
            _ if flag == own => Self::Builtin,
            named => Self::Named(named),
        }
    }
}

impl BundlesConfig {
    /// Returns a loader of the networks that a run of an evaluation names.
    #[must_use]
    pub fn loader(&self) -> ModelLoader {
        let bundles = self.clone();
        Box::new(move |masks, encoder| {
            let (masks, encoder, bundles) = (masks.into(), encoder.into(), bundles.clone());
            Ok(ModelsConfig { masks, encoder, bundles }.load()?.models)
        })
    }
}

impl ModelsConfig {
    /// Loads the configured models. With `auto`, loads the first bundle by name that works. Blocks:
    /// not for asynchronous code.
    ///
    /// # Errors
    /// Returns an error if a configured bundle, library, provider or inference server cannot be
    /// used.
    pub fn load(&self) -> anyhow::Result<ChosenModels> {
        let Self { masks, encoder, bundles } = self;
        let (masks, encoder) = (
            ModelChoice::parse(masks, BUILTIN_MASKS),
            ModelChoice::parse(encoder, BUILTIN_ENCODER),
        );
        let mut choosing = ModelChooser {
            bundles,
            lying: Vec::new(),
            engine: None,
            models: Models::default(),
            warnings: Vec::new(),
        };
        if [masks, encoder].contains(&ModelChoice::Auto) {
            choosing.scan_bundles();
        }
        let is_named = [masks, encoder].iter().any(|wish| matches!(wish, ModelChoice::Named(_)));
        let lies_there = (masks == ModelChoice::Auto && choosing.is_installed(Role::Masks))
            || (encoder == ModelChoice::Auto && choosing.is_installed(Role::Encoder));
        if is_named || lies_there {
            match bundles.engine() {
                Ok(engine) => choosing.engine = Some(engine),
                Err(error) if is_named || !bundles.is_default() => return Err(error),
                Err(error) => choosing
                    .warnings
                    .push(format!("bundles in {} cannot be used: {error:#}", bundles.models)),
            }
        }
        let masks = choosing.choose(Role::Masks, masks).context("--masks")?;
        let encoder = choosing.choose(Role::Encoder, encoder).context("--encoder")?;
        let ModelChooser { models, warnings, .. } = choosing;
        Ok(ChosenModels {
            models,
            summary: format!("masks: {masks}; encoder: {encoder}"),
            warnings,
        })
    }

    /// Returns whether a bundle would be used if it were in the models folder.
    #[must_use]
    pub fn is_wanted_bundle(&self, role: Role, bundle: &str) -> bool {
        match self.choice(role) {
            ModelChoice::Auto => true,
            ModelChoice::Builtin => false,
            ModelChoice::Named(names) => names.split('+').any(|name| name == bundle),
        }
    }

    /// Returns whether any working bundle of a role is used.
    #[must_use]
    pub fn is_auto(&self, role: Role) -> bool {
        self.choice(role) == ModelChoice::Auto
    }

    /// Returns whether a role is filled by a bundle, if there is one.
    #[must_use]
    pub fn wants_bundle(&self, role: Role) -> bool {
        self.choice(role) != ModelChoice::Builtin
    }

    fn choice(&self, role: Role) -> ModelChoice<'_> {
        match role {
            Role::Masks => ModelChoice::parse(&self.masks, BUILTIN_MASKS),
            Role::Encoder => ModelChoice::parse(&self.encoder, BUILTIN_ENCODER),
        }
    }
}

struct ModelChooser<'a> {
    bundles: &'a BundlesConfig,
    /// Bundles in the models folder, by name. Filled only for `auto`.
    lying: Vec<BundleListing>,
    /// Set only if a network may have to run.
    engine: Option<Box<dyn Engine>>,
    models: Models,
    warnings: Vec<String>,
}

impl ModelChooser<'_> {
    fn scan_bundles(&mut self) {
        let folder = &self.bundles.models;
        match list(folder) {
            Ok(lying) => self.lying = lying,
            // A missing folder is normal.
            Err(error) if error.kind() == io::ErrorKind::NotFound => {}
            Err(error) => self.warnings.push(format!("{folder} cannot be read: {error}")),
        }
        let unreadable = self.lying.iter().filter(|bundle| bundle.role.is_none());
        self.warnings.extend(unreadable.filter_map(|bundle| bundle.problem.clone()));
    }

    fn is_installed(&self, role: Role) -> bool {
        self.lying.iter().any(|bundle| bundle.role == Some(role))
    }

    /// Loads the models for a role and returns a description of the choice.
    fn choose(&mut self, role: Role, wish: ModelChoice) -> anyhow::Result<String> {
        match wish {
            ModelChoice::Builtin => Ok("built in (as configured)".into()),
            ModelChoice::Named(names) => {
                let names_of_masks = names.split('+');
                let names: Vec<&str> =
                    if role == Role::Masks { names_of_masks.collect() } else { vec![names] };
                for name in &names {
                    let folder = match BundleSource::is_remote(name) {
                        true => self.install(name)?,
                        false => bundle_folder(name, &self.bundles.models),
                    };
                    self.models = self.load_with(role, &folder)?;
                }
                Ok(format!("{} (as configured)", names.join("+")))
            }
            ModelChoice::Auto => Ok(self.choose_first_working(role)),
        }
    }

    /// Chooses the first bundle by name that works.
    fn choose_first_working(&mut self, role: Role) -> String {
        let folder = &self.bundles.models;
        let candidates: Vec<BundleListing> =
            self.lying.iter().filter(|bundle| bundle.role == Some(role)).cloned().collect();
        let names: Vec<&str> = candidates.iter().map(|bundle| bundle.name.as_str()).collect();
        if names.is_empty() {
            let kind =
                if role == Role::Masks { "segmentation model" } else { "image-text encoder" };
            return format!(
                "built in (no {kind} in {folder}; run uniground models fetch to get one)"
            );
        }
        let names = names.join(", ");
        if self.engine.is_none() {
            return format!("built in ({names} found, but no runtime for it)");
        }
        for bundle in &candidates {
            match self.load_with(role, &bundle.folder) {
                Ok(models) => {
                    self.models = models;
                    let on_cores = self.bundles.inference_url.is_none()
                        && self.bundles.runtime.provider == Provider::Cpu;
                    let cost = if role == Role::Masks && on_cores {
                        format!("; {SEGMENTER_COST}")
                    } else {
                        String::new()
                    };
                    return format!("{} (found in {folder}{cost})", bundle.name);
                }
                Err(error) => {
                    self.warnings.push(format!("{} cannot be used: {error:#}", bundle.name));
                }
            }
        }
        format!("built in (unusable: {names})")
    }

    /// Installs a bundle from the hub or a zip file, unless it is installed.
    fn install(&self, source: &str) -> anyhow::Result<Utf8PathBuf> {
        let source: BundleSource = source.parse().map_err(anyhow::Error::msg)?;
        let hub = hub_settings()?;
        let options = AddOptions {
            models: &self.bundles.models,
            name: None,
            precision: None,
            update: false,
            hub: &hub,
            pause: &std::thread::sleep,
        };
        let added = bundles::add(&source, &options, &mut |event| match event {
            Event::Described { source, license, bytes } => {
                let megabytes = bytes / 1_000_000;
                tracing::info!(source, license, megabytes, "installing a model");
            }
            Event::Started(file, _) => tracing::info!(file, "downloading"),
            Event::NotVerified { source } => {
                tracing::warn!(source, "the source states no hashes: files are not verified");
            }
            Event::Retrying { why, seconds } => tracing::warn!(why, seconds, "retrying"),
            Event::Received(_)
            | Event::Downloaded
            | Event::Installed(_)
            | Event::AlreadyInstalled(_) => {}
        })?;
        Ok(added.folder)
    }

    fn load_with(&self, role: Role, folder: &camino::Utf8Path) -> anyhow::Result<Models> {
        let engine = self.engine.as_deref().context("no runtime for neural networks")?;
        let models = self.models.clone();
        // A bundle of the other kind is installed by its source before that is known.
        if let Ok(bundle) = Bundle::read(folder) {
            let own = bundle.manifest.role();
            ensure!(own == role, "{} is for --{own}, not for --{role}", bundle.name());
        }
        let loaded: Result<Models, ModelError> = match role {
            Role::Masks => models.with_segmenter(engine, folder),
            Role::Encoder => models.with_encoder(engine, folder),
        };
        Ok(loaded?)
    }
}
