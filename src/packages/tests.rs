//! Tests packages with a loopback server that acts as both registries.

use super::*;
use crate::packages::unpack::hex;
use axum::Router;
use axum::extract::State;
use axum::http::{HeaderMap, StatusCode, Uri, header};
use axum::response::{IntoResponse, Response};
use flate2::Compression;
use flate2::write::GzEncoder;
use reqwest::Url;
use serde_json::json;
use sha2::{Digest, Sha256};
use std::fs;
use std::io::Write;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::{Arc, Mutex};
use tokio::runtime::Runtime;
use uniground_core::models::neural::{Role, list};
use zip::write::{SimpleFileOptions, ZipWriter};

const NETWORK: &[u8] = b"layers and layers of a network";
const LICENSE: &[u8] = b"do as you like";
const MANIFEST: &[u8] = b"{}";

/// The behavior of the registries.
#[derive(Debug, Clone, Copy, PartialEq)]
enum ServedContent {
    Json,
    /// Only pages of links, like older mirrors.
    Html,
    /// Archives are truncated.
    BreaksOff,
    /// One byte of an archive differs.
    Altered,
    NotThere,
}

struct Served {
    mood: Mutex<ServedContent>,
    archive: Vec<u8>,
    /// Number of downloads of the archive.
    downloads: AtomicUsize,
}

struct Bench {
    served: Arc<Served>,
    registries: Registries,
    places: Places,
    part: PackagePart,
    _folder: tempfile::TempDir,
    _runtime: Runtime,
}

fn wheel() -> Vec<u8> {
    let mut archive = ZipWriter::new(io::Cursor::new(Vec::new()));
    for (name, bytes) in
        [("lib/network.onnx", NETWORK), ("lib/other", b"not wanted"), ("lib/LICENSE", LICENSE)]
    {
        archive.start_file(name, SimpleFileOptions::default()).unwrap();
        archive.write_all(bytes).unwrap();
    }
    archive.finish().unwrap().into_inner()
}

fn tarball() -> Vec<u8> {
    let mut archive = tar::Builder::new(GzEncoder::new(Vec::new(), Compression::default()));
    for (name, bytes) in
        [("lib/other", &b"not wanted"[..]), ("lib/LICENSE", LICENSE), ("lib/network.onnx", NETWORK)]
    {
        let mut header = tar::Header::new_gnu();
        header.set_size(bytes.len() as u64);
        archive.append_data(&mut header, name, bytes).unwrap();
    }
    archive.into_inner().unwrap().finish().unwrap()
}

/// Hashes for a table of constants, computed while a test runs.
fn sum(bytes: &[u8]) -> &'static str {
    String::leak(hex(Sha256::new_with_prefix(bytes)))
}

async fn answer(State(served): State<Arc<Served>>, uri: Uri, headers: HeaderMap) -> Response {
    let accepts =
        headers.get(header::ACCEPT).map_or("", |value| value.to_str().unwrap()).to_owned();
    let mood = *served.mood.lock().unwrap();
    match uri.path() {
        _ if mood == ServedContent::NotThere => StatusCode::NOT_FOUND.into_response(),
        "/simple/networks/" if mood == ServedContent::Html => {
            let page = r#"<html><a href="../../files/networks-1.0-py3-none-any.whl#sha256=0">networks</a></html>"#;
            ([(header::CONTENT_TYPE, "text/html")], page).into_response()
        }
        "/simple/networks/" => {
            assert!(accepts.starts_with("application/vnd.pypi.simple.v1+json"), "{accepts}");
            let files = json!({"files": [
                {"filename": "networks-0.9-py3-none-any.whl", "url": "/files/old", "hashes": {}},
                {"filename": "networks-1.0-py3-none-any.whl", "url": "../../files/networks-1.0-py3-none-any.whl", "hashes": {}},
            ]});
            ([(header::CONTENT_TYPE, "application/vnd.pypi.simple.v1+json")], files.to_string())
                .into_response()
        }
        "/npm/@scope%2Fnetworks" => {
            assert!(accepts.starts_with("application/vnd.npm.install-v1+json"), "{accepts}");
            let tarball = format!(
                "http://{}/files/networks-1.0.tgz",
                headers[header::HOST].to_str().unwrap()
            );
            let versions = json!({"versions": {"0.9": {"dist": {"tarball": "/files/old"}}, "1.0": {"dist": {"tarball": tarball}}}});
            ([(header::CONTENT_TYPE, "application/json")], versions.to_string()).into_response()
        }
        // Registries often host archives elsewhere.
        "/files/networks-1.0-py3-none-any.whl" | "/files/networks-1.0.tgz" => {
            (StatusCode::FOUND, [(header::LOCATION, "/elsewhere/archive")]).into_response()
        }
        "/elsewhere/archive" => {
            served.downloads.fetch_add(1, Ordering::Relaxed);
            let mut bytes = served.archive.clone();
            match mood {
                ServedContent::BreaksOff => bytes.truncate(bytes.len() / 2),
                ServedContent::Altered => bytes[10] ^= 1,
                _ => {}
            }
            bytes.into_response()
        }
        path => panic!("nobody should ask for {path}"),
    }
}

