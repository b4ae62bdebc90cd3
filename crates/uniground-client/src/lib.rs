//! A typed client of uniground's HTTP API: upload a scan, follow its parse, ask questions.
//!
//! ```no_run
//! # async fn example() -> Result<(), Box<dyn std::error::Error>> {
//! use uniground_client::{Client, types::question::GroundRequest};
//!
//! let client = Client::new("http://127.0.0.1:8080", None)?;
//! let created = client.create_scene(None, "application/zip", std::fs::read("living_room.zip")?).await?;
//! let job = created.job.ok_or("nothing to wait for")?;
//! client.follow_job(&job.id, |job| println!("{:.0} %", job.progress * 100.0)).await?;
//! let answer = client.ground(&created.scene.id, &GroundRequest::new("the mug on the coffee table")).await?;
//! println!("{:?} at {:?}", answer.status, answer.aabb);
//! # Ok(())
//! # }
//! ```

#![warn(missing_docs)]

mod exports;
mod growth;
mod reply;
mod rooms;

pub use reply::ClientError;

use futures::StreamExt;
use reply::{checked, json};
use reqwest::{Method, RequestBuilder, Url};
use serde::Serialize;
use std::net::IpAddr;
pub use uniground_types as types;
use uniground_types::answer::{Answer, AnswerList, Shortlisted};
use uniground_types::batch::{Batch, BatchList, BatchRequest, BatchResult};
use uniground_types::corrections::{Change, Correction, CorrectionList};
use uniground_types::instances::{InstanceList, InstanceView, Levels};
use uniground_types::job::{Job, JobList};
use uniground_types::keys::{AuditList, CreatedKey, Key, KeyList, NewKey};
use uniground_types::links::{LinkList, LinkRequest};
use uniground_types::many::{ManyAnswers, ManyGroundRequest};
use uniground_types::question::{GroundRequest, ShortlistRequest};
use uniground_types::scenes::{Created, Scene, SceneChange, SceneList, SceneReport};
use uniground_types::service::ModelList;
use uniground_types::stats::Stats;
use uniground_types::transcript::{AnswerPrompt, AnswerReply};

/// Installs the TLS crypto provider of this process: ring, unless one is installed already.
/// `reqwest` has none of its own and needs one when a client is created.
pub fn install_crypto_provider() {
    if rustls::crypto::CryptoProvider::get_default().is_none() {
        let _chosen_meanwhile = rustls::crypto::ring::default_provider().install_default();
    }
}

/// Returns a builder of an HTTP client for an address. Proxies of the environment are not used for
/// addresses of this machine: they could not reach it.
pub fn http_client(address: &str) -> reqwest::ClientBuilder {
    let builder = reqwest::Client::builder();
    if is_local(address) { builder.no_proxy() } else { builder }
}

/// Returns whether an address is one of this machine.
#[must_use]
pub fn is_local(address: &str) -> bool {
    let Some(host) = Url::parse(address).ok().and_then(|url| url.host_str().map(str::to_owned))
    else {
        return false;
    };
    let ip = host.trim_start_matches('[').trim_end_matches(']').parse::<IpAddr>();
    host == "localhost" || host.ends_with(".localhost") || ip.is_ok_and(|ip| ip.is_loopback())
}

/// A client of one server, with an optional API key.
#[derive(Debug, Clone)]
pub struct Client {
    http: reqwest::Client,
    base: Url,
    api_key: Option<String>,
}

impl Client {
    /// Creates a client of a server at an address like `http://127.0.0.1:8080` or
    /// `https://host/prefix`.
    ///
    /// # Errors
    /// [`ClientError::BadAddress`].
    pub fn new(server: &str, api_key: Option<String>) -> Result<Self, ClientError> {
        let mut base = Url::parse(server)
            .ok()
            .filter(|url| !url.cannot_be_a_base())
            .ok_or_else(|| ClientError::BadAddress(server.into()))?;
        // Paths are relative to it: without the slash, the last folder would be replaced.
        if !base.path().ends_with('/') {
            let path = format!("{}/", base.path());
            base.set_path(&path);
        }
        install_crypto_provider();
        let http = http_client(server).build()?;
        Ok(Self { http, base, api_key })
    }

