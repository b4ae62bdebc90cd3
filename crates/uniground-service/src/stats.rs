//! Statistics of the service, for Prometheus and for people.
//!
//! Most values are counted where they occur. Values from the store are read on request, once for
//! all concurrent callers. A scrape does not wait for a slow disk. It reports the previous values
//! instead.

use super::single_flight_cache::SingleFlightCache;
use super::vlm::today;
use super::{BatchJob, FullParseJob, MAX_UPLOADS, NamingJob, ParseJob};
use crate::error::Error;
use crate::parses::ParseCache;
use crate::{HealthService, Limits, Vlm};
use jiff::Timestamp;
use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::Duration;
use tokio::sync::{Mutex, Semaphore};
use uniground_grounding::PictureCache;
use uniground_jobs::{JobKind, Jobs};
use uniground_storage::{
    Blobs, Figures, FolderSizes, JobState, SpendingRepository, StatisticsRepository, StoreError,
};
use uniground_telemetry::metrics::Metrics;
use uniground_types::stats::{DiskUse, JobStats, Spending, Stats, StoredCounts};

/// The maximum age of the store's figures.
const AGE: Duration = Duration::from_secs(1);
/// The maximum age of the measured file sizes.
const SIZES_AGE: Duration = Duration::from_mins(1);
/// How long a scrape waits for fresh figures. The first scrape waits longer.
const SCRAPE_TIMEOUT: Duration = Duration::from_millis(8);
const FIRST_SCRAPE_TIMEOUT: Duration = Duration::from_secs(5);

type Sizes = Arc<BTreeMap<&'static str, u64>>;

/// The cached figures of the store.
#[derive(Clone, Default)]
pub(super) struct FigureCache {
    /// Concurrent callers share an error.
    figures: SingleFlightCache<Result<Arc<Figures>, Arc<StoreError>>>,
    sizes: SingleFlightCache<Option<Sizes>>,
    measured: Arc<Mutex<FolderSizes>>,
}

/// Returns statistics and metrics that are read from the store.
#[derive(Clone)]
pub struct StatsService {
    pub(crate) figures: FigureCache,
    pub(crate) metrics: Arc<Metrics>,
    pub(crate) vlm: Option<Arc<Vlm>>,
    pub(crate) limits: Limits,
    pub(crate) health_service: Arc<HealthService>,
    pub(crate) permits: Arc<Semaphore>,
    pub(crate) upload_permits: Arc<Semaphore>,
    pub(crate) parse_cache: Arc<ParseCache>,
    pub(crate) picture_cache: Arc<PictureCache>,
    pub(crate) statistics_repository: StatisticsRepository,
    pub(crate) blobs: Blobs,
    pub(crate) spending_repository: SpendingRepository,
    pub(crate) jobs: Jobs,
}

impl StatsService {
    /// Returns what this server stores, runs and may spend.
    ///
    /// # Errors
    /// [`Error::Store`].
    pub async fn stats(&self) -> Result<Stats, Error> {
        let figures = self
            .figures
            .figures
            .get(AGE, self.cached_figures())
            .await
            .map_err(StoreError::Shared)?;
        let sizes = self.cached_sizes().await;
        let process = &self.metrics.process;
        let Figures { scenes, parses, instances, answers, database_bytes, free_bytes, .. } =
            *figures;
        Ok(Stats {
            version: env!("CARGO_PKG_VERSION").into(),
            started_at: Timestamp::try_from(process.started_at()).unwrap_or_default().to_string(),
            uptime_s: process.uptime_s(),
            stored: StoredCounts {
                scenes,
                parses,
                instances,
                answers,
                batches: figures.batches.clone(),
            },
            jobs: self.job_statistics(&figures),
            spending: Spending {
                day: today(),
                today_usd: self.spent_today().await?,
                daily_limit_usd: self.vlm.as_ref().and_then(|vlm| vlm.daily_limit_usd()),
            },
            disk: DiskUse {
                database_bytes,
                blob_bytes: sizes.map(|sizes| {
                    sizes.iter().map(|(kind, bytes)| ((*kind).to_owned(), *bytes)).collect()
                }),
                free_bytes,
            },
            retention: self.limits.retention,
        })
    }

