//! Answers one question, from words to an answer. The service, the evaluation and a robot's own
//! process all use this pipeline.
//!
//! ```text
//! read -> choose -> appearance -> decide -> evidence -> review -> answer
//!         \______ one compute step ____/    \_ with a model _/
//! ```
//! Evidence and review run only where a vision-language model is configured.
//!
//! The pipeline is a future that its caller drives; it needs no runtime of its own. A
//! [`SceneSource`] provides a scene's pictures, embeddings and names, and the threads for
//! computing.

use super::appearance::{Appearance, ShortlistScoring};
use super::direction::common_look;
use super::find_in_photographs::{Searched, find_in_photographs};
use super::found_anchors::ByGeometry;
use super::reasoner::builtin;
use super::recover_unlisted::{Found, find_better, look_up};
use super::scene_source::scene_view;
pub use super::scene_source::{QuestionError, SceneSource};
use super::vlm::{
    self, Conversation, Decision, EvidenceMode, MAX_CALLS, Options, Outcome, PictureSettings,
    PromptVersion, Undecided, naming,
};
use super::{
    Candidate, Grounding, Question, Seen, Status, answer_kinds, choose_reading, coverage, decided,
    ground_with_context, rank_candidates,
};
use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::{Duration, Instant};
use uniground_geometry::scene::{Embeddings, InstanceId};
use uniground_language::{BuiltinParser, FellBack, ParsedQuery, QueryParser, Reading, parse};
use uniground_models::attributes;
use uniground_models::chat::{AskError, Budget, CallRecord, ChatModel, Session};
use uniground_models::neural::DualEncoder;
use uniground_types::answer::LeftOut;

/// Name of the directions that photographs show, if all of them look one way.
const PHOTOGRAPHS: &str = "photographs";
/// Confidence of the geometry from which the photographs mode does not ask where the object is.
const SURE_WITHOUT_LOOKING: f32 = 0.8;

/// What happens when a chat model cannot be used.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum WithoutModel {
    /// Grammar and geometry replace the model; the answer is marked as degraded.
    BuiltIn,
    /// The question fails.
    Fail,
}

/// A question, and the components that answer it.
pub struct Ask {
    /// The words, and how to interpret them.
    pub question: Question,
    /// The parser of the question.
    pub parser: Arc<dyn QueryParser>,
    /// What happens when `parser` cannot use its model.
    pub without_parser: WithoutModel,
    /// Whether names and measures may answer where the encoder fails, or is not the one that
    /// embedded the scene. The answer then says so.
    pub allow_builtin_encoder: bool,
    /// A vision-language model that reviews the result of the geometry.
    pub review: Option<Review>,
}

impl Ask {
    /// Returns a question for grammar, geometry and the encoder's embeddings, without a chat model.
    #[must_use]
    pub fn of(question: Question) -> Self {
        let (parser, without_parser) = (Arc::new(BuiltinParser), WithoutModel::BuiltIn);
        Self { question, parser, without_parser, allow_builtin_encoder: false, review: None }
    }
}

/// A vision-language model and its prompt settings.
pub struct Review {
    /// The model that sees the candidates.
    pub model: Arc<dyn ChatModel>,
    /// Budgets of its calls: every call is charged to each of these.
    pub budgets: Vec<Budget>,
    /// How the prompt is built: ablation, pictures, format.
    pub options: Options,
    /// What happens when the model cannot be asked.
    pub without_model: WithoutModel,
}

