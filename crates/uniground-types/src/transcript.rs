//! Prompts and replies of a vision-language model for an answer.

use serde::{Deserialize, Serialize};

/// All prompts of an answer, in order.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct AnswerPrompt {
    /// Name of the model at its endpoint.
    pub model: String,
    /// Calls in order.
    pub calls: Vec<PromptCall>,
}

/// The prompt of one call.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct PromptCall {
    /// Purpose of the call: `parse`, `naming`, `spatial`, or the defect of the previous reply:
    /// `out_of_set`, `unreadable`, `inconsistent`.
    pub purpose: String,
    /// The system message.
    pub system: String,
    /// Parts of the user message, in order.
    pub user: Vec<PromptPart>,
    /// The requested JSON schema. `null` if none was requested.
    #[cfg_attr(feature = "openapi", schema(value_type = Option<Object>))]
    pub schema: Option<serde_json::Value>,
}

/// A part of a prompt.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(tag = "type", rename_all = "snake_case")]
pub enum PromptPart {
    /// Text.
    Text {
        /// The text as sent.
        text: String,
    },
    /// A picture.
    Picture {
        /// URL of the JPEG as sent, relative to the server.
        href: String,
    },
}

/// All replies for an answer, in order.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct AnswerReply {
    /// Name of the model at its endpoint.
    pub model: String,
    /// Replies in order, one for each prompt.
    pub calls: Vec<ReplyCall>,
}

/// The reply of one call.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct ReplyCall {
    /// Purpose of the call, as in the prompt with the same index.
    pub purpose: String,
    /// Text of the reply, unchanged. `null` without a reply.
    pub text: Option<String>,
    /// Error if there was no reply, else `null`.
    pub error: Option<String>,
}
