//! Questions about many scenes: every one is looked into without a model, and those that most
//! likely have it are asked in full.

use super::{QuestionCaller, StoredScene};
use crate::error::Error;
use crate::vlm::OF_QUESTION;
use crate::{Caller, GroundingService};
use futures::{StreamExt, stream};
use std::collections::HashSet;
use std::time::{Duration, Instant};
use tokio::time::sleep;
use uniground_grounding::Status;
use uniground_grounding::pipeline::{self, Answered};
use uniground_models::chat::Budget;
use uniground_storage::{SceneFilter, SceneRow};
use uniground_types::answer::Answer;
use uniground_types::many::{MOST_SCENES, ManyAnswers, ManyGroundRequest, NotAsked, SceneAnswer};
use uniground_types::question::{GroundRequest, ReasonerChoice};

/// Scenes of one question that are under way at once.
const AT_ONCE: usize = 4;
/// So few scenes stay in memory once they were looked into.
const FEW_SCENES: usize = 32;
/// So many are looked into where more are meant than can be.
const LIKELY_SCENES: usize = 200;
/// How long a scene waits when all places are taken, and how often.
const STEP_ASIDE: Duration = Duration::from_millis(100);
const TRIES: u32 = 100;

impl GroundingService {
    /// Finds out in which of many scenes something is.
    ///
    /// # Errors
    /// [`Error::Invalid`], [`Error::SceneNotFound`] for a scene that was named; where no scene
    /// could be asked in full, why the first could not.
    pub async fn ground_many(
        &self,
        request: ManyGroundRequest,
        caller: Caller,
    ) -> Result<ManyAnswers, Error> {
        request.check()?;
        let (start, question) = (Instant::now(), request.of_one());
        self.reviewer(&question, &caller)?;
        let (rows, narrowed) = self.scenes_meant(&request).await?;
        let glance_at = GroundRequest { reasoner: ReasonerChoice::Builtin, ..question.clone() };
        let stays = rows.len() <= FEW_SCENES;
        let looks: Vec<(SceneRow, Result<MatchRank, Error>)> = stream::iter(rows)
            .map(async |row| {
                let seen = Box::pin(self.glance(&row, &glance_at, &caller, start, stays)).await;
                (row, seen)
            })
            .buffered(AT_ONCE)
            .collect()
            .await;
        let (mut looked_into, mut likely, mut not_asked, mut first_error) =
            (0, Vec::new(), Vec::new(), None);
        for (row, seen) in looks {
            match seen {
                Ok(standing) => {
                    looked_into += 1;
                    likely.push((standing, row));
                }
                // It was deleted meanwhile.
                Err(Error::SceneNotFound { .. }) => {}
                Err(error @ Error::QuestionTimedOut { .. }) => return Err(error),
                Err(error) => {
                    not_asked.push(told(&row, &error));
                    if !matches!(error, Error::SceneNotReady { .. }) {
                        first_error.get_or_insert(error);
                    }
                }
            }
        }
        if let (0, Some(error)) = (looked_into, first_error) {
            return Err(error);
        }
        // Newest first among equals, as they come.
        likely.sort_by(|(a, _), (b, _)| a.0.cmp(&b.0).then(b.1.total_cmp(&a.1)));
        likely.truncate(request.top_k as usize);
        let pays = request.max_cost_usd.map(|usd| Budget::new(OF_QUESTION, usd));
        let asked: Vec<(SceneRow, Result<_, Error>)> = stream::iter(likely)
            .map(async |(_, row)| {
                let answer =
                    Box::pin(self.ask_in_full(&row, &question, &caller, start, pays.clone())).await;
                (row, answer)
            })
            .buffered(AT_ONCE)
            .collect()
            .await;
        let (mut answers, mut first_error) = (Vec::new(), None);
        for (row, answer) in asked {
            match answer {
                Ok(answer) => {
                    answers.push(SceneAnswer { scene_name: row.name, labels: row.labels, answer })
                }
                Err(error) => {
                    not_asked.push(told(&row, &error));
                    first_error.get_or_insert(error);
                }
            }
        }
        if let (true, Some(error)) = (answers.is_empty(), first_error) {
            return Err(error);
        }
        // Each of them is a question of its own; one was counted when it came.
        if let Some(key) = &caller.key {
            for _ in answers.iter().skip(1) {
                let _ = self.keyring.count(key).await;
            }
        }
        let standing_of =
            |found: &SceneAnswer| standing(found.answer.status, found.answer.confidence);
        answers.sort_by(|a, b| {
            let (a, b) = (standing_of(a), standing_of(b));
            a.0.cmp(&b.0).then(b.1.total_cmp(&a.1))
        });
        Ok(ManyAnswers { query: request.query, looked_into, narrowed, answers, not_asked })
    }

