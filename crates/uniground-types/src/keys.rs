//! API keys and the audit log.

use serde::{Deserialize, Serialize};

/// Scope of a key. Each scope includes the previous ones.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(rename_all = "snake_case")]
pub enum Scope {
    /// View everything and ask questions.
    Read,
    /// Upload, parse, rename and delete scenes, submit batches, cancel jobs.
    Write,
    /// Create and revoke keys, read the audit log.
    Admin,
}

impl Scope {
    /// All scopes, from least to most.
    pub const ALL: [Self; 3] = [Self::Read, Self::Write, Self::Admin];

    /// Returns the name of the scope in JSON and the database.
    #[must_use]
    pub fn as_str(self) -> &'static str {
        match self {
            Self::Read => "read",
            Self::Write => "write",
            Self::Admin => "admin",
        }
    }
}

impl TryFrom<String> for Scope {
    type Error = String;

    fn try_from(word: String) -> Result<Self, String> {
        Self::ALL
            .into_iter()
            .find(|scope| scope.as_str() == word)
            .ok_or_else(|| format!("{word:?} is not a scope"))
    }
}

/// A new API key.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(deny_unknown_fields)]
pub struct NewKey {
    /// Name of the holder for display, one line of 1 to 200 characters.
    #[cfg_attr(
        feature = "openapi",
        schema(min_length = 1, max_length = 200, example = "kitchen robot")
    )]
    pub name: String,
    /// Scope of the key.
    pub scope: Scope,
    /// Expiry time, RFC 3339. Default: never.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[cfg_attr(feature = "openapi", schema(format = DateTime))]
    pub expires_at: Option<String>,
    /// Maximum number of requests per minute, with bursts up to the same number. Default: no limit.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[cfg_attr(feature = "openapi", schema(minimum = 1))]
    pub requests_per_minute: Option<u32>,
    /// Maximum number of scenes the key may own. Default: no limit.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub max_scenes: Option<u32>,
    /// Spending limit for questions per day (UTC), US dollars. Default: the server's limit.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[cfg_attr(feature = "openapi", schema(minimum = 0))]
    pub daily_usd: Option<f64>,
}

/// An API key without its secret.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct Key {
    /// UUIDv7, so ids sort by time.
    pub id: String,
    /// Name of the holder.
    pub name: String,
    /// Beginning of the secret, for recognition.
    #[cfg_attr(feature = "openapi", schema(example = "ug_5f1c02ab"))]
    pub prefix: String,
    /// Scope of the key.
    pub scope: Scope,
    /// Expiry time, RFC 3339 UTC. `null`: never.
    pub expires_at: Option<String>,
    /// Maximum number of requests per minute. `null`: no limit.
    pub requests_per_minute: Option<u32>,
    /// Maximum number of scenes the key may own. `null`: no limit.
    pub max_scenes: Option<u32>,
    /// Spending limit for questions per day (UTC), US dollars. `null`: the server's limit.
    pub daily_usd: Option<f64>,
    /// Cost of the key's questions today (UTC), US dollars.
    pub spent_today_usd: f64,
    /// Creation time, RFC 3339 UTC.
    pub created_at: String,
    /// Time of the last use, to the minute, RFC 3339 UTC. `null`: never used.
    pub last_used_at: Option<String>,
    /// Time of revocation, RFC 3339 UTC. `null` if not revoked.
    pub revoked_at: Option<String>,
}

/// A newly created key with its secret.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct CreatedKey {
    /// The key.
    #[serde(flatten)]
    pub key: Key,
    /// The secret that callers send as a bearer token. It is returned only once; the server stores
    /// only its hash.
    #[cfg_attr(
        feature = "openapi",
        schema(example = "ug_5f1c02ab_HbMQtr0mJm1gwYNeLRuXl5AqLvMvmbfXZ3XWfBnXo6g")
    )]
    pub secret: String,
}

/// All keys, newest first.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct KeyList {
    /// Keys, newest first, including revoked ones.
    pub keys: Vec<Key>,
    /// Cursor of the next page. `null` on the last page.
    pub next_cursor: Option<String>,
}

/// An entry of the audit log: a request that changed stored data.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct AuditEntry {
    /// UUIDv7, so ids sort by time.
    pub id: String,
    /// Time, RFC 3339 UTC.
    pub at: String,
    /// Id of the key. `null` for the server's own key, and without authentication.
    pub key_id: Option<String>,
    /// HTTP method.
    pub method: String,
    /// Path of the request, without the query.
    pub path: String,
    /// HTTP status of the response.
    pub status: u16,
    /// Request id, as in the header `x-request-id` and in the log.
    pub request_id: Option<String>,
}

/// A page of the audit log, newest first.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct AuditList {
    /// Entries, newest first.
    pub entries: Vec<AuditEntry>,
    /// Cursor of the next page. `null` on the last page.
    pub next_cursor: Option<String>,
}
