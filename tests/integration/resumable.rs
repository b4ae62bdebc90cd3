//! Uploads in parts, in the words of tus 1.0: what is there stays there, whatever becomes of the
//! sender or the server.

use crate::archives::Scan;
use crate::server::{self, Process, TestServer, blobs, command, finished, location, problem};
use base64::Engine;
use base64::engine::general_purpose::STANDARD;
use camino::Utf8Path;
use reqwest::{Method, Response, StatusCode};
use sha1::Sha1;
use sha2::{Digest, Sha256};
use sqlx::{AssertSqlSafe, Connection};
use std::fs;
use std::time::Duration;
use tokio::io::AsyncWriteExt;
use tokio::net::TcpStream;
use tokio::time::sleep;
use uniground::config::{LimitsConfig, ModelsConfig, VlmConfig};
use uniground_client::Client;
use uniground_service::{Dependencies, RunMode, Services};
use uniground_storage::Store;
use uniground_types::keys::{NewKey, Scope};
use uniground_types::problem::Problem;
use uniground_types::scenes::SceneStatus;
use uniground_types::uploads::{Upload, UploadState};

const PART: &str = "application/offset+octet-stream";

async fn send(
    client: &Client,
    method: Method,
    path: &str,
    headers: &[(&str, &str)],
    body: &[u8],
) -> Response {
    let mut request = client.request(method, path).body(body.to_vec());
    if !headers.iter().any(|(name, _)| *name == "tus-resumable") {
        request = request.header("tus-resumable", "1.0.0");
    }
    for (name, value) in headers {
        request = request.header(*name, *value);
    }
    request.send().await.unwrap()
}

async fn begin(client: &Client, length: usize, headers: &[(&str, &str)]) -> Response {
    let length = length.to_string();
    send(
        client,
        Method::POST,
        "v1/uploads",
        &[headers, &[("upload-length", &length)]].concat(),
        &[],
    )
    .await
}

/// The path of a new upload.
async fn begun(client: &Client, length: usize) -> String {
    let response = begin(client, length, &[]).await;
    assert_eq!(response.status(), 201, "{}", response.text().await.unwrap());
    response.headers()["location"].to_str().unwrap().trim_start_matches('/').to_owned()
}

async fn patch(
    client: &Client,
    upload: &str,
    offset: usize,
    body: &[u8],
    headers: &[(&str, &str)],
) -> Response {
    let offset = offset.to_string();
    let headers = [&[("upload-offset", offset.as_str()), ("content-type", PART)], headers].concat();
    send(client, Method::PATCH, upload, &headers, body).await
}

async fn offset(client: &Client, upload: &str) -> usize {
    let response = send(client, Method::HEAD, upload, &[], &[]).await;
    assert_eq!(
        (response.status(), &response.headers()["cache-control"]),
        (StatusCode::OK, &"no-store".parse().unwrap())
    );
    header(&response, "upload-offset").parse().unwrap()
}

async fn told(client: &Client, upload: &str) -> Upload {
    serde_json::from_slice(&client.bytes(upload).await.unwrap()).unwrap()
}

fn header(response: &Response, name: &str) -> String {
    response.headers()[name].to_str().unwrap().to_owned()
}

async fn refusal(response: Response) -> (u16, String) {
    assert_eq!(
        (header(&response, "tus-resumable"), header(&response, "content-type")),
        ("1.0.0".into(), "application/problem+json".into())
    );
    let status = response.status().as_u16();
    let problem: Problem = response.json().await.unwrap();
    assert_eq!(problem.status, status);
    (status, problem.code)
}

/// Begins to send a part and says nothing more; as long as the stream lives, the server waits.
async fn stalled(
    client: &Client,
    upload: &str,
    offset: usize,
    announced: usize,
    body: &[u8],
) -> TcpStream {
    stalled_with("", client, upload, offset, announced, body).await
}

