//! A local server that speaks the protocol of the Hugging Face hub, for one repository.

use axum::Router;
use axum::body::Body;
use axum::extract::{Request, State};
use axum::http::{HeaderMap, StatusCode, header};
use axum::response::{IntoResponse, Response};
use camino::{Utf8Path, Utf8PathBuf};
use serde_json::{Value, json};
use sha1::Sha1;
use sha2::{Digest, Sha256};
use std::collections::BTreeMap;
use std::fs;
use std::net::SocketAddr;
use std::sync::{Arc, Mutex};
use std::time::Duration;
use tokio::net::TcpListener;
use tokio::runtime::Runtime;

/// Two commits of the repository.
pub const FIRST: &str = "1111111111111111111111111111111111111111";
pub const SECOND: &str = "2222222222222222222222222222222222222222";
/// The token that opens a gated repository.
pub const TOKEN: &str = "hf_secret";
/// The repository.
pub const MODEL: &str = "hub:acme/tiny-clip";

/// The behavior of the hub.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub enum Mood {
    #[default]
    Fine,
    /// Large files end in the middle, whatever is asked for.
    BreaksOff,
    /// Large files come in small pieces.
    Slow,
    /// One byte of every large file differs.
    Altered,
    /// Only with a token, and only after consent.
    Gated,
    /// The first request of each kind is refused for two seconds.
    Busy,
    /// The stated sizes of large files are larger than the files.
    WrongSize,
    /// Every request for a file gets an error of the server.
    Down,
    /// Files of a repository have changed without a new commit.
    Rewritten,
}

/// The content and the record of the server.
struct Served {
    mood: Mutex<Mood>,
    files: BTreeMap<String, Vec<u8>>,
    /// Where large files are: another host, as at the hub.
    storage: SocketAddr,
    /// The commit of `main`.
    commit: Mutex<String>,
    /// Path and `Range` of every request.
    requests: Mutex<Vec<(String, Option<String>)>>,
    /// Whether the storage has seen a token.
    has_leaked: Mutex<bool>,
}

impl Served {
    fn is_large(&self, path: &str) -> bool {
        path.contains(".onnx") || self.files.get(path).is_some_and(|bytes| bytes.len() > 1 << 20)
    }

    fn description(&self) -> Value {
        let mood = *self.mood.lock().unwrap();
        let siblings: Vec<Value> = self
            .files
            .iter()
            .map(|(path, bytes)| {
                if self.is_large(path) {
                    let sha256 = match mood {
                        Mood::Rewritten => "0".repeat(64),
                        _ => hex(Sha256::new_with_prefix(bytes)),
                    };
                    let size = bytes.len() + if mood == Mood::WrongSize { 1000 } else { 0 };
                    json!({"rfilename": path, "size": size, "lfs": {"sha256": sha256, "size": size}})
                } else {
                    let blob = [format!("blob {}\0", bytes.len()).as_bytes(), bytes].concat();
                    json!({"rfilename": path, "size": bytes.len(), "blobId": hex(Sha1::new_with_prefix(blob))})
                }
            })
            .collect();
        json!({"sha": *self.commit.lock().unwrap(), "siblings": siblings, "cardData": {"license": "mit"}})
    }
}

fn bytes_of(path: &str, served: &Served, headers: &HeaderMap) -> Response {
    let Some(bytes) = served.files.get(path) else {
        return (StatusCode::NOT_FOUND, [("x-error-code", "EntryNotFound")]).into_response();
    };
    let mut bytes = bytes.clone();
    let mood = *served.mood.lock().unwrap();
    if mood == Mood::Altered && served.is_large(path) {
        bytes[100] ^= 1;
    }
    let range = headers.get(header::RANGE).and_then(|range| range.to_str().ok());
    let from: usize = range
        .and_then(|range| range.strip_prefix("bytes=")?.strip_suffix('-')?.parse().ok())
        .unwrap_or(0);
    let total = bytes.len();
    let mut rest = bytes.split_off(from);
    let length = rest.len();
    let status = if from > 0 { StatusCode::PARTIAL_CONTENT } else { StatusCode::OK };
    let mut response = Response::builder()
        .status(status)
        .header(header::CONTENT_RANGE, format!("bytes {from}-{}/{total}", total.saturating_sub(1)));
    if mood == Mood::BreaksOff && served.is_large(path) {
        rest.truncate(length / 2);
        // A promise of more bytes than come.
        response = response.header(header::CONTENT_LENGTH, length);
        let stream = futures::stream::unfold(Some(rest), |rest| async {
            let Some(rest) = rest else {
                // What was sent arrives first.
                tokio::time::sleep(Duration::from_millis(100)).await;
                return Some((Err(std::io::Error::other("the connection is lost")), None));
            };
            Some((Ok(bytes::Bytes::from(rest)), None))
        });
        return response.body(Body::from_stream(stream)).unwrap();
    }
    if mood == Mood::Slow && served.is_large(path) {
        let pieces: Vec<bytes::Bytes> =
            rest.chunks(1 << 18).map(bytes::Bytes::copy_from_slice).collect();
        let slowly = futures::stream::unfold(pieces.into_iter(), |mut pieces| async {
            tokio::time::sleep(Duration::from_millis(20)).await;
            Some((Ok::<_, std::io::Error>(pieces.next()?), pieces))
        });
        return response.body(Body::from_stream(slowly)).unwrap();
    }
    response.body(Body::from(rest)).unwrap()
}

