//! Caches a value that takes a while to compute and may be slightly old. Concurrent callers share
//! one computation.

use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant};
use tokio::time::timeout;

/// The last value, with its time.
pub struct SingleFlightCache<T> {
    last: Arc<Mutex<Option<(Instant, T)>>>,
    /// Held by the caller that computes the value.
    looking: Arc<tokio::sync::Mutex<()>>,
}

impl<T> Clone for SingleFlightCache<T> {
    fn clone(&self) -> Self {
        Self { last: self.last.clone(), looking: self.looking.clone() }
    }
}

impl<T> Default for SingleFlightCache<T> {
    fn default() -> Self {
        Self { last: Arc::default(), looking: Arc::default() }
    }
}

impl<T: Clone + Send + 'static> SingleFlightCache<T> {
    /// Returns the cached value if it is younger than `age`, or computes it.
    pub async fn get(&self, age: Duration, compute: impl Future<Output = T>) -> T {
        let _looking = self.looking.lock().await;
        if let Some((at, value)) = &*self.last.lock().unwrap_or_else(PoisonError::into_inner)
            && at.elapsed() < age
        {
            return value.clone();
        }
        let value = compute.await;
        *self.last.lock().unwrap_or_else(PoisonError::into_inner) =
            Some((Instant::now(), value.clone()));
        value
    }

    /// Like [`get`](Self::get), but waits no longer than `patience`. After that the computation
    /// goes on in the background. Returns the previous value, or `None` if there is none.
    pub async fn get_within(
        &self,
        age: Duration,
        patience: Duration,
        compute: impl Future<Output = T> + Send + 'static,
    ) -> Option<T> {
        let cache = self.clone();
        let looking = tokio::spawn(async move { cache.get(age, compute).await });
        match timeout(patience, looking).await {
            Ok(Ok(value)) => Some(value),
            _ => self.last(),
        }
    }

    /// Returns the last value, however old it is.
    pub fn last(&self) -> Option<T> {
        self.last
            .lock()
            .unwrap_or_else(PoisonError::into_inner)
            .as_ref()
            .map(|(_, value)| value.clone())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use tokio::time::sleep;

    #[tokio::test]
    async fn callers_share_a_computation_that_continues_after_a_timeout() {
        let (cache, long) = (SingleFlightCache::default(), Duration::from_hours(1));
        assert_eq!(cache.get(long, async { 1 }).await, 1);
        assert_eq!(cache.get(long, async { 2 }).await, 1);
        let slow = async {
            sleep(Duration::from_millis(50)).await;
            3
        };
        assert_eq!(cache.get_within(Duration::ZERO, Duration::from_millis(5), slow).await, Some(1));
        assert_eq!(cache.get(long, async { 4 }).await, 3, "the slow computation has continued");
    }
}
