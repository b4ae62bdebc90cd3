//! How to reach the hub.

use camino::Utf8PathBuf;
use reqwest::Url;
use std::fmt;

/// How to reach the hub.
#[derive(Clone)]
pub struct HubSettings {
    /// Its address: `HF_ENDPOINT`, or the public one.
    pub endpoint: Url,
    /// Sent to the endpoint only, never to where it redirects to.
    pub token: Option<String>,
    /// The folder in which the hub's own tools keep repositories.
    pub cache: Option<Utf8PathBuf>,
    /// Whether nothing may be requested (`HF_HUB_OFFLINE`).
    pub is_offline: bool,
}

impl fmt::Debug for HubSettings {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("HubSettings")
            .field("endpoint", &self.endpoint.as_str())
            .field("has_token", &self.token.is_some())
            .field("cache", &self.cache)
            .field("is_offline", &self.is_offline)
            .finish()
    }
}

impl HubSettings {
    /// Returns the address for display: without user name and password.
    #[must_use]
    pub fn display_endpoint(&self) -> String {
        let mut shown = self.endpoint.clone();
        // Addresses that cannot hold them have none.
        let _none = (shown.set_username(""), shown.set_password(None));
        shown.as_str().trim_end_matches('/').to_owned()
    }
}
