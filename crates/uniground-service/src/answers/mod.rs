//! Answers questions about scenes and stores the answers.

mod follow_ups;
mod in_frame;
mod lists;
mod many;
mod once;
mod pictures;
mod question_models;
mod stored_scene;
pub(super) mod table;
mod transcripts;

use follow_ups::ResolvedQuestion;
pub use lists::AnswerService;
pub use lists::LineFormat;
use question_models::QuestionModels;
pub(super) use stored_scene::StoredScene;
pub use transcripts::Transcripts;

use super::parses::LoadedParse;
use super::{Caller, Vlm};
use crate::error::Error;
use crate::{Keyring, Limits, NamingService, ParsedScenes, RoomSearch, SceneLookup, ServiceLocks};
pub use in_frame::CoordinateFrameView;
use std::sync::Arc;
use std::time::{Duration, Instant};
use tokio::sync::Semaphore;
use tokio::time::{sleep, timeout};
use uniground_geometry::scene::InstanceId;
use uniground_grounding::pipeline::{self, Answered, Shortlist};
use uniground_grounding::reasoner::builtin;
use uniground_grounding::{Grounding, ShortlistScoring, Status};
use uniground_models::chat::{Budget, CallRecord, total_usage};
use uniground_storage::{AnswerRepository, Blobs, IdGenerator, NewAnswer, SceneRepository};
use uniground_telemetry::metrics::Metrics;
use uniground_types::answer::{Answer, Call, CoordinateFrame, Models, Shortlisted, Trace};
use uniground_types::question::{
    GroundRequest, Include, ParserChoice, ReasonerChoice, ShortlistRequest, WaitFor,
};

/// How long a batch keeps retrying to store an answer. After that the answer is lost and the
/// question is asked again.
pub(super) const STORE_RETRY_TIMEOUT: Duration = Duration::from_mins(5);
/// The interval between the attempts.
const RETRY_INTERVAL: Duration = Duration::from_secs(1);

/// The caller of a question, with the budget and answer id that a batch assigns.
pub(super) struct QuestionCaller {
    pub caller: Caller,
    /// The id that the answer will have.
    pub answer_id: String,
    /// A budget that is charged in addition to the question's own and the daily budget.
    pub pays: Option<Budget>,
    /// Whether the question is an item of a batch.
    pub is_batch: bool,
    /// Whether the scene may be named first. Naming is not charged to the question.
    pub may_name: bool,
}

/// What is stored with an answer.
struct AnswerRecord<'a> {
    /// Name of the vision-language model.
    model: &'a str,
    parse_id: &'a str,
    /// The conversation that it belongs to, qualified by the caller.
    session: Option<String>,
    calls: Vec<CallRecord>,
}

/// Answers questions about scenes.
#[derive(Clone)]
pub struct GroundingService {
    pub(crate) keyring: Keyring,
    pub(crate) scene_repository: SceneRepository,
    pub(crate) room_search: Arc<RoomSearch>,
    pub(crate) scene_lookup: Arc<SceneLookup>,
    pub(crate) ids: IdGenerator,
    pub(crate) scan_permits: Arc<Semaphore>,
    pub(crate) parsed_scenes: Arc<ParsedScenes>,
    pub(crate) metrics: Arc<Metrics>,
    pub(crate) blobs: Blobs,
    pub(crate) naming_service: Arc<NamingService>,
    pub(crate) vlm: Option<Arc<Vlm>>,
    pub(crate) answer_repository: AnswerRepository,
    pub(crate) transcripts: Arc<Transcripts>,
    pub(crate) limits: Limits,
    pub(crate) service_locks: Arc<ServiceLocks>,
}

impl GroundingService {
    /// Answers a question about a parsed scene and stores the answer.
    ///
    /// # Errors
    /// [`Error`] for an unknown or unparsed scene, an invalid question, overload, or a timeout; and
    /// if the question requires a model that is missing or cannot be paid for.
    pub async fn ground(
        &self,
        scene_id: &str,
        request: GroundRequest,
        caller: Caller,
    ) -> Result<Answer, Error> {
        let asker = QuestionCaller {
            caller,
            answer_id: self.ids.new_id(),
            pays: None,
            is_batch: false,
            may_name: true,
        };
        self.ground_for(scene_id, request, asker).await
    }

