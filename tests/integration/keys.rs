//! Access and API keys: required keys, scopes, rate limits, quotas, budgets, and the audit log.

use crate::scripted_model::{Script, says};
use crate::test_scans::Scan;
use crate::test_server::{
    Process, TestServer, ask, assert_contains, database_location, expect_problem, serve_command,
    storage_env, wait_for_job,
};
use crate::vlm::{six_field_reply, vlm_config};
use camino::Utf8Path;
use reqwest::{Method, StatusCode};
use serde_json::{Value, json};
use std::io::{BufRead, BufReader};
use std::process::{Command, Stdio};
use uniground::config::{LimitsConfig, VlmConfig};
use uniground_client::Client;
use uniground_storage::Location;
use uniground_types::batch::{BatchRequest, BatchState};
use uniground_types::keys::{CreatedKey, NewKey, Scope};
use uniground_types::question::{GroundRequest, ReasonerChoice};

const KEY: &str = "ug_0123456789abcdef";
/// Routes that need no key.
const PUBLIC: [&str; 2] = ["/healthz", "/readyz"];

fn new_key(name: &str, scope: Scope) -> NewKey {
    NewKey {
        name: name.into(),
        scope,
        expires_at: None,
        requests_per_minute: None,
        max_scenes: None,
        daily_usd: None,
    }
}

/// Creates a key with `of`, an administrator's client, and returns a client that uses it.
async fn create_key_client(of: &Client, url: &str, new: NewKey) -> (Client, CreatedKey) {
    let created = of.create_key(&new).await.unwrap();
    (Client::new(url, Some(created.secret.clone())).unwrap(), created)
}

/// The first key is created in the stopped server's folder; from then on every request needs one.
#[tokio::test]
async fn a_server_with_a_key_can_listen_on_the_network() {
    let data = tempfile::tempdir().unwrap();
    let folder = Utf8Path::from_path(data.path()).unwrap();
    let key = |args: &[&str]| {
        let mut program = Command::new(env!("CARGO_BIN_EXE_uniground"));
        program.arg("key").args(args).envs(storage_env(folder)).output().unwrap()
    };
    let made = key(&["create", "boss", "--scope", "admin", "--data-dir", folder.as_str()]);
    assert!(made.status.success(), "{}", String::from_utf8_lossy(&made.stderr));
    let secret = String::from_utf8(made.stdout).unwrap().trim().to_owned();
    let process = Process::spawn(&mut serve_command(folder, "0.0.0.0:0"));
    let url = process
        .client
        .request(Method::GET, "")
        .build()
        .unwrap()
        .url()
        .to_string()
        .replace("0.0.0.0", "127.0.0.1");
    let (anonymous, boss) =
        (Client::new(&url, None).unwrap(), Client::new(&url, Some(secret)).unwrap());
    assert_eq!(expect_problem(anonymous.scenes(1, None).await).code, "unauthorized");
    let robot = boss.create_key(&new_key("robot", Scope::Read)).await.unwrap();
    let known = boss.keys(10, None).await.unwrap();
    assert_eq!(
        known.keys.iter().map(|key| key.name.as_str()).collect::<Vec<_>>(),
        ["robot", "boss"]
    );
    assert!(
        !serde_json::to_string(&known).unwrap().contains(&robot.secret),
        "a secret is returned only once"
    );
    let revoked = boss.revoke_key(&robot.key.id).await.unwrap();
    let again = boss.revoke_key(&robot.key.id).await.unwrap();
    assert!(
        revoked.revoked_at.is_some() && again.revoked_at == revoked.revoked_at,
        "{revoked:?} {again:?}"
    );
    let robot = Client::new(&url, Some(robot.secret)).unwrap();
    assert_eq!(expect_problem(robot.scenes(1, None).await).detail, "this key was revoked");
    assert_eq!(
        expect_problem(boss.revoke_key("018f0000-0000-7000-8000-000000000000").await).code,
        "key_not_found"
    );
    let listed = key(&["list", "--data-dir", folder.as_str()]);
    match database_location(folder) {
        Location::Postgres(_) => {
            assert!(
                String::from_utf8_lossy(&listed.stdout).contains("boss"),
                "several processes may use the database"
            );
        }
        _ => assert_contains(
            String::from_utf8_lossy(&listed.stderr),
            "another server uses this data",
        ),
    }
    assert_eq!(process.terminate(), Some(0));
    let listed = String::from_utf8(key(&["list", "--data-dir", folder.as_str()]).stdout).unwrap();
    assert!(listed.contains("boss") && listed.contains("revoked"), "{listed}");
}

