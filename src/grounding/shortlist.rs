//! Candidates by score: top-k, ties by id.

use super::SceneView;
use crate::geometry::boxes::Aabb;
use crate::geometry::statistics::largest;
use crate::scene::InstanceId;
use serde::{Deserialize, Serialize};
use utoipa::ToSchema;

/// An instance that may be meant.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct Candidate {
    pub id: InstanceId,
    /// From 1.
    pub rank: u32,
    /// Fit to the question, `0..=1`.
    pub score: f32,
    #[serde(rename = "box")]
    pub aabb: Aabb,
}

/// The `top_k` best instances by `scores` (by index); instances that score nothing are no candidates.
pub(super) fn rank(scene: SceneView, scores: &[f32], top_k: usize) -> Vec<Candidate> {
    largest(scores, top_k)
        .into_iter()
        .filter(|&i| scores[i] > 0.0)
        .enumerate()
        .map(|(rank, i)| {
            let instance = &scene.instances[i];
            Candidate { id: instance.id, rank: rank as u32 + 1, score: scores[i], aabb: instance.aabb }
        })
        .collect()
}