async fn stalled_with(
    more: &str,
    client: &Client,
    upload: &str,
    offset: usize,
    announced: usize,
    body: &[u8],
) -> TcpStream {
    let url = client.request(Method::GET, "").build().unwrap().url().clone();
    let mut stream =
        TcpStream::connect((url.host_str().unwrap(), url.port().unwrap())).await.unwrap();
    let head = format!(
        "PATCH /{upload} HTTP/1.1\r\nhost: 127.0.0.1\r\ntus-resumable: 1.0.0\r\ncontent-type: {PART}\r\n{more}\
         upload-offset: {offset}\r\ncontent-length: {announced}\r\n\r\n"
    );
    stream.write_all(head.as_bytes()).await.unwrap();
    stream.write_all(body).await.unwrap();
    stream
}

/// Waits until the server has seen what becomes of a connection.
async fn until_offset(client: &Client, upload: &str, wanted: usize) {
    for _ in 0..600 {
        if offset(client, upload).await == wanted {
            return;
        }
        sleep(Duration::from_millis(50)).await;
    }
    panic!("offset {} and not {wanted}", offset(client, upload).await);
}

async fn rows(data: &Utf8Path, sql: &str) {
    let mut rows = server::rows(data).await;
    sqlx::query(AssertSqlSafe(sql.to_owned())).execute(&mut rows).await.unwrap();
    rows.close().await.unwrap();
}

async fn started_on(data: tempfile::TempDir) -> TestServer {
    TestServer::start_on(
        data,
        LimitsConfig::default(),
        VlmConfig::default(),
        ModelsConfig::builtin(),
    )
    .await
}

fn base64(bytes: impl AsRef<[u8]>) -> String {
    STANDARD.encode(bytes)
}

/// The story: parts, one of them lost on the way, the scene at the end, and what may be asked of
/// it.
#[tokio::test]
async fn an_upload_in_parts_becomes_the_scene_a_whole_one_becomes() {
    let server = TestServer::start().await;
    let (client, scan) = (&server.client, Scan::neutral().zip());
    let metadata = format!(
        "filename {},name {},mood {}",
        base64("room.zip"),
        base64("in parts"),
        base64("fine")
    );
    let made = begin(client, scan.len(), &[("upload-metadata", &metadata)]).await;
    assert_eq!(
        (made.status().as_u16(), header(&made, "upload-offset"), header(&made, "tus-resumable")),
        (201, "0".into(), "1.0.0".into())
    );
    assert!(
        header(&made, "upload-expires").ends_with(" GMT"),
        "{}",
        header(&made, "upload-expires")
    );
    let upload = header(&made, "location").trim_start_matches('/').to_owned();
    assert_eq!(made.json::<Upload>().await.unwrap(), told(client, &upload).await);

    let first = patch(client, &upload, 0, &scan[..5000], &[]).await;
    assert_eq!((first.status().as_u16(), header(&first, "upload-offset")), (204, "5000".into()));
    // A sender that leaves: what came is kept.
    drop(stalled(client, &upload, 5000, scan.len() - 5000, &scan[5000..9000]).await);
    until_offset(client, &upload, 9000).await;
    let wrong = patch(client, &upload, 5000, &scan[5000..], &[]).await;
    assert_eq!(header(&wrong, "upload-offset"), "9000");
    assert_eq!(refusal(wrong).await, (409, "upload_offset_wrong".into()));
    let head = send(client, Method::HEAD, &upload, &[], &[]).await;
    assert_eq!(
        (header(&head, "upload-length"), header(&head, "upload-metadata")),
        (scan.len().to_string(), metadata)
    );
    let state = told(client, &upload).await;
    assert_eq!((state.state, state.offset, state.scene_id), (UploadState::Receiving, 9000, None));

    let last = patch(client, &upload, 9000, &scan[9000..], &[]).await;
    assert_eq!(
        (last.status().as_u16(), header(&last, "upload-offset")),
        (204, scan.len().to_string())
    );
    let (scene_id, job_id) =
        (header(&last, "uniground-scene-id"), header(&last, "uniground-job-id"));
    assert_eq!(finished(client, &job_id).await.error, None);
    let scene = client.scene(&scene_id).await.unwrap();
    let whole =
        client.create_scene(Some("in parts"), "application/zip", scan.clone()).await.unwrap().scene;
    assert_eq!(
        (scene.status, &scene.name, &scene.content_hash),
        (SceneStatus::Ready, &whole.name, &whole.content_hash)
    );
    let state = told(client, &upload).await;
    assert_eq!(
        (state.state, state.scene_id.as_ref(), state.job_id.as_ref()),
        (UploadState::Done, Some(&scene_id), Some(&job_id))
    );
    assert_eq!(server.stored("uploads"), [""; 0]);
    // Who did not hear the end asks once more.
    let again = patch(client, &upload, scan.len(), &[], &[]).await;
    assert_eq!(
        (again.status().as_u16(), header(&again, "uniground-scene-id")),
        (204, scene_id.clone())
    );
    assert_eq!(send(client, Method::DELETE, &upload, &[], &[]).await.status(), 204);
    assert_eq!(
        refusal(send(client, Method::DELETE, &upload, &[], &[]).await).await,
        (404, "upload_not_found".into())
    );
    assert!(client.scene(&scene_id).await.is_ok(), "a scene does not go with its upload");
    server.stop().await;
}

