//! Metrics of the service, for `GET /metrics`.
//!
//! Each part counts its own work: requests in `http`, jobs in their lanes, questions, models and
//! storage in `service`. One value is created at the start and passed down. There is no global
//! state, so two servers in one process count separately. Labels have few values by construction:
//! route templates, methods, statuses, kinds and codes; never ids, names or questions.

mod jobs;
mod process;
mod questions;
mod requests;
mod stored;
mod vlm;

pub use jobs::JobMetrics;
pub use process::ProcessMetrics;
pub use questions::QuestionMetrics;
pub use requests::{InFlightRequest, RequestMetrics};
pub use stored::StoredMetrics;
pub use vlm::VlmMetrics;

use prometheus_client::encoding::text;
use prometheus_client::metrics::family::Family;
use prometheus_client::metrics::gauge::Gauge;
use prometheus_client::metrics::histogram::Histogram;
use prometheus_client::metrics::info::Info;
use prometheus_client::registry::Registry;
use std::sync::atomic::AtomicU64;

/// Media type of [`Metrics::text`].
pub const MEDIA_TYPE: &str = "application/openmetrics-text; version=1.0.0; charset=utf-8";

/// Labels and their values, all known at compile time.
type Labels<const N: usize> = [(&'static str, &'static str); N];
/// One histogram for each set of labels.
type Histograms<L> = Family<L, Histogram, fn() -> Histogram>;
/// A gauge of seconds, shares or dollars.
type FloatGauge = Gauge<f64, AtomicU64>;

/// All metrics, grouped by the part that counts them.
pub struct Metrics {
    pub requests: RequestMetrics,
    pub questions: QuestionMetrics,
    pub jobs: JobMetrics,
    pub vlm: VlmMetrics,
    pub stored: StoredMetrics,
    pub process: ProcessMetrics,
    registry: Registry,
}

impl Default for Metrics {
    fn default() -> Self {
        let mut registry = Registry::default();
        let process = ProcessMetrics::new(&mut registry);
        let own = registry.sub_registry_with_prefix("uniground");
        own.register(
            "build",
            "Version of the running server",
            Info::new([("version", env!("CARGO_PKG_VERSION"))]),
        );
        Self {
            requests: RequestMetrics::new(own),
            questions: QuestionMetrics::new(own),
            jobs: JobMetrics::new(own),
            vlm: VlmMetrics::new(own),
            stored: StoredMetrics::new(own),
            process,
            registry,
        }
    }
}

impl Metrics {
    /// Returns all metrics in the `OpenMetrics` text format, which Prometheus reads.
    #[must_use]
    pub fn text(&self) -> String {
        self.process.update();
        let mut text = String::new();
        // Writing to a string cannot fail.
        let _ = text::encode(&mut text, &self.registry);
        text
    }
}

/// Buckets from a millisecond to five minutes, for requests and questions.
fn short_seconds() -> Histogram {
    Histogram::new([
        0.001, 0.0025, 0.005, 0.01, 0.025, 0.05, 0.1, 0.25, 0.5, 1.0, 2.5, 5.0, 10.0, 30.0, 60.0,
        300.0,
    ])
}

/// Buckets from a tenth of a second to six hours, for parses and jobs.
fn long_seconds() -> Histogram {
    Histogram::new([
        0.1, 0.5, 1.0, 2.5, 5.0, 10.0, 30.0, 60.0, 120.0, 300.0, 600.0, 1800.0, 3600.0, 21600.0,
    ])
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::time::Duration;

    #[test]
    fn metrics_are_exported_as_text() {
        let metrics = Metrics::default();
        metrics.jobs.register("parse");
        metrics.jobs.record_finished("parse", "succeeded", Some(Duration::from_secs(3)));
        metrics.questions.record_answer("grounded", "builtin", false, Duration::from_millis(4));
        let exported = metrics.text();
        for line in [
            "uniground_jobs_finished_total{kind=\"parse\",state=\"succeeded\"} 1",
            "uniground_jobs_finished_total{kind=\"parse\",state=\"failed\"} 0",
            "uniground_job_duration_seconds_bucket{le=\"5.0\",kind=\"parse\"} 1",
            "uniground_questions_total{status=\"grounded\",reasoner=\"builtin\"} 1",
            "# TYPE uniground_build info",
            "# EOF",
        ] {
            assert!(
                exported.lines().any(|exported| exported == line),
                "{line} is not in\n{exported}"
            );
        }
        assert!(exported.contains("process_start_time_seconds 1"), "{exported}");
    }

    #[test]
    fn metrics_of_two_servers_are_independent() {
        let (one, other) = (Metrics::default(), Metrics::default());
        one.questions.record_failure("overloaded");
        assert!(
            one.text().contains("code=\"overloaded\"")
                && !other.text().contains("code=\"overloaded\"")
        );
    }
}
