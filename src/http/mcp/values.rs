//! Arguments and results of the tools. Shorter than those of the API, because language models read
//! every word.

use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use uniground_types::answer::{
    Alternative, Answer, AnswerKind, AnswerValue, NoMatchReason, Seen, Status, Target,
};
use uniground_types::approach::{ApproachRequest, FloorPoint, Robot};
use uniground_types::coverage::Coverage;
use uniground_types::geometry::boxes::Aabb;
use uniground_types::instances::{InstanceView, Levels};
use uniground_types::many::{ManyAnswers, ManyGroundRequest, SceneAnswer};
use uniground_types::placement::{FrameChoice, InFrame, Observer};
use uniground_types::question::{GroundRequest, QuestionContext, Region};
use uniground_types::scene::{InstanceId, Level, Structure, Support};
use uniground_types::scenes::{Scene, SceneStatus};
use utoipa::ToSchema;

#[derive(Debug, Deserialize, ToSchema)]
#[serde(deny_unknown_fields)]
pub(super) struct ListScenes {
    /// Part of a name, case-insensitive. If omitted, all scenes.
    pub name: Option<String>,
    /// `next_cursor` of the previous page.
    pub cursor: Option<String>,
}

/// An uploaded scan.
#[derive(Debug, Serialize, ToSchema)]
pub(super) struct SceneBrief {
    pub scene_id: String,
    pub name: String,
    /// Status of the scene. Questions require `ready`.
    pub status: SceneStatus,
    /// Number of instances, including floor, walls and ceiling. `null` before the first parse.
    pub instances: Option<u32>,
    /// Box of all points; meters, Z up. `null` before the first parse.
    pub extent: Option<Aabb>,
    /// Name of the scene's map frame. `null` if not set.
    pub map_frame_id: Option<String>,
    /// Labels, such as a building and a floor.
    pub labels: BTreeMap<String, String>,
    pub created_at: String,
}

#[derive(Debug, Serialize, ToSchema)]
pub(super) struct SceneBriefs {
    /// Scenes, newest first.
    pub scenes: Vec<SceneBrief>,
    /// Cursor of the next page. `null` on the last page.
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
    /// Scene id from `list_scenes`.
    pub scene_id: String,
    /// Question in English: "the black chair closest to the door", "what is on the desk", "how far
    /// is the stool from the door", "is there a piano".
    #[schema(min_length = 1, max_length = 1000)]
    pub query: String,
    /// Observer for phrases like "left" and "in front of me".
    pub observer: Option<Observer>,
    /// Frame of `observer`, `within` and `in_frame`.
    #[serde(default)]
    pub frame: FrameChoice,
    /// Context of a follow-up question: the `answer_id` of an earlier answer or a `session` of your
    /// choice for "it" and "one", or the instance that "this" means.
    pub context: Option<QuestionContext>,
    /// Region in which the object has to be.
    pub within: Option<Region>,
}

impl Ground {
    pub fn into_request(self) -> (String, GroundRequest) {
        let Self { scene_id, query, observer, frame, context, within } = self;
        let request =
            GroundRequest { observer, frame, context, within, ..GroundRequest::new(query) };
        (scene_id, request)
    }
}

/// Answer to a question.
#[derive(Debug, Serialize, ToSchema)]
pub(super) struct Grounded {
    /// The answer as a sentence.
    pub text: String,
    /// What kind of answer it is.
    pub kind: AnswerKind,
    /// The number, the measurement, or yes or no.
    pub value: Option<AnswerValue>,
    /// Status. `grounded`: `targets` contains the object. `uncertain`: a likely guess. `ambiguous`:
    /// one of `alternatives`. `no_match`: no object fits.
    pub status: Status,
    /// Why no object was chosen. `null` unless `no_match`.
    pub no_match_reason: Option<NoMatchReason>,
    /// Which part of the room was seen: whether the object is not there, or may be where no camera
    /// looked. `null` unless `no_match`, and if it is not known.
    pub coverage: Option<Coverage>,
    /// Explanation of the decision.
    pub explanation: String,
    /// Confidence in the answer, `0..=1`.
    pub confidence: f32,
    /// The objects that the question refers to, best first, with boxes in meters, Z up.
    pub targets: Vec<Target>,
    /// Number of matching objects, if the question asks for several.
    pub count: Option<u32>,
    /// Other objects that the question may refer to, most likely first.
    pub alternatives: Vec<Alternative>,
    /// Location where a model sees an object that is not an instance.
    pub seen: Option<Seen>,
    /// How the object differs from the question: "it is black, not white". The answer is then the
    /// closest object. `null` if nothing differs.
    pub differs: Option<String>,
    /// Words that were ignored because they were not understood.
    pub not_understood: Vec<String>,
    /// Boxes of `targets` in the requested frame.
    pub in_frame: Option<InFrame>,
    /// Answer id, for `render_view`.
    pub answer_id: String,
}

impl From<Answer> for Grounded {
    fn from(answer: Answer) -> Self {
        let Answer {
            id,
            text,
            kind,
            value,
            status,
            no_match_reason,
            coverage,
            seen,
            differs,
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
            text,
            kind,
            value,
            status,
            no_match_reason,
            coverage,
            explanation: answer.explanation,
            confidence,
            targets,
            count,
            alternatives,
            seen,
            differs,
            not_understood: parsed_query.not_understood,
            in_frame,
            answer_id: id,
        }
    }
}