    /// Uploads an archive and starts parsing it.
    ///
    /// # Errors
    /// [`ClientError`].
    pub async fn create_scene(
        &self,
        name: Option<&str>,
        media_type: &str,
        archive: impl Into<reqwest::Body>,
    ) -> Result<Created, ClientError> {
        let request = self
            .request(Method::POST, "v1/scenes")
            .header("content-type", media_type)
            .body(archive);
        json(request.query(&[("name", name)])).await
    }

    /// Uploads an archive under an idempotency key. A repeated `key` returns the scene that the
    /// first request created. `query` holds query parameters of the API: `name`, `up`, `levelling`
    /// and so on.
    ///
    /// # Errors
    /// [`ClientError`].
    pub async fn create_scene_once(
        &self,
        query: &[(&str, &str)],
        media_type: &str,
        archive: impl Into<reqwest::Body>,
        key: &str,
    ) -> Result<Created, ClientError> {
        let request = self.request(Method::POST, "v1/scenes").header("content-type", media_type);
        json(request.header("idempotency-key", key).query(query).body(archive)).await
    }

    /// Uploads a scan: an archive, a `.sens` file, a cloud or a mesh. The server detects the format
    /// from its bytes. `query` holds query parameters of the API: `name`, `parse`, `up`,
    /// `metres_per_unit`, `levelling`, `preset`.
    ///
    /// # Errors
    /// [`ClientError`].
    pub async fn upload(
        &self,
        scan: impl Into<reqwest::Body>,
        query: &[(&str, &str)],
    ) -> Result<Created, ClientError> {
        let request = self
            .request(Method::POST, "v1/scenes")
            .header("content-type", "application/octet-stream");
        json(request.query(query).body(scan)).await
    }

    /// # Errors
    /// [`ClientError`].
    pub async fn scene(&self, id: &str) -> Result<Scene, ClientError> {
        json(self.request(Method::GET, &format!("v1/scenes/{id}"))).await
    }

    /// # Errors
    /// [`ClientError`].
    pub async fn scenes(&self, limit: u32, cursor: Option<&str>) -> Result<SceneList, ClientError> {
        json(
            self.request(Method::GET, "v1/scenes").query(&[
                ("limit", Some(limit.to_string())),
                ("cursor", cursor.map(str::to_owned)),
            ]),
        )
        .await
    }

    /// Returns a page of the scenes with these labels: `building=A,floor=2`.
    ///
    /// # Errors
    /// [`ClientError`].
    pub async fn scenes_with_labels(
        &self,
        labels: &str,
        limit: u32,
        cursor: Option<&str>,
    ) -> Result<SceneList, ClientError> {
        let limit = limit.to_string();
        let query = [("labels", Some(labels)), ("limit", Some(&limit)), ("cursor", cursor)];
        json(self.request(Method::GET, "v1/scenes").query(&query)).await
    }

    /// # Errors
    /// [`ClientError`].
    pub async fn rename_scene(&self, id: &str, name: &str) -> Result<Scene, ClientError> {
        self.change_scene(
            id,
            &SceneChange { name: Some(name.to_owned()), ..SceneChange::default() },
        )
        .await
    }

    /// Changes a scene's name, its labels or its pose in a map.
    ///
    /// # Errors
    /// [`ClientError`].
    pub async fn change_scene(&self, id: &str, change: &SceneChange) -> Result<Scene, ClientError> {
        json(self.request(Method::PATCH, &format!("v1/scenes/{id}")).json(change)).await
    }

