//! Recorded model replies: results that were paid for once can be reproduced for free.
//!
//! One JSON line per reply: `{"key", "model", "reply"}`. The key is the SHA-256 of the request as
//! sent, including pictures. Address and API key are not part of it.

use camino::{Utf8Path, Utf8PathBuf};
use serde::{Deserialize, Serialize};
use std::collections::HashMap;
use std::fs::{self, OpenOptions};
use std::io::Write;
use std::sync::{Mutex, PoisonError};
use uniground_models::chat::ChatReply;

/// How replies are recorded and replayed.
#[derive(Debug, Default)]
pub enum ReplayCache {
    /// Always ask the model.
    #[default]
    Off,
    /// Ask the model once per request, and record new replies immediately.
    Record { file: Mutex<fs::File>, known: Mutex<HashMap<String, ChatReply>> },
    /// Never ask the model.
    Replay { known: HashMap<String, ChatReply> },
}

/// Why a file of recorded replies cannot be used.
#[derive(Debug, thiserror::Error)]
pub enum ReplayError {
    #[error("{path}")]
    Io {
        path: Utf8PathBuf,
        #[source]
        error: std::io::Error,
    },
    #[error("{path}:{line}: not a recorded reply")]
    NotAnAnswer { path: Utf8PathBuf, line: usize },
    #[error("{path}: the file has no recorded replies")]
    Empty { path: Utf8PathBuf },
}

impl ReplayError {
    /// Adds the file to an I/O error.
    fn with_path(path: &Utf8Path) -> impl FnOnce(std::io::Error) -> Self {
        move |error| Self::Io { path: path.to_owned(), error }
    }
}

#[derive(Serialize, Deserialize)]
struct Line {
    key: String,
    model: String,
    reply: ChatReply,
}

impl ReplayCache {
    /// Continues a file of recorded replies, or creates one.
    ///
    /// # Errors
    /// The file cannot be written, or has other content.
    pub fn record(path: &Utf8Path) -> Result<Self, ReplayError> {
        let known = if path.exists() { read(path)?.0 } else { HashMap::new() };
        let file = OpenOptions::new()
            .create(true)
            .append(true)
            .open(path)
            .map_err(ReplayError::with_path(path))?;
        // Remove an incomplete last line: the next reply must start on a line of its own.
        let text = fs::read(path).map_err(ReplayError::with_path(path))?;
        let whole = text.iter().rposition(|byte| *byte == b'\n').map_or(0, |at| at + 1);
        file.set_len(whole as u64).map_err(ReplayError::with_path(path))?;
        Ok(Self::Record { file: Mutex::new(file), known: Mutex::new(known) })
    }

    /// Replays a file. Also returns the model it was recorded with.
    ///
    /// # Errors
    /// An unreadable or empty file.
    pub fn replay(path: &Utf8Path) -> Result<(Self, String), ReplayError> {
        let (known, model) = read(path)?;
        let model = model.ok_or_else(|| ReplayError::Empty { path: path.to_owned() })?;
        Ok((Self::Replay { known }, model))
    }

    pub(super) fn is_off(&self) -> bool {
        matches!(self, Self::Off)
    }

    pub(super) fn is_replay(&self) -> bool {
        matches!(self, Self::Replay { .. })
    }

    pub(super) fn reply(&self, key: &str) -> Option<ChatReply> {
        match self {
            Self::Off => None,
            Self::Record { known, .. } => {
                known.lock().unwrap_or_else(PoisonError::into_inner).get(key).cloned()
            }
            Self::Replay { known } => known.get(key).cloned(),
        }
    }

    /// Records a reply, if recording is enabled.
    pub(super) fn record_reply(
        &self,
        key: &str,
        model: &str,
        reply: &ChatReply,
    ) -> std::io::Result<()> {
        let Self::Record { file, known } = self else { return Ok(()) };
        let line = Line { key: key.to_owned(), model: model.to_owned(), reply: reply.clone() };
        let mut text = serde_json::to_vec(&line)?;
        text.push(b'\n');
        file.lock().unwrap_or_else(PoisonError::into_inner).write_all(&text)?;
        known.lock().unwrap_or_else(PoisonError::into_inner).insert(line.key, line.reply);
        Ok(())
    }
}

fn read(path: &Utf8Path) -> Result<(HashMap<String, ChatReply>, Option<String>), ReplayError> {
    let text = fs::read_to_string(path).map_err(ReplayError::with_path(path))?;
    let (mut known, mut model, count) = (HashMap::new(), None, text.lines().count());
    for (i, line) in text.lines().enumerate() {
        let parsed: Result<Line, _> = serde_json::from_str(line);
        // An incomplete last line is a reply that was not recorded completely.
        let cut_off = i + 1 == count && !text.ends_with('\n');
        match parsed {
            Ok(Line { key, model: of, reply }) => {
                known.insert(key, reply);
                model.get_or_insert(of);
            }
            Err(_) if cut_off => {}
            Err(_) => {
                return Err(ReplayError::NotAnAnswer { path: path.to_owned(), line: i + 1 });
            }
        }
    }
    Ok((known, model))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_truncated_recording_is_continued() {
        let folder = tempfile::tempdir().unwrap();
        let path = Utf8Path::from_path(folder.path()).unwrap().join("answers.jsonl");
        let reply = |text: &str| ChatReply {
            text: text.into(),
            prompt_tokens: 1,
            completion_tokens: 1,
            attempts: 1,
            lost: 0,
            latency_ms: 0.0,
        };
        ReplayCache::record(&path).unwrap().record_reply("one", "m", &reply("1")).unwrap();
        let whole = fs::read_to_string(&path).unwrap();
        fs::write(&path, format!("{whole}{}", &whole[..whole.len() / 2])).unwrap();
        let again = ReplayCache::record(&path).unwrap();
        assert_eq!(again.reply("one"), Some(reply("1")));
        again.record_reply("two", "m", &reply("2")).unwrap();
        let (played, _) = ReplayCache::replay(&path).unwrap();
        assert_eq!(
            (played.reply("one"), played.reply("two")),
            (Some(reply("1")), Some(reply("2")))
        );
    }
}
