//! Time-ordered ids, also when the clock is set back.

use jiff::Timestamp;
use std::sync::{Arc, Mutex, PoisonError};
use uuid::{ContextV7, Uuid};

/// Generates UUIDv7 ids, each greater than all before it. Clones share the order.
#[derive(Clone)]
pub struct IdGenerator(Arc<Mutex<ContextV7>>);

impl IdGenerator {
    /// Returns a new id, greater than all before it.
    #[must_use]
    pub fn new_id(&self) -> String {
        self.at(Timestamp::now())
    }

    /// Creates a generator that continues after `newest`, the greatest existing id.
    #[must_use]
    pub fn after(newest: Option<&str>) -> Self {
        let context = ContextV7::new();
        let last = newest.and_then(|id| id.parse::<Uuid>().ok()).and_then(|id| id.get_timestamp());
        if let Some((seconds, nanos)) = last.map(|last| last.to_unix()) {
            // Start with the next millisecond: the counter within the last one is not known.
            let (seconds, nanos) =
                if nanos < 999_000_000 { (seconds, nanos + 1_000_000) } else { (seconds + 1, 0) };
            let _ = uuid::Timestamp::from_unix(&context, seconds, nanos);
        }
        Self(Arc::new(Mutex::new(context)))
    }

    pub fn at(&self, now: Timestamp) -> String {
        let context = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        let (seconds, nanos) = (
            u64::try_from(now.as_second()).unwrap_or(0),
            u32::try_from(now.subsec_nanosecond()).unwrap_or(0),
        );
        Uuid::new_v7(uuid::Timestamp::from_unix(&*context, seconds, nanos)).to_string()
    }
}

/// Returns the first id that could have been assigned at a time. Smaller ids are older.
#[must_use]
pub fn first_id_at(time: Timestamp) -> String {
    let millis = u64::try_from(time.as_millisecond()).unwrap_or(0);
    uuid::Builder::from_unix_timestamp_millis(millis, &[0; 10]).into_uuid().to_string()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn ids_stay_ordered_when_the_clock_is_set_back() {
        let (day, hour) =
            ("2026-11-20T12:00:00Z".parse().unwrap(), "2026-11-20T11:00:00Z".parse().unwrap());
        let ids = IdGenerator::after(None);
        let made: Vec<String> = [day, day, hour, hour].map(|time| ids.at(time)).into();
        assert!(made.is_sorted() && made[0] < made[3], "{made:?}");
        // The same holds if the clock is set back while the server is down.
        let later = IdGenerator::after(Some(&made[3])).at(hour);
        assert!(later > made[3], "{later} after {made:?}");
    }
}