    /// Like [`ground`](Self::ground), for a caller that sets the answer's id or adds a budget.
    pub(super) async fn ground_for(
        &self,
        scene_id: &str,
        request: GroundRequest,
        asker: QuestionCaller,
    ) -> Result<Answer, Error> {
        let (start, is_batch) = (Instant::now(), asker.is_batch);
        let answered = Box::pin(self.answer_question(scene_id, request, asker)).await;
        match &answered {
            Ok(answer) => {
                let reasoner =
                    if answer.models.reasoner == builtin::NAME { "builtin" } else { "vlm" };
                self.metrics.questions.record_answer(
                    status_name(answer.status),
                    reasoner,
                    answer.degraded,
                    start.elapsed(),
                );
            }
            // Not counted as a failure: a batch yields to interactive questions and retries at
            // once.
            Err(Error::Overloaded) if is_batch => {}
            Err(error) => self.metrics.questions.record_failure(error.code()),
        }
        answered
    }

    async fn answer_question(
        &self,
        scene_id: &str,
        request: GroundRequest,
        asker: QuestionCaller,
    ) -> Result<Answer, Error> {
        request.check()?;
        let start = Instant::now();
        if request.wait == Some(WaitFor::Full) {
            let parsed = self.scene_lookup.wait_for_full_parse(scene_id);
            match request.timeout_s {
                Some(seconds) => timeout(Duration::from_secs_f32(seconds), parsed)
                    .await
                    .map_err(|_| Error::QuestionTimedOut { seconds })??,
                None => parsed.await?,
            }
        }
        let (scene, parse_id) = self.scene_lookup.ready_scene(scene_id).await?;
        let version = u32::try_from(scene.parse_version).unwrap_or(0);
        if let Some(asked) = request.if_version.filter(|asked| *asked != version) {
            return Err(Error::ParseChanged { asked, now: version });
        }
        let mut budgets = Vlm::budgets(request.max_cost_usd);
        budgets.extend(asker.pays);
        let models = QuestionModels::decide(self.vlm.as_ref(), &request, &asker.caller, budgets)?;
        if models.has_reviewer() && asker.may_name {
            let naming =
                self.naming_service.name_before_asking(&scene.id, &parse_id, &asker.caller);
            let named = match request.timeout_s {
                Some(seconds) => {
                    timeout(Duration::from_secs_f32(seconds), naming).await.unwrap_or(Ok(()))
                }
                None => naming.await,
            };
            if let Err(error) = named {
                tracing::warn!(
                    error = &error as &dyn std::error::Error,
                    "naming failed; answering without names"
                );
            }
        }
        let source = StoredScene::new(
            self.parsed_scenes.clone(),
            self.parsed_scenes.loaded_parse(&parse_id).await?,
        );
        let frame =
            CoordinateFrameView::resolve(request.frame, &scene, source.parse.source_to_scene)?;
        let request = match &frame {
            Some(frame) => GroundRequest {
                observer: request
                    .observer
                    .map(|observer| frame.from_scene.observer_to_scene(&observer)),
                within: match &request.within {
                    Some(region) => Some(frame.region_to_scene(region)?),
                    None => None,
                },
                ..request
            },
            None => request,
        };
        let said = request.query.clone();
        let (understood_as, context_confidence, follows) = match &request.context {
            Some(context) => {
                let ResolvedQuestion { query, confidence, follows } =
                    self.resolve_follow_up(&scene, &said, context, &asker.caller, &source).await?;
                ((query != said).then_some(query), confidence, follows)
            }
            None => (None, 1.0, None),
        };
        let session = request.context.as_ref().and_then(|context| context.session.clone());
        let request = match &understood_as {
            Some(query) => GroundRequest { query: query.clone(), ..request },
            None => request,
        };
        // A permit for the queue of the model, held until the question is answered.
        let _place = models.acquire_queue_permit()?;
        let asks_model = models.has_reviewer() || request.parser == ParserChoice::Vlm;
        let mut ask = models.into_ask(&request);
        ask.question.most_confidence = context_confidence;
        let answered = match request.timeout_s {
            Some(seconds) => {
                match timeout(
                    Duration::from_secs_f32(seconds).saturating_sub(start.elapsed()),
                    pipeline::answer(&source, ask),
                )
                .await
                {
                    Ok(answered) => answered?,
                    // A question that does not require the model falls back to the built-in answer.
                    Err(_) if asks_model && request.reasoner == ReasonerChoice::Auto => {
                        self.answer_without_model(&request, &source, seconds).await?
                    }
                    Err(_) => return Err(Error::QuestionTimedOut { seconds }),
                }
            }
            None => pipeline::answer(&source, ask).await?,
        };
        answered.calls.iter().for_each(|call| self.metrics.vlm.record_purpose(call.purpose));
        let mut answer =
            self.to_answer(&answered, asker.answer_id, scene.id, version, &source.parse);
        answer.query = said;
        answer.understood_as = understood_as;
        answer.follows = follows;
        answer.session = session;
        answer.in_frame = frame.map(|frame| frame.with_targets(&answer.targets));
        let model = self.vlm.as_ref().map_or("", |vlm| vlm.name());
        // No client waits for an item of a batch, and its answer may have been paid for. Storing it
        // is retried until the store is available again.
        let patience = if asker.is_batch { STORE_RETRY_TIMEOUT } else { Duration::ZERO };
        let record = AnswerRecord {
            model,
            parse_id: &parse_id,
            session: answer.session.clone().map(|session| asker.caller.qualify_name(session)),
            calls: answered.calls,
        };
        match self.store_with_retries(patience, &answer, &record).await {
            Ok(true) => {}
            Ok(false) => {
                self.blobs.discard(self.blobs.answer(&answer.id)).await?;
                return Err(Error::SceneNotFound { id: answer.scene_id });
            }
            // The caller gets the answer in any case. That it could not be stored is for the
            // operator.
            Err(error) => {
                tracing::error!(
                    error = &error as &dyn std::error::Error,
                    "answer could not be stored; returning it unstored"
                );
                (answer.stored, answer.evidence) = (false, Some(Vec::new()));
            }
        }
        Ok(filter_answer(answer, request.include.as_deref()))
    }

