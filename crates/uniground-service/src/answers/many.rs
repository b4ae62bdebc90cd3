//! Questions about many scenes. Every scene is first scanned without a model. The most likely ones
//! are then asked in full.

use super::question_models::QuestionModels;
use super::{QuestionCaller, StoredScene};
use crate::error::Error;
use crate::vlm::OF_QUESTION;
use crate::{Caller, GroundingService};
use futures::{StreamExt, stream};
use std::collections::HashSet;
use std::mem;
use std::time::{Duration, Instant};
use tokio::time::sleep;
use uniground_grounding::Status;
use uniground_grounding::pipeline::{self, Answered};
use uniground_models::chat::Budget;
use uniground_storage::{SceneFilter, SceneRow};
use uniground_types::answer::Answer;
use uniground_types::many::{MOST_SCENES, ManyAnswers, ManyGroundRequest, NotAsked, SceneAnswer};
use uniground_types::question::{GroundRequest, ReasonerChoice};

/// Scenes of one question that are asked concurrently.
const MAX_CONCURRENT_SCENES: usize = 4;
/// Up to this many scenes stay in memory after they were scanned.
const FEW_SCENES: usize = 32;
/// How many scenes are scanned if more match than can be scanned.
const LIKELY_SCENES: usize = 200;
/// The wait when no permit is free, and how often it is repeated.
const RETRY_DELAY: Duration = Duration::from_millis(100);
const TRIES: u32 = 100;

impl GroundingService {
    /// Finds the scenes that contain what the question asks for.
    ///
    /// # Errors
    /// [`Error::Invalid`]; [`Error::SceneNotFound`] for a scene that was named; if no scene could
    /// be asked in full, the error of the first one.
    pub async fn ground_many(
        &self,
        mut request: ManyGroundRequest,
        caller: Caller,
    ) -> Result<ManyAnswers, Error> {
        request.check()?;
        for scene in request.scenes.iter_mut().flatten() {
            *scene = self.scene_lookup.resolve(mem::take(scene)).await?;
        }
        let (start, question) = (Instant::now(), request.to_ground_request());
        // Fails early if the question requires a model that is unavailable.
        QuestionModels::decide(self.vlm.as_ref(), &question, &caller, Vec::new())?;
        let (rows, narrowed) = self.select_scenes(&request).await?;
        let glance_at = GroundRequest { reasoner: ReasonerChoice::Builtin, ..question.clone() };
        let stays = rows.len() <= FEW_SCENES;
        let looks: Vec<(SceneRow, Result<MatchRank, Error>)> = stream::iter(rows)
            .map(async |row| {
                let seen = Box::pin(self.scan_scene(&row, &glance_at, &caller, start, stays)).await;
                (row, seen)
            })
            .buffered(MAX_CONCURRENT_SCENES)
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
                // The scene was deleted in the meantime.
                Err(Error::SceneNotFound { .. }) => {}
                Err(error @ Error::QuestionTimedOut { .. }) => return Err(error),
                Err(error) => {
                    not_asked.push(to_not_asked(&row, &error));
                    if !matches!(error, Error::SceneNotReady { .. }) {
                        first_error.get_or_insert(error);
                    }
                }
            }
        }
        if let (0, Some(error)) = (looked_into, first_error) {
            return Err(error);
        }
        // The sort is stable: scenes of equal rank stay newest first.
        likely.sort_by(|(a, _), (b, _)| a.0.cmp(&b.0).then(b.1.total_cmp(&a.1)));
        likely.truncate(request.top_k as usize);
        let pays = request.max_cost_usd.map(|usd| Budget::new(OF_QUESTION, usd));
        let asked: Vec<(SceneRow, Result<_, Error>)> = stream::iter(likely)
            .map(async |(_, row)| {
                let answer =
                    Box::pin(self.ask_full_question(&row, &question, &caller, start, pays.clone()))
                        .await;
                (row, answer)
            })
            .buffered(MAX_CONCURRENT_SCENES)
            .collect()
            .await;
        let (mut answers, mut first_error) = (Vec::new(), None);
        for (row, answer) in asked {
            match answer {
                Ok(answer) => {
                    answers.push(SceneAnswer { scene_name: row.name, labels: row.labels, answer });
                }
                Err(error) => {
                    not_asked.push(to_not_asked(&row, &error));
                    first_error.get_or_insert(error);
                }
            }
        }
        if let (true, Some(error)) = (answers.is_empty(), first_error) {
            return Err(error);
        }
        // Every scene asked in full counts as a question. The first one was counted with the
        // request.
        if let Some(key) = &caller.key {
            for _ in answers.iter().skip(1) {
                let _ = self.keyring.count_request(key).await;
            }
        }
        let standing_of =
            |found: &SceneAnswer| match_rank(found.answer.status, found.answer.confidence);
        answers.sort_by(|a, b| {
            let (a, b) = (standing_of(a), standing_of(b));
            a.0.cmp(&b.0).then(b.1.total_cmp(&a.1))
        });
        Ok(ManyAnswers { query: request.query, looked_into, narrowed, answers, not_asked })
    }

    /// Returns the scenes to scan: all that match or, if they are too many, the likeliest ones by
    /// the room index. Also returns whether the list was shortened this way.
    async fn select_scenes(
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
            // The scene may exist with other labels.
            self.scene_lookup.scene_row(id).await?;
        }
        Ok((rows, false))
    }

    /// Asks the whole question about one scene.
    async fn ask_full_question(
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
            // The cost of naming a scene is not part of a question's budget.
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
                Err(Error::Overloaded) if tries < TRIES => sleep(RETRY_DELAY).await,
                answered => return answered,
            }
            tries += 1;
        }
    }

    /// Asks the built-in reasoner about one scene. The answer is not stored.
    async fn scan_scene(
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
                self.parsed_scenes.load_parse_uncached(parse_id).await?
            };
            let scene = StoredScene::new(self.parsed_scenes.clone(), parse);
            let models = QuestionModels::decide(self.vlm.as_ref(), question, caller, Vec::new())?;
            match pipeline::answer(&scene, models.into_ask(question)).await {
                Err(Error::Overloaded) if tries < TRIES => {
                    drop(glance);
                    sleep(RETRY_DELAY).await;
                }
                answered => {
                    return answered.map(|Answered { grounding, .. }| {
                        match_rank(grounding.status, grounding.confidence)
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

/// A rank, lower is better, and a confidence within it, higher is better.
type MatchRank = (u8, f32);

/// Ranks a result by status, then by confidence. Results that find the object come before results
/// that report its absence.
fn match_rank(status: Status, confidence: f32) -> MatchRank {
    match status {
        Status::Grounded => (0, confidence),
        Status::Ambiguous => (1, confidence),
        Status::Uncertain => (2, confidence),
        Status::NoMatch => (3, -confidence),
    }
}

fn to_not_asked(row: &SceneRow, error: &Error) -> NotAsked {
    if !matches!(error, Error::SceneNotReady { .. }) {
        tracing::warn!(
            scene_id = row.id,
            error = error as &dyn std::error::Error,
            "scene could not be searched"
        );
    }
    NotAsked { scene_id: row.id.clone(), code: error.code().to_owned(), detail: error.to_string() }
}