/// On an open network, a caller without a key must not create the first one and lock out the
/// others. On loopback anybody may, under any name.
#[tokio::test]
async fn the_first_key_cannot_be_created_over_an_open_network() {
    let data = tempfile::tempdir().unwrap();
    let mut open = serve_command(Utf8Path::from_path(data.path()).unwrap(), "0.0.0.0:0");
    let process = Process::spawn(open.arg("--allow-anybody"));
    let url = process
        .client
        .request(Method::GET, "")
        .build()
        .unwrap()
        .url()
        .to_string()
        .replace("0.0.0.0", "127.0.0.1");
    let stranger = Client::new(&url, None).unwrap();
    assert_eq!(
        expect_problem(stranger.create_key(&new_key("mine", Scope::Admin)).await).code,
        "first_key_by_hand"
    );
    assert!(stranger.scenes(1, None).await.is_ok(), "callers without a key still have access");
    assert_eq!(process.terminate(), Some(0));

    let server = TestServer::start().await;
    let named = async |client: &Client| {
        let request = client.request(Method::GET, "v1/scenes").header("host", "robot.example");
        request.send().await.unwrap().status().as_u16()
    };
    assert_eq!(named(&server.client).await, 421);
    let (admin, _) =
        create_key_client(&server.client, &server.url(), new_key("admin", Scope::Admin)).await;
    assert_eq!((named(&server.client).await, named(&admin).await), (401, 200));
    server.stop().await;
}

