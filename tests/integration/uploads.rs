//! Uploads: the content decides the type, large ones are streamed to disk, and refused or
//! interrupted ones leave nothing.

use crate::test_scans::Scan;
use crate::test_server::{Process, TestServer, expect_problem, wait_for_job};
use bytes::Bytes;
use camino::Utf8Path;
use futures::stream;
use reqwest::Method;
use std::fs;
use std::io;
use uniground::config::LimitsConfig;
use uniground_client::Client;
use uniground_types::scenes::{Created, SceneStatus};

const CHUNK: usize = 1 << 20;

/// Returns the peak resident memory of a process in MB.
fn peak_mb(pid: u32) -> f64 {
    let status = fs::read_to_string(format!("/proc/{pid}/status")).unwrap();
    let line = status.lines().find(|l| l.starts_with("VmHWM:")).unwrap();
    line.split_whitespace().nth(1).unwrap().parse::<f64>().unwrap() / 1024.0
}

#[tokio::test]
async fn the_content_type_of_an_upload_does_not_matter() {
    let server = TestServer::start().await;
    let made = async |query: &str, media_type: &str, body: Vec<u8>| {
        let request = server.client.request(Method::POST, &format!("v1/scenes{query}"));
        let response = request.header("content-type", media_type).body(body).send().await.unwrap();
        assert_eq!(response.status(), 202, "{media_type}: {}", response.text().await.unwrap());
        let Created { scene, job } = response.json().await.unwrap();
        assert_eq!(
            wait_for_job(&server.client, &job.unwrap().id).await.error,
            None,
            "{media_type}"
        );
        server.client.scene(&scene.id).await.unwrap()
    };
    let scan = Scan::neutral();
    let form = |name: &str, file: &[u8]| {
        let head = format!(
            "--x\r\ncontent-disposition: form-data; name=\"a\"\r\n\r\n1\r\n--x\r\ncontent-disposition: form-data; name=\"scan\"; filename=\"{name}\"\r\n\r\n"
        );
        [head.as_bytes(), file, b"\r\n--x--\r\n"].concat()
    };
    const FORM: &str = "multipart/form-data; boundary=x";
    // curl's default media type; a wrong one; a browser's form.
    for (media_type, body) in [
        ("application/x-www-form-urlencoded", scan.zip()),
        ("application/octet-stream", scan.tar()),
        ("application/x-tar", scan.zip()),
        (FORM, form("room.zip", &scan.zip())),
    ] {
        assert_eq!(made("", media_type, body).await.name, "test room", "{media_type}");
    }
    // A bare cloud, and a text file of numbers that its name marks as a cloud.
    let cloud = Scan::cloud_only().0.remove("cloud.ply").unwrap();
    let scene = made("?up=z&name=bare", "application/octet-stream", cloud).await;
    assert_eq!((scene.status, scene.import.unwrap().format.as_str()), (SceneStatus::Ready, "ply"));
    let square = |z: f32| {
        (0..900)
            .map(move |i| format!("{} {} {z}\n", (i % 30) as f32 * 0.05, (i / 30) as f32 * 0.05))
    };
    let lines: String = square(0.0).chain(square(1.0)).collect();
    let scene = made("?up=z", FORM, form("points.xyz", lines.as_bytes())).await;
    assert_eq!(
        (scene.import.unwrap().format.as_str(), scene.counts.unwrap().points),
        ("xyz", 1800)
    );
    server.stop().await;
}

#[tokio::test]
async fn a_large_upload_is_not_held_in_memory() {
    let data = tempfile::tempdir().unwrap();
    let server = Process::start(Utf8Path::from_path(data.path()).unwrap());
    // A tar of one large file. It contains no room, so it is refused, but only after all of it was
    // written to disk.
    const MEGABYTES: usize = 300;
    let mut header = tar::Header::new_gnu();
    header.set_path("noise.bin").unwrap();
    header.set_size((MEGABYTES * CHUNK) as u64);
    header.set_cksum();
    let head = Bytes::copy_from_slice(header.as_bytes());
    let noise = Bytes::from((0..CHUNK).map(|i| (i * 31 % 251) as u8).collect::<Vec<_>>());
    let tail = Bytes::from(vec![0; 1024]);
    let chunks = std::iter::once(head)
        .chain(std::iter::repeat_n(noise, MEGABYTES))
        .chain([tail])
        .map(Ok::<_, io::Error>);
    let body = reqwest::Body::wrap_stream(stream::iter(chunks));
    let refusal = expect_problem(server.client.create_scene(None, "application/x-tar", body).await);
    assert_eq!(refusal.code, "unknown_layout", "{}", refusal.detail);
    let peak = peak_mb(server.child.id());
    println!("a {MEGABYTES} MB upload peaked at {peak:.0} MB resident");
    assert!(peak < 100.0, "{peak:.0} MB");
    assert_eq!(server.terminate(), Some(0));
}

#[tokio::test]
async fn an_interrupted_upload_leaves_nothing() {
    let data = tempfile::tempdir().unwrap();
    let data = Utf8Path::from_path(data.path()).unwrap();
    let server = Process::start(data);
    let archive = Scan::neutral().zip();
    let half = Bytes::copy_from_slice(&archive[..archive.len() / 2]);
    let chunks = vec![Ok(half), Err(io::Error::other("the robot lost its network"))];
    let client: &Client = &server.client;
    let sent = client
        .create_scene(None, "application/zip", reqwest::Body::wrap_stream(stream::iter(chunks)))
        .await;
    assert!(sent.is_err());
    // The server notices the closed connection a moment later.
    for _ in 0..100 {
        if data.join("tmp").read_dir_utf8().unwrap().next().is_none() {
            break;
        }
        tokio::time::sleep(std::time::Duration::from_millis(20)).await;
    }
    assert!(data.join("tmp").read_dir_utf8().unwrap().next().is_none());
    assert_eq!(client.scenes(10, None).await.unwrap().scenes, []);
    assert_eq!(server.terminate(), Some(0));
}

#[tokio::test]
async fn an_upload_over_the_limit_is_refused() {
    let server =
        TestServer::start_with(LimitsConfig { max_upload_bytes: 1000, ..LimitsConfig::default() })
            .await;
    let refusal = expect_problem(
        server.client.create_scene(None, "application/zip", Scan::neutral().zip()).await,
    );
    assert_eq!((refusal.status, refusal.code.as_str()), (413, "upload_too_large"));
    assert_eq!(server.list_folder("tmp"), Vec::<String>::new());
    server.stop().await;
}
