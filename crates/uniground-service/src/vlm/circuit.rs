//! A circuit breaker for the model's server. While the server is down, questions do not wait for
//! it. A server that could not be reached is up again at its first sign of life; one that fails is
//! tried again by one question from time to time.

use jiff::Timestamp;
use std::sync::{Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

/// What a call reveals about the model's server.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum CallSignal {
    /// It answered.
    Up,
    /// It cannot be reached. One such call is enough to open the circuit.
    Unreachable,
    /// It reported that it cannot answer now. A few such calls in a row open the circuit.
    Failing,
    /// It answered, but not this question. Says nothing about other questions.
    Unclear,
}

/// The wait before the server is first tried again. Each later wait is twice as long.
const MIN_BACKOFF: Duration = Duration::from_secs(5);
const MAX_BACKOFF: Duration = Duration::from_mins(2);
/// The interval between two looks for a server that could not be reached.
pub const LOOK_INTERVAL: Duration = Duration::from_secs(1);
/// Failed calls in a row after which a reachable server counts as down.
const FAILURES: u32 = 5;

/// Decides whether the model is called.
#[derive(Default)]
pub struct CircuitBreaker(Mutex<CircuitState>);

#[derive(Default)]
struct CircuitState {
    /// The number of failed calls in a row, the outcome of the last one, and the time of the first
    /// one.
    failing: Option<(u32, &'static str, String)>,
    /// Calls in a row whose signal was `Unreachable` or `Failing`: the server may be down.
    down: u32,
    open: Option<OpenCircuit>,
}

/// The circuit is open: calls are rejected.
struct OpenCircuit {
    /// Whether the server could not be reached. Otherwise it answers, but fails.
    is_unreachable: bool,
    /// When the server was last looked for.
    looked_for: Instant,
    until: Instant,
    wait: Duration,
    /// Start time of the probe, a call that tries the server again.
    trying: Option<Instant>,
}

/// A probe that never ends blocks other probes no longer than this.
const MAX_PROBE_DURATION: Duration = Duration::from_mins(10);

impl CircuitBreaker {
    fn state(&self) -> MutexGuard<'_, CircuitState> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Admits a call if the circuit is closed, or as a probe if one is due.
    ///
    /// # Errors
    /// The time to wait.
    pub fn admit(&self, now: Instant) -> Result<(), Duration> {
        let mut state = self.state();
        let Some(open) = &mut state.open else { return Ok(()) };
        if now < open.until {
            return Err(open.until - now);
        }
        if open.trying.is_some_and(|since| now.duration_since(since) < MAX_PROBE_DURATION) {
            return Err(MIN_BACKOFF);
        }
        open.trying = Some(now);
        Ok(())
    }

    /// Returns whether the server could not be reached and has not been seen since.
    pub fn is_unreachable(&self) -> bool {
        self.state().open.as_ref().is_some_and(|open| open.is_unreachable)
    }

    /// Returns whether it is time to look for a sign of life of a server that could not be reached.
    pub fn wants_look(&self, now: Instant) -> bool {
        self.state().open.as_ref().is_some_and(|open| {
            open.is_unreachable && now.duration_since(open.looked_for) >= LOOK_INTERVAL
        })
    }

    /// Records a look for the server. It is called again if it was seen.
    pub fn record_look(&self, is_alive: bool, now: Instant) {
        let mut state = self.state();
        if is_alive {
            *state = CircuitState::default();
        } else if let Some(open) = &mut state.open {
            // No question has to find out what the look has shown.
            (open.looked_for, open.until) = (now, now + LOOK_INTERVAL);
        }
    }

