//! Questions to answers, kept.

use super::cache::LoadedParse;
use super::looking::{Asked, Seen, appearance, read_embeddings};
use super::parse_settings::ParseModels;
use super::questions::{GroundRequest, Include, ParserChoice, ReasonerChoice, ShortlistRequest, check_query, check_top_k};
use super::reviewing::{Case, Review};
use super::vlm::Vlm;
use super::{Service, transcripts};
use crate::error::Error;
use crate::geometry::boxes::{Aabb, OrientedBox};
use crate::grounding::query::{BuiltinParser, ParsedQuery, QueryParser, Reading, VlmParser};
use crate::grounding::vlm::{Options, Outcome, reasoner_name};
use crate::grounding::{
    self, Alternative, Candidate, Grounding, ParsedQuerySummary, Question, SceneView, ShortlistScoring, SixFields, Status, Timings,
};
use crate::models::attributes;
use crate::models::chat::{CallRecord, Purse};
use serde::{Deserialize, Serialize};
use std::sync::Arc;
use std::time::{Duration, Instant};
use tokio::sync::OwnedSemaphorePermit;
use tokio::task::spawn_blocking;
use tokio::time::timeout;
use utoipa::ToSchema;
use uuid::Uuid;

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
    /// `parse`, `naming`, `spatial`, or what was wrong before: `out_of_set`, `unreadable`, `inconsistent`.
    pub purpose: String,
    pub attempts: u32,
    pub latency_ms: f64,
    pub prompt_tokens: u64,
    pub completion_tokens: u64,
    /// Why there was no reply.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub error: Option<String>,
}

