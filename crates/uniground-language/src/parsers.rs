//! Parsers of queries: the built-in grammar, a chat model, or the model where the grammar is in
//! doubt.

use super::{Form, ParsedQuery, Quantity, vlm};
use futures::FutureExt;
use futures::future::BoxFuture;
use std::sync::Arc;
use uniground_models::chat::{Budget, CallRecord, ChatModel, Session};

/// A parsed query, with a record of how it was parsed.
#[derive(Debug, Clone, PartialEq)]
pub struct Reading {
    /// The parsed query, by the model or, where it was not used or not usable, by the grammar.
    pub parsed: ParsedQuery,
    /// Name and version of the parser, recorded with answers.
    pub by: String,
    /// The model calls that it took.
    pub calls: Vec<CallRecord>,
    /// Why the grammar parsed in place of a requested model, if so.
    pub fell_back: Option<FellBack>,
}

/// The reason why a requested model could not be used for parsing.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct FellBack {
    /// The problem, in words.
    pub why: String,
    /// Whether the model had to parse in any case. If so, the answer is degraded.
    pub was_demanded: bool,
}

impl Reading {
    fn by_grammar(parsed: ParsedQuery) -> Self {
        Self { parsed, by: GRAMMAR.into(), calls: Vec::new(), fell_back: None }
    }
}

/// Name and version of the built-in grammar.
const GRAMMAR: &str = "builtin-3";

/// Parses queries. Never fails: the grammar parses what a model cannot.
pub trait QueryParser: Send + Sync {
    /// Parses one query, given in plain words. `grammar` is the grammar's result: computing it
    /// blocks, so the caller does that on a thread that may block.
    fn read<'a>(&'a self, query: &'a str, grammar: ParsedQuery) -> BoxFuture<'a, Reading>;
}

/// The grammar and lexicon.
#[derive(Debug, Clone, Copy, Default)]
pub struct BuiltinParser;

impl QueryParser for BuiltinParser {
    fn read<'a>(&'a self, _: &'a str, grammar: ParsedQuery) -> BoxFuture<'a, Reading> {
        std::future::ready(Reading::by_grammar(grammar)).boxed()
    }
}

/// Makes one call to a chat model and validates the reply. Falls back to the grammar.
#[derive(Clone)]
pub struct VlmParser {
    /// The model that parses.
    pub model: Arc<dyn ChatModel>,
    /// Budgets of the call.
    pub budgets: Vec<Budget>,
}

impl VlmParser {
    /// Asks the model, and falls back to the grammar's reading. Where the grammar reads a number of
    /// objects or a unit, these stay.
    async fn ask(&self, query: &str, grammar: ParsedQuery) -> Reading {
        let mut session = Session::new(self.model.as_ref(), self.budgets.clone(), 1);
        let read = match session.ask("parse", vlm::request(query)).await {
            Ok(text) => vlm::decode(&text),
            Err(error) => Err(error.to_string()),
        };
        let calls = session.into_records();
        match read {
            Ok(parsed) => {
                let by = format!("{} (prompt {})", self.model.name(), vlm::PROMPT_VERSION);
                // A model that names no form leaves it to the grammar.
                let form =
                    if parsed.form == Form::Object { grammar.form } else { parsed.form.clone() };
                let quantity = match grammar.quantity {
                    Quantity::One => parsed.quantity,
                    several => several,
                };
                let except = if parsed.except.is_empty() { grammar.except } else { parsed.except };
                let unit = grammar.unit.or(parsed.unit);
                let mut target = parsed.target;
                // Ids of instances come from the context of the question: they are exact.
                if target.among.is_empty() {
                    target.among = grammar.target.among;
                }
                Reading {
                    parsed: ParsedQuery { target, quantity, form, except, unit, ..parsed },
                    by,
                    calls,
                    fell_back: None,
                }
            }
            Err(why) => Reading {
                calls,
                fell_back: Some(FellBack { why, was_demanded: true }),
                ..Reading::by_grammar(grammar)
            },
        }
    }
}

impl QueryParser for VlmParser {
    fn read<'a>(&'a self, query: &'a str, grammar: ParsedQuery) -> BoxFuture<'a, Reading> {
        self.ask(query, grammar).boxed()
    }
}

/// Uses the grammar, and a chat model where the grammar is in [doubt](ParsedQuery::doubt). Falls
/// back to the grammar's reading if the model cannot be used.
#[derive(Clone)]
pub struct AutoParser(pub VlmParser);

impl QueryParser for AutoParser {
    fn read<'a>(&'a self, query: &'a str, grammar: ParsedQuery) -> BoxFuture<'a, Reading> {
        async move {
            let Some(doubt) = grammar.doubt() else { return Reading::by_grammar(grammar) };
            let mut reading = self.0.ask(query, grammar).await;
            if let Some(FellBack { why, was_demanded }) = &mut reading.fell_back {
                (*why, *was_demanded) =
                    (format!("{doubt}; a model was to read it, but {why}"), false);
            }
            reading
        }
        .boxed()
    }
}
