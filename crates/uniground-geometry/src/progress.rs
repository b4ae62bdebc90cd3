//! Progress reports and cancellation of long work.

use std::sync::Arc;

/// The work was cancelled by its caller.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
#[error("cancelled")]
pub struct Cancelled;

type Sink = dyn Fn(&'static str, f32) + Send + Sync;
type Stop = dyn Fn() -> bool + Send + Sync;

/// A progress sink with a cancellation check, passed to pipelines as one value.
#[derive(Clone)]
pub struct Progress {
    sink: Arc<Sink>,
    is_cancelled: Arc<Stop>,
    from: f32,
    to: f32,
}

impl Progress {
    /// Creates a progress. `sink` receives a stage's name and the overall progress in `0..=1`.
    /// `is_cancelled` is called often and must be cheap.
    pub fn new(
        sink: impl Fn(&'static str, f32) + Send + Sync + 'static,
        is_cancelled: impl Fn() -> bool + Send + Sync + 'static,
    ) -> Self {
        Self { sink: Arc::new(sink), is_cancelled: Arc::new(is_cancelled), from: 0.0, to: 1.0 }
    }

    /// Creates a progress that reports nothing and is never cancelled.
    #[must_use]
    pub fn silent() -> Self {
        Self::new(|_, _| {}, || false)
    }

    /// Returns a progress for the part `from..to` (shares of this one).
    #[must_use]
    pub fn sub_range(&self, from: f32, to: f32) -> Self {
        let at = |share: f32| self.from + (self.to - self.from) * share;
        Self { from: at(from), to: at(to), ..self.clone() }
    }

    /// Reports that `done` (0..=1) of this part is complete, in `stage`.
    ///
    /// # Errors
    /// Returns [`Cancelled`] once the caller has cancelled.
    pub fn report(&self, stage: &'static str, done: f32) -> Result<(), Cancelled> {
        self.check()?;
        (self.sink)(stage, self.from + (self.to - self.from) * done.clamp(0.0, 1.0));
        Ok(())
    }

    /// Checks for cancellation.
    ///
    /// # Errors
    /// Returns [`Cancelled`] once the caller has cancelled.
    pub fn check(&self) -> Result<(), Cancelled> {
        if (self.is_cancelled)() { Err(Cancelled) } else { Ok(()) }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::sync::Mutex;
    use std::sync::atomic::{AtomicBool, Ordering};

    #[test]
    fn nested_sub_ranges_scale_progress_and_reports_fail_after_cancellation() {
        let seen = Arc::new(Mutex::new(Vec::new()));
        let cancel = Arc::new(AtomicBool::new(false));
        let sink = {
            let seen = seen.clone();
            move |stage, at| seen.lock().unwrap().push((stage, at))
        };
        let asked = cancel.clone();
        let progress = Progress::new(sink, move || asked.load(Ordering::Relaxed));
        progress.sub_range(0.5, 1.0).sub_range(0.0, 0.5).report("inner", 1.0).unwrap();
        assert_eq!(*seen.lock().unwrap(), [("inner", 0.75)]);
        cancel.store(true, Ordering::Relaxed);
        assert_eq!(progress.report("late", 0.0), Err(Cancelled));
    }
}