    /// Returns the built-in answer to a question that timed out before the model replied.
    async fn answer_without_model(
        &self,
        request: &GroundRequest,
        source: &Arc<StoredScene>,
        seconds: f32,
    ) -> Result<Answered, Error> {
        let request = GroundRequest {
            reasoner: ReasonerChoice::Builtin,
            parser: ParserChoice::Builtin,
            ..request.clone()
        };
        let ask = QuestionModels::built_in().into_ask(&request);
        let mut answered = pipeline::answer(source, ask).await?;
        answered.degraded = true;
        answered.corrections.push(format!("the model did not answer within {seconds} s"));
        Ok(answered)
    }

    /// Like `store_answer`, but retries for up to `patience` while the store is unavailable.
    async fn store_with_retries(
        &self,
        patience: Duration,
        answer: &Answer,
        record: &AnswerRecord<'_>,
    ) -> Result<bool, Error> {
        let start = Instant::now();
        loop {
            match self.store_answer(answer, record).await {
                Err(error) if error.is_transient() && start.elapsed() < patience => {
                    tracing::warn!(
                        error = &error as &dyn std::error::Error,
                        "answer could not be stored yet; retrying"
                    );
                    sleep(RETRY_INTERVAL).await;
                }
                kept => return kept,
            }
        }
    }

    /// Stores an answer with its transcript. Returns `false` if its scene was deleted.
    async fn store_answer(
        &self,
        answer: &Answer,
        AnswerRecord { model, parse_id, session, calls }: &AnswerRecord<'_>,
    ) -> Result<bool, Error> {
        self.transcripts.store_transcript(answer, model, calls.clone()).await?;
        let new = NewAnswer {
            id: answer.id.clone(),
            scene_id: answer.scene_id.clone(),
            parse_id: (*parse_id).to_owned(),
            body: serde_json::to_string(answer)?,
            session: session.clone(),
        };
        Ok(self.answer_repository.insert_answer(new).await?)
    }

    /// Returns the candidates for a query, without reasoning over relations.
    ///
    /// # Errors
    /// Those of [`ground`](Self::ground).
    pub async fn shortlist(
        &self,
        scene_id: &str,
        request: ShortlistRequest,
    ) -> Result<Shortlisted, Error> {
        request.check()?;
        let (_, parse_id) = self.scene_lookup.ready_scene(scene_id).await?;
        let source = StoredScene::new(
            self.parsed_scenes.clone(),
            self.parsed_scenes.loaded_parse(&parse_id).await?,
        );
        let ShortlistRequest { query, top_k, query_text, candidates, calibrated, allow_builtin } =
            request;
        let scoring = ShortlistScoring { from: candidates, query_text, calibrated };
        let Shortlist { candidates, encoder, cut } =
            pipeline::shortlist(&source, query.clone(), scoring, allow_builtin, top_k as usize)
                .await?;
        Ok(Shortlisted { query, candidates, encoder, cut })
    }

