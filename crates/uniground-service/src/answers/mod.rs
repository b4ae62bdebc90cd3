//! Questions to answers, kept.

mod in_frame;
mod lists;
mod many;
mod once;
mod pictures;
mod stored_scene;
pub(super) mod table;
mod transcripts;

pub use lists::AnswerService;
pub use lists::LineFormat;
pub(super) use stored_scene::StoredScene;
pub use transcripts::Transcripts;

use super::parses::LoadedParse;
use super::vlm::OF_QUESTION;
use super::{Caller, Vlm};
use crate::error::Error;
use crate::{Keyring, Limits, NamingService, ParsedScenes, RoomSearch, SceneLookup, ServiceLocks};
pub use in_frame::CoordinateFrameView;
use std::sync::Arc;
use std::time::{Duration, Instant};
use tokio::sync::Semaphore;
use tokio::time::{sleep, timeout};
use uniground_geometry::scene::InstanceId;
use uniground_grounding::pipeline::{self, Answered, Ask, Review, Shortlist, WithoutModel};
use uniground_grounding::reasoner::builtin;
use uniground_grounding::vlm::Options;
use uniground_grounding::{Grounding, Question, ShortlistScoring, Status};
use uniground_language::{AutoParser, BuiltinParser, QueryParser, VlmParser};
use uniground_models::chat::{Budget, CallRecord, OverBudget, usage_of};
use uniground_storage::{AnswerRepository, Blobs, IdGenerator, NewAnswer, SceneRepository};
use uniground_telemetry::metrics::Metrics;
use uniground_types::answer::{Answer, Call, CoordinateFrame, Models, Shortlisted, Trace};
use uniground_types::question::{
    DEFAULT_MIN_CONFIDENCE, GroundRequest, Include, ParserChoice, ReasonerChoice, ShortlistRequest,
};

/// How long the store may be away until an answer of a batch is lost, and asked for again.
pub(super) const STORE_IS_BACK: Duration = Duration::from_mins(5);
/// How often it is tried.
const LOOK_AGAIN: Duration = Duration::from_secs(1);

/// Who asks, and what goes with that where it is not somebody who waits for the answer.
pub(super) struct QuestionCaller {
    pub caller: Caller,
    /// Of the answer.
    pub answer_id: String,
    /// Pays beside the question's own budget and the day's.
    pub pays: Option<Budget>,
    /// It is an item of a batch.
    pub is_batch: bool,
    /// A scene may be named first, which is paid beside the question.
    pub may_name: bool,
}

/// Answers questions about scenes.
#[derive(Clone)]
pub struct GroundingService {
    pub(crate) keyring: Keyring,
    pub(crate) scene_repository: SceneRepository,
    pub(crate) room_search: RoomSearch,
    pub(crate) scene_lookup: SceneLookup,
    pub(crate) ids: IdGenerator,
    pub(crate) scan_permits: Arc<Semaphore>,
    pub(crate) parsed_scenes: ParsedScenes,
    pub(crate) metrics: Arc<Metrics>,
    pub(crate) blobs: Blobs,
    pub(crate) naming_service: NamingService,
    pub(crate) vlm: Option<Arc<Vlm>>,
    pub(crate) answer_repository: AnswerRepository,
    pub(crate) transcripts: Transcripts,
    pub(crate) limits: Limits,
    pub(crate) service_locks: ServiceLocks,
}

impl GroundingService {
    /// Grounds one question in a parsed scene and keeps the answer.
    ///
    /// # Errors
    /// [`Error`]: unknown or unparsed scene, a question that is none, no model or no money where a model was demanded, overload, time-out.
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

    /// The same for somebody who has chosen the answer's id, or pays.
    pub(super) async fn ground_for(
        &self,
        scene_id: &str,
        request: GroundRequest,
        asker: QuestionCaller,
    ) -> Result<Answer, Error> {
        let (start, is_batch) = (Instant::now(), asker.is_batch);
        let answered = Box::pin(self.ground_uncounted(scene_id, request, asker)).await;
        match &answered {
            Ok(answer) => {
                let reasoner =
                    if answer.models.reasoner == builtin::NAME { "builtin" } else { "vlm" };
                self.metrics.questions.answered(
                    word(answer.status),
                    reasoner,
                    answer.degraded,
                    start.elapsed(),
                );
            }
            // A batch steps aside for people and asks again at once.
            Err(Error::Overloaded) if is_batch => {}
            Err(error) => self.metrics.questions.failed(error.code()),
        }
        answered
    }

