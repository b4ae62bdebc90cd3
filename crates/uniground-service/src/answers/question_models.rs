//! Chooses the models of a question and the budgets that pay for them.

use crate::error::Error;
use crate::vlm::OF_QUESTION;
use crate::{Caller, Vlm};
use std::sync::Arc;
use tokio::sync::OwnedSemaphorePermit;
use uniground_grounding::Question;
use uniground_grounding::pipeline::{Ask, Review, WithoutModel};
use uniground_grounding::vlm::Options;
use uniground_language::{AutoParser, BuiltinParser, QueryParser, VlmParser};
use uniground_models::chat::{Budget, OverBudget};
use uniground_types::question::{
    DEFAULT_MIN_CONFIDENCE, GroundRequest, ParserChoice, ReasonerChoice,
};

/// The models that a question uses. Chosen once, before anything is computed or paid.
pub(super) struct QuestionModels {
    /// Reviews the result of the built-in reasoner. `None`: the built-in reasoner decides.
    reviewer: Option<(Arc<Vlm>, Review)>,
    parser: Arc<dyn QueryParser>,
}

impl QuestionModels {
    /// Returns models for a question without model calls: the grammar parses it and the built-in
    /// reasoner decides.
    pub fn built_in() -> Self {
        Self { reviewer: None, parser: Arc::new(BuiltinParser) }
    }

    /// Chooses the models by the request, the caller's key and the configured model. Every call is
    /// charged to all of `budgets`, and to the daily budgets, which the model checks itself.
    ///
    /// # Errors
    /// [`Error::VlmNotConfigured`] and [`Error::OverBudget`] if the request requires a model;
    /// [`Error::Invalid`] for a cost limit if the model's prices are unknown.
    pub fn decide(
        vlm: Option<&Arc<Vlm>>,
        request: &GroundRequest,
        caller: &Caller,
        budgets: Vec<Budget>,
    ) -> Result<Self, Error> {
        let is_spending_forbidden = is_spending_forbidden(vlm, request, caller);
        if let Some(vlm) = vlm.filter(|_| {
            wants_model(request) && !is_spending_forbidden && request.max_cost_usd.is_some()
        }) && !vlm.prices().has_prices()
        {
            return Err(Error::invalid(
                "/max_cost_usd",
                "this server knows no prices of its model: only 0 can be held to",
            ));
        }
        let reviewer = match (request.reasoner, vlm) {
            (ReasonerChoice::Builtin, _) | (ReasonerChoice::Auto, None) => None,
            (ReasonerChoice::Auto, Some(_)) if is_spending_forbidden => None,
            (ReasonerChoice::Vlm, None) => return Err(Error::VlmNotConfigured),
            (ReasonerChoice::Vlm, Some(_)) if is_spending_forbidden => {
                return Err(Error::OverBudget(OverBudget {
                    of: OF_QUESTION,
                    limit_usd: 0.0,
                    left_usd: 0.0,
                    wanted_usd: 0.0,
                }));
            }
            (_, Some(vlm)) => Some(vlm.clone()),
        };
        // Without a budget, the grammar parses the question.
        let reader = vlm
            .filter(|_| !is_spending_forbidden)
            .map(|vlm| VlmParser { model: vlm.model_for(caller), budgets: budgets.clone() });
        let parser: Arc<dyn QueryParser> =
            match (request.parser.resolve_for(request.reasoner), reader) {
                (ParserChoice::Vlm, _) if vlm.is_none() => return Err(Error::VlmNotConfigured),
                (ParserChoice::Vlm, Some(reader)) => Arc::new(reader),
                (ParserChoice::Auto, Some(reader)) => Arc::new(AutoParser(reader)),
                (ParserChoice::Builtin, _) | (_, None) => Arc::new(BuiltinParser),
            };
        let reviewer = reviewer.map(|vlm| {
            let options = Options {
                ablation: request.ablation,
                evidence: request.evidence,
                prompt: request.prompt,
                json: vlm.json(),
                points: vlm.points(),
                limits: vlm.picture_limits(),
            };
            let without_model = match request.reasoner {
                ReasonerChoice::Vlm => WithoutModel::Fail,
                ReasonerChoice::Auto | ReasonerChoice::Builtin => WithoutModel::BuiltIn,
            };
            // Nothing but the model will do, and the question's own limit ends the wait.
            let is_patient = request.reasoner == ReasonerChoice::Vlm && request.timeout_s.is_some();
            let model = match is_patient {
                true => vlm.patient_model_for(caller),
                false => vlm.model_for(caller),
            };
            let review = Review { model, budgets, options, without_model };
            (vlm, review)
        });
        Ok(Self { reviewer, parser })
    }

    /// Returns whether a vision-language model reviews the answer.
    pub fn has_reviewer(&self) -> bool {
        self.reviewer.is_some()
    }

    /// Acquires a permit of the model's queue, to be held until the question is answered.
    ///
    /// # Errors
    /// [`Error::Overloaded`].
    pub fn acquire_queue_permit(&self) -> Result<Option<OwnedSemaphorePermit>, Error> {
        self.reviewer.as_ref().map(|(vlm, _)| vlm.acquire_permit()).transpose()
    }

    /// Converts the question with its models to the input of the pipeline.
    pub fn into_ask(self, request: &GroundRequest) -> Ask {
        let question = Question {
            query: request.query.clone(),
            top_k: request.evidence.candidate_limit(request.top_k) as usize,
            convention: request.direction_convention,
            observer: request.observer,
            target_name: None,
            candidates: request.candidates,
            query_text: request.query_text,
            min_confidence: request.min_confidence.unwrap_or(DEFAULT_MIN_CONFIDENCE),
            within: request.within.clone(),
            most_confidence: 1.0,
        };
        Ask {
            question,
            parser: self.parser,
            without_parser: WithoutModel::BuiltIn,
            allow_builtin_encoder: request.allow_builtin,
            review: self.reviewer.map(|(_, review)| review),
        }
    }
}

/// Returns whether a question asks for a model, regardless of budgets.
pub(super) fn wants_model(request: &GroundRequest) -> bool {
    request.reasoner != ReasonerChoice::Builtin || request.parser == ParserChoice::Vlm
}

/// Returns whether a question must not cost anything: its limit is 0, or its key has a daily budget
/// and the model's prices are unknown.
fn is_spending_forbidden(vlm: Option<&Arc<Vlm>>, request: &GroundRequest, caller: &Caller) -> bool {
    let has_budget = caller.key.as_ref().is_some_and(|key| key.row.daily_usd.is_some());
    request.max_cost_usd == Some(0.0)
        || (has_budget && vlm.is_some_and(|vlm| !vlm.prices().has_prices()))
}
