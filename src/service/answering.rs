//! Questions to answers, kept.

use super::Service;
use super::cache::LoadedParse;
use super::parsing::ParseModels;
use crate::error::Error;
use crate::geometry::boxes::{Aabb, OrientedBox};
use crate::grounding::direction::{DirectionConvention, Observer};
use crate::grounding::query::{BuiltinParser, QueryParser, Reading, VlmParser};
use crate::grounding::{self, Alternative, Candidate, Grounding, ParsedQuerySummary, Question, SceneView, SixFields, Status, Timings};
use crate::models::chat::ChatReply;
use serde::{Deserialize, Serialize};
use std::sync::Arc;
use std::time::{Duration, Instant};
use tokio::sync::OwnedSemaphorePermit;
use tokio::task::spawn_blocking;
use tokio::time::timeout;
use utoipa::ToSchema;
use uuid::Uuid;

/// Who decides.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
#[serde(rename_all = "snake_case")]
pub enum ReasonerChoice {
    /// A vision-language model when one is configured, else the built-in reasoner.
    #[default]
    Auto,
    Vlm,
    Builtin,
}

/// Who reads the question.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
#[serde(rename_all = "snake_case")]
pub enum ParserChoice {
    /// Grammar and lexicon: no call, no cost.
    #[default]
    Builtin,
    /// One call to the configured model; the grammar where its answer can not be used, told in the trace.
    Vlm,
}

/// Parts of the paper's prompt left out; only a vision-language model has a prompt.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
#[serde(rename_all = "snake_case")]
pub enum Ablation {
    #[default]
    Full,
    NoGlobal,
    NoCandidate,
    SimplePrompt,
}

/// Parts of an answer that can be left out of the reply.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
#[serde(rename_all = "snake_case")]
pub enum Include {
    Candidates,
    Evidence,
    Trace,
}

/// A question about a scene.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
#[serde(deny_unknown_fields)]
pub struct GroundRequest {
    /// What to find, in plain English.
    #[schema(min_length = 1, max_length = 2000, example = "the black chair closest to the door")]
    pub query: String,
    /// Candidates to keep.
    #[serde(default = "default_top_k")]
    #[schema(minimum = 1, maximum = 100, default = 5)]
    pub top_k: u32,
    #[serde(default)]
    pub parser: ParserChoice,
    #[serde(default)]
    pub reasoner: ReasonerChoice,
    #[serde(default)]
    pub ablation: Ablation,
    #[serde(default)]
    pub direction_convention: DirectionConvention,
    /// Left, right, front and back as seen by this observer.
    pub observer: Option<Observer>,
    /// Optional parts to send back; all when left out.
    pub include: Option<Vec<Include>>,
    /// Most this question may cost; the built-in reasoner costs nothing.
    #[schema(minimum = 0)]
    pub max_cost_usd: Option<f64>,
    /// Give up after this many seconds.
    #[schema(exclusive_minimum = 0, maximum = 3600)]
    pub timeout_s: Option<f32>,
}

/// A query for candidates only.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
#[serde(deny_unknown_fields)]
pub struct ShortlistRequest {
    #[schema(min_length = 1, max_length = 2000, example = "the black chair")]
    pub query: String,
    #[serde(default = "default_top_k")]
    #[schema(minimum = 1, maximum = 100, default = 5)]
    pub top_k: u32,
}

fn default_top_k() -> u32 {
    5
}

/// Name and version of the parts an answer came from.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
pub struct Models {
    pub masks: String,
    pub encoder: String,
    /// Empty in answers given before this was recorded.
    #[serde(default)]
    pub parser: String,
    pub reasoner: String,
}

/// The frame all coordinates are in.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
pub struct CoordinateFrame {
    #[schema(example = "z")]
    pub up: String,
    #[schema(example = "m")]
    pub units: String,
}

/// One call of a vision-language model.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct Call {
    pub purpose: String,
    pub attempts: u32,
    pub latency_ms: f64,
    pub prompt_tokens: u64,
    pub completion_tokens: u64,
}

/// What happened on the way; empty when everything was done by built-in parts.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct Trace {
    pub calls: Vec<Call>,
    pub corrections: Vec<String>,
}

#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct Usage {
    pub vlm_calls: u32,
    pub prompt_tokens: u64,
    pub completion_tokens: u64,
    pub cost_usd: f64,
}

impl Usage {
    /// What reading a question took.
    #[must_use]
    pub fn of(reading: &Reading) -> Self {
        let calls = &reading.calls;
        Self {
            vlm_calls: calls.len() as u32,
            prompt_tokens: calls.iter().map(|c| c.prompt_tokens).sum(),
            completion_tokens: calls.iter().map(|c| c.completion_tokens).sum(),
            cost_usd: reading.cost_usd,
        }
    }
}

