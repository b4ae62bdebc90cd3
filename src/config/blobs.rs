//! Storage of scans, parses and transcripts.

use crate::telemetry;
use anyhow::{Context, bail};
use camino::Utf8PathBuf;
use std::fs;
use std::time::Duration;
use uniground_storage::{AccessKeys, BlobHome, BlobsAt, Links};

const DEFAULT_CACHE_BYTES: u64 = 50 << 30;
const DEFAULT_GRACE_S: u64 = 24 * 60 * 60;

/// Storage in the data folder or in an S3-compatible object store. The endpoint, region and keys
/// come from the usual variables: AWS_ENDPOINT_URL, AWS_REGION, AWS_ACCESS_KEY_ID,
/// AWS_SECRET_ACCESS_KEY, AWS_SESSION_TOKEN, or from the role of the machine.
#[allow(clippy::doc_markdown)] // Help is plain text.
#[derive(Debug, Clone, clap::Args)]
pub struct BlobsConfig {
    /// Storage of scans and parses: "folder" (the data folder), or s3://BUCKET/PREFIX. With S3, the
    /// data folder holds a local cache
    #[arg(long = "blobs", env = "UNIGROUND_BLOBS", value_name = "PLACE", default_value = "folder")]
    pub at: BlobsAt,
    /// File with the keys of the bucket, in the format of ~/.aws/credentials. Uses the profile
    /// "default", or the one in AWS_PROFILE
    #[arg(long, env = "UNIGROUND_BLOBS_CREDENTIALS_FILE", value_name = "FILE")]
    pub blobs_credentials_file: Option<Utf8PathBuf>,
    /// Maximum size of unused files in the local cache of S3 objects, bytes
    #[arg(long, env = "UNIGROUND_BLOBS_CACHE_BYTES", default_value_t = DEFAULT_CACHE_BYTES, value_name = "BYTES")]
    pub blobs_cache_bytes: u64,
    /// Redirect downloads of clouds, points and embeddings to the object store, with links that are
    /// valid for 15 minutes. Clients must be able to reach the store
    #[arg(long, env = "UNIGROUND_BLOBS_REDIRECT")]
    pub blobs_redirect: bool,
    /// Age at which orphan objects in the bucket are removed, seconds. Storing one scan must take
    /// at most half of it
    #[arg(long, env = "UNIGROUND_BLOBS_GRACE_S", default_value_t = DEFAULT_GRACE_S, value_name = "SECONDS", value_parser = clap::value_parser!(u64).range(1..))]
    pub blobs_grace_s: u64,
}

impl Default for BlobsConfig {
    fn default() -> Self {
        Self {
            at: BlobsAt::Folder,
            blobs_credentials_file: None,
            blobs_cache_bytes: DEFAULT_CACHE_BYTES,
            blobs_redirect: false,
            blobs_grace_s: DEFAULT_GRACE_S,
        }
    }
}

impl BlobsConfig {
    /// Returns the storage location with its keys, and redacts the keys from the log.
    ///
    /// # Errors
    /// Returns an error if the credentials file cannot be read or has no keys.
    pub fn blob_home(&self) -> anyhow::Result<BlobHome> {
        let BlobsAt::Bucket(bucket) = &self.at else { return Ok(BlobHome::Folder) };
        for secret in ["AWS_SECRET_ACCESS_KEY", "AWS_SESSION_TOKEN"] {
            std::env::var(secret).iter().for_each(|secret| telemetry::register_secret(secret));
        }
        let keys = match &self.blobs_credentials_file {
            Some(file) => {
                let text = fs::read_to_string(file)
                    .with_context(|| format!("the credentials file {file}"))?;
                let profile = std::env::var("AWS_PROFILE").unwrap_or_else(|_| "default".into());
                Some(
                    parse_access_keys(&text, &profile)
                        .with_context(|| format!("the credentials file {file}"))?,
                )
            }
            None => None,
        };
        Ok(BlobHome::Bucket {
            bucket: bucket.clone(),
            keys,
            links: if self.blobs_redirect { Links::ToObjects } else { Links::None },
            cache_bytes: self.blobs_cache_bytes,
            grace: Duration::from_secs(self.blobs_grace_s),
        })
    }
}

/// Returns the keys of a profile.
fn parse_access_keys(text: &str, profile: &str) -> anyhow::Result<AccessKeys> {
    let (mut is_ours, mut id, mut secret, mut session) = (false, None, None, None);
    for line in text.lines().map(str::trim) {
        if let Some(section) = line.strip_prefix('[').and_then(|rest| rest.strip_suffix(']')) {
            is_ours = section.trim() == profile;
        } else if let Some((key, value)) = line.split_once('=').filter(|_| is_ours) {
            let value = Some(value.trim().to_owned());
            match key.trim() {
                "aws_access_key_id" => id = value,
                "aws_secret_access_key" => secret = value,
                "aws_session_token" => session = value,
                _ => {}
            }
        }
    }
    secret.iter().chain(&session).for_each(|secret| telemetry::register_secret(secret));
    match (id, secret) {
        (Some(id), Some(secret)) => Ok(AccessKeys { id, secret, session }),
        _ => bail!("the profile [{profile}] has no aws_access_key_id and aws_secret_access_key"),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn access_keys_come_from_the_profile() {
        let file = "[other]\naws_access_key_id = OTHER\n[default]\naws_access_key_id=MINE\naws_secret_access_key = se/cret+=\n";
        let keys = parse_access_keys(file, "default").unwrap();
        assert_eq!(
            (keys.id.as_str(), keys.secret.as_str(), keys.session),
            ("MINE", "se/cret+=", None)
        );
        let error = parse_access_keys(file, "other").unwrap_err().to_string();
        assert!(error.contains("[other]") && !error.contains("OTHER"), "{error}");
    }
}