impl Call {
    fn of(record: &CallRecord) -> Self {
        let (reply, error) = (record.outcome.as_ref().ok(), record.outcome.as_ref().err().cloned());
        Self {
            purpose: record.purpose.to_owned(),
            attempts: record.attempts,
            latency_ms: record.latency_ms,
            prompt_tokens: reply.map_or(0, |reply| reply.prompt_tokens),
            completion_tokens: reply.map_or(0, |reply| reply.completion_tokens),
            error,
        }
    }
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
    /// What calls took. Those that got no answer cost nothing that is known.
    #[must_use]
    pub fn of(calls: &[CallRecord]) -> Self {
        let replies = || calls.iter().filter_map(|call| call.outcome.as_ref().ok());
        Self {
            vlm_calls: replies().count() as u32,
            prompt_tokens: replies().map(|reply| reply.prompt_tokens).sum(),
            completion_tokens: replies().map(|reply| reply.completion_tokens).sum(),
            cost_usd: calls.iter().map(|call| call.cost_usd).sum(),
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
    /// A built-in part took the place of a model that could not be used, or that never chose a candidate; `trace.corrections` says why.
    #[serde(default)]
    pub degraded: bool,
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
    /// The sentence is longer than the encoder reads: its end does not count.
    pub cut: bool,
}

/// A question, decided.
struct Decided {
    grounding: Grounding,
    seen: Seen,
    reading: Reading,
    review: Option<Reviewed>,
}

/// What a model's review left.
struct Reviewed {
    corrections: Vec<String>,
    degraded: bool,
    reasoner: String,
    records: Vec<CallRecord>,
}

/// Name and version, recorded with answers.
pub const BUILTIN_REASONER: &str = "builtin-2";
/// How long a question waits for its turn before the server calls itself overloaded.
const PATIENCE: Duration = Duration::from_secs(2);

impl Service {
    /// Grounds one question in a parsed scene and keeps the answer.
    ///
    /// # Errors
    /// [`Error`]: unknown or unparsed scene, a question that is none, no model or no money where a model was demanded, overload, time-out.
    pub async fn ground(&self, scene_id: &str, request: GroundRequest) -> Result<Answer, Error> {
        request.check()?;
        let (scene, parse_id) = self.ready_scene(scene_id).await?;
        let (reviewer, parse) = (self.reviewer(&request)?, self.loaded_parse(&parse_id).await?);
        let purses = match &self.vlm {
            Some(vlm) => vlm.purses(&self.store, request.max_cost_usd).await?,
            None => Vec::new(),
        };
        let parser = self.parser(&request, &purses)?;
        let models =
            Models { masks: parse.masks.clone(), encoder: parse.encoder.clone(), parser: parser.name(), reasoner: BUILTIN_REASONER.into() };
        let work = self.decided(&request, &parse_id, parse.clone(), parser.as_ref(), reviewer.as_deref(), purses);
        let Decided { grounding, seen, reading, review } = match request.timeout_s {
            Some(seconds) => timeout(Duration::from_secs_f32(seconds), work)
                .await
                .map_err(|_| Error::QuestionTimedOut { seconds })??,
            None => work.await?,
        };
        let mut answer = dress(grounding, scene.id, u32::try_from(scene.parse_version).unwrap_or(0), models);
        let mut records = reading.calls;
        let trace = answer.trace.get_or_insert_default();
        if let Some(why) = reading.fell_back {
            trace.corrections.push(format!("the built-in parser read the question: {why}"));
            answer.models.parser = BuiltinParser.name();
            answer.degraded = true;
        }
        if let Some(Reviewed { corrections, degraded, reasoner, records: of_review }) = review {
            trace.corrections.extend(corrections);
            answer.degraded |= degraded;
            answer.models.reasoner = reasoner;
            records.extend(of_review);
        }
        trace.calls = records.iter().map(Call::of).collect();
        answer.usage = Usage::of(&records);
        seen.note(&mut answer);
        if self.limits.keep_evidence_days > 0 {
            let shown = transcripts::pictures(&records);
            let others = shown
                .into_iter()
                .filter(|name| *name != "global")
                .map(|name| transcripts::picture_path(&answer.id, name));
            answer.evidence.get_or_insert_default().extend(others);
        }
        let model = self.vlm.as_ref().map_or("", |vlm| vlm.client.model());
        self.keep_transcript(&answer, model, records).await?;
        if !self
            .store
            .insert_answer(&answer.id, &answer.scene_id, &parse_id, &serde_json::to_string(&answer)?)
            .await?
        {
            self.store.blobs.remove(&self.store.blobs.answer(&answer.id))?;
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

    /// Reads a question, decides it by geometry, and lets the model review that, where one does.
    async fn decided(
        &self,
        request: &GroundRequest,
        parse_id: &str,
        parse: Arc<LoadedParse>,
        parser: &dyn QueryParser,
        reviewer: Option<&Vlm>,
        purses: Vec<Purse>,
    ) -> Result<Decided, Error> {
        let start = Instant::now();
        let reading = parser.read(&request.query).await;
        if let Some(vlm) = self.vlm.as_ref().filter(|_| !reading.calls.is_empty()) {
            vlm.note_spending(&self.store).await?;
        }
        let (parsed, took) = (reading.parsed.clone(), start.elapsed());
        let question = Question {
            query: request.query.clone(),
            top_k: request.top_k as usize,
            convention: request.direction_convention,
            observer: request.observer,
            target_name: None,
        };
        let asked = Asked { query: request.query.clone(), scoring: ShortlistScoring::default(), allow_builtin: request.allow_builtin };
        let Some(vlm) = reviewer else {
            let decide = move |scene: SceneView, parsed| grounding::ground_read(scene, &question, parsed, took);
            let (grounding, seen) = self.computed(parse, asked, parsed, decide).await?;
            return Ok(Decided { grounding, seen, reading, review: None });
        };
        let decide = move |scene: SceneView, parsed| grounding::ground_and_brief(scene, &question, parsed, took);
        let ((mut grounding, brief), seen) = self.computed(parse.clone(), asked, parsed, decide).await?;
        if brief.candidates.is_empty() {
            return Ok(Decided { grounding, seen, reading, review: None });
        }
        let options = Options { ablation: request.ablation, evidence: request.evidence, json: vlm.json() };
        let before = start.elapsed().as_secs_f64() * 1e3;
        let calls_made = reading.calls.len() as u32;
        let case = Case { parse_id, parse: parse.clone(), brief: brief.clone(), options, calls_made };
        let Review { decision, records, evidence_ms } = self.review(vlm, case, purses).await?;
        let (corrections, degraded, reasoner) = match decision {
            Ok(decision) => {
                decision.apply(&mut grounding, &brief, &parse.instances);
                // Where the geometry had to choose, the model did not.
                let degraded = matches!(decision.outcome, Outcome::Projected(_) | Outcome::Unknown);
                let reasoner =
                    if decision.outcome == Outcome::Unknown { BUILTIN_REASONER.to_owned() } else { reasoner_name(vlm.client.model()) };
                (decision.corrections, degraded, reasoner)
            }
            Err(undecided) if request.reasoner == ReasonerChoice::Vlm => return Err(undecided.error.into()),
            Err(error) => (vec![format!("the built-in reasoner answered: {error}")], true, BUILTIN_REASONER.to_owned()),
        };
        let total = start.elapsed().as_secs_f64() * 1e3;
        let timings = &mut grounding.timings_ms;
        timings.evidence = evidence_ms;
        timings.reason += (total - before - evidence_ms).max(0.0);
        timings.total = total;
        let review = Some(Reviewed { corrections, degraded, reasoner, records });
        Ok(Decided { grounding, seen, reading, review })
    }

    /// Who reads a question; the grammar where nothing may be spent.
    fn parser(&self, request: &GroundRequest, purses: &[Purse]) -> Result<Box<dyn QueryParser>, Error> {
        match (request.parser, &self.vlm) {
            (ParserChoice::Builtin, _) => Ok(Box::new(BuiltinParser)),
            (ParserChoice::Vlm, Some(_)) if request.max_cost_usd == Some(0.0) => Ok(Box::new(BuiltinParser)),
            (ParserChoice::Vlm, Some(vlm)) => Ok(Box::new(VlmParser { client: vlm.client.clone(), purses: purses.to_vec() })),
            (ParserChoice::Vlm, None) => Err(Error::VlmNotConfigured),
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
        let ShortlistRequest { query, top_k, query_text, calibrated, allow_builtin } = request;
        let encoder = parse.encoder.clone();
        let asked = Asked { query: query.clone(), scoring: ShortlistScoring { query_text, calibrated }, allow_builtin };
        let rank = move |scene: SceneView, parsed: ParsedQuery| grounding::shortlist(scene, &parsed, top_k as usize);
        let (candidates, seen) = self.computed(parse, asked, grounding::query::parse(&query), rank).await?;
        let encoder = if seen.missing.is_some() { attributes::NAME.into() } else { encoder };
        Ok(Shortlisted { query, candidates, encoder, cut: seen.cut })
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

    /// Runs stage 2 work on a blocking thread, with the question's words embedded where an encoder has seen the scene.
    async fn computed<T: Send + 'static>(
        &self,
        parse: Arc<LoadedParse>,
        asked: Asked,
        parsed: ParsedQuery,
        work: impl FnOnce(SceneView, ParsedQuery) -> T + Send + 'static,
    ) -> Result<(T, Seen), Error> {
        let permit = self.turn().await?;
        let models = self.models.clone();
        let result = spawn_blocking(move || {
            let _permit = permit;
            let (appearance, missing) = match appearance(&models, &parse, &asked, &parsed) {
                Err(error) if asked.allow_builtin => (None, Some(error.to_string())),
                looked => (looked?, None),
            };
            let seen = Seen { missing, cut: appearance.as_ref().is_some_and(|a| a.cut) };
            let scene = SceneView { instances: &parse.instances, extent: parse.extent, appearance: appearance.as_ref() };
            Ok((work(scene, parsed), seen))
        });
        result.await?
    }

    pub(super) async fn loaded_parse(&self, parse_id: &str) -> Result<Arc<LoadedParse>, Error> {
        if let Some(parse) = self.caches.parses.get(parse_id) {
            return Ok(parse);
        }
        let gone = || Error::SceneNotFound { id: parse_id.into() };
        let row = self.store.parse(parse_id).await?.ok_or_else(gone)?;
        let ParseModels { masks, encoder } = serde_json::from_str(&row.models)?;
        let folder = self.store.blobs.parse(parse_id);
        let parse = Arc::new(LoadedParse {
            embeddings: read_embeddings(&folder).await?,
            instances: self.store.instances(parse_id).await?,
            extent: serde_json::from_str(&row.extent)?,
            masks,
            encoder,
        });
        self.caches.parses.put(parse_id.to_owned(), parse.clone(), 1);
        Ok(parse)
    }
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
        degraded: false,
        direction_convention,
        frame: CoordinateFrame { up: "z".into(), units: "m".into() },
        trace: Some(Trace::default()),
        usage: Usage::default(),
        timings_ms,
    }
}