    /// Records the outcome of a call, with a word for it.
    pub fn record(&self, sign: CallSignal, word: &'static str, now: Instant) {
        let mut state = self.state();
        if sign == CallSignal::Up {
            *state = CircuitState::default();
            return;
        }
        let (calls, _, since) =
            state.failing.take().unwrap_or_else(|| (0, word, Timestamp::now().to_string()));
        state.failing = Some((calls + 1, word, since));
        state.down = match sign {
            CallSignal::Unreachable | CallSignal::Failing => state.down + 1,
            // The server is up.
            CallSignal::Up | CallSignal::Unclear => 0,
        };
        let is_down = sign == CallSignal::Unreachable || state.down >= FAILURES;
        let wait = state.open.as_ref().map_or(MIN_BACKOFF, |open| (open.wait * 2).min(MAX_BACKOFF));
        state.open = is_down.then(|| OpenCircuit {
            is_unreachable: sign == CallSignal::Unreachable,
            looked_for: now,
            until: now + wait,
            wait,
            trying: None,
        });
    }

    /// Records that a probe was abandoned before its answer. The next call becomes the probe.
    pub fn release_probe(&self) {
        if let Some(open) = &mut self.state().open {
            open.trying = None;
        }
    }

    /// Returns whether the model answered its last call. Otherwise describes since when it has not.
    pub fn condition(&self) -> Result<(), String> {
        match &self.state().failing {
            None => Ok(()),
            Some((calls, word, since)) => Err(format!("{word} since {since} ({calls} calls)")),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_open_circuit_admits_one_probe_at_a_time() {
        let (circuit, start) = (CircuitBreaker::default(), Instant::now());
        let after = |seconds| start + Duration::from_secs(seconds);
        assert!(circuit.admit(start).is_ok() && circuit.condition().is_ok());
        circuit.record(CallSignal::Unreachable, "unreachable", start);
        assert_eq!(circuit.admit(after(1)), Err(Duration::from_secs(4)));
        assert!(circuit.condition().unwrap_err().starts_with("unreachable since"));
        assert!(circuit.admit(after(5)).is_ok(), "one probe is admitted");
        assert!(circuit.admit(after(5)).is_err(), "a second probe is rejected");
        circuit.record(CallSignal::Unreachable, "unreachable", after(6));
        assert_eq!(circuit.admit(after(6)), Err(Duration::from_secs(10)));
        assert!(circuit.admit(after(16)).is_ok());
        circuit.release_probe();
        assert!(circuit.admit(after(16)).is_ok(), "the released probe is replaced");
        circuit.record(CallSignal::Up, "answered", after(17));
        assert!(
            circuit.admit(after(17)).is_ok()
                && circuit.admit(after(17)).is_ok()
                && circuit.condition().is_ok()
        );
    }

    #[test]
    fn an_unreachable_server_is_up_at_its_first_sign_of_life() {
        let (circuit, start) = (CircuitBreaker::default(), Instant::now());
        let after = |seconds| start + Duration::from_secs(seconds);
        assert!(!circuit.wants_look(start), "nobody is looked for while all is well");
        circuit.record(CallSignal::Unreachable, "unreachable", start);
        assert!(!circuit.wants_look(start) && circuit.wants_look(after(1)));
        circuit.record_look(false, after(1));
        assert!(!circuit.wants_look(after(1)) && circuit.admit(after(1)).is_err());
        assert!(circuit.wants_look(after(2)));
        circuit.record_look(true, after(2));
        assert!((0..3).all(|_| circuit.admit(after(2)).is_ok()), "everybody is admitted");
        // A server that answers with errors shows signs of life all the time.
        (0..FAILURES).for_each(|_| circuit.record(CallSignal::Failing, "refused", after(3)));
        assert!(!circuit.wants_look(after(60)));
    }

    #[test]
    fn failures_in_a_row_open_the_circuit() {
        let (circuit, now) = (CircuitBreaker::default(), Instant::now());
        let failing = |calls: u32| {
            (0..calls).for_each(|_| circuit.record(CallSignal::Failing, "refused", now));
        };
        failing(FAILURES - 1);
        circuit.record(CallSignal::Unclear, "refused", now);
        failing(FAILURES - 1);
        assert!(circuit.admit(now).is_ok(), "the failures are not in a row");
        failing(1);
        assert!(circuit.admit(now).is_err());
        assert!(circuit.condition().unwrap_err().contains("10 calls"));
    }
}
