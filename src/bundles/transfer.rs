//! Downloads a file: in pieces, resumed where an earlier attempt ended, and verified as a whole.

use super::AddError;
use crate::packages::{Event, describe_error, hex};
use camino::{Utf8Path, Utf8PathBuf};
use reqwest::blocking::{Client, RequestBuilder, Response};
use reqwest::header::{CONTENT_RANGE, IF_RANGE, RANGE, RETRY_AFTER};
use reqwest::{StatusCode, Url};
use sha1::Sha1;
use sha2::{Digest, Sha256};
use std::fs::{self, File, OpenOptions};
use std::io::{self, Read, Write};
use std::time::Duration;

/// Timeout for a response and between two pieces of a file.
const NETWORK_TIMEOUT: Duration = Duration::from_mins(1);
const CONNECT_TIMEOUT: Duration = Duration::from_secs(15);
/// Number of bytes that are read at once.
const PIECE_BYTES: usize = 1 << 16;
/// Number of attempts without a new byte.
const ATTEMPTS: u32 = 5;
/// Longest pause between two attempts.
const MAX_PAUSE: Duration = Duration::from_secs(30);
/// Largest file whose size the source does not state.
const MAX_UNSTATED_BYTES: u64 = 16 << 30;

/// Returns the name of a file until it is complete.
#[must_use]
pub fn partial_of(file: &Utf8Path) -> Utf8PathBuf {
    file.with_file_name(format!("{}.partial", file.file_name().unwrap_or_default()))
}

/// The published hash of a file.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Hash {
    Sha256(String),
    /// The SHA-1 of the file as a blob of Git. Small files have no other one at the hub.
    GitBlob(String),
}

/// A file at its source.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct RemoteFile {
    /// Name for messages.
    pub name: String,
    pub bytes: Option<u64>,
    pub hash: Option<Hash>,
}

/// Makes the requests of one source.
pub struct Transfer<'a> {
    pub client: Client,
    /// Sent with requests to the source's own host.
    pub token: Option<&'a str>,
    /// The source, for messages.
    pub source_name: String,
    /// The source's address, for messages.
    pub address: String,
    /// What to do when the source cannot be reached.
    pub remedy: &'static str,
    /// Waits between attempts.
    pub pause: &'a dyn Fn(Duration),
}

/// Returns a client with the limits of all transfers.
///
/// # Errors
/// Returns an error when the system's certificates or proxies cannot be used.
pub fn client() -> reqwest::Result<Client> {
    uniground_client::install_crypto_provider();
    Client::builder()
        .timeout(NETWORK_TIMEOUT)
        .connect_timeout(CONNECT_TIMEOUT)
        .user_agent(concat!("uniground/", env!("CARGO_PKG_VERSION")))
        .build()
}

/// How an attempt ended.
enum Attempt {
    Complete,
    /// The reason, and how long the server asks to wait.
    Again(String, Option<Duration>),
}