/// Its bytes with the first request, only stored, and a name that only its file's ending explains.
#[tokio::test]
async fn a_short_upload_needs_one_request() {
    let server = TestServer::start().await;
    let square = |z: f32| {
        (0..900)
            .map(move |i| format!("{} {} {z}\n", (i % 30) as f32 * 0.05, (i / 30) as f32 * 0.05))
    };
    let lines: String = square(0.0).chain(square(1.0)).collect();
    let length = lines.len().to_string();
    let metadata = format!("parse {},filename {}", base64("true"), base64("points.xyz"));
    let headers = [
        ("upload-length", length.as_str()),
        ("upload-metadata", &metadata),
        ("content-type", PART),
    ];
    let path = "v1/uploads?parse=false&up=z&name=square";
    let made = send(&server.client, Method::POST, path, &headers, lines.as_bytes()).await;
    assert_eq!((made.status().as_u16(), header(&made, "upload-offset")), (201, length));
    let scene = server.client.scene(&header(&made, "uniground-scene-id")).await.unwrap();
    assert_eq!(
        (scene.status, scene.name.as_str(), scene.job_id),
        (SceneStatus::Uploaded, "square", None)
    );
    server.stop().await;
}

#[tokio::test]
async fn a_killed_server_goes_on_where_bytes_are_on_the_disk() {
    let data = tempfile::tempdir().unwrap();
    let data = Utf8Path::from_path(data.path()).unwrap();
    // Large enough that some of it is noted while it comes: a file beside the room that nothing
    // makes smaller.
    let mut state = 1_u64;
    let noise = (0..40 << 20).map(|_| {
        state ^= state << 13;
        state ^= state >> 7;
        state ^= state << 17;
        state as u8
    });
    let scan = Scan::neutral().with("noise.bin", noise.collect::<Vec<_>>()).zip();
    let sent = scan.len() - 1000;
    let server = Process::start(data);
    let upload = begun(&server.client, scan.len()).await;
    assert_eq!(patch(&server.client, &upload, 0, &scan[..3000], &[]).await.status(), 204);
    let under_way =
        stalled(&server.client, &upload, 3000, scan.len() - 3000, &scan[3000..sent]).await;
    for _ in 0..1000 {
        if offset(&server.client, &upload).await > 32 << 20 {
            break;
        }
        sleep(Duration::from_millis(20)).await;
    }
    server.kill();
    drop(under_way);

    let server = Process::start(data);
    let there = offset(&server.client, &upload).await;
    assert!((32 << 20..=sent).contains(&there), "{there}");
    let file = data.join("uploads").join(upload.rsplit('/').next().unwrap());
    assert!(fs::read(file).unwrap().starts_with(&scan[..there]), "an offset claims what is there");
    let last = patch(&server.client, &upload, there, &scan[there..], &[]).await;
    let scene = server.client.scene(&header(&last, "uniground-scene-id")).await.unwrap();
    let hash: String = Sha256::digest(&scan).iter().map(|byte| format!("{byte:02x}")).collect();
    assert_eq!(scene.content_hash, hash);
    assert_eq!(server.terminate(), Some(0));
}

