//! The result of stage 1: a scene cut into instances.

use super::{Instance, InstanceId, PointCloud};
use crate::geometry::boxes::Aabb;
use serde::{Deserialize, Serialize};
use utoipa::ToSchema;

/// A parsed scene: every point belongs to exactly one instance.
#[derive(Debug, Clone)]
pub struct ParsedScene {
    pub cloud: PointCloud,
    /// Instance of each point of `cloud`.
    pub instance_of_point: Vec<InstanceId>,
    /// In order of id.
    pub instances: Vec<Instance>,
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
    /// Wall-clock seconds per stage, in order.
    pub stages: Vec<StageTiming>,
    pub warnings: Vec<String>,
}

#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct StageTiming {
    pub stage: String,
    pub seconds: f32,
}