    /// Converts the result of a question to the answer that callers get.
    fn to_answer(
        &self,
        answered: &Answered,
        id: String,
        scene_id: String,
        parse_version: u32,
        parse: &LoadedParse,
    ) -> Answer {
        let Answered {
            grounding,
            parsed: _,
            parser,
            encoder,
            reasoner,
            degraded,
            corrections,
            left_out,
            calls,
        } = answered.clone();
        let Grounding {
            query,
            kind,
            text,
            value,
            status,
            no_match_reason,
            seen,
            differs,
            coverage,
            answer,
            aabb,
            oriented_box,
            confidence,
            mut candidates,
            mut alternatives,
            mut targets,
            count,
            parsed_query,
            direction_convention,
            timings_ms,
        } = grounding;
        let view = |id: InstanceId| {
            let is_shown = parse
                .instances
                .get(id.0 as usize - 1)
                .is_some_and(|instance| !instance.views.is_empty());
            is_shown
                .then(|| format!("/v1/scenes/{scene_id}/instances/{id}/views/0.jpg?picture=crop"))
        };
        candidates.iter_mut().for_each(|candidate| candidate.view = view(candidate.id));
        alternatives.iter_mut().for_each(|alternative| alternative.view = view(alternative.id));
        targets.iter_mut().for_each(|target| target.last_seen = parse.last_seen(target.id));
        let mut evidence = vec![transcripts::picture_path(&id, pictures::GLOBAL)];
        if self.limits.retention.evidence_days > 0 {
            let shown = transcripts::picture_names(&calls)
                .into_iter()
                .filter(|name| *name != pictures::GLOBAL);
            evidence.extend(shown.map(|name| transcripts::picture_path(&id, &name)));
        }
        Answer {
            evidence: Some(evidence),
            id,
            scene_id,
            parse_version,
            query,
            understood_as: None,
            follows: None,
            session: None,
            kind,
            text,
            value,
            status,
            no_match_reason,
            seen,
            differs,
            coverage,
            answer,
            aabb,
            oriented_box,
            confidence,
            candidates: Some(candidates),
            alternatives,
            last_seen: targets.first().and_then(|target| target.last_seen.clone()),
            targets,
            count,
            parsed_query,
            models: Models {
                masks: parse.masks.clone(),
                encoder,
                parser,
                names: parse.named_by.clone(),
                reasoner,
            },
            degraded,
            stored: true,
            direction_convention,
            frame: CoordinateFrame::default(),
            in_frame: None,
            trace: Some(Trace {
                calls: calls.iter().map(to_call).collect(),
                corrections,
                left_out,
            }),
            usage: total_usage(&calls),
            timings_ms,
        }
    }
}

impl AnswerService {
    /// Returns the JSON of an answer, byte for byte as it was first returned.
    ///
    /// # Errors
    /// [`Error::AnswerNotFound`].
    pub async fn answer(&self, id: &str) -> Result<String, Error> {
        Ok(self
            .answer_repository
            .answer(id)
            .await?
            .ok_or_else(|| Error::AnswerNotFound { id: id.into() })?
            .body)
    }
}

/// Returns the spelling of a status.
fn status_name(status: Status) -> &'static str {
    match status {
        Status::Grounded => "grounded",
        Status::Uncertain => "uncertain",
        Status::Ambiguous => "ambiguous",
        Status::NoMatch => "no_match",
    }
}

/// Converts one call of a model to its form in the trace.
fn to_call(record: &CallRecord) -> Call {
    let (reply, error) = (record.outcome.as_ref().ok(), record.outcome.as_ref().err().cloned());
    Call {
        purpose: record.purpose.to_owned(),
        attempts: record.attempts,
        latency_ms: record.latency_ms,
        prompt_tokens: reply.map_or(0, |reply| reply.prompt_tokens),
        completion_tokens: reply.map_or(0, |reply| reply.completion_tokens),
        error,
    }
}

/// Keeps the requested parts of an answer. Keeps all of them if none are named.
fn filter_answer(mut answer: Answer, include: Option<&[Include]>) -> Answer {
    if let Some(include) = include {
        let wanted = |part| include.contains(&part);
        answer.candidates = answer.candidates.filter(|_| wanted(Include::Candidates));
        answer.evidence = answer.evidence.filter(|_| wanted(Include::Evidence));
        answer.trace = answer.trace.filter(|_| wanted(Include::Trace));
    }
    answer
}