impl Bench {
    fn new(source: Source, mood: ServedContent) -> Self {
        let (bytes, name, archive) = match source {
            Source::PyPi => (wheel(), "networks", "networks-1.0-py3-none-any.whl"),
            Source::Npm => (tarball(), "@scope/networks", "networks-1.0.tgz"),
        };
        let package = Package {
            source,
            name,
            version: "1.0",
            archive,
            sha256: sum(&bytes),
            bytes: bytes.len() as u64,
        };
        let files = vec![
            PackagedFile { inside: "lib/network.onnx", name: "network.onnx", sha256: sum(NETWORK) },
            PackagedFile { inside: "lib/LICENSE", name: "LICENSE", sha256: sum(LICENSE) },
        ];
        let part = PackagePart {
            name: "test",
            what: "",
            licence: "",
            home: InstallTarget::Bundle("test-bundle", Role::Encoder),
            builds: vec![Build { system: None, package, files: files.leak() }].leak(),
            carried: &[CarriedFile { name: "model.json", bytes: MANIFEST }],
        };
        let served = Arc::new(Served {
            mood: Mutex::new(mood),
            archive: bytes,
            downloads: AtomicUsize::new(0),
        });
        let runtime = Runtime::new().unwrap();
        let listener = runtime.block_on(tokio::net::TcpListener::bind("127.0.0.1:0")).unwrap();
        let address = listener.local_addr().unwrap();
        let router = Router::new().fallback(answer).with_state(served.clone());
        runtime.spawn(async move { axum::serve(listener, router).await });
        let registry = |path: &str| Registry {
            base: Url::parse(&format!("http://{address}/{path}")).unwrap(),
            remedy: "Try another registry.".into(),
        };
        let registries = Registries { pypi: registry("simple"), npm: registry("npm/") };
        let folder = tempfile::tempdir().unwrap();
        let models = Utf8PathBuf::from_path_buf(folder.path().join("models")).unwrap();
        let places = Places { library: models.join("library"), models };
        Self { served, registries, places, part, _folder: folder, _runtime: runtime }
    }

    fn fetch(&self) -> Result<(), FetchError> {
        fetch(&self.part, &self.places, &self.registries, &mut |_| {})
    }

    fn file(&self, name: &str) -> Utf8PathBuf {
        self.part.folder(&self.places).join(name)
    }

    /// Returns the names of the files in the part's folder.
    fn placed(&self) -> Vec<String> {
        let entries = self.part.folder(&self.places).read_dir_utf8().unwrap();
        let mut names: Vec<String> =
            entries.map(|entry| entry.unwrap().file_name().to_owned()).collect();
        names.sort();
        names
    }

    fn downloads(&self) -> usize {
        self.served.downloads.load(Ordering::Relaxed)
    }
}

/// From index to file, for each kind of registry. A second fetch downloads nothing, and replaces
/// files that were damaged in between.
#[test]
fn a_part_is_installed_once() {
    for (source, mood) in [
        (Source::PyPi, ServedContent::Json),
        (Source::PyPi, ServedContent::Html),
        (Source::Npm, ServedContent::Json),
    ] {
        let bench = Bench::new(source, mood);
        bench.fetch().unwrap();
        assert_eq!(
            bench.placed(),
            ["LICENSE", "model.json", "network.onnx"],
            "{source:?} {mood:?}"
        );
        assert_eq!(fs::read(bench.file("network.onnx")).unwrap(), NETWORK);
        bench.fetch().unwrap();
        fs::remove_file(bench.file("model.json")).unwrap();
        bench.fetch().unwrap();
        assert_eq!(
            (bench.downloads(), fs::read(bench.file("model.json")).unwrap().as_slice()),
            (1, MANIFEST)
        );
        fs::write(bench.file("network.onnx"), b"damaged").unwrap();
        bench.fetch().unwrap();
        assert_eq!(
            (bench.downloads(), fs::read(bench.file("network.onnx")).unwrap().as_slice()),
            (2, NETWORK)
        );
    }
}