/// The answer to a question, with its record.
#[derive(Debug, Clone, PartialEq)]
pub struct Answered {
    /// Six fields, boxes, status and candidates.
    pub grounding: Grounding,
    /// The parsed question.
    pub parsed: ParsedQuery,
    /// Name and version of the parser of the question.
    pub parser: String,
    /// Name and version of what compared pictures and words: an encoder, or the built-in
    /// attributes.
    pub encoder: String,
    /// Name and version of what decided: the built-in reasoner, or the model with its prompt.
    pub reasoner: String,
    /// Whether a built-in part replaced a model that was requested and could not be used, or that
    /// never chose a candidate. `corrections` gives the reason.
    pub degraded: bool,
    /// Problems on the way, in order.
    pub corrections: Vec<String>,
    /// Things that had no number in the photographs that a model searched; `None` if it searched
    /// none.
    pub left_out: Option<LeftOut>,
    /// Every call of a model, in order: at most [`MAX_CALLS`], one more where the model saw an
    /// object that was not listed, and one or two more where it looked at photographs first.
    pub calls: Vec<CallRecord>,
}

impl Answered {
    /// Keeps the geometry's answer, because the model could not be asked.
    fn keep_geometry(
        &mut self,
        why: AskError,
        without_model: WithoutModel,
    ) -> Result<(), QuestionError> {
        if without_model == WithoutModel::Fail {
            return Err(QuestionError::Review(why));
        }
        self.degraded = true;
        self.corrections.push(format!("the built-in reasoner was used: {why}"));
        Ok(())
    }

    /// Records how long the review took, and the question so far. `evidence` is the part of
    /// `review` that went into pictures.
    fn record_times(&mut self, review: Duration, evidence: Duration, total: Duration) {
        let ms = |took: Duration| took.as_secs_f64() * 1e3;
        let timings = &mut self.grounding.timings_ms;
        timings.evidence = ms(evidence);
        timings.reason += ms(review.saturating_sub(evidence));
        timings.total = ms(total);
    }
}

/// Answers a question.
///
/// # Errors
/// Those of the source; [`QuestionError`] where a required model cannot be used.
pub async fn answer<S: SceneSource>(source: &Arc<S>, ask: Ask) -> Result<Answered, S::Error> {
    let Ask { question, parser, without_parser, allow_builtin_encoder, review } = ask;
    let least = question.min_confidence;
    let start = Instant::now();
    let query = question.query.clone();
    let grammar = source.compute(move |_| Ok(parse(&query))).await?;
    let Reading { parsed, by, mut calls, fell_back } = parser.read(&question.query, grammar).await;
    let (mut corrections, mut degraded) = (Vec::new(), false);
    if let Some(FellBack { why, was_demanded }) = fell_back {
        // A model with an unusable reply was asked all the same.
        let was_asked = calls.iter().any(|call| call.outcome.is_ok());
        if without_parser == WithoutModel::Fail && !was_asked {
            return Err(QuestionError::Unread(why).into());
        }
        corrections.push(format!("the built-in parser was used: {why}"));
        degraded = was_demanded;
    }
    let took = start.elapsed();

    let with_review = review.is_some();
    let asked = question.clone();
    let (grounding, context, parsed, used, appearance) = source
        .compute(move |source| {
            let parsed = choose_reading(scene_view(source, None), parsed);
            let with_review = with_review && answer_kinds::may_be_reviewed(&parsed);
            let scoring =
                ShortlistScoring { query_text: question.query_text, ..ShortlistScoring::default() };
            let (appearance, used) =
                appearance(source, &question.query, &parsed, scoring, allow_builtin_encoder)?;
            let scene = scene_view(source, appearance.as_ref());
            if !with_review {
                let grounding = decided(scene, &question, parsed.clone(), took).1;
                return Ok((grounding, None, parsed, used, appearance));
            }
            let (grounding, context) = ground_with_context(scene, &question, parsed.clone(), took);
            Ok((grounding, Some(context), parsed, used, appearance))
        })
        .await?;
    let appearance = Arc::new(appearance);
    if let Some(why) = used.missing {
        corrections.push(format!("names and measures were used instead of the encoder: {why}"));
        degraded = true;
    }
    let mut answered = Answered {
        grounding,
        parsed,
        parser: by,
        encoder: used.name,
        reasoner: builtin::NAME.into(),
        degraded,
        corrections,
        left_out: None,
        calls: Vec::new(),
    };
    let may_decide = |(review, context): &(Review, vlm::PromptContext)| {
        !context.candidates.is_empty() || review.options.evidence == EvidenceMode::Photographs
    };
    let mut review_state = ReviewState::default();
    // A review may add instances that the model saw.
    let mut source = source.clone();
    if let Some((review, context)) = review.zip(context).filter(may_decide) {
        // On the heap: most questions have no review, and its future is by far the largest.
        let question = (&asked, &appearance, &mut review_state);
        let review =
            apply_review(&source, question, &mut answered, review, context, &mut calls, start);
        source = Box::pin(review).await?;
    }
    let ReviewState { by_model, decided_with } = review_state;
    let (parsed, mut grounding) =
        (decided_with.unwrap_or_else(|| answered.parsed.clone()), answered.grounding);
    answered.grounding = source
        .compute(move |source| {
            let scene = scene_view(source, appearance.as_ref().as_ref());
            answer_kinds::complete(scene, &asked, &parsed, by_model, &mut grounding);
            if let Some(seen) = source.coverage() {
                coverage::add_coverage(seen, asked.within.as_ref(), &mut grounding);
            }
            grounding.require_confidence(least);
            Ok(grounding)
        })
        .await?;
    answered.calls = calls;
    Ok(answered)
}

