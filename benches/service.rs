//! The service as a process: time to parse the sample scene, questions over HTTP, memory of a 1 GB
//! upload. `cargo bench --bench service`

#![allow(missing_docs, clippy::unwrap_used)] // a bench that can not set up has nothing to time

use bytes::Bytes;
use camino::Utf8Path;
use futures::stream;
use std::fs;
use std::io::{self, BufRead, BufReader};
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};
use uniground_client::Client;

const QUESTIONS: [&str; 4] = [
    "find the coffee table",
    "the orange stool",
    "the mug on the coffee table",
    "the green fridge",
];
const ROUNDS: usize = 1000;
const UPLOAD_MB: usize = 1024;

struct Server {
    child: Child,
    client: Client,
    _data: tempfile::TempDir,
}

impl Server {
    fn start() -> Self {
        let data = tempfile::tempdir().unwrap();
        let folder = Utf8Path::from_path(data.path()).unwrap();
        let mut child = Command::new(env!("CARGO_BIN_EXE_uniground"))
            .args([
                "serve",
                "--listen",
                "127.0.0.1:0",
                "--data-dir",
                folder.as_str(),
                "--masks",
                "builtin",
                "--encoder",
                "builtin",
            ])
            .stdout(Stdio::piped())
            .stderr(Stdio::null())
            .spawn()
            .unwrap();
        let mut line = String::new();
        BufReader::new(child.stdout.take().unwrap()).read_line(&mut line).unwrap();
        let client = Client::new(line.trim().strip_prefix("listening on ").unwrap(), None).unwrap();
        Self { child, client, _data: data }
    }

    /// Returns the peak resident memory in MB.
    fn peak_mb(&self) -> f64 {
        let status = fs::read_to_string(format!("/proc/{}/status", self.child.id())).unwrap();
        let line = status.lines().find(|l| l.starts_with("VmHWM:")).unwrap();
        line.split_whitespace().nth(1).unwrap().parse::<f64>().unwrap() / 1024.0
    }
}

impl Drop for Server {
    fn drop(&mut self) {
        // The process may already have ended; there is nothing to do about it here.
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

#[tokio::main]
async fn main() {
    let archive =
        fs::read(Utf8Path::new(env!("CARGO_MANIFEST_DIR")).join("examples/living_room.zip"))
            .unwrap();
    let mut times = Vec::new();
    let mut last = None;
    for _ in 0..5 {
        let server = Server::start();
        let start = Instant::now();
        let created =
            server.client.create_scene(None, "application/zip", archive.clone()).await.unwrap();
        server.client.follow_job(&created.job.unwrap().id, |_| {}).await.unwrap();
        times.push(start.elapsed());
        last = Some((server, created.scene.id));
    }
    let (server, scene) = last.unwrap();
    times.sort();
    println!(
        "sample scene, upload to ready: median {:.2} s, best {:.2} s, worst {:.2} s of 5",
        s(times[2]),
        s(times[0]),
        s(times[4])
    );
    // A parse resets the kernel's peak at every stage and reports each. The kernel still has the
    // peak after the last stage.
    let stages = server.client.report(&scene).await.unwrap().parse.unwrap().stages;
    let of_stages =
        stages.iter().filter_map(|stage| stage.peak_memory_mb).max().map_or(0.0, f64::from);
    println!("  peak resident memory while parsing it: {:.0} MB", server.peak_mb().max(of_stages));

    let mut latencies = Vec::new();
    for i in 0..ROUNDS {
        let request =
            serde_json::from_value(serde_json::json!({"query": QUESTIONS[i % QUESTIONS.len()]}))
                .unwrap();
        let start = Instant::now();
        server.client.ground(&scene, &request).await.unwrap();
        latencies.push(start.elapsed());
    }
    latencies.sort();
    let at = |share: f64| s(latencies[(share * (ROUNDS - 1) as f64) as usize]) * 1e3;
    println!(
        "ground over HTTP, built-in reasoner, {ROUNDS} in a row: p50 {:.2} ms, p95 {:.2} ms, p99 {:.2} ms",
        at(0.5),
        at(0.95),
        at(0.99)
    );

    let server = Server::start();
    let start = Instant::now();
    let mut header = tar::Header::new_gnu();
    header.set_path("noise.bin").unwrap();
    header.set_size((UPLOAD_MB as u64) << 20);
    header.set_cksum();
    let chunk = Bytes::from((0..1 << 20).map(|i: usize| (i * 31 % 251) as u8).collect::<Vec<_>>());
    let head = Bytes::copy_from_slice(header.as_bytes());
    let chunks = std::iter::once(head)
        .chain(std::iter::repeat_n(chunk, UPLOAD_MB))
        .chain([Bytes::from(vec![0; 1024])]);
    let body = reqwest::Body::wrap_stream(stream::iter(chunks.map(Ok::<_, io::Error>)));
    let refused = server.client.create_scene(None, "application/x-tar", body).await.unwrap_err();
    assert!(refused.to_string().contains("unknown_layout"), "{refused}");
    println!(
        "{UPLOAD_MB} MB upload, received and unpacked: {:.1} s, peak resident memory {:.0} MB",
        s(start.elapsed()),
        server.peak_mb()
    );
}

fn s(duration: Duration) -> f64 {
    duration.as_secs_f64()
}