    /// Returns all metrics in the format of Prometheus. Takes a few milliseconds, whatever the
    /// state of the store.
    pub async fn scrape(&self) -> String {
        let is_first = self.figures.figures.last().is_none();
        let patience = if is_first { FIRST_SCRAPE_TIMEOUT } else { SCRAPE_TIMEOUT };
        let service = self.clone();
        let figures = self
            .figures
            .figures
            .get_within(AGE, patience, async move { service.cached_figures().await });
        let spent = async { tokio::time::timeout(patience, self.spent_today()).await.ok()?.ok() };
        let (figures, health, sizes, spent) = tokio::join!(
            figures,
            self.health_service.health_within(patience),
            self.cached_sizes(),
            spent
        );
        let (stored, vlm, questions) =
            (&self.metrics.stored, &self.metrics.vlm, &self.metrics.questions);
        // Figures that cannot be read keep their previous values. Another metric reports that the
        // database is failing.
        if let Some(Ok(figures)) = figures {
            stored.scenes.set(figures.scenes.into());
            stored.parses.set(figures.parses.into());
            stored.instances.set(figures.instances.into());
            stored.answers.set(figures.answers.into());
            for state in ["running", "paused", "succeeded", "cancelled"] {
                stored.set_batches(state, figures.batches.get(state).copied().unwrap_or(0));
            }
            stored.database_bytes.set(figures.database_bytes as i64);
            stored.free_bytes.set(figures.free_bytes as i64);
            // Reported even if no process has workers for a kind. The age of its queue matters most
            // then.
            for kind in [ParseJob::NAME, FullParseJob::NAME, NamingJob::NAME, BatchJob::NAME] {
                let JobStats { queued, running, oldest_queued_s, .. } =
                    job_stats(kind, true, &figures);
                self.metrics.jobs.set_queue_lengths(
                    kind,
                    queued,
                    running,
                    oldest_queued_s.unwrap_or(0.0),
                );
            }
        }
        sizes
            .iter()
            .flat_map(|sizes| sizes.iter())
            .for_each(|(kind, bytes)| stored.set_blob_bytes(kind, *bytes));
        if let Some(health) = health {
            stored.ready.set(health.is_ready().into());
            stored.set_component_health("database", health.store.database.is_none());
            stored.set_component_health("blob_folder", health.store.blobs.is_none());
            stored.set_component_health("disk", health.store.disk.is_none());
            stored.set_component_health("workers", health.dead_lanes.is_empty());
            health
                .inference
                .iter()
                .for_each(|server| stored.set_component_health("inference_server", server.is_ok()));
            health.vlm.iter().for_each(|model| stored.set_component_health("vlm", model.is_ok()));
        }
        if let Some(model) = &self.vlm {
            vlm.waiting.set(model.waiting() as i64);
            vlm.daily_limit.set(model.daily_limit_usd().unwrap_or(0.0));
            vlm.spent_today.set(spent.unwrap_or_else(|| vlm.spent_today.get()));
        }
        let most = self.limits.max_concurrent_questions;
        questions.computing_limit.set(most as i64);
        questions.computing.set(most.saturating_sub(self.permits.available_permits()) as i64);
        questions
            .uploads
            .set(MAX_UPLOADS.saturating_sub(self.upload_permits.available_permits()) as i64);
        let looks = [
            ("parses", self.parse_cache.hits_and_misses()),
            ("clouds", self.parse_cache.render_scenes.hits_and_misses()),
            ("files", self.parse_cache.sound.hits_and_misses()),
            ("pictures", self.picture_cache.hits_and_misses()),
        ];
        looks
            .into_iter()
            .for_each(|(cache, (hits, misses))| questions.set_cache_counts(cache, hits, misses));
        self.metrics.text()
    }

    async fn cached_figures(&self) -> Result<Arc<Figures>, Arc<StoreError>> {
        self.statistics_repository.figures().await.map(Arc::new).map_err(Arc::new)
    }

    /// Returns the disk space that files use, if it has been measured. Measures it again in the
    /// background.
    async fn cached_sizes(&self) -> Option<Sizes> {
        let (blobs, measured, before) = (
            self.blobs.clone(),
            self.figures.measured.clone(),
            self.figures.sizes.last().flatten(),
        );
        let look = async move {
            let mut measured = measured.lock().await;
            let sizes = blobs.sizes(&mut measured).await;
            let sizes = sizes
                .inspect_err(|error| tracing::warn!(%error, "file sizes could not be measured"));
            sizes.ok().map(Arc::new).or(before)
        };
        self.figures.sizes.get_within(SIZES_AGE, SCRAPE_TIMEOUT, look).await.flatten()
    }

    /// Returns today's spending in US dollars.
    async fn spent_today(&self) -> Result<f64, Error> {
        match &self.vlm {
            Some(vlm) => vlm.spent_today_usd().await,
            None => Ok(self.spending_repository.spending_on_day(&today()).await?),
        }
    }

    /// Returns statistics for the kinds of jobs that this server runs or has records of.
    fn job_statistics(&self, figures: &Figures) -> Vec<JobStats> {
        let lanes = self.jobs.lane_states();
        let mut kinds: Vec<&str> = lanes
            .keys()
            .copied()
            .chain(figures.jobs.iter().map(|jobs| jobs.kind.as_str()))
            .collect();
        kinds.sort_unstable();
        kinds.dedup();
        kinds
            .into_iter()
            .map(|kind| job_stats(kind, lanes.get(kind) == Some(&true), figures))
            .collect()
    }
}

fn job_stats(kind: &str, working: bool, figures: &Figures) -> JobStats {
    let of = |state: JobState| {
        figures.jobs.iter().find(|jobs| jobs.kind == kind && jobs.state == state.as_str())
    };
    let number = |state| of(state).map_or(0, |jobs| jobs.jobs);
    let oldest = of(JobState::Queued).and_then(|jobs| jobs.oldest.parse::<Timestamp>().ok());
    JobStats {
        kind: kind.to_owned(),
        working,
        queued: number(JobState::Queued),
        running: number(JobState::Running),
        succeeded: number(JobState::Succeeded),
        failed: number(JobState::Failed),
        cancelled: number(JobState::Cancelled),
        oldest_queued_s: oldest
            .map(|oldest| Timestamp::now().duration_since(oldest).as_secs_f64().max(0.0)),
    }
}
