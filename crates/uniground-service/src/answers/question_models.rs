//! Which models a question may use, and what pays for them.

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

/// The models that one question may use. Decided once, before anything is computed or paid.
pub(super) struct QuestionModels {
    /// Reviews what the built-in reasoner found. `None`: the built-in reasoner decides.
    reviewer: Option<(Arc<Vlm>, Review)>,
    parser: Arc<dyn QueryParser>,
}

impl QuestionModels {
    /// No model: the grammar reads and the built-in reasoner decides.
    pub fn built_in() -> Self {
        Self { reviewer: None, parser: Arc::new(BuiltinParser) }
    }

    /// Decides from the request, the caller's key and the configured model. Every call is paid
    /// from all of `budgets`, and from the budgets of the day that the model knows itself.
    ///
    /// # Errors
    /// [`Error::VlmNotConfigured`] and [`Error::OverBudget`] where the request insists on a model;
    /// [`Error::Invalid`] for a cost limit where the model's prices are not known.
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
        // The grammar reads where nothing may be spent.
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
            };
            let without_model = match request.reasoner {
                ReasonerChoice::Vlm => WithoutModel::Fail,
                ReasonerChoice::Auto | ReasonerChoice::Builtin => WithoutModel::BuiltIn,
            };
            let review = Review { model: vlm.model_for(caller), budgets, options, without_model };
            (vlm, review)
        });
        Ok(Self { reviewer, parser })
    }

    /// Whether a vision-language model reviews the answer.
    pub fn has_reviewer(&self) -> bool {
        self.reviewer.is_some()
    }

    /// Takes a place in the queue for the model, to be held until the question is answered.
    ///
    /// # Errors
    /// [`Error::Overloaded`].
    pub fn acquire_queue_permit(&self) -> Result<Option<OwnedSemaphorePermit>, Error> {
        self.reviewer.as_ref().map(|(vlm, _)| vlm.acquire_permit()).transpose()
    }

    /// The question with its models, as the pipeline takes it.
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

/// Whether a question asks for a model, if one may be paid.
pub(super) fn wants_model(request: &GroundRequest) -> bool {
    request.reasoner != ReasonerChoice::Builtin || request.parser == ParserChoice::Vlm
}

/// Whether nothing may be spent on a question: it says so, or its key has a daily budget and the
/// model's prices are not known.
fn is_spending_forbidden(vlm: Option<&Arc<Vlm>>, request: &GroundRequest, caller: &Caller) -> bool {
    let has_budget = caller.key.as_ref().is_some_and(|key| key.row.daily_usd.is_some());
    request.max_cost_usd == Some(0.0)
        || (has_budget && vlm.is_some_and(|vlm| !vlm.prices().has_prices()))
}
