//! Stores what a model was shown and replied for an answer, as files. The operator sets their
//! retention.

use crate::Limits;
use crate::error::Error;
use crate::parses::read;
use camino::Utf8Path;
use std::collections::BTreeSet;
use std::fs;
use tokio::task::spawn_blocking;
use uniground_models::chat::{CallRecord, Part};
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
pub(super) fn picture_names(records: &[CallRecord]) -> BTreeSet<&str> {
    let parts = records.iter().flat_map(|record| &record.request.user);
    parts
        .filter_map(|part| {
            if let Part::Picture(picture) = part { Some(picture.name.as_str()) } else { None }
        })
        .collect()
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
    for part in records.iter().flat_map(|record| &record.request.user) {
        if let Part::Picture(picture) = part {
            fs::write(folder.join(format!("{}.jpg", picture.name)), &picture.jpeg)?;
        }
    }
    let shown = |part: &Part| match part {
        Part::Text(text) => PromptPart::Text { text: text.clone() },
        Part::Picture(picture) => PromptPart::Picture { href: picture_path(id, &picture.name) },
    };
    let asked = |record: &CallRecord| PromptCall {
        purpose: record.purpose.to_owned(),
        system: record.request.system.clone(),
        user: record.request.user.iter().map(shown).collect(),
        schema: record.request.schema.as_ref().map(|(_, schema)| schema.clone()),
    };
    let said = |record: &CallRecord| ReplyCall {
        purpose: record.purpose.to_owned(),
        text: record.outcome.as_ref().ok().map(|reply| reply.text.clone()),
        error: record.outcome.as_ref().err().cloned(),
    };
    let prompt = AnswerPrompt { model: model.clone(), calls: records.iter().map(asked).collect() };
    let reply = AnswerReply { model, calls: records.iter().map(said).collect() };
    fs::write(folder.join(PROMPT_FILE), serde_json::to_vec_pretty(&prompt)?)?;
    fs::write(folder.join(REPLY_FILE), serde_json::to_vec_pretty(&reply)?)?;
    Ok(())
}
