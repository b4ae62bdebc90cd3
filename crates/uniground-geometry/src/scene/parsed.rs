//! The result of stage 1: a scene segmented into instances.

use super::{Embeddings, FrameEmbeddings, Instance, InstanceId, ParseReport, PointCloud};
use crate::boxes::Aabb;

/// A parsed scene: every point belongs to one thing, or to none. Parts and wholes overlap the
/// things.
#[derive(Debug, Clone)]
pub struct ParsedScene {
    /// The points of the import, in its order.
    pub cloud: PointCloud,
    /// The thing that each point of `cloud` belongs to; 0 for points that no mask contains.
    pub instance_of_point: Vec<InstanceId>,
    /// Superpoint of each point, numbered from 0.
    pub superpoint_of_point: Vec<u32>,
    /// Sorted by id: things, then parts and wholes.
    pub instances: Vec<Instance>,
    /// Embeddings of the instances, if an encoder is configured.
    pub embeddings: Option<Embeddings>,
    /// Embeddings of some whole frames, if an encoder is configured.
    pub frame_embeddings: Option<FrameEmbeddings>,
    /// Axis-aligned box of all points, meters, world frame.
    pub extent: Aabb,
    /// The result and duration of each step, and warnings.
    pub report: ParseReport,
}
