//! Bundles in a folder: what lies there, and whether it is whole.

use super::bundle::{Bundle, MANIFEST, Manifest};
use super::{Engine, ModelError, Models, Role};
use camino::{Utf8Path, Utf8PathBuf};
use serde::Serialize;

/// A file of a bundle.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct BundleFile {
    /// As in the manifest, without the folder.
    pub name: String,
    /// `None` when it is missing.
    pub bytes: Option<u64>,
}

/// What lies in one folder.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct BundleListing {
    /// Where its `model.json` lies.
    pub folder: Utf8PathBuf,
    /// The manifest's; the folder's when the manifest can not be read.
    pub name: String,
    /// Where it can be used; unknown when its manifest can not be read.
    pub role: Option<Role>,
    /// Networks, then the tokenizer where there is one; none when the manifest can not be read.
    pub files: Vec<BundleFile>,
    /// Of the weights, for people; empty when not told.
    pub licence: String,
    /// Where the weights come from, for people; empty when not told.
    pub source: String,
    /// What is wrong with it, if anything.
    pub problem: Option<String>,
}

/// The bundles in a folder, by name.
///
/// # Errors
/// When the folder can not be read.
pub fn list(folder: &Utf8Path) -> std::io::Result<Vec<BundleListing>> {
    let mut folders: Vec<Utf8PathBuf> = folder
        .read_dir_utf8()?
        .map(|entry| Ok(entry?.into_path()))
        .collect::<std::io::Result<_>>()?;
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
    let (role, licence, source) = match &bundle.manifest {
        Manifest::DualEncoder(m) => (Role::Encoder, m.licence.clone(), m.source.clone()),
        Manifest::PromptableSegmenter(m) => (Role::Masks, m.licence.clone(), m.source.clone()),
    };
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

/// Loads a bundle and runs it once: whether it would work.
///
/// # Errors
/// [`ModelError`] naming file and tensor.
pub fn verify(engine: &dyn Engine, folder: &Utf8Path) -> Result<Models, ModelError> {
    let bundle = Bundle::read(folder)?;
    match bundle.manifest {
        Manifest::DualEncoder(_) => Models::default().with_encoder(engine, folder),
        Manifest::PromptableSegmenter(_) => Models::default().with_segmenter(engine, folder),
    }
}
