//! Layouts of networks as exporters write them. A hub's repository or a folder has ONNX networks
//! beside `config.json`, `preprocessor_config.json` and `tokenizer.json`, but no `model.json`.
//!
//! ```text
//! file names ─> select (which networks, which precision) ─> files in one folder
//!            ─> describe (side files + the networks' own inputs and outputs) ─> Manifest
//! ```
//! Supported: dual encoders of Transformers.js and Optimum (CLIP, `SigLIP`, `MetaCLIP`; separate
//! towers or one network), and segmenters of Transformers.js, Optimum and SAM's own script (SAM,
//! SAM 2, `EdgeTAM`, `MobileSAM`). Anything else is refused: nothing is guessed that the files do
//! not state.

mod pictures;
mod ports;
mod segmenters;
mod selection;
mod side_files;
mod towers;

pub use selection::{Networks, Precision, Selection, select};

use super::ModelError;
use super::bundle::Manifest;
use super::onnx_file::{OnnxFile, read_onnx};
use camino::Utf8Path;
use side_files::SideFiles;
use std::fs::File;
use std::io::{self, Read};

/// What people know about a bundle, and its files do not state.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct About {
    /// The bundle's name.
    pub name: String,
    /// License of the weights. Empty when not stated.
    pub licence: String,
    /// Where the files come from.
    pub source: String,
}

/// Returns the manifest of the selected networks. All files are in `folder`, without subfolders.
///
/// # Errors
/// Returns [`ModelError::Bundle`], which names the file, and says what was expected and found.
pub fn describe(
    folder: &Utf8Path,
    selection: &Selection,
    about: &About,
) -> Result<Manifest, ModelError> {
    let side = SideFiles::read(folder)?;
    let open = |file: &str| Graph::read(folder, file);
    match &selection.networks {
        Networks::Towers { image, text } => {
            towers::describe(&open(image)?, &open(text)?, &side, about).map(Manifest::DualEncoder)
        }
        Networks::Joint { file } => {
            let graph = open(file)?;
            towers::describe(&graph, &graph, &side, about).map(Manifest::DualEncoder)
        }
        Networks::Segmenter { encoder, decoder } => {
            segmenters::describe(&open(encoder)?, &open(decoder)?, &side, about)
                .map(Manifest::PromptableSegmenter)
        }
    }
}

/// Returns the names of the files that hold the weights of networks in `folder`, beside the
/// networks themselves.
///
/// # Errors
/// Returns [`ModelError::Bundle`], which names the network that cannot be read.
pub fn external_weights(folder: &Utf8Path, networks: &[String]) -> Result<Vec<String>, ModelError> {
    let mut names = Vec::new();
    for network in networks {
        // A network in the runtime's own format has no description, and no external weights.
        let file = folder.join(network);
        let wrong = |e: io::Error| ModelError::Bundle { file: file.clone(), why: e.to_string() };
        names.extend(read_onnx(&file).map_err(wrong)?.external_data);
    }
    names.sort();
    names.dedup();
    Ok(names)
}

/// A network's file and its description.
struct Graph {
    /// Name in the bundle's folder.
    name: String,
    file: camino::Utf8PathBuf,
    content: OnnxFile,
}

impl Graph {
    fn read(folder: &Utf8Path, name: &str) -> Result<Self, ModelError> {
        let file = folder.join(name);
        let content = read_onnx(&file).map_err(|e| ModelError::Bundle {
            file: file.clone(),
            why: match e.kind() {
                io::ErrorKind::NotFound => "the file is missing".into(),
                _ => e.to_string(),
            },
        })?;
        if content.signature.outputs.is_empty() {
            return Err(ModelError::Bundle { why: what_it_is(&file), file });
        }
        Ok(Self { name: name.to_owned(), file, content })
    }

    /// Returns the error for a network that cannot be described.
    fn wrong(&self, why: impl Into<String>) -> ModelError {
        ModelError::Bundle { file: self.file.clone(), why: why.into() }
    }
}

/// Describes a file that is not an ONNX network.
fn what_it_is(file: &Utf8Path) -> String {
    const LFS_POINTER: &[u8] = b"version https://git-lfs";
    let mut head = Vec::new();
    let read =
        File::open(file).and_then(|f| f.take(LFS_POINTER.len() as u64).read_to_end(&mut head));
    match read {
        Ok(0) => "the file is empty".into(),
        Ok(_) if head == LFS_POINTER => {
            "the file is a pointer of Git LFS, not a network: run `git lfs pull`".into()
        }
        _ => "not an ONNX network, or cut off".into(),
    }
}

#[cfg(test)]
mod tests;
