//! Metrics, statistics and readiness, compared with what was done and with the files that use them.

use crate::scripted_model::{Script, fails, says};
use crate::test_scans::Scan;
use crate::test_server::{Process, TestServer, ask, serve_command, upload_and_parse, wait_for_job};
use axum::Json;
use axum::extract::{DefaultBodyLimit, State};
use camino::Utf8Path;
use reqwest::Method;
use serde_json::Value;
use std::collections::{BTreeMap, BTreeSet};
use std::fs;
use std::process::Stdio;
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};
use uniground::config::{LimitsConfig, ModelsConfig, VlmConfig};
use uniground_types::batch::BatchState;
use uniground_types::instances::Levels;
use uniground_types::question::{GroundRequest, ReasonerChoice};
use uniground_types::service::Readiness;

/// A sample: its labels and its value.
type Sample = (BTreeMap<String, String>, f64);

/// A scrape: samples by name, and the types and help texts of families.
struct Scrape {
    samples: BTreeMap<String, Vec<Sample>>,
    types: BTreeMap<String, String>,
}

impl Scrape {
    /// Parses every line and fails on an invalid one.
    fn read(text: &str) -> Self {
        let (mut samples, mut types, mut helped) =
            (BTreeMap::<_, Vec<Sample>>::new(), BTreeMap::new(), BTreeSet::new());
        assert!(text.ends_with("# EOF\n"), "{text}");
        for line in text.lines().filter(|line| *line != "# EOF") {
            if let Some(rest) = line.strip_prefix("# ") {
                let (what, rest) = rest.split_once(' ').unwrap();
                let (name, said) = rest.split_once(' ').unwrap();
                match what {
                    "TYPE" => assert!(
                        types.insert(name.to_owned(), said.to_owned()).is_none(),
                        "{name} appears twice"
                    ),
                    "HELP" => assert!(said.len() > 10 && helped.insert(name.to_owned()), "{line}"),
                    "UNIT" => assert!(name.ends_with(said), "{line}"),
                    _ => panic!("{line}"),
                }
                continue;
            }
            let (series, value) = line.rsplit_once(' ').unwrap();
            let value: f64 = value.parse().unwrap_or_else(|_| panic!("{line}"));
            let (name, labels) = series
                .split_once('{')
                .map_or((series, ""), |(name, rest)| (name, rest.strip_suffix('}').unwrap()));
            let labels = labels.split("\",").filter(|label| !label.is_empty()).map(|label| {
                let (label, value) = label.split_once("=\"").unwrap_or_else(|| panic!("{line}"));
                (label.to_owned(), value.trim_end_matches('"').to_owned())
            });
            samples.entry(name.to_owned()).or_default().push((labels.collect(), value));
        }
        assert_eq!(types.keys().collect::<Vec<_>>(), helped.iter().collect::<Vec<_>>());
        Self { samples, types }
    }

    /// Returns the value of a series; 0 if there is none.
    fn value(&self, name: &str, labels: &[(&str, &str)]) -> f64 {
        let fits = |(of, _): &&Sample| {
            labels.iter().all(|(label, value)| of.get(*label).is_some_and(|found| found == value))
        };
        self.samples.get(name).into_iter().flatten().filter(fits).map(|(_, value)| value).sum()
    }

    /// Returns every name that a query may use.
    fn names(&self) -> BTreeSet<String> {
        let of = |(family, kind): (&String, &String)| match kind.as_str() {
            "counter" => vec![format!("{family}_total")],
            "histogram" => ["_bucket", "_sum", "_count"].map(|end| format!("{family}{end}")).into(),
            "info" => vec![format!("{family}_info")],
            _ => vec![family.clone()],
        };
        self.types.iter().flat_map(of).collect()
    }
}

async fn fetch_metrics(server: &TestServer) -> Scrape {
    let response = server.client.request(Method::GET, "metrics").send().await.unwrap();
    assert_eq!(
        response.headers()["content-type"],
        "application/openmetrics-text; version=1.0.0; charset=utf-8"
    );
    Scrape::read(&response.text().await.unwrap())
}

async fn fetch_readiness(server: &TestServer) -> (u16, Readiness) {
    let response = server.client.request(Method::GET, "readyz").send().await.unwrap();
    (response.status().as_u16(), response.json().await.unwrap())
}

fn sample_scan() -> Vec<u8> {
    fs::read(concat!(env!("CARGO_MANIFEST_DIR"), "/examples/living_room.zip")).unwrap()
}

