//! Connection floods: connections that send nothing, stalled uploads, many event streams; and a
//! scene with very many answers.

use crate::hostile_uploads::ZIP;
use crate::test_scans::Scan;
use crate::test_server::{ask, upload_and_parse};
use crate::{Form, Report, Target, since};
use sqlx::Connection;
use sqlx::sqlite::{SqliteConnectOptions, SqliteConnection};
use std::time::{Duration, Instant};
use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::TcpStream;
use uniground_client::Client;

/// Returns the p99 and the maximum latency of sequential questions, in milliseconds.
async fn measure_questions(client: &Client, scene: &str, count: usize) -> (f64, f64) {
    let mut times = Vec::new();
    for _ in 0..count {
        let start = Instant::now();
        client.ground(scene, &ask("the red sofa")).await.unwrap();
        times.push(start.elapsed().as_secs_f64() * 1e3);
    }
    times.sort_by(f64::total_cmp);
    (times[count * 99 / 100], times[count - 1])
}

async fn send_text(address: &str, text: &str) -> Option<TcpStream> {
    let mut stream = TcpStream::connect(address).await.ok()?;
    stream.write_all(text.as_bytes()).await.ok()?;
    Some(stream)
}

/// Returns how many connections of the flood are refused. Most are; which ones depends on the
/// scheduler.
async fn count_refused(crowd: &mut [TcpStream]) -> usize {
    let told = crowd.iter_mut().map(async |stream| {
        let mut bytes = [0; 64];
        let read = tokio::time::timeout(Duration::from_millis(500), stream.read(&mut bytes)).await;
        String::from_utf8_lossy(&bytes[..read.map_or(0, |read| read.unwrap_or(0))])
            .starts_with("HTTP/1.1 429")
    });
    futures::future::join_all(told).await.into_iter().filter(|refused| *refused).count()
}

pub async fn run(form: Form, report: &mut Report) {
    let target = Target::start();
    let client = &target.process.client;
    let scene = upload_and_parse(client, ZIP, Scan::neutral().zip()).await;
    let address = client
        .request(reqwest::Method::GET, "healthz")
        .build()
        .unwrap()
        .url()
        .authority()
        .to_owned();
    let count = form.of(300, 1000);
    measure_questions(client, &scene.id, 200).await;
    let (calm, _) = measure_questions(client, &scene.id, count).await;
    report.row(
        "questions, idle server",
        &format!("p99 {calm:.1} ms"),
        0.0,
        Some(target.peak_mb()),
        "",
        true,
    );
    // Twice the idle latency. Below this many milliseconds noise of the machine dominates,
    // especially right after other tests.
    let most = (2.0 * calm).max(form.of(250.0, 25.0));

    let half_headers = form.of(1100, 3000);
    let mut crowd = Vec::new();
    for _ in 0..half_headers {
        crowd.extend(
            send_text(&address, "GET /healthz HTTP/1.1\r\nhost: 127.0.0.1\r\nx-slow: ").await,
        );
    }
    let fresh = Client::new(&format!("http://{address}"), None).unwrap();
    let (p99, longest) = measure_questions(&fresh, &scene.id, count).await;
    report.row(
        &format!("{half_headers} half-sent headers"),
        &format!("p99 {p99:.1}, longest {longest:.0} ms"),
        0.0,
        Some(target.peak_mb()),
        "",
        p99 < most,
    );
    drop(crowd);

    let dripping = form.of(1100, 3000);
    let mut crowd = Vec::new();
    for _ in 0..dripping {
        let head = "POST /mcp HTTP/1.1\r\nhost: 127.0.0.1\r\ncontent-type: application/json\r\n\
            accept: application/json, text/event-stream\r\ncontent-length: 60000\r\n\r\n ";
        crowd.extend(send_text(&address, head).await);
    }
    let fresh = Client::new(&format!("http://{address}"), None).unwrap();
    let (p99, longest) = measure_questions(&fresh, &scene.id, count).await;
    report.row(
        &format!("{dripping} slow request bodies"),
        &format!("p99 {p99:.1}, longest {longest:.0} ms"),
        0.0,
        Some(target.peak_mb()),
        "",
        p99 < most,
    );
    drop(crowd);

    let stalled = form.of(300, 1000);
    let mut crowd = Vec::new();
    for _ in 0..stalled {
        let head = "POST /v1/scenes HTTP/1.1\r\nhost: 127.0.0.1\r\ncontent-type: application/zip\r\ncontent-length: 1000000\r\n\r\nPK";
        crowd.extend(send_text(&address, head).await);
    }
    let fresh = Client::new(&format!("http://{address}"), None).unwrap();
    let (p99, longest) = measure_questions(&fresh, &scene.id, count).await;
    let ready = fresh.bytes("readyz").await.is_ok();
    let refused_uploads = count_refused(&mut crowd).await;
    let held = p99 < most && ready && 2 * refused_uploads > stalled;
    report.row(
        &format!("{stalled} stalled uploads"),
        &format!("p99 {p99:.1}, longest {longest:.0} ms"),
        0.0,
        Some(target.peak_mb()),
        &format!("{refused_uploads} refused with 429"),
        held,
    );
    drop(crowd);

    let streams = form.of(600, 2000);
    // An unfinished job keeps its event streams open: this one waits for its start time.
    let options = SqliteConnectOptions::new().filename(target.folder().join("uniground.sqlite"));
    let mut other = SqliteConnection::connect_with(&options).await.unwrap();
    let sql = "INSERT INTO jobs (id, kind, subject, payload, state, created_at, not_before)
               VALUES ('waiting', 'parse', ?, '{}', 'queued', ?, strftime('%Y-%m-%dT%H:%M:%SZ', 'now', '+1 hour'))";
    sqlx::query(sql).bind(&scene.id).bind(&scene.created_at).execute(&mut other).await.unwrap();
    other.close().await.unwrap();
    let mut crowd = Vec::new();
    for _ in 0..streams {
        crowd.extend(
            send_text(&address, "GET /v1/jobs/waiting/events HTTP/1.1\r\nhost: 127.0.0.1\r\n\r\n")
                .await,
        );
    }
    let fresh = Client::new(&format!("http://{address}"), None).unwrap();
    let (p99, longest) = measure_questions(&fresh, &scene.id, count).await;
    let refused_streams = count_refused(&mut crowd).await;
    report.row(
        &format!("{streams} event streams"),
        &format!("p99 {p99:.1}, longest {longest:.0} ms"),
        0.0,
        Some(target.peak_mb()),
        &format!("{refused_streams} refused with 429"),
        // Half of the connections stay open.
        p99 < most && refused_streams + 512 >= streams,
    );
    drop(crowd);
    many_answers(form, report).await;
}

