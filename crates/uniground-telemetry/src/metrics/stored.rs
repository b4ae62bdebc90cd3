//! Metrics of the store and of readiness.

use super::Labels;
use prometheus_client::metrics::family::Family;
use prometheus_client::metrics::gauge::Gauge;
use prometheus_client::registry::{Registry, Unit};

/// Gauges of the data folder and of readiness.
pub struct StoredMetrics {
    pub scenes: Gauge,
    pub parses: Gauge,
    pub instances: Gauge,
    pub answers: Gauge,
    batches: Family<Labels<1>, Gauge>,
    pub database_bytes: Gauge,
    blob_bytes: Family<Labels<1>, Gauge>,
    pub free_bytes: Gauge,
    pub ready: Gauge,
    components: Family<Labels<1>, Gauge>,
}

impl StoredMetrics {
    pub(super) fn new(registry: &mut Registry) -> Self {
        let stored = Self {
            scenes: Gauge::default(),
            parses: Gauge::default(),
            instances: Gauge::default(),
            answers: Gauge::default(),
            batches: Family::default(),
            database_bytes: Gauge::default(),
            blob_bytes: Family::default(),
            free_bytes: Gauge::default(),
            ready: Gauge::default(),
            components: Family::default(),
        };
        registry.register("scenes", "Stored scenes", stored.scenes.clone());
        registry.register("parses", "Stored parses", stored.parses.clone());
        registry.register("instances", "Instances of all parses", stored.instances.clone());
        registry.register("answers", "Stored answers", stored.answers.clone());
        registry.register("batches", "Stored batches, by state", stored.batches.clone());
        registry.register_with_unit(
            "database_size",
            "Size of the database, with its journal",
            Unit::Bytes,
            stored.database_bytes.clone(),
        );
        let help = "Size of files outside the database, by kind; measured at most once a minute";
        registry.register_with_unit("blobs_size", help, Unit::Bytes, stored.blob_bytes.clone());
        registry.register_with_unit(
            "disk_free",
            "Free disk space",
            Unit::Bytes,
            stored.free_bytes.clone(),
        );
        registry.register("ready", "Whether /readyz reports ready", stored.ready.clone());
        let help = "Components of the service: 1 if healthy; the vision-language model does not affect readiness";
        registry.register("component_up", help, stored.components.clone());
        stored
    }

    /// Sets the number of batches in a state.
    pub fn set_batches(&self, state: &'static str, batches: u32) {
        self.batches.get_or_create(&[("state", state)]).set(batches.into());
    }

    /// Sets the disk usage of a kind of files.
    pub fn set_blob_bytes(&self, kind: &'static str, bytes: u64) {
        self.blob_bytes
            .get_or_create(&[("kind", kind)])
            .set(i64::try_from(bytes).unwrap_or(i64::MAX));
    }

    /// Sets whether a component of the service is healthy.
    pub fn set_component_health(&self, component: &'static str, up: bool) {
        self.components.get_or_create(&[("component", component)]).set(up.into());
    }
}
