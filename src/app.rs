//! Composition root: builds the running service from the configuration and stops it cleanly. Only
//! this file knows all parts.

use crate::config::{ChosenModels, JobType, ProcessRole, ServeConfig, Vectors};
use crate::http::{self, AllowedHosts, App, EventStreams, Mcp, Origins};
use anyhow::{Context, ensure};
use std::net::SocketAddr;
use std::sync::Arc;
use std::time::Duration;
use tokio::net::TcpListener;
use tokio::task::JoinHandle;
use tokio::time::{sleep, timeout};
use tokio_util::sync::CancellationToken;
use uniground_core::background;
use uniground_endpoints::chat::{ChatClient, ReplayCache};
use uniground_endpoints::inference::Probe;
use uniground_evaluation::model_check::check_pictures;
use uniground_jobs::{JobKind, Jobs};
use uniground_service::{
    BatchJob, Dependencies, FullParseJob, Keyring, NamingJob, ParseJob, Services, Vlm, VlmSettings,
};
use uniground_storage::{BlobsAt, DbNotification, Location, NotificationListener, Store};
use uniground_telemetry::metrics::Metrics;

/// A running service.
pub struct RunningService {
    /// The address it listens on, with the port that the system chose.
    pub address: SocketAddr,
    services: Services,
    shutdown: CancellationToken,
    server: JoinHandle<()>,
    lanes: Vec<JoinHandle<()>>,
    store: Store,
}

/// Starts the whole service, or the parts that the server's role includes.
///
/// # Errors
/// Returns an error when the address, the data folder or the key cannot be used.
pub async fn start(config: &ServeConfig) -> anyhow::Result<RunningService> {
    start_role(config, &config.role.into()).await
}

/// Starts a part of the service. Other processes with the same database do the rest.
///
/// # Errors
/// Returns the errors of [`start`], and an error for a part if the database supports a single
/// process only.
pub async fn start_role(
    config: &ServeConfig,
    part: &ProcessRole,
) -> anyhow::Result<RunningService> {
    // The future is large. Boxing it keeps the caller's future small.
    Box::pin(build_app(config, part)).await
}

