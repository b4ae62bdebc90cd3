//! Malicious uploads are refused with a stable code, quickly, with little memory, and without
//! leaving files.

use crate::hostile_uploads::{self, ANY, ZIP, ZST};
use crate::test_scans::Scan;
use crate::test_server::{ask, wait_for_job};
use crate::{Form, Report, Target, since};
use reqwest::Method;
use std::time::Instant;

/// Uploads are read in child processes, so the server itself needs no more memory.
const MOST_MB: f64 = 120.0;
/// Seconds for an error that shows in the headers.
const SOON: f64 = 2.0;
/// Seconds for an error that shows only after unpacking.
const LATER: f64 = 20.0;

pub async fn run(form: Form, report: &mut Report) {
    let many = form.of(120_000, 250_000);
    let header = form.of(300 << 20, 1 << 30);
    let line = form.of(100 << 20, 190 << 20);
    type Case = (&'static str, &'static str, Vec<u8>, &'static str, f64);
    let cases: Vec<Case> = vec![
        (
            "a PLY with a million columns",
            ZIP,
            hostile_uploads::a_million_columns(),
            "scene_file_malformed",
            SOON,
        ),
        (
            "folders 1,900 deep",
            ZIP,
            hostile_uploads::deep_folders(1900),
            "archive_entry_unsafe",
            SOON,
        ),
        (
            "a huge PAX header",
            ZST,
            hostile_uploads::an_extended_header(tar::EntryType::XHeader, header),
            "archive_unreadable",
            SOON,
        ),
        (
            "a huge long name",
            ZST,
            hostile_uploads::an_extended_header(
                tar::EntryType::GNULongName,
                form.of(header, 4 << 30),
            ),
            "archive_unreadable",
            SOON,
        ),
        (
            "an endless ASCII line",
            ZIP,
            hostile_uploads::an_endless_line(line),
            "job scene_file_malformed",
            LATER,
        ),
        (
            "an endless PLY header",
            ZIP,
            hostile_uploads::an_endless_header(line),
            "scene_file_malformed",
            LATER,
        ),
        // More points than are stored: they are thinned while reading, and then contain no room.
        (
            "thirteen million points",
            ZIP,
            hostile_uploads::thirteen_million_points(),
            "job up_unknown",
            LATER,
        ),
        (
            "a pose file of 100 MB",
            ZIP,
            hostile_uploads::a_large_pose(100 << 20),
            "scene_file_malformed",
            LATER,
        ),
        (
            "a manifest of half a million frames",
            ZIP,
            hostile_uploads::a_large_manifest(16 << 20),
            "scene_file_malformed",
            LATER,
        ),
        (
            "a manifest just below the limit",
            ZIP,
            hostile_uploads::a_large_manifest(11 << 20),
            "scene_file_malformed",
            LATER,
        ),
        ("too many files", ZIP, hostile_uploads::many_files(many), "archive_too_large", SOON),
        (
            "a million folders",
            ZST,
            hostile_uploads::many_folders(form.of(200_000, 1_000_000)),
            "archive_too_large",
            SOON,
        ),
        (
            "a gigabyte of zeros",
            ZIP,
            hostile_uploads::zeros(form.of(300 << 20, 1 << 30)),
            "archive_too_large",
            LATER,
        ),
        (
            "a LAZ record of 2^40 bytes",
            ANY,
            hostile_uploads::laz_with_a_record(1 << 40),
            "scene_file_malformed",
            SOON,
        ),
        (
            "a LAZ record of 6 GiB",
            ANY,
            hostile_uploads::laz_with_a_record(6 << 30),
            "scene_file_malformed",
            SOON,
        ),
        (
            "a LAZ of 2^32 - 1 chunks",
            ANY,
            hostile_uploads::laz_with_chunks(u32::MAX),
            "scene_file_malformed",
            SOON,
        ),
        (
            "a GLB of millions of indices",
            ZIP,
            hostile_uploads::glb_of_indices(form.of(100_000_000, 400_000_000)),
            "job scene_file_malformed",
            LATER,
        ),
        (
            "an E57 with a large description",
            ZIP,
            hostile_uploads::e57_of_elements(form.of(10_000, 51_000)),
            "scene_file_malformed",
            LATER,
        ),
    ];
    let target = Target::start();
    let client = &target.process.client;
    for (case, media_type, bytes, code, most_seconds) in cases {
        target.forget_peak();
        let (start, size) = (Instant::now(), bytes.len());
        let (answer, held) = match client.create_scene(None, media_type, bytes).await {
            Err(uniground_client::ClientError::Problem(problem)) => {
                let held = problem.code == code && (400..500).contains(&problem.status);
                (format!("{} {}", problem.status, problem.code), held)
            }
            // An error that appears only when rows are read fails the job.
            Ok(created) if code.starts_with("job ") => {
                let job = wait_for_job(client, &created.job.unwrap().id).await;
                client.delete_scene(&created.scene.id).await.unwrap();
                let told = format!("job {}", job.error.map(|error| error.code).unwrap_or_default());
                (format!("202, {told}"), told == code)
            }
            other => (format!("{other:?}").chars().take(30).collect(), false),
        };
        let (seconds, peak) = (since(start), target.peak_mb());
        tokio::time::sleep(std::time::Duration::from_millis(300)).await;
        let left = target.left();
        let clean = left == "contents 0, tmp 0";
        report.row(
            &format!("{case} ({} kB)", size >> 10),
            &answer,
            seconds,
            Some(peak),
            &left,
            held && clean && seconds < most_seconds && peak < MOST_MB,
        );
    }
    let target = target.again();
    let ready = target.process.client.bytes("readyz").await.is_ok();
    report.row(
        "all of the above, then a restart",
        if ready { "ready" } else { "not ready" },
        0.0,
        Some(target.peak_mb()),
        &target.left(),
        ready,
    );
    run_requests(&target, report).await;
}

/// Malicious requests.
async fn run_requests(target: &Target, report: &mut Report) {
    let client = &target.process.client;
    let created = client.create_scene(None, ZIP, Scan::neutral().zip()).await.unwrap();
    wait_for_job(client, &created.job.unwrap().id).await;
    let start = Instant::now();
    let path = format!("v1/scenes/{}/ground", created.scene.id);
    let request = client.request(Method::POST, &path).header("content-type", "application/json");
    let body = format!(r#"{{"query": "the sofa", "{}": 1}}"#, "x".repeat(1 << 20));
    let short = request
        .body(body[..(1 << 20) - 100].to_owned() + "\": 1}")
        .header("x-request-id", "y".repeat(3000))
        .send()
        .await
        .unwrap();
    let id = short.headers()["x-request-id"].len();
    let nosniff = short.headers().get("x-content-type-options").is_some();
    let bytes = short.bytes().await.unwrap().len();
    report.row(
        "a field of a megabyte, an id of 3,000",
        &format!("{bytes} bytes back, id of {id}"),
        since(start),
        None,
        "",
        bytes < 4096 && id < 200 && nosniff,
    );
    let response = client
        .request(Method::GET, "v1/scenes")
        .header("host", "evil.example")
        .send()
        .await
        .unwrap();
    report.row(
        "a foreign host name",
        response.status().as_str(),
        0.0,
        None,
        "",
        response.status() == 421,
    );
    let found = client.ground(&created.scene.id, &ask("the red sofa")).await.is_ok();
    report.row(
        "then a question",
        if found { "answered" } else { "not answered" },
        0.0,
        Some(target.peak_mb()),
        "",
        found,
    );
}
