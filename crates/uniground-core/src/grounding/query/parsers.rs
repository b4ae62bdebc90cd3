//! Who reads queries: the built-in grammar, or a vision-language model.

use super::{ParsedQuery, parse, vlm};
use crate::models::chat::{Budget, CallRecord, ChatModel, Session};
use futures::FutureExt;
use futures::future::BoxFuture;
use std::sync::Arc;

/// A query, read.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Reading {
    /// What the query says, by the model or, where it could not be used, by the grammar.
    pub parsed: ParsedQuery,
    /// The calls it took.
    pub calls: Vec<CallRecord>,
    /// Why the built-in grammar had to step in, if so.
    pub fell_back: Option<String>,
}

/// Reads queries. Never fails: what a model can not read the grammar does.
pub trait QueryParser: Send + Sync {
    /// Name and version, recorded with answers.
    fn name(&self) -> String;

    /// Reads one query, given in plain words.
    fn read<'a>(&'a self, query: &'a str) -> BoxFuture<'a, Reading>;
}

/// The grammar and lexicon.
#[derive(Debug, Clone, Copy, Default)]
pub struct BuiltinParser;

impl QueryParser for BuiltinParser {
    fn name(&self) -> String {
        "builtin-3".into()
    }

    fn read<'a>(&'a self, query: &'a str) -> BoxFuture<'a, Reading> {
        std::future::ready(Reading { parsed: parse(query), ..Reading::default() }).boxed()
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

impl QueryParser for VlmParser {
    fn name(&self) -> String {
        format!("{} (prompt {})", self.model.name(), vlm::PROMPT_VERSION)
    }

    fn read<'a>(&'a self, query: &'a str) -> BoxFuture<'a, Reading> {
        async move {
            let mut session = Session::new(self.model.as_ref(), self.budgets.clone(), 1);
            let read = match session.ask("parse", vlm::request(query)).await {
                Ok(text) => vlm::decode(&text),
                Err(error) => Err(error.to_string()),
            };
            let calls = session.into_records();
            match read {
                Ok(parsed) => Reading { parsed, calls, fell_back: None },
                Err(why) => Reading { parsed: parse(query), calls, fell_back: Some(why) },
            }
        }
        .boxed()
    }
}