fn read_file(path: &str) -> String {
    fs::read_to_string(Utf8Path::new(env!("CARGO_MANIFEST_DIR")).join(path)).unwrap()
}

/// Returns the names of this service's metrics in a text.
fn metric_names(text: &str) -> BTreeSet<String> {
    let words = text.split(|c: char| !c.is_ascii_alphanumeric() && c != '_');
    words
        .filter(|word| word.starts_with("uniground_") || word.starts_with("process_"))
        .map(str::to_owned)
        .collect()
}

/// Returns the metric names in the dashboard's expressions. Every panel has a place of its own and
/// a unique title.
fn dashboard_metric_names() -> BTreeSet<String> {
    let dashboard: Value =
        serde_json::from_str(&read_file("deploy/grafana-dashboard.json")).unwrap();
    let panels = dashboard["panels"].as_array().unwrap();
    let ids: BTreeSet<u64> = panels.iter().map(|panel| panel["id"].as_u64().unwrap()).collect();
    assert!(
        ids.len() == panels.len() && panels.len() > 20,
        "{} ids of {} panels",
        ids.len(),
        panels.len()
    );
    let targets = panels.iter().filter_map(|panel| panel["targets"].as_array()).flatten();
    targets.flat_map(|target| metric_names(target["expr"].as_str().unwrap())).collect()
}

fn folder_bytes(folder: &Utf8Path) -> u64 {
    let entries = folder.read_dir_utf8().unwrap().map(Result::unwrap);
    entries
        .map(|entry| {
            if entry.file_type().unwrap().is_dir() {
                folder_bytes(entry.path())
            } else {
                entry.metadata().unwrap().len()
            }
        })
        .sum()
}

