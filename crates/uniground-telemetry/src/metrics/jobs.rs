//! Metrics of jobs and their lanes.

use super::{FloatGauge, Histograms, Labels, long_seconds};
use prometheus_client::metrics::counter::Counter;
use prometheus_client::metrics::family::Family;
use prometheus_client::metrics::gauge::Gauge;
use prometheus_client::registry::{Registry, Unit};
use std::time::Duration;

/// Metrics by kind of job.
pub struct JobMetrics {
    queued: Family<Labels<1>, Gauge>,
    running: Family<Labels<1>, Gauge>,
    oldest: Family<Labels<1>, FloatGauge>,
    finished: Family<Labels<2>, Counter>,
    retried: Family<Labels<1>, Counter>,
    duration: Histograms<Labels<1>>,
    lanes: Family<Labels<1>, Gauge>,
}

impl JobMetrics {
    pub(super) fn new(registry: &mut Registry) -> Self {
        let jobs = Self {
            queued: Family::default(),
            running: Family::default(),
            oldest: Family::default(),
            finished: Family::default(),
            retried: Family::default(),
            duration: Histograms::new_with_constructor(long_seconds),
            lanes: Family::default(),
        };
        registry.register("jobs_queued", "Jobs in the queue", jobs.queued.clone());
        registry.register("jobs_running", "Running jobs", jobs.running.clone());
        let help = "Age of the oldest queued job; 0 if the queue is empty";
        registry.register_with_unit(
            "jobs_oldest_queued_age",
            help,
            Unit::Seconds,
            jobs.oldest.clone(),
        );
        registry.register("jobs_finished", "Finished jobs, by state", jobs.finished.clone());
        registry.register(
            "jobs_retried",
            "Jobs queued again after a transient failure",
            jobs.retried.clone(),
        );
        let help = "Duration of one run of a job";
        registry.register_with_unit("job_duration", help, Unit::Seconds, jobs.duration.clone());
        registry.register(
            "lane_up",
            "Whether workers for this kind of job are running",
            jobs.lanes.clone(),
        );
        jobs
    }

    /// Registers a kind, so that its counters start at 0.
    pub fn register(&self, kind: &'static str) {
        for state in ["succeeded", "failed", "cancelled"] {
            self.finished.get_or_create(&[("kind", kind), ("state", state)]).inc_by(0);
        }
        self.retried.get_or_create(&[("kind", kind)]).inc_by(0);
        self.set_queue_lengths(kind, 0, 0, 0.0);
    }

    /// Counts a finished job. `took` is set if the job was run.
    pub fn record_finished(&self, kind: &'static str, state: &'static str, took: Option<Duration>) {
        self.finished.get_or_create(&[("kind", kind), ("state", state)]).inc();
        if let Some(took) = took {
            self.duration.get_or_create(&[("kind", kind)]).observe(took.as_secs_f64());
        }
    }

    /// Counts a retry.
    pub fn record_retry(&self, kind: &'static str) {
        self.retried.get_or_create(&[("kind", kind)]).inc();
    }

    /// Sets the numbers of queued and running jobs, and the age of the oldest queued one.
    pub fn set_queue_lengths(&self, kind: &'static str, queued: u32, running: u32, oldest_s: f64) {
        self.queued.get_or_create(&[("kind", kind)]).set(queued.into());
        self.running.get_or_create(&[("kind", kind)]).set(running.into());
        self.oldest.get_or_create(&[("kind", kind)]).set(oldest_s);
    }

    /// Sets whether a lane is running.
    pub fn set_lane_running(&self, kind: &'static str, up: bool) {
        self.lanes.get_or_create(&[("kind", kind)]).set(up.into());
    }
}
