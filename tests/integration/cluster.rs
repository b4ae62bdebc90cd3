//! Several processes over one database: API servers that answer and workers that run queued jobs.
//! SQLite allows only one process.

use crate::test_scans::Scan;
use crate::test_server::{
    ask, database_location, expect_problem, open_database, serve_config, wait_for_job,
};
use camino::Utf8Path;
use std::time::Duration;
use tokio::time::sleep;
use uniground::app::{self, RunningService};
use uniground::config::{JobType, ProcessRole, Role, ServeConfig, WorkerConfig};
use uniground_client::Client;
use uniground_storage::Location;
use uniground_types::corrections::Change;
use uniground_types::instances::Levels;
use uniground_types::job::JobState;
use uniground_types::keys::{NewKey, Scope};

/// Returns whether several processes may share the database. If not, prints why the test is
/// skipped.
fn supports_several_processes(data: &Utf8Path) -> bool {
    let may = matches!(database_location(data), Location::Postgres(_));
    if !may {
        eprintln!("skipped: several processes require PostgreSQL (make test-postgres)");
    }
    may
}

fn new_key() -> NewKey {
    NewKey {
        name: "robot".into(),
        scope: Scope::Admin,
        expires_at: None,
        requests_per_minute: None,
        max_scenes: None,
        daily_usd: None,
    }
}

async fn start_server(data: &Utf8Path, role: Role) -> (RunningService, Client) {
    let running = app::start(&ServeConfig { role, ..serve_config(data) }).await.unwrap();
    let client = Client::new(&format!("http://{}", running.address), None).unwrap();
    (running, client)
}

async fn start_worker(data: &Utf8Path, kinds: &[JobType]) -> RunningService {
    let worker =
        WorkerConfig { kinds: kinds.to_vec(), concurrency: Some(2), serve: serve_config(data) };
    app::start_role(&worker.serve, &ProcessRole::from(&worker)).await.unwrap()
}

#[tokio::test]
async fn an_api_or_worker_role_requires_a_shared_database() {
    let place = tempfile::tempdir().unwrap();
    let data = Utf8Path::from_path(place.path()).unwrap();
    let alone = ServeConfig { role: Role::Api, ..serve_config(data) };
    let alone = ServeConfig { database: uniground::config::DatabaseConfig::default(), ..alone };
    let refused = app::start(&alone).await.err().unwrap().to_string();
    assert!(refused.contains("--database postgres://"), "{refused}");
    assert!(!data.join("uniground-data.json").exists(), "a refused start creates no files");
}

/// A worker runs what one server enqueues, another server reports it, and a change made at one
/// server is visible at the other.
#[tokio::test]
async fn servers_share_state_and_workers_run_jobs() {
    let place = tempfile::tempdir().unwrap();
    let data = Utf8Path::from_path(place.path()).unwrap();
    if !supports_several_processes(data) {
        return;
    }
    let (first, a) = start_server(data, Role::Api).await;
    let (second, b) = start_server(data, Role::Api).await;
    let created = a.create_scene(None, "application/zip", Scan::neutral().zip()).await.unwrap();
    let job = created.job.unwrap();
    sleep(Duration::from_millis(300)).await;
    assert_eq!(b.job(&job.id).await.unwrap().state, JobState::Queued, "no worker is running");
    let naming = start_worker(data, &[JobType::Naming]).await;
    let parsing = start_worker(data, &[JobType::Parse, JobType::Batch]).await;
    let health = reqwest::get(format!("http://{}/readyz", parsing.address)).await.unwrap();
    assert_eq!(health.status(), 200);
    let nothing_else = reqwest::get(format!("http://{}/v1/scenes", parsing.address)).await.unwrap();
    assert_eq!(nothing_else.status(), 404, "a worker answers no questions");
    assert_eq!(wait_for_job(&b, &job.id).await.state, JobState::Succeeded);

    let scene = created.scene.id;
    let bytes =
        async |client: &Client, path: &str| client.bytes(&format!("v1/{path}")).await.unwrap();
    let same =
        async |path: &str| assert_eq!(bytes(&a, path).await, bytes(&b, path).await, "{path}");
    let answer = a.ground(&scene, &ask("the red sofa")).await.unwrap();
    for path in [
        format!("scenes/{scene}"),
        format!("scenes/{scene}/instances"),
        format!("answers/{}", answer.id),
        format!("scenes/{scene}/report"),
    ] {
        same(&path).await;
    }
    let sofa = answer.answer.predicted_id.unwrap();
    assert_eq!(
        b.ground(&scene, &ask("the red sofa")).await.unwrap().answer.predicted_id,
        Some(sofa)
    );

    // Both servers have the scene in memory. A correction made at one applies at the other at once.
    for (here, there, name) in [(&a, &b, "Grandma's bench"), (&b, &a, "Grandpa's bench")] {
        here.correct(&scene, &Change::Rename { instance_id: sofa, name: name.into() })
            .await
            .unwrap();
        let told = there.ground(&scene, &ask("the bench")).await.unwrap();
        assert!(told.targets[0].name.contains(name), "{told:?}");
        let listed = there.all_instances(&scene, Levels::Things).await.unwrap();
        assert!(
            listed.iter().any(|i| i.id == sofa && i.label == name),
            "{sofa:?} is not called {name}: {listed:?}"
        );
    }

    // Any worker runs a batch, and every server can read it.
    let items = serde_json::json!({"items": [{"scene_id": scene, "query": "the red sofa"}, {"scene_id": scene, "query": "the bin"}]});
    let batch = a.create_batch(&serde_json::from_value(items).unwrap(), None).await.unwrap();
    wait_for_job(&b, batch.job_id.as_deref().unwrap()).await;
    same(&format!("batches/{}/results", batch.id)).await;

    // A scene deleted at one server is gone at all of them.
    b.delete_scene(&scene).await.unwrap();
    assert_eq!(expect_problem(a.ground(&scene, &ask("the red sofa")).await).status, 404);

    // The first key closes access at every server within a short time; a revoked key opens none.
    let key = a.create_key(&new_key()).await.unwrap();
    let with_key = |running: &RunningService| {
        Client::new(&format!("http://{}", running.address), Some(key.secret.clone())).unwrap()
    };
    let (a_with, b_with) = (with_key(&first), with_key(&second));
    wait_until("every server requires the key", async || {
        b.scenes(1, None).await.is_err() && b_with.scenes(1, None).await.is_ok()
    })
    .await;
    a_with.revoke_key(&key.key.id).await.unwrap();
    wait_until("every server refuses the key", async || b_with.scenes(1, None).await.is_err())
        .await;

    for running in [first, second, naming, parsing] {
        running.stop().await.unwrap();
    }
}

