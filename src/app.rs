//! Composition root: configuration to parts to a running service to a clean stop. The only place that knows every part.

use crate::config::ServeConfig;
use crate::http::{self, App};
use crate::jobs::Jobs;
use crate::models::chat::Tape;
use crate::service::{NAMING_JOB, PARSE_JOB, Service, Vlm, VlmSettings};
use crate::store::Store;
use anyhow::Context;
use std::collections::HashMap;
use std::net::SocketAddr;
use std::sync::Arc;
use std::time::Duration;
use tokio::net::TcpListener;
use tokio::task::JoinHandle;
use tokio::time::{sleep, timeout};
use tokio_util::sync::CancellationToken;

/// A service that listens.
pub struct RunningService {
    /// Where it listens, with the port the system picked.
    pub address: SocketAddr,
    shutdown: CancellationToken,
    server: JoinHandle<std::io::Result<()>>,
    worker: JoinHandle<()>,
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
    let vlm = config.vlm.client(Tape::None)?.map(|client| Vlm::new(client, vlm_settings));
    let service = Service::new(store.clone(), jobs.clone(), config.limits.service_limits(), vlm, models);
    let listener = TcpListener::bind(config.listen).await.with_context(|| format!("listening on {}", config.listen))?;
    let address = listener.local_addr()?;

    let shutdown = CancellationToken::new();
    let worker_ended = CancellationToken::new();
    let handlers = HashMap::from([(PARSE_JOB, service.parse_handler()), (NAMING_JOB, service.naming_handler())]);
    let worker = tokio::spawn({
        let (shutdown, worker_ended) = (shutdown.clone(), worker_ended.clone());
        async move {
            // Dropped however the worker ends, so that /readyz learns of it.
            let _ended = worker_ended.drop_guard();
            if let Err(error) = jobs.work(&handlers, shutdown).await {
                tracing::error!(error = &error as &dyn std::error::Error, "the job worker stopped");
            }
        }
    });
    tokio::spawn(forget_daily(service.clone(), shutdown.clone()));
    let router = http::router(App { service: service.clone(), api_key, shutdown: shutdown.clone(), worker: worker_ended });
    let server = tokio::spawn({
        let shutdown = shutdown.clone();
        async move { axum::serve(listener, router).with_graceful_shutdown(shutdown.cancelled_owned()).await }
    });
    Ok(RunningService { address, shutdown, server, worker, service, store })
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
    /// Stops: no new requests, running ones finish, the running job goes back to the queue, the database is closed.
    ///
    /// # Errors
    /// When the server had failed before.
    pub async fn stop(self) -> anyhow::Result<()> {
        self.shutdown.cancel();
        self.worker.await?;
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
