//! Checks that disk and memory have room for more work.

use crate::Limits;
use crate::error::Error;
use uniground_storage::HealthProbe;
use uniground_telemetry::memory::MemoryUsage;

/// Checks that disk and memory have room for more work.
#[derive(Clone)]
pub struct Capacity {
    pub(crate) health_probe: HealthProbe,
    pub(crate) limits: Limits,
}

impl Capacity {
    /// Checks that the disk has room for `bytes` more, with enough left for the rest: running work,
    /// questions and their answers.
    pub(crate) fn check_disk(&self, bytes: u64) -> Result<(), Error> {
        let free = self.health_probe.free_bytes()?;
        if free < self.limits.keep_free_bytes.saturating_add(bytes) {
            Err(Error::DiskNearlyFull { free })
        } else {
            Ok(())
        }
    }

    /// Checks that there is memory for `wanted` more bytes. Passes if the system does not report
    /// its memory. Blocks.
    pub(crate) fn check_memory(&self, wanted: u64) -> Result<(), Error> {
        let Some(MemoryUsage { resident, most }) = MemoryUsage::now() else { return Ok(()) };
        let most = self.limits.max_memory_bytes.unwrap_or(most);
        if resident.saturating_add(wanted) > most {
            Err(Error::MemoryShort { wanted, resident, most })
        } else {
            Ok(())
        }
    }
}
