//! Ranks candidates by score: top-k, ties by id.

use super::answer::to_candidate;
use super::{Candidate, SceneView};
use uniground_geometry::statistics::largest_indices;

/// Returns the `top_k` best instances by `scores` (by index). Instances with a score of 0 are no
/// candidates.
pub(super) fn rank(scene: SceneView, scores: &[f32], top_k: usize) -> Vec<Candidate> {
    largest_indices(scores, top_k)
        .into_iter()
        .filter(|&i| scores[i] > 0.0)
        .enumerate()
        .map(|(rank, i)| to_candidate(&scene.instances[i], rank as u32 + 1, scores[i]))
        .collect()
}
