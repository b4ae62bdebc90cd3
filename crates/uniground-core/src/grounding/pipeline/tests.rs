//! The pipeline from end to end over a few things in memory, with a model that says what it is told to.

use super::*;
use crate::geometry::Point3;
use crate::geometry::boxes::Aabb;
use crate::grounding::Status;
use crate::grounding::album::{Album, AlbumScene};
use crate::grounding::query::VlmParser;
use crate::models::attributes::tests::thing;
use crate::models::chat::{ChatError, ChatFailure, ChatReply, ChatRequest, Prices};
use crate::render::RenderScene;
use crate::scene::{InstanceId, PointCloud, Support};
use futures::FutureExt;
use futures::executor::block_on;
use futures::future::BoxFuture;
use std::sync::Mutex;

/// Answers in order, the last one for ever; `None`: it can not be asked.
struct Scripted {
    replies: Mutex<Vec<Option<&'static str>>>,
    asked: Mutex<u32>,
}

impl Scripted {
    fn new(replies: &[Option<&'static str>]) -> Arc<Self> {
        Arc::new(Self { replies: Mutex::new(replies.to_vec()), asked: Mutex::new(0) })
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

    fn ask<'a>(&'a self, _: &'a ChatRequest) -> BoxFuture<'a, Result<ChatReply, ChatFailure>> {
        async move {
            *self.asked.lock().unwrap() += 1;
            let mut replies = self.replies.lock().unwrap();
            let reply = if replies.len() > 1 { replies.remove(0) } else { replies[0] };
            let down = || ChatFailure { error: ChatError::Transport("down".into()), attempts: 1, lost: 0, latency_ms: 0.0 };
            let said =
                |text: &str| ChatReply { text: text.into(), prompt_tokens: 1, completion_tokens: 1, attempts: 1, lost: 0, latency_ms: 0.0 };
            reply.map(said).ok_or_else(down)
        }
        .boxed()
    }
}

/// Two red chairs of which one stands by the table.
fn room() -> Arc<AlbumScene> {
    let instances = vec![
        thing(1, [0.0, 0.0], [1.4, 0.8, 0.75], 0.0, Support::Floor, [120, 80, 40]),
        thing(2, [1.2, 0.0], [0.45, 0.45, 0.9], 0.0, Support::Floor, [200, 30, 30]),
        thing(3, [4.0, 2.0], [0.45, 0.45, 0.9], 0.0, Support::Floor, [200, 30, 30]),
    ];
    let extent = Aabb::from_corners(Point3::new(-1.0, -1.0, 0.0), Point3::new(5.0, 3.0, 2.5));
    Arc::new(Album::new(extent, RenderScene::of(PointCloud::default()), None, "attributes".into(), Vec::new())).scene(instances.into())
}

const QUERY: &str = "the red chair next to the table";
const CHOOSES_THREE: &str = "Predicted ID: 3\nExplanation: it is red\nCandidate Names: 2 -> red chair, 3 -> red chair\nTarget name matches?: true\n\
                             Anchor ID: 1\nRelation used: next to";

fn asked_of(model: &Arc<Scripted>, without_model: WithoutModel) -> Ask {
    let review = Review { model: model.clone(), budgets: Vec::new(), options: Options::default(), without_model };
    Ask { review: Some(review), ..Ask::of(Question::of(QUERY)) }
}

#[test]
fn grammar_and_geometry_answer_where_nobody_reviews() {
    let answered = block_on(answer(&room(), Ask::of(Question::of(QUERY)))).unwrap();
    assert_eq!((answered.grounding.status, answered.grounding.answer.predicted_id), (Status::Grounded, Some(InstanceId(2))));
    assert!(!answered.degraded && answered.calls.is_empty() && answered.reasoner == builtin::NAME);
}

#[test]
fn the_model_has_the_last_word() {
    let model = Scripted::new(&[Some(CHOOSES_THREE)]);
    let answered = block_on(answer(&room(), asked_of(&model, WithoutModel::Fail))).unwrap();
    assert_eq!(answered.grounding.answer.predicted_id, Some(InstanceId(3)));
    assert!(answered.reasoner.starts_with("scripted") && !answered.degraded, "{answered:?}");
}

/// Reading the question counts: whoever reads with the model and hears only nonsense afterwards has asked three times, not four.
#[test]
fn three_calls_are_made_at_most_reading_included() {
    for (with_parser, replies) in [(true, [Some("no JSON"), Some("hm"), Some("hm")]), (false, [Some("hm"), Some("hm"), Some("hm")])] {
        let model = Scripted::new(&replies);
        let mut ask = asked_of(&model, WithoutModel::BuiltIn);
        if with_parser {
            ask.parser = Arc::new(VlmParser { model: model.clone(), budgets: Vec::new() });
        }
        let answered = block_on(answer(&room(), ask)).unwrap();
        assert_eq!((model.asked(), answered.calls.len()), (MAX_CALLS, MAX_CALLS as usize), "{:?}", answered.corrections);
        // What geometry has found stands.
        assert_eq!((answered.grounding.answer.predicted_id, answered.degraded), (Some(InstanceId(2)), true));
    }
}

#[test]
fn a_model_that_can_not_be_asked_is_replaced_or_told() {
    let model = Scripted::new(&[None]);
    let answered = block_on(answer(&room(), asked_of(&model, WithoutModel::BuiltIn))).unwrap();
    assert_eq!((answered.grounding.answer.predicted_id, answered.degraded), (Some(InstanceId(2)), true));
    assert!(answered.corrections[0].contains("the built-in reasoner answered"), "{:?}", answered.corrections);
    let failed = block_on(answer(&room(), asked_of(&model, WithoutModel::Fail)));
    assert!(matches!(failed, Err(QuestionError::Review(_))), "{failed:?}");
    let parser = Arc::new(VlmParser { model: model.clone(), budgets: Vec::new() });
    let unread = Ask { parser, without_parser: WithoutModel::Fail, ..Ask::of(Question::of(QUERY)) };
    assert!(matches!(block_on(answer(&room(), unread)), Err(QuestionError::Unread(_))));
    // What it said can not be used, but it was asked: the grammar reads.
    let model = Scripted::new(&[Some("no JSON")]);
    let parser = Arc::new(VlmParser { model, budgets: Vec::new() });
    let misread = Ask { parser, without_parser: WithoutModel::Fail, ..Ask::of(Question::of(QUERY)) };
    assert!(block_on(answer(&room(), misread)).unwrap().degraded);
}
