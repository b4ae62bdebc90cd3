//! What each stage took, for the report only: nothing is decided by it.

use std::fs;
use std::time::Instant;
use uniground_geometry::scene::StageReport;

/// Collects one [`StageReport`] per stage.
#[derive(Default)]
pub struct Stopwatch {
    /// In the order they were run; failed ones are left out.
    pub stages: Vec<StageReport>,
}

/// What a stage says about itself.
#[derive(Default)]
pub struct StageOutcome {
    /// How many things came out of the stage.
    pub produced: usize,
    /// Whether they were kept from an earlier attempt.
    pub reused: bool,
}

impl Stopwatch {
    /// Runs a stage and notes its time and memory.
    ///
    /// # Errors
    /// Those of `work`.
    pub fn time<T, E>(
        &mut self,
        stage: &str,
        work: impl FnOnce(&mut StageOutcome) -> Result<T, E>,
    ) -> Result<T, E> {
        forget_peak_memory();
        let start = Instant::now();
        let mut outcome = StageOutcome::default();
        let result = work(&mut outcome)?;
        self.stages.push(StageReport {
            stage: stage.into(),
            seconds: start.elapsed().as_secs_f32(),
            produced: outcome.produced as u64,
            reused: outcome.reused,
            peak_memory_mb: peak_memory_mb(),
        });
        Ok(result)
    }
}

/// Makes the kernel count the peak memory from here on; others who read `VmHWM` of this process see
/// the same. Where the kernel does not allow it, the peak is that since the process began.
fn forget_peak_memory() {
    let _ = fs::write("/proc/self/clear_refs", "5");
}

/// Largest resident memory of the process since it was last forgotten, MB; `None` where the system
/// does not tell.
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
    fn stages_are_noted_in_order_and_failures_are_not() {
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