/// A failed fetch leaves no files, and the message names the package and what to do.
#[test]
fn files_with_a_wrong_hash_are_not_installed() {
    for (mood, expected) in [
        (ServedContent::Altered, "networks 1.0: the archive has the SHA-256"),
        (ServedContent::BreaksOff, "networks 1.0: the archive is not"),
        (
            ServedContent::NotThere,
            "does not have networks-1.0-py3-none-any.whl. Try another registry.",
        ),
    ] {
        let bench = Bench::new(Source::PyPi, mood);
        let error = bench.fetch().unwrap_err().to_string();
        assert!(error.contains(expected), "{mood:?}: {error}");
        assert!(bench.placed().is_empty(), "{mood:?}: {:?}", bench.placed());
        // The next attempt succeeds.
        *bench.served.mood.lock().unwrap() = ServedContent::Json;
        bench.fetch().unwrap();
        assert_eq!(bench.placed().len(), 3);
    }
}

/// An intact archive with a different or missing file.
#[test]
fn every_file_has_its_own_hash() {
    for source in [Source::PyPi, Source::Npm] {
        for (inside, expected) in
            [("lib/other", "network.onnx has the SHA-256"), ("lib/nowhere", "lib/nowhere")]
        {
            let mut bench = Bench::new(source, ServedContent::Json);
            let Build { package, .. } = bench.part.builds[0].clone();
            let files = vec![PackagedFile { inside, name: "network.onnx", sha256: sum(NETWORK) }];
            bench.part.builds = vec![Build { system: None, package, files: files.leak() }].leak();
            let error = bench.fetch().unwrap_err().to_string();
            assert!(error.contains(expected) && error.contains("networks 1.0"), "{error}");
            assert!(bench.placed().is_empty(), "{:?}", bench.placed());
        }
    }
}

#[test]
fn an_unreachable_registry_is_reported_with_advice() {
    let mut bench = Bench::new(Source::PyPi, ServedContent::Json);
    // A port without a listener.
    let gone = std::net::TcpListener::bind("127.0.0.1:0").unwrap().local_addr().unwrap();
    bench.registries.pypi.base = Url::parse(&format!("http://me:secret@{gone}/simple")).unwrap();
    let error = bench.fetch().unwrap_err().to_string();
    assert!(
        error.contains(&format!("networks 1.0: http://{gone}/simple cannot be reached")),
        "{error}"
    );
    assert!(error.contains("Try another registry.") && !error.contains("secret"), "{error}");
}

/// Downloaded and included files together form complete bundles.
#[test]
fn bundles_are_complete() {
    let folder = tempfile::tempdir().unwrap();
    let models = Utf8PathBuf::from_path_buf(folder.path().to_owned()).unwrap();
    let places = Places { library: models.join("library"), models: models.clone() };
    let mut bundles = Vec::new();
    for part in PARTS.iter().filter(|part| part.home != InstallTarget::Library) {
        let place = part.folder(&places);
        fs::create_dir_all(&place).unwrap();
        part.carried.iter().for_each(|file| fs::write(place.join(file.name), file.bytes).unwrap());
        part.build()
            .unwrap()
            .files
            .iter()
            .for_each(|file| fs::write(place.join(file.name), b"").unwrap());
        assert_eq!(
            part.carried.last().map(|file| file.name),
            Some("model.json"),
            "{}: a manifest comes last",
            part.name
        );
        bundles.push(place.file_name().unwrap().to_owned());
    }
    bundles.sort();
    let listed = list(&models).unwrap();
    assert!(listed.iter().all(|bundle| bundle.problem.is_none()), "{listed:?}");
    let is_listed = |home: &InstallTarget| {
        listed
            .iter()
            .any(|bundle| matches!(home, InstallTarget::Bundle(name, role) if *name == bundle.name && Some(*role) == bundle.role))
    };
    assert!(
        PARTS.iter().all(|part| part.home == InstallTarget::Library || is_listed(&part.home)),
        "{listed:?}"
    );
    assert_eq!(
        listed.iter().map(|bundle| bundle.name.as_str()).collect::<Vec<_>>(),
        bundles,
        "a bundle is called as its folder is"
    );
}
