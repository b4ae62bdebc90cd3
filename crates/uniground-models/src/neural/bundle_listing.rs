//! Lists the bundles in a folder and checks whether they are complete.

use super::bundle::{Bundle, MANIFEST, Manifest};
use super::{Engine, ModelError, Models, Role};
use camino::{Utf8Path, Utf8PathBuf};
use serde::Serialize;
use std::io;

/// A file of a bundle.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct BundleFile {
    /// Name as in the manifest, without the folder.
    pub name: String,
    /// Size in bytes. `None` when the file is missing.
    pub bytes: Option<u64>,
}

/// A bundle found in a folder.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct BundleListing {
    /// The folder that contains its `model.json`.
    pub folder: Utf8PathBuf,
    /// The manifest's name, or the folder's name when the manifest cannot be read.
    pub name: String,
    /// What it can be used for. `None` when its manifest cannot be read.
    pub role: Option<Role>,
    /// Networks, then the tokenizer if there is one. Empty when the manifest cannot be read.
    pub files: Vec<BundleFile>,
    /// License of the weights, for people. Empty when not stated.
    pub licence: String,
    /// Source of the weights, for people. Empty when not stated.
    pub source: String,
    /// The problem with it, if any.
    pub problem: Option<String>,
}

/// Returns the bundles in a folder, sorted by name. A folder that does not exist has none.
///
/// # Errors
/// Returns an error when the folder cannot be read.
pub fn list(folder: &Utf8Path) -> io::Result<Vec<BundleListing>> {
    let entries = match folder.read_dir_utf8() {
        Err(error) if error.kind() == io::ErrorKind::NotFound => return Ok(Vec::new()),
        entries => entries?,
    };
    let mut folders: Vec<Utf8PathBuf> =
        entries.map(|entry| Ok(entry?.into_path())).collect::<io::Result<_>>()?;
    folders.retain(|folder| folder.join(MANIFEST).is_file());
    folders.sort();
    Ok(folders.iter().map(|folder| listing(folder)).collect())
}

fn listing(folder: &Utf8Path) -> BundleListing {
    let bundle = match Bundle::read(folder) {
        Ok(bundle) => bundle,
        Err(error) => {
            let name = folder.file_name().unwrap_or_default().to_owned();
            let problem = Some(error.to_string());
            let (role, licence, source) = (None, String::new(), String::new());
            return BundleListing {
                folder: folder.to_owned(),
                name,
                role,
                files: Vec::new(),
                licence,
                source,
                problem,
            };
        }
    };
    let (networks, tokenizer) = bundle.files();
    let files: Vec<BundleFile> = networks
        .into_iter()
        .chain(tokenizer)
        .map(|name| BundleFile {
            name: name.to_owned(),
            bytes: bundle.path(name).metadata().ok().map(|m| m.len()),
        })
        .collect();
    let missing: Vec<&str> =
        files.iter().filter(|f| f.bytes.is_none()).map(|f| f.name.as_str()).collect();
    let problem = (!missing.is_empty()).then(|| format!("missing: {}", missing.join(", ")));
    let manifest = &bundle.manifest;
    let (role, licence, source) =
        (manifest.role(), manifest.licence().to_owned(), manifest.source().to_owned());
    BundleListing {
        folder: folder.to_owned(),
        name: bundle.name().to_owned(),
        role: Some(role),
        files,
        licence,
        source,
        problem,
    }
}

/// Loads a bundle and runs it once to check that it works.
///
/// # Errors
/// Returns a [`ModelError`] that names the file and the tensor.
pub fn verify(engine: &dyn Engine, folder: &Utf8Path) -> Result<Models, ModelError> {
    let bundle = Bundle::read(folder)?;
    match bundle.manifest {
        Manifest::DualEncoder(_) => Models::default().with_encoder(engine, folder),
        Manifest::PromptableSegmenter(_) => Models::default().with_segmenter(engine, folder),
    }
}