    /// # Errors
    /// [`ClientError`].
    pub async fn delete_scene(&self, id: &str) -> Result<(), ClientError> {
        checked(self.request(Method::DELETE, &format!("v1/scenes/{id}")).send().await?).await?;
        Ok(())
    }

    /// # Errors
    /// [`ClientError`].
    pub async fn parse(&self, id: &str, request: &impl Serialize) -> Result<Job, ClientError> {
        json(self.request(Method::POST, &format!("v1/scenes/{id}/parse")).json(request)).await
    }

    /// # Errors
    /// [`ClientError`].
    pub async fn report(&self, scene_id: &str) -> Result<SceneReport, ClientError> {
        json(self.request(Method::GET, &format!("v1/scenes/{scene_id}/report"))).await
    }

    /// Returns the first objects of a scene.
    ///
    /// # Errors
    /// [`ClientError`].
    pub async fn instances(&self, scene_id: &str, limit: u32) -> Result<InstanceList, ClientError> {
        json(
            self.request(Method::GET, &format!("v1/scenes/{scene_id}/instances"))
                .query(&[("limit", limit)]),
        )
        .await
    }

    /// Returns all instances of a scene at these levels, ordered by id.
    ///
    /// # Errors
    /// [`ClientError`].
    pub async fn all_instances(
        &self,
        scene_id: &str,
        levels: Levels,
    ) -> Result<Vec<InstanceView>, ClientError> {
        const PAGE: u32 = 200;
        let mut instances = Vec::new();
        let mut cursor = None;
        loop {
            let query = [("limit", Some(PAGE)), ("cursor", cursor)];
            let page =
                self.request(Method::GET, &format!("v1/scenes/{scene_id}/instances")).query(&query);
            let page: InstanceList = json(page.query(&[("level", levels)])).await?;
            instances.extend(page.instances);
            cursor = page.next_cursor;
            if cursor.is_none() {
                return Ok(instances);
            }
        }
    }

    /// Corrects a scene's current parse. Later answers use the correction.
    ///
    /// # Errors
    /// [`ClientError`].
    pub async fn correct(
        &self,
        scene_id: &str,
        change: &Change,
    ) -> Result<Correction, ClientError> {
        json(self.request(Method::POST, &format!("v1/scenes/{scene_id}/corrections")).json(change))
            .await
    }

    /// Returns the corrections of a scene's current parse, newest first.
    ///
    /// # Errors
    /// [`ClientError`].
    pub async fn corrections(&self, scene_id: &str) -> Result<CorrectionList, ClientError> {
        json(self.request(Method::GET, &format!("v1/scenes/{scene_id}/corrections"))).await
    }

    /// Undoes a correction.
    ///
    /// # Errors
    /// [`ClientError`].
    pub async fn undo_correction(
        &self,
        scene_id: &str,
        id: &str,
    ) -> Result<Correction, ClientError> {
        json(self.request(Method::DELETE, &format!("v1/scenes/{scene_id}/corrections/{id}"))).await
    }

    /// Creates signed links that work without a key for a limited time.
    ///
    /// # Errors
    /// [`ClientError`].
    pub async fn links(&self, request: &LinkRequest) -> Result<LinkList, ClientError> {
        json(self.request(Method::POST, "v1/links").json(request)).await
    }

    /// # Errors
    /// [`ClientError`].
    pub async fn ground(
        &self,
        scene_id: &str,
        request: &GroundRequest,
    ) -> Result<Answer, ClientError> {
        json(self.request(Method::POST, &format!("v1/scenes/{scene_id}/ground")).json(request))
            .await
    }

    /// Finds the scenes that contain an object.
    ///
    /// # Errors
    /// [`ClientError`].
    pub async fn ground_many(
        &self,
        request: &ManyGroundRequest,
    ) -> Result<ManyAnswers, ClientError> {
        json(self.request(Method::POST, "v1/ground").json(request)).await
    }