/// What a review has changed, for the kinds of answers.
#[derive(Default)]
struct ReviewState {
    /// Whether the model chose the object.
    by_model: bool,
    /// The question with the anchors that the model found.
    decided_with: Option<ParsedQuery>,
}

/// Shows the candidates to the model, and applies its decision to the answer. Returns the source
/// with the instances that were added.
async fn apply_review<S: SceneSource>(
    source: &Arc<S>,
    (asked, appearance, state): (&Question, &Arc<Option<Appearance>>, &mut ReviewState),
    answered: &mut Answered,
    Review { model, budgets, options, without_model }: Review,
    context: vlm::PromptContext,
    calls: &mut Vec<CallRecord>,
    start: Instant,
) -> Result<Arc<S>, S::Error> {
    let before = start.elapsed();
    let mut names = if options.uses_names() { source.names().await? } else { BTreeMap::new() };
    names.retain(|id, _| context.is_candidate(*id));
    let known = names.clone();
    let mut session =
        Session::new(model.as_ref(), budgets, MAX_CALLS.saturating_sub(calls.len() as u32));
    let context = if options.prompt == PromptVersion::Paper {
        context.like_the_paper()
    } else {
        let context = context.without_building_anchors(source.instances());
        source
            .compute(|source| {
                let poses = source.frames()?.into_iter().map(|frame| frame.camera_to_world);
                Ok(context.with_photographed_directions(common_look(poses)))
            })
            .await?
    };
    let by_geometry_alone = answered.grounding.clone();
    let of_geometry = &answered.grounding;
    let is_sure =
        of_geometry.status == Status::Grounded && of_geometry.confidence >= SURE_WITHOUT_LOOKING;
    let untouched = |context| Searched::without_looking(source.clone(), context);
    let searched = match options.evidence {
        EvidenceMode::TwoStep => {
            untouched(narrow_candidates(source, context, options.limits, &mut session).await?)
        }
        EvidenceMode::Photographs if !is_sure => {
            let by_geometry = ByGeometry {
                question: asked,
                parsed: &answered.parsed,
                appearance,
                grounding: &mut answered.grounding,
                decided_with: &mut state.decided_with,
            };
            match find_in_photographs(source, context, by_geometry, options, &mut session).await? {
                Ok(found) => found,
                Err(error) => {
                    calls.extend(session.into_records());
                    let total = start.elapsed();
                    answered.record_times(total.saturating_sub(before), Duration::ZERO, total);
                    answered.keep_geometry(error, without_model)?;
                    return Ok(source.clone());
                }
            }
        }
        _ => untouched(context),
    };
    let Searched { source, context, notes, drawing, agreed, left_out } = searched;
    answered.left_out = left_out;
    if context.is_as_photographed() {
        answered.grounding.direction_convention = PHOTOGRAPHS.into();
    }
    let source = &source;
    // The model has confirmed the geometry's choice, or neither has found anything to decide about.
    if agreed.is_some() || context.candidates.is_empty() {
        if let Some(id) = agreed {
            let decision = Decision::confirmed(id, &answered.grounding.answer.explanation);
            decision.apply(&mut answered.grounding, &context, source.instances());
            state.by_model = true;
            answered.reasoner = vlm::reasoner_name(model.name(), options.prompt);
        }
        calls.extend(session.into_records());
        let total = start.elapsed();
        answered.record_times(total.saturating_sub(before), drawing, total);
        return Ok(source.clone());
    }
    let begun = Instant::now();
    let (context, evidence, unnamed) = source
        .compute(move |source| {
            let photographs = vlm::select_photographs(source, &context, options)?;
            let evidence = vlm::VisualEvidence {
                photographs,
                ..vlm::collect(source, &context, &PictureSettings::of(options))?
            };
            let mut unnamed = context.unnamed(&known, options.evidence);
            unnamed.truncate(naming::PER_SHEET);
            let unnamed = naming::sheet_of(source, 1, &unnamed)?;
            Ok((context, evidence, unnamed))
        })
        .await?;
    let evidence_took = drawing + begun.elapsed();
    let conversation = Conversation {
        context: &context,
        evidence: &evidence,
        options,
        names: names.clone(),
        unnamed,
    };
    let decision = vlm::decide(&conversation, &mut session).await;
    let (Ok(Decision { new_names, .. }) | Err(Undecided { new_names, .. })) = &decision;
    if !new_names.is_empty() {
        source.keep_names(new_names).await?;
    }
    let mut shown = Shown { source: source.clone(), context, evidence, options, names, notes };
    let decision = match decision {
        Ok(decision) => Ok(shown.resolve_seen(decision, &mut session).await?),
        undecided => undecided,
    };
    calls.extend(session.into_records());
    let Shown { source: shown_source, context, notes, .. } = shown;
    let source = &shown_source;
    match decision {
        Ok(decision) => {
            answered.grounding.add_shown(&context, source.instances());
            decision.apply(&mut answered.grounding, &context, source.instances());
            state.by_model = matches!(decision.outcome, Outcome::Chosen(_));
            // The geometry had to choose, because the model did not.
            answered.degraded |=
                matches!(decision.outcome, Outcome::Projected(_) | Outcome::Unknown);
            if decision.outcome != Outcome::Unknown {
                answered.reasoner = vlm::reasoner_name(model.name(), options.prompt);
            }
            answered.corrections.extend(notes);
            answered.corrections.extend(decision.corrections);
        }
        Err(undecided) => {
            // Without what the model found before.
            answered.grounding = by_geometry_alone;
            state.decided_with = None;
            answered.keep_geometry(undecided.error, without_model)?;
        }
    }
    let total = start.elapsed();
    answered.record_times(total.saturating_sub(before), evidence_took, total);
    Ok(shown_source)
}

