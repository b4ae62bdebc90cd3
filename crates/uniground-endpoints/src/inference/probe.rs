//! Health probe of the inference server, independent of the calls of its networks.

use reqwest::Client;
use std::time::Duration;
use uniground_client::{http_client, install_crypto_provider};
use uniground_models::with_causes;

/// Timeout of the probe.
const TIMEOUT: Duration = Duration::from_secs(1);

/// Probes an inference server.
#[derive(Debug)]
pub struct Probe {
    url: String,
    client: Client,
}

impl Probe {
    /// Creates a probe of a server at an address like `http://host:8000`.
    ///
    /// # Errors
    /// The HTTP client cannot be created.
    pub fn new(address: &str) -> Result<Self, reqwest::Error> {
        install_crypto_provider();
        let client = http_client(address).timeout(TIMEOUT).build()?;
        Ok(Self { url: format!("{}/v2/health/ready", address.trim_end_matches('/')), client })
    }

    /// Checks that the server is ready. A server without a readiness endpoint counts as ready.
    ///
    /// # Errors
    /// Why it is not ready, without its address.
    pub async fn check_ready(&self) -> Result<(), String> {
        let answer = self
            .client
            .get(&self.url)
            .send()
            .await
            .map_err(|error| with_causes(&error.without_url()))?;
        let status = answer.status();
        // The protocol uses 400 for "not ready"; an unknown endpoint is 404, 405 or 501.
        let unknown = matches!(status.as_u16(), 404 | 405 | 501);
        if status.is_success() || unknown { Ok(()) } else { Err(format!("it answered {status}")) }
    }
}