async fn many_answers(form: Form, report: &mut Report) {
    let target = Target::start();
    let client = target.process.client.clone();
    let full = upload_and_parse(&client, ZIP, Scan::neutral().with("note.txt", "full").zip()).await;
    let quiet = upload_and_parse(&client, ZIP, Scan::neutral().zip()).await;
    let answer = client.ground(&full.id, &ask("the red sofa")).await.unwrap();
    let count = form.of(10_000, 100_000);
    let options = SqliteConnectOptions::new().filename(target.folder().join("uniground.sqlite"));
    let mut other = SqliteConnection::connect_with(&options).await.unwrap();
    let sql = "INSERT INTO answers (id, scene_id, parse_id, body, created_at)
               WITH RECURSIVE n(i) AS (SELECT 1 UNION ALL SELECT i + 1 FROM n WHERE i < ?2)
               SELECT answers.id || '-' || i, scene_id, parse_id, body, created_at FROM answers, n WHERE answers.id = ?1";
    sqlx::query(sql).bind(&answer.id).bind(count).execute(&mut other).await.unwrap();
    other.close().await.unwrap();
    let (calm, _) = measure_questions(&client, &quiet.id, 200).await;
    let start = Instant::now();
    let deleting = tokio::spawn({
        let (client, id) = (client.clone(), full.id.clone());
        async move { client.delete_scene(&id).await.is_ok() }
    });
    let mut longest: f64 = 0.0;
    while !deleting.is_finished() {
        longest = longest.max(measure_questions(&client, &quiet.id, 1).await.1);
    }
    let deleted = deleting.await.unwrap();
    let answer = format!("calm p99 {calm:.1}, longest {longest:.0} ms");
    report.row(
        &format!("deleting a scene with {count} answers"),
        &answer,
        since(start),
        None,
        "",
        deleted && longest < 1000.0,
    );
}
