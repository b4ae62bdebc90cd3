//! Which models a process works with: those named, or what lies in the folder of bundles.

use super::models::{BundlesConfig, ModelsConfig};
use super::{AUTO, BUILTIN, BUILTIN_ENCODER, BUILTIN_MASKS};
use anyhow::Context;
use std::io;
use uniground_core::models::neural::{
    BundleListing, Engine, ModelError, Models, Provider, Role, bundle_folder, list,
};
use uniground_evaluation::systems::ModelLoader;

/// What a segmenter costs where it runs on processor cores: seconds where the built-in masks take a
/// tenth of one (docs/MODELS.md).
const SEGMENTER_COST: &str =
    "SAM 2 tiny takes about 6 s a frame on two cores; --masks builtin is fast";

/// The models, and how they came to be chosen.
#[derive(Debug)]
pub struct ChosenModels {
    pub models: Models,
    /// Masks and encoder, and why these: one line for people.
    pub told: String,
    /// What lies in the folder of bundles and can not be used.
    pub warnings: Vec<String>,
}

/// What was asked for.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum ModelChoice<'a> {
    Auto,
    Builtin,
    /// Bundles, by name or folder.
    Named(&'a str),
}

impl<'a> ModelChoice<'a> {
    /// Reads a flag; `own` is what the built-in part calls itself.
    fn of(flag: &'a str, own: &str) -> Self {
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
    /// Loads what is configured, and under `auto` the first bundle by name that works. Blocks: not
    /// for asynchronous code.
    ///
    /// # Errors
    /// What is wrong with a bundle that was named, or with a library, a provider or an inference
    /// server that was.
    pub fn load(&self) -> anyhow::Result<ChosenModels> {
        let Self { masks, encoder, bundles } = self;
        let (masks, encoder) =
            (ModelChoice::of(masks, BUILTIN_MASKS), ModelChoice::of(encoder, BUILTIN_ENCODER));
        let mut choosing = ModelChooser {
            bundles,
            lying: Vec::new(),
            engine: None,
            models: Models::default(),
            warnings: Vec::new(),
        };
        if [masks, encoder].contains(&ModelChoice::Auto) {
            choosing.look();
        }
        let is_named = [masks, encoder].iter().any(|wish| matches!(wish, ModelChoice::Named(_)));
        let lies_there = (masks == ModelChoice::Auto && choosing.lies(Role::Masks))
            || (encoder == ModelChoice::Auto && choosing.lies(Role::Encoder));
        if is_named || lies_there {
            match bundles.engine() {
                Ok(engine) => choosing.engine = Some(engine),
                Err(error) if is_named || !bundles.is_usual() => return Err(error),
                Err(error) => choosing
                    .warnings
                    .push(format!("bundles in {} can not be used: {error:#}", bundles.models)),
            }
        }
        let masks = choosing.choose(Role::Masks, masks).context("--masks")?;
        let encoder = choosing.choose(Role::Encoder, encoder).context("--encoder")?;
        let ModelChooser { models, warnings, .. } = choosing;
        Ok(ChosenModels { models, told: format!("masks: {masks}; encoder: {encoder}"), warnings })
    }

    /// Whether a bundle would be used if it lay in the folder of bundles.
    #[must_use]
    pub fn wants(&self, role: Role, bundle: &str) -> bool {
        let wish = match role {
            Role::Masks => ModelChoice::of(&self.masks, BUILTIN_MASKS),
            Role::Encoder => ModelChoice::of(&self.encoder, BUILTIN_ENCODER),
        };
        match wish {
            ModelChoice::Auto => true,
            ModelChoice::Builtin => false,
            ModelChoice::Named(names) => names.split('+').any(|name| name == bundle),
        }
    }
}

struct ModelChooser<'a> {
    bundles: &'a BundlesConfig,
    /// What lies in the folder of bundles, by name; only looked at where something is left to
    /// choose.
    lying: Vec<BundleListing>,
    /// Only where something may have to run.
    engine: Option<Box<dyn Engine>>,
    models: Models,
    warnings: Vec<String>,
}

impl ModelChooser<'_> {
    fn look(&mut self) {
        let folder = &self.bundles.models;
        match list(folder) {
            Ok(lying) => self.lying = lying,
            // Most have none.
            Err(error) if error.kind() == io::ErrorKind::NotFound => {}
            Err(error) => self.warnings.push(format!("{folder} can not be looked at: {error}")),
        }
        let unreadable = self.lying.iter().filter(|bundle| bundle.role.is_none());
        self.warnings.extend(unreadable.filter_map(|bundle| bundle.problem.clone()));
    }

    fn lies(&self, role: Role) -> bool {
        self.lying.iter().any(|bundle| bundle.role == Some(role))
    }

    /// Loads what a role is to be done with, and tells what and why.
    fn choose(&mut self, role: Role, wish: ModelChoice) -> anyhow::Result<String> {
        match wish {
            ModelChoice::Builtin => Ok("built in (as asked)".into()),
            ModelChoice::Named(names) => {
                let names_of_masks = names.split('+');
                let names: Vec<&str> =
                    if role == Role::Masks { names_of_masks.collect() } else { vec![names] };
                for name in &names {
                    self.models = self.with(role, &bundle_folder(name, &self.bundles.models))?;
                }
                Ok(format!("{} (as asked)", names.join("+")))
            }
            ModelChoice::Auto => Ok(self.choose_lying(role)),
        }
    }

    /// The first by name that works.
    fn choose_lying(&mut self, role: Role) -> String {
        let folder = &self.bundles.models;
        let candidates: Vec<BundleListing> =
            self.lying.iter().filter(|bundle| bundle.role == Some(role)).cloned().collect();
        let names: Vec<&str> = candidates.iter().map(|bundle| bundle.name.as_str()).collect();
        if names.is_empty() {
            let kind = if role == Role::Masks { "segmenter" } else { "dual encoder" };
            return format!("built in (no {kind} in {folder}; uniground models fetch brings one)");
        }
        let names = names.join(", ");
        if self.engine.is_none() {
            return format!("built in (nothing is there to run {names})");
        }
        for bundle in &candidates {
            match self.with(role, &bundle.folder) {
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
                    self.warnings.push(format!("{} can not be used: {error:#}", bundle.name));
                }
            }
        }
        format!("built in (broken: {names})")
    }

    fn with(&self, role: Role, folder: &camino::Utf8Path) -> anyhow::Result<Models> {
        let engine = self.engine.as_deref().context("nothing runs networks")?;
        let models = self.models.clone();
        let loaded: Result<Models, ModelError> = match role {
            Role::Masks => models.with_segmenter(engine, folder),
            Role::Encoder => models.with_encoder(engine, folder),
        };
        Ok(loaded?)
    }
}
