//! Low-priority threads for long work, so that a parse does not delay a question.
//!
//! On Linux each thread has its own niceness, and threads it starts inherit it. So what a
//! low-priority thread creates (the pools of a network's session) has low priority as well. On
//! other systems all threads have the same priority, and only the pools are separate.

use rayon::{ThreadPool, ThreadPoolBuildError, ThreadPoolBuilder};

/// Niceness of background threads: they get a tenth of the time of an ordinary thread when both
/// compete for one core.
#[cfg(target_os = "linux")]
const NICENESS: i32 = 10;

/// Creates a low-priority pool for long work, with as many threads as there are cores.
///
/// # Errors
/// Returns an error when the system cannot start more threads.
pub fn low_priority_pool() -> Result<ThreadPool, ThreadPoolBuildError> {
    ThreadPoolBuilder::new()
        .thread_name(|i| format!("background-{i}"))
        .start_handler(|_| lower_thread_priority())
        .build()
}

/// Runs `work` on a low-priority thread. Threads it starts have low priority too.
pub fn run_at_low_priority<T: Send>(work: impl FnOnce() -> T + Send) -> T {
    std::thread::scope(|scope| {
        let low = scope.spawn(|| {
            lower_thread_priority();
            work()
        });
        low.join().unwrap_or_else(|panic| std::panic::resume_unwind(panic))
    })
}

/// Lowers the priority of this thread. If the system refuses, other work gets slower, but results
/// do not change.
fn lower_thread_priority() {
    #[cfg(target_os = "linux")]
    if let Err(error) = rustix::process::nice(NICENESS) {
        tracing::debug!(%error, "priority of a background thread could not be lowered");
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[cfg(target_os = "linux")]
    #[test]
    fn low_priority_is_inherited_and_the_caller_keeps_its_own() {
        // Niceness of the calling thread: the nineteenth field of its `stat`.
        let niceness = || -> i32 {
            let stat = std::fs::read_to_string("/proc/thread-self/stat").unwrap();
            stat.rsplit(')').next().unwrap().split_whitespace().nth(16).unwrap().parse().unwrap()
        };
        let own = niceness();
        assert_eq!(low_priority_pool().unwrap().install(niceness), (own + NICENESS).min(19));
        let inherited = run_at_low_priority(|| {
            std::thread::scope(|scope| scope.spawn(niceness).join().unwrap())
        });
        assert_eq!(inherited, (own + NICENESS).min(19));
        assert_eq!(niceness(), own, "the caller's niceness must not change");
    }
}
