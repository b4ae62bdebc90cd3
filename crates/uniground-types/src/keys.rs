//! Keys of callers, and what was done with them.

use serde::{Deserialize, Serialize};

/// What a key lets its holder do; each includes those before it.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(rename_all = "snake_case")]
pub enum Scope {
    /// Look at everything, and ask questions.
    Read,
    /// Upload, parse, rename and delete scenes; submit batches; stop jobs.
    Write,
    /// Make and revoke keys; read what was done with them.
    Admin,
}

impl Scope {
    /// From the least to the most.
    pub const ALL: [Self; 3] = [Self::Read, Self::Write, Self::Admin];

    /// As it is written everywhere.
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
            .ok_or_else(|| format!("{word:?} is no scope"))
    }
}

/// A key that is wanted.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(deny_unknown_fields)]
pub struct NewKey {
    /// Who holds it, for people: one line of 1 to 200 characters.
    #[cfg_attr(
        feature = "openapi",
        schema(min_length = 1, max_length = 200, example = "kitchen robot")
    )]
    pub name: String,
    /// What it lets its holder do.
    pub scope: Scope,
    /// From then on it is refused, RFC 3339; default: never.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[cfg_attr(feature = "openapi", schema(format = DateTime))]
    pub expires_at: Option<String>,
    /// Requests a minute; as many may come at once after a pause. Default: no limit.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[cfg_attr(feature = "openapi", schema(minimum = 1))]
    pub requests_per_minute: Option<u32>,
    /// Scenes it may have uploaded and not deleted. Default: no limit.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub max_scenes: Option<u32>,
    /// Most that its questions may cost in a day (UTC), US dollars. Default: what the server may
    /// spend.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[cfg_attr(feature = "openapi", schema(minimum = 0))]
    pub daily_usd: Option<f64>,
}

/// A key, but for its secret.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct Key {
    /// UUIDv7; in order of time.
    pub id: String,
    /// Who holds it.
    pub name: String,
    /// How the secret begins: enough to know it again.
    #[cfg_attr(feature = "openapi", schema(example = "ug_5f1c02ab"))]
    pub prefix: String,
    /// What it lets its holder do.
    pub scope: Scope,
    /// From then on it is refused, RFC 3339 UTC; `null`: never.
    pub expires_at: Option<String>,
    /// Requests a minute; `null`: no limit.
    pub requests_per_minute: Option<u32>,
    /// Scenes it may have uploaded and not deleted; `null`: no limit.
    pub max_scenes: Option<u32>,
    /// Most that its questions may cost in a day (UTC), US dollars; `null`: what the server may
    /// spend.
    pub daily_usd: Option<f64>,
    /// What its questions cost today (UTC), US dollars.
    pub spent_today_usd: f64,
    /// RFC 3339, UTC.
    pub created_at: String,
    /// When it was last shown, to the minute, RFC 3339 UTC.
    pub last_used_at: Option<String>,
    /// Since when it is refused, RFC 3339 UTC.
    pub revoked_at: Option<String>,
}

/// A key that was just made.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct CreatedKey {
    /// The key.
    #[serde(flatten)]
    pub key: Key,
    /// What callers show as a bearer token. It is told this once: only its hash is kept.
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
    /// Newest first; revoked ones too.
    pub keys: Vec<Key>,
    /// `cursor` of the next page; `null` on the last.
    pub next_cursor: Option<String>,
}

/// Something that was done: a request that changes what is stored.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct AuditEntry {
    /// UUIDv7; in order of time.
    pub id: String,
    /// RFC 3339, UTC.
    pub at: String,
    /// Whose key; `null`: the server's own key, or nobody's where none is wanted.
    pub key_id: Option<String>,
    /// HTTP method.
    pub method: String,
    /// What was asked for, without its query.
    pub path: String,
    /// HTTP status of the answer.
    pub status: u16,
    /// As the header `x-request-id` and the log have it.
    pub request_id: Option<String>,
}

/// A page of what was done, newest first.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct AuditList {
    /// Newest first.
    pub entries: Vec<AuditEntry>,
    /// `cursor` of the next page; `null` on the last.
    pub next_cursor: Option<String>,
}
