//! Allowed host names of a server without a key. Protects against DNS rebinding: a web page could
//! point its own host name to this machine, but its requests carry that name and are rejected.

use super::App;
use super::problem::ProblemResponse;
use axum::extract::{Request, State};
use axum::http::uri::Authority;
use axum::http::{StatusCode, header};
use axum::middleware::Next;
use axum::response::{IntoResponse, Response};
use std::net::IpAddr;

/// Allowed host names besides loopback names.
pub struct AllowedHosts(Vec<String>);

impl AllowedHosts {
    #[must_use]
    pub fn new(names: &[String]) -> Self {
        Self(names.iter().map(|name| name.to_ascii_lowercase()).collect())
    }

    fn allows(&self, host: &str) -> bool {
        let host = host.trim_start_matches('[').trim_end_matches(']').to_ascii_lowercase();
        let is_loopback =
            host == "localhost" || host.parse::<IpAddr>().is_ok_and(|ip| ip.is_loopback());
        is_loopback || self.0.contains(&host)
    }
}

/// Rejects requests with a host name that is not allowed.
pub async fn check(State(app): State<App>, request: Request, next: Next) -> Response {
    // If a key is required, DNS rebinding is harmless.
    let allowed = app.allowed_hosts.as_ref().filter(|_| !app.services.keyring.has_keys());
    let Some(allowed) = allowed else { return next.run(request).await };
    let host = request.headers().get(header::HOST).and_then(|host| host.to_str().ok());
    let host = host.and_then(|host| host.parse::<Authority>().ok());
    // Browsers always send a host name.
    match host {
        Some(host) if !allowed.allows(host.host()) => {
            let detail = format!(
                "the host name {} is not allowed: start the server with --allowed-host, or use an \
                 API key",
                host.host()
            );
            ProblemResponse::new(StatusCode::MISDIRECTED_REQUEST, "host_not_allowed", detail)
                .into_response()
        }
        _ => next.run(request).await,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn loopback_names_are_allowed_and_unknown_hosts_rejected() {
        let hosts = AllowedHosts::new(&["Robot.local".into()]);
        assert!(
            ["localhost", "127.0.0.1", "127.0.0.2", "[::1]", "robot.LOCAL"]
                .iter()
                .all(|host| hosts.allows(host))
        );
        assert!(
            ["evil.example", "192.168.1.2", "localhost.evil.example", ""]
                .iter()
                .all(|host| !hosts.allows(host))
        );
    }
}
