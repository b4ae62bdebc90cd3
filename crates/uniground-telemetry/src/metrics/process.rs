//! Metrics of the process, under the names that all exporters use.

use super::FloatGauge;
use crate::memory::MemoryUsage;
use prometheus_client::metrics::gauge::Gauge;
use prometheus_client::registry::{Registry, Unit};
use std::time::{Instant, SystemTime, UNIX_EPOCH};

/// Start time and memory of the process.
pub struct ProcessMetrics {
    resident: Gauge,
    started: Instant,
    started_at: SystemTime,
}

impl ProcessMetrics {
    pub(super) fn new(registry: &mut Registry) -> Self {
        let process = Self {
            resident: Gauge::default(),
            started: Instant::now(),
            started_at: SystemTime::now(),
        };
        let began = FloatGauge::default();
        began.set(process.started_at.duration_since(UNIX_EPOCH).unwrap_or_default().as_secs_f64());
        registry.register_with_unit(
            "process_start_time",
            "Start time of the server, seconds since 1970",
            Unit::Seconds,
            began,
        );
        registry.register_with_unit(
            "process_resident_memory",
            "Resident memory of the process",
            Unit::Bytes,
            process.resident.clone(),
        );
        process
    }

    /// Returns the time at which the server started.
    #[must_use]
    pub fn started_at(&self) -> SystemTime {
        self.started_at
    }

    /// Returns the time since the start, independent of changes of the system clock.
    #[must_use]
    pub fn uptime_s(&self) -> u64 {
        self.started.elapsed().as_secs()
    }

    /// Updates the gauges. They stay 0 where the system does not report them.
    pub(super) fn update(&self) {
        self.resident.set(
            MemoryUsage::now().and_then(|memory| memory.resident.try_into().ok()).unwrap_or(0),
        );
    }
}
