//! The models a process works with: bundles by name or folder, loaded once.

use super::bundle::{Bundle, Manifest};
use super::network::Network;
use super::{DualEncoder, ModelError, OnnxRuntime, RemoteServer, RuntimeSettings, Segmenter};
use camino::{Utf8Path, Utf8PathBuf};
use serde::{Deserialize, Serialize};
use std::sync::Arc;
use utoipa::ToSchema;

/// Where networks run.
#[derive(Debug, Clone)]
pub enum Engine {
    /// On this machine.
    Local(OnnxRuntime),
    /// Behind a server of the `KServe` v2 protocol.
    Remote(RemoteServer),
}

/// What a model is for.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
#[serde(rename_all = "snake_case")]
pub enum Role {
    /// Cuts pictures into masks.
    Masks,
    /// Compares pictures and words.
    Encoder,
}

impl std::fmt::Display for Role {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(match self {
            Self::Masks => "masks",
            Self::Encoder => "encoder",
        })
    }
}

/// A model in use, as told to callers.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
pub struct LoadedModel {
    /// Name of the bundle.
    pub name: String,
    pub role: Role,
    /// SHA-256 over the bundle's files; of the manifest and the server's models where those run elsewhere.
    pub fingerprint: String,
    /// `cpu`, `cuda`, `tensorrt`, `coreml`, or the inference server's address.
    pub runs_on: String,
    /// The library that computes; none where networks run elsewhere.
    pub library: Option<String>,
    /// Dimensions of an embedding; none for masks.
    pub dimensions: Option<usize>,
    /// Pictures, or prompts, per call.
    pub batch: usize,
    pub licence: String,
}

/// Segmenter and encoder, where there are any. Cheap to clone.
#[derive(Clone, Default)]
pub struct Models {
    pub segmenter: Option<Arc<Segmenter>>,
    pub encoder: Option<Arc<DualEncoder>>,
    pub loaded: Vec<LoadedModel>,
}

impl std::fmt::Debug for Models {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Models").field("loaded", &self.loaded).finish_non_exhaustive()
    }
}

/// Prompts and queries come several at once; a picture's encoder uses all cores by itself.
const AT_ONCE: usize = 2;

impl Engine {
    /// ONNX Runtime on this machine.
    ///
    /// # Errors
    /// [`ModelError`]: no library, or not the provider.
    pub fn local(settings: &RuntimeSettings) -> Result<Self, ModelError> {
        Ok(Self::Local(OnnxRuntime::load(settings)?))
    }

    fn open(&self, bundle: &Bundle, file: &str, at_once: usize) -> Result<Box<dyn Network>, ModelError> {
        match self {
            Self::Local(runtime) => Ok(Box::new(runtime.open(&bundle.path(file), at_once)?)),
            Self::Remote(server) => Ok(Box::new(server.open(&network_name(bundle, file))?)),
        }
    }

    /// What tells this bundle's answers from those of another: its files; elsewhere, its manifest and what the server says it has.
    fn fingerprint(&self, bundle: &Bundle) -> Result<String, ModelError> {
        match self {
            Self::Local(_) => bundle.fingerprint(true, &[]),
            Self::Remote(server) => {
                let (networks, _) = bundle.files();
                let identities = networks
                    .into_iter()
                    .map(|file| Ok(server.open(&network_name(bundle, file))?.identity))
                    .collect::<Result<Vec<_>, ModelError>>()?;
                bundle.fingerprint(false, &identities)
            }
        }
    }

    fn runs_on(&self) -> String {
        match self {
            Self::Local(runtime) => runtime.provider.to_string(),
            Self::Remote(server) => server.address().to_owned(),
        }
    }

    fn library(&self) -> Option<String> {
        match self {
            Self::Local(runtime) => Some(runtime.library.file_name().unwrap_or_default().to_owned()),
            Self::Remote(_) => None,
        }
    }
}

/// What a bundle's network is called at an inference server: the bundle's name and the file's, without its extension.
fn network_name(bundle: &Bundle, file: &str) -> String {
    format!("{}-{}", bundle.name(), file.split('.').next().unwrap_or(file))
}

/// The folder of a bundle: a path, or a name below `folder`.
#[must_use]
pub fn folder_of(bundle: &str, folder: &Utf8Path) -> Utf8PathBuf {
    match bundle.contains(['/', '\\']) {
        true => bundle.into(),
        false => folder.join(bundle),
    }
}

impl Models {
    /// Loads a segmenter.
    ///
    /// # Errors
    /// [`ModelError`] naming file and tensor.
    pub fn with_segmenter(mut self, engine: &Engine, folder: &Utf8Path) -> Result<Self, ModelError> {
        let bundle = Bundle::read(folder)?;
        let Manifest::PromptableSegmenter(manifest) = &bundle.manifest else { return Err(wrong_kind(&bundle, "a promptable-segmenter")) };
        let encoder = engine.open(&bundle, &manifest.encoder.file, 1)?;
        let decoder = engine.open(&bundle, &manifest.decoder.file, AT_ONCE)?;
        let segmenter = Segmenter::new(&bundle, manifest, encoder, decoder)?;
        self.note(engine, &bundle, Role::Masks, None, segmenter.batch(), &manifest.licence)?;
        self.segmenter = Some(Arc::new(segmenter));
        Ok(self)
    }

    /// Loads a dual encoder.
    ///
    /// # Errors
    /// [`ModelError`] naming file and tensor.
    pub fn with_encoder(mut self, engine: &Engine, folder: &Utf8Path) -> Result<Self, ModelError> {
        let bundle = Bundle::read(folder)?;
        let Manifest::DualEncoder(manifest) = &bundle.manifest else { return Err(wrong_kind(&bundle, "a dual-encoder")) };
        let image = engine.open(&bundle, &manifest.image.file, 1)?;
        let text = engine.open(&bundle, &manifest.text.file, AT_ONCE)?;
        let encoder = DualEncoder::new(&bundle, manifest, image, text)?;
        self.note(engine, &bundle, Role::Encoder, Some(encoder.dim()), encoder.batch(), &manifest.licence)?;
        self.encoder = Some(Arc::new(encoder));
        Ok(self)
    }

    /// Those of the wanted roles.
    #[must_use]
    pub fn only(&self, masks: bool, encoder: bool) -> Self {
        let wanted = |role: Role| if role == Role::Masks { masks } else { encoder };
        Self {
            segmenter: self.segmenter.clone().filter(|_| masks),
            encoder: self.encoder.clone().filter(|_| encoder),
            loaded: self.loaded.iter().filter(|model| wanted(model.role)).cloned().collect(),
        }
    }

    fn note(
        &mut self,
        engine: &Engine,
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

    /// What a loaded model is recorded as: its name and the beginning of its fingerprint.
    #[must_use]
    pub fn label(&self, role: Role) -> Option<String> {
        let model = self.loaded.iter().find(|model| model.role == role)?;
        Some(format!("{}@{}", model.name, &model.fingerprint[..12]))
    }
}

fn wrong_kind(bundle: &Bundle, wanted: &str) -> ModelError {
    ModelError::Bundle { file: bundle.path(super::bundle::MANIFEST), why: format!("is not {wanted}") }
}