    async fn ground_uncounted(
        &self,
        scene_id: &str,
        request: GroundRequest,
        asker: QuestionCaller,
    ) -> Result<Answer, Error> {
        request.check()?;
        let (scene, parse_id) = self.scene_lookup.ready_scene(scene_id).await?;
        let reviewer = self.reviewer(&request, &asker.caller)?;
        let start = Instant::now();
        if reviewer.is_some() && asker.may_name {
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
        let frame = CoordinateFrameView::of(request.frame, &scene, source.parse.source_to_scene)?;
        let request = match &frame {
            Some(frame) => GroundRequest {
                observer: request.observer.map(|observer| frame.from_scene.observer(&observer)),
                ..request
            },
            None => request,
        };
        // A place among those who wait for the model, for as long as the question takes.
        let _place = reviewer.as_ref().map(|vlm| vlm.place()).transpose()?;
        let mut budgets = Vlm::budgets(request.max_cost_usd);
        budgets.extend(asker.pays);
        let asks_model = reviewer.is_some() || request.parser == ParserChoice::Vlm;
        let ask = self.ask(&request, &asker.caller, reviewer, &budgets)?;
        let answered = match request.timeout_s {
            Some(seconds) => {
                match timeout(
                    Duration::from_secs_f32(seconds).saturating_sub(start.elapsed()),
                    pipeline::answer(&source, ask),
                )
                .await
                {
                    Ok(answered) => answered?,
                    // Who did not insist on the model gets what there is without it.
                    Err(_) if asks_model && request.reasoner == ReasonerChoice::Auto => {
                        self.without_model(&request, &source, seconds).await?
                    }
                    Err(_) => return Err(Error::QuestionTimedOut { seconds }),
                }
            }
            None => pipeline::answer(&source, ask).await?,
        };
        answered.calls.iter().for_each(|call| self.metrics.vlm.purpose(call.purpose));
        let version = u32::try_from(scene.parse_version).unwrap_or(0);
        let mut answer = self.told(&answered, asker.answer_id, scene.id, version, &source.parse);
        answer.in_frame = frame.map(|frame| frame.holding(&answer.targets));
        let model = self.vlm.as_ref().map_or("", |vlm| vlm.name());
        // Nobody waits for an item of a batch, and it may have been paid for: it is kept as soon as
        // that can be done.
        let patience = if asker.is_batch { STORE_IS_BACK } else { Duration::ZERO };
        match self.keep_within(patience, &answer, model, &parse_id, answered.calls).await {
            Ok(true) => {}
            Ok(false) => {
                self.blobs.discard(self.blobs.answer(&answer.id)).await?;
                return Err(Error::SceneNotFound { id: answer.scene_id });
            }
            // Who asked wants to know; that it can not be kept is the operator's concern.
            Err(error) => {
                tracing::error!(
                    error = &error as &dyn std::error::Error,
                    "answer could not be stored; returning it unstored"
                );
                (answer.stored, answer.evidence) = (false, Some(Vec::new()));
            }
        }
        Ok(filtered(answer, request.include.as_deref()))
    }

    /// The built-in answer, for a question whose time was over before the model's came.
    async fn without_model(
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
        let ask = self.ask(&request, &Caller::operator(), None, &[])?;
        let mut answered = pipeline::answer(source, ask).await?;
        answered.degraded = true;
        answered.corrections.push(format!("the model did not answer within {seconds} s"));
        Ok(answered)
    }

    /// The same where the store may be away for so long.
    async fn keep_within(
        &self,
        patience: Duration,
        answer: &Answer,
        model: &str,
        parse_id: &str,
        calls: Vec<CallRecord>,
    ) -> Result<bool, Error> {
        let start = Instant::now();
        loop {
            match self.keep(answer, model, parse_id, calls.clone()).await {
                Err(error) if error.is_transient() && start.elapsed() < patience => {
                    tracing::warn!(
                        error = &error as &dyn std::error::Error,
                        "answer could not be stored yet; retrying"
                    );
                    sleep(LOOK_AGAIN).await;
                }
                kept => return kept,
            }
        }
    }

    /// Keeps an answer with what led to it; `false` when its scene is gone.
    async fn keep(
        &self,
        answer: &Answer,
        model: &str,
        parse_id: &str,
        calls: Vec<CallRecord>,
    ) -> Result<bool, Error> {
        self.transcripts.keep_transcript(answer, model, calls).await?;
        let new = NewAnswer {
            id: answer.id.clone(),
            scene_id: answer.scene_id.clone(),
            parse_id: parse_id.to_owned(),
            body: serde_json::to_string(answer)?,
        };
        Ok(self.answer_repository.insert_answer(new).await?)
    }

    /// The candidates for a query, without reasoning over relations.
    ///
    /// # Errors
    /// As [`ground`](Self::ground).
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

    /// The model that reviews a question; `None` where the built-in reasoner decides, by choice or
    /// because nothing may be spent.
    fn reviewer(
        &self,
        request: &GroundRequest,
        caller: &Caller,
    ) -> Result<Option<Arc<Vlm>>, Error> {
        let unpaid = self.is_unpaid(request, caller);
        let asks =
            request.reasoner != ReasonerChoice::Builtin || request.parser == ParserChoice::Vlm;
        if let Some(vlm) =
            self.vlm.as_ref().filter(|_| asks && !unpaid && request.max_cost_usd.is_some())
            && !vlm.prices().are_known()
        {
            return Err(Error::invalid(
                "/max_cost_usd",
                "this server knows no prices of its model: only 0 can be held to",
            ));
        }
        match (request.reasoner, &self.vlm) {
            (ReasonerChoice::Builtin, _) | (ReasonerChoice::Auto, None) => Ok(None),
            (ReasonerChoice::Auto, Some(_)) if unpaid => Ok(None),
            (ReasonerChoice::Vlm, None) => Err(Error::VlmNotConfigured),
            (ReasonerChoice::Vlm, Some(_)) if unpaid => Err(Error::OverBudget(OverBudget {
                of: OF_QUESTION,
                limit_usd: 0.0,
                left_usd: 0.0,
                wanted_usd: 0.0,
            })),
            (_, Some(vlm)) => Ok(Some(vlm.clone())),
        }
    }

    /// Whether nothing may be spent on a question: it says so, or its key has a budget that nothing
    /// can be held against.
    fn is_unpaid(&self, request: &GroundRequest, caller: &Caller) -> bool {
        let has_budget = caller.key.as_ref().is_some_and(|key| key.row.daily_usd.is_some());
        request.max_cost_usd == Some(0.0)
            || (has_budget && self.vlm.as_ref().is_some_and(|vlm| !vlm.prices().are_known()))
    }

    /// A request as the pipeline takes it.
    fn ask(
        &self,
        request: &GroundRequest,
        caller: &Caller,
        reviewer: Option<Arc<Vlm>>,
        budgets: &[Budget],
    ) -> Result<Ask, Error> {
        // The grammar reads where nothing may be spent.
        let model = self.vlm.as_ref().filter(|_| !self.is_unpaid(request, caller));
        let model =
            model.map(|vlm| VlmParser { model: vlm.model_for(caller), budgets: budgets.to_vec() });
        let parser: Arc<dyn QueryParser> = match (request.parser.beside(request.reasoner), model) {
            (ParserChoice::Vlm, _) if self.vlm.is_none() => return Err(Error::VlmNotConfigured),
            (ParserChoice::Vlm, Some(model)) => Arc::new(model),
            (ParserChoice::Auto, Some(model)) => Arc::new(AutoParser(model)),
            (ParserChoice::Builtin, _) | (_, None) => Arc::new(BuiltinParser),
        };
        let without_model = if request.reasoner == ReasonerChoice::Vlm {
            WithoutModel::Fail
        } else {
            WithoutModel::BuiltIn
        };
        let review = reviewer.map(|vlm| Review {
            model: vlm.model_for(caller),
            budgets: budgets.to_vec(),
            options: Options {
                ablation: request.ablation,
                evidence: request.evidence,
                prompt: request.prompt,
                json: vlm.json(),
            },
            without_model,
        });
        let question = Question {
            query: request.query.clone(),
            top_k: request.evidence.candidates(request.top_k) as usize,
            convention: request.direction_convention,
            observer: request.observer,
            target_name: None,
            candidates: request.candidates,
            query_text: request.query_text,
            min_confidence: request.min_confidence.unwrap_or(DEFAULT_MIN_CONFIDENCE),
        };
        Ok(Ask {
            question,
            parser,
            without_parser: WithoutModel::BuiltIn,
            allow_builtin_encoder: request.allow_builtin,
            review,
        })
    }

    /// What came of a question, as callers are told.
    fn told(
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
            calls,
        } = answered.clone();
        let Grounding {
            query,
            status,
            no_match_reason,
            seen,
            answer,
            aabb,
            oriented_box,
            confidence,
            mut candidates,
            mut alternatives,
            targets,
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
        let mut evidence = vec![transcripts::picture_path(&id, pictures::GLOBAL)];
        if self.limits.retention.evidence_days > 0 {
            let shown =
                transcripts::pictures(&calls).into_iter().filter(|name| *name != pictures::GLOBAL);
            evidence.extend(shown.map(|name| transcripts::picture_path(&id, name)));
        }
        Answer {
            evidence: Some(evidence),
            id,
            scene_id,
            parse_version,
            query,
            status,
            no_match_reason,
            seen,
            answer,
            aabb,
            oriented_box,
            confidence,
            candidates: Some(candidates),
            alternatives,
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
            trace: Some(Trace { calls: calls.iter().map(call).collect(), corrections }),
            usage: usage_of(&calls),
            timings_ms,
        }
    }
}

impl AnswerService {
    /// An answer as it was given, whole: its JSON, byte for byte.
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

/// A status as it is written everywhere.
fn word(status: Status) -> &'static str {
    match status {
        Status::Grounded => "grounded",
        Status::Uncertain => "uncertain",
        Status::Ambiguous => "ambiguous",
        Status::NoMatch => "no_match",
    }
}

/// One call, as told in the trace.
fn call(record: &CallRecord) -> Call {
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

/// An answer with the parts that are wanted; all of them where nothing is said.
fn filtered(mut answer: Answer, include: Option<&[Include]>) -> Answer {
    if let Some(include) = include {
        let wanted = |part| include.contains(&part);
        answer.candidates = answer.candidates.filter(|_| wanted(Include::Candidates));
        answer.evidence = answer.evidence.filter(|_| wanted(Include::Evidence));
        answer.trace = answer.trace.filter(|_| wanted(Include::Trace));
    }
    answer
}
