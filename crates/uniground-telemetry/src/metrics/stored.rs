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
        registry.register("scenes", "Scenes that are stored", stored.scenes.clone());
        registry.register("parses", "Parses that are stored", stored.parses.clone());
        registry.register("instances", "Instances of all parses", stored.instances.clone());
        registry.register("answers", "Answers that are stored", stored.answers.clone());
        registry.register("batches", "Batches that are stored, by state", stored.batches.clone());
        registry.register_with_unit(
            "database_size",
            "The database with its journal",
            Unit::Bytes,
            stored.database_bytes.clone(),
        );
        let help = "Files beside the database, by kind; measured in the background, a minute apart at least";
        registry.register_with_unit("blobs_size", help, Unit::Bytes, stored.blob_bytes.clone());
        registry.register_with_unit(
            "disk_free",
            "Bytes that may still be written",
            Unit::Bytes,
            stored.free_bytes.clone(),
        );
        registry.register("ready", "Whether /readyz says so", stored.ready.clone());
        let help = "What the service needs, each 1 where it is well; the vision-language model does not count for being ready";
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
