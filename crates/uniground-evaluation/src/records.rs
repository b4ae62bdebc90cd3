//! Reads records of annotation files one by one, with their lines. An invalid record does not
//! affect the others.

use camino::{Utf8Path, Utf8PathBuf};
use serde::de::DeserializeOwned;
use serde::{Deserialize, Serialize};
use serde_json::value::RawValue;

/// A part of a suite that could not be used. The rest is scored without it.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Omission {
    pub file: Utf8PathBuf,
    /// Line number from 1. `None`: the whole file.
    pub line: Option<u64>,
    pub reason: String,
}

impl Omission {
    pub fn new(file: &Utf8Path, line: impl Into<Option<u64>>, reason: impl Into<String>) -> Self {
        Self { file: file.to_owned(), line: line.into(), reason: reason.into() }
    }
}

impl std::fmt::Display for Omission {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self.line {
            Some(line) => write!(f, "{}:{line}: {}", self.file, self.reason),
            None => write!(f, "{}: {}", self.file, self.reason),
        }
    }
}

/// One element of a JSON list, with the line where it starts.
#[derive(Debug, Clone, Copy)]
pub struct Record<'a> {
    pub line: u64,
    raw: &'a str,
}

impl<'a> Record<'a> {
    /// Returns the elements of a JSON list.
    ///
    /// # Errors
    /// Returns an error when `text` is not a JSON list.
    pub fn parse_list(text: &'a str) -> serde_json::Result<Vec<Self>> {
        let raw: Vec<&RawValue> = serde_json::from_str(text)?;
        Ok(Self::with_locations(text, &raw))
    }

    /// Returns elements borrowed from `text`, in its order.
    #[must_use]
    pub fn with_locations(text: &'a str, raw: &[&'a RawValue]) -> Vec<Self> {
        let (mut line, mut counted_to) = (1, 0);
        let locate = |value: &&'a RawValue| {
            // The value is a slice of the text, so its distance from the start is its position.
            let at = (value.get().as_ptr() as usize)
                .saturating_sub(text.as_ptr() as usize)
                .min(text.len());
            line += text.as_bytes()[counted_to.min(at)..at].split(|&byte| byte == b'\n').count()
                as u64
                - 1;
            counted_to = at;
            Self { line, raw: value.get() }
        };
        raw.iter().map(locate).collect()
    }

    /// Decodes this record. The error names the field and the line within the file.
    ///
    /// # Errors
    /// Returns an [`Omission`].
    pub fn decode<T: DeserializeOwned>(&self, file: &Utf8Path) -> Result<T, Omission> {
        serde_path_to_error::deserialize(&mut serde_json::Deserializer::from_str(self.raw)).map_err(
            |error| {
                let path = error.path().to_string();
                let inner = error.into_inner();
                let line = self.line + (inner.line() as u64).saturating_sub(1);
                let what = inner.to_string();
                let what = what.split(" at line ").next().unwrap_or_default();
                Omission::new(
                    file,
                    line,
                    if path == "." { what.to_owned() } else { format!("{path}: {what}") },
                )
            },
        )
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[derive(Debug, Deserialize)]
    struct Row {
        id: u32,
    }

    #[test]
    fn decode_errors_name_line_and_field() {
        let text = "[\n {\"id\": 1},\n\n {\n  \"id\": \"two\"\n }, {\"id\": 3}]";
        let records = Record::parse_list(text).unwrap();
        assert_eq!(records.iter().map(|r| r.line).collect::<Vec<_>>(), [2, 4, 6]);
        let file = Utf8Path::new("rows.json");
        assert_eq!(records[2].decode::<Row>(file).unwrap().id, 3);
        let omission = records[1].decode::<Row>(file).unwrap_err();
        assert_eq!(
            omission.to_string(),
            "rows.json:5: id: invalid type: string \"two\", expected u32"
        );
    }
}
