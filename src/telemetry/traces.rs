//! Traces: sends the spans of requests, jobs and model calls to an OpenTelemetry collector (OTLP
//! over HTTP).
//!
//! Only spans are sent, no log lines: ids, routes, kinds and outcomes. Secrets are redacted in the
//! log only, and the log stays on this machine.

use anyhow::{Context, ensure};
use opentelemetry::trace::TracerProvider;
use opentelemetry_otlp::{SpanExporter, WithExportConfig};
use opentelemetry_sdk::Resource;
use opentelemetry_sdk::trace::SdkTracerProvider;
use reqwest::Url;
use tracing::Subscriber;
use tracing::level_filters::LevelFilter;
use tracing_subscriber::Layer;
use tracing_subscriber::filter::filter_fn;
use tracing_subscriber::registry::LookupSpan;
use uniground_client::install_crypto_provider;

/// Sends spans while it lives, and the remaining ones on drop.
pub struct Traces(SdkTracerProvider);

impl Drop for Traces {
    fn drop(&mut self) {
        if let Err(error) = self.0.shutdown() {
            tracing::warn!(%error, "remaining traces could not be exported");
        }
    }
}

/// Returns a layer that sends spans to a collector, given its address without `/v1/traces`. The
/// sampling rate is set by OpenTelemetry's variables (`OTEL_TRACES_SAMPLER`) and by callers in
/// `traceparent`.
pub(super) fn collector_layer<S>(
    endpoint: &str,
) -> anyhow::Result<(Box<dyn Layer<S> + Send + Sync>, Traces)>
where
    S: Subscriber + for<'a> LookupSpan<'a> + Send + Sync,
{
    ensure!(Url::parse(endpoint).is_ok_and(|url| url.has_host()), "--otlp-endpoint: invalid URL");
    super::register_secrets_of_address(endpoint);
    install_crypto_provider();
    let url = format!("{}/v1/traces", endpoint.trim_end_matches('/'));
    let exporter = SpanExporter::builder()
        .with_http()
        .with_endpoint(url)
        .build()
        .context("--otlp-endpoint")?;
    let service = Resource::builder().with_service_name(env!("CARGO_PKG_NAME")).build();
    let provider =
        SdkTracerProvider::builder().with_batch_exporter(exporter).with_resource(service).build();
    let ours = filter_fn(|seen| seen.is_span() && seen.target().starts_with("uniground"))
        .with_max_level_hint(LevelFilter::INFO);
    let layer = tracing_opentelemetry::layer()
        .with_tracer(provider.tracer("uniground"))
        .with_location(false)
        .with_threads(false)
        .with_filter(ours);
    Ok((layer.boxed(), Traces(provider)))
}