/// A server that is killed before it has noted what came of an upload makes no second scene of it.
#[tokio::test]
async fn an_upload_that_is_finished_twice_is_one_scene() {
    let server = TestServer::start().await;
    let scan = Scan::neutral().zip();
    let upload = begun(&server.client, scan.len()).await;
    let scene_id =
        header(&patch(&server.client, &upload, 0, &scan, &[]).await, "uniground-scene-id");
    let data = server.give_back().await;
    let folder = Utf8Path::from_path(data.path()).unwrap();
    rows(folder, "UPDATE uploads SET scene_id = NULL, job_id = NULL").await;
    fs::write(folder.join("uploads").join(upload.rsplit('/').next().unwrap()), &scan).unwrap();
    let server = started_on(data).await;
    for _ in 0..200 {
        if told(&server.client, &upload).await.state == UploadState::Done {
            break;
        }
        sleep(Duration::from_millis(50)).await;
    }
    assert_eq!(told(&server.client, &upload).await.scene_id.as_ref(), Some(&scene_id));
    let scenes = server.client.scenes(10, None).await.unwrap().scenes;
    assert_eq!(scenes.iter().map(|scene| &scene.id).collect::<Vec<_>>(), [&scene_id]);
    server.stop().await;
}

#[tokio::test]
async fn a_part_with_a_wrong_checksum_is_not_kept() {
    let server = TestServer::start().await;
    let (client, scan) = (&server.client, Scan::neutral().zip());
    let upload = begun(client, scan.len()).await;
    let (sha1, sha256) =
        (base64(Sha1::digest(&scan[..6000])), base64(Sha256::digest(&scan[6000..])));
    let send = async |from: usize, to: usize, checksum: String| {
        patch(client, &upload, from, &scan[from..to], &[("upload-checksum", &checksum)]).await
    };
    assert_eq!(
        refusal(send(0, 5999, format!("sha1 {sha1}")).await).await,
        (460, "checksum_mismatch".into())
    );
    assert_eq!(offset(client, &upload).await, 0);
    assert_eq!(
        refusal(send(0, 6000, format!("md5 {sha1}")).await).await,
        (400, "header_wrong".into())
    );
    assert_eq!(send(0, 6000, format!("sha1 {sha1}")).await.status(), 204);
    let rest = format!("sha256 {sha256}");
    // One that breaks off can not be checked: nothing of it is kept.
    let (length, header_line) = (scan.len(), format!("upload-checksum: {rest}\r\n"));
    drop(stalled_with(&header_line, client, &upload, 6000, length - 6000, &scan[6000..8000]).await);
    let last = loop {
        // Until the server has seen it leave.
        match send(6000, length, rest.clone()).await {
            busy if busy.status() == 423 => sleep(Duration::from_millis(50)).await,
            done => break done,
        }
    };
    assert_eq!((last.status().as_u16(), header(&last, "upload-offset")), (204, length.to_string()));
    server.stop().await;
}

/// One sender stalls, and meanwhile nobody else is let in; it is dropped like any other, and what
/// came of it stays.
#[tokio::test]
async fn a_stalled_sender_is_dropped_and_its_bytes_stay() {
    let server = TestServer::start().await;
    let (client, scan) = (&server.client, Scan::neutral().zip());
    let upload = begun(client, scan.len()).await;
    let stream = stalled(client, &upload, 0, scan.len(), &scan[..7000]).await;
    let second = loop {
        // An empty part, until the server has met the first sender.
        match patch(client, &upload, offset(client, &upload).await, &[], &[]).await {
            first if first.status() == 204 => sleep(Duration::from_millis(10)).await,
            second => break second,
        }
    };
    assert_eq!(header(&second, "retry-after"), "1");
    assert_eq!(refusal(second).await, (423, "upload_busy".into()));
    assert_eq!(
        refusal(send(client, Method::DELETE, &upload, &[], &[]).await).await,
        (423, "upload_busy".into())
    );
    // 20 seconds of silence.
    until_offset(client, &upload, 7000).await;
    let last = loop {
        match patch(client, &upload, 7000, &scan[7000..], &[]).await {
            busy if busy.status() == 423 => sleep(Duration::from_millis(50)).await,
            done => break done,
        }
    };
    drop(stream);
    assert_eq!(
        (last.status().as_u16(), header(&last, "upload-offset")),
        (204, scan.len().to_string())
    );
    server.stop().await;
}

