//! Tests of the whole pipeline over a few instances in memory, with a scripted model.

use super::*;
use crate::Status;
use crate::found_anchors::SURE_IF_CONFIRMED;
use crate::memory_scene::{MemoryScene, SceneAlbum};
use camino::Utf8Path;
use futures::FutureExt;
use futures::executor::block_on;
use futures::future::BoxFuture;
use image::RgbImage;
use std::sync::Mutex;
use uniground_geometry::boxes::Aabb;
use uniground_geometry::scene::{
    FrameEmbeddings, FrameIndex, FrameRef, Instance, InstanceId, Intrinsics, PointCloud, Support,
};
use uniground_geometry::{Isometry3, Point3, Vector3};
use uniground_language::{AutoParser, VlmParser};
use uniground_models::chat::{ChatError, ChatFailure, ChatReply, ChatRequest, Part, Prices};
use uniground_parsing::pointed::PixelArea;
use uniground_render::RenderScene;
use uniground_testing::thing;
use uniground_testing::tiny_encoder;

/// A model that replies in order and repeats the last reply; `None`: the call fails.
struct Scripted {
    replies: Mutex<Vec<Option<&'static str>>>,
    asked: Mutex<u32>,
    /// Names of the pictures of every call.
    shown: Mutex<Vec<String>>,
}

impl Scripted {
    fn new(replies: &[Option<&'static str>]) -> Arc<Self> {
        Arc::new(Self {
            replies: Mutex::new(replies.to_vec()),
            asked: Mutex::new(0),
            shown: Mutex::default(),
        })
    }

    fn asked(&self) -> u32 {
        *self.asked.lock().unwrap()
    }
}

impl ChatModel for Scripted {
    fn name(&self) -> &'static str {
        "scripted"
    }

    fn prices(&self) -> Prices {
        Prices::default()
    }

    fn ask<'a>(
        &'a self,
        request: &'a ChatRequest,
    ) -> BoxFuture<'a, Result<ChatReply, ChatFailure>> {
        async move {
            *self.asked.lock().unwrap() += 1;
            self.shown.lock().unwrap().extend(request.user.iter().filter_map(|part| match part {
                Part::Picture(picture) => Some(picture.name.clone()),
                Part::Text(_) => None,
            }));
            let mut replies = self.replies.lock().unwrap();
            let reply = if replies.len() > 1 { replies.remove(0) } else { replies[0] };
            let down = || ChatFailure {
                error: ChatError::Transport("down".into()),
                attempts: 1,
                lost: 0,
                latency_ms: 0.0,
            };
            let said = |text: &str| ChatReply {
                text: text.into(),
                prompt_tokens: 1,
                completion_tokens: 1,
                attempts: 1,
                lost: 0,
                latency_ms: 0.0,
            };
            reply.map(said).ok_or_else(down)
        }
        .boxed()
    }
}

/// Returns a room with two red chairs, one of them by the table.
fn room() -> Arc<MemoryScene> {
    let extent = Aabb::from_corners(Point3::new(-1.0, -1.0, 0.0), Point3::new(5.0, 3.0, 2.5));
    Arc::new(SceneAlbum::new(
        extent,
        RenderScene::new(PointCloud::default()),
        None,
        "attributes".into(),
        Vec::new(),
    ))
    .scene(things().into())
}

fn things() -> Vec<Instance> {
    vec![
        thing(1, [0.0, 0.0], [1.4, 0.8, 0.75], 0.0, Support::Floor, [120, 80, 40]),
        thing(2, [1.2, 0.0], [0.45, 0.45, 0.9], 0.0, Support::Floor, [200, 30, 30]),
        thing(3, [4.0, 2.0], [0.45, 0.45, 0.9], 0.0, Support::Floor, [200, 30, 30]),
    ]
}

const QUERY: &str = "the red chair next to the table";
const CHOOSES_THREE: &str = "Predicted ID: 3\nExplanation: it is red\nCandidate Names: 2 -> red chair, 3 -> red chair\nTarget name matches?: true\n\
                             Anchor ID: 1\nRelation used: next to";

fn asked_of(model: &Arc<Scripted>, without_model: WithoutModel) -> Ask {
    let review = Review {
        model: model.clone(),
        budgets: Vec::new(),
        options: Options::default(),
        without_model,
    };
    Ask { review: Some(review), ..Ask::of(Question::of(QUERY)) }
}

#[test]
fn grammar_and_geometry_answer_without_a_review_model() {
    let answered = block_on(answer(&room(), Ask::of(Question::of(QUERY)))).unwrap();
    assert_eq!(
        (answered.grounding.status, answered.grounding.answer.predicted_id),
        (Status::Grounded, Some(InstanceId(2)))
    );
    assert!(!answered.degraded && answered.calls.is_empty() && answered.reasoner == builtin::NAME);
}

