//! Metrics of questions, batch items, caches and parses.

use super::{Histograms, Labels, long_seconds, short_seconds};
use prometheus_client::metrics::counter::Counter;
use prometheus_client::metrics::family::Family;
use prometheus_client::metrics::gauge::Gauge;
use prometheus_client::metrics::histogram::Histogram;
use prometheus_client::registry::{Registry, Unit};
use std::sync::atomic::Ordering::Relaxed;
use std::time::Duration;

/// Stages of a parse, as reports name them. Stages that are not listed are counted as "other".
const STAGES: [&str; 14] = [
    "import",
    "superpoints",
    "planes",
    "masks_and_lifting",
    "growth",
    "gaps",
    "merging",
    "part_merging",
    "hierarchy",
    "refinement",
    "views",
    "instances",
    "appearance",
    "frame_appearance",
];
/// Possible outcomes of a question.
const STATUSES: [&str; 5] = ["grounded", "uncertain", "ambiguous", "no_match", "failed"];

/// Metrics of the two stages of the method.
pub struct QuestionMetrics {
    answered: Family<Labels<2>, Counter>,
    failures: Family<Labels<1>, Counter>,
    degraded: Counter,
    duration: Histograms<Labels<1>>,
    items: Family<Labels<1>, Counter>,
    caches: Family<Labels<2>, Counter>,
    stages: Histograms<Labels<1>>,
    parses: Histogram,
    pub computing: Gauge,
    pub computing_limit: Gauge,
    pub uploads: Gauge,
}

impl QuestionMetrics {
    pub(super) fn new(registry: &mut Registry) -> Self {
        let questions = Self {
            answered: Family::default(),
            failures: Family::default(),
            degraded: Counter::default(),
            duration: Histograms::new_with_constructor(short_seconds),
            items: Family::default(),
            caches: Family::default(),
            stages: Histograms::new_with_constructor(long_seconds),
            parses: long_seconds(),
            computing: Gauge::default(),
            computing_limit: Gauge::default(),
            uploads: Gauge::default(),
        };
        let help = "Questions by status and reasoner, including those of batches";
        registry.register("questions", help, questions.answered.clone());
        registry.register(
            "question_failures",
            "Questions without an answer, by problem code",
            questions.failures.clone(),
        );
        let help = "Answers that used a built-in component because a model was not available";
        registry.register("questions_degraded", help, questions.degraded.clone());
        let help = "Time from receiving a question to storing its answer";
        registry.register_with_unit(
            "question_duration",
            help,
            Unit::Seconds,
            questions.duration.clone(),
        );
        registry.register(
            "batch_items",
            "Questions of batches by outcome",
            questions.items.clone(),
        );
        registry.register(
            "cache_requests",
            "Cache lookups, by cache and outcome",
            questions.caches.clone(),
        );
        let help = "Duration of parse stages that were computed, not restored from a checkpoint";
        registry.register_with_unit(
            "parse_stage_duration",
            help,
            Unit::Seconds,
            questions.stages.clone(),
        );
        let help = "Duration of parses, from the unpacked scan to the stored result";
        registry.register_with_unit(
            "parse_duration",
            help,
            Unit::Seconds,
            questions.parses.clone(),
        );
        registry.register(
            "questions_computing",
            "Questions being computed",
            questions.computing.clone(),
        );
        registry.register(
            "questions_computing_limit",
            "Maximum number of questions computed at once",
            questions.computing_limit.clone(),
        );
        registry.register("uploads_in_flight", "Uploads being received", questions.uploads.clone());
        // Start all counters at 0, so that rates are correct from the first event on.
        for status in STATUSES {
            let reasoner = if status == "failed" { "none" } else { "builtin" };
            questions
                .answered
                .get_or_create(&[("status", status), ("reasoner", reasoner)])
                .inc_by(0);
            questions.items.get_or_create(&[("outcome", status)]).inc_by(0);
        }
        questions
    }

    /// Counts an answered question. `status` is e.g. `grounded`; `reasoner` is `builtin` or `vlm`.
    pub fn record_answer(
        &self,
        status: &'static str,
        reasoner: &'static str,
        degraded: bool,
        took: Duration,
    ) {
        self.answered.get_or_create(&[("status", status), ("reasoner", reasoner)]).inc();
        self.duration.get_or_create(&[("reasoner", reasoner)]).observe(took.as_secs_f64());
        self.degraded.inc_by(u64::from(degraded));
    }

    /// Counts a failed question. `code` is the code of the problem.
    pub fn record_failure(&self, code: &'static str) {
        self.answered.get_or_create(&[("status", "failed"), ("reasoner", "none")]).inc();
        self.failures.get_or_create(&[("code", code)]).inc();
    }

    /// Counts a finished batch item.
    pub fn record_batch_item(&self, status: &str) {
        let outcome = STATUSES.into_iter().find(|known| *known == status).unwrap_or("other");
        self.items.get_or_create(&[("outcome", outcome)]).inc();
    }

    /// Counts a finished parse, with the duration of each stage.
    pub fn record_parse<'a>(
        &self,
        took: Duration,
        stages: impl IntoIterator<Item = (&'a str, f32)>,
    ) {
        self.parses.observe(took.as_secs_f64());
        for (stage, seconds) in stages {
            let stage = STAGES.into_iter().find(|known| *known == stage).unwrap_or("other");
            self.stages.get_or_create(&[("stage", stage)]).observe(f64::from(seconds));
        }
    }

    /// Sets the hits and misses of a cache since the start.
    pub fn set_cache_counts(&self, cache: &'static str, hits: u64, misses: u64) {
        for (outcome, looks) in [("hit", hits), ("miss", misses)] {
            self.caches
                .get_or_create(&[("cache", cache), ("outcome", outcome)])
                .inner()
                .store(looks, Relaxed);
        }
    }
}
