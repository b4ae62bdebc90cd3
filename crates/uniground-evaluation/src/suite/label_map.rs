//! `ScanNet`'s table of labels, and the 18 classes that `ScanRefer` uses to distinguish unique from
//! multiple.

use anyhow::{Context, ensure};
use camino::Utf8Path;
use std::collections::HashMap;

/// The classes. Everything else is "others".
const CLASSES: [&str; 17] = [
    "cabinet",
    "bed",
    "chair",
    "sofa",
    "table",
    "door",
    "window",
    "bookshelf",
    "picture",
    "counter",
    "desk",
    "curtain",
    "refrigerator",
    "shower curtain",
    "toilet",
    "sink",
    "bathtub",
];

pub(super) struct LabelMap(HashMap<String, String>);

impl LabelMap {
    /// Reads `scannetv2-labels.combined.tsv`.
    pub(super) fn read(file: &Utf8Path) -> anyhow::Result<Self> {
        let mut reader = csv::ReaderBuilder::new()
            .delimiter(b'\t')
            .quoting(false)
            .flexible(true)
            .from_path(file)
            .with_context(|| file.to_string())?;
        let headers = reader.headers().with_context(|| file.to_string())?.clone();
        let column = |name: &str| {
            headers
                .iter()
                .position(|h| h == name)
                .with_context(|| format!("{file}: no column {name}"))
        };
        let (raw, class) = (column("raw_category")?, column("nyu40class")?);
        let mut classes = HashMap::new();
        for row in reader.records() {
            let row = row.with_context(|| file.to_string())?;
            if let (Some(raw), Some(class)) = (row.get(raw), row.get(class)) {
                classes.insert(raw.to_owned(), class.replace("refridgerator", "refrigerator"));
            }
        }
        ensure!(!classes.is_empty(), "{file}: no labels");
        Ok(Self(classes))
    }

    /// Returns the class of an object's name.
    pub(super) fn class(&self, name: &str) -> &'static str {
        let class = self.0.get(name).map_or("", String::as_str);
        CLASSES.into_iter().find(|c| *c == class).unwrap_or("others")
    }
}
