//! Whether everything a request or a job may need is there.

use crate::Vlm;
use crate::single_flight_cache::SingleFlightCache;
use std::sync::Arc;
use std::time::Duration;
use uniground_endpoints::inference::Probe;
use uniground_jobs::Jobs;
use uniground_storage::{HealthProbe, StoreHealth};

/// How the parts of the service are.
#[derive(Debug, Clone, Default)]
pub struct Health {
    pub store: StoreHealth,
    /// Kinds of jobs that nobody works on any more.
    pub dead_lanes: Vec<&'static str>,
    /// Where an inference server runs the networks: why it does not, if so.
    pub inference: Option<Result<(), String>>,
    /// Where a vision-language model is configured: what became of the last calls, if it could not
    /// be asked.
    pub vlm: Option<Result<(), String>>,
}

impl Health {
    /// Whether the service can do its work. Without its vision-language model it can: built-in
    /// parts answer, and say so.
    #[must_use]
    pub fn is_ready(&self) -> bool {
        let Self {
            store: StoreHealth { database, blobs, disk, is_damaged: _ },
            dead_lanes,
            inference,
            vlm: _,
        } = self;
        let whole = [database, blobs, disk].into_iter().all(Option::is_none);
        whole && dead_lanes.is_empty() && !matches!(inference, Some(Err(_)))
    }
}

/// Looked at so often at most, however many ask.
const AGE: Duration = Duration::from_secs(1);

/// Checks what the service depends on.
#[derive(Clone)]
pub struct HealthService {
    pub(crate) last_health: SingleFlightCache<Health>,
    pub(crate) health_probe: HealthProbe,
    pub(crate) inference: Option<Arc<Probe>>,
    pub(crate) jobs: Jobs,
    pub(crate) vlm: Option<Arc<Vlm>>,
}

impl HealthService {
    /// How everything is.
    pub async fn health(&self) -> Health {
        self.last_health.get(AGE, self.look_at_health()).await
    }

    /// How everything is or was, for somebody in a hurry; `None` while that is not known.
    pub(super) async fn health_soon(&self, patience: Duration) -> Option<Health> {
        let service = self.clone();
        self.last_health
            .get_soon(AGE, patience, async move { service.look_at_health().await })
            .await
    }

    async fn look_at_health(&self) -> Health {
        let inference = async {
            match &self.inference {
                Some(probe) => Some(probe.look().await),
                None => None,
            }
        };
        let (mut store, inference) = tokio::join!(self.health_probe.health(), inference);
        // Not every look meets the damage, and it does not heal.
        if let Some(before) = self.last_health.last().filter(|before| before.store.is_damaged) {
            store = StoreHealth { database: before.store.database, is_damaged: true, ..store };
        }
        let dead_lanes =
            self.jobs.lanes().into_iter().filter(|(_, up)| !up).map(|(kind, _)| kind).collect();
        Health { store, dead_lanes, inference, vlm: self.vlm.as_ref().map(|vlm| vlm.condition()) }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_dead_lane_or_a_lost_network_is_not_ready_and_a_silent_model_is() {
        let with = |change: fn(&mut Health)| {
            let mut health = Health::default();
            change(&mut health);
            health.is_ready()
        };
        assert!(with(|_| {}));
        assert!(with(|health| health.vlm = Some(Err("unreachable".into()))));
        assert!(!with(|health| health.dead_lanes.push("naming")));
        assert!(!with(|health| health.inference = Some(Err("gone".into()))));
        assert!(!with(|health| health.store.disk = Some("full".into())));
    }
}
