//! Whether the inference server is there, between the calls of its networks.

use reqwest::Client;
use std::time::Duration;
use uniground_client::choose_cryptography;
use uniground_models::with_causes;

/// A server that does not say so within this time is not there.
const PATIENCE: Duration = Duration::from_secs(1);

/// Looks at a server.
#[derive(Debug)]
pub struct Probe {
    url: String,
    client: Client,
}

impl Probe {
    /// Of a server by its address, like `http://host:8000`.
    ///
    /// # Errors
    /// When no client can be made.
    pub fn new(address: &str) -> Result<Self, reqwest::Error> {
        choose_cryptography();
        let client = Client::builder().timeout(PATIENCE).build()?;
        Ok(Self { url: format!("{}/v2/health/ready", address.trim_end_matches('/')), client })
    }

    /// Whether the server is there; why not. One that does not know the question is.
    ///
    /// # Errors
    /// Why not, without its address.
    pub async fn look(&self) -> Result<(), String> {
        let answer = self
            .client
            .get(&self.url)
            .send()
            .await
            .map_err(|error| with_causes(&error.without_url()))?;
        let status = answer.status();
        // The protocol has 400 for "not ready"; what is unknown there is 404 or 405.
        let unknown = matches!(status.as_u16(), 404 | 405 | 501);
        if status.is_success() || unknown { Ok(()) } else { Err(format!("it says {status}")) }
    }
}