/// Every route requires the scope in its description, and no route that changes anything accepts a
/// read key.
#[tokio::test(flavor = "multi_thread")]
async fn every_route_refuses_an_insufficient_scope() {
    let server = TestServer::start().await;
    let url = server.url();
    let (admin, _) = create_key_client(&server.client, &url, new_key("admin", Scope::Admin)).await;
    let (reader, _) = create_key_client(&admin, &url, new_key("reader", Scope::Read)).await;
    let (writer, _) = create_key_client(&admin, &url, new_key("writer", Scope::Write)).await;
    // The requests have a body and change nothing.
    let of_scene =
        ["ground", "shortlist", "approach"].map(|what| format!("/v1/scenes/{{scene_id}}/{what}"));
    let questions: Vec<&str> =
        of_scene.iter().map(String::as_str).chain(["/v1/ground", "/v1/links", "/mcp"]).collect();
    let openapi = serde_json::to_value(uniground::http::openapi()).unwrap();
    let mut asked = [0; 3];
    for (path, operations) in openapi["paths"].as_object().unwrap() {
        for (method, operation) in operations.as_object().unwrap() {
            let method: Method = method.to_uppercase().parse().unwrap();
            let Some(scope) = operation["security"][0]["key"][0].as_str() else {
                assert!(
                    ["/healthz", "/readyz"].contains(&path.as_str()),
                    "{method} {path} requires no key"
                );
                continue;
            };
            let scope = Scope::try_from(scope.to_owned()).unwrap();
            let changes = !method.is_safe() && !questions.contains(&path.as_str());
            assert!(
                !changes || scope > Scope::Read,
                "{method} {path} changes data and accepts a read key"
            );
            for (client, has) in [(&reader, Scope::Read), (&writer, Scope::Write)] {
                let status = client
                    .request(method.clone(), path.trim_start_matches('/'))
                    .send()
                    .await
                    .unwrap()
                    .status();
                assert_eq!(
                    status == StatusCode::FORBIDDEN,
                    has < scope,
                    "{has:?}: {method} {path} {status}"
                );
            }
            asked[scope as usize] += 1;
        }
    }
    assert!(asked.iter().all(|&n| n >= 4), "{asked:?}");
    server.stop().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn a_key_has_a_rate_limit_and_a_scene_limit() {
    let server = TestServer::start().await;
    let url = server.url();
    let (admin, _) = create_key_client(&server.client, &url, new_key("admin", Scope::Admin)).await;
    let (slow, _) = create_key_client(
        &admin,
        &url,
        NewKey { requests_per_minute: Some(3), ..new_key("slow", Scope::Read) },
    )
    .await;
    for left in ["2", "1", "0"] {
        let response = slow.request(Method::GET, "v1/scenes").send().await.unwrap();
        assert_eq!(response.headers()["ratelimit-policy"], "\"key\";q=3;w=60");
        assert!(
            response.headers()["ratelimit"]
                .to_str()
                .unwrap()
                .starts_with(&format!("\"key\";r={left};t="))
        );
    }
    let refused = expect_problem(slow.scenes(1, None).await);
    assert_eq!((refused.status, refused.code.as_str()), (429, "rate_limited"));
    assert!(refused.retry_after_s.is_some_and(|wait| (1..=20).contains(&wait)), "{refused:?}");
    assert!(admin.scenes(1, None).await.is_ok(), "another key has its own rate limit");

    let (robot, _) = create_key_client(
        &admin,
        &url,
        NewKey { max_scenes: Some(1), ..new_key("robot", Scope::Write) },
    )
    .await;
    let upload = async |client: &Client, name: &str, key: &str| {
        client
            .create_scene_once(&[("name", name)], "application/zip", Scan::neutral().zip(), key)
            .await
    };
    let first = upload(&robot, "a", "k").await.unwrap();
    let refused = expect_problem(upload(&robot, "b", "another").await);
    assert_eq!((refused.status, refused.code.as_str()), (403, "quota_used_up"));
    assert_eq!(
        upload(&robot, "a", "k").await.unwrap().scene.id,
        first.scene.id,
        "a retry returns the created scene"
    );
    // The same idempotency key under another API key is a different key.
    assert_ne!(upload(&admin, "a", "k").await.unwrap().scene.id, first.scene.id);
    wait_for_job(&robot, &first.job.unwrap().id).await;
    robot.delete_scene(&first.scene.id).await.unwrap();
    upload(&robot, "b", "another").await.unwrap();
    server.stop().await;
}

/// A key's daily budget covers all its questions, including its batches, and is shared with no
/// other key.
#[tokio::test(flavor = "multi_thread")]
async fn a_key_has_its_own_daily_budget() {
    let script = Script::default();
    let model = VlmConfig {
        vlm_prompt_usd: 1000.0,
        vlm_completion_usd: 5000.0,
        ..vlm_config(&script.serve(vec![says("-")]).await)
    };
    let server = TestServer::start_configured(LimitsConfig::default(), model).await;
    let url = server.url();
    let scene = server.upload_and_parse(Scan::neutral().zip()).await.id;
    let (admin, _) = create_key_client(&server.client, &url, new_key("admin", Scope::Admin)).await;
    let (robot, key) = create_key_client(
        &admin,
        &url,
        NewKey { daily_usd: Some(20.0), ..new_key("robot", Scope::Write) },
    )
    .await;
    script.next(vec![six_field_reply(1, "", true, 1)]);
    let by_model = GroundRequest { reasoner: ReasonerChoice::Vlm, ..ask("the red sofa") };
    let mut paid = 0;
    let refused = loop {
        match robot.ground(&scene, &by_model).await {
            Ok(_) => paid += 1,
            refused => break expect_problem(refused),
        }
        assert!(paid < 40, "the key's budget is never exhausted");
    };
    assert!(
        paid > 1 && refused.code == "budget_spent" && refused.detail.contains("this key today"),
        "{paid} {refused:?}"
    );
    assert!(admin.ground(&scene, &by_model).await.is_ok(), "another key has its own budget");
    let spent = admin
        .keys(10, None)
        .await
        .unwrap()
        .keys
        .into_iter()
        .find(|known| known.id == key.key.id)
        .unwrap()
        .spent_today_usd;
    assert!(spent > 0.5 * f64::from(paid) && spent <= 20.0, "{paid} calls, {spent} USD");
    let batch: BatchRequest =
        serde_json::from_value(json!({"items": [{"query": "the red sofa", "reasoner": "vlm"}], "defaults": {"scene_id": scene}})).unwrap();
    let calls = script.calls();
    let batch = robot.create_batch(&batch, None).await.unwrap();
    wait_for_job(&robot, batch.job_id.as_deref().unwrap()).await;
    let waits = robot.batch(&batch.id).await.unwrap();
    assert_eq!(
        (waits.state, waits.reason.as_deref(), script.calls()),
        (BatchState::Paused, Some("budget_spent"), calls)
    );
    server.stop().await;
}

/// A batch stops when its key is revoked; another key can resume it.
#[tokio::test(flavor = "multi_thread")]
async fn a_batch_stops_when_its_key_is_revoked() {
    let script = Script::default();
    let model = vlm_config(&script.serve(vec![crate::scripted_model::Scripted::Stall]).await);
    let server = TestServer::start_configured(LimitsConfig::default(), model).await;
    let url = server.url();
    let scene = server.upload_and_parse(Scan::neutral().zip()).await.id;
    let (admin, _) = create_key_client(&server.client, &url, new_key("admin", Scope::Admin)).await;
    let (robot, key) = create_key_client(&admin, &url, new_key("robot", Scope::Write)).await;
    let items: Vec<Value> = (0..3).map(|_| json!({"query": "the red sofa"})).collect();
    let request = json!({"items": items, "defaults": {"scene_id": scene, "reasoner": "vlm", "timeout_s": 0.5}, "concurrency": 1});
    let batch = robot.create_batch(&serde_json::from_value(request).unwrap(), None).await.unwrap();
    admin.control_batch(&batch.id, "pause").await.unwrap();
    wait_for_job(&admin, batch.job_id.as_deref().unwrap()).await;
    admin.revoke_key(&key.key.id).await.unwrap();
    let resumed = admin.control_batch(&batch.id, "resume").await.unwrap();
    wait_for_job(&admin, resumed.job_id.as_deref().unwrap()).await;
    let paused = admin.batch(&batch.id).await.unwrap();
    assert_eq!((paused.state, paused.reason.as_deref()), (BatchState::Paused, Some("key_refused")));
    server.stop().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn the_audit_log_records_the_key_and_the_outcome() {
    let server = TestServer::start().await;
    let url = server.url();
    let (admin, _) = create_key_client(&server.client, &url, new_key("admin", Scope::Admin)).await;
    let (robot, key) = create_key_client(&admin, &url, new_key("robot", Scope::Write)).await;
    let scene = robot
        .create_scene(Some("kitchen"), "application/zip", Scan::neutral().zip())
        .await
        .unwrap()
        .scene;
    robot.scene(&scene.id).await.unwrap();
    assert!(
        robot.delete_scene("018f0000-0000-7000-8000-000000000000").await.is_err(),
        "a key without the scope deleted a scene"
    );
    assert!(robot.keys(1, None).await.is_err(), "a key without the scope listed keys");
    let page = admin.audit(2, None).await.unwrap();
    let rest = admin.audit(10, page.next_cursor.as_deref()).await.unwrap();
    let told: Vec<(&str, &str, u16, bool)> = page
        .entries
        .iter()
        .chain(&rest.entries)
        .map(|entry| {
            (
                entry.method.as_str(),
                entry.path.as_str(),
                entry.status,
                entry.key_id.as_ref() == Some(&key.key.id),
            )
        })
        .collect();
    let expected = [
        ("DELETE", "/v1/scenes/018f0000-0000-7000-8000-000000000000", 404, true),
        ("POST", "/v1/scenes", 202, true),
        ("POST", "/v1/keys", 201, false),
        ("POST", "/v1/keys", 201, false),
    ];
    assert_eq!(told, expected, "reads are not in the audit log");
    assert!(page.entries.iter().all(|entry| entry.request_id.is_some()), "{:?}", page.entries);
    server.stop().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn answers_and_jobs_can_be_filtered() {
    let server = TestServer::start().await;
    let client = &server.client;
    let [a, b] = [
        server.upload_and_parse(Scan::neutral().zip()).await.id,
        server.upload_and_parse(Scan::neutral().zip()).await.id,
    ];
    let mut given = Vec::new();
    for (scene, query) in [(&a, "the red sofa"), (&a, "the purple beds"), (&b, "the red sofa")] {
        given.push(client.ground(scene, &ask(query)).await.unwrap());
    }
    let ids = async |query: &[(&str, &str)]| {
        let page = client.answers(query).await.unwrap();
        (page.answers.into_iter().map(|answer| answer.id).collect::<Vec<_>>(), page.next_cursor)
    };
    let of = |indices: &[usize]| indices.iter().map(|&i| given[i].id.clone()).collect::<Vec<_>>();
    assert_eq!(ids(&[]).await, (of(&[2, 1, 0]), None));
    let (first, cursor) = ids(&[("limit", "2")]).await;
    assert_eq!(
        (first, ids(&[("cursor", &cursor.unwrap())]).await),
        (of(&[2, 1]), (of(&[0]), None))
    );
    assert_eq!(ids(&[("scene_id", &a)]).await.0, of(&[1, 0]));
    assert_eq!(ids(&[("scene_id", &a), ("status", "no_match")]).await.0, of(&[1]));
    assert_eq!(ids(&[("since", "2100-01-01T00:00:00Z")]).await.0, of(&[]));
    assert_eq!(
        ids(&[("since", "2020-01-01T00:00:00Z"), ("until", "2100-01-01T00:00:00Z")]).await.0.len(),
        3
    );
    let batch: BatchRequest =
        serde_json::from_value(json!({"items": [{"query": "the red sofa", "scene_id": b}]}))
            .unwrap();
    let batch = client.create_batch(&batch, None).await.unwrap();
    wait_for_job(client, batch.job_id.as_deref().unwrap()).await;
    assert_eq!(ids(&[("batch_id", &batch.id)]).await.0.len(), 1);
    let bad = client.answers(&[("since", "yesterday")]).await;
    assert_eq!(expect_problem(bad).errors[0].pointer, "since");

    let lines = String::from_utf8(client.bytes("v1/answers?format=jsonl").await.unwrap()).unwrap();
    assert!(
        lines.lines().count() == 4
            && lines.lines().all(|line| serde_json::from_str::<Value>(line).is_ok())
    );
    let table = String::from_utf8(
        client.bytes(&format!("v1/answers?format=csv&scene_id={a}")).await.unwrap(),
    )
    .unwrap();
    let rows: Vec<&str> = table.lines().collect();
    assert!(
        rows.len() == 3
            && rows[0].starts_with("answer_id,scene_id,query,status,predicted_id")
            && rows[1].contains("the purple beds,no_match")
    );

    let kinds = async |query: &[(&str, &str)]| {
        client
            .jobs(query)
            .await
            .unwrap()
            .jobs
            .into_iter()
            .map(|job| (job.kind, job.subject))
            .collect::<Vec<_>>()
    };
    let parse = |scene: &str| ("parse".to_owned(), scene.to_owned());
    assert_eq!(kinds(&[("kind", "parse")]).await, [parse(&b), parse(&a)]);
    assert_eq!(kinds(&[("kind", "parse"), ("limit", "1")]).await, [parse(&b)]);
    assert_eq!(kinds(&[("subject", &a)]).await, [parse(&a)]);
    assert_eq!(kinds(&[("state", "succeeded")]).await[0], ("batch".to_owned(), batch.id.clone()));
    assert!(kinds(&[("state", "failed")]).await.is_empty());
    server.stop().await;
}

#[test]
fn a_network_address_without_a_key_is_refused_at_startup() {
    let data = tempfile::tempdir().unwrap();
    let refused =
        serve_command(Utf8Path::from_path(data.path()).unwrap(), "0.0.0.0:0").output().unwrap();
    let message = String::from_utf8_lossy(&refused.stderr);
    assert_eq!(refused.status.code(), Some(1), "{message}");
    assert!(message.contains("UNIGROUND_API_KEY"), "{message}");
}

#[tokio::test]
async fn every_route_except_health_requires_the_configured_key() {
    let data = tempfile::tempdir().unwrap();
    let mut child = serve_command(Utf8Path::from_path(data.path()).unwrap(), "127.0.0.1:0")
        .env("UNIGROUND_API_KEY", KEY)
        .stdout(Stdio::piped())
        .stderr(Stdio::null())
        .spawn()
        .unwrap();
    let mut line = String::new();
    BufReader::new(child.stdout.take().unwrap()).read_line(&mut line).unwrap();
    let address = line.trim().strip_prefix("listening on ").unwrap().to_owned();
    let (anonymous, known) =
        (Client::new(&address, None).unwrap(), Client::new(&address, Some(KEY.into())).unwrap());
    let wrong = Client::new(&address, Some("ug_something_else".into())).unwrap();

    let openapi: serde_json::Value =
        serde_json::from_slice(&anonymous.bytes("openapi.json").await.unwrap()).unwrap();
    let mut asked = 0;
    for (path, operations) in openapi["paths"].as_object().unwrap() {
        for method in operations.as_object().unwrap().keys() {
            let method: Method = method.to_uppercase().parse().unwrap();
            for client in [&anonymous, &wrong] {
                let response = client
                    .request(method.clone(), path.trim_start_matches('/'))
                    .send()
                    .await
                    .unwrap();
                let expected_open = PUBLIC.contains(&path.as_str());
                assert_eq!(
                    response.status().as_u16() == 401,
                    !expected_open,
                    "{method} {path}: {}",
                    response.status()
                );
                if !expected_open {
                    assert_eq!(response.headers()["www-authenticate"], "Bearer");
                }
            }
            asked += 1;
        }
    }
    assert!(asked >= 15, "only {asked} operations found");
    assert_eq!(known.scenes(1, None).await.unwrap().scenes, []);
    let process = Process { client: known, child };
    assert_eq!(process.terminate(), Some(0));
}