/// The scene, the context and the pictures that a model was shown.
struct Shown<S> {
    source: Arc<S>,
    context: vlm::PromptContext,
    evidence: vlm::VisualEvidence,
    options: Options,
    names: BTreeMap<u32, String>,
    /// What became of places that the model pointed at.
    notes: Vec<String>,
}

impl<S: SceneSource> Shown<S> {
    /// Looks up the place in a photograph where the model saw the object, if it gave one.
    async fn resolve_seen(
        &mut self,
        decision: Decision,
        session: &mut Session<'_>,
    ) -> Result<Decision, S::Error> {
        let Some(seen) = decision.seen.clone().and_then(|sighting| sighting.original) else {
            return Ok(decision);
        };
        match decision.outcome {
            Outcome::NotListed => self.resolve_unlisted(decision, seen, session).await,
            // The paper's prompt asks for no place.
            Outcome::Chosen(chosen) if self.options.prompt == PromptVersion::Revised => {
                self.replace_chosen(decision, chosen, seen).await
            }
            _ => Ok(decision),
        }
    }

    /// Takes what fits the object better than the chosen instance, if the model gave the object's
    /// area and anything does.
    async fn replace_chosen(
        &mut self,
        decision: Decision,
        chosen: InstanceId,
        seen: Seen,
    ) -> Result<Decision, S::Error> {
        let (context, evidence, settings) =
            (self.context.clone(), self.evidence.clone(), PictureSettings::of(self.options));
        let found = self
            .source
            .compute(move |source| {
                find_better(source, &context, (chosen, &seen), &evidence, &settings)
            })
            .await?;
        let id = match found {
            None => return Ok(decision),
            Some(Found::Known(id)) => id,
            Some(Found::New(found)) => {
                let (source, id) = self.source.keep_found(*found).await?;
                self.source = source;
                id
            }
        };
        self.notes.push(format!("instance {id} fits the object better than the chosen {chosen}"));
        self.context.replace_candidate(chosen, id, self.source.instances());
        Ok(decision.with_replaced(chosen, id))
    }

