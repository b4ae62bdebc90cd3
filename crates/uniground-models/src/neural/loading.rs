//! The models of a process: bundles by name or folder, loaded once.

use super::bundle::{Bundle, Manifest};
use super::engine::{Engine, Work};
use super::network::Network;
use super::{DualEncoder, ModelError, Segmenter};
use camino::{Utf8Path, Utf8PathBuf};
use std::sync::Arc;
use uniground_types::models::{LoadedModel, Role};

/// The loaded segmenters and encoder, if any. Cheap to clone.
#[derive(Clone, Default)]
pub struct Models {
    /// Segmenters for 2D masks. Each makes its own masks, and the first one corrects outlines.
    /// Empty: masks come from depth and color (docs/METHOD.md, section 1.3).
    pub segmenters: Vec<Arc<Segmenter>>,
    /// Embeds pictures and words. `None`: names come from measures (docs/METHOD.md, section 1.10).
    pub encoder: Option<Arc<DualEncoder>>,
    /// Information on each model for callers, in the order of loading.
    pub loaded: Vec<LoadedModel>,
}

impl std::fmt::Debug for Models {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Models").field("loaded", &self.loaded).finish_non_exhaustive()
    }
}

/// Number of concurrent sessions for prompts and queries, which arrive several at once. A picture's
/// encoder uses all cores by itself.
const AT_ONCE: usize = 2;

/// Returns the folder of a bundle, from a path or a name below `folder`.
#[must_use]
pub fn bundle_folder(bundle: &str, folder: &Utf8Path) -> Utf8PathBuf {
    match bundle.contains(['/', '\\']) {
        true => bundle.into(),
        false => folder.join(bundle),
    }
}

impl Models {
    /// Loads a segmenter and appends it to the loaded ones.
    ///
    /// # Errors
    /// Returns a [`ModelError`] that names the file and the tensor.
    pub fn with_segmenter(
        mut self,
        engine: &dyn Engine,
        folder: &Utf8Path,
    ) -> Result<Self, ModelError> {
        let bundle = Bundle::read(folder)?;
        let Manifest::PromptableSegmenter(manifest) = &bundle.manifest else {
            return Err(wrong_kind_error(&bundle, "a promptable-segmenter"));
        };
        let encoder = engine.open(&bundle, &manifest.encoder.file, 1, Work::Parsing)?;
        let decoder = engine.open(&bundle, &manifest.decoder.file, AT_ONCE, Work::Parsing)?;
        let mut manifest = manifest.clone();
        if engine.is_accelerated() {
            manifest.decoder.max_batch =
                manifest.decoder.accelerated_batch.map_or(manifest.decoder.max_batch, usize::from);
        }
        let segmenter = Segmenter::new(&bundle, &manifest, encoder, decoder)?;
        self.record_model(
            engine,
            &bundle,
            Role::Masks,
            None,
            segmenter.batch_size(),
            &manifest.licence,
        )?;
        self.segmenters.push(Arc::new(segmenter));
        Ok(self)
    }

    /// Loads a dual encoder.
    ///
    /// # Errors
    /// Returns a [`ModelError`] that names the file and the tensor.
    pub fn with_encoder(
        mut self,
        engine: &dyn Engine,
        folder: &Utf8Path,
    ) -> Result<Self, ModelError> {
        let bundle = Bundle::read(folder)?;
        let Manifest::DualEncoder(manifest) = &bundle.manifest else {
            return Err(wrong_kind_error(&bundle, "a dual-encoder"));
        };
        let text: Arc<dyn Network> =
            engine.open(&bundle, &manifest.text.file, AT_ONCE, Work::Questions)?.into();
        let image = match manifest.is_joint() {
            true => text.clone(),
            false => engine.open(&bundle, &manifest.image.file, 1, Work::Parsing)?.into(),
        };
        let encoder = DualEncoder::new(&bundle, manifest, image, text)?;
        self.record_model(
            engine,
            &bundle,
            Role::Encoder,
            Some(encoder.dim()),
            encoder.batch_size(),
            &manifest.licence,
        )?;
        self.encoder = Some(Arc::new(encoder));
        Ok(self)
    }

    /// Returns the models of the requested roles.
    #[must_use]
    pub fn select_roles(&self, masks: bool, encoder: bool) -> Self {
        let wanted = |role: Role| if role == Role::Masks { masks } else { encoder };
        Self {
            segmenters: if masks { self.segmenters.clone() } else { Vec::new() },
            encoder: self.encoder.clone().filter(|_| encoder),
            loaded: self.loaded.iter().filter(|model| wanted(model.role)).cloned().collect(),
        }
    }

    fn record_model(
        &mut self,
        engine: &dyn Engine,
        bundle: &Bundle,
        role: Role,
        dimensions: Option<usize>,
        batch: usize,
        licence: &str,
    ) -> Result<(), ModelError> {
        self.loaded.push(LoadedModel {
            name: bundle.name().to_owned(),
            role,
            fingerprint: engine.fingerprint(bundle)?,
            runs_on: engine.runs_on(),
            library: engine.library(),
            dimensions,
            batch,
            licence: licence.to_owned(),
        });
        Ok(())
    }

    /// Returns the record of the loaded models of a role: their names, each with the beginning of
    /// its fingerprint, joined by `+`.
    #[must_use]
    pub fn label(&self, role: Role) -> Option<String> {
        let of_role = self.loaded.iter().filter(|model| model.role == role);
        let labels: Vec<String> =
            of_role.map(|model| format!("{}@{}", model.name, &model.fingerprint[..12])).collect();
        (!labels.is_empty()).then(|| labels.join("+"))
    }
}

fn wrong_kind_error(bundle: &Bundle, wanted: &str) -> ModelError {
    ModelError::Bundle {
        file: bundle.path(super::bundle::MANIFEST),
        why: format!("the bundle is not {wanted}"),
    }
}
