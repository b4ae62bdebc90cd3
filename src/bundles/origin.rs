//! A source that was opened: its list of files, and a way to bring each of them.

use super::folder::{self, Archive};
use super::hub_api::{Hub, Repository};
use super::hub_cache::CachedRepository;
use super::install::AddOptions;
use super::lock::{LockedBundle, LockedFile};
use super::source::{BundleSource, HubName};
use super::transfer::{self, Hash, RemoteFile, Transfer, hashes_of};
use super::{AddError, HubSettings};
use crate::packages::{Event, hex};
use camino::{Utf8Path, Utf8PathBuf};
use reqwest::{StatusCode, Url};
use sha2::{Digest, Sha256};

/// An opened source.
pub enum Origin<'a> {
    Hub(Box<HubOrigin<'a>>),
    Folder(Utf8PathBuf),
    Zip(Archive),
}

/// A repository of the hub at one commit.
pub struct HubOrigin<'a> {
    hub: Hub<'a>,
    repository: Repository,
    cache: Option<CachedRepository>,
    pinned: Option<&'a LockedBundle>,
}

impl<'a> Origin<'a> {
    /// Opens a source. `pinned` is what `models.lock` has of it.
    ///
    /// # Errors
    /// Returns an error when the source cannot be reached, or does not exist.
    pub fn open(
        source: &'a BundleSource,
        pinned: Option<&'a LockedBundle>,
        staging: &Utf8Path,
        options: &AddOptions<'a>,
        on_event: &mut dyn FnMut(Event),
    ) -> Result<Self, AddError> {
        let transfer = |address: String, remedy, token| -> Result<Transfer<'a>, AddError> {
            let source_name = source.to_string();
            let client = transfer::client().map_err(|e| AddError::Source {
                source_name: source_name.clone(),
                why: format!("no connection can be made: {e}"),
            })?;
            Ok(Transfer { client, token, source_name, address, remedy, pause: options.pause })
        };
        match source {
            BundleSource::Hub(name) => {
                let settings = options.hub;
                let transfer = transfer(
                    settings.display_endpoint(),
                    "Check the network connection, or set HF_ENDPOINT to a mirror.",
                    settings.token.as_deref(),
                )?;
                let hub = Hub { settings, name, transfer };
                HubOrigin::open(hub, pinned, on_event).map(Box::new).map(Self::Hub)
            }
            BundleSource::Folder(folder) => Ok(Self::Folder(folder.clone())),
            BundleSource::Zip(url, sha256) => {
                let host = url.host_str().unwrap_or_default().to_owned();
                let remedy = "Check the network connection and the address.";
                let transfer = transfer(host, remedy, None)?;
                Self::open_zip(url, sha256.as_deref(), &transfer, staging, on_event)
            }
        }
    }

    fn open_zip(
        url: &Url,
        sha256: Option<&str>,
        transfer: &Transfer,
        staging: &Utf8Path,
        on_event: &mut dyn FnMut(Event),
    ) -> Result<Self, AddError> {
        // The rest of one archive must not continue another of the same name.
        let address = hex(Sha256::new_with_prefix(url.as_str()));
        let file = staging.join(format!("archive-{}.zip", &address[..16]));
        let remote = RemoteFile {
            name: "the archive".into(),
            bytes: None,
            hash: sha256.map(|hash| Hash::Sha256(hash.to_owned())),
        };
        let explain = |response: &reqwest::blocking::Response| {
            let status = response.status();
            let is_final = status.is_client_error() && status != StatusCode::TOO_MANY_REQUESTS;
            is_final.then(|| AddError::Source {
                source_name: transfer.source_name.clone(),
                why: format!("the server answers {status}"),
            })
        };
        transfer.download(url, &remote, &file, &explain, on_event)?;
        Archive::open(&file, &transfer.source_name).map(Self::Zip)
    }

    /// Returns the paths of its files.
    ///
    /// # Errors
    /// Returns an error if a folder cannot be read.
    pub fn list(&self) -> Result<Vec<String>, AddError> {
        match self {
            Self::Hub(hub) => Ok(hub.repository.files.keys().cloned().collect()),
            Self::Folder(folder) => folder::list(folder),
            Self::Zip(archive) => Ok(archive.list()),
        }
    }

    /// Returns the size of a file, if the source states it.
    #[must_use]
    pub fn bytes(&self, path: &str) -> Option<u64> {
        match self {
            Self::Hub(hub) => hub.repository.files.get(path)?.bytes,
            Self::Folder(folder) => folder.join(path).metadata().ok().map(|m| m.len()),
            Self::Zip(_) => None,
        }
    }

    /// Returns whether a file can be compared with a hash that its source states. Files of this
    /// machine need none.
    #[must_use]
    pub fn is_verifiable(&self, path: &str) -> bool {
        match self {
            Self::Hub(hub) if hub.hub.settings.is_offline => true,
            Self::Hub(hub) => hub.repository.files.get(path).is_some_and(|f| f.hash.is_some()),
            Self::Folder(_) | Self::Zip(_) => true,
        }
    }

    /// Returns the license that the source states, or an empty text.
    #[must_use]
    pub fn license(&self) -> &str {
        match self {
            Self::Hub(hub) => &hub.repository.license,
            Self::Folder(_) | Self::Zip(_) => "",
        }
    }

    /// Returns the commit of a repository.
    #[must_use]
    pub fn revision(&self) -> Option<&str> {
        match self {
            Self::Hub(hub) => Some(&hub.repository.commit),
            Self::Folder(_) | Self::Zip(_) => None,
        }
    }

    /// Brings a file to `to`, and returns its SHA-256. `installed` is where an earlier revision has
    /// it.
    ///
    /// # Errors
    /// Returns an error when the file cannot be brought, or differs from the published one.
    pub fn bring(
        &mut self,
        path: &str,
        to: &Utf8Path,
        installed: &Utf8Path,
        on_event: &mut dyn FnMut(Event),
    ) -> Result<String, AddError> {
        match self {
            Self::Hub(hub) => return hub.bring(path, to, installed, on_event),
            // A copy: whoever made the folder may write to its files again.
            Self::Folder(folder) => folder::copy(&folder.join(path), to)?,
            Self::Zip(archive) => archive.extract(path, to)?,
        }
        hashes_of(to)
            .map(|hashes| hashes.sha256)
            .map_err(|why| AddError::File { file: to.to_owned(), why })
    }
}