    /// Looks up an object that the model saw in a photograph and that was not listed: turns its
    /// place into an instance and asks the model again with it. If that fails, the earlier decision
    /// stands.
    async fn resolve_unlisted(
        &mut self,
        decision: Decision,
        seen: Seen,
        session: &mut Session<'_>,
    ) -> Result<Decision, S::Error> {
        let (context, evidence, settings) =
            (self.context.clone(), self.evidence.clone(), PictureSettings::of(self.options));
        let place =
            format!("the model saw \"{}\" in {}, which is not listed", seen.name, seen.picture);
        let found = self
            .source
            .compute(move |source| look_up(source, &context, &seen, &evidence, &settings))
            .await?;
        match found {
            None => Ok(decision),
            Some(Found::Known(id)) => {
                Ok(decision.found(id, format!("{place}: it is instance {id}")))
            }
            Some(Found::New(found)) => {
                let (source, id) = self.source.keep_found(*found).await?;
                self.source = source;
                let why = format!("{place}: instance {id} was made of it");
                self.ask_again(decision.with_note(why), id, session).await
            }
        }
    }

    /// Asks again with an instance that was found. The earlier decision stands where the model
    /// chooses nothing of the list.
    async fn ask_again(
        &mut self,
        before: Decision,
        id: InstanceId,
        session: &mut Session<'_>,
    ) -> Result<Decision, S::Error> {
        let instances = self.source.instances();
        let Some(found) = instances.get(id.0 as usize - 1) else { return Ok(before) };
        let context = self.context.clone().with_found(found, instances);
        let settings = PictureSettings::of(self.options);
        let (context, evidence) = self
            .source
            .compute(move |source| {
                vlm::collect(source, &context, &settings).map(|evidence| (context, evidence))
            })
            .await?;
        session.allow_one_more();
        let conversation = Conversation {
            context: &context,
            evidence: &evidence,
            options: self.options,
            names: self.names.clone(),
            unnamed: None,
        };
        let again = vlm::decide(&conversation, session).await;
        (self.context, self.evidence) = (context, evidence);
        Ok(match again {
            Ok(again) if matches!(again.outcome, Outcome::Chosen(_)) => {
                before.merged_with_later(again)
            }
            Ok(_) => before,
            Err(undecided) => before.with_note(format!("asking again failed: {undecided}")),
        })
    }
}