#[derive(Debug, Deserialize, ToSchema)]
#[serde(deny_unknown_fields)]
pub(super) struct FindInScenes {
    /// Description of the object in English: "the red mug".
    #[schema(min_length = 1, max_length = 1000)]
    pub query: String,
    /// Search only scenes with all of these labels. If omitted, all scenes.
    #[serde(default)]
    pub labels: BTreeMap<String, String>,
}

impl FindInScenes {
    pub fn into_request(self) -> ManyGroundRequest {
        let Self { query, labels } = self;
        ManyGroundRequest { labels, ..ManyGroundRequest::new(query) }
    }
}

/// Answer for one scene.
#[derive(Debug, Serialize, ToSchema)]
pub(super) struct FoundBrief {
    pub scene_id: String,
    pub scene_name: String,
    /// Status. `grounded`: `targets` contains the object. `uncertain`: a likely guess. `ambiguous`:
    /// several objects fit equally well. `no_match`: no object fits.
    pub status: Status,
    /// Confidence in the answer, `0..=1`.
    pub confidence: f32,
    /// Explanation of the decision.
    pub explanation: String,
    /// The objects that the question refers to, best first, with boxes in meters, Z up.
    pub targets: Vec<Target>,
}

#[derive(Debug, Serialize, ToSchema)]
pub(super) struct FoundBriefs {
    /// The most likely scenes, best first.
    pub found: Vec<FoundBrief>,
    /// Number of searched scenes.
    pub looked_into: u32,
    /// Number of scenes that could not be searched.
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
    /// Scene id from `list_scenes`.
    pub scene_id: String,
    /// Part of a name, case-insensitive. If omitted, all objects.
    pub name: Option<String>,
    /// Levels to list: objects (default), parts, wholes, or all.
    #[serde(default)]
    pub level: Levels,
    /// `next_cursor` of the previous page.
    #[serde(default)]
    pub cursor: u32,
}

/// An object in a scene.
#[derive(Debug, Serialize, ToSchema)]
pub(super) struct ObjectBrief {
    pub instance_id: InstanceId,
    pub name: String,
    pub level: Level,
    /// Set for building elements: floor, wall or ceiling.
    pub structure: Option<Structure>,
    /// Axis-aligned box; meters, Z up.
    #[serde(rename = "box")]
    pub aabb: Aabb,
    /// What the object stands on or hangs on.
    pub support: Support,
}

#[derive(Debug, Serialize, ToSchema)]
pub(super) struct ObjectBriefs {
    /// Objects ordered by id, the largest first.
    pub objects: Vec<ObjectBrief>,
    /// Cursor of the next page. `null` on the last page.
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
    /// Scene id from `list_scenes`.
    pub scene_id: String,
    /// Instance id from `ground` or `list_objects`.
    #[schema(minimum = 1)]
    pub instance_id: u32,
}

#[derive(Debug, Deserialize, ToSchema)]
#[serde(deny_unknown_fields)]
pub(super) struct Relations {
    /// Scene id from `list_scenes`.
    pub scene_id: String,
    /// Instance id from `ground` or `list_objects`. Limits the graph to this object and its
    /// relations. If omitted, the whole scene.
    #[schema(minimum = 1)]
    pub instance_id: Option<u32>,
}

#[derive(Debug, Deserialize, ToSchema)]
#[serde(deny_unknown_fields)]
pub(super) struct Approach {
    /// Scene id from `list_scenes`.
    pub scene_id: String,
    /// Instance id from `ground` or `list_objects`. Exactly one of this, `query` and
    /// `unseen_region` is required.
    #[schema(minimum = 1)]
    pub instance_id: Option<u32>,
    /// Description of the object in English.
    #[schema(min_length = 1, max_length = 1000)]
    pub query: Option<String>,
    /// Number of an unseen part of the room from `coverage` of an answer of `ground`. Poses look at
    /// it.
    #[schema(minimum = 1)]
    pub unseen_region: Option<u32>,
    pub robot: Robot,
    /// Start position of the robot. If set, each pose has a path.
    pub from: Option<FloorPoint>,
    /// Frame of `from` and `in_frame`.
    #[serde(default)]
    pub frame: FrameChoice,
}

impl Approach {
    pub fn into_request(self) -> (String, ApproachRequest) {
        let Self { scene_id, instance_id, query, unseen_region, robot, from, frame } = self;
        let any = ApproachRequest::for_instance(InstanceId(0), robot);
        (
            scene_id,
            ApproachRequest {
                instance_id: instance_id.map(InstanceId),
                query,
                unseen_region,
                from,
                frame,
                ..any
            },
        )
    }
}

#[derive(Debug, Deserialize, ToSchema)]
#[serde(deny_unknown_fields)]
pub(super) struct RenderView {
    /// Scene id from `list_scenes`.
    pub scene_id: String,
    /// Ids of the instances to mark, at most 20. A photograph shows the first. If omitted, only the
    /// room is drawn.
    #[serde(default)]
    #[schema(max_items = 20)]
    pub instance_ids: Vec<u32>,
    /// View: the room from above, or the photograph with the best view of an instance.
    #[serde(default)]
    pub view: ViewKind,
}

/// Maximum number of marked instances in one picture.
pub(super) const MAX_MARKED: usize = 20;

#[derive(Debug, Clone, Copy, Default, Deserialize, ToSchema)]
#[serde(rename_all = "snake_case")]
pub(super) enum ViewKind {
    /// The room from above, seen from the south: left is -X, the far wall is at +Y.
    #[default]
    Room,
    /// A photograph of the scan with the object outlined.
    Photograph,
}
