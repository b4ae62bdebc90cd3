//! Measures the time and memory of each stage. Only for the report: no decision depends on it.

use std::fs;
use std::time::Instant;
use uniground_geometry::scene::{ModelTime, StageReport};

/// Collects one [`StageReport`] per stage.
#[derive(Default)]
pub struct Stopwatch {
    /// In the order they ran; failed stages are left out.
    pub stages: Vec<StageReport>,
}

/// The outcome that a stage reports.
#[derive(Default)]
pub struct StageOutcome {
    /// Number of items that the stage produced.
    pub produced: usize,
    /// Whether they came from a checkpoint.
    pub reused: bool,
    /// Time spent in models.
    pub models: Vec<ModelTime>,
}

impl Stopwatch {
    /// Runs a stage and records its time and memory.
    ///
    /// # Errors
    /// Errors of `work`.
    pub fn time<T, E>(
        &mut self,
        stage: &str,
        work: impl FnOnce(&mut StageOutcome) -> Result<T, E>,
    ) -> Result<T, E> {
        reset_peak_memory();
        let start = Instant::now();
        let mut outcome = StageOutcome::default();
        let result = work(&mut outcome)?;
        self.stages.push(StageReport {
            stage: stage.into(),
            seconds: start.elapsed().as_secs_f32(),
            produced: outcome.produced as u64,
            reused: outcome.reused,
            peak_memory_mb: peak_memory_mb(),
            models: outcome.models,
        });
        Ok(result)
    }
}

/// Resets the kernel's peak memory counter of this process; other readers of its `VmHWM` see the
/// same. If the kernel does not allow it, the peak since process start is reported.
fn reset_peak_memory() {
    let _ = fs::write("/proc/self/clear_refs", "5");
}

/// Returns the largest resident memory of the process since the last reset, MB; `None` where the
/// system does not report it.
fn peak_memory_mb() -> Option<u32> {
    let status = fs::read_to_string("/proc/self/status").ok()?;
    let line = status.lines().find(|line| line.starts_with("VmHWM:"))?;
    let kilobytes: u64 = line.split_whitespace().nth(1)?.parse().ok()?;
    u32::try_from(kilobytes * 1024 / 1_000_000).ok()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn successful_stages_are_recorded_and_failed_ones_are_not() {
        let mut watch = Stopwatch::default();
        let first = watch.time("first", |outcome| {
            outcome.produced = 3;
            Ok::<_, ()>("done")
        });
        assert_eq!(first, Ok("done"));
        assert_eq!(watch.time("second", |_| Err::<(), _>("broken")), Err("broken"));
        assert_eq!(watch.stages.len(), 1);
        assert_eq!((watch.stages[0].stage.as_str(), watch.stages[0].produced), ("first", 3));
        #[cfg(target_os = "linux")]
        assert!(watch.stages[0].peak_memory_mb.is_some_and(|mb| mb > 1));
    }
}
