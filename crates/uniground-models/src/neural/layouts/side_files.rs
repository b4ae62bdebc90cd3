//! Reads the configurations beside the networks.

use super::super::ModelError;
use camino::{Utf8Path, Utf8PathBuf};
use serde_json::Value;
use std::fs;
use std::io;

/// Maximum size of a configuration, bytes. Real ones have a few kilobytes.
const MAX_BYTES: u64 = 8 << 20;

/// The configurations. A missing file is null.
pub struct SideFiles {
    pub folder: Utf8PathBuf,
    /// `config.json`: the architecture.
    pub config: Value,
    /// `preprocessor_config.json`, or the part of `processor_config.json` with that content: how
    /// pictures are resized and normalized.
    pub pictures: Value,
    /// The file that `pictures` comes from.
    pub pictures_file: Utf8PathBuf,
    /// `tokenizer_config.json`.
    pub tokenizer: Value,
    /// `special_tokens_map.json`.
    pub special_tokens: Value,
}

impl SideFiles {
    /// # Errors
    /// Returns [`ModelError::Bundle`] for a file that is not JSON or cannot be read.
    pub fn read(folder: &Utf8Path) -> Result<Self, ModelError> {
        let mut pictures_file = folder.join("preprocessor_config.json");
        let mut pictures = read_json(&pictures_file)?;
        if pictures.is_null() {
            let newer = folder.join("processor_config.json");
            let content = read_json(&newer)?;
            if content["image_processor"].is_object() {
                pictures = content["image_processor"].clone();
                pictures_file = newer;
            }
        }
        Ok(Self {
            folder: folder.to_owned(),
            config: read_json(&folder.join("config.json"))?,
            pictures,
            pictures_file,
            tokenizer: read_json(&folder.join("tokenizer_config.json"))?,
            special_tokens: read_json(&folder.join("special_tokens_map.json"))?,
        })
    }

    /// Returns a positive number in `config.json`, at the first of these paths that has one.
    pub fn number(&self, paths: &[&str]) -> Option<usize> {
        paths.iter().find_map(|path| {
            let number = self.config.pointer(path)?.as_u64()?;
            usize::try_from(number).ok().filter(|n| *n > 0)
        })
    }

    /// Returns the architecture's name in `config.json`, or an empty text.
    pub fn model_type(&self) -> &str {
        self.config["model_type"].as_str().unwrap_or_default()
    }

    /// Returns the text of the padding token, if a file states it.
    pub fn pad_token(&self) -> Option<&str> {
        [&self.tokenizer, &self.special_tokens].into_iter().find_map(|file| {
            let token = &file["pad_token"];
            token.as_str().or_else(|| token["content"].as_str())
        })
    }
}

/// Reads a JSON file. Null if it does not exist.
fn read_json(file: &Utf8Path) -> Result<Value, ModelError> {
    let wrong = |why: String| ModelError::Bundle { file: file.to_owned(), why };
    let length = match fs::metadata(file) {
        Err(error) if error.kind() == io::ErrorKind::NotFound => return Ok(Value::Null),
        metadata => metadata.map_err(|e| wrong(e.to_string()))?.len(),
    };
    if length > MAX_BYTES {
        return Err(wrong(format!("the file is larger than {} MB", MAX_BYTES >> 20)));
    }
    let text = fs::read_to_string(file).map_err(|e| wrong(e.to_string()))?;
    serde_json::from_str(&text).map_err(|e| wrong(e.to_string()))
}
