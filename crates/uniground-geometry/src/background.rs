//! Threads of long work that give way: a parse must not stand in front of somebody's question.
//!
//! On Linux a thread has a niceness of its own, and threads it starts inherit it: what a low thread
//! creates (the pools of a network's session) is low as well. Elsewhere all threads are alike, and
//! only the pools are apart.

use rayon::{ThreadPool, ThreadPoolBuildError, ThreadPoolBuilder};

/// How much background threads give way: a tenth of what an ordinary thread gets where both want
/// the same core.
#[cfg(target_os = "linux")]
const NICENESS: i32 = 10;

/// A pool for long work, as many threads as there are cores.
///
/// # Errors
/// When the system has no threads left.
pub fn pool() -> Result<ThreadPool, ThreadPoolBuildError> {
    ThreadPoolBuilder::new()
        .thread_name(|i| format!("background-{i}"))
        .start_handler(|_| give_way())
        .build()
}

/// Runs `work` on a thread that gives way: threads it starts do so as well.
pub fn on_low_thread<T: Send>(work: impl FnOnce() -> T + Send) -> T {
    std::thread::scope(|scope| {
        let low = scope.spawn(|| {
            give_way();
            work()
        });
        low.join().unwrap_or_else(|panic| std::panic::resume_unwind(panic))
    })
}

/// Lowers the priority of this thread. What the system refuses costs speed elsewhere, never a
/// result.
fn give_way() {
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
    fn background_threads_give_way_and_so_do_those_they_start() {
        // Of the calling thread: the nineteenth field of its `stat`.
        let niceness = || -> i32 {
            let stat = std::fs::read_to_string("/proc/thread-self/stat").unwrap();
            stat.rsplit(')').next().unwrap().split_whitespace().nth(16).unwrap().parse().unwrap()
        };
        let own = niceness();
        assert_eq!(pool().unwrap().install(niceness), (own + NICENESS).min(19));
        let inherited =
            on_low_thread(|| std::thread::scope(|scope| scope.spawn(niceness).join().unwrap()));
        assert_eq!(inherited, (own + NICENESS).min(19));
        assert_eq!(niceness(), own, "the caller keeps its own");
    }
}
