//! Sends webhooks to another server as Standard Webhooks (version 1) specifies. They are signed.
//! They are never sent to an address that only this machine or its own network can reach, unless
//! the operator allows it.

use base64::Engine;
use base64::engine::general_purpose::STANDARD;
use hmac::{Hmac, KeyInit, Mac};
use reqwest::dns::{Addrs, Name, Resolve, Resolving};
use reqwest::{Url, redirect};
use sha2::Sha256;
use std::net::{IpAddr, Ipv4Addr, SocketAddr};
use std::sync::Arc;
use std::time::Duration;
use uniground_client::install_crypto_provider;

/// The timeout of a delivery.
const TIMEOUT: Duration = Duration::from_secs(15);
const MIN_SECRET_BYTES: usize = 16;
/// The prefix of secrets in base64.
const PREFIX: &str = "whsec_";

/// The destination of webhooks and the secret that signs them.
pub struct Webhook {
    http: reqwest::Client,
    url: Url,
    secret: Vec<u8>,
}

/// Why a delivery failed.
#[derive(Debug, thiserror::Error)]
pub enum WebhookError {
    #[error("the webhook's server can not be reached")]
    Transport(#[from] reqwest::Error),
    #[error("the webhook's server answered {0}")]
    Refused(u16),
}

/// Why a webhook cannot be configured.
#[derive(Debug, thiserror::Error)]
pub enum BadWebhook {
    #[error("this is not an address with http or https")]
    Address,
    #[error(
        "{0} is an address of this machine or its own network: say --webhook-allow-private where that is meant"
    )]
    Private(String),
    #[error(
        "the webhook secret must be `whsec_` followed by at least {MIN_SECRET_BYTES} bytes in base64"
    )]
    Secret,
    #[error("a client for webhooks")]
    Client(#[from] reqwest::Error),
}

impl Webhook {
    /// Creates a webhook. `secret` has the form of Standard Webhooks: `whsec_` and base64.
    ///
    /// # Errors
    /// [`BadWebhook`].
    pub fn new(url: &str, secret: &str, allow_private: bool) -> Result<Self, BadWebhook> {
        let url = Url::parse(url)
            .ok()
            .filter(|url| matches!(url.scheme(), "http" | "https") && url.has_host());
        let url = url.ok_or(BadWebhook::Address)?;
        let secret = STANDARD
            .decode(secret.trim().trim_start_matches(PREFIX))
            .map_err(|_| BadWebhook::Secret)?;
        if secret.len() < MIN_SECRET_BYTES {
            return Err(BadWebhook::Secret);
        }
        install_crypto_provider();
        // Redirects are not followed: the receiver must not send a delivery elsewhere.
        let mut http =
            reqwest::Client::builder().redirect(redirect::Policy::none()).timeout(TIMEOUT);
        if !allow_private {
            // Host names are checked when they are resolved for a connection, because their address
            // may change. Numeric addresses are checked here.
            http = http.dns_resolver(Arc::new(PublicOnly)).no_proxy();
            let host = url.host_str().unwrap_or_default().trim_matches(['[', ']']);
            if host.parse::<IpAddr>().is_ok_and(|address| !is_public(address)) {
                return Err(BadWebhook::Private(host.to_owned()));
            }
        }
        Ok(Self { http: http.build()?, url, secret })
    }

    /// Delivers a message. `id` is the same for every retry. `at` is the current time in Unix
    /// seconds.
    ///
    /// # Errors
    /// [`WebhookError`] if the message was not accepted. A retry may succeed.
    pub async fn deliver(&self, id: &str, at: i64, body: String) -> Result<(), WebhookError> {
        let signature = self.signature(id, at, &body);
        let request = self
            .http
            .post(self.url.clone())
            .header("content-type", "application/json")
            .header("webhook-id", id)
            .header("webhook-timestamp", at.to_string())
            .header("webhook-signature", signature);
        let status = request.body(body).send().await.map_err(reqwest::Error::without_url)?.status();
        if status.is_success() { Ok(()) } else { Err(WebhookError::Refused(status.as_u16())) }
    }

    fn signature(&self, id: &str, at: i64, body: &str) -> String {
        // HMAC accepts keys of any length.
        let Ok(mut mac) = Hmac::<Sha256>::new_from_slice(&self.secret) else {
            return String::new();
        };
        mac.update(format!("{id}.{at}.{body}").as_bytes());
        format!("v1,{}", STANDARD.encode(mac.finalize().into_bytes()))
    }
}

