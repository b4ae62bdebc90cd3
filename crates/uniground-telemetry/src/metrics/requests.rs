//! Metrics of requests and connections.

use super::{Histograms, short_seconds};
use prometheus_client::encoding::EncodeLabelSet;
use prometheus_client::metrics::counter::Counter;
use prometheus_client::metrics::family::Family;
use prometheus_client::metrics::gauge::Gauge;
use prometheus_client::registry::{Registry, Unit};
use std::time::Instant;

#[derive(Debug, Clone, Hash, PartialEq, Eq, EncodeLabelSet)]
struct Labels {
    method: &'static str,
    route: String,
    status: u16,
}

/// Known methods; all others are counted as "other".
const METHODS: [&str; 7] = ["GET", "POST", "PUT", "PATCH", "DELETE", "HEAD", "OPTIONS"];
/// The route label of requests to an unknown path.
const NO_ROUTE: &str = "none";
/// The status of requests whose client disconnected before the response, as in nginx.
const CALLER_LEFT: u16 = 499;

/// Metrics of HTTP requests.
pub struct RequestMetrics {
    finished: Family<Labels, Counter>,
    duration: Histograms<Labels>,
    in_flight: Gauge,
    pub connections: Gauge,
    pub connections_limit: Gauge,
    pub connections_refused: Counter,
    pub event_streams: Gauge,
    pub audit_entries_dropped: Counter,
}

impl RequestMetrics {
    pub(super) fn new(registry: &mut Registry) -> Self {
        let requests = Self {
            finished: Family::default(),
            duration: Histograms::new_with_constructor(short_seconds),
            in_flight: Gauge::default(),
            connections: Gauge::default(),
            connections_limit: Gauge::default(),
            connections_refused: Counter::default(),
            event_streams: Gauge::default(),
            audit_entries_dropped: Counter::default(),
        };
        registry.register(
            "http_requests",
            "Requests by method, route template and status",
            requests.finished.clone(),
        );
        let help =
            "Time from a request's headers to the response headers; streamed bodies take longer";
        registry.register_with_unit(
            "http_request_duration",
            help,
            Unit::Seconds,
            requests.duration.clone(),
        );
        registry.register(
            "http_requests_in_flight",
            "Requests in progress",
            requests.in_flight.clone(),
        );
        registry.register("http_connections", "Open connections", requests.connections.clone());
        registry.register(
            "http_connections_limit",
            "Maximum number of open connections",
            requests.connections_limit.clone(),
        );
        let help = "Connections refused because the limit was reached and all were busy";
        registry.register("http_connections_refused", help, requests.connections_refused.clone());
        registry.register(
            "http_event_streams",
            "Open event streams",
            requests.event_streams.clone(),
        );
        let help =
            "Audit entries that could not be written: too many at once, or a failing database";
        registry.register("audit_entries_dropped", help, requests.audit_entries_dropped.clone());
        requests
    }

    /// Starts a request. `route` is the template of its route, if its path has one.
    #[must_use]
    pub fn begin(&self, method: &str, route: Option<&str>) -> InFlightRequest<'_> {
        self.in_flight.inc();
        let method = METHODS.into_iter().find(|known| *known == method).unwrap_or("other");
        let labels =
            Labels { method, route: route.unwrap_or(NO_ROUTE).to_owned(), status: CALLER_LEFT };
        InFlightRequest { requests: self, labels, start: Instant::now() }
    }
}

/// A request in progress; counted on drop.
pub struct InFlightRequest<'a> {
    requests: &'a RequestMetrics,
    labels: Labels,
    start: Instant,
}

impl InFlightRequest<'_> {
    /// Sets the status of the response.
    pub fn finish(mut self, status: u16) {
        self.labels.status = status;
    }
}

impl Drop for InFlightRequest<'_> {
    fn drop(&mut self) {
        self.requests.in_flight.dec();
        self.requests.finished.get_or_create(&self.labels).inc();
        self.requests
            .duration
            .get_or_create(&self.labels)
            .observe(self.start.elapsed().as_secs_f64());
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn unknown_methods_and_paths_share_one_label() {
        let requests = RequestMetrics::new(&mut Registry::default());
        requests.begin("BREW", None).finish(405);
        drop(requests.begin("GET", Some("/v1/scenes")));
        let of = |method, route: &str, status| {
            requests.finished.get(&Labels { method, route: route.into(), status }).map(|n| n.get())
        };
        assert_eq!(of("other", "none", 405), Some(1));
        assert_eq!(of("GET", "/v1/scenes", CALLER_LEFT), Some(1), "who left is counted too");
        assert_eq!(requests.in_flight.get(), 0);
    }
}
