//! Options for the address and the key of the server.

use clap::Args;
use uniground_client::{Client, ClientError};

const DEFAULT: &str = "http://127.0.0.1:8080";
const VARIABLE: &str = "UNIGROUND_SERVER";

#[allow(clippy::doc_markdown)] // Help is plain text.
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

    /// Returns the value of the flag, and `None` if it comes from the environment.
    pub fn explicit_address(&self) -> Option<&str> {
        self.server.as_deref().filter(|server| std::env::var(VARIABLE).as_deref() != Ok(server))
    }

    /// Returns the flag to repeat in the next command for the same server.
    pub fn to_flag(&self) -> String {
        self.explicit_address().map_or_else(String::new, |server| format!(" --server {server}"))
    }

    /// # Errors
    /// [`ClientError::BadAddress`].
    pub fn client(&self) -> Result<Client, ClientError> {
        client(self.address())
    }
}

/// Creates a client that uses the key in `UNIGROUND_API_KEY`, if set.
///
/// # Errors
/// [`ClientError::BadAddress`].
pub fn client(address: &str) -> Result<Client, ClientError> {
    let key = std::env::var("UNIGROUND_API_KEY").ok().map(|key| key.trim().to_owned());
    Client::new(address, key.filter(|key| !key.is_empty()))
}
