//! Which server a command speaks to, and with which key.

use clap::Args;
use uniground_client::{Client, ClientError};

const DEFAULT: &str = "http://127.0.0.1:8080";
const VARIABLE: &str = "UNIGROUND_SERVER";

#[allow(clippy::doc_markdown)] // Help is no Markdown.
#[derive(Debug, Args)]
pub struct ServerArgs {
    /// Address of the server [default: http://127.0.0.1:8080]
    #[arg(long, env = VARIABLE, value_name = "URL")]
    server: Option<String>,
}

impl ServerArgs {
    pub fn address(&self) -> &str {
        self.server.as_deref().unwrap_or(DEFAULT)
    }

    /// What the flag says where it was given, and not the environment.
    pub fn explicit_address(&self) -> Option<&str> {
        self.server.as_deref().filter(|server| std::env::var(VARIABLE).as_deref() != Ok(server))
    }

    /// What the next command has to repeat to speak to the same server.
    pub fn to_flag(&self) -> String {
        self.explicit_address().map_or_else(String::new, |server| format!(" --server {server}"))
    }

    /// # Errors
    /// [`ClientError::BadAddress`].
    pub fn client(&self) -> Result<Client, ClientError> {
        client(self.address())
    }
}

/// Whoever sets `UNIGROUND_API_KEY` asks with that key.
///
/// # Errors
/// [`ClientError::BadAddress`].
pub fn client(address: &str) -> Result<Client, ClientError> {
    let key = std::env::var("UNIGROUND_API_KEY").ok().map(|key| key.trim().to_owned());
    Client::new(address, key.filter(|key| !key.is_empty()))
}
