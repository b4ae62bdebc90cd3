//! The result of stage 1: a scene cut into instances.

use super::{Embeddings, Instance, InstanceId, PointCloud};
use crate::geometry::boxes::Aabb;
use serde::{Deserialize, Serialize};
use utoipa::ToSchema;

/// A parsed scene: every point belongs to exactly one instance.
#[derive(Debug, Clone)]
pub struct ParsedScene {
    pub cloud: PointCloud,
    /// Instance of each point of `cloud`.
    pub instance_of_point: Vec<InstanceId>,
    /// Superpoint of each point, numbered from 0.
    pub superpoint_of_point: Vec<u32>,
    /// In order of id.
    pub instances: Vec<Instance>,
    /// What the instances look like, where an encoder has seen them.
    pub embeddings: Option<Embeddings>,
    pub extent: Aabb,
    pub report: ParseReport,
}

/// What stage 1 did, for people who want to know what went wrong.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct ParseReport {
    pub points: u64,
    pub frames_used: u32,
    pub superpoints: u32,
    pub instances: u32,
    /// Instances flagged as floor, wall or ceiling.
    pub structural: u32,
    /// Instances that no frame shows.
    pub without_views: u32,
    /// What each stage did and took, in order.
    pub stages: Vec<StageReport>,
    pub warnings: Vec<String>,
}

#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct StageReport {
    pub stage: String,
    /// Wall-clock.
    pub seconds: f32,
    /// How many came out: points, superpoints, masks over all frames, regions, instances, sightings of instances.
    #[serde(default)]
    pub produced: u64,
    /// Whether they were kept from an earlier parse of the scan that got so far under the same settings.
    #[serde(default)]
    pub reused: bool,
    /// Largest resident memory of the whole process during the stage, 10^6 bytes; `null` where the system does not tell.
    #[serde(default)]
    pub peak_memory_mb: Option<u32>,
}
