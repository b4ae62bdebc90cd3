//! The hub's description of a repository: its commit, its files with sizes and hashes, its license.

use super::AddError;
use super::hub_settings::HubSettings;
use super::source::HubName;
use super::transfer::{Hash, RemoteFile, Transfer};
use crate::packages::Event;
use reqwest::blocking::Response;
use reqwest::{StatusCode, Url};
use serde::Deserialize;
use std::collections::BTreeMap;

/// Maximum size of a description. Repositories with thousands of files have a megabyte.
const MAX_DESCRIPTION_BYTES: u64 = 16 << 20;
/// The revision of a repository that nothing pins.
const MAIN: &str = "main";
/// Longest name of a license.
const MAX_LICENSE_CHARS: usize = 100;

/// Returns the hub's word for why a request was refused, or an empty text.
fn error_code(response: &Response) -> &str {
    response.headers().get("X-Error-Code").and_then(|v| v.to_str().ok()).unwrap_or_default()
}

/// A repository at one commit.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Repository {
    /// 40 hexadecimal digits.
    pub commit: String,
    /// Files by path.
    pub files: BTreeMap<String, RemoteFile>,
    /// Name of the license as its authors state it. Empty if they do not.
    pub license: String,
}

#[derive(Deserialize)]
struct ModelInfo {
    sha: String,
    #[serde(default)]
    siblings: Vec<Sibling>,
    #[serde(default, rename = "cardData")]
    card: serde_json::Value,
    tags: Option<Vec<String>>,
}

#[derive(Deserialize)]
struct Sibling {
    rfilename: String,
    size: Option<u64>,
    #[serde(rename = "blobId")]
    blob_id: Option<String>,
    lfs: Option<LargeFile>,
}

#[derive(Deserialize)]
struct LargeFile {
    sha256: Option<String>,
    size: Option<u64>,
}

impl ModelInfo {
    fn license(&self) -> String {
        let named = |value: &serde_json::Value| match value {
            serde_json::Value::Array(names) => {
                Some(names.iter().filter_map(|name| name.as_str()).collect::<Vec<_>>().join(", "))
            }
            other => other.as_str().map(str::to_owned),
        };
        // The name of a license that is not in the hub's list.
        let own = || named(&self.card["license_name"]);
        let of_card = named(&self.card["license"]).filter(|name| !name.is_empty());
        let of_card = match of_card.as_deref() {
            Some("other") => own().or(of_card),
            _ => of_card,
        };
        let of_tags = || {
            self.tags.iter().flatten().find_map(|tag| Some(tag.strip_prefix("license:")?.into()))
        };
        let license: String = of_card.or_else(of_tags).unwrap_or_default();
        // It is printed to terminals.
        license.chars().filter(|c| !c.is_control()).take(MAX_LICENSE_CHARS).collect()
    }
}

/// The hub, asked for one repository.
pub struct Hub<'a> {
    pub settings: &'a HubSettings,
    pub name: &'a HubName,
    pub transfer: Transfer<'a>,
}

