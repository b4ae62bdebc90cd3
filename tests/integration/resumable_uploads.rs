//! Resumable uploads by the protocol tus 1.0: received bytes survive a lost sender and a killed
//! server.

use crate::test_scans::Scan;
use crate::test_server::{
    self, Process, TestServer, blobs_config, database_location, expect_problem, serve_command,
    wait_for_job,
};
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

async fn send_request(
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

async fn create_upload(client: &Client, length: usize, headers: &[(&str, &str)]) -> Response {
    let length = length.to_string();
    send_request(
        client,
        Method::POST,
        "v1/uploads",
        &[headers, &[("upload-length", &length)]].concat(),
        &[],
    )
    .await
}

/// Creates an upload and returns its path.
async fn create_upload_path(client: &Client, length: usize) -> String {
    let response = create_upload(client, length, &[]).await;
    assert_eq!(response.status(), 201, "{}", response.text().await.unwrap());
    response.headers()["location"].to_str().unwrap().trim_start_matches('/').to_owned()
}

async fn send_part(
    client: &Client,
    upload: &str,
    offset: usize,
    body: &[u8],
    headers: &[(&str, &str)],
) -> Response {
    let offset = offset.to_string();
    let headers = [&[("upload-offset", offset.as_str()), ("content-type", PART)], headers].concat();
    send_request(client, Method::PATCH, upload, &headers, body).await
}

async fn fetch_offset(client: &Client, upload: &str) -> usize {
    let response = send_request(client, Method::HEAD, upload, &[], &[]).await;
    assert_eq!(
        (response.status(), &response.headers()["cache-control"]),
        (StatusCode::OK, &"no-store".parse().unwrap())
    );
    header_text(&response, "upload-offset").parse().unwrap()
}

async fn fetch_upload(client: &Client, upload: &str) -> Upload {
    serde_json::from_slice(&client.bytes(upload).await.unwrap()).unwrap()
}

fn header_text(response: &Response, name: &str) -> String {
    response.headers()[name].to_str().unwrap().to_owned()
}

async fn read_problem(response: Response) -> (u16, String) {
    assert_eq!(
        (header_text(&response, "tus-resumable"), header_text(&response, "content-type")),
        ("1.0.0".into(), "application/problem+json".into())
    );
    let status = response.status().as_u16();
    let problem: Problem = response.json().await.unwrap();
    assert_eq!(problem.status, status);
    (status, problem.code)
}

/// Starts to send a part and stalls. The server waits as long as the stream lives.
async fn start_stalled_part(
    client: &Client,
    upload: &str,
    offset: usize,
    announced: usize,
    body: &[u8],
) -> TcpStream {
    start_stalled_part_with("", client, upload, offset, announced, body).await
}

async fn start_stalled_part_with(
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

/// Waits until the server has noticed the end of a connection.
async fn wait_for_offset(client: &Client, upload: &str, wanted: usize) {
    for _ in 0..600 {
        if fetch_offset(client, upload).await == wanted {
            return;
        }
        sleep(Duration::from_millis(50)).await;
    }
    panic!("offset {} and not {wanted}", fetch_offset(client, upload).await);
}

async fn execute_sql(data: &Utf8Path, sql: &str) {
    let mut rows = test_server::open_database(data).await;
    sqlx::query(AssertSqlSafe(sql.to_owned())).execute(&mut rows).await.unwrap();
    rows.close().await.unwrap();
}

async fn start_on(data: tempfile::TempDir) -> TestServer {
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

/// The whole sequence: parts, one of them interrupted, the scene at the end, and the upload's
/// state.
#[tokio::test]
async fn an_upload_in_parts_gives_the_same_scene_as_a_single_request() {
    let server = TestServer::start().await;
    let (client, scan) = (&server.client, Scan::neutral().zip());
    let metadata = format!(
        "filename {},name {},mood {}",
        base64("room.zip"),
        base64("in parts"),
        base64("fine")
    );
    let made = create_upload(client, scan.len(), &[("upload-metadata", &metadata)]).await;
    assert_eq!(
        (
            made.status().as_u16(),
            header_text(&made, "upload-offset"),
            header_text(&made, "tus-resumable")
        ),
        (201, "0".into(), "1.0.0".into())
    );
    assert!(
        header_text(&made, "upload-expires").ends_with(" GMT"),
        "{}",
        header_text(&made, "upload-expires")
    );
    let upload = header_text(&made, "location").trim_start_matches('/').to_owned();
    assert_eq!(made.json::<Upload>().await.unwrap(), fetch_upload(client, &upload).await);

    let first = send_part(client, &upload, 0, &scan[..5000], &[]).await;
    assert_eq!(
        (first.status().as_u16(), header_text(&first, "upload-offset")),
        (204, "5000".into())
    );
    // The sender disconnects: the received bytes are stored.
    drop(start_stalled_part(client, &upload, 5000, scan.len() - 5000, &scan[5000..9000]).await);
    wait_for_offset(client, &upload, 9000).await;
    let wrong = send_part(client, &upload, 5000, &scan[5000..], &[]).await;
    assert_eq!(header_text(&wrong, "upload-offset"), "9000");
    assert_eq!(read_problem(wrong).await, (409, "upload_offset_wrong".into()));
    let head = send_request(client, Method::HEAD, &upload, &[], &[]).await;
    assert_eq!(
        (header_text(&head, "upload-length"), header_text(&head, "upload-metadata")),
        (scan.len().to_string(), metadata)
    );
    let state = fetch_upload(client, &upload).await;
    assert_eq!((state.state, state.offset, state.scene_id), (UploadState::Receiving, 9000, None));

    let last = send_part(client, &upload, 9000, &scan[9000..], &[]).await;
    assert_eq!(
        (last.status().as_u16(), header_text(&last, "upload-offset")),
        (204, scan.len().to_string())
    );
    let (scene_id, job_id) =
        (header_text(&last, "uniground-scene-id"), header_text(&last, "uniground-job-id"));
    assert_eq!(wait_for_job(client, &job_id).await.error, None);
    let scene = client.scene(&scene_id).await.unwrap();
    let whole =
        client.create_scene(Some("in parts"), "application/zip", scan.clone()).await.unwrap().scene;
    assert_eq!(
        (scene.status, &scene.name, &scene.content_hash),
        (SceneStatus::Ready, &whole.name, &whole.content_hash)
    );
    let state = fetch_upload(client, &upload).await;
    assert_eq!(
        (state.state, state.scene_id.as_ref(), state.job_id.as_ref()),
        (UploadState::Done, Some(&scene_id), Some(&job_id))
    );
    assert_eq!(server.list_folder("uploads"), [""; 0]);
    // A client that missed the last response repeats the request.
    let again = send_part(client, &upload, scan.len(), &[], &[]).await;
    assert_eq!(
        (again.status().as_u16(), header_text(&again, "uniground-scene-id")),
        (204, scene_id.clone())
    );
    assert_eq!(send_request(client, Method::DELETE, &upload, &[], &[]).await.status(), 204);
    assert_eq!(
        read_problem(send_request(client, Method::DELETE, &upload, &[], &[]).await).await,
        (404, "upload_not_found".into())
    );
    assert!(client.scene(&scene_id).await.is_ok(), "deleting an upload must not delete its scene");
    server.stop().await;
}

/// All bytes come with the first request, as a stored zip entry, and only the file name's extension
/// tells the format.
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
    let made = send_request(&server.client, Method::POST, path, &headers, lines.as_bytes()).await;
    assert_eq!((made.status().as_u16(), header_text(&made, "upload-offset")), (201, length));
    let scene = server.client.scene(&header_text(&made, "uniground-scene-id")).await.unwrap();
    assert_eq!(
        (scene.status, scene.name.as_str(), scene.job_id),
        (SceneStatus::Uploaded, "square", None)
    );
    server.stop().await;
}

#[tokio::test]
async fn an_upload_resumes_at_the_stored_offset_after_a_kill() {
    let data = tempfile::tempdir().unwrap();
    let data = Utf8Path::from_path(data.path()).unwrap();
    // Large enough that offsets are saved during the transfer: an incompressible file next to the
    // room.
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
    let upload = create_upload_path(&server.client, scan.len()).await;
    assert_eq!(send_part(&server.client, &upload, 0, &scan[..3000], &[]).await.status(), 204);
    let under_way =
        start_stalled_part(&server.client, &upload, 3000, scan.len() - 3000, &scan[3000..sent])
            .await;
    for _ in 0..1000 {
        if fetch_offset(&server.client, &upload).await > 32 << 20 {
            break;
        }
        sleep(Duration::from_millis(20)).await;
    }
    server.kill();
    drop(under_way);

    let server = Process::start(data);
    let there = fetch_offset(&server.client, &upload).await;
    assert!((32 << 20..=sent).contains(&there), "{there}");
    let file = data.join("uploads").join(upload.rsplit('/').next().unwrap());
    assert!(
        fs::read(file).unwrap().starts_with(&scan[..there]),
        "the stored bytes differ from the sent ones"
    );
    let last = send_part(&server.client, &upload, there, &scan[there..], &[]).await;
    let scene = server.client.scene(&header_text(&last, "uniground-scene-id")).await.unwrap();
    let hash: String = Sha256::digest(&scan).iter().map(|byte| format!("{byte:02x}")).collect();
    assert_eq!(scene.content_hash, hash);
    assert_eq!(server.terminate(), Some(0));
}

/// A server that is killed before it records the result of an upload does not create a second
/// scene.
#[tokio::test]
async fn an_upload_completed_twice_creates_one_scene() {
    let server = TestServer::start().await;
    let scan = Scan::neutral().zip();
    let upload = create_upload_path(&server.client, scan.len()).await;
    let scene_id =
        header_text(&send_part(&server.client, &upload, 0, &scan, &[]).await, "uniground-scene-id");
    let data = server.stop_and_keep_data().await;
    let folder = Utf8Path::from_path(data.path()).unwrap();
    execute_sql(folder, "UPDATE uploads SET scene_id = NULL, job_id = NULL").await;
    fs::write(folder.join("uploads").join(upload.rsplit('/').next().unwrap()), &scan).unwrap();
    let server = start_on(data).await;
    for _ in 0..200 {
        if fetch_upload(&server.client, &upload).await.state == UploadState::Done {
            break;
        }
        sleep(Duration::from_millis(50)).await;
    }
    assert_eq!(fetch_upload(&server.client, &upload).await.scene_id.as_ref(), Some(&scene_id));
    let scenes = server.client.scenes(10, None).await.unwrap().scenes;
    assert_eq!(scenes.iter().map(|scene| &scene.id).collect::<Vec<_>>(), [&scene_id]);
    server.stop().await;
}

#[tokio::test]
async fn a_part_with_a_wrong_checksum_is_discarded() {
    let server = TestServer::start().await;
    let (client, scan) = (&server.client, Scan::neutral().zip());
    let upload = create_upload_path(client, scan.len()).await;
    let (sha1, sha256) =
        (base64(Sha1::digest(&scan[..6000])), base64(Sha256::digest(&scan[6000..])));
    let send_bytes = async |from: usize, to: usize, checksum: String| {
        send_part(client, &upload, from, &scan[from..to], &[("upload-checksum", &checksum)]).await
    };
    assert_eq!(
        read_problem(send_bytes(0, 5999, format!("sha1 {sha1}")).await).await,
        (460, "checksum_mismatch".into())
    );
    assert_eq!(fetch_offset(client, &upload).await, 0);
    assert_eq!(
        read_problem(send_bytes(0, 6000, format!("md5 {sha1}")).await).await,
        (400, "header_wrong".into())
    );
    assert_eq!(send_bytes(0, 6000, format!("sha1 {sha1}")).await.status(), 204);
    let rest = format!("sha256 {sha256}");
    // A part that is cut off cannot be verified: nothing of it is stored.
    let (length, header_line) = (scan.len(), format!("upload-checksum: {rest}\r\n"));
    drop(
        start_stalled_part_with(
            &header_line,
            client,
            &upload,
            6000,
            length - 6000,
            &scan[6000..8000],
        )
        .await,
    );
    let last = loop {
        // Wait until the server has noticed the disconnect.
        match send_bytes(6000, length, rest.clone()).await {
            busy if busy.status() == 423 => sleep(Duration::from_millis(50)).await,
            done => break done,
        }
    };
    assert_eq!(
        (last.status().as_u16(), header_text(&last, "upload-offset")),
        (204, length.to_string())
    );
    server.stop().await;
}

/// A stalled sender holds the upload for a limited time; then it is disconnected and its bytes
/// stay.
#[tokio::test]
async fn a_stalled_sender_is_disconnected_and_its_bytes_are_stored() {
    let server = TestServer::start().await;
    let (client, scan) = (&server.client, Scan::neutral().zip());
    let upload = create_upload_path(client, scan.len()).await;
    let stream = start_stalled_part(client, &upload, 0, scan.len(), &scan[..7000]).await;
    let second = loop {
        // Send empty parts until the server has accepted the first sender.
        match send_part(client, &upload, fetch_offset(client, &upload).await, &[], &[]).await {
            first if first.status() == 204 => sleep(Duration::from_millis(10)).await,
            second => break second,
        }
    };
    assert_eq!(header_text(&second, "retry-after"), "1");
    assert_eq!(read_problem(second).await, (423, "upload_busy".into()));
    assert_eq!(
        read_problem(send_request(client, Method::DELETE, &upload, &[], &[]).await).await,
        (423, "upload_busy".into())
    );
    // After 20 seconds of silence.
    wait_for_offset(client, &upload, 7000).await;
    let last = loop {
        match send_part(client, &upload, 7000, &scan[7000..], &[]).await {
            busy if busy.status() == 423 => sleep(Duration::from_millis(50)).await,
            done => break done,
        }
    };
    drop(stream);
    assert_eq!(
        (last.status().as_u16(), header_text(&last, "upload-offset")),
        (204, scan.len().to_string())
    );
    server.stop().await;
}

#[tokio::test]
async fn an_abandoned_upload_is_removed_and_counted() {
    let server = TestServer::start().await;
    let upload = create_upload_path(&server.client, 100_000).await;
    assert_eq!(
        send_part(&server.client, &upload, 0, &Scan::neutral().zip()[..6000], &[]).await.status(),
        204
    );
    let data = server.stop_and_keep_data().await;
    let folder = Utf8Path::from_path(data.path()).unwrap();
    // Dated January 2020, by id and time.
    const OLD: &str = "016f5e66-e800-7000-8000-000000000001";
    execute_sql(
        folder,
        &format!("UPDATE uploads SET id = '{OLD}', updated_at = '2020-01-01T00:00:00Z'"),
    )
    .await;
    let uploads = folder.join("uploads");
    fs::rename(uploads.join(upload.rsplit('/').next().unwrap()), uploads.join(OLD)).unwrap();
    let server = start_on(data).await;
    let old = format!("v1/uploads/{OLD}");
    assert_eq!(send_request(&server.client, Method::HEAD, &old, &[], &[]).await.status(), 410);
    assert_eq!(
        read_problem(send_part(&server.client, &old, 6000, b"more", &[]).await).await,
        (410, "upload_expired".into())
    );
    assert_eq!(expect_problem(server.client.bytes(&old).await).code, "upload_expired");
    let data = server.stop_and_keep_data().await;
    let folder = Utf8Path::from_path(data.path()).unwrap();
    let store =
        Store::open(folder, &database_location(folder), &blobs_config(folder).blob_home().unwrap())
            .await
            .unwrap();
    let limits = LimitsConfig::default().service_limits();
    let services = Services::new(Dependencies::offline(store.clone(), limits).await.unwrap());
    let removed = services.maintenance.apply_retention(RunMode::Offline).await.unwrap();
    let removed = removed.iter().find(|removed| removed.kind == "uploads in parts").unwrap();
    assert_eq!((removed.entries, removed.bytes), (1, 6000));
    store.close().await;
    drop((services, store));
    let server = start_on(data).await;
    assert_eq!(send_request(&server.client, Method::HEAD, &old, &[], &[]).await.status(), 404);
    assert_eq!(server.list_folder("uploads"), [""; 0]);
    server.stop().await;
}

/// Invalid content is reported to the sender of the last part and in the upload's state.
#[tokio::test]
async fn refused_content_is_reported_with_a_reason() {
    let server = TestServer::start().await;
    let client = &server.client;
    let refused = async |upload: &str, response: Response, status: u16, code: &str| {
        let offset = header_text(&response, "upload-offset");
        let problem: Problem = response.json().await.unwrap();
        assert_eq!((problem.status, problem.code.as_str()), (status, code), "{}", problem.detail);
        let state = fetch_upload(client, upload).await;
        let same = Problem { request_id: None, ..problem };
        assert_eq!(
            (state.state, state.problem, state.offset.to_string()),
            (UploadState::Refused, Some(same), offset)
        );
        // The state does not change afterwards.
        let again = send_part(client, upload, state.offset as usize, &[], &[]).await;
        assert_eq!(read_problem(again).await, (status, code.to_owned()));
    };
    let broken = Scan::neutral().without("pose/3.txt").zip();
    let upload = create_upload_path(client, broken.len()).await;
    assert_eq!(send_part(client, &upload, 0, &broken[..5000], &[]).await.status(), 204);
    refused(
        &upload,
        send_part(client, &upload, 5000, &broken[5000..], &[]).await,
        422,
        "scene_file_missing",
    )
    .await;
    // A video is recognized by its first bytes, before the rest arrives.
    let upload = create_upload_path(client, 1 << 30).await;
    refused(
        &upload,
        send_part(client, &upload, 0, &[b'x'; 5000], &[]).await,
        422,
        "archive_unreadable",
    )
    .await;
    assert_eq!(
        (server.list_folder("uploads"), server.list_folder("blobs/contents")),
        (Vec::new(), Vec::new())
    );
    server.stop().await;
}

#[tokio::test]
async fn announced_lengths_are_limited() {
    let server = TestServer::start_with(LimitsConfig {
        max_upload_bytes: 1 << 50,
        keep_free_bytes: 0,
        ..LimitsConfig::default()
    })
    .await;
    let free = server.client.stats().await.unwrap().disk.free_bytes as usize;
    let upload = create_upload_path(&server.client, free / 5 * 3).await;
    // Nothing has been sent yet, but the space is reserved.
    assert_eq!(
        read_problem(create_upload(&server.client, free / 5 * 3, &[]).await).await,
        (507, "storage_full".into())
    );
    assert_eq!(send_request(&server.client, Method::DELETE, &upload, &[], &[]).await.status(), 204);
    create_upload_path(&server.client, free / 5 * 3).await;
    server.stop().await;
    let limits = LimitsConfig {
        max_unfinished_uploads: 2,
        max_upload_bytes: 1000,
        ..LimitsConfig::default()
    };
    let server = TestServer::start_with(limits).await;
    assert_eq!(
        read_problem(create_upload(&server.client, 1001, &[]).await).await,
        (413, "upload_too_large".into())
    );
    create_upload_path(&server.client, 1000).await;
    create_upload_path(&server.client, 1000).await;
    assert_eq!(
        read_problem(create_upload(&server.client, 1000, &[]).await).await,
        (429, "too_many_uploads".into())
    );
    server.stop().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn an_upload_belongs_to_the_key_that_created_it() {
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
    let upload = create_upload_path(&robot, scan.len()).await;
    assert_eq!(send_part(&robot, &upload, 0, &scan[..5000], &[]).await.status(), 204);
    // Another key cannot even see that the upload is in use.
    let stream = start_stalled_part(&robot, &upload, 5000, 10, &[]).await;
    for method in [Method::HEAD, Method::GET, Method::DELETE] {
        assert_eq!(
            send_request(&admin, method.clone(), &upload, &[], &[]).await.status(),
            404,
            "{method}"
        );
    }
    drop(stream);
    assert_eq!(
        read_problem(send_part(&admin, &upload, 5000, &scan[5000..], &[]).await).await,
        (404, "upload_not_found".into())
    );
    assert_eq!(send_part(&reader, &upload, 5000, &scan[5000..], &[]).await.status(), 403);
    // An unfinished upload counts as a scene.
    assert_eq!(
        read_problem(create_upload(&robot, scan.len(), &[]).await).await,
        (403, "quota_used_up".into())
    );
    let last = send_part(&robot, &upload, 5000, &scan[5000..], &[]).await;
    wait_for_job(&robot, &header_text(&last, "uniground-job-id")).await;
    assert_eq!(
        read_problem(create_upload(&robot, scan.len(), &[]).await).await,
        (403, "quota_used_up".into())
    );
    server.stop().await;
}

/// The CORS preflight of a browser for tus requests, and the headers that a page may read.
#[tokio::test]
async fn allowed_origins_can_upload_in_parts() {
    let data = tempfile::tempdir().unwrap();
    let mut named = serve_command(Utf8Path::from_path(data.path()).unwrap(), "127.0.0.1:0");
    let server = Process::spawn(named.args(["--cors-origin", "https://robots.example"]));
    let upload = create_upload_path(&server.client, 1000).await;
    let origin = ("origin", "https://robots.example");
    let words = "tus-resumable,upload-offset,upload-checksum,content-type,authorization";
    let asking = [
        origin,
        ("access-control-request-method", "PATCH"),
        ("access-control-request-headers", words),
    ];
    let asked = send_request(&server.client, Method::OPTIONS, &upload, &asking, &[]).await;
    let (methods, headers) = (
        header_text(&asked, "access-control-allow-methods"),
        header_text(&asked, "access-control-allow-headers"),
    );
    assert!(
        asked.status().is_success() && methods.contains("PATCH") && methods.contains("HEAD"),
        "{methods}"
    );
    assert!(words.split(',').all(|word| headers.contains(word)), "{headers}");
    let sent = send_part(&server.client, &upload, 0, b"PK", &[origin]).await;
    let exposed = header_text(&sent, "access-control-expose-headers");
    let wanted =
        ["upload-offset", "upload-expires", "location", "tus-resumable", "uniground-scene-id"];
    assert!(sent.status() == 204 && wanted.iter().all(|name| exposed.contains(name)), "{exposed}");
    assert_eq!(server.terminate(), Some(0));
}

#[tokio::test]
async fn invalid_tus_requests_are_refused() {
    let server = TestServer::start().await;
    let client = &server.client;
    let capabilities = client.request(Method::OPTIONS, "v1/uploads").send().await.unwrap();
    assert_eq!(
        (capabilities.status().as_u16(), header_text(&capabilities, "tus-version")),
        (204, "1.0.0".into())
    );
    assert_eq!(
        header_text(&capabilities, "tus-extension"),
        "creation,creation-with-upload,checksum,expiration,termination"
    );
    assert_eq!(
        (
            header_text(&capabilities, "tus-checksum-algorithm"),
            header_text(&capabilities, "tus-max-size")
        ),
        ("sha1,sha256".into(), (16_u64 << 30).to_string())
    );
    let upload = create_upload_path(client, 1000).await;
    let version = [("tus-resumable", "2.0.0")];
    for (method, path) in
        [(Method::POST, "v1/uploads"), (Method::PATCH, &upload), (Method::DELETE, &upload)]
    {
        let refused = send_request(client, method, path, &version, &[]).await;
        assert_eq!(header_text(&refused, "tus-version"), "1.0.0");
        assert_eq!(read_problem(refused).await, (412, "tus_version_unknown".into()));
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
            read_problem(send_request(client, Method::POST, "v1/uploads", headers, &[]).await)
                .await,
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
            read_problem(send_request(client, Method::PATCH, &upload, headers, b"x").await).await,
            (status, code.into()),
            "{headers:?}"
        );
    }
    assert_eq!(
        read_problem(send_part(client, &upload, 0, &[b'P'; 1001], &[]).await).await,
        (413, "upload_too_large".into())
    );
    assert_eq!(
        read_problem(send_part(client, "v1/uploads/nobody", 0, b"PK", &[]).await).await,
        (404, "upload_not_found".into())
    );
    // For networks that allow only POST.
    let by_post = |method: &'static str| {
        [("x-http-method-override", method), ("content-type", PART), ("upload-offset", "0")]
    };
    let sent = send_request(client, Method::POST, &upload, &by_post("PATCH"), b"PK").await;
    assert_eq!((sent.status().as_u16(), header_text(&sent, "upload-offset")), (204, "2".into()));
    assert_eq!(
        read_problem(send_request(client, Method::POST, &upload, &by_post("PUT"), b"PK").await)
            .await,
        (400, "header_wrong".into())
    );
    assert_eq!(
        send_request(client, Method::POST, &upload, &by_post("DELETE"), &[]).await.status(),
        204
    );
    server.stop().await;
}
