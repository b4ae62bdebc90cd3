//! Signed links that work without a key for a limited time: for `<img>`, `EventSource` and
//! downloads, which cannot send a key.

use serde::{Deserialize, Serialize};

/// Paths to access without a key.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(deny_unknown_fields)]
pub struct LinkRequest {
    /// 1 to 500 paths of this server below `/v1/`. A path that ends in `/*`, like
    /// `/v1/scenes/{scene_id}/*`, covers everything below it.
    #[cfg_attr(feature = "openapi", schema(min_items = 1, max_items = 500, example = json!(["/v1/scenes/01a1ff70-0000-7000-8000-000000000001/*"])))]
    pub paths: Vec<String>,
    /// Validity of the links, seconds, 10 to 86400. Default: 600.
    #[serde(default = "default_seconds_valid")]
    #[cfg_attr(feature = "openapi", schema(minimum = 10, maximum = 86_400, default = 600))]
    pub expires_in_s: u32,
}

fn default_seconds_valid() -> u32 {
    600
}

/// A signed link.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct Link {
    /// The requested path.
    pub path: String,
    /// Signature, sent as the query parameter `link` with any covered path.
    pub token: String,
    /// The path with its token. `null` if the path covers several paths.
    pub url: Option<String>,
    /// Expiry time, RFC 3339 UTC.
    pub expires_at: String,
}

/// Links in the order of their paths.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct LinkList {
    /// One link for each requested path.
    pub links: Vec<Link>,
}
