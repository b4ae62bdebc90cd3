//! Trace propagation with the W3C `traceparent` header: accepted from callers, and passed on to
//! the model's endpoint. Without a collector it is neither accepted nor passed on.

use opentelemetry::propagation::TextMapPropagator;
use opentelemetry_http::{HeaderExtractor, HeaderInjector};
use opentelemetry_sdk::propagation::TraceContextPropagator;
use reqwest::header::HeaderMap;
use tracing::Span;
use tracing_opentelemetry::OpenTelemetrySpanExt;

/// Makes a span a child of the caller's trace.
pub fn adopt(span: &Span, headers: &HeaderMap) {
    let caller = TraceContextPropagator::new().extract(&HeaderExtractor(headers));
    // Without a collector this fails, and the span stays without a parent.
    let _ = span.set_parent(caller);
}

/// Returns the headers that pass the current span on to another service.
#[must_use]
pub fn propagation_headers() -> HeaderMap {
    let mut headers = HeaderMap::new();
    TraceContextPropagator::new()
        .inject_context(&Span::current().context(), &mut HeaderInjector(&mut headers));
    headers
}