/// Uploads the sample scan twice, asks single questions and a batch, and asks about a scene that
/// does not exist.
#[tokio::test(flavor = "multi_thread")]
async fn metrics_and_stats_match_the_requests() {
    let server = TestServer::start().await;
    let before = fetch_metrics(&server).await;
    assert_eq!(
        (before.value("uniground_scenes", &[]), before.value("uniground_ready", &[])),
        (0.0, 1.0)
    );
    assert_eq!(before.value("uniground_jobs_finished_total", &[]), 0.0);
    let scene = server.upload_and_parse(sample_scan()).await.id;
    let again =
        server.client.create_scene(Some("again"), "application/zip", sample_scan()).await.unwrap();
    wait_for_job(&server.client, &again.job.unwrap().id).await;
    for query in ["the mug on the coffee table", "the purple beds"] {
        server.client.ground(&scene, &ask(query)).await.unwrap();
    }
    server
        .client
        .ground("0190a0a0-0000-7000-8000-000000000000", &ask("the mug"))
        .await
        .unwrap_err();
    let items = serde_json::json!({"defaults": {"scene_id": scene}, "items": [{"query": "the sofa"}, {"query": "the lamp"}]});
    let batch =
        server.client.create_batch(&serde_json::from_value(items).unwrap(), None).await.unwrap();
    wait_for_job(&server.client, batch.job_id.as_deref().unwrap()).await;
    assert_eq!(server.client.batch(&batch.id).await.unwrap().state, BatchState::Succeeded);
    server.client.bytes("no/such/path").await.unwrap_err();
    tokio::time::sleep(Duration::from_millis(1100)).await;

    let first = fetch_metrics(&server).await;
    let route = "/v1/scenes/{scene_id}/ground";
    let asked = |scrape: &Scrape, status| {
        scrape.value(
            "uniground_http_requests_total",
            &[("route", route), ("method", "POST"), ("status", status)],
        )
    };
    assert_eq!((asked(&first, "200"), asked(&first, "404")), (2.0, 1.0));
    assert_eq!(
        first.value(
            "uniground_http_request_duration_seconds_count",
            &[("route", route), ("status", "200")]
        ),
        2.0
    );
    assert_eq!(
        first.value("uniground_http_requests_total", &[("route", "none"), ("status", "404")]),
        1.0
    );
    assert_eq!(first.value("uniground_questions_total", &[("reasoner", "builtin")]), 4.0);
    assert_eq!(first.value("uniground_questions_total", &[("status", "no_match")]), 1.0);
    assert_eq!(
        first.value("uniground_question_failures_total", &[("code", "scene_not_found")]),
        1.0
    );
    assert_eq!(
        first.value("uniground_question_duration_seconds_count", &[("reasoner", "builtin")]),
        4.0
    );
    assert_eq!(first.value("uniground_batch_items_total", &[]), 2.0);
    assert_eq!(
        first.value("uniground_jobs_finished_total", &[("kind", "parse"), ("state", "succeeded")]),
        2.0
    );
    assert_eq!(
        first.value("uniground_jobs_finished_total", &[("kind", "batch"), ("state", "succeeded")]),
        1.0
    );
    assert_eq!(
        first.samples["uniground_jobs_finished_total"].len(),
        12,
        "a counter without events is missing"
    );
    assert_eq!(
        first.value("uniground_parse_duration_seconds_count", &[]),
        1.0,
        "the second scene reuses the parse of the first"
    );
    let stages = first.value("uniground_parse_stage_duration_seconds_sum", &[]);
    assert!(
        stages > 0.0 && stages <= first.value("uniground_parse_duration_seconds_sum", &[]) * 1.01,
        "{stages}"
    );
    assert_eq!(
        first.value("uniground_parse_stage_duration_seconds_count", &[("stage", "other")]),
        0.0,
        "every stage has a name"
    );
    assert_eq!(
        first.value("uniground_parse_stage_duration_seconds_count", &[("stage", "merging")]),
        1.0
    );
    assert!(
        first.value("uniground_cache_requests_total", &[("cache", "parses"), ("outcome", "hit")])
            >= 3.0
    );
    assert_eq!(first.value("uniground_component_up", &[("component", "workers")]), 1.0);
    assert_eq!(first.samples["uniground_lane_up"].len(), 4);
    assert!(
        first.value("process_resident_memory_bytes", &[]) > 1e6,
        "{}",
        first.value("process_resident_memory_bytes", &[])
    );

    // The statistics endpoint reports the same numbers.
    let stats = server.client.stats().await.unwrap();
    let instances = server.client.all_instances(&scene, Levels::All).await.unwrap().len() as u32;
    let stored = &stats.stored;
    assert_eq!(
        (stored.scenes, stored.parses, stored.instances, stored.answers),
        (2, 1, instances, 4)
    );
    assert_eq!(stored.batches, BTreeMap::from([("succeeded".to_owned(), 1)]));
    // These figures come from the database and may be a few seconds old.
    let succeeded = [("state", "succeeded")];
    let mut figures = fetch_metrics(&server).await;
    for _ in 0..100 {
        if figures.value("uniground_answers", &[]) == f64::from(stored.answers)
            && figures.value("uniground_batches", &succeeded) == 1.0
        {
            break;
        }
        tokio::time::sleep(Duration::from_millis(200)).await;
        figures = fetch_metrics(&server).await;
    }
    for (metric, count) in [
        ("scenes", stored.scenes),
        ("parses", stored.parses),
        ("instances", stored.instances),
        ("answers", stored.answers),
    ] {
        assert_eq!(
            figures.value(&format!("uniground_{metric}"), &[]),
            f64::from(count),
            "{metric}"
        );
    }
    assert_eq!(figures.value("uniground_batches", &succeeded), 1.0);
    for jobs in &stats.jobs {
        assert!(
            jobs.working && jobs.queued == 0 && jobs.running == 0 && jobs.oldest_queued_s.is_none(),
            "{jobs:?}"
        );
        let counted = |state| {
            first.value("uniground_jobs_finished_total", &[("kind", &jobs.kind), ("state", state)])
        };
        assert_eq!(
            (counted("succeeded"), counted("failed")),
            (f64::from(jobs.succeeded), f64::from(jobs.failed)),
            "{jobs:?}"
        );
    }
    assert_eq!((stats.spending.today_usd, stats.spending.daily_limit_usd), (0.0, None));
    assert_eq!(
        (stats.retention.answers_days, stats.version.as_str()),
        (365, env!("CARGO_PKG_VERSION"))
    );
    assert!(stats.disk.database_bytes > 4096 && stats.disk.free_bytes > 0);

    // Sizes are measured in the background; those from the start are of an empty folder.
    let data = server.data().to_owned();
    let restarted = TestServer::start_on(
        server.stop_and_keep_data().await,
        LimitsConfig::default(),
        VlmConfig::default(),
        ModelsConfig::builtin(),
    )
    .await;
    let sizes = loop {
        if let Some(sizes) = restarted.client.stats().await.unwrap().disk.blob_bytes {
            break sizes;
        }
        tokio::time::sleep(Duration::from_millis(20)).await;
    };
    for kind in ["contents", "parses", "checkpoints", "answers"] {
        assert_eq!(sizes[kind], folder_bytes(&data.join("blobs").join(kind)), "{kind}");
    }
    assert!(sizes["contents"] > 100_000 && sizes["parses"] > 100_000, "{sizes:?}");
    let scrape = fetch_metrics(&restarted).await;
    assert_eq!(
        scrape.value("uniground_blobs_size_bytes", &[("kind", "parses")]),
        sizes["parses"] as f64
    );
    assert_eq!(
        (scrape.value("uniground_answers", &[]), scrape.value("uniground_questions_total", &[])),
        (4.0, 0.0)
    );
    let mut fastest = Duration::MAX;
    for _ in 0..20 {
        let start = Instant::now();
        fetch_metrics(&restarted).await;
        fastest = fastest.min(start.elapsed());
    }
    assert!(fastest < Duration::from_millis(20), "a scrape takes {fastest:?}");
    restarted.stop().await;
}

