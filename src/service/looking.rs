//! The encoder's part in a question: whether it knows the scene, and what happens when it can not help.

use super::answering::Answer;
use super::cache::LoadedParse;
use super::parsing::{EMBEDDINGS_FILE, NORMS_FILE};
use crate::error::Error;
use crate::grounding::query::ParsedQuery;
use crate::grounding::{Appearance, ShortlistScoring};
use crate::models::attributes;
use crate::models::neural::{Models, Role};
use crate::scene::Embeddings;
use camino::Utf8Path;

/// What is asked of an encoder.
pub(super) struct Asked {
    pub query: String,
    pub scoring: ShortlistScoring,
    pub allow_builtin: bool,
}

/// How the encoder fared.
pub(super) struct Seen {
    /// Why it took no part, though it should have.
    pub missing: Option<String>,
    /// The end of the sentence was not read.
    pub cut: bool,
}

impl Seen {
    pub fn note(self, answer: &mut Answer) {
        let trace = answer.trace.get_or_insert_default();
        if let Some(why) = self.missing {
            answer.degraded = true;
            attributes::NAME.clone_into(&mut answer.models.encoder);
            trace.corrections.push(format!("names and measures answered, not the encoder: {why}"));
        }
    }
}

/// The question's words beside what the instances look like; nothing where no encoder has seen them.
pub(super) fn appearance(models: &Models, parse: &LoadedParse, asked: &Asked, parsed: &ParsedQuery) -> Result<Option<Appearance>, Error> {
    let Some(embeddings) = &parse.embeddings else { return Ok(None) };
    let here = models.label(Role::Encoder).unwrap_or_else(|| attributes::NAME.into());
    match &models.encoder {
        Some(encoder) if here == parse.encoder => Ok(Some(Appearance::of(&asked.query, parsed, encoder, embeddings, asked.scoring)?)),
        _ => Err(Error::EncoderChanged { parsed_with: parse.encoder.clone(), here }),
    }
}

pub(super) async fn read_embeddings(parse: &Utf8Path) -> Result<Option<Embeddings>, Error> {
    let (rows, norms) = (parse.join(EMBEDDINGS_FILE), parse.join(NORMS_FILE));
    match tokio::fs::read(&rows).await {
        Ok(rows) => Ok(Some(Embeddings::read(&rows, &tokio::fs::read(&norms).await?)?)),
        Err(error) if error.kind() == std::io::ErrorKind::NotFound => Ok(None),
        Err(error) => Err(error.into()),
    }
}
