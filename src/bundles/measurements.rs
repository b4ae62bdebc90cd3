//! How long bundles take on this machine, measured whenever they are verified.

use super::AddError;
use camino::Utf8Path;
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::fs;

/// Name of the file, in the folder of bundles. It belongs to the machine, not to the bundles.
const FILE: &str = ".measurements.json";

/// Seconds per picture by bundle.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[serde(transparent)]
pub struct Measurements(BTreeMap<String, f32>);

impl Measurements {
    /// Reads the measurements of a folder of bundles. None if there are none, or if they cannot be
    /// read: they are made again.
    #[must_use]
    pub fn read(models: &Utf8Path) -> Self {
        fs::read_to_string(models.join(FILE))
            .ok()
            .and_then(|text| serde_json::from_str(&text).ok())
            .unwrap_or_default()
    }

    /// Returns the seconds per picture of a bundle.
    #[must_use]
    pub fn seconds(&self, bundle: &str) -> Option<f32> {
        self.0.get(bundle).copied()
    }

    /// Sets the seconds per picture of a bundle.
    pub fn set(&mut self, bundle: &str, seconds: f32) {
        self.0.insert(bundle.to_owned(), seconds);
    }

    /// # Errors
    /// Returns an error if the file cannot be written.
    pub fn write(&self, models: &Utf8Path) -> Result<(), AddError> {
        let file = models.join(FILE);
        serde_json::to_vec_pretty(self)
            .map_err(Into::into)
            .and_then(|text| fs::write(&file, text))
            .map_err(|why| AddError::File { file: file.clone(), why })
    }
}
