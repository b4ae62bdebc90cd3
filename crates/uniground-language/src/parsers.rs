//! Who reads queries: the built-in grammar, a chat model, or the one where the other is in doubt.

use super::{ParsedQuery, vlm};
use futures::FutureExt;
use futures::future::BoxFuture;
use std::sync::Arc;
use uniground_models::chat::{Budget, CallRecord, ChatModel, Session};

/// A query, read.
#[derive(Debug, Clone, PartialEq)]
pub struct Reading {
    /// What the query says, by the model or, where it was not wanted or could not be used, by the
    /// grammar.
    pub parsed: ParsedQuery,
    /// Name and version of who read it, recorded with answers.
    pub by: String,
    /// The calls it took.
    pub calls: Vec<CallRecord>,
    /// Why the grammar has read where a model was wanted, if so.
    pub fell_back: Option<FellBack>,
}

/// A model was wanted as a reader and could not be used.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct FellBack {
    /// What was wrong, in words.
    pub why: String,
    /// The model was to read whatever comes: the answer is less than what was asked for.
    pub was_demanded: bool,
}

impl Reading {
    fn by_grammar(parsed: ParsedQuery) -> Self {
        Self { parsed, by: GRAMMAR.into(), calls: Vec::new(), fell_back: None }
    }
}

/// Name and version of the built-in grammar.
const GRAMMAR: &str = "builtin-3";

/// Reads queries. Never fails: what a model can not read the grammar does.
pub trait QueryParser: Send + Sync {
    /// Reads one query, given in plain words. `grammar` is what the grammar has read: it computes,
    /// so the caller runs it where a thread may be kept busy.
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

/// One call to a chat model, validated; the grammar where that fails.
#[derive(Clone)]
pub struct VlmParser {
    /// The model that is asked to read.
    pub model: Arc<dyn ChatModel>,
    /// What pays for the call.
    pub budgets: Vec<Budget>,
}

impl VlmParser {
    /// Asks the model; where it can not be used, the grammar's reading stands. How many are asked
    /// for the grammar knows best.
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
                Reading {
                    parsed: ParsedQuery { quantity: grammar.quantity, ..parsed },
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

/// The grammar, and a chat model where the grammar is in [doubt](ParsedQuery::doubt). Where the
/// model can not be used then, the grammar's reading is what there is.
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
