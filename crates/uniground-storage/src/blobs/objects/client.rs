//! The bucket and its client settings.

use super::Objects;
use object_store::aws::{AmazonS3Builder, AmazonS3ConfigKey};
use object_store::{BackoffConfig, ClientOptions, RetryConfig};
use std::str::FromStr;
use std::sync::Arc;
use std::time::Duration;
use std::{fmt, io};
use uniground_client::install_crypto_provider;

/// `s3://BUCKET/PREFIX`
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Bucket {
    name: String,
    /// Without leading or trailing slash; may be empty.
    prefix: String,
}

/// Access keys of a bucket, read from a file.
#[derive(Clone)]
pub struct AccessKeys {
    pub id: String,
    pub secret: String,
    pub session: Option<String>,
}

impl fmt::Debug for AccessKeys {
    fn fmt(&self, to: &mut fmt::Formatter<'_>) -> fmt::Result {
        to.write_str("AccessKeys")
    }
}

impl FromStr for Bucket {
    type Err = &'static str;

    fn from_str(text: &str) -> Result<Self, Self::Err> {
        const EXPECTED: &str = "expected \"folder\" or s3://BUCKET/PREFIX";
        let place = text.strip_prefix("s3://").ok_or(EXPECTED)?;
        let (name, prefix) = place.split_once('/').unwrap_or((place, ""));
        let may_be = |c: char| c.is_ascii_alphanumeric() || "-._".contains(c);
        let is_name = name.len() >= 3 && name.chars().all(may_be);
        let prefix = prefix.trim_matches('/');
        let is_prefix = prefix.is_empty()
            || prefix
                .split('/')
                .all(|part| !part.trim_matches('.').is_empty() && part.chars().all(may_be));
        if is_name && is_prefix {
            Ok(Self { name: name.to_owned(), prefix: prefix.to_owned() })
        } else {
            Err(EXPECTED)
        }
    }
}

impl fmt::Display for Bucket {
    fn fmt(&self, to: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { name, prefix } = self;
        write!(to, "s3://{name}/{prefix}")
    }
}

/// Whether clients are redirected to the object store for large files.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Links {
    None,
    ToObjects,
}

/// Timeout for opening a connection.
const CONNECT_TIMEOUT: Duration = Duration::from_secs(2);
/// A connection without data for longer counts as lost.
const READ_TIMEOUT: Duration = Duration::from_secs(10);

impl Bucket {
    /// Returns the objects in the bucket. Address, region and keys come from the usual variables
    /// (`AWS_ENDPOINT_URL`, `AWS_REGION`, `AWS_ACCESS_KEY_ID`, …) or from the machine's role. TLS
    /// is off only where the address says so.
    ///
    /// # Errors
    /// A setting that cannot be parsed.
    pub fn objects(
        &self,
        keys: Option<&AccessKeys>,
        links: Links,
        grace: Duration,
    ) -> io::Result<Objects> {
        install_crypto_provider();
        let options = ClientOptions::new()
            .with_timeout_disabled()
            .with_connect_timeout(CONNECT_TIMEOUT)
            .with_read_timeout(READ_TIMEOUT);
        let retry = RetryConfig {
            backoff: BackoffConfig {
                init_backoff: Duration::from_millis(100),
                max_backoff: Duration::from_secs(1),
                base: 2.0,
            },
            max_retries: 3,
            retry_timeout: Duration::from_secs(10),
        };
        let mut builder = AmazonS3Builder::from_env()
            .with_bucket_name(&self.name)
            .with_client_options(options)
            .with_retry(retry);
        let endpoint = builder
            .get_config_value(&AmazonS3ConfigKey::Endpoint)
            .or_else(|| builder.get_config_value(&AmazonS3ConfigKey::S3Endpoint));
        builder =
            builder.with_allow_http(endpoint.is_some_and(|address| address.starts_with("http://")));
        if let Some(AccessKeys { id, secret, session }) = keys {
            builder = builder.with_access_key_id(id).with_secret_access_key(secret);
            if let Some(session) = session {
                builder = builder.with_token(session);
            }
        }
        let store = Arc::new(builder.build().map_err(io::Error::other)?);
        let objects = Objects::new(store.clone(), &self.prefix, grace);
        Ok(match links {
            Links::None => objects,
            Links::ToObjects => objects.with_signer(store),
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn bucket_urls_are_parsed_and_formatted() {
        let parse_and_format = |text: &str| text.parse::<Bucket>().map(|bucket| bucket.to_string());
        assert_eq!(parse_and_format("s3://rooms/a/b/"), Ok("s3://rooms/a/b".into()));
        assert_eq!(parse_and_format("s3://rooms"), Ok("s3://rooms/".into()));
        for wrong in [
            "rooms",
            "s3://",
            "s3://r",
            "s3://ro oms",
            "s3://rooms/../other",
            "s3://user:pass@rooms/x",
            "gs://rooms/x",
        ] {
            assert!(parse_and_format(wrong).is_err(), "{wrong}");
        }
    }
}
