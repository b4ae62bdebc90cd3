//! Metrics of calls to the vision-language model.

use super::{FloatGauge, Labels};
use prometheus_client::metrics::counter::Counter;
use prometheus_client::metrics::family::Family;
use prometheus_client::metrics::gauge::Gauge;
use prometheus_client::metrics::histogram::Histogram;
use prometheus_client::registry::{Registry, Unit};
use std::sync::atomic::AtomicU64;
use std::time::Duration;

/// Problems of a reply, each the purpose of the repeated call.
const MALFORMED: [&str; 3] = ["unreadable", "out_of_set", "inconsistent"];

/// Calls of the model, with tokens, cost and duration.
pub struct VlmMetrics {
    calls: Family<Labels<1>, Counter>,
    attempts: Counter,
    tokens: Family<Labels<1>, Counter>,
    spent: Counter<f64, AtomicU64>,
    duration: Histogram,
    malformed: Family<Labels<1>, Counter>,
    /// Questions that wait for the model or use it.
    pub waiting: Gauge,
    /// US dollars spent on this day (UTC), including earlier runs of the server.
    pub spent_today: FloatGauge,
    /// US dollars; 0: no limit.
    pub daily_limit: FloatGauge,
}

impl VlmMetrics {
    pub(super) fn new(registry: &mut Registry) -> Self {
        let vlm = Self {
            calls: Family::default(),
            attempts: Counter::default(),
            tokens: Family::default(),
            spent: Counter::default(),
            duration: Histogram::new([
                0.25, 0.5, 1.0, 2.0, 4.0, 8.0, 15.0, 30.0, 60.0, 120.0, 300.0, 900.0,
            ]),
            malformed: Family::default(),
            waiting: Gauge::default(),
            spent_today: FloatGauge::default(),
            daily_limit: FloatGauge::default(),
        };
        registry.register(
            "vlm_calls",
            "Calls of the vision-language model by outcome",
            vlm.calls.clone(),
        );
        registry.register(
            "vlm_attempts",
            "Requests sent to the model's endpoint, including retries",
            vlm.attempts.clone(),
        );
        registry.register("vlm_tokens", "Tokens of successful calls", vlm.tokens.clone());
        registry.register(
            "vlm_spent_usd",
            "Cost of calls since the start, US dollars",
            vlm.spent.clone(),
        );
        let help = "Duration of a call, including retries and waits";
        registry.register_with_unit("vlm_call_duration", help, Unit::Seconds, vlm.duration.clone());
        let help = "Malformed replies that were requested again, by problem";
        registry.register("vlm_malformed_replies", help, vlm.malformed.clone());
        registry.register(
            "vlm_questions_waiting",
            "Questions waiting for the model or using it",
            vlm.waiting.clone(),
        );
        registry.register(
            "vlm_spent_today_usd",
            "Amount spent today (UTC), US dollars",
            vlm.spent_today.clone(),
        );
        registry.register(
            "vlm_daily_limit_usd",
            "Daily spending limit, US dollars; 0: no limit",
            vlm.daily_limit.clone(),
        );
        vlm
    }

    /// Registers a model, so that its counters start at 0.
    pub fn register(&self, outcomes: &[&'static str]) {
        for outcome in outcomes {
            self.calls.get_or_create(&[("outcome", outcome)]).inc_by(0);
        }
        for problem in MALFORMED {
            self.malformed.get_or_create(&[("problem", problem)]).inc_by(0);
        }
        self.record_tokens(0, 0);
    }

    /// Counts a finished call.
    pub fn record_call(&self, outcome: &'static str, attempts: u32, took: Duration) {
        self.calls.get_or_create(&[("outcome", outcome)]).inc();
        self.attempts.inc_by(attempts.into());
        self.duration.observe(took.as_secs_f64());
    }

    /// Counts the tokens of a reply.
    pub fn record_tokens(&self, prompt_tokens: u64, completion_tokens: u64) {
        self.tokens.get_or_create(&[("type", "prompt")]).inc_by(prompt_tokens);
        self.tokens.get_or_create(&[("type", "completion")]).inc_by(completion_tokens);
    }

    /// Adds spending, US dollars.
    pub fn record_spending(&self, usd: f64) {
        self.spent.inc_by(usd.max(0.0));
    }

    /// Counts the purpose of a call, if it repeats an earlier call with a malformed reply.
    pub fn record_purpose(&self, purpose: &str) {
        if let Some(problem) = MALFORMED.into_iter().find(|problem| *problem == purpose) {
            self.malformed.get_or_create(&[("problem", problem)]).inc();
        }
    }
}