/// Alerts, dashboard and manual name only existing metrics, and the manual names all of them.
fn assert_files_match_metrics(scrape: &Scrape) {
    let known = scrape.names();
    for used in ["deploy/prometheus-alerts.yml", "docs/guides/operations.md"] {
        // The manual's table lists histograms by family name.
        let unknown: Vec<_> = metric_names(&read_file(used))
            .into_iter()
            .filter(|name| !known.contains(name) && !scrape.types.contains_key(name))
            .collect();
        assert_eq!(unknown, [""; 0], "{used}");
    }
    let unknown: Vec<_> =
        dashboard_metric_names().into_iter().filter(|name| !known.contains(name)).collect();
    assert_eq!(unknown, [""; 0], "the dashboard");

    // The table: | `name` | type | labels | ...
    let manual = read_file("docs/guides/operations.md");
    let rows = manual
        .lines()
        .filter(|line| line.starts_with("| `uniground_") || line.starts_with("| `process_"));
    let told: BTreeMap<&str, Vec<&str>> = rows
        .map(|row| row.split('|').map(|cell| cell.trim().trim_matches('`')).collect::<Vec<_>>())
        .map(|cells| (cells[1], cells))
        .collect();
    let exposed = |(family, kind): (&String, &String)| match kind.as_str() {
        "counter" => format!("{family}_total"),
        "info" => format!("{family}_info"),
        _ => family.clone(),
    };
    let families: BTreeSet<String> = scrape.types.iter().map(exposed).collect();
    assert_eq!(
        told.keys().map(|name| (*name).to_owned()).collect::<BTreeSet<_>>(),
        families,
        "the manual's table"
    );
    for (family, kind) in &scrape.types {
        assert_eq!(told[exposed((family, kind)).as_str()][2], kind, "{family}");
    }
    let alerts = read_file("deploy/prometheus-alerts.yml");
    let alerts: Vec<&str> =
        alerts.lines().filter_map(|line| line.trim().strip_prefix("- alert: ")).collect();
    assert!(alerts.len() > 10, "{} alerts", alerts.len());
    for alert in alerts {
        assert!(manual.contains(&format!("| `{alert}` |")), "the manual does not describe {alert}");
    }
}

