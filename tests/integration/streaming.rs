//! Large uploads are streamed to disk and not held in memory.

use crate::archives::Scan;
use crate::server::{Process, problem};
use bytes::Bytes;
use camino::Utf8Path;
use futures::stream;
use std::fs;
use std::io;
use uniground_client::Client;

const CHUNK: usize = 1 << 20;

/// Returns the peak resident memory of a process in MB.
fn peak_mb(pid: u32) -> f64 {
    let status = fs::read_to_string(format!("/proc/{pid}/status")).unwrap();
    let line = status.lines().find(|l| l.starts_with("VmHWM:")).unwrap();
    line.split_whitespace().nth(1).unwrap().parse::<f64>().unwrap() / 1024.0
}

#[tokio::test]
async fn a_large_upload_stays_out_of_memory() {
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
    let refusal = problem(server.client.create_scene(None, "application/x-tar", body).await);
    assert_eq!(refusal.code, "unknown_layout", "{}", refusal.detail);
    let peak = peak_mb(server.child.id());
    println!("a {MEGABYTES} MB upload peaked at {peak:.0} MB resident");
    assert!(peak < 100.0, "{peak:.0} MB");
    assert_eq!(server.terminate(), Some(0));
}

#[tokio::test]
async fn an_upload_that_breaks_off_leaves_nothing() {
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