impl Transfer<'_> {
    fn unreachable(&self, why: String) -> AddError {
        AddError::Unreachable {
            source_name: self.source_name.clone(),
            address: self.address.clone(),
            why,
            remedy: self.remedy,
        }
    }

    fn failing(&self, why: String) -> AddError {
        let (source_name, address) = (self.source_name.clone(), self.address.clone());
        AddError::Failing { source_name, address, why: format!("{why}; tried {ATTEMPTS} times") }
    }

    /// Waits before the next attempt.
    fn wait(&self, why: &str, pause: Duration, on_event: &mut dyn FnMut(Event)) {
        on_event(Event::Retrying { why, seconds: pause.as_secs() });
        (self.pause)(pause);
    }

    fn refused(&self, why: impl Into<String>) -> AddError {
        AddError::Source { source_name: self.source_name.clone(), why: why.into() }
    }

    fn request(&self, url: Url) -> RequestBuilder {
        let request = self.client.get(url);
        match self.token {
            Some(token) => request.bearer_auth(token),
            None => request,
        }
    }

    /// Returns the response to a request for a description, at most `limit` bytes. `explain` turns
    /// a status into an error; `None` stands for an error of the server, which may pass.
    ///
    /// # Errors
    /// Returns an error when the source is unreachable or refuses.
    pub fn fetch_text(
        &self,
        url: &Url,
        limit: u64,
        explain: &dyn Fn(&Response) -> Option<AddError>,
        on_event: &mut dyn FnMut(Event),
    ) -> Result<String, AddError> {
        let mut last = String::new();
        for attempt in 0..ATTEMPTS {
            // A host that does not exist or does not listen will not do so a second later.
            let response = self
                .request(url.clone())
                .send()
                .map_err(|error| self.unreachable(describe_error(error)))?;
            let mut asked = None;
            if response.status().is_success() {
                let mut bytes = Vec::new();
                match response.take(limit + 1).read_to_end(&mut bytes) {
                    Ok(length) if length as u64 > limit => {
                        return Err(self.refused("the description of its files is too long"));
                    }
                    Ok(_) => {
                        return String::from_utf8(bytes)
                            .map_err(|_| self.refused("the description of its files is not text"));
                    }
                    Err(error) => last = format!("broke off its answer: {error}"),
                }
            } else if let Some(error) = explain(&response) {
                return Err(error);
            } else {
                last = format!("answers {}", response.status());
                asked = retry_after(&response);
            }
            if attempt + 1 < ATTEMPTS {
                self.wait(&format!("{} {last}", self.address), backoff(attempt, asked), on_event);
            }
        }
        Err(self.failing(last))
    }

    /// Downloads a file to `to`, and returns its SHA-256. What an earlier attempt left beside `to`
    /// is continued.
    ///
    /// # Errors
    /// Returns an error when the source is unreachable or refuses, when the file differs from the
    /// published one, or when it cannot be written.
    pub fn download(
        &self,
        url: &Url,
        file: &RemoteFile,
        to: &Utf8Path,
        explain: &dyn Fn(&Response) -> Option<AddError>,
        on_event: &mut dyn FnMut(Event),
    ) -> Result<String, AddError> {
        let partial = partial_of(to);
        let failed = |why: io::Error| AddError::File { file: partial.clone(), why };
        let mut open = OpenOptions::new();
        let mut target =
            open.create(true).append(true).read(true).open(&partial).map_err(failed)?;
        let length = |target: &File| target.metadata().map(|m| m.len()).map_err(failed);
        if length(&target)? > file.bytes.unwrap_or(u64::MAX) {
            target.set_len(0).map_err(failed)?;
        }
        on_event(Event::Started(
            format!("{} of {}", file.name, self.source_name),
            file.bytes.unwrap_or_default(),
        ));
        let mut resumed = length(&target)? > 0;
        loop {
            self.receive(url, file, &mut target, &partial, explain, on_event)?;
            on_event(Event::Downloaded);
            target.sync_all().map_err(failed)?;
            match self.verify(file, &partial) {
                Ok(sha256) => {
                    fs::rename(&partial, to).map_err(failed)?;
                    return Ok(sha256);
                }
                // The beginning may come from another file, which an earlier attempt left.
                Err(AddError::WrongHash { .. }) if resumed => {
                    target.set_len(0).map_err(failed)?;
                    resumed = false;
                }
                Err(error) => {
                    // The next attempt begins anew.
                    let _gone = fs::remove_file(&partial);
                    return Err(error);
                }
            }
        }
    }

    /// Appends the rest of a file, in as many attempts as bring something.
    fn receive(
        &self,
        url: &Url,
        file: &RemoteFile,
        target: &mut File,
        partial: &Utf8Path,
        explain: &dyn Fn(&Response) -> Option<AddError>,
        on_event: &mut dyn FnMut(Event),
    ) -> Result<(), AddError> {
        let length = |target: &File| {
            target
                .metadata()
                .map(|m| m.len())
                .map_err(|why| AddError::File { file: partial.to_owned(), why })
        };
        let (mut idle, mut most, mut validator) = (0, length(target)?, None);
        loop {
            if file.bytes == Some(length(target)?) {
                return Ok(());
            }
            let ended = self.attempt(url, file, target, &mut validator, explain, on_event)?;
            let Attempt::Again(why, asked) = ended else { return Ok(()) };
            // Only bytes that no attempt had before are progress.
            let received = length(target)?;
            idle = if received > most { 0 } else { idle + 1 };
            most = most.max(received);
            if idle >= ATTEMPTS {
                return Err(self.failing(format!("does not give {}: {why}", file.name)));
            }
            self.wait(&format!("{}: {why}", file.name), backoff(idle, asked), on_event);
        }
    }

    fn attempt(
        &self,
        url: &Url,
        file: &RemoteFile,
        target: &mut File,
        validator: &mut Option<String>,
        explain: &dyn Fn(&Response) -> Option<AddError>,
        on_event: &mut dyn FnMut(Event),
    ) -> Result<Attempt, AddError> {
        let unwritten =
            |e: io::Error| self.refused(format!("{} cannot be written: {e}", file.name));
        let mut received = target.metadata().map_err(unwritten)?.len();
        let mut request = self.request(url.clone());
        if received > 0 {
            request = request.header(RANGE, format!("bytes={received}-"));
            if let Some(tag) = &validator {
                request = request.header(IF_RANGE, tag);
            }
        }
        let mut response = match request.send() {
            Ok(response) => response,
            Err(error) if error.is_redirect() || error.is_builder() => {
                return Err(self.unreachable(describe_error(error)));
            }
            Err(error) => return Ok(Attempt::Again(describe_error(error), None)),
        };
        let goes_on = response.status() == StatusCode::PARTIAL_CONTENT
            && response
                .headers()
                .get(CONTENT_RANGE)
                .and_then(|v| v.to_str().ok())
                .is_some_and(|range| range.trim().starts_with(&format!("bytes {received}-")));
        if response.status() == StatusCode::RANGE_NOT_SATISFIABLE {
            target.set_len(0).map_err(unwritten)?;
            return Ok(Attempt::Again("it has fewer bytes than before".into(), None));
        }
        if !response.status().is_success() {
            return match explain(&response) {
                Some(error) => Err(error),
                None => Ok(Attempt::Again(
                    format!("it answers {}", response.status()),
                    retry_after(&response),
                )),
            };
        }
        if !goes_on {
            target.set_len(0).map_err(unwritten)?;
            received = 0;
            if let (Some(whole), Some(stated)) = (response.content_length(), file.bytes)
                && whole != stated
            {
                return Err(self.refused(format!(
                    "{} has {whole} bytes, but {stated} are stated; it was not installed",
                    file.name
                )));
            }
        }
        *validator = response
            .headers()
            .get(reqwest::header::ETAG)
            .and_then(|tag| tag.to_str().ok())
            // A weak tag does not promise the same bytes.
            .filter(|tag| !tag.starts_with("W/"))
            .map(str::to_owned);
        let limit = file.bytes.unwrap_or(MAX_UNSTATED_BYTES);
        let mut piece = vec![0; PIECE_BYTES];
        loop {
            on_event(Event::Received(received));
            let read = match response.read(&mut piece) {
                Ok(0) => break,
                Ok(read) => read,
                Err(error) => {
                    return Ok(Attempt::Again(
                        format!("the download was interrupted: {error}"),
                        None,
                    ));
                }
            };
            received += read as u64;
            if received > limit {
                target.set_len(0).map_err(unwritten)?;
                return Err(self.refused(format!(
                    "{} is longer than the stated {limit} bytes and was not installed",
                    file.name
                )));
            }
            target.write_all(&piece[..read]).map_err(unwritten)?;
        }
        match file.bytes {
            Some(bytes) if received < bytes => Ok(Attempt::Again(
                format!("the download ended after {received} of {bytes} bytes"),
                None,
            )),
            _ => Ok(Attempt::Complete),
        }
    }

    /// Returns the SHA-256 of a file if it is the published one.
    ///
    /// # Errors
    /// Returns an error that names the file, the expected and the found hash.
    pub fn verify(&self, file: &RemoteFile, there: &Utf8Path) -> Result<String, AddError> {
        let hashes =
            hashes_of(there).map_err(|why| AddError::File { file: there.to_owned(), why })?;
        let (algorithm, expected, found) = match &file.hash {
            None => return Ok(hashes.sha256),
            Some(Hash::Sha256(expected)) => ("SHA-256", expected, &hashes.sha256),
            Some(Hash::GitBlob(expected)) => ("Git hash", expected, &hashes.git_blob),
        };
        if !expected.eq_ignore_ascii_case(found) {
            return Err(AddError::WrongHash {
                source_name: self.source_name.clone(),
                file: file.name.clone(),
                algorithm,
                found: found.clone(),
                expected: expected.clone(),
            });
        }
        Ok(hashes.sha256)
    }
}