/// A process keeps its jobs while it sends heartbeats and loses them once the heartbeats stop.
#[tokio::test]
async fn a_job_of_a_lost_process_is_taken_over() {
    let place = tempfile::tempdir().unwrap();
    let data = Utf8Path::from_path(place.path()).unwrap();
    if !supports_several_processes(data) {
        return;
    }
    let mut short = serve_config(data);
    short.database.lease_s = 10;
    let api = app::start(&ServeConfig { role: Role::Api, ..short.clone() }).await.unwrap();
    let client = Client::new(&format!("http://{}", api.address), None).unwrap();
    let job = client
        .create_scene(None, "application/zip", Scan::neutral().zip())
        .await
        .unwrap()
        .job
        .unwrap();
    // A process that does not exist holds the job: its last heartbeat is recent, and none follows.
    let mut rows = open_database(data).await;
    for sql in [
        "INSERT INTO members (id, seen_at) VALUES ('ghost', extract(epoch FROM clock_timestamp()))"
            .to_owned(),
        format!(
            "UPDATE jobs SET state = 'running', holder = 'ghost', attempts = 1 WHERE id = '{}'",
            job.id
        ),
    ] {
        sqlx::query(sqlx::AssertSqlSafe(sql)).execute(&mut rows).await.unwrap();
    }
    let worker = WorkerConfig { kinds: vec![JobType::Parse], concurrency: None, serve: short };
    let other = app::start_role(&worker.serve, &ProcessRole::from(&worker)).await.unwrap();
    sleep(Duration::from_secs(4)).await;
    let state = client.job(&job.id).await.unwrap();
    assert_eq!((state.state, state.attempts), (JobState::Running, 1), "the lease has not expired");
    let done = wait_for_job(&client, &job.id).await;
    assert_eq!((done.state, done.attempts), (JobState::Succeeded, 2));
    other.stop().await.unwrap();
    api.stop().await.unwrap();
}

/// All servers count a key's requests together.
#[tokio::test]
async fn a_rate_limit_applies_across_all_servers() {
    let place = tempfile::tempdir().unwrap();
    let data = Utf8Path::from_path(place.path()).unwrap();
    if !supports_several_processes(data) {
        return;
    }
    let (first, a) = start_server(data, Role::Api).await;
    let (second, b) = start_server(data, Role::Api).await;
    let mut new = new_key();
    new.requests_per_minute = Some(6);
    let secret = a.create_key(&new).await.unwrap().secret;
    wait_until("every server requires the key", async || b.scenes(1, None).await.is_err()).await;
    let with_key = |running: &RunningService| format!("http://{}/v1/scenes", running.address);
    let mut told = Vec::new();
    for at in [&first, &second, &first, &second, &first, &second, &first, &second] {
        let reply =
            reqwest::Client::new().get(with_key(at)).bearer_auth(&secret).send().await.unwrap();
        told.push((
            reply.status().as_u16(),
            reply.headers()["ratelimit"].to_str().unwrap().to_owned(),
        ));
    }
    let (statuses, left): (Vec<u16>, Vec<String>) = told.into_iter().unzip();
    assert_eq!(statuses, [200, 200, 200, 200, 200, 200, 429, 429], "{left:?}");
    assert!(left[0].contains("r=5;t=10") && left[5].contains("r=0;t=60"), "{left:?}");
    first.stop().await.unwrap();
    second.stop().await.unwrap();
}

async fn wait_until(what: &str, is_so: impl AsyncFn() -> bool) {
    for _ in 0..200 {
        if is_so().await {
            return;
        }
        sleep(Duration::from_millis(50)).await;
    }
    panic!("timed out waiting until {what}");
}
