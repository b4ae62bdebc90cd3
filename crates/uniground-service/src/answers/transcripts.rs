//! Stores what a model was shown and replied for an answer, as files. The operator sets their
//! retention.

use crate::Limits;
use crate::error::Error;
use crate::parses::read;
use camino::Utf8Path;
use std::collections::{BTreeMap, BTreeSet};
use std::fs;
use tokio::task::spawn_blocking;
use uniground_models::chat::{CallRecord, Part, Picture};
use uniground_storage::{AnswerRepository, Blobs, Scratch};
use uniground_types::answer::Answer;
use uniground_types::transcript::{AnswerPrompt, AnswerReply, PromptCall, PromptPart, ReplyCall};

const PROMPT_FILE: &str = "prompt.json";
const REPLY_FILE: &str = "reply.json";

/// Returns the URL path of an answer's picture.
pub(super) fn picture_path(answer_id: &str, name: &str) -> String {
    format!("/v1/answers/{answer_id}/evidence/{name}.jpg")
}

/// Returns the names of the pictures that a model was shown, without duplicates.
pub(super) fn picture_names(records: &[CallRecord]) -> BTreeSet<String> {
    StoredPictures::of(records).by_name.into_keys().collect()
}

/// The pictures of all calls by the names they are stored under. A picture that differs from an earlier
/// one of its name, such as the room with another candidate, is stored with the number of its call.
#[derive(Default)]
struct StoredPictures<'a> {
    by_name: BTreeMap<String, &'a Picture>,
    /// The names of the pictures of each call, in order.
    of_calls: Vec<Vec<String>>,
}

impl<'a> StoredPictures<'a> {
    fn of(records: &'a [CallRecord]) -> Self {
        let mut stored = Self::default();
        for (record, call) in records.iter().zip(1..) {
            let pictures = record.request.user.iter().filter_map(|part| match part {
                Part::Picture(picture) => Some(picture),
                Part::Text(_) => None,
            });
            let names = pictures.map(|picture| stored.add(picture, call)).collect();
            stored.of_calls.push(names);
        }
        stored
    }

    fn add(&mut self, picture: &'a Picture, call: usize) -> String {
        let is_other = |other: &&&Picture| other.jpeg != picture.jpeg;
        let name = match self.by_name.get(&picture.name).filter(is_other) {
            Some(_) => format!("{}-call-{call}", picture.name),
            None => picture.name.clone(),
        };
        self.by_name.insert(name.clone(), picture);
        name
    }
}

/// Stores the prompts, replies and pictures behind an answer.
#[derive(Clone)]
pub struct Transcripts {
    pub(crate) blobs: Blobs,
    pub(crate) limits: Limits,
    pub(crate) answer_repository: AnswerRepository,
}

impl Transcripts {
    /// Stores what the model was asked and what it replied.
    pub(super) async fn store_transcript(
        &self,
        answer: &Answer,
        model: &str,
        records: Vec<CallRecord>,
    ) -> Result<(), Error> {
        if records.is_empty() || self.limits.retention.evidence_days == 0 {
            return Ok(());
        }
        let (blobs, id, model) = (self.blobs.clone(), answer.id.clone(), model.to_owned());
        spawn_blocking(move || {
            let scratch = blobs.scratch()?;
            write(&scratch, &id, model, &records)?;
            Ok(blobs.publish(scratch, &blobs.answer(&id))?)
        })
        .await?
    }

    /// Returns what the model was shown and asked for an answer.
    ///
    /// # Errors
    /// [`Error::AnswerNotFound`]; [`Error::NoTranscript`] for answers of the built-in reasoner, and
    /// after the transcript has expired.
    pub async fn answer_prompt(&self, id: &str) -> Result<AnswerPrompt, Error> {
        self.transcript(id, PROMPT_FILE).await
    }

    /// Returns what the model replied.
    ///
    /// # Errors
    /// Those of [`answer_prompt`](Self::answer_prompt).
    pub async fn answer_reply(&self, id: &str) -> Result<AnswerReply, Error> {
        self.transcript(id, REPLY_FILE).await
    }

    async fn transcript<T: serde::de::DeserializeOwned>(
        &self,
        id: &str,
        file: &str,
    ) -> Result<T, Error> {
        Ok(serde_json::from_slice(&self.read_answer_file(id, file).await?)?)
    }