async fn build_app(config: &ServeConfig, part: &ProcessRole) -> anyhow::Result<RunningService> {
    ensure!(
        !part.requires_other_processes()
            || matches!(config.database.location, Location::Postgres(_)),
        "a process with only a part of the work needs a shared database: set --database \
         postgres://…, or run everything with \"uniground serve\""
    );
    let api_key = config.api_key()?;
    let webhook = config.webhook.webhook()?;
    let store = Store::open_with(
        &config.data_dir,
        &config.database.location,
        &config.blobs.blob_home()?,
        config.database.lease(),
    )
    .await
    .with_context(|| {
        format!("the data folder {}{}", config.data_dir, describe_external_stores(config))
    })?;
    if config.database.vectors == Vectors::Pgvector {
        store.room_index.enable_vectors().await?;
    }
    let mut keys = Keyring::open(&store, api_key.as_deref()).await?;
    if let Some(secret) = config.access.link_secret()? {
        keys = keys.with_link_secret(secret);
    }
    ensure!(
        keys.has_keys() || !config.requires_keys(),
        "{} can be reached from other machines and no key is set: create one (uniground key \
         create), set UNIGROUND_API_KEY or --api-key-file, or pass --allow-anybody",
        config.listen
    );
    // On a network address, keys exist or the operator has allowed access without keys.
    let is_private = config.listen.ip().is_loopback();
    let metrics = Arc::<Metrics>::default();
    let jobs =
        Jobs::new(store.jobs.clone(), config.limits.max_queued_jobs).with_metrics(metrics.clone());
    let models = tokio::task::spawn_blocking({
        let config = config.models.clone();
        move || config.load()
    });
    let ChosenModels { models, summary, warnings } = models.await??;
    warnings.iter().for_each(|warning| tracing::warn!("{warning}"));
    tracing::info!("{summary}");
    for model in &models.loaded {
        tracing::info!(
            name = model.name,
            fingerprint = model.fingerprint,
            runs_on = model.runs_on,
            "model loaded"
        );
    }
    let vlm_settings = VlmSettings {
        daily_usd: config.vlm.vlm_daily_usd,
        json: config.vlm.vlm_json,
        points: config.vlm.vlm_points.into(),
        limits: config.vlm.picture_limits(),
        names: config.vlm.names.into(),
    };
    let chat = config.vlm.client(ReplayCache::Off)?.map(Arc::new);
    let vlm = chat.clone().map(|chat| Vlm::new(chat, vlm_settings, &store, metrics.clone()));
    let pool = || background::low_priority_pool().context("threads for parses");
    let inference =
        config.models.bundles.inference_url.as_deref().filter(|_| !models.loaded.is_empty());
    let inference =
        inference.map(Probe::new).transpose().context("a client for the inference server")?;
    let services = Services::new(Dependencies {
        store: store.clone(),
        jobs: jobs.clone(),
        keyring: keys,
        limits: config.limits.service_limits(),
        vlm,
        models,
        parse_pool: pool()?,
        full_parse_pool: pool()?,
        parse_mode: config.parse.into(),
        reader: config.limits.scan_reader(),
        import_root: config.access.import_root.clone(),
        inference,
        explain: http::to_problem,
    });
    let listener = TcpListener::bind(config.listen)
        .await
        .with_context(|| format!("cannot listen on {}", config.listen))?;
    let address = listener.local_addr()?;

    let shutdown = CancellationToken::new();
    services.webhooks.set_deliveries_enabled(webhook.as_ref()).await?;
    // Other running processes may be of a newer version, with job kinds unknown here.
    if store.locks.was_alone_at_start() {
        jobs.fail_unknown_kinds(&JobType::ALL.map(JobType::kinds).concat()).await?;
    }
    let parse_job =
        || ParseJob { runner: services.parse_runner.clone(), naming: services.naming.clone() };
    let at_once = part.concurrency;
    let start = |work: &JobType| match work {
        JobType::Parse => vec![
            start_lane(&jobs, parse_job(), at_once, &shutdown),
            start_lane(&jobs, FullParseJob(parse_job()), at_once, &shutdown),
        ],
        JobType::Naming => {
            vec![start_lane(&jobs, NamingJob(services.naming.clone()), at_once, &shutdown)]
        }
        JobType::Batch => {
            vec![start_lane(&jobs, BatchJob(services.batch_runner.clone()), at_once, &shutdown)]
        }
    };
    let lanes = part.works.iter().flat_map(start).collect();
    tokio::spawn(run_maintenance(services.clone(), shutdown.clone()));
    tokio::spawn(update_room_index(services.clone(), shutdown.clone()));
    tokio::spawn(restore_reserve_when_possible(store.clone(), shutdown.clone()));
    if part.serves {
        tokio::spawn(complete_pending_uploads(services.clone(), shutdown.clone()));
    }
    if let Some(listen) = store.notifications.listen().await? {
        tokio::spawn(handle_notifications(
            listen,
            jobs.clone(),
            services.keyring.clone(),
            shutdown.clone(),
        ));
    }
    if let Some(chat) = chat {
        tokio::spawn(check_model_server(chat, services.clone(), config.vlm_check));
    }
    if let Some(webhook) = webhook {
        tokio::spawn(
            services.webhooks.clone().deliver_webhooks(Arc::new(webhook), shutdown.clone()),
        );
    }
    let most = most_connections(config.limits.max_connections);
    let app = App {
        services: services.clone(),
        scopes: Arc::new(http::scopes()),
        shutdown: shutdown.clone(),
        metrics: metrics.clone(),
        allowed_hosts: is_private
            .then(|| Arc::new(AllowedHosts::new(&config.access.allowed_hosts))),
        origins: Origins::new(&config.access.cors_origins).context("--cors-origin")?,
        event_streams: EventStreams::for_connections(most),
        mcp: Mcp::over_http(services.clone(), shutdown.child_token()),
    };
    let router = if part.serves { http::router(app) } else { http::worker_router(app) };
    let server = tokio::spawn(http::serve(listener, router, most, metrics, shutdown.clone()));
    Ok(RunningService { address, services, shutdown, server, lanes, store })
}

