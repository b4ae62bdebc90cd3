//! What tools take and tell: less than the API does, as language models read every word.

use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use uniground_types::answer::{Alternative, Answer, NoMatchReason, Seen, Status, Target};
use uniground_types::approach::{ApproachRequest, FloorPoint, Robot};
use uniground_types::geometry::boxes::Aabb;
use uniground_types::instances::{InstanceView, Levels};
use uniground_types::many::{ManyAnswers, ManyGroundRequest, SceneAnswer};
use uniground_types::placement::{FrameChoice, InFrame, Observer};
use uniground_types::question::GroundRequest;
use uniground_types::scene::{InstanceId, Level, Structure, Support};
use uniground_types::scenes::{Scene, SceneStatus};
use utoipa::ToSchema;

#[derive(Debug, Deserialize, ToSchema)]
#[serde(deny_unknown_fields)]
pub(super) struct ListScenes {
    /// Part of a name, in any case; left out, all.
    pub name: Option<String>,
    /// `next_cursor` of the page before.
    pub cursor: Option<String>,
}

/// A scan that was uploaded.
#[derive(Debug, Serialize, ToSchema)]
pub(super) struct SceneBrief {
    pub scene_id: String,
    pub name: String,
    /// Questions are answered where `ready`.
    pub status: SceneStatus,
    /// Instances found, floor, walls and ceiling included; `null` before the first parse.
    pub instances: Option<u32>,
    /// Box of everything, metres, Z up; `null` before the first parse.
    pub extent: Option<Aabb>,
    /// What the map is called that the scene lies in; `null` where nobody has said.
    pub map_frame_id: Option<String>,
    /// What it is filed under, such as a building and a floor.
    pub labels: BTreeMap<String, String>,
    pub created_at: String,
}

#[derive(Debug, Serialize, ToSchema)]
pub(super) struct SceneBriefs {
    /// Newest first.
    pub scenes: Vec<SceneBrief>,
    /// Pass as `cursor` for the next page; `null` on the last.
    pub next_cursor: Option<String>,
}

impl From<Scene> for SceneBrief {
    fn from(scene: Scene) -> Self {
        let Scene { id, name, status, counts, extent, map_frame_id, labels, created_at, .. } =
            scene;
        let instances = counts.map(|counts| counts.instances);
        Self { scene_id: id, name, status, instances, extent, map_frame_id, labels, created_at }
    }
}

#[derive(Debug, Deserialize, ToSchema)]
#[serde(deny_unknown_fields)]
pub(super) struct Ground {
    /// Of `list_scenes`.
    pub scene_id: String,
    /// What to find, in plain English: "the black chair closest to the door", "all the mugs".
    #[schema(min_length = 1, max_length = 1000)]
    pub query: String,
    /// Who asks, where "left", "in front of me" and the like are theirs.
    pub observer: Option<Observer>,
    /// Whose coordinates `observer` and `in_frame` are in.
    #[serde(default)]
    pub frame: FrameChoice,
}

impl Ground {
    pub fn request(self) -> (String, GroundRequest) {
        let Self { scene_id, query, observer, frame } = self;
        (scene_id, GroundRequest { observer, frame, ..GroundRequest::new(query) })
    }
}

/// What a question comes to.
#[derive(Debug, Serialize, ToSchema)]
pub(super) struct Grounded {
    /// `grounded`: `targets` has it. `uncertain`: likely, not surely. `ambiguous`: one of
    /// `alternatives`. `no_match`: nothing fits.
    pub status: Status,
    /// Why nothing was chosen; `null` unless `no_match`.
    pub no_match_reason: Option<NoMatchReason>,
    /// Why, in words.
    pub explanation: String,
    /// Belief in the answer, `0..=1`.
    pub confidence: f32,
    /// What is meant, best first, with boxes in metres, Z up.
    pub targets: Vec<Target>,
    /// How many there are, where the question asks for several.
    pub count: Option<u32>,
    /// What else may be meant, likeliest first.
    pub alternatives: Vec<Alternative>,
    /// Where a model sees what is asked for, though it is no instance.
    pub seen: Option<Seen>,
    /// Words of the question that could not be used.
    pub not_understood: Vec<String>,
    /// The boxes of `targets` in the coordinates that were asked for.
    pub in_frame: Option<InFrame>,
    /// For `render_view`.
    pub answer_id: String,
}

impl From<Answer> for Grounded {
    fn from(answer: Answer) -> Self {
        let Answer {
            id,
            status,
            no_match_reason,
            seen,
            answer,
            confidence,
            alternatives,
            targets,
            count,
            parsed_query,
            in_frame,
            ..
        } = answer;
        Self {
            status,
            no_match_reason,
            explanation: answer.explanation,
            confidence,
            targets,
            count,
            alternatives,
            seen,
            not_understood: parsed_query.not_understood,
            in_frame,
            answer_id: id,
        }
    }
}

#[derive(Debug, Deserialize, ToSchema)]
#[serde(deny_unknown_fields)]
pub(super) struct FindInScenes {
    /// What to find, in plain English: "the red mug".
    #[schema(min_length = 1, max_length = 1000)]
    pub query: String,
    /// Look only in scenes with all of these labels; left out, in all.
    #[serde(default)]
    pub labels: BTreeMap<String, String>,
}

impl FindInScenes {
    pub fn request(self) -> ManyGroundRequest {
        let Self { query, labels } = self;
        ManyGroundRequest { labels, ..ManyGroundRequest::new(query) }
    }
}

