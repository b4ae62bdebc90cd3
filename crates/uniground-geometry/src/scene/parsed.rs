//! The result of stage 1: a scene cut into instances.

use super::{Embeddings, FrameEmbeddings, Instance, InstanceId, ParseReport, PointCloud};
use crate::boxes::Aabb;

/// A parsed scene: every point belongs to one thing, or to none; parts and wholes overlap the
/// things.
#[derive(Debug, Clone)]
pub struct ParsedScene {
    /// The points of the import, in its order.
    pub cloud: PointCloud,
    /// Thing each point of `cloud` belongs to; 0: none, for what no mask shows.
    pub instance_of_point: Vec<InstanceId>,
    /// Superpoint of each point, numbered from 0.
    pub superpoint_of_point: Vec<u32>,
    /// In order of id: things, then parts and wholes.
    pub instances: Vec<Instance>,
    /// What the instances look like, where an encoder has seen them.
    pub embeddings: Option<Embeddings>,
    /// What some of the frames look like as a whole, where an encoder has seen them.
    pub frame_embeddings: Option<FrameEmbeddings>,
    /// Axis-aligned box of all points, metres, world frame.
    pub extent: Aabb,
    /// What each step did and took, and what is odd.
    pub report: ParseReport,
}