/// Describes the stores outside of the data folder.
fn describe_external_stores(config: &ServeConfig) -> String {
    let database = Some(&config.database.location)
        .filter(|at| **at != Location::Folder)
        .map(ToString::to_string);
    let blobs =
        Some(&config.blobs.at).filter(|at| **at != BlobsAt::Folder).map(ToString::to_string);
    let named: Vec<String> = database.into_iter().chain(blobs).collect();
    if named.is_empty() { String::new() } else { format!(" with {}", named.join(" and ")) }
}

/// Starts the lane of a kind of job.
fn start_lane<K: JobKind>(
    jobs: &Jobs,
    kind: K,
    at_once: Option<usize>,
    shutdown: &CancellationToken,
) -> JoinHandle<()> {
    let (jobs, shutdown) = (jobs.clone(), shutdown.clone());
    tokio::spawn(async move {
        jobs.run_lane(Arc::new(kind), at_once.unwrap_or(K::CONCURRENCY), shutdown).await;
    })
}

/// Handles notifications of other processes: wakes lanes and reloads keys.
async fn handle_notifications(
    mut listen: NotificationListener,
    jobs: Jobs,
    keys: Keyring,
    shutdown: CancellationToken,
) {
    /// Notifications can get lost without an error. After this time, everything is checked.
    const POLL_INTERVAL: Duration = Duration::from_secs(10);
    const TROUBLE: Duration = Duration::from_secs(2);
    // Notifications before the first one count as missed too.
    let mut news = DbNotification::ConnectionLost;
    loop {
        match &news {
            DbNotification::JobQueued { kind } => jobs.wake_lanes(Some(kind)),
            DbNotification::KeysChanged => {}
            DbNotification::ConnectionLost => jobs.wake_lanes(None),
        }
        if !matches!(news, DbNotification::JobQueued { .. })
            && let Err(error) = keys.reload().await
        {
            tracing::warn!(
                error = &error as &dyn std::error::Error,
                "API keys could not be reloaded"
            );
        }
        let next = timeout(POLL_INTERVAL, Box::pin(listen.next()));
        news = match shutdown.run_until_cancelled(next).await {
            None => return,
            Some(Ok(Ok(news))) => news,
            Some(Ok(Err(error))) => {
                tracing::warn!(
                    error = &error as &dyn std::error::Error,
                    "notification listener disconnected; polling instead"
                );
                let _ = shutdown.run_until_cancelled(sleep(TROUBLE)).await;
                DbNotification::ConnectionLost
            }
            Some(Err(_)) => DbNotification::ConnectionLost,
        };
    }
}

/// Checks the vision-language model's server at startup, not on the first question. Logs a warning
/// if it is unreachable or has a limit that requests will exceed.
async fn check_model_server(chat: Arc<ChatClient>, services: Services, shows_pictures: bool) {
    let Some(vlm) = services.vlm() else { return };
    if let Err(error) = chat.check_reachable().await {
        tracing::warn!(
            error = &error as &dyn std::error::Error,
            "vision-language model server unreachable; the built-in reasoner answers until it returns"
        );
        return vlm.record_unreachable();
    }
    for limit in chat.describe_limits(vlm.picture_limits().count).await {
        tracing::warn!(limit, "vision-language model server has a limit that requests will exceed");
    }
    if !shows_pictures {
        return;
    }
    let model = vlm.own_model();
    match check_pictures(model.as_ref(), vlm.json(), vlm.points(), vlm.picture_limits()).await {
        Ok((findings, _)) => {
            for finding in findings {
                if finding.is_right {
                    tracing::info!("vision-language model: {finding}");
                } else {
                    tracing::warn!("vision-language model: {finding}");
                }
            }
        }
        Err(failure) => tracing::warn!(
            error = &failure.error as &dyn std::error::Error,
            "vision-language model could not be checked"
        ),
    }
}