/// Resolves host names to public addresses only.
struct PublicOnly;

impl Resolve for PublicOnly {
    fn resolve(&self, name: Name) -> Resolving {
        Box::pin(async move {
            let host = name.as_str().to_owned();
            let found = tokio::net::lookup_host((host.as_str(), 0)).await?;
            let public: Vec<SocketAddr> = found.filter(|address| is_public(address.ip())).collect();
            match public.is_empty() {
                true => {
                    Err(format!("{host} is an address of this machine or its own network").into())
                }
                false => Ok(Box::new(public.into_iter()) as Addrs),
            }
        })
    }
}

/// Returns whether an address is public on the internet.
fn is_public(address: IpAddr) -> bool {
    match address {
        IpAddr::V4(address) => is_public_v4(address),
        IpAddr::V6(address) => {
            // An IPv6 address may contain an IPv4 address: mapped, or behind a translator.
            let segments = address.segments();
            let inner = || Ipv4Addr::from((u32::from(segments[6]) << 16) | u32::from(segments[7]));
            match address.to_ipv4_mapped() {
                Some(mapped) => is_public_v4(mapped),
                None if segments[..6] == [0x64, 0xff9b, 0, 0, 0, 0] => is_public_v4(inner()),
                // Global unicast addresses begin with 001. Of these, 2001:db8::/32 is reserved for
                // documentation.
                None => {
                    segments[0] & 0xe000 == 0x2000
                        && !(segments[0] == 0x2001 && segments[1] == 0x0db8)
                }
            }
        }
    }
}

fn is_public_v4(address: Ipv4Addr) -> bool {
    let [a, b, c, _] = address.octets();
    let special = address.is_private()
        || address.is_loopback()
        || address.is_link_local()
        || address.is_documentation()
        || address.is_multicast()
        || a == 0
        || a >= 240
        || (a == 100 && (64..128).contains(&b))
        || (a == 192 && b == 0 && c == 0)
        || (a == 198 && (b == 18 || b == 19));
    !special
}

#[cfg(test)]
mod tests {
    use super::*;

    const SECRET: &str = "whsec_MfKQ9r8GKYqrTwjUPD8ILPZIo2LaLaSw";

    /// Uses the example from the Standard Webhooks libraries.
    #[test]
    fn signatures_follow_standard_webhooks() {
        let webhook = Webhook::new("https://example.com/hook", SECRET, false).unwrap();
        let signature = webhook.signature(
            "msg_p5jXN8AQM9LWM0D4loKWxJek",
            1_614_265_330,
            "{\"test\": 2432232314}",
        );
        assert_eq!(signature, "v1,g0hM9SsE+OTPJTGt/tmIKtSyZlE3uFJELVlNIOLJ1OE=");
    }

    #[test]
    fn webhooks_to_private_addresses_are_rejected() {
        for private in [
            "127.0.0.1",
            "10.1.2.3",
            "172.16.0.1",
            "192.168.1.1",
            "169.254.169.254",
            "100.64.0.1",
            "0.0.0.0",
            "224.0.0.1",
            "255.255.255.255",
            "[::1]",
            "[fc00::1]",
            "[fe80::1]",
            "[::ffff:10.0.0.1]",
            "[64:ff9b::10.0.0.1]",
        ] {
            let url = format!("http://{private}/hook");
            assert!(
                matches!(Webhook::new(&url, SECRET, false), Err(BadWebhook::Private(_))),
                "{private}"
            );
            assert!(Webhook::new(&url, SECRET, true).is_ok(), "{private}");
        }
        for public in ["1.1.1.1", "[2606:4700:4700::1111]", "example.com"] {
            assert!(
                Webhook::new(&format!("https://{public}/hook"), SECRET, false).is_ok(),
                "{public}"
            );
        }
        assert!(matches!(
            Webhook::new("ftp://example.com", SECRET, false),
            Err(BadWebhook::Address)
        ));
        assert!(matches!(
            Webhook::new("https://example.com", "whsec_c2hvcnQ=", false),
            Err(BadWebhook::Secret)
        ));
    }

    #[tokio::test]
    async fn host_names_that_resolve_to_this_machine_are_rejected() {
        let webhook = Webhook::new("http://localhost:9/hook", SECRET, false).unwrap();
        let error = webhook.deliver("msg_1", 1, "{}".into()).await.unwrap_err();
        let message = uniground_models::with_causes(&error);
        assert!(message.contains("its own network"), "{message}");
    }
}
