//! Memory use and memory limit of this process.

use sysinfo::{
    MemoryRefreshKind, ProcessRefreshKind, ProcessesToUpdate, RefreshKind, System, get_current_pid,
};

/// Bytes of memory.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct MemoryUsage {
    /// Resident memory of this process.
    pub resident: u64,
    /// The most it can use: the limit of its container or the memory of the machine, minus what
    /// other processes use.
    pub most: u64,
}

impl MemoryUsage {
    /// Reads the current values; `None` where the system does not report them.
    #[must_use]
    pub fn now() -> Option<Self> {
        let id = get_current_pid().ok()?;
        let of_machine =
            RefreshKind::nothing().with_memory(MemoryRefreshKind::nothing().with_ram());
        let mut system = System::new_with_specifics(of_machine).ok()?;
        system.refresh_processes_specifics(
            ProcessesToUpdate::Some(&[id]),
            false,
            ProcessRefreshKind::nothing().with_memory(),
        );
        let process = system.process(id)?;
        let of_machine = system.total_memory();
        let most = process
            .cgroup_limits()
            .map_or(of_machine, |limits| limits.total_memory.min(of_machine));
        let resident = process.memory();
        Some(Self { resident, most: most.min(resident.saturating_add(system.available_memory())) })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn memory_usage_is_below_its_limit() {
        let MemoryUsage { resident, most } = MemoryUsage::now().unwrap();
        assert!((1 << 20..most).contains(&resident), "{resident} of {most}");
    }
}