/// The answer to a question. `box` is set only when the status is `grounded`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct Answer {
    pub id: String,
    pub scene_id: String,
    pub parse_version: u32,
    pub query: String,
    pub status: Status,
    /// The six fields.
    pub answer: SixFields,
    #[serde(rename = "box")]
    pub aabb: Option<Aabb>,
    pub oriented_box: Option<OrientedBox>,
    /// Belief in the answer, `0..=1`.
    pub confidence: f32,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub candidates: Option<Vec<Candidate>>,
    pub alternatives: Vec<Alternative>,
    pub parsed_query: ParsedQuerySummary,
    pub models: Models,
    pub direction_convention: String,
    pub frame: CoordinateFrame,
    /// Paths of the pictures that go with the answer.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub evidence: Option<Vec<String>>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub trace: Option<Trace>,
    pub usage: Usage,
    pub timings_ms: Timings,
}

/// Candidates by names and attributes alone.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct Shortlisted {
    pub query: String,
    /// Best first; instances that do not fit at all are left out.
    pub candidates: Vec<Candidate>,
    pub encoder: String,
}

/// Name and version, recorded with answers.
pub const BUILTIN_REASONER: &str = "builtin-2";
const MAX_QUERY_CHARS: usize = 2000;
const MAX_TOP_K: u32 = 100;
const MAX_TIMEOUT_S: f32 = 3600.0;
/// How long a question waits for its turn before the server calls itself overloaded.
const PATIENCE: Duration = Duration::from_secs(2);

impl GroundRequest {
    /// # Errors
    /// [`Error::Invalid`] naming the field.
    pub fn check(&self) -> Result<(), Error> {
        check_query(&self.query)?;
        check_top_k(self.top_k)?;
        if let Some(observer) = &self.observer
            && !observer.position.iter().chain([&observer.yaw_rad]).all(|v| v.is_finite())
        {
            return Err(Error::invalid("/observer", "position and yaw_rad must be finite"));
        }
        if self.max_cost_usd.is_some_and(|cost| !cost.is_finite() || cost < 0.0) {
            return Err(Error::invalid("/max_cost_usd", "must be 0 or more"));
        }
        if self.timeout_s.is_some_and(|t| !t.is_finite() || t <= 0.0 || t > MAX_TIMEOUT_S) {
            return Err(Error::invalid("/timeout_s", format!("must be above 0 and at most {MAX_TIMEOUT_S}")));
        }
        Ok(())
    }
}

fn check_query(query: &str) -> Result<(), Error> {
    let characters = query.chars().count();
    if query.trim().is_empty() {
        return Err(Error::invalid("/query", "must not be empty"));
    }
    if characters > MAX_QUERY_CHARS {
        return Err(Error::invalid("/query", format!("has {characters} characters, at most {MAX_QUERY_CHARS} are read")));
    }
    Ok(())
}

fn check_top_k(top_k: u32) -> Result<(), Error> {
    match top_k {
        1..=MAX_TOP_K => Ok(()),
        _ => Err(Error::invalid("/top_k", format!("must be 1 to {MAX_TOP_K}"))),
    }
}

impl Service {
    /// Grounds one question in a parsed scene and keeps the answer.
    ///
    /// # Errors
    /// [`Error`]: unknown or unparsed scene, a question that is none, no model where one was demanded, overload, time-out.
    pub async fn ground(&self, scene_id: &str, request: GroundRequest) -> Result<Answer, Error> {
        request.check()?;
        let (scene, parse_id) = self.ready_scene(scene_id).await?;
        if request.reasoner == ReasonerChoice::Vlm {
            return Err(Error::VlmUnavailable);
        }
        let parse = self.loaded_parse(&parse_id).await?;
        let question = Question {
            query: request.query.clone(),
            top_k: request.top_k as usize,
            convention: request.direction_convention,
            observer: request.observer,
            target_name: None,
        };
        let parser = self.parser(request.parser)?;
        let models =
            Models { masks: parse.masks.clone(), encoder: parse.encoder.clone(), parser: parser.name(), reasoner: BUILTIN_REASONER.into() };
        let unpaid = request.max_cost_usd == Some(0.0);
        let work = async {
            let start = Instant::now();
            let reading = match unpaid {
                true => BuiltinParser.read(&request.query).await,
                false => parser.read(&request.query).await,
            };
            let (parsed, took) = (reading.parsed.clone(), start.elapsed());
            let grounding = self.computed(parse, move |scene| grounding::ground_read(scene, &question, parsed, took)).await?;
            Ok::<_, Error>((grounding, reading))
        };
        let (grounding, reading) = match request.timeout_s {
            Some(seconds) => timeout(Duration::from_secs_f32(seconds), work)
                .await
                .map_err(|_| Error::QuestionTimedOut { seconds })??,
            None => work.await?,
        };
        let mut answer = dress(grounding, scene.id, u32::try_from(scene.parse_version).unwrap_or(0), models);
        account(&mut answer, reading);
        if !self
            .store
            .insert_answer(&answer.id, &answer.scene_id, &parse_id, &serde_json::to_string(&answer)?)
            .await?
        {
            return Err(Error::SceneNotFound { id: answer.scene_id });
        }
        if let Some(include) = request.include {
            let wanted = |part| include.contains(&part);
            answer.candidates = answer.candidates.filter(|_| wanted(Include::Candidates));
            answer.evidence = answer.evidence.filter(|_| wanted(Include::Evidence));
            answer.trace = answer.trace.filter(|_| wanted(Include::Trace));
        }
        Ok(answer)
    }