#[test]
fn model_decision_overrides_the_geometry() {
    let model = Scripted::new(&[Some(CHOOSES_THREE)]);
    let answered = block_on(answer(&room(), asked_of(&model, WithoutModel::Fail))).unwrap();
    assert_eq!(answered.grounding.answer.predicted_id, Some(InstanceId(3)));
    assert!(answered.reasoner.starts_with("scripted") && !answered.degraded, "{answered:?}");
}

/// Parsing the question counts as a call: parsing with the model and getting only unusable replies
/// afterwards makes three calls, not four.
#[test]
fn at_most_three_calls_are_made_including_parsing() {
    for (with_parser, replies) in [
        (true, [Some("no JSON"), Some("hm"), Some("hm")]),
        (false, [Some("hm"), Some("hm"), Some("hm")]),
    ] {
        let model = Scripted::new(&replies);
        let mut ask = asked_of(&model, WithoutModel::BuiltIn);
        if with_parser {
            ask.parser = Arc::new(VlmParser { model: model.clone(), budgets: Vec::new() });
        }
        let answered = block_on(answer(&room(), ask)).unwrap();
        assert_eq!(
            (model.asked(), answered.calls.len()),
            (MAX_CALLS, MAX_CALLS as usize),
            "{:?}",
            answered.corrections
        );
        // The geometry's result stands.
        assert_eq!(
            (answered.grounding.answer.predicted_id, answered.degraded),
            (Some(InstanceId(2)), true)
        );
    }
}

#[test]
fn unavailable_model_falls_back_or_fails_as_configured() {
    let model = Scripted::new(&[None]);
    let answered = block_on(answer(&room(), asked_of(&model, WithoutModel::BuiltIn))).unwrap();
    assert_eq!(
        (answered.grounding.answer.predicted_id, answered.degraded),
        (Some(InstanceId(2)), true)
    );
    assert!(
        answered.corrections[0].contains("the built-in reasoner was used"),
        "{:?}",
        answered.corrections
    );
    let failed = block_on(answer(&room(), asked_of(&model, WithoutModel::Fail)));
    assert!(matches!(failed, Err(QuestionError::Review(_))), "{failed:?}");
    let parser = Arc::new(VlmParser { model: model.clone(), budgets: Vec::new() });
    let unread = Ask { parser, without_parser: WithoutModel::Fail, ..Ask::of(Question::of(QUERY)) };
    assert!(matches!(block_on(answer(&room(), unread)), Err(QuestionError::Unread(_))));
    // The reply is unusable, but the model was asked: the grammar parses.
    let model = Scripted::new(&[Some("no JSON")]);
    let parser = Arc::new(VlmParser { model, budgets: Vec::new() });
    let misread =
        Ask { parser, without_parser: WithoutModel::Fail, ..Ask::of(Question::of(QUERY)) };
    assert!(block_on(answer(&room(), misread)).unwrap().degraded);
}

const READS_A_CHAIR: &str = r#"{"target": {"noun": "chair", "relations": [{"kind": "near", "words": "by", "anchors": [{"noun": "table"}]}]}}"#;

/// The grammar does not know "perched", so the automatic parser asks the model.
#[test]
fn model_parses_questions_that_the_grammar_doubts() {
    let asked = |query: &str, replies: &[Option<&'static str>], without_parser| {
        let model = Scripted::new(replies);
        let parser = Arc::new(AutoParser(VlmParser { model: model.clone(), budgets: Vec::new() }));
        let ask = Ask { parser, without_parser, ..Ask::of(Question::of(query)) };
        (block_on(answer(&room(), ask)), model.asked())
    };
    let (plain, calls) = asked(QUERY, &[None], WithoutModel::Fail);
    assert_eq!((plain.unwrap().parser, calls), ("builtin-3".to_owned(), 0));

    let doubtful = "the chair perched by the table";
    let (read, calls) = asked(doubtful, &[Some(READS_A_CHAIR)], WithoutModel::BuiltIn);
    let read = read.unwrap();
    assert!(
        calls == 1 && read.parser.starts_with("scripted") && read.parsed.not_understood.is_empty(),
        "{read:?}"
    );
    assert!(read.corrections.is_empty() && !read.degraded, "{read:?}");

    // No model was required: the grammar's reading stands, and the answer reports it.
    for reply in [None, Some("no JSON")] {
        let (stood, calls) = asked(doubtful, &[reply], WithoutModel::BuiltIn);
        let stood = stood.unwrap();
        assert!(calls == 1 && stood.parser == "builtin-3" && !stood.degraded, "{stood:?}");
        assert!(
            stood.corrections.len() == 1
                && stood.corrections[0].contains("not understood: perched"),
            "{stood:?}"
        );
    }
    // The grammar, not the model, decides how many objects the question asks for.
    let (counted, _) = asked(
        "how many chairs are perched by the table",
        &[Some(READS_A_CHAIR)],
        WithoutModel::BuiltIn,
    );
    assert_eq!(counted.unwrap().grounding.count, Some(1));
    // An evaluation must see the failure.
    let (failed, _) = asked(doubtful, &[None], WithoutModel::Fail);
    assert!(matches!(failed, Err(QuestionError::Unread(_))), "{failed:?}");
}