/// What one of many scenes answers.
#[derive(Debug, Serialize, ToSchema)]
pub(super) struct FoundBrief {
    pub scene_id: String,
    pub scene_name: String,
    /// `grounded`: `targets` has it. `uncertain`: likely, not surely. `ambiguous`: several there
    /// fit alike. `no_match`: nothing there fits.
    pub status: Status,
    /// Belief in that, `0..=1`.
    pub confidence: f32,
    /// Why, in words.
    pub explanation: String,
    /// What is meant, best first, with boxes in metres, Z up.
    pub targets: Vec<Target>,
}

#[derive(Debug, Serialize, ToSchema)]
pub(super) struct FoundBriefs {
    /// The scenes that most likely have it, best first.
    pub found: Vec<FoundBrief>,
    /// How many scenes were looked into.
    pub looked_into: u32,
    /// How many could not be.
    pub not_asked: u32,
}

impl From<ManyAnswers> for FoundBriefs {
    fn from(answers: ManyAnswers) -> Self {
        let brief = |SceneAnswer { scene_name, answer, .. }| {
            let Answer { scene_id, status, confidence, answer, targets, .. } = answer;
            FoundBrief {
                scene_id,
                scene_name,
                status,
                confidence,
                explanation: answer.explanation,
                targets,
            }
        };
        let ManyAnswers { looked_into, answers, not_asked, .. } = answers;
        Self {
            found: answers.into_iter().map(brief).collect(),
            looked_into,
            not_asked: not_asked.len() as u32,
        }
    }
}

#[derive(Debug, Deserialize, ToSchema)]
#[serde(deny_unknown_fields)]
pub(super) struct ListObjects {
    /// Of `list_scenes`.
    pub scene_id: String,
    /// Part of a name, in any case; left out, all.
    pub name: Option<String>,
    /// Things alone, their parts, wholes of several, or all of them.
    #[serde(default)]
    pub level: Levels,
    /// `next_cursor` of the page before.
    #[serde(default)]
    pub cursor: u32,
}

/// A thing in a scene.
#[derive(Debug, Serialize, ToSchema)]
pub(super) struct ObjectBrief {
    pub instance_id: InstanceId,
    pub name: String,
    pub level: Level,
    /// Set for parts of the building.
    pub structure: Option<Structure>,
    /// Axis-aligned box, metres, Z up.
    #[serde(rename = "box")]
    pub aabb: Aabb,
    /// What it stands on or hangs on.
    pub support: Support,
}

#[derive(Debug, Serialize, ToSchema)]
pub(super) struct ObjectBriefs {
    /// In order of id, the largest first.
    pub objects: Vec<ObjectBrief>,
    /// Pass as `cursor` for the next page; `null` on the last.
    pub next_cursor: Option<u32>,
}

impl From<InstanceView> for ObjectBrief {
    fn from(view: InstanceView) -> Self {
        let InstanceView {
            id, label, level, structure, aabb, support, model_name, given_name, ..
        } = view;
        Self {
            instance_id: id,
            name: given_name.or(model_name).unwrap_or(label),
            level,
            structure,
            aabb,
            support,
        }
    }
}

#[derive(Debug, Deserialize, ToSchema)]
#[serde(deny_unknown_fields)]
pub(super) struct OneObject {
    /// Of `list_scenes`.
    pub scene_id: String,
    /// Of `ground` or `list_objects`.
    #[schema(minimum = 1)]
    pub instance_id: u32,
}

#[derive(Debug, Deserialize, ToSchema)]
#[serde(deny_unknown_fields)]
pub(super) struct Relations {
    /// Of `list_scenes`.
    pub scene_id: String,
    /// Of `ground` or `list_objects`: it and what it stands in a relation to, alone. Left out, the
    /// whole scene.
    #[schema(minimum = 1)]
    pub instance_id: Option<u32>,
}

#[derive(Debug, Deserialize, ToSchema)]
#[serde(deny_unknown_fields)]
pub(super) struct Approach {
    /// Of `list_scenes`.
    pub scene_id: String,
    /// Of `ground` or `list_objects`; one of this and `query`.
    #[schema(minimum = 1)]
    pub instance_id: Option<u32>,
    /// What to find, in plain English.
    #[schema(min_length = 1, max_length = 1000)]
    pub query: Option<String>,
    pub robot: Robot,
    /// Where the robot is: then each pose has its path.
    pub from: Option<FloorPoint>,
    /// Whose coordinates `from` and `in_frame` are in.
    #[serde(default)]
    pub frame: FrameChoice,
}

impl Approach {
    pub fn request(self) -> (String, ApproachRequest) {
        let Self { scene_id, instance_id, query, robot, from, frame } = self;
        let any = ApproachRequest::for_instance(InstanceId(0), robot);
        (
            scene_id,
            ApproachRequest { instance_id: instance_id.map(InstanceId), query, from, frame, ..any },
        )
    }
}

#[derive(Debug, Deserialize, ToSchema)]
#[serde(deny_unknown_fields)]
pub(super) struct RenderView {
    /// Of `list_scenes`.
    pub scene_id: String,
    /// Instances to mark, at most 20; in a photograph the first is shown. Left out, the room
    /// alone.
    #[serde(default)]
    #[schema(max_items = 20)]
    pub instance_ids: Vec<u32>,
    /// The room from above, or the photograph that shows an instance best.
    #[serde(default)]
    pub view: ViewKind,
}

/// Instances that are marked in one picture.
pub(super) const MOST_MARKED: usize = 20;

#[derive(Debug, Clone, Copy, Default, Deserialize, ToSchema)]
#[serde(rename_all = "snake_case")]
pub(super) enum ViewKind {
    /// The room from the south, well above: left is -X, the far wall +Y.
    #[default]
    Room,
    /// A photograph of the scan with the instance outlined.
    Photograph,
}