impl Hub<'_> {
    /// Returns the repository at a revision: the named one, or else `pinned`, or else `main`.
    ///
    /// # Errors
    /// Returns an error when the hub is unreachable, or when it refuses or does not have it.
    pub fn describe(
        &self,
        pinned: Option<&str>,
        on_event: &mut dyn FnMut(Event),
    ) -> Result<Repository, AddError> {
        let HubName { owner, name, revision } = self.name;
        let revision = revision.as_deref().or(pinned).unwrap_or(MAIN);
        let mut url = self.url(&["api", "models", owner, name, "revision", revision])?;
        url.set_query(Some("blobs=true"));
        let explain = |response: &Response| match error_code(response) {
            "RevisionNotFound" if pinned == Some(revision) => Some(self.refused(format!(
                "the pinned commit {revision} does not exist any more; --update takes the newest"
            ))),
            "RevisionNotFound" => {
                Some(self.refused(format!("there is no branch, tag or full commit {revision}")))
            }
            _ => self.explain(response),
        };
        let text = self.transfer.fetch_text(&url, MAX_DESCRIPTION_BYTES, &explain, on_event)?;
        let info: ModelInfo = serde_json::from_str(&text).map_err(|_| {
            self.refused(
                "the answer does not describe a repository: is there a proxy or a login page in \
                 between?",
            )
        })?;
        if !(info.sha.len() == 40 && info.sha.chars().all(|c| c.is_ascii_hexdigit())) {
            return Err(self.refused("its description has no commit"));
        }
        let license = info.license();
        let files = info.siblings.into_iter().map(|sibling| {
            let large = sibling.lfs.as_ref();
            let sha256 = large.and_then(|lfs| lfs.sha256.clone()).map(Hash::Sha256);
            let file = RemoteFile {
                name: sibling.rfilename.clone(),
                bytes: large.and_then(|lfs| lfs.size).or(sibling.size),
                hash: sha256.or_else(|| {
                    sibling.blob_id.clone().filter(|_| large.is_none()).map(Hash::GitBlob)
                }),
            };
            (sibling.rfilename, file)
        });
        Ok(Repository { commit: info.sha, files: files.collect(), license })
    }

    /// Returns the address of a file at a commit.
    ///
    /// # Errors
    /// Returns an error if the endpoint's address cannot have a path.
    pub fn file_url(&self, commit: &str, path: &str) -> Result<Url, AddError> {
        let HubName { owner, name, .. } = self.name;
        let mut segments = vec![owner.as_str(), name, "resolve", commit];
        segments.extend(path.split('/'));
        self.url(&segments)
    }

    /// Joins the endpoint and segments. A slash inside of a segment is part of it.
    fn url(&self, segments: &[&str]) -> Result<Url, AddError> {
        let mut url = self.settings.endpoint.clone();
        url.path_segments_mut()
            .map_err(|()| self.refused("invalid address of the hub"))?
            .pop_if_empty()
            .extend(segments);
        Ok(url)
    }

    fn refused(&self, why: impl Into<String>) -> AddError {
        AddError::Source { source_name: self.transfer.source_name.clone(), why: why.into() }
    }

    /// Returns the error for a status that will not change by itself.
    pub fn explain(&self, response: &Response) -> Option<AddError> {
        let HubName { owner, name, .. } = self.name;
        let code = error_code(response);
        let page = format!("{}/{owner}/{name}", self.settings.display_endpoint());
        let has_token = self.settings.token.is_some();
        let why = match (response.status(), code) {
            (StatusCode::UNAUTHORIZED | StatusCode::FORBIDDEN, "GatedRepo") => match has_token {
                true => format!(
                    "its authors ask for consent to terms, which the account of the token has not \
                     given. Give it at {page}."
                ),
                false => format!(
                    "its authors ask for consent to terms. Give it at {page}, then set HF_TOKEN."
                ),
            },
            (StatusCode::NOT_FOUND, "EntryNotFound") => {
                "a file does not exist at this commit".into()
            }
            (StatusCode::UNAUTHORIZED | StatusCode::NOT_FOUND, _) => match has_token {
                true => format!("does not exist, or the token has no access: see {page}"),
                false => format!(
                    "does not exist, or is private: see {page}. For a private one set HF_TOKEN."
                ),
            },
            (StatusCode::FORBIDDEN, _) => match has_token {
                true => format!("the token has no access: see {page}"),
                false => format!("access is denied: see {page}. For a private one set HF_TOKEN."),
            },
            (status, _)
                if status.is_client_error()
                    && status != StatusCode::TOO_MANY_REQUESTS
                    && status != StatusCode::REQUEST_TIMEOUT =>
            {
                format!("the hub answers {status}")
            }
            _ => return None,
        };
        Some(self.refused(why))
    }
}