/// Every label has a bounded set of values.
fn assert_labels_are_bounded(scrape: &Scrape) {
    for (name, samples) in &scrape.samples {
        for (labels, _) in samples {
            for (label, value) in labels {
                // Route templates contain braces; a value with digits like an id would come from a
                // request.
                let bounded = label == "le"
                    || label == "version"
                    || label == "status"
                    || value.chars().filter(char::is_ascii_digit).count() <= 1;
                assert!(bounded && value.len() < 60, "{name} {label}={value}");
            }
        }
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn unusual_requests_create_no_new_labels() {
    let server = TestServer::start().await;
    let path = "v1/scenes/0190a0a0-0000-7000-8000-000000000000";
    for method in ["GET", "PATCH", "BREW"] {
        let method = Method::from_bytes(method.as_bytes()).unwrap();
        server.client.request(method, path).send().await.unwrap();
    }
    server.client.bytes("0190a0a0-0000-7000-8000-000000000000/of/mine").await.unwrap_err();
    let scrape = fetch_metrics(&server).await;
    assert_labels_are_bounded(&scrape);
    assert_eq!(scrape.value("uniground_http_requests_total", &[("method", "other")]), 1.0);
    assert_eq!(
        scrape.value("uniground_http_requests_total", &[("route", "/v1/scenes/{scene_id}")]),
        3.0
    );
    assert_eq!(scrape.value("uniground_http_requests_total", &[("route", "none")]), 1.0);
    server.stop().await;
}

/// A model that does not answer is reported, and the server stays ready because the built-in models
/// answer.
#[tokio::test(flavor = "multi_thread")]
async fn a_model_that_is_down_is_reported_and_the_server_stays_ready() {
    let script = Script::default();
    let url = script.serve(vec![fails(500, "out of order")]).await;
    let vlm = VlmConfig {
        vlm_url: Some(url),
        vlm_model: Some("scripted".into()),
        vlm_prompt_usd: 2.0,
        vlm_completion_usd: 8.0,
        vlm_daily_usd: Some(3.0),
        vlm_attempts: 2,
        vlm_backoff_ms: 1,
        ..VlmConfig::default()
    };
    let server = TestServer::start_configured(LimitsConfig::default(), vlm).await;
    assert_eq!(fetch_readiness(&server).await.1.vlm.as_deref(), Some("ok"));
    let scene = server.upload_and_parse(Scan::neutral().zip()).await.id;
    let query = "the red sofa";
    let answer = server.client.ground(&scene, &ask(query)).await.unwrap();
    assert!(answer.degraded, "{answer:?}");
    tokio::time::sleep(Duration::from_millis(1100)).await;
    let (status, told) = fetch_readiness(&server).await;
    let trouble = told.vlm.unwrap();
    assert!(
        status == 200
            && told.ready
            && trouble.starts_with("refused since ")
            && trouble.ends_with(" (1 calls)"),
        "{trouble}"
    );
    let scrape = fetch_metrics(&server).await;
    assert_eq!(
        (
            scrape.value("uniground_component_up", &[("component", "vlm")]),
            scrape.value("uniground_ready", &[])
        ),
        (0.0, 1.0)
    );
    assert_eq!(
        (
            scrape.value("uniground_vlm_attempts_total", &[]),
            scrape.value("uniground_questions_degraded_total", &[])
        ),
        (2.0, 1.0)
    );

    // The model is back: first with an invalid reply, then with a choice.
    let chosen = answer.candidates.as_ref().unwrap()[0].id;
    let choice = format!(
        "Predicted ID: {chosen}\nExplanation: red\nCandidate Names: {chosen} -> sofa\nTarget name matches?: True\nAnchor ID: -1\nRelation used: on"
    );
    script.next(vec![says("I would rather not"), says(&choice)]);
    let request = GroundRequest { reasoner: ReasonerChoice::Vlm, ..ask(query) };
    let answer = server.client.ground(&scene, &request).await.unwrap();
    assert_eq!(answer.usage.vlm_calls, 2);
    tokio::time::sleep(Duration::from_millis(1100)).await;
    assert_eq!(fetch_readiness(&server).await.1.vlm.as_deref(), Some("ok"));
    server.client.ground("01a204e6-089a-7381-b0fc-2e7c672de513", &ask(query)).await.unwrap_err();
    let items =
        serde_json::json!({"items": [{"scene_id": scene, "query": query, "reasoner": "builtin"}]});
    let batch =
        server.client.create_batch(&serde_json::from_value(items).unwrap(), None).await.unwrap();
    wait_for_job(&server.client, batch.job_id.as_deref().unwrap()).await;
    let scrape = fetch_metrics(&server).await;
    // Each outcome has occurred once.
    assert_files_match_metrics(&scrape);
    assert_labels_are_bounded(&scrape);
    let calls = |outcome| scrape.value("uniground_vlm_calls_total", &[("outcome", outcome)]);
    assert_eq!((calls("answered"), calls("refused"), calls("unreachable")), (2.0, 1.0, 0.0));
    assert_eq!(
        scrape.value("uniground_vlm_malformed_replies_total", &[("problem", "unreadable")]),
        1.0
    );
    let tokens = |of| scrape.value("uniground_vlm_tokens_total", &[("type", of)]);
    assert_eq!((tokens("prompt"), tokens("completion")), (1400.0, 80.0));
    assert_eq!(
        scrape.value("uniground_questions_total", &[("reasoner", "vlm"), ("status", "uncertain")]),
        1.0
    );
    let spending = server.client.stats().await.unwrap().spending;
    let spent = scrape.value("uniground_vlm_spent_usd_total", &[]);
    assert!(
        spent > answer.usage.cost_usd - 1e-9 && (spent - spending.today_usd).abs() < 1e-9,
        "{spent} {spending:?}"
    );
    // This figure comes from the database and may be a few seconds old.
    let mut today = scrape.value("uniground_vlm_spent_today_usd", &[]);
    for _ in 0..100 {
        if (today - spent).abs() < 1e-9 {
            break;
        }
        tokio::time::sleep(Duration::from_millis(200)).await;
        today = fetch_metrics(&server).await.value("uniground_vlm_spent_today_usd", &[]);
    }
    assert!((today - spent).abs() < 1e-9, "{today} {spent}");
    assert_eq!(
        (spending.daily_limit_usd, scrape.value("uniground_vlm_daily_limit_usd", &[])),
        (Some(3.0), 3.0)
    );
    server.stop().await;
}

/// What the collector and the model received: path, `traceparent`, body.
type Sent = Arc<Mutex<Vec<(String, Option<String>, Vec<u8>)>>>;

async fn record_request(State(sent): State<Sent>, request: axum::extract::Request) -> Json<Value> {
    let (path, traceparent) = (
        request.uri().path().to_owned(),
        request.headers().get("traceparent").map(|v| v.to_str().unwrap().to_owned()),
    );
    let body = axum::body::to_bytes(request.into_body(), 16 << 20).await.unwrap().to_vec();
    sent.lock().unwrap().push((path, traceparent, body));
    Json(
        serde_json::json!({"choices": [{"message": {"role": "assistant", "content": "I would rather not"}}]}),
    )
}

/// A caller's trace continues through the server to the model, and its spans go to the collector:
/// requests, jobs, calls.
#[tokio::test(flavor = "multi_thread")]
async fn traces_are_continued_propagated_and_exported() {
    const TRACE: &str = "0af7651916cd43dd8448eb211c80319c";
    let sent = Sent::default();
    let listener = tokio::net::TcpListener::bind("127.0.0.1:0").await.unwrap();
    let there = format!("http://{}", listener.local_addr().unwrap());
    let router = axum::Router::new()
        .fallback(record_request)
        .layer(DefaultBodyLimit::disable())
        .with_state(sent.clone());
    tokio::spawn(async move { axum::serve(listener, router).await });
    let folder = tempfile::tempdir().unwrap();
    let mut command = serve_command(Utf8Path::from_path(folder.path()).unwrap(), "127.0.0.1:0");
    command.args([
        "--otlp-endpoint",
        &there,
        "--vlm-url",
        &format!("{there}/v1"),
        "--vlm-model",
        "scripted",
    ]);
    let process = Process::spawn(command.env("RUST_LOG", "error").stderr(Stdio::null()));
    let scene = upload_and_parse(&process.client, "application/zip", Scan::neutral().zip()).await;
    let request = process.client.request(Method::POST, &format!("v1/scenes/{}/ground", scene.id));
    let request = request
        .header("traceparent", format!("00-{TRACE}-b7ad6b7169203331-01"))
        .json(&ask("the red sofa"));
    assert_eq!(request.send().await.unwrap().status(), 200);
    assert_eq!(process.terminate(), Some(0));

    let sent = sent.lock().unwrap();
    let (calls, traces): (Vec<_>, Vec<_>) =
        sent.iter().partition(|(path, ..)| path == "/v1/chat/completions");
    assert!(
        !calls.is_empty()
            && calls.iter().all(|(_, parent, _)| parent
                .as_ref()
                .is_some_and(|parent| parent.starts_with(&format!("00-{TRACE}-"))))
    );
    // The startup probe of the endpoint belongs to no request.
    let (traces, looks): (Vec<_>, Vec<_>) =
        traces.into_iter().partition(|(path, ..)| path == "/v1/traces");
    assert!(
        !traces.is_empty()
            && looks.iter().all(|(path, parent, _)| path == "/v1/models" && parent.is_none())
    );
    let bodies: Vec<u8> = traces.iter().flat_map(|(.., body)| body.clone()).collect();
    let has = |what: &[u8]| bodies.windows(what.len()).any(|window| window == what);
    let trace: Vec<u8> =
        (0..16).map(|i| u8::from_str_radix(&TRACE[2 * i..2 * i + 2], 16).unwrap()).collect();
    assert!(has(&trace), "the caller's trace");
    for span in ["request", "job", "model_call", "/v1/scenes/{scene_id}/ground"] {
        assert!(has(span.as_bytes()), "{span}");
    }
    assert!(!has(b"the red sofa"), "a trace contains the text of a question");
}
