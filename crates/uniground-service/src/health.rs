//! Checks whether everything that requests and jobs need is available.

use crate::Vlm;
use crate::single_flight_cache::SingleFlightCache;
use std::sync::Arc;
use std::time::Duration;
use uniground_endpoints::inference::Probe;
use uniground_jobs::Jobs;
use uniground_storage::{HealthProbe, StoreHealth};

/// The state of the parts of the service.
#[derive(Debug, Clone, Default)]
pub struct Health {
    pub store: StoreHealth,
    /// Kinds of jobs whose workers have stopped.
    pub dead_lanes: Vec<&'static str>,
    /// The state of the inference server, or why it does not work. `None` if no server runs the
    /// networks.
    pub inference: Option<Result<(), String>>,
    /// The state of the vision-language model, or how its last calls failed. `None` if no model is
    /// configured.
    pub vlm: Option<Result<(), String>>,
}

impl Health {
    /// Returns whether the service can do its work. It can without its vision-language model:
    /// built-in parts answer instead, and their answers say so.
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

/// The minimum interval between two checks, for any number of callers.
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
    /// Returns the state of the service.
    pub async fn health(&self) -> Health {
        self.last_health.get(AGE, self.check_health()).await
    }

    /// Returns the current state, or the last known one if the check takes longer than `patience`.
    /// Returns `None` if no state is known yet.
    pub(super) async fn health_within(&self, patience: Duration) -> Option<Health> {
        let service = self.clone();
        self.last_health
            .get_within(AGE, patience, async move { service.check_health().await })
            .await
    }

    async fn check_health(&self) -> Health {
        let inference = async {
            match &self.inference {
                Some(probe) => Some(probe.check_ready().await),
                None => None,
            }
        };
        let (mut store, inference) = tokio::join!(self.health_probe.health(), inference);
        // Damage is permanent, but not every check finds it.
        if let Some(before) = self.last_health.last().filter(|before| before.store.is_damaged) {
            store = StoreHealth { database: before.store.database, is_damaged: true, ..store };
        }
        let dead_lanes = self
            .jobs
            .lane_states()
            .into_iter()
            .filter(|(_, up)| !up)
            .map(|(kind, _)| kind)
            .collect();
        Health { store, dead_lanes, inference, vlm: self.vlm.as_ref().map(|vlm| vlm.condition()) }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn readiness_depends_on_lanes_and_inference_but_not_on_the_vlm() {
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