/// Returns the room with a photograph that an encoder embedded, but no embedded instances.
fn photographed(folder: &Utf8Path) -> Arc<MemoryScene> {
    let color = folder.join("0.png");
    RgbImage::from_pixel(1600, 1200, image::Rgb([10, 200, 30])).save(&color).unwrap();
    let intrinsics =
        Intrinsics { width: 1600, height: 1200, fx: 800.0, fy: 800.0, cx: 800.0, cy: 600.0 };
    let frame = FrameRef {
        index: FrameIndex(7),
        time_s: None,
        depth: color.clone(),
        color,
        color_intrinsics: intrinsics,
        depth_intrinsics: intrinsics,
        depth_scale_m: 0.001,
        camera_to_world: Isometry3::identity(),
        optics: uniground_geometry::scene::Optics::default(),
    };
    let (encoder, things) = (tiny_encoder(), things());
    let dim = encoder.dim();
    let unseen = Embeddings::new(dim, &vec![0.0; dim * things.len()]);
    let mut of_frame = vec![0.0; dim];
    of_frame[0] = 1.0;
    let seen = Some((encoder, unseen));
    let extent = Aabb::from_corners(Point3::new(-1.0, -1.0, 0.0), Point3::new(5.0, 3.0, 2.5));
    let album = SceneAlbum::new(
        extent,
        RenderScene::new(PointCloud::default()),
        seen,
        "tiny".into(),
        vec![frame],
    );
    Arc::new(album.with_frame_embeddings(Some(FrameEmbeddings::new(
        dim,
        vec![FrameIndex(7)],
        &of_frame,
    ))))
    .scene(things.into())
}

#[test]
fn photographs_are_offered_when_no_candidate_fits_and_not_listed_is_allowed() {
    let folder = tempfile::tempdir().unwrap();
    let scene = photographed(Utf8Path::from_path(folder.path()).unwrap());
    let shown = |query: &str, options: Options| {
        let model = Scripted::new(&[Some("Predicted ID: none\nExplanation: there is none")]);
        let review = Review {
            model: model.clone(),
            budgets: Vec::new(),
            options,
            without_model: WithoutModel::Fail,
        };
        block_on(answer(&scene, Ask { review: Some(review), ..Ask::of(Question::of(query)) }))
            .unwrap();
        let shown = model.shown.lock().unwrap();
        shown.iter().filter(|name| name.starts_with("photograph-")).count()
    };
    assert_eq!(shown("the accordion", Options::default()), 1, "no candidate fits");
    assert_eq!(shown("the red chair", Options::default()), 0, "two candidates fit");
    assert_eq!(
        shown("the accordion", Options { prompt: PromptVersion::Paper, ..Options::default() }),
        0
    );
    assert_eq!(
        shown(
            "the accordion",
            Options { ablation: vlm::Ablation::SimplePrompt, ..Options::default() }
        ),
        0
    );
}

/// Returns an album of the room with points on its things, and photographs of it from above, all
/// from one place.
fn album_from_above(folder: &Utf8Path, frames: u32) -> Arc<SceneAlbum> {
    let color = folder.join("0.png");
    RgbImage::from_pixel(640, 480, image::Rgb([90, 90, 90])).save(&color).unwrap();
    let intrinsics =
        Intrinsics { width: 640, height: 480, fx: 400.0, fy: 400.0, cx: 320.0, cy: 240.0 };
    let frame = |number: u32| FrameRef {
        index: FrameIndex(4 * number),
        time_s: None,
        depth: color.clone(),
        color: color.clone(),
        color_intrinsics: intrinsics,
        depth_intrinsics: intrinsics,
        depth_scale_m: 0.001,
        camera_to_world: Isometry3::new(
            Vector3::new(2.0, 1.0, 5.0),
            Vector3::x() * std::f32::consts::PI,
        ),
        optics: uniground_geometry::scene::Optics::default(),
    };
    let mut cloud = PointCloud::default();
    for top in things().iter().map(|thing| thing.aabb) {
        for (i, j) in (0..=30).flat_map(|i| (0..=30).map(move |j| (i, j))) {
            let at = |i: i32, size: f32| (i as f32 / 30.0 - 0.5) * size;
            let above = Vector3::new(at(i, top.size.x), at(j, top.size.y), top.size.z / 2.0);
            cloud.positions.push(top.center + above);
            cloud.colors.push([200; 3]);
        }
    }
    let extent = Aabb::from_corners(Point3::new(-1.0, -1.0, 0.0), Point3::new(5.0, 3.0, 2.5));
    let frames = (1..=frames).map(frame).collect();
    let album = SceneAlbum::new(extent, RenderScene::new(cloud), None, "attributes".into(), frames);
    Arc::new(album)
}