impl<'a> HubOrigin<'a> {
    fn open(
        hub: Hub<'a>,
        pinned: Option<&'a LockedBundle>,
        on_event: &mut dyn FnMut(Event),
    ) -> Result<Self, AddError> {
        let HubSettings { cache, is_offline, .. } = hub.settings;
        let cache = cache.as_ref().map(|cache| CachedRepository::new(cache, hub.name));
        let pinned_commit = pinned.and_then(|locked| locked.revision.as_deref());
        let repository = match is_offline {
            false => hub.describe(pinned_commit, on_event)?,
            true => {
                cached_repository(cache.as_ref(), hub.name, pinned_commit).ok_or_else(|| {
                    let why = "HF_HUB_OFFLINE is set, and the revision is not in the hub's cache";
                    AddError::Source {
                        source_name: hub.transfer.source_name.clone(),
                        why: why.into(),
                    }
                })?
            }
        };
        Ok(Self { hub, repository, cache, pinned })
    }

    fn bring(
        &self,
        path: &str,
        to: &Utf8Path,
        installed: &Utf8Path,
        on_event: &mut dyn FnMut(Event),
    ) -> Result<String, AddError> {
        let Self { hub, repository, cache, .. } = self;
        let unknown = || RemoteFile { name: path.to_owned(), bytes: None, hash: None };
        let mut file = repository.files.get(path).cloned().unwrap_or_else(unknown);
        if let Some(pinned) = self.pinned_file(path) {
            file.hash = Some(Hash::Sha256(pinned.sha256.clone()));
        }
        let cached = cache.as_ref().and_then(|c| c.find(&repository.commit, path, &file));
        // The cache calls its files by their hashes.
        let named = cached.as_deref().and_then(hash_in_name);
        file.hash = file.hash.or(named);
        // Without a hash, only the cache is known to have this commit's file.
        let known = |there: &Utf8Path| file.hash.is_some().then(|| there.to_owned());
        for there in [known(to), known(installed), cached].into_iter().flatten() {
            if there.is_file()
                && let Ok(sha256) = hub.transfer.verify(&file, &there)
            {
                folder::link(&there, to)?;
                return Ok(sha256);
            }
        }
        if hub.settings.is_offline {
            return Err(AddError::Source {
                source_name: hub.transfer.source_name.clone(),
                why: format!("HF_HUB_OFFLINE is set, and {path} is not in the hub's cache"),
            });
        }
        let url = hub.file_url(&repository.commit, path)?;
        hub.transfer.download(&url, &file, to, &|response| hub.explain(response), on_event)
    }

    /// Returns the file that `models.lock` has of the same commit.
    fn pinned_file(&self, path: &str) -> Option<&LockedFile> {
        let is_same =
            |locked: &&LockedBundle| locked.revision.as_deref() == Some(&self.repository.commit);
        self.pinned.filter(is_same)?.files.values().find(|file| file.path == path)
    }
}

/// Returns the hash that a file of the cache is called by.
fn hash_in_name(file: &Utf8Path) -> Option<Hash> {
    let name = file.file_name().filter(|name| name.chars().all(|c| c.is_ascii_hexdigit()))?;
    match name.len() {
        64 => Some(Hash::Sha256(name.to_owned())),
        40 => Some(Hash::GitBlob(name.to_owned())),
        _ => None,
    }
}

/// Returns the part of a repository that the hub's own tools have downloaded.
fn cached_repository(
    cache: Option<&CachedRepository>,
    name: &HubName,
    pinned: Option<&str>,
) -> Option<Repository> {
    let cache = cache?;
    let commit = cache.commit(name.revision.as_deref().or(pinned).unwrap_or("main"))?;
    let unknown = |path: String| {
        let file = RemoteFile { name: path.clone(), bytes: None, hash: None };
        (path, file)
    };
    let files = cache.files(&commit).into_iter().map(unknown).collect();
    let license = cache.license(&commit);
    Some(Repository { commit, files, license })
}
