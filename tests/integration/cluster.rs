//! Several processes over one database: servers that answer, workers that do what waits. With
//! SQLite there is one.

use crate::archives::Scan;
use crate::server::{ask, config, finished, location, problem, rows};
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

/// Whether several may use a database; if not, that is told in place of a test.
fn may_have_company(data: &Utf8Path) -> bool {
    let may = matches!(location(data), Location::Postgres(_));
    if !may {
        eprintln!("left out: several processes want PostgreSQL (make test-postgres)");
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

async fn server(data: &Utf8Path, role: Role) -> (RunningService, Client) {
    let running = app::start(&ServeConfig { role, ..config(data) }).await.unwrap();
    let client = Client::new(&format!("http://{}", running.address), None).unwrap();
    (running, client)
}

async fn worker(data: &Utf8Path, kinds: &[JobType]) -> RunningService {
    let worker = WorkerConfig { kinds: kinds.to_vec(), concurrency: Some(2), serve: config(data) };
    app::start_role(&worker.serve, &ProcessRole::from(&worker)).await.unwrap()
}

#[tokio::test]
async fn a_part_wants_others() {
    let place = tempfile::tempdir().unwrap();
    let data = Utf8Path::from_path(place.path()).unwrap();
    let alone = ServeConfig { role: Role::Api, ..config(data) };
    let alone = ServeConfig { database: uniground::config::DatabaseConfig::default(), ..alone };
    let refused = app::start(&alone).await.err().unwrap().to_string();
    assert!(refused.contains("--database postgres://"), "{refused}");
    assert!(
        !data.join("uniground-data.json").exists(),
        "nothing is made of a folder that is not used"
    );
}

/// What one server is asked a worker does, another server tells, and what is changed at one is
/// changed at the other.
#[tokio::test]
async fn servers_agree_and_workers_work() {
    let place = tempfile::tempdir().unwrap();
    let data = Utf8Path::from_path(place.path()).unwrap();
    if !may_have_company(data) {
        return;
    }
    let (first, a) = server(data, Role::Api).await;
    let (second, b) = server(data, Role::Api).await;
    let created = a.create_scene(None, "application/zip", Scan::neutral().zip()).await.unwrap();
    let job = created.job.unwrap();
    sleep(Duration::from_millis(300)).await;
    assert_eq!(b.job(&job.id).await.unwrap().state, JobState::Queued, "nobody works yet");
    let naming = worker(data, &[JobType::Naming]).await;
    let parsing = worker(data, &[JobType::Parse, JobType::Batch]).await;
    let health = reqwest::get(format!("http://{}/readyz", parsing.address)).await.unwrap();
    assert_eq!(health.status(), 200);
    let nothing_else = reqwest::get(format!("http://{}/v1/scenes", parsing.address)).await.unwrap();
    assert_eq!(nothing_else.status(), 404, "a worker answers no questions");
    assert_eq!(finished(&b, &job.id).await.state, JobState::Succeeded);

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

    // Both have the scene in memory; what people say at one is heard at the other, at once.
    for (here, there, name) in [(&a, &b, "Grandma's bench"), (&b, &a, "Grandpa's bench")] {
        here.correct(&scene, &Change::Rename { instance_id: sofa, name: name.into() })
            .await
            .unwrap();
        let told = there.ground(&scene, &ask("the bench")).await.unwrap();
        assert!(told.targets[0].name.contains(name), "{told:?}");
        let listed = there.all_instances(&scene, Levels::Things).await.unwrap();
        assert!(listed.iter().any(|i| i.id == sofa && i.label == name));
    }

    // A list is asked by whoever works, and read anywhere.
    let items = serde_json::json!({"items": [{"scene_id": scene, "query": "the red sofa"}, {"scene_id": scene, "query": "the bin"}]});
    let batch = a.create_batch(&serde_json::from_value(items).unwrap(), None).await.unwrap();
    finished(&b, batch.job_id.as_deref().unwrap()).await;
    same(&format!("batches/{}/results", batch.id)).await;

    // A scene that is gone is gone everywhere.
    b.delete_scene(&scene).await.unwrap();
    assert_eq!(problem(a.ground(&scene, &ask("the red sofa")).await).status, 404);

    // The first key locks every door, soon; one that is revoked opens none.
    let key = a.create_key(&new_key()).await.unwrap();
    let with_key = |running: &RunningService| {
        Client::new(&format!("http://{}", running.address), Some(key.secret.clone())).unwrap()
    };
    let (a_with, b_with) = (with_key(&first), with_key(&second));
    until("the key is wanted everywhere", async || {
        b.scenes(1, None).await.is_err() && b_with.scenes(1, None).await.is_ok()
    })
    .await;
    a_with.revoke_key(&key.key.id).await.unwrap();
    until("the key is refused everywhere", async || b_with.scenes(1, None).await.is_err()).await;

    for running in [first, second, naming, parsing] {
        running.stop().await.unwrap();
    }
}

/// What somebody has in hands stays there as long as he is seen; who is not seen any more loses it.
#[tokio::test]
async fn the_job_of_one_who_is_gone_goes_on_elsewhere() {
    let place = tempfile::tempdir().unwrap();
    let data = Utf8Path::from_path(place.path()).unwrap();
    if !may_have_company(data) {
        return;
    }
    let mut short = config(data);
    short.database.lease_s = 10;
    let api = app::start(&ServeConfig { role: Role::Api, ..short.clone() }).await.unwrap();
    let client = Client::new(&format!("http://{}", api.address), None).unwrap();
    let job = client
        .create_scene(None, "application/zip", Scan::neutral().zip())
        .await
        .unwrap()
        .job
        .unwrap();
    // Somebody has taken it who is seen once more, and then never again.
    let mut rows = rows(data).await;
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
    assert_eq!((state.state, state.attempts), (JobState::Running, 1), "he may only be slow");
    let done = finished(&client, &job.id).await;
    assert_eq!((done.state, done.attempts), (JobState::Succeeded, 2));
    other.stop().await.unwrap();
    api.stop().await.unwrap();
}

/// A key's requests are counted wherever they come to.
#[tokio::test]
async fn a_rate_holds_at_all_servers_together() {
    let place = tempfile::tempdir().unwrap();
    let data = Utf8Path::from_path(place.path()).unwrap();
    if !may_have_company(data) {
        return;
    }
    let (first, a) = server(data, Role::Api).await;
    let (second, b) = server(data, Role::Api).await;
    let mut new = new_key();
    new.requests_per_minute = Some(6);
    let secret = a.create_key(&new).await.unwrap().secret;
    until("the key is wanted everywhere", async || b.scenes(1, None).await.is_err()).await;
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

async fn until(what: &str, is_so: impl AsyncFn() -> bool) {
    for _ in 0..200 {
        if is_so().await {
            return;
        }
        sleep(Duration::from_millis(50)).await;
    }
    panic!("it never came to be that {what}");
}
