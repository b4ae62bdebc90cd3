//! Processes frames in parallel and uses the results in order.

use super::FrameRef;
use rayon::prelude::*;
use std::collections::BTreeMap;
use std::sync::{Mutex, MutexGuard, PoisonError};

/// How far a thread may run ahead of a slow frame: frames per thread. Bounds the number of results
/// in memory.
const AHEAD: usize = 3;

/// Processes frames in parallel, a few at a time, and folds the results in frame order.
///
/// At most one frame per thread is in memory, and a few results. The outcome does not depend on the
/// number of threads. `fold` runs on any thread, one call at a time.
///
/// # Errors
/// The first error of `work` or `fold`, in frame order.
pub fn stream_frames<T: Send, E: Send>(
    frames: &[FrameRef],
    work: impl Fn(&FrameRef) -> Result<T, E> + Sync,
    fold: impl FnMut(usize, T) -> Result<(), E> + Send,
) -> Result<(), E> {
    let at_once = rayon::current_num_threads();
    let stream = Stream {
        frames: frames.len(),
        ahead: AHEAD * at_once,
        state: Mutex::new(StreamState {
            claimed: 0,
            folded: 0,
            done: BTreeMap::new(),
            error: None,
        }),
        fold: Mutex::new(fold),
    };
    loop {
        // Threads do not wait for each other: one may run inside of the work of another, when that
        // work is parallel itself. A thread that is too far ahead ends instead.
        (0..at_once).into_par_iter().with_max_len(1).for_each(|_| {
            while let Some(frame) = stream.claim() {
                let result = work(&frames[frame]);
                stream.state().done.insert(frame, result);
                stream.fold_finished();
            }
        });
        stream.fold_finished();
        let mut state = stream.state();
        if let Some(error) = state.error.take() {
            return Err(error);
        }
        if state.folded == frames.len() {
            return Ok(());
        }
    }
}

struct Stream<T, E, F> {
    frames: usize,
    ahead: usize,
    state: Mutex<StreamState<T, E>>,
    fold: Mutex<F>,
}

struct StreamState<T, E> {
    /// Number of frames that threads have taken.
    claimed: usize,
    /// Number of frames whose results were used.
    folded: usize,
    /// Results that wait for those of earlier frames.
    done: BTreeMap<usize, Result<T, E>>,
    error: Option<E>,
}

impl<T, E, F: FnMut(usize, T) -> Result<(), E>> Stream<T, E, F> {
    fn state(&self) -> MutexGuard<'_, StreamState<T, E>> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Takes the next frame, unless there is none, one has failed, or it is too far ahead.
    fn claim(&self) -> Option<usize> {
        let mut state = self.state();
        let open = state.error.is_none()
            && state.claimed < self.frames.min(state.folded.saturating_add(self.ahead));
        open.then(|| {
            state.claimed += 1;
            state.claimed - 1
        })
    }

    /// Uses the results that are next in order. Does nothing while another thread does this: what
    /// that thread leaves behind is found by a later call.
    fn fold_finished(&self) {
        let Ok(mut fold) = self.fold.try_lock() else { return };
        loop {
            let (frame, result) = {
                let mut state = self.state();
                let frame = state.folded;
                match state.done.remove(&frame) {
                    Some(result) if state.error.is_none() => (frame, result),
                    _ => return,
                }
            };
            let folded = result.and_then(|result| fold(frame, result));
            let mut state = self.state();
            match folded {
                Ok(()) => state.folded += 1,
                Err(error) => state.error = Some(error),
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::super::{FrameIndex, Intrinsics, Optics};
    use super::*;
    use crate::Isometry3;
    use std::sync::atomic::{AtomicUsize, Ordering};
    use std::time::Duration;

    fn frames(number: u32) -> Vec<FrameRef> {
        let intrinsics = Intrinsics { width: 1, height: 1, fx: 1.0, fy: 1.0, cx: 0.0, cy: 0.0 };
        (0..number)
            .map(|i| FrameRef {
                index: FrameIndex(i),
                time_s: None,
                color: "c".into(),
                depth: "d".into(),
                color_intrinsics: intrinsics,
                depth_intrinsics: intrinsics,
                depth_scale_m: 0.001,
                camera_to_world: Isometry3::identity(),
                optics: Optics::default(),
            })
            .collect()
    }

    fn in_pool<T: Send>(threads: usize, work: impl FnOnce() -> T + Send) -> T {
        rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap().install(work)
    }

    /// Every seventh frame is slow, and the work of each is parallel itself.
    #[test]
    fn results_are_folded_in_order_and_few_run_ahead() {
        for threads in [1, 2, 5] {
            let (started, furthest) = (AtomicUsize::new(0), AtomicUsize::new(0));
            let mut folded = Vec::new();
            let done = in_pool(threads, || {
                stream_frames(
                    &frames(50),
                    |frame| {
                        started.fetch_add(1, Ordering::SeqCst);
                        if frame.index.0.is_multiple_of(7) {
                            std::thread::sleep(Duration::from_millis(3));
                        }
                        Ok::<_, ()>((0..1000_u32).into_par_iter().sum::<u32>() + frame.index.0)
                    },
                    |i, sum| {
                        furthest.fetch_max(started.load(Ordering::SeqCst) - i, Ordering::SeqCst);
                        folded.push((i, sum - 499_500));
                        Ok(())
                    },
                )
            });
            assert_eq!(done, Ok(()));
            assert!(folded.iter().enumerate().all(|(k, &(i, frame))| k == i && i as u32 == frame));
            assert_eq!(folded.len(), 50);
            assert!(furthest.into_inner() <= AHEAD * threads, "{threads} threads");
        }
    }

    #[test]
    fn the_first_error_in_frame_order_is_returned() {
        let fails = |at: [u32; 2]| {
            let mut folded = 0;
            let error = in_pool(3, || {
                stream_frames(
                    &frames(40),
                    |frame| {
                        // The later of the two fails sooner.
                        std::thread::sleep(Duration::from_millis(u64::from(
                            frame.index.0 == at[0],
                        )));
                        if at.contains(&frame.index.0) { Err(frame.index.0) } else { Ok(()) }
                    },
                    |_, ()| {
                        folded += 1;
                        Ok(())
                    },
                )
            });
            (error, folded)
        };
        assert_eq!(fails([10, 11]), (Err(10), 10));
        let of_fold = in_pool(2, || {
            stream_frames(&frames(9), |_| Ok(()), |i, ()| if i == 4 { Err("no") } else { Ok(()) })
        });
        assert_eq!(of_fold, Err("no"));
        assert_eq!(stream_frames(&[], |_| Ok::<_, ()>(()), |_, ()| Ok(())), Ok(()));
    }
}