#[tokio::test]
async fn an_upload_that_nobody_goes_on_with_is_removed_and_counted() {
    let server = TestServer::start().await;
    let upload = begun(&server.client, 100_000).await;
    assert_eq!(
        patch(&server.client, &upload, 0, &Scan::neutral().zip()[..6000], &[]).await.status(),
        204
    );
    let data = server.give_back().await;
    let folder = Utf8Path::from_path(data.path()).unwrap();
    // Of January 2020, by id and time.
    const OLD: &str = "016f5e66-e800-7000-8000-000000000001";
    rows(folder, &format!("UPDATE uploads SET id = '{OLD}', updated_at = '2020-01-01T00:00:00Z'"))
        .await;
    let uploads = folder.join("uploads");
    fs::rename(uploads.join(upload.rsplit('/').next().unwrap()), uploads.join(OLD)).unwrap();
    let server = started_on(data).await;
    let old = format!("v1/uploads/{OLD}");
    assert_eq!(send(&server.client, Method::HEAD, &old, &[], &[]).await.status(), 410);
    assert_eq!(
        refusal(patch(&server.client, &old, 6000, b"more", &[]).await).await,
        (410, "upload_expired".into())
    );
    assert_eq!(problem(server.client.bytes(&old).await).code, "upload_expired");
    let data = server.give_back().await;
    let folder = Utf8Path::from_path(data.path()).unwrap();
    let store =
        Store::open(folder, &location(folder), &blobs(folder).blob_home().unwrap()).await.unwrap();
    let limits = LimitsConfig::default().service_limits();
    let services = Services::new(Dependencies::offline(store.clone(), limits).await.unwrap());
    let removed = services.maintenance.apply_retention(RunMode::Offline).await.unwrap();
    let removed = removed.iter().find(|removed| removed.kind == "uploads in parts").unwrap();
    assert_eq!((removed.entries, removed.bytes), (1, 6000));
    store.close().await;
    drop((services, store));
    let server = started_on(data).await;
    assert_eq!(send(&server.client, Method::HEAD, &old, &[], &[]).await.status(), 404);
    assert_eq!(server.stored("uploads"), [""; 0]);
    server.stop().await;
}

/// What is no scan is told to whoever sends the last of it, and to whoever asks.
#[tokio::test]
async fn content_that_is_refused_says_why() {
    let server = TestServer::start().await;
    let client = &server.client;
    let refused = async |upload: &str, response: Response, status: u16, code: &str| {
        let offset = header(&response, "upload-offset");
        let problem: Problem = response.json().await.unwrap();
        assert_eq!((problem.status, problem.code.as_str()), (status, code), "{}", problem.detail);
        let state = told(client, upload).await;
        let same = Problem { request_id: None, ..problem };
        assert_eq!(
            (state.state, state.problem, state.offset.to_string()),
            (UploadState::Refused, Some(same), offset)
        );
        // And so it stays.
        let again = patch(client, upload, state.offset as usize, &[], &[]).await;
        assert_eq!(refusal(again).await, (status, code.to_owned()));
    };
    let broken = Scan::neutral().without("pose/3.txt").zip();
    let upload = begun(client, broken.len()).await;
    assert_eq!(patch(client, &upload, 0, &broken[..5000], &[]).await.status(), 204);
    refused(
        &upload,
        patch(client, &upload, 5000, &broken[5000..], &[]).await,
        422,
        "scene_file_missing",
    )
    .await;
    // A video says so with its first bytes, whatever else was to come.
    let upload = begun(client, 1 << 30).await;
    refused(
        &upload,
        patch(client, &upload, 0, &[b'x'; 5000], &[]).await,
        422,
        "archive_unreadable",
    )
    .await;
    assert_eq!(
        (server.stored("uploads"), server.stored("blobs/contents")),
        (Vec::new(), Vec::new())
    );
    server.stop().await;
}