    /// # Errors
    /// [`ClientError`].
    pub async fn shortlist(
        &self,
        scene_id: &str,
        request: &ShortlistRequest,
    ) -> Result<Shortlisted, ClientError> {
        json(self.request(Method::POST, &format!("v1/scenes/{scene_id}/shortlist")).json(request))
            .await
    }

    /// Submits a list of questions. A repeated idempotency `key` returns the batch that the first
    /// request created.
    ///
    /// # Errors
    /// [`ClientError`].
    pub async fn create_batch(
        &self,
        batch: &BatchRequest,
        key: Option<&str>,
    ) -> Result<Batch, ClientError> {
        let request = self.request(Method::POST, "v1/batches").json(batch);
        json(key.into_iter().fold(request, |request, key| request.header("idempotency-key", key)))
            .await
    }

    /// Submits a list of questions as streamed JSONL, one item per line. `query` holds query
    /// parameters of the API, like `scene_id` and `label`.
    ///
    /// # Errors
    /// [`ClientError`].
    pub async fn create_batch_of_lines(
        &self,
        lines: impl Into<reqwest::Body>,
        query: &[(&str, String)],
        key: Option<&str>,
    ) -> Result<Batch, ClientError> {
        let request = self
            .request(Method::POST, "v1/batches")
            .header("content-type", "application/jsonl")
            .query(query);
        let request =
            key.into_iter().fold(request, |request, key| request.header("idempotency-key", key));
        json(request.body(lines)).await
    }

    /// # Errors
    /// [`ClientError`].
    pub async fn batch(&self, id: &str) -> Result<Batch, ClientError> {
        json(self.request(Method::GET, &format!("v1/batches/{id}"))).await
    }

    /// # Errors
    /// [`ClientError`].
    pub async fn batches(
        &self,
        limit: u32,
        cursor: Option<&str>,
    ) -> Result<BatchList, ClientError> {
        let query = [("limit", Some(limit.to_string())), ("cursor", cursor.map(str::to_owned))];
        json(self.request(Method::GET, "v1/batches").query(&query)).await
    }

    /// Pauses, resumes or cancels a batch. `what` is `pause`, `resume` or `cancel`.
    ///
    /// # Errors
    /// [`ClientError`].
    pub async fn control_batch(&self, id: &str, what: &str) -> Result<Batch, ClientError> {
        json(self.request(Method::POST, &format!("v1/batches/{id}/{what}"))).await
    }

    /// Reads results in item order, starting at item `from`. `follow` waits for unfinished items.
    /// `on_result` gets each line as it was sent, and the parsed result. Returns the item to resume
    /// from.
    ///
    /// # Errors
    /// [`ClientError`], after `on_result` got the results before the error; errors of `on_result`.
    pub async fn batch_results<E: From<ClientError>>(
        &self,
        id: &str,
        from: u32,
        follow: bool,
        mut on_result: impl FnMut(&[u8], BatchResult) -> Result<(), E>,
    ) -> Result<u32, E> {
        let request = self
            .request(Method::GET, &format!("v1/batches/{id}/results"))
            .query(&[("from", from.to_string()), ("follow", follow.to_string())]);
        let response = checked(request.send().await.map_err(ClientError::from)?).await?;
        let (mut chunks, mut buffer, mut next) = (response.bytes_stream(), Vec::new(), from);
        while let Some(chunk) = chunks.next().await {
            buffer.extend_from_slice(&chunk.map_err(ClientError::from)?);
            let mut begin = 0;
            while let Some(length) = buffer[begin..].iter().position(|&byte| byte == b'\n') {
                let line = &buffer[begin..=begin + length];
                let result: BatchResult =
                    serde_json::from_slice(line).map_err(ClientError::from)?;
                next = result.item + 1;
                on_result(line, result)?;
                begin += length + 1;
            }
            buffer.drain(..begin);
        }
        Ok(next)
    }

