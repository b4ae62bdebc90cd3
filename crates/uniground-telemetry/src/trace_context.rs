//! Which trace a request belongs to, as W3C's `traceparent` says it: taken from callers, handed on
//! to the model's endpoint. Without a collector nothing is taken and nothing handed on.

use opentelemetry::propagation::TextMapPropagator;
use opentelemetry_http::{HeaderExtractor, HeaderInjector};
use opentelemetry_sdk::propagation::TraceContextPropagator;
use reqwest::header::HeaderMap;
use tracing::Span;
use tracing_opentelemetry::OpenTelemetrySpanExt;

/// Makes a span part of the trace its caller speaks of.
pub fn adopt(span: &Span, headers: &HeaderMap) {
    let caller = TraceContextPropagator::new().extract(&HeaderExtractor(headers));
    // Where traces go nowhere there is nothing to be part of.
    let _ = span.set_parent(caller);
}

/// What to say to whom this span asks.
#[must_use]
pub fn handed_on() -> HeaderMap {
    let mut headers = HeaderMap::new();
    TraceContextPropagator::new()
        .inject_context(&Span::current().context(), &mut HeaderInjector(&mut headers));
    headers
}