/// The hashes of a file, hexadecimal.
pub struct Hashes {
    pub sha256: String,
    pub git_blob: String,
}

/// # Errors
/// Returns an error if the file cannot be read.
pub fn hashes_of(file: &Utf8Path) -> io::Result<Hashes> {
    let mut file = File::open(file)?;
    let (mut sha256, mut git) = (Sha256::new(), Sha1::new());
    git.update(format!("blob {}\0", file.metadata()?.len()));
    let mut piece = vec![0; PIECE_BYTES];
    loop {
        let read = file.read(&mut piece)?;
        if read == 0 {
            break;
        }
        sha256.update(&piece[..read]);
        git.update(&piece[..read]);
    }
    Ok(Hashes { sha256: hex(sha256), git_blob: hex(git) })
}

/// Returns the pause before the next attempt: what the server asks for, or a second, doubled each
/// time.
fn backoff(attempt: u32, asked: Option<Duration>) -> Duration {
    asked.unwrap_or(Duration::from_secs(1 << attempt.min(5))).min(MAX_PAUSE)
}

fn retry_after(response: &Response) -> Option<Duration> {
    let seconds = response.headers().get(RETRY_AFTER)?.to_str().ok()?.trim().parse().ok()?;
    Some(Duration::from_secs(seconds))
}
