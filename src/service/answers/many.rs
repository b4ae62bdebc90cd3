//! Questions about many scenes: every one is looked into without a model, and those that most likely have it are asked in full.

use super::{Asker, StoredScene};
use crate::error::Error;
use crate::service::vlm::OF_QUESTION;
use crate::service::{Caller, Service};
use crate::store::{SceneFilter, SceneRow};
use futures::{StreamExt, stream};
use std::time::{Duration, Instant};
use tokio::time::sleep;
use uniground_core::grounding::Status;
use uniground_core::grounding::pipeline::{self, Answered};
use uniground_core::models::chat::Budget;
use uniground_types::many::{ManyAnswers, ManyGroundRequest, NotAsked, SceneAnswer};
use uniground_types::question::{GroundRequest, ReasonerChoice};

/// Most scenes that one question is about.
const MOST_SCENES: u32 = 1000;
/// Scenes looked into at once: somebody else's question comes between.
const LOOKS_AT_ONCE: usize = 2;
/// Scenes asked in full at once.
const ASKED_AT_ONCE: usize = 4;
/// How long a look waits when others are before it.
const STEP_ASIDE: Duration = Duration::from_millis(50);

impl Service {
    /// Finds out in which of many scenes something is.
    ///
    /// # Errors
    /// [`Error::Invalid`], [`Error::SceneNotFound`] for a scene that was named; where no scene could be asked in full, why the first could not.
    pub async fn ground_many(&self, request: ManyGroundRequest, caller: Caller) -> Result<ManyAnswers, Error> {
        request.check()?;
        let (start, question) = (Instant::now(), request.of_one());
        self.reviewer(&question, &caller)?;
        let rows = self.scenes_meant(&request).await?;
        let glance_at = GroundRequest { reasoner: ReasonerChoice::Builtin, ..question.clone() };
        let looks: Vec<(SceneRow, Result<Answered, Error>)> = stream::iter(rows)
            .map(async |row| {
                let seen = self.glance(&row, &glance_at, &caller, start).await;
                (row, seen)
            })
            .buffered(LOOKS_AT_ONCE)
            .collect()
            .await;
        let (mut looked_into, mut likely, mut not_asked) = (0, Vec::new(), Vec::new());
        for (row, seen) in looks {
            match seen {
                Ok(Answered { grounding, .. }) => {
                    looked_into += 1;
                    likely.push((standing(grounding.status, grounding.confidence), row));
                }
                // It was deleted meanwhile.
                Err(Error::SceneNotFound { .. }) => {}
                Err(error @ Error::QuestionTimedOut { .. }) => return Err(error),
                Err(error) => not_asked.push(told(&row, &error)),
            }
        }
        // Newest first among equals, as they come.
        likely.sort_by(|(a, _), (b, _)| a.0.cmp(&b.0).then(b.1.total_cmp(&a.1)));
        likely.truncate(request.top_k as usize);
        let pays = request.max_cost_usd.map(|usd| Budget::new(OF_QUESTION, usd));
        let asked: Vec<(SceneRow, Result<_, Error>)> = stream::iter(likely)
            .map(async |(_, row)| {
                let timeout_s = question.timeout_s.map(|seconds| (seconds - start.elapsed().as_secs_f32()).max(0.001));
                let asker = Asker { caller: caller.clone(), answer_id: self.store.new_id(), pays: pays.clone(), is_batch: false };
                let answer = self.ground_for(&row.id, GroundRequest { timeout_s, ..question.clone() }, asker).await;
                (row, answer)
            })
            .buffered(ASKED_AT_ONCE)
            .collect()
            .await;
        let (mut answers, mut first_error) = (Vec::new(), None);
        for (row, answer) in asked {
            match answer {
                Ok(answer) => answers.push(SceneAnswer { scene_name: row.name, labels: row.labels, answer }),
                Err(error) => {
                    not_asked.push(told(&row, &error));
                    first_error.get_or_insert(error);
                }
            }
        }
        if let (true, Some(error)) = (answers.is_empty(), first_error) {
            return Err(error);
        }
        let standing_of = |found: &SceneAnswer| standing(found.answer.status, found.answer.confidence);
        answers.sort_by(|a, b| {
            let (a, b) = (standing_of(a), standing_of(b));
            a.0.cmp(&b.0).then(b.1.total_cmp(&a.1))
        });
        Ok(ManyAnswers { query: request.query, looked_into, answers, not_asked })
    }

    async fn scenes_meant(&self, request: &ManyGroundRequest) -> Result<Vec<SceneRow>, Error> {
        let filter = SceneFilter { ids: request.scenes.clone(), labels: request.labels.clone() };
        let rows = self.store.scenes(MOST_SCENES + 1, None, &filter).await?;
        if rows.len() > MOST_SCENES as usize {
            let detail = format!("more than {MOST_SCENES} scenes are meant: narrow them down by labels, or name those to look in");
            return Err(Error::invalid("/scenes", detail));
        }
        for id in request.scenes.iter().flatten() {
            if rows.iter().all(|row| row.id != *id) {
                // It may be there under other labels.
                self.scene_row(id).await?;
            }
        }
        Ok(rows)
    }

    /// What the built-in reasoner makes of one scene; nothing is kept of it.
    async fn glance(&self, row: &SceneRow, question: &GroundRequest, caller: &Caller, start: Instant) -> Result<Answered, Error> {
        let not_ready = || Error::SceneNotReady { id: row.id.clone(), job_id: row.job_id.clone() };
        let parse_id = row.parse_id.as_ref().ok_or_else(not_ready)?;
        let scene = StoredScene::new(self.clone(), self.passing_parse(parse_id).await?);
        loop {
            if let Some(seconds) = question.timeout_s.filter(|seconds| start.elapsed().as_secs_f32() > *seconds) {
                return Err(Error::QuestionTimedOut { seconds });
            }
            match pipeline::answer(&scene, self.ask(question, caller, None, &[])?).await {
                Err(Error::Overloaded) => sleep(STEP_ASIDE).await,
                answered => return answered,
            }
        }
    }
}

/// The lower first, then by confidence: what is said of a thing counts before what is said of its absence.
fn standing(status: Status, confidence: f32) -> (u8, f32) {
    match status {
        Status::Grounded => (0, confidence),
        Status::Ambiguous => (1, confidence),
        Status::Uncertain => (2, confidence),
        Status::NoMatch => (3, -confidence),
    }
}

fn told(row: &SceneRow, error: &Error) -> NotAsked {
    NotAsked { scene_id: row.id.clone(), code: error.code().to_owned(), detail: error.to_string() }
}