    fn parser(&self, choice: ParserChoice) -> Result<Arc<dyn QueryParser>, Error> {
        match (choice, &self.vlm) {
            (ParserChoice::Builtin, _) => Ok(Arc::new(BuiltinParser)),
            (ParserChoice::Vlm, Some(client)) => Ok(Arc::new(VlmParser { client: client.clone() })),
            (ParserChoice::Vlm, None) => Err(Error::VlmUnavailable),
        }
    }

    /// The candidates for a query, by names and attributes alone.
    ///
    /// # Errors
    /// As [`ground`](Self::ground).
    pub async fn shortlist(&self, scene_id: &str, request: ShortlistRequest) -> Result<Shortlisted, Error> {
        check_query(&request.query)?;
        check_top_k(request.top_k)?;
        let (_, parse_id) = self.ready_scene(scene_id).await?;
        let parse = self.loaded_parse(&parse_id).await?;
        let encoder = parse.encoder.clone();
        let (query, top_k) = (request.query.clone(), request.top_k as usize);
        let (_, candidates) = self.computed(parse, move |scene| grounding::shortlist(scene, &query, top_k)).await?;
        Ok(Shortlisted { query: request.query, candidates, encoder })
    }

    /// An answer as it was given, whole.
    ///
    /// # Errors
    /// [`Error::AnswerNotFound`].
    pub async fn answer(&self, id: &str) -> Result<Answer, Error> {
        let row = self.store.answer(id).await?.ok_or_else(|| Error::AnswerNotFound { id: id.into() })?;
        Ok(serde_json::from_str(&row.body)?)
    }

    /// Waits for one of the bounded places at work; not for long.
    pub(super) async fn turn(&self) -> Result<OwnedSemaphorePermit, Error> {
        let turn = timeout(PATIENCE, self.questions.clone().acquire_owned()).await;
        turn.ok().and_then(Result::ok).ok_or(Error::Overloaded)
    }

    /// Runs stage 2 work on a blocking thread.
    async fn computed<T: Send + 'static>(
        &self,
        parse: Arc<LoadedParse>,
        work: impl FnOnce(SceneView) -> T + Send + 'static,
    ) -> Result<T, Error> {
        let permit = self.turn().await?;
        let result = spawn_blocking(move || {
            let _permit = permit;
            work(SceneView { instances: &parse.instances, extent: parse.extent })
        });
        Ok(result.await?)
    }

    pub(super) async fn loaded_parse(&self, parse_id: &str) -> Result<Arc<LoadedParse>, Error> {
        if let Some(parse) = self.cache.get(parse_id) {
            return Ok(parse);
        }
        let gone = || Error::SceneNotFound { id: parse_id.into() };
        let row = self.store.parse(parse_id).await?.ok_or_else(gone)?;
        let ParseModels { masks, encoder } = serde_json::from_str(&row.models)?;
        let parse = Arc::new(LoadedParse {
            instances: self.store.instances(parse_id).await?,
            extent: serde_json::from_str(&row.extent)?,
            masks,
            encoder,
        });
        self.cache.put(parse_id, parse.clone());
        Ok(parse)
    }
}

/// Notes the calls that reading the question took.
fn account(answer: &mut Answer, reading: Reading) {
    answer.usage = Usage::of(&reading);
    let Reading { parsed: _, calls, cost_usd: _, fell_back } = reading;
    let calls: Vec<Call> = calls
        .into_iter()
        .map(|ChatReply { text: _, prompt_tokens, completion_tokens, attempts, latency_ms }| Call {
            purpose: "parse".into(),
            attempts,
            latency_ms,
            prompt_tokens,
            completion_tokens,
        })
        .collect();
    let corrections = fell_back.map(|why| format!("the built-in parser read the question: {why}"));
    answer.trace = Some(Trace { calls, corrections: corrections.into_iter().collect() });
}

fn dress(grounding: Grounding, scene_id: String, parse_version: u32, models: Models) -> Answer {
    let id = Uuid::now_v7().to_string();
    let Grounding {
        query,
        status,
        answer,
        aabb,
        oriented_box,
        confidence,
        candidates,
        alternatives,
        parsed_query,
        direction_convention,
        timings_ms,
    } = grounding;
    Answer {
        evidence: Some(vec![format!("/v1/answers/{id}/evidence/global.jpg")]),
        id,
        scene_id,
        parse_version,
        query,
        status,
        answer,
        aabb,
        oriented_box,
        confidence,
        candidates: Some(candidates),
        alternatives,
        parsed_query,
        models,
        direction_convention,
        frame: CoordinateFrame { up: "z".into(), units: "m".into() },
        trace: Some(Trace::default()),
        usage: Usage::default(),
        timings_ms,
    }
}