#[test]
fn cached_frame_contents_follow_dismissals() {
    let folder = tempfile::tempdir().unwrap();
    let album = album_from_above(Utf8Path::from_path(folder.path()).unwrap(), 1);
    let seen_without = |dismissed: u32| {
        let mut instances = things();
        instances[dismissed as usize - 1].dismissed = true;
        let contents = album.scene(instances.into()).frame_contents().unwrap();
        let [frame] = &contents.frames[..] else { panic!("{contents:?}") };
        frame.instances.iter().map(|seen| seen.id.0).collect::<Vec<_>>()
    };
    assert_eq!((seen_without(2), seen_without(3)), (vec![1, 3], vec![1, 2]));
}

/// Asks with photographs first. Returns the answer, and the names of the pictures that were shown.
fn asked_with_photographs(
    scene: &Arc<MemoryScene>,
    query: &str,
    replies: &[Option<&'static str>],
) -> (Answered, Vec<String>) {
    let model = Scripted::new(replies);
    let review = Review {
        model: model.clone(),
        budgets: Vec::new(),
        options: Options { evidence: EvidenceMode::Photographs, ..Options::default() },
        without_model: WithoutModel::BuiltIn,
    };
    let ask = Ask { review: Some(review), ..Ask::of(Question::of(query)) };
    let answered = block_on(answer(scene, ask)).unwrap();
    let shown = model.shown.lock().unwrap().clone();
    (answered, shown)
}

#[test]
fn what_is_in_no_photograph_is_looked_for_in_the_others() {
    let folder = tempfile::tempdir().unwrap();
    let album = album_from_above(Utf8Path::from_path(folder.path()).unwrap(), 2);
    let scene = album.scene(things().into());
    let nothing = Some("Could be: none\nAnchors: 1 -> table\nSeen at: none");
    let found = Some("Could be: 3\nAnchors: none\nSeen at: none");
    let (answered, shown) =
        asked_with_photographs(&scene, QUERY, &[nothing, found, Some(CHOOSES_THREE)]);
    assert_eq!(answered.grounding.answer.predicted_id, Some(InstanceId(3)));
    assert_eq!(shown[..2], ["marked-1", "further-1"]);
    assert!(shown.contains(&"candidate-3".to_owned()), "{shown:?}");
    let purposes: Vec<_> = answered.calls.iter().map(|call| call.purpose).collect();
    assert_eq!(purposes, ["find", "find", "spatial"]);
    // Nothing further is shown if the first ones show it.
    let (_, shown) = asked_with_photographs(&scene, QUERY, &[found, Some(CHOOSES_THREE)]);
    assert!(!shown.contains(&"further-1".to_owned()), "{shown:?}");
    // It is in none of the photographs.
    let none = Some("Predicted ID: none");
    let (answered, _) = asked_with_photographs(&scene, "the theremin", &[nothing, nothing, none]);
    assert_eq!((answered.grounding.status, answered.calls.len()), (Status::NoMatch, 3));
    // The second look fails.
    let (answered, shown) = asked_with_photographs(&scene, QUERY, &[nothing, None]);
    assert!(answered.degraded && shown.contains(&"marked-1".to_owned()), "{shown:?}");
}

#[test]
fn model_finds_candidates_and_anchors_in_marked_photographs() {
    let folder = tempfile::tempdir().unwrap();
    let album = album_from_above(Utf8Path::from_path(folder.path()).unwrap(), 1);
    let scene = album.scene(things().into());
    let asked = |query: &str, replies: &[_]| asked_with_photographs(&scene, query, replies);
    let nothing = "Could be: none\nAnchors: none\nSeen at: none";
    let found = "Could be: 3\nAnchors: 1\nSeen at: none";
    let (answered, shown) = asked(QUERY, &[Some(found), Some(CHOOSES_THREE)]);
    assert_eq!(answered.grounding.answer.predicted_id, Some(InstanceId(3)));
    assert_eq!(shown[0], "marked-1");
    assert!(shown.contains(&"candidate-3".to_owned()), "{shown:?}");
    assert!(shown.contains(&"candidate-2".to_owned()), "the geometry's best: {shown:?}");
    assert_eq!(answered.calls.len(), 2);
    assert!(answered.corrections.is_empty() && answered.grounding.confidence >= 0.7);

    // The geometry knows no such thing, and the model sees one, or none.
    let unknown = "the theremin";
    let (answered, shown) = asked(unknown, &[Some(found), Some(CHOOSES_THREE)]);
    assert_eq!(answered.grounding.answer.predicted_id, Some(InstanceId(3)), "{shown:?}");
    let (answered, _) = asked(unknown, &[Some(nothing), Some("Predicted ID: none")]);
    assert_eq!((answered.grounding.status, answered.calls.len()), (Status::NoMatch, 2));
    // Where the model finds nothing, the geometry's candidates are shown as ever.
    let (answered, shown) = asked(QUERY, &[Some(nothing), Some(CHOOSES_THREE)]);
    assert_eq!(answered.grounding.answer.predicted_id, Some(InstanceId(3)));
    assert!(shown.contains(&"candidate-2".to_owned()), "{shown:?}");
    // The model sees the geometry's choice and nothing else that may be meant.
    let plain = "the table";
    let by_geometry = block_on(answer(&scene, Ask::of(Question::of(plain)))).unwrap().grounding;
    let sure = SURE_IF_CONFIRMED..SURE_WITHOUT_LOOKING;
    assert!(sure.contains(&by_geometry.confidence), "{}", by_geometry.confidence);
    assert_eq!(by_geometry.answer.predicted_id, Some(InstanceId(1)));
    let (answered, shown) = asked(plain, &[Some("Could be: 1\nAnchors: none\nSeen at: none")]);
    assert_eq!(answered.grounding.answer.predicted_id, Some(InstanceId(1)));
    assert_eq!(shown, ["marked-1"]);
    assert!(answered.grounding.confidence > by_geometry.confidence && !answered.degraded);
    assert_eq!((answered.calls.len(), answered.left_out), (1, Some(LeftOut::default())));
    // Whether it exists, is where the question says, or has another color, takes a second look.
    for query in ["is there a table", "the table next to the chair", "the green table"] {
        let replies = [Some("Could be: 1\nAnchors: none\nSeen at: none"), Some("Predicted ID: 1")];
        assert_eq!(asked(query, &replies).0.calls.len(), 2, "{query}");
    }
    // An unavailable model.
    let (answered, _) = asked(QUERY, &[None]);
    assert_eq!(
        (answered.grounding.answer.predicted_id, answered.degraded),
        (Some(InstanceId(2)), true)
    );
    let (answered, _) = asked(unknown, &[None]);
    assert_eq!((answered.grounding.status, answered.degraded), (Status::NoMatch, true));
}

#[test]
fn position_in_an_offered_photograph_maps_to_its_frame() {
    let folder = tempfile::tempdir().unwrap();
    let scene = photographed(Utf8Path::from_path(folder.path()).unwrap());
    let context = scene_view(&*scene, None);
    let (_, context) = ground_with_context(
        context,
        &Question::of("the accordion"),
        parse("the accordion"),
        Duration::ZERO,
    );
    let photographs = vlm::select_photographs(&*scene, &context, Options::default()).unwrap();
    let offered = &photographs[0];
    assert_eq!(
        (offered.frame, offered.taken_px, offered.picture.width, offered.picture.height),
        (FrameIndex(7), (1600, 1200), 768, 576)
    );
    let seen = crate::Seen {
        picture: "photograph-1".into(),
        at: [0.25, 0.5],
        area: None,
        name: "accordion".into(),
    };
    let evidence = vlm::VisualEvidence { photographs, ..vlm::VisualEvidence::default() };
    let place =
        evidence.place(&*scene, &seen, &PictureSettings::of(Options::default())).unwrap().unwrap();
    assert_eq!((place.frame, place.at, place.area), (FrameIndex(7), (400.0, 600.0), None));
    let seen = crate::Seen { area: Some([0.25, 0.5, 0.5, 1.0]), ..seen };
    let place =
        evidence.place(&*scene, &seen, &PictureSettings::of(Options::default())).unwrap().unwrap();
    let area = PixelArea { left: 400.0, top: 600.0, right: 800.0, bottom: 1200.0 };
    assert_eq!(place.area, Some(area));
}