/// Applies retention, removes orphans and verifies stored data: one minute after the start, and
/// every day.
async fn run_maintenance(services: Services, shutdown: CancellationToken) {
    const DAY: Duration = Duration::from_hours(24);
    let mut wait = Duration::from_mins(1);
    while shutdown.run_until_cancelled(sleep(wait)).await.is_some() {
        if let Some(Err(error)) =
            shutdown.run_until_cancelled(services.maintenance.run_maintenance()).await
        {
            tracing::warn!(error = &error as &dyn std::error::Error, "daily maintenance failed");
        }
        wait = DAY;
    }
}

/// Updates the room index for rooms with a new parse, or whose indexed data has changed.
async fn update_room_index(services: Services, shutdown: CancellationToken) {
    const EVERY: Duration = Duration::from_secs(3);
    while shutdown.run_until_cancelled(sleep(EVERY)).await.is_some() {
        if let Some(Err(error)) = shutdown.run_until_cancelled(services.rooms.index_rooms()).await {
            tracing::warn!(
                error = &error as &dyn std::error::Error,
                "scene index could not be updated"
            );
        }
    }
}

/// Restores the reserve file that was released on a full disk, once the disk has space.
async fn restore_reserve_when_possible(store: Store, shutdown: CancellationToken) {
    const EVERY: Duration = Duration::from_mins(1);
    while shutdown.run_until_cancelled(sleep(EVERY)).await.is_some() {
        store.reserve.restore_reserve().await;
    }
}

/// Continues uploads that were complete when their server stopped, or that waited because of a full
/// queue or disk.
async fn complete_pending_uploads(services: Services, shutdown: CancellationToken) {
    const EVERY: Duration = Duration::from_secs(10);
    while let Some(made) =
        shutdown.run_until_cancelled(services.uploads.complete_pending_uploads()).await
    {
        if let Err(error) = made {
            tracing::warn!(
                error = &error as &dyn std::error::Error,
                "waiting uploads could not be listed"
            );
        }
        if shutdown.run_until_cancelled(sleep(EVERY)).await.is_none() {
            return;
        }
    }
}

/// Returns the number of connections: at most `wanted`, and at most half of the available file
/// descriptors. The other half is for files.
fn most_connections(requested: u32) -> usize {
    use rustix::process::{Resource, getrlimit, setrlimit};
    let mut limit = getrlimit(Resource::Nofile);
    limit.current = limit.maximum;
    if let Err(error) = setrlimit(Resource::Nofile, limit) {
        tracing::debug!(%error, "open file limit could not be raised");
    }
    let files = getrlimit(Resource::Nofile).current.unwrap_or(u64::MAX);
    usize::try_from(u64::from(requested).min(files / 2)).unwrap_or(usize::MAX).max(8)
}

/// Time that running requests get to finish after the service stops.
const GRACE: Duration = Duration::from_secs(5);

impl RunningService {
    /// Returns the services.
    #[must_use]
    pub fn services(&self) -> Services {
        self.services.clone()
    }

    /// Stops the service: accepts no new requests, lets running requests finish, returns running
    /// jobs to their queues, and closes the database.
    ///
    /// # Errors
    /// Returns an error when the server or a lane panicked before.
    pub async fn stop(self) -> anyhow::Result<()> {
        self.shutdown.cancel();
        for lane in self.lanes {
            lane.await?;
        }
        // A caller that stalls during its request must not keep the process alive.
        let abort = self.server.abort_handle();
        let served = timeout(GRACE, self.server).await.unwrap_or_else(|_| {
            tracing::warn!("shutdown timeout reached; aborting unfinished requests");
            abort.abort();
            Ok(())
        });
        self.store.close().await;
        Ok(served?)
    }

    /// Completes when the server ends by itself, which only happens when it panics.
    pub async fn until_server_ends(&mut self) {
        // A finished handle must not be polled again. `stop` polls it for its error, so only check
        // it here.
        while !self.server.is_finished() {
            sleep(Duration::from_millis(200)).await;
        }
    }
}