    /// Reads a file that is stored with an answer.
    pub(super) async fn read_answer_file(&self, id: &str, file: &str) -> Result<Vec<u8>, Error> {
        self.answer_repository
            .answer(id)
            .await?
            .ok_or_else(|| Error::AnswerNotFound { id: id.into() })?;
        let (blobs, folder, file) = (self.blobs.clone(), self.blobs.answer(id), file.to_owned());
        let kept = spawn_blocking(move || read(&blobs, &folder, file)).await??;
        kept.ok_or_else(|| Error::NoTranscript { id: id.into() })
    }

    /// Removes the transcripts of deleted answers, in the background.
    pub(crate) async fn discard_transcripts(&self, answers: &[String]) -> Result<(), Error> {
        let folders = answers.iter().map(|answer| self.blobs.answer(answer)).collect();
        self.blobs.remove_later(self.blobs.set_aside(folders).await?);
        Ok(())
    }
}

fn write(scratch: &Scratch, id: &str, model: String, records: &[CallRecord]) -> Result<(), Error> {
    let folder: &Utf8Path = scratch.path();
    let StoredPictures { by_name, of_calls } = StoredPictures::of(records);
    for (name, picture) in by_name {
        fs::write(folder.join(format!("{name}.jpg")), &picture.jpeg)?;
    }
    let asked = |(record, names): (&CallRecord, Vec<String>)| {
        let mut names = names.into_iter();
        let shown = |part: &Part| match part {
            Part::Text(text) => PromptPart::Text { text: text.clone() },
            Part::Picture(picture) => {
                let name = names.next().unwrap_or_else(|| picture.name.clone());
                PromptPart::Picture { href: picture_path(id, &name) }
            }
        };
        PromptCall {
            purpose: record.purpose.to_owned(),
            system: record.request.system.clone(),
            user: record.request.user.iter().map(shown).collect(),
            schema: record.request.schema.as_ref().map(|(_, schema)| schema.clone()),
        }
    };
    let said = |record: &CallRecord| ReplyCall {
        purpose: record.purpose.to_owned(),
        text: record.outcome.as_ref().ok().map(|reply| reply.text.clone()),
        error: record.outcome.as_ref().err().cloned(),
    };
    let calls = records.iter().zip(of_calls).map(asked).collect();
    let prompt = AnswerPrompt { model: model.clone(), calls };
    let reply = AnswerReply { model, calls: records.iter().map(said).collect() };
    fs::write(folder.join(PROMPT_FILE), serde_json::to_vec_pretty(&prompt)?)?;
    fs::write(folder.join(REPLY_FILE), serde_json::to_vec_pretty(&reply)?)?;
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;
    use uniground_models::chat::ChatRequest;

    fn call(pictures: &[(&str, u8)]) -> CallRecord {
        let picture = |&(name, content): &(&str, u8)| {
            let jpeg = vec![content].into();
            Part::Picture(Picture { name: name.into(), jpeg, width: 1, height: 1 })
        };
        let user = pictures.iter().map(picture).collect();
        CallRecord {
            purpose: "spatial",
            request: ChatRequest { system: String::new(), user, schema: None },
            outcome: Err(String::new()),
            attempts: 1,
            latency_ms: 0.0,
            cost_usd: 0.0,
        }
    }

    #[test]
    fn pictures_of_one_name_that_differ_are_all_stored() {
        let calls = [
            call(&[("global", 1), ("candidate-7", 2)]),
            call(&[("global", 1), ("candidate-7", 2)]),
            call(&[("global", 3), ("candidate-7", 2), ("candidate-9", 4)]),
        ];
        let stored = StoredPictures::of(&calls);
        let contents: Vec<(&str, u8)> =
            stored.by_name.iter().map(|(name, picture)| (name.as_str(), picture.jpeg[0])).collect();
        let expected =
            [("candidate-7", 2), ("candidate-9", 4), ("global", 1), ("global-call-3", 3)];
        assert_eq!(contents, expected);
        assert_eq!(stored.of_calls[1], ["global", "candidate-7"]);
        assert_eq!(stored.of_calls[2], ["global-call-3", "candidate-7", "candidate-9"]);
    }
}
