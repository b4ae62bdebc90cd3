//! Composition root: configuration to parts to a running service to a clean stop. The only place that knows every part.

use crate::chat::ReplayCache;
use crate::config::ServeConfig;
use crate::http::{self, App};
use crate::jobs::{JobKind, Jobs};
use crate::service::{NamingJob, ParseJob, Service, Vlm, VlmSettings};
use crate::store::Store;
use anyhow::Context;
use std::net::SocketAddr;
use std::sync::Arc;
use std::time::Duration;
use tokio::net::TcpListener;
use tokio::task::JoinHandle;
use tokio::time::{sleep, timeout};
use tokio_util::sync::CancellationToken;
use uniground_core::background;

/// A service that listens.
pub struct RunningService {
    /// Where it listens, with the port the system picked.
    pub address: SocketAddr,
    shutdown: CancellationToken,
    server: JoinHandle<std::io::Result<()>>,
    lanes: Vec<JoinHandle<()>>,
    service: Service,
    store: Store,
}

/// Starts everything.
///
/// # Errors
/// When the address, the data folder or the key can not be used.
pub async fn start(config: &ServeConfig) -> anyhow::Result<RunningService> {
    let api_key = config.api_key()?.map(Arc::new);
    let store = Store::open(&config.data_dir)
        .await
        .with_context(|| format!("the data folder {}", config.data_dir))?;
    let jobs = Jobs::new(store.clone(), config.limits.max_queued_jobs);
    let models = tokio::task::spawn_blocking({
        let config = config.models.clone();
        move || config.load()
    });
    let models = models.await??;
    for model in &models.loaded {
        tracing::info!(name = model.name, fingerprint = model.fingerprint, runs_on = model.runs_on, "loaded a model");
    }
    let vlm_settings = VlmSettings { daily_usd: config.vlm.vlm_daily_usd, json: config.vlm.vlm_json };
    let vlm = config.vlm.client(ReplayCache::Off)?.map(|client| Vlm::new(Arc::new(client), vlm_settings));
    let parsing = background::pool().context("threads for parses")?;
    let service = Service::new(store.clone(), jobs.clone(), config.limits.service_limits(), vlm, models, parsing);
    let listener = TcpListener::bind(config.listen).await.with_context(|| format!("listening on {}", config.listen))?;
    let address = listener.local_addr()?;

    let shutdown = CancellationToken::new();
    let lane_ended = CancellationToken::new();
    jobs.refuse_unknown_kinds(&[ParseJob::NAME, NamingJob::NAME]).await?;
    let lanes = vec![
        start_lane(&jobs, ParseJob(service.clone()), &shutdown, &lane_ended),
        start_lane(&jobs, NamingJob(service.clone()), &shutdown, &lane_ended),
    ];
    tokio::spawn(forget_daily(service.clone(), shutdown.clone()));
    let router = http::router(App { service: service.clone(), api_key, shutdown: shutdown.clone(), lane_ended });
    let server = tokio::spawn({
        let shutdown = shutdown.clone();
        async move { axum::serve(listener, router).with_graceful_shutdown(shutdown.cancelled_owned()).await }
    });
    Ok(RunningService { address, shutdown, server, lanes, service, store })
}

/// Gives a kind of job its lane.
fn start_lane<K: JobKind>(jobs: &Jobs, kind: K, shutdown: &CancellationToken, ended: &CancellationToken) -> JoinHandle<()> {
    let (jobs, shutdown, ended) = (jobs.clone(), shutdown.clone(), ended.clone());
    tokio::spawn(async move {
        // Dropped however the lane ends, so that /readyz learns of it.
        let _ended = ended.drop_guard();
        jobs.run_lane(Arc::new(kind), shutdown).await;
    })
}

/// Removes transcripts that were kept long enough: now, and every day.
async fn forget_daily(service: Service, shutdown: CancellationToken) {
    const DAY: Duration = Duration::from_hours(24);
    loop {
        if let Err(error) = service.forget_transcripts().await {
            tracing::warn!(error = &error as &dyn std::error::Error, "old transcripts could not be removed");
        }
        if shutdown.run_until_cancelled(sleep(DAY)).await.is_none() {
            return;
        }
    }
}

/// How long running requests may take once the service stops.
const GRACE: Duration = Duration::from_secs(5);

impl RunningService {
    /// Stops: no new requests, running ones finish, running jobs go back to their queues, the database is closed.
    ///
    /// # Errors
    /// When the server had failed before.
    pub async fn stop(self) -> anyhow::Result<()> {
        self.shutdown.cancel();
        for lane in self.lanes {
            lane.await?;
        }
        // A caller that stalls in the middle of its request must not keep the process alive.
        let abort = self.server.abort_handle();
        let served = if let Ok(served) = timeout(GRACE, self.server).await {
            served?
        } else {
            tracing::warn!("some requests did not finish in time and are cut off");
            abort.abort();
            Ok(())
        };
        self.service.settle().await?;
        self.store.close().await;
        Ok(served?)
    }

    /// Completes when the server ends by itself, which it only does when it fails.
    pub async fn ended(&mut self) {
        // A finished handle must not be polled again: `stop` does that for the error, so only look.
        while !self.server.is_finished() {
            sleep(Duration::from_millis(200)).await;
        }
    }
}
