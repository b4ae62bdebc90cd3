//! Scores one reply against its truth.

use super::reply::Reply;
use super::sealed::Ranked;
use super::segmentation::IOU_THRESHOLDS;
use super::suite::{Target, Task};
use serde::{Deserialize, Serialize};
use uniground_geometry::boxes::Aabb;
use uniground_grounding::Status;

/// The outcome of one expression. Boxes in meters, world frame (Z up).
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct ScoredExpression {
    pub id: String,
    pub scene: String,
    pub query: String,
    /// `unique`, `multiple`, `unknown` or `absent`, then further splits of the suite.
    pub splits: Vec<String>,
    pub target: Option<TargetOutcome>,
    /// `None` when the question failed.
    pub reply: Option<Reply>,
    /// The reason of the failure.
    pub error: Option<String>,
    /// File name of the picture of a wrong answer.
    pub picture: Option<String>,
}

/// The score against the target's box. Expressions about absent objects have none.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct TargetOutcome {
    pub name: Option<String>,
    #[serde(rename = "box")]
    pub aabb: Aabb,
    /// Axis-aligned IoU of the answer. 0 without an answer.
    pub iou: f32,
    /// IoU of the answer's oriented box with the annotated one, if there is one.
    pub iou_9dof: Option<f32>,
    /// Axis-aligned IoU of each candidate, by rank.
    pub candidate_ious: Vec<f32>,
    /// Axis-aligned IoU of each box of the shortlist.
    pub shortlist_ious: Vec<f32>,
    /// The best IoU of all instances: the upper bound set by stage 1.
    pub best_instance_iou: f32,
}

impl ScoredExpression {
    /// Scores a finished reply. `instances` are the boxes of all instances.
    #[must_use]
    pub fn score(
        task: &Task,
        scene: &str,
        asked: Result<&Ranked, String>,
        instances: &[Aabb],
    ) -> Self {
        let (ranked, error) = match asked {
            Ok(ranked) => (Some(ranked), None),
            Err(error) => (None, Some(error)),
        };
        let failed = Ranked::failed();
        let truth = task.truth.judge(ranked.unwrap_or(&failed));
        let reply = ranked.map(Ranked::reply);
        let target = match &truth.target {
            Target::Absent => None,
            Target::Object { name, aabb, rotated } => {
                let boxed = |f: &dyn Fn(&Reply) -> Vec<f32>| reply.map_or_else(Vec::new, f);
                let best = |ious: &mut dyn Iterator<Item = f32>| ious.fold(0.0, f32::max);
                Some(TargetOutcome {
                    name: name.clone(),
                    aabb: *aabb,
                    iou: reply.and_then(|r| r.aabb).map_or(0.0, |answer| answer.iou(aabb)),
                    iou_9dof: rotated.map(|truth| {
                        reply.and_then(|r| r.oriented_box).map_or(0.0, |b| truth.iou(&b.into()))
                    }),
                    candidate_ious: boxed(&|r| {
                        r.candidates.iter().map(|c| c.aabb.iou(aabb)).collect()
                    }),
                    shortlist_ious: boxed(&|r| r.shortlist.iter().map(|b| b.iou(aabb)).collect()),
                    best_instance_iou: best(&mut instances.iter().map(|b| b.iou(aabb))),
                })
            }
        };
        Self {
            id: task.id.clone(),
            scene: scene.to_owned(),
            query: task.expression.query.clone(),
            splits: std::iter::once(truth.uniqueness.to_owned())
                .chain(truth.splits.iter().cloned())
                .collect(),
            target,
            reply: reply.cloned(),
            error,
            picture: None,
        }
    }

    #[must_use]
    pub fn status(&self) -> Option<Status> {
        self.reply.as_ref().map(|r| r.status)
    }

    /// Returns whether it is right at an IoU: the box overlaps enough, or an absent target was
    /// reported as absent.
    #[must_use]
    pub fn is_right_at(&self, threshold: f32) -> bool {
        match &self.target {
            Some(target) => target.iou >= threshold,
            None => self.status() == Some(Status::NoMatch),
        }
    }

    #[must_use]
    pub fn is_right(&self) -> bool {
        self.is_right_at(IOU_THRESHOLDS[0])
    }
}
