//! Which files of a source make the bundle: those that its own manifest names, or those of a known
//! layout.

use super::AddError;
use super::origin::Origin;
use crate::packages::Event;
use camino::Utf8Path;
use std::fs;
use uniground_core::models::neural::ModelError;
use uniground_core::models::neural::bundle::{MANIFEST, Manifest};
use uniground_core::models::neural::layouts::{About, Precision, Selection, describe, select};

/// Largest manifest. Real ones have a few kilobytes.
const MAX_MANIFEST_BYTES: u64 = 1 << 20;

/// The files of a bundle at its source.
pub enum Plan {
    /// The source is a bundle.
    Manifest(Box<Manifest>),
    /// The source has networks in a known layout.
    Layout(Selection),
}

impl Plan {
    /// Returns the plan of a source with a manifest of its own. `None` for any other source: other
    /// tools have files of the same name.
    ///
    /// # Errors
    /// Returns an error when the manifest cannot be brought.
    pub fn of_manifest(
        origin: &mut Origin,
        listed: &[String],
        staging: &Utf8Path,
        on_event: &mut dyn FnMut(Event),
    ) -> Result<Option<Self>, AddError> {
        let is_small = origin.bytes(MANIFEST).is_none_or(|bytes| bytes <= MAX_MANIFEST_BYTES);
        if !listed.iter().any(|path| path == MANIFEST) || !is_small {
            return Ok(None);
        }
        let candidate = staging.join("candidate.json");
        origin.bring(MANIFEST, &candidate, &candidate, on_event)?;
        let text = fs::read_to_string(&candidate);
        let _gone = fs::remove_file(&candidate);
        let plan = Manifest::parse_checked(&text.unwrap_or_default())
            .ok()
            .map(Box::new)
            .map(Self::Manifest);
        Ok(plan.filter(|plan| plan.paths().iter().all(|path| listed.contains(path))))
    }

    /// Returns the plan of a source with a known layout.
    ///
    /// # Errors
    /// Returns what was expected and found.
    pub fn of_layout(listed: &[String], precision: Option<Precision>) -> Result<Self, String> {
        select(listed, precision).map(Self::Layout)
    }

    /// Returns the paths of all files, except for external weights, which the networks name.
    #[must_use]
    pub fn paths(&self) -> Vec<String> {
        let side_files: Vec<&str> = match self {
            Self::Manifest(manifest) => manifest.files().1.into_iter().collect(),
            Self::Layout(selection) => selection.side_files.iter().map(String::as_str).collect(),
        };
        self.networks().into_iter().chain(side_files).map(str::to_owned).collect()
    }

    /// Returns the paths of the networks.
    #[must_use]
    pub fn networks(&self) -> Vec<&str> {
        match self {
            Self::Manifest(manifest) => manifest.files().0,
            Self::Layout(selection) => selection.networks.files(),
        }
    }

    /// Returns where a file in the same folder as a network would be.
    pub fn beside_networks<'a>(&'a self, file: &'a str) -> impl Iterator<Item = String> + 'a {
        self.networks().into_iter().map(move |network| match network.rsplit_once('/') {
            Some((folder, _)) => format!("{folder}/{file}"),
            None => file.to_owned(),
        })
    }

    /// Returns whether a file belongs to the bundle, as far as names tell: external weights are
    /// called like their network.
    #[must_use]
    pub fn includes(&self, path: &str) -> bool {
        let is_beside = |network: &str| {
            path.strip_prefix(network)
                .is_some_and(|rest| rest.starts_with("_data") || rest.starts_with(".data"))
        };
        self.paths().iter().any(|own| own == path) || self.networks().into_iter().any(is_beside)
    }

    /// Returns the precision of the networks, if the layout states it.
    #[must_use]
    pub fn precision(&self) -> Option<Precision> {
        match self {
            Self::Manifest(_) => None,
            Self::Layout(selection) => Some(selection.precision),
        }
    }

    /// Returns the manifest of the bundle. Its files are in `folder`.
    ///
    /// # Errors
    /// Returns a [`ModelError`] that names the file, and what was expected and found.
    pub fn manifest(self, folder: &Utf8Path, about: &About) -> Result<Manifest, ModelError> {
        match self {
            Self::Manifest(manifest) => Ok(manifest.named(&about.name)),
            Self::Layout(selection) => describe(folder, &selection.flattened(), about),
        }
    }
}

/// Returns a path without its folders, as the file is called in a bundle.
pub fn base_name(path: &str) -> String {
    path.rsplit('/').next().unwrap_or(path).to_owned()
}