    /// The scenes to look into: all that are meant, or where those are too many the likeliest by
    /// what they are known by, and whether that is so.
    async fn scenes_meant(
        &self,
        request: &ManyGroundRequest,
    ) -> Result<(Vec<SceneRow>, bool), Error> {
        let filter = SceneFilter { ids: request.scenes.clone(), labels: request.labels.clone() };
        let rows = self.scene_repository.scenes(MOST_SCENES as u32 + 1, None, &filter).await?;
        if rows.len() > MOST_SCENES {
            return Ok((
                self.room_search
                    .likely_scenes(&request.query, &request.labels, LIKELY_SCENES)
                    .await?,
                true,
            ));
        }
        let found: HashSet<&str> = rows.iter().map(|row| row.id.as_str()).collect();
        for id in request.scenes.iter().flatten().filter(|id| !found.contains(id.as_str())) {
            // It may be there under other labels.
            self.scene_lookup.scene_row(id).await?;
        }
        Ok((rows, false))
    }

    /// One of the scenes, as a question about it alone.
    async fn ask_in_full(
        &self,
        row: &SceneRow,
        question: &GroundRequest,
        caller: &Caller,
        start: Instant,
        pays: Option<Budget>,
    ) -> Result<Answer, Error> {
        let mut tries = 1;
        loop {
            check_time(question, start)?;
            let timeout_s = question
                .timeout_s
                .map(|seconds| seconds - start.elapsed().as_secs_f32())
                .filter(|left| *left > 0.0);
            // What naming a scene costs is no part of a question's budget.
            let asker = QuestionCaller {
                caller: caller.clone(),
                answer_id: self.ids.new_id(),
                pays: pays.clone(),
                is_batch: false,
                may_name: false,
            };
            match self
                .ground_for(&row.id, GroundRequest { timeout_s, ..question.clone() }, asker)
                .await
            {
                Err(Error::Overloaded) if tries < TRIES => sleep(STEP_ASIDE).await,
                answered => return answered,
            }
            tries += 1;
        }
    }

    /// What the built-in reasoner makes of one scene; nothing is kept of it.
    async fn glance(
        &self,
        row: &SceneRow,
        question: &GroundRequest,
        caller: &Caller,
        start: Instant,
        stays: bool,
    ) -> Result<MatchRank, Error> {
        let not_ready = || Error::SceneNotReady { id: row.id.clone(), job_id: row.job_id.clone() };
        let parse_id = row.parse_id.as_ref().ok_or_else(not_ready)?;
        let mut tries = 1;
        loop {
            let glance = self.scan_permits.acquire().await;
            check_time(question, start)?;
            let parse = if stays {
                self.parsed_scenes.loaded_parse(parse_id).await?
            } else {
                self.parsed_scenes.passing_parse(parse_id).await?
            };
            let scene = StoredScene::new(self.parsed_scenes.clone(), parse);
            match pipeline::answer(&scene, self.ask(question, caller, None, &[])?).await {
                Err(Error::Overloaded) if tries < TRIES => {
                    drop(glance);
                    sleep(STEP_ASIDE).await;
                }
                answered => {
                    return answered.map(|Answered { grounding, .. }| {
                        standing(grounding.status, grounding.confidence)
                    });
                }
            }
            tries += 1;
        }
    }
}

fn check_time(question: &GroundRequest, start: Instant) -> Result<(), Error> {
    match question.timeout_s.filter(|seconds| start.elapsed().as_secs_f32() >= *seconds) {
        Some(seconds) => Err(Error::QuestionTimedOut { seconds }),
        None => Ok(()),
    }
}

/// A rank, the lower the better, and within it the higher the better.
type MatchRank = (u8, f32);

/// The lower first, then by confidence: what is said of a thing counts before what is said of its
/// absence.
fn standing(status: Status, confidence: f32) -> MatchRank {
    match status {
        Status::Grounded => (0, confidence),
        Status::Ambiguous => (1, confidence),
        Status::Uncertain => (2, confidence),
        Status::NoMatch => (3, -confidence),
    }
}

fn told(row: &SceneRow, error: &Error) -> NotAsked {
    if !matches!(error, Error::SceneNotReady { .. }) {
        tracing::warn!(
            scene_id = row.id,
            error = error as &dyn std::error::Error,
            "scene could not be searched"
        );
    }
    NotAsked { scene_id: row.id.clone(), code: error.code().to_owned(), detail: error.to_string() }
}
