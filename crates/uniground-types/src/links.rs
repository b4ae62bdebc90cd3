//! Links that work without a key for a while: for `<img>`, `EventSource` and downloads, which can
//! show none.

use serde::{Deserialize, Serialize};

/// What is to be read without a key.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(deny_unknown_fields)]
pub struct LinkRequest {
    /// Paths of this server below `/v1/`, 1 to 500. One that ends in `/*` stands for everything
    /// below it, like `/v1/scenes/{scene_id}/*`.
    #[cfg_attr(feature = "openapi", schema(min_items = 1, max_items = 500, example = json!(["/v1/scenes/01a1ff70-0000-7000-8000-000000000001/*"])))]
    pub paths: Vec<String>,
    /// How long they work, seconds.
    #[serde(default = "default_seconds_valid")]
    #[cfg_attr(feature = "openapi", schema(minimum = 10, maximum = 86_400, default = 600))]
    pub expires_in_s: u32,
}

fn default_seconds_valid() -> u32 {
    600
}

/// A link, and until when it works.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct Link {
    /// As it was asked for.
    pub path: String,
    /// What makes it work: the query parameter `link` of any path it stands for.
    pub token: String,
    /// The path with its token; `null` where the path stands for several.
    pub url: Option<String>,
    /// RFC 3339 UTC.
    pub expires_at: String,
}

/// Links in the order of their paths.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct LinkList {
    /// One for each path.
    pub links: Vec<Link>,
}