async fn answer_as_hub(State(served): State<Arc<Served>>, request: Request) -> Response {
    let (path, headers) = (request.uri().path().to_owned(), request.headers().clone());
    let range = headers.get(header::RANGE).map(|r| r.to_str().unwrap().to_owned());
    let is_first = {
        let mut requests = served.requests.lock().unwrap();
        let is_first = !requests.iter().any(|(there, _)| *there == path);
        requests.push((path.clone(), range));
        is_first
    };
    let mood = *served.mood.lock().unwrap();
    if mood == Mood::Busy && is_first {
        return (StatusCode::TOO_MANY_REQUESTS, [(header::RETRY_AFTER, "2")]).into_response();
    }
    let token = headers.get(header::AUTHORIZATION).map(|token| token.to_str().unwrap().to_owned());
    if mood == Mood::Gated && token.as_deref() != Some(format!("Bearer {TOKEN}").as_str()) {
        return (StatusCode::UNAUTHORIZED, [("x-error-code", "GatedRepo")]).into_response();
    }
    let commit = served.commit.lock().unwrap().clone();
    if let Some(revision) = path.strip_prefix("/api/models/acme/tiny-clip/revision/") {
        assert_eq!(request.uri().query(), Some("blobs=true"));
        return match revision {
            "main" | FIRST | SECOND => served.description().to_string().into_response(),
            _ => (StatusCode::NOT_FOUND, [("x-error-code", "RevisionNotFound")]).into_response(),
        };
    }
    if mood == Mood::Down {
        return StatusCode::SERVICE_UNAVAILABLE.into_response();
    }
    let Some(file) = path.strip_prefix(&format!("/acme/tiny-clip/resolve/{commit}/")) else {
        return (StatusCode::NOT_FOUND, [("x-error-code", "RepoNotFound")]).into_response();
    };
    if served.is_large(file) {
        let there = format!("http://{}/{file}?signature=1", served.storage);
        return (StatusCode::FOUND, [(header::LOCATION, there)]).into_response();
    }
    bytes_of(file, &served, &headers)
}

async fn answer_as_storage(State(served): State<Arc<Served>>, request: Request) -> Response {
    if request.headers().contains_key(header::AUTHORIZATION) {
        *served.has_leaked.lock().unwrap() = true;
    }
    bytes_of(request.uri().path().trim_start_matches('/'), &served, request.headers())
}

/// A running hub. It ends when it is dropped.
pub struct LocalHub {
    served: Arc<Served>,
    address: SocketAddr,
    _runtime: Runtime,
}

/// Returns a folder of tiny networks in a layout of the hub.
pub fn layout_folder(layout: &str) -> Utf8PathBuf {
    Utf8Path::new(env!("CARGO_MANIFEST_DIR"))
        .join("crates/uniground-models/tests/data/hub")
        .join(layout)
}

/// Returns the files below a folder, by their paths relative to it.
pub fn files_below(root: &Utf8Path) -> BTreeMap<String, Vec<u8>> {
    let (mut files, mut folders) = (BTreeMap::new(), vec![root.to_owned()]);
    while let Some(folder) = folders.pop() {
        for entry in folder.read_dir_utf8().unwrap() {
            let path = entry.unwrap().into_path();
            if path.is_dir() {
                folders.push(path);
            } else {
                let name = path.strip_prefix(root).unwrap().to_string();
                files.insert(name, fs::read(path).unwrap());
            }
        }
    }
    files
}

pub fn hex(sum: impl Digest) -> String {
    sum.finalize().iter().map(|byte| format!("{byte:02x}")).collect()
}

impl LocalHub {
    pub fn start(layout: &str, mood: Mood) -> Self {
        Self::serve(files_below(&layout_folder(layout)), mood)
    }

    pub fn serve(files: BTreeMap<String, Vec<u8>>, mood: Mood) -> Self {
        let runtime = Runtime::new().unwrap();
        let listen = || runtime.block_on(TcpListener::bind("127.0.0.1:0")).unwrap();
        let (hub, storage) = (listen(), listen());
        let address = hub.local_addr().unwrap();
        let served = Arc::new(Served {
            mood: Mutex::new(mood),
            files,
            storage: storage.local_addr().unwrap(),
            commit: Mutex::new(FIRST.into()),
            requests: Mutex::default(),
            has_leaked: Mutex::default(),
        });
        let router = Router::new().fallback(answer_as_hub).with_state(served.clone());
        runtime.spawn(async move { axum::serve(hub, router).await });
        let router = Router::new().fallback(answer_as_storage).with_state(served.clone());
        runtime.spawn(async move { axum::serve(storage, router).await });
        Self { served, address, _runtime: runtime }
    }

    pub fn endpoint(&self) -> String {
        format!("http://{}/", self.address)
    }

    pub fn files(&self) -> &BTreeMap<String, Vec<u8>> {
        &self.served.files
    }

    pub fn set_mood(&self, mood: Mood) {
        *self.served.mood.lock().unwrap() = mood;
    }

    pub fn set_commit(&self, commit: &str) {
        commit.clone_into(&mut self.served.commit.lock().unwrap());
    }

    /// Returns path and `Range` of the requests since the last call.
    pub fn take_requests(&self) -> Vec<(String, Option<String>)> {
        std::mem::take(&mut self.served.requests.lock().unwrap())
    }

    /// Returns whether the storage, which is another host, has seen a token.
    pub fn has_leaked(&self) -> bool {
        *self.served.has_leaked.lock().unwrap()
    }
}
