//! Writes the log to stderr and sends traces to a collector. Secrets of this process are redacted
//! from the log, at every level and from every source.

mod traces;

pub use traces::Traces;

use crate::config::{LogConfig, LogFormat};
use reqwest::Url;
use std::io::{self, Write};
use std::sync::{PoisonError, RwLock};
use tracing_subscriber::layer::SubscriberExt;
use tracing_subscriber::util::SubscriberInitExt;
use tracing_subscriber::{EnvFilter, Layer, fmt};

/// Logs warnings and errors only, for commands whose output is for people.
pub fn start_quiet() {
    start_at("warn");
}

/// The same for commands that report the result of their job themselves.
pub fn start_quiet_about_jobs() {
    start_at("warn,uniground::jobs::lane=error");
}

/// The same for commands with slow statements, because they read all data.
pub fn start_quiet_about_statements() {
    start_at("warn,sqlx::query=error");
}

fn start_at(levels: &str) {
    let filter = EnvFilter::try_from_default_env().unwrap_or_else(|_| EnvFilter::new(levels));
    let log = tracing_subscriber::fmt().with_env_filter(filter).with_writer(|| RedactingWriter);
    if let Err(error) = log.try_init() {
        tracing::debug!(%error, "logger is already initialized");
    }
}

/// Starts logging and, if configured, sending traces while the returned value lives. A second call
/// in the same process has no effect.
///
/// # Errors
/// Returns an error for an endpoint that is not a valid address.
pub fn start(config: &LogConfig) -> anyhow::Result<Option<Traces>> {
    let filter = EnvFilter::try_from_default_env()
        .unwrap_or_else(|_| EnvFilter::new("info,sqlx=warn,ort=warn,object_store=warn"));
    let log = fmt::layer().with_writer(|| RedactingWriter);
    let log = match config.log_format {
        LogFormat::Text => log
            .with_ansi(std::io::IsTerminal::is_terminal(&std::io::stderr()))
            .with_filter(filter)
            .boxed(),
        LogFormat::Json => log.json().with_filter(filter).boxed(),
    };
    let (layer, traces) =
        config.otlp_endpoint.as_deref().map(traces::collector_layer).transpose()?.unzip();
    if let Err(error) = tracing_subscriber::registry().with(log).with(layer).try_init() {
        tracing::debug!(%error, "logger is already initialized");
    }
    Ok(traces)
}

static SECRETS: RwLock<Vec<String>> = RwLock::new(Vec::new());
/// Minimum length of a redacted secret. Shorter ones would redact half of the log.
const SHORTEST_SECRET: usize = 6;

/// Redacts a secret from the log from now on.
pub fn register_secret(secret: &str) {
    let mut secrets = SECRETS.write().unwrap_or_else(PoisonError::into_inner);
    if secret.len() >= SHORTEST_SECRET && !secrets.iter().any(|known| known == secret) {
        secrets.push(secret.to_owned());
        // The longest first, because one secret may contain another.
        secrets.sort_by_key(|secret| std::cmp::Reverse(secret.len()));
    }
}

/// Redacts the secrets in an address: a password, and the values of its query.
pub fn register_secrets_of_address(address: &str) {
    if let Ok(url) = Url::parse(address) {
        url.password().iter().for_each(|password| register_secret(password));
        url.query_pairs().for_each(|(_, value)| register_secret(&value));
        url.query()
            .into_iter()
            .flat_map(|query| query.split('&'))
            .filter_map(|pair| pair.split_once('='))
            .for_each(|(_, value)| register_secret(value));
    }
}

/// Returns a text with secrets redacted.
#[must_use]
pub fn redact_secrets(text: &str) -> String {
    let secrets = SECRETS.read().unwrap_or_else(PoisonError::into_inner);
    secrets.iter().fold(text.to_owned(), |text, secret| match text.contains(secret.as_str()) {
        true => text.replace(secret.as_str(), "<secret>"),
        false => text,
    })
}

/// Stderr, line by line. The log formatter passes each line as a whole.
struct RedactingWriter;

impl Write for RedactingWriter {
    fn write(&mut self, line: &[u8]) -> io::Result<usize> {
        io::stderr().write_all(redact_secrets(&String::from_utf8_lossy(line)).as_bytes())?;
        Ok(line.len())
    }

    fn flush(&mut self) -> io::Result<()> {
        io::stderr().flush()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn secrets_are_redacted_everywhere() {
        register_secret("sk-telemetry-test");
        register_secrets_of_address(
            "https://user:pass%20telemetry@host.example/v1?api-version=2026&key=telemetry%2Fkey",
        );
        let line = "authorization: Bearer sk-telemetry-test, https://user:pass%20telemetry@host.example/v1?key=telemetry%2Fkey telemetry/key";
        let redacted = redact_secrets(line);
        assert!(
            !redacted.contains("sk-telemetry")
                && !redacted.contains("pass%20telemetry")
                && !redacted.contains("telemetry%2Fkey")
                && !redacted.contains("telemetry/key"),
            "{redacted}"
        );
        assert!(redacted.contains("host.example"));
    }
}