/// The first of two steps: returns the candidates that remain after the model has seen one
/// photograph of each. A failed call is not reported here, because the next call will fail as well.
/// Where the model finds no candidate, the best ones remain.
async fn narrow_candidates<S: SceneSource>(
    source: &Arc<S>,
    context: vlm::PromptContext,
    limits: vlm::PictureLimits,
    session: &mut Session<'_>,
) -> Result<vlm::PromptContext, S::Error> {
    let (context, sheets) = source
        .compute(move |source| {
            let ids: Vec<InstanceId> = context.candidates.iter().map(|c| c.id).collect();
            let sheets = vlm::contact_sheets(source, &ids)?;
            Ok((context, vlm::VisualEvidence { sheets, ..vlm::VisualEvidence::default() }))
        })
        .await?;
    let mut ids = vlm::narrow(&context, &sheets, limits, session).await.unwrap_or_default();
    if ids.is_empty() {
        ids = context.candidates.iter().map(|c| c.id.0).take(vlm::REMAINING).collect();
    }
    Ok(context.narrowed_to(&ids))
}

/// The encoder or attributes that compared pictures and words.
struct UsedEncoder {
    name: String,
    /// Why it is not the encoder that embedded the scene; `None` when it is, or when no encoder
    /// embedded it.
    missing: Option<String>,
}

/// Compares the question's words with the appearance of the instances; returns nothing where no
/// encoder has embedded them.
fn appearance<S: SceneSource>(
    source: &S,
    query: &str,
    parsed: &ParsedQuery,
    scoring: ShortlistScoring,
    allow_builtin_encoder: bool,
) -> Result<(Option<Appearance>, UsedEncoder), S::Error> {
    let seen = source.embeddings().and_then(|seen| {
        let looks = |(encoder, embeddings): (&DualEncoder, &Embeddings)| {
            Appearance::of(query, parsed, encoder, embeddings, scoring)
                .map(|appearance| appearance.of_builtin_masks(source.has_builtin_masks()))
        };
        seen.map(looks).transpose().map_err(|error| QuestionError::Encoder(error).into())
    });
    match seen {
        Err(error) if allow_builtin_encoder => Ok((
            None,
            UsedEncoder { name: attributes::NAME.into(), missing: Some(error.to_string()) },
        )),
        seen => Ok((seen?, UsedEncoder { name: source.encoder_name(), missing: None })),
    }
}

/// The candidates for a query, without reasoning over relations.
#[derive(Debug, Clone, PartialEq)]
pub struct Shortlist {
    /// Best first; instances that do not fit at all are left out.
    pub candidates: Vec<Candidate>,
    /// Name and version of what compared them.
    pub encoder: String,
    /// Whether the sentence is longer than the encoder reads, so that its end is ignored.
    pub cut: bool,
}

/// Returns the `top_k` best candidates for a query (paper: by the encoder), read by the built-in
/// grammar.
///
/// # Errors
/// Those of the source; [`QuestionError::Encoder`].
pub async fn shortlist<S: SceneSource>(
    source: &Arc<S>,
    query: String,
    scoring: ShortlistScoring,
    allow_builtin_encoder: bool,
    top_k: usize,
) -> Result<Shortlist, S::Error> {
    source
        .compute(move |source| {
            let parsed = choose_reading(scene_view(source, None), parse(&query));
            shortlist_of(source, &query, &parsed, scoring, allow_builtin_encoder, top_k)
        })
        .await
}

/// Returns the `top_k` best candidates for a query that is already parsed. Computes on the calling
/// thread.
///
/// # Errors
/// As [`shortlist`].
pub fn shortlist_of<S: SceneSource>(
    source: &S,
    query: &str,
    parsed: &ParsedQuery,
    scoring: ShortlistScoring,
    allow_builtin_encoder: bool,
    top_k: usize,
) -> Result<Shortlist, S::Error> {
    let (appearance, used) = appearance(source, query, parsed, scoring, allow_builtin_encoder)?;
    let scene = scene_view(source, appearance.as_ref());
    let cut = appearance.as_ref().is_some_and(|appearance| appearance.cut);
    Ok(Shortlist {
        candidates: rank_candidates(scene, parsed, scoring.from, top_k),
        encoder: used.name,
        cut,
    })
}

#[cfg(test)]
mod tests;