    /// Returns the results of a batch as a CSV table: those before the first unfinished item.
    ///
    /// # Errors
    /// [`ClientError`].
    pub async fn batch_table(&self, id: &str) -> Result<Vec<u8>, ClientError> {
        let request = self
            .request(Method::GET, &format!("v1/batches/{id}/results"))
            .query(&[("format", "csv")]);
        Ok(checked(request.send().await?).await?.bytes().await?.to_vec())
    }

    /// # Errors
    /// [`ClientError`].
    pub async fn models(&self) -> Result<ModelList, ClientError> {
        json(self.request(Method::GET, "v1/models")).await
    }

    /// Returns statistics of the server: stored data, jobs, spending and disk usage.
    ///
    /// # Errors
    /// [`ClientError`].
    pub async fn stats(&self) -> Result<Stats, ClientError> {
        json(self.request(Method::GET, "v1/stats")).await
    }

    /// Starts a job in which the server's model names the objects of a scene.
    ///
    /// # Errors
    /// [`ClientError`].
    pub async fn name_instances(&self, scene_id: &str) -> Result<Job, ClientError> {
        json(self.request(Method::POST, &format!("v1/scenes/{scene_id}/names"))).await
    }

    /// # Errors
    /// [`ClientError`].
    pub async fn answer_prompt(&self, id: &str) -> Result<AnswerPrompt, ClientError> {
        json(self.request(Method::GET, &format!("v1/answers/{id}/prompt"))).await
    }

    /// # Errors
    /// [`ClientError`].
    pub async fn answer_reply(&self, id: &str) -> Result<AnswerReply, ClientError> {
        json(self.request(Method::GET, &format!("v1/answers/{id}/reply"))).await
    }

    /// # Errors
    /// [`ClientError`].
    pub async fn answer(&self, id: &str) -> Result<Answer, ClientError> {
        json(self.request(Method::GET, &format!("v1/answers/{id}"))).await
    }

    /// # Errors
    /// [`ClientError`].
    pub async fn job(&self, id: &str) -> Result<Job, ClientError> {
        json(self.request(Method::GET, &format!("v1/jobs/{id}"))).await
    }

    /// # Errors
    /// [`ClientError`].
    pub async fn cancel_job(&self, id: &str) -> Result<Job, ClientError> {
        json(self.request(Method::DELETE, &format!("v1/jobs/{id}"))).await
    }

    /// Returns a page of answers, newest first. `query` holds query parameters of the API:
    /// `scene_id`, `batch_id`, `status`, `since`, `until`, `limit`, `cursor`.
    ///
    /// # Errors
    /// [`ClientError`].
    pub async fn answers(&self, query: &[(&str, &str)]) -> Result<AnswerList, ClientError> {
        json(self.request(Method::GET, "v1/answers").query(query)).await
    }

    /// Returns a page of jobs, newest first. `query` holds query parameters of the API: `kind`,
    /// `state`, `subject`, `limit`, `cursor`.
    ///
    /// # Errors
    /// [`ClientError`].
    pub async fn jobs(&self, query: &[(&str, &str)]) -> Result<JobList, ClientError> {
        json(self.request(Method::GET, "v1/jobs").query(query)).await
    }

    /// Creates a key. Only this response contains its secret.
    ///
    /// # Errors
    /// [`ClientError`].
    pub async fn create_key(&self, new: &NewKey) -> Result<CreatedKey, ClientError> {
        json(self.request(Method::POST, "v1/keys").json(new)).await
    }

    /// # Errors
    /// [`ClientError`].
    pub async fn keys(&self, limit: u32, cursor: Option<&str>) -> Result<KeyList, ClientError> {
        let query = [("limit", Some(limit.to_string())), ("cursor", cursor.map(str::to_owned))];
        json(self.request(Method::GET, "v1/keys").query(&query)).await
    }

    /// # Errors
    /// [`ClientError`].
    pub async fn revoke_key(&self, id: &str) -> Result<Key, ClientError> {
        json(self.request(Method::DELETE, &format!("v1/keys/{id}"))).await
    }

