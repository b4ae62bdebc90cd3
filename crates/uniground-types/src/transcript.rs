//! What a vision-language model was shown and said for an answer.

use serde::{Deserialize, Serialize};

/// Every prompt of an answer, in order.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct AnswerPrompt {
    /// The model that was asked, by the name its endpoint knows it by.
    pub model: String,
    /// In the order they were made.
    pub calls: Vec<PromptCall>,
}

/// What was said to the model in one call.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct PromptCall {
    /// `parse`, `naming`, `spatial`, or what was wrong: `out_of_set`, `unreadable`,
    /// `inconsistent`.
    pub purpose: String,
    /// The system message: what the model is there for.
    pub system: String,
    /// In the order the model got them.
    pub user: Vec<PromptPart>,
    /// The JSON schema asked for, if one was.
    #[cfg_attr(feature = "openapi", schema(value_type = Option<Object>))]
    pub schema: Option<serde_json::Value>,
}

/// A piece of what the model was shown.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(tag = "type", rename_all = "snake_case")]
pub enum PromptPart {
    /// Plain text.
    Text {
        /// As it was sent.
        text: String,
    },
    /// A picture by its path below this server.
    Picture {
        /// JPEG, as it was shown; relative to the server.
        href: String,
    },
}

/// Every reply of an answer, in order.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct AnswerReply {
    /// The model that was asked, by the name its endpoint knows it by.
    pub model: String,
    /// In the order they were made, one for every prompt.
    pub calls: Vec<ReplyCall>,
}

/// What the model said in one call.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct ReplyCall {
    /// Why it was asked, as in the prompt of the same place.
    pub purpose: String,
    /// The model's words as they came; `null` when there were none.
    pub text: Option<String>,
    /// Why there was no reply; `null` when there was one.
    pub error: Option<String>,
}