#[tokio::test]
async fn there_is_an_end_to_what_may_be_announced() {
    let server = TestServer::start_with(LimitsConfig {
        max_upload_bytes: 1 << 50,
        keep_free_bytes: 0,
        ..LimitsConfig::default()
    })
    .await;
    let free = server.client.stats().await.unwrap().disk.free_bytes as usize;
    let upload = begun(&server.client, free / 5 * 3).await;
    // Nothing of it is there, and the room for it is taken.
    assert_eq!(
        refusal(begin(&server.client, free / 5 * 3, &[]).await).await,
        (507, "storage_full".into())
    );
    assert_eq!(send(&server.client, Method::DELETE, &upload, &[], &[]).await.status(), 204);
    begun(&server.client, free / 5 * 3).await;
    server.stop().await;
    let limits = LimitsConfig {
        max_unfinished_uploads: 2,
        max_upload_bytes: 1000,
        ..LimitsConfig::default()
    };
    let server = TestServer::start_with(limits).await;
    assert_eq!(
        refusal(begin(&server.client, 1001, &[]).await).await,
        (413, "upload_too_large".into())
    );
    begun(&server.client, 1000).await;
    begun(&server.client, 1000).await;
    assert_eq!(
        refusal(begin(&server.client, 1000, &[]).await).await,
        (429, "too_many_uploads".into())
    );
    server.stop().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn an_upload_belongs_to_the_key_that_began_it() {
    let server = TestServer::start().await;
    let holder = async |of: &Client, name: &str, scope, max_scenes| {
        let new = NewKey {
            name: name.into(),
            scope,
            expires_at: None,
            requests_per_minute: None,
            max_scenes,
            daily_usd: None,
        };
        Client::new(&server.url(), Some(of.create_key(&new).await.unwrap().secret)).unwrap()
    };
    let admin = holder(&server.client, "admin", Scope::Admin, None).await;
    let (robot, reader) = (
        holder(&admin, "robot", Scope::Write, Some(1)).await,
        holder(&admin, "reader", Scope::Read, None).await,
    );
    let scan = Scan::neutral().zip();
    let upload = begun(&robot, scan.len()).await;
    assert_eq!(patch(&robot, &upload, 0, &scan[..5000], &[]).await.status(), 204);
    // Not even that somebody is at work on it.
    let stream = stalled(&robot, &upload, 5000, 10, &[]).await;
    for method in [Method::HEAD, Method::GET, Method::DELETE] {
        assert_eq!(send(&admin, method.clone(), &upload, &[], &[]).await.status(), 404, "{method}");
    }
    drop(stream);
    assert_eq!(
        refusal(patch(&admin, &upload, 5000, &scan[5000..], &[]).await).await,
        (404, "upload_not_found".into())
    );
    assert_eq!(patch(&reader, &upload, 5000, &scan[5000..], &[]).await.status(), 403);
    // What is coming counts as a scene.
    assert_eq!(refusal(begin(&robot, scan.len(), &[]).await).await, (403, "quota_used_up".into()));
    let last = patch(&robot, &upload, 5000, &scan[5000..], &[]).await;
    finished(&robot, &header(&last, "uniground-job-id")).await;
    assert_eq!(refusal(begin(&robot, scan.len(), &[]).await).await, (403, "quota_used_up".into()));
    server.stop().await;
}

/// What a browser asks before it lets a page of another origin speak tus, and what that page may
/// read then.
#[tokio::test]
async fn pages_of_named_origins_may_upload_in_parts() {
    let data = tempfile::tempdir().unwrap();
    let mut named = command(Utf8Path::from_path(data.path()).unwrap(), "127.0.0.1:0");
    let server = Process::started(named.args(["--cors-origin", "https://robots.example"]));
    let upload = begun(&server.client, 1000).await;
    let origin = ("origin", "https://robots.example");
    let words = "tus-resumable,upload-offset,upload-checksum,content-type,authorization";
    let asking = [
        origin,
        ("access-control-request-method", "PATCH"),
        ("access-control-request-headers", words),
    ];
    let asked = send(&server.client, Method::OPTIONS, &upload, &asking, &[]).await;
    let (methods, headers) = (
        header(&asked, "access-control-allow-methods"),
        header(&asked, "access-control-allow-headers"),
    );
    assert!(
        asked.status().is_success() && methods.contains("PATCH") && methods.contains("HEAD"),
        "{methods}"
    );
    assert!(words.split(',').all(|word| headers.contains(word)), "{headers}");
    let sent = patch(&server.client, &upload, 0, b"PK", &[origin]).await;
    let exposed = header(&sent, "access-control-expose-headers");
    let wanted =
        ["upload-offset", "upload-expires", "location", "tus-resumable", "uniground-scene-id"];
    assert!(sent.status() == 204 && wanted.iter().all(|name| exposed.contains(name)), "{exposed}");
    assert_eq!(server.terminate(), Some(0));
}

#[tokio::test]
async fn words_that_are_not_tus_are_refused() {
    let server = TestServer::start().await;
    let client = &server.client;
    let capabilities = client.request(Method::OPTIONS, "v1/uploads").send().await.unwrap();
    assert_eq!(
        (capabilities.status().as_u16(), header(&capabilities, "tus-version")),
        (204, "1.0.0".into())
    );
    assert_eq!(
        header(&capabilities, "tus-extension"),
        "creation,creation-with-upload,checksum,expiration,termination"
    );
    assert_eq!(
        (header(&capabilities, "tus-checksum-algorithm"), header(&capabilities, "tus-max-size")),
        ("sha1,sha256".into(), (16_u64 << 30).to_string())
    );
    let upload = begun(client, 1000).await;
    let version = [("tus-resumable", "2.0.0")];
    for (method, path) in
        [(Method::POST, "v1/uploads"), (Method::PATCH, &upload), (Method::DELETE, &upload)]
    {
        let refused = send(client, method, path, &version, &[]).await;
        assert_eq!(header(&refused, "tus-version"), "1.0.0");
        assert_eq!(refusal(refused).await, (412, "tus_version_unknown".into()));
    }
    let wrong_metadata = format!("up {}", base64("sideways"));
    for (headers, status, code) in [
        (&[][..], 400, "header_wrong"),
        (&[("upload-length", "-1")], 400, "header_wrong"),
        (&[("upload-defer-length", "1")], 400, "header_wrong"),
        (&[("upload-length", "0")], 422, "invalid_request"),
        (&[("upload-length", "9"), ("upload-metadata", "name not-base64")], 400, "header_wrong"),
        (&[("upload-length", "9"), ("upload-metadata", &wrong_metadata)], 422, "invalid_request"),
    ] {
        assert_eq!(
            refusal(send(client, Method::POST, "v1/uploads", headers, &[]).await).await,
            (status, code.into()),
            "{headers:?}"
        );
    }
    for (headers, status, code) in [
        (
            &[("upload-offset", "0"), ("content-type", "application/zip")][..],
            415,
            "unsupported_media_type",
        ),
        (&[("content-type", PART)], 400, "header_wrong"),
        (&[("content-type", PART), ("upload-offset", "zero")], 400, "header_wrong"),
    ] {
        assert_eq!(
            refusal(send(client, Method::PATCH, &upload, headers, b"x").await).await,
            (status, code.into()),
            "{headers:?}"
        );
    }
    assert_eq!(
        refusal(patch(client, &upload, 0, &[b'P'; 1001], &[]).await).await,
        (413, "upload_too_large".into())
    );
    assert_eq!(
        refusal(patch(client, "v1/uploads/nobody", 0, b"PK", &[]).await).await,
        (404, "upload_not_found".into())
    );
    // A network that lets only POST through.
    let by_post = |method: &'static str| {
        [("x-http-method-override", method), ("content-type", PART), ("upload-offset", "0")]
    };
    let sent = send(client, Method::POST, &upload, &by_post("PATCH"), b"PK").await;
    assert_eq!((sent.status().as_u16(), header(&sent, "upload-offset")), (204, "2".into()));
    assert_eq!(
        refusal(send(client, Method::POST, &upload, &by_post("PUT"), b"PK").await).await,
        (400, "header_wrong".into())
    );
    assert_eq!(send(client, Method::POST, &upload, &by_post("DELETE"), &[]).await.status(), 204);
    server.stop().await;
}