    /// Returns a page of the audit log, newest first.
    ///
    /// # Errors
    /// [`ClientError`].
    pub async fn audit(&self, limit: u32, cursor: Option<&str>) -> Result<AuditList, ClientError> {
        let query = [("limit", Some(limit.to_string())), ("cursor", cursor.map(str::to_owned))];
        json(self.request(Method::GET, "v1/audit").query(&query)).await
    }

    /// Follows a job's events until the job is finished. `on_event` gets every state.
    ///
    /// # Errors
    /// [`ClientError`].
    pub async fn follow_job(
        &self,
        id: &str,
        mut on_event: impl FnMut(&Job),
    ) -> Result<Job, ClientError> {
        let response =
            checked(self.request(Method::GET, &format!("v1/jobs/{id}/events")).send().await?)
                .await?;
        let mut chunks = response.bytes_stream();
        let mut buffer = Vec::new();
        while let Some(chunk) = chunks.next().await {
            buffer.extend_from_slice(&chunk?);
            while let Some(end) = buffer.iter().position(|&byte| byte == b'\n') {
                let line: Vec<u8> = buffer.drain(..=end).collect();
                let Some(data) = line.strip_prefix(b"data: ") else { continue };
                let job: Job = serde_json::from_slice(data)?;
                on_event(&job);
                if job.state.is_final() {
                    return Ok(job);
                }
            }
        }
        // The stream ends early when the server stops. Read the job's state once more.
        self.job(id).await
    }

    /// Waits until the latest parse job of a scene is done, and the full parse after a draft. Calls
    /// `on_event` with every progress event of those jobs. Returns the last job; `None` if the scene
    /// was stored without a parse.
    ///
    /// # Errors
    /// [`ClientError`].
    pub async fn follow_parses(
        &self,
        scene_id: &str,
        mut on_event: impl FnMut(&Job),
    ) -> Result<Option<Job>, ClientError> {
        let mut last: Option<Job> = None;
        loop {
            let job_id = self.scene(scene_id).await?.job_id;
            match job_id {
                Some(id) if last.as_ref().is_none_or(|job| job.id != id) => {
                    last = Some(self.follow_job(&id, &mut on_event).await?);
                }
                _ => return Ok(last),
            }
        }
    }

    /// Returns the bytes of a resource, e.g. a picture. `path` is a path from an API response.
    ///
    /// # Errors
    /// [`ClientError`].
    pub async fn bytes(&self, path: &str) -> Result<Vec<u8>, ClientError> {
        let response =
            checked(self.request(Method::GET, path.trim_start_matches('/')).send().await?).await?;
        Ok(response.bytes().await?.to_vec())
    }

    /// Creates a request to a path below the server's address, with the API key.
    pub fn request(&self, method: Method, path: &str) -> RequestBuilder {
        // Joining a relative path does not fail: `new` has checked the base URL.
        let url = self.base.join(path).unwrap_or_else(|_| self.base.clone());
        let request = self.http.request(method, url);
        match &self.api_key {
            Some(key) => request.bearer_auth(key),
            None => request,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_prefix_of_the_address_is_kept() {
        for server in ["http://host/rooms", "http://host/rooms/"] {
            let client = Client::new(server, None).unwrap();
            let request = client.request(Method::GET, "v1/scenes").build().unwrap();
            assert_eq!(request.url().as_str(), "http://host/rooms/v1/scenes");
        }
    }

    #[test]
    fn addresses_of_this_machine_are_recognized() {
        for local in [
            "http://127.0.0.1:8080",
            "http://localhost/v1",
            "http://[::1]:80",
            "http://a.localhost",
            "http://127.9.9.9",
        ] {
            assert!(is_local(local), "{local}");
        }
        for other in
            ["http://10.0.0.1", "https://example.com", "http://localhost.example.com", "nonsense"]
        {
            assert!(!is_local(other), "{other}");
        }
    }
}
