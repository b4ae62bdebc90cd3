//! A model sees an object in a photograph that is not listed: the place becomes an instance, and
//! the model is asked again.

use super::{
    Script, builtin_answer, call_purposes, corrections, count_images, request_by, sample_scan,
    six_field_reply, start_server, user_text, vlm_config,
};
use crate::neural::tiny_models;
use crate::scripted_model::{Scripted, says};
use crate::test_server::{TestServer, ask};
use uniground::config::{LimitsConfig, ModelsConfig, VlmConfig};
use uniground_core::grounding::{NoMatchReason, Status};
use uniground_types::answer::Answer;
use uniground_types::instances::{InstanceView, Levels};
use uniground_types::question::{GroundRequest, PromptVersion, ReasonerChoice};

const QUERY: &str = "the porcelain teapot";
const NAME: &str = "white porcelain teapot";

/// Returns the reply "not listed" with the object's place, in the whole photograph below the crop
/// of this collage image.
fn unlisted_reply(image: usize, (x, y): (u32, u32)) -> Scripted {
    says(&format!(
        "Predicted ID: not listed\nExplanation: it stands there\nCandidate Names: none\nTarget name matches?: false\nAnchor ID: unknown\n\
         Relation used: none\nSeen at: {image}, {x}, {y}, {NAME}"
    ))
}

#[tokio::test(flavor = "multi_thread")]
async fn an_object_that_differs_from_the_question_is_uncertain() {
    let script = Script::default();
    let (server, scene) = start_server(vlm_config(&script.serve(vec![says("-")]).await)).await;
    let plain = builtin_answer(&server, &scene).await;
    let chosen = plain.candidates.as_ref().unwrap()[0].id;
    script.next(vec![says(&format!(
        "Predicted ID: {chosen}\nExplanation: the only mug\nCandidate Names: {chosen} -> blue mug\nTarget name matches?: true\n\
         Anchor ID: unknown\nRelation used: none\nDiffers: it is blue, not red"
    ))]);
    let answer = server.client.ground(&scene, &request_by(ReasonerChoice::Vlm)).await.unwrap();
    assert_eq!(
        (answer.status, answer.answer.predicted_id, answer.differs.as_deref()),
        (Status::Uncertain, Some(chosen), Some("it is blue, not red"))
    );
    for text in [&answer.text, &answer.answer.explanation] {
        assert!(text.contains("it is blue, not red"), "{text}");
    }
    assert!(answer.confidence <= 0.5 && answer.aabb.is_some(), "{}", answer.confidence);
    server.stop().await;
}

/// Returns the id of the new instance, from the trace.
fn created_instance(answer: &Answer) -> Option<u32> {
    let told = corrections(answer);
    let (before, _) = told.split_once(" was made of it")?;
    before.rsplit(' ').next()?.parse().ok()
}

#[tokio::test(flavor = "multi_thread")]
async fn an_unlisted_object_in_a_photograph_becomes_an_instance() {
    let script = Script::default();
    let (server, scene) = start_server(vlm_config(&script.serve(vec![says("-")]).await)).await;
    let before = server.client.all_instances(&scene, Levels::All).await.unwrap().len();
    let asked = async |answers: Vec<Scripted>| {
        script.take();
        script.next(answers);
        server.client.ground(&scene, &ask(QUERY)).await.unwrap()
    };

    // A place in the render is reported, because it is not in a photograph.
    let answer = asked(vec![unlisted_reply(1, (500, 500))]).await;
    assert_eq!(
        (answer.status, answer.no_match_reason),
        (Status::NoMatch, Some(NoMatchReason::NotListed))
    );
    assert_eq!(
        (answer.seen.as_ref().unwrap().name.as_str(), call_purposes(&answer).len()),
        (NAME, 1)
    );

    // The place in the photographs is not an instance yet. The model does not choose it: there is
    // no target.
    let spots = (2..=4).flat_map(|image| {
        [80, 160, 240].into_iter().flat_map(move |x| [600, 700, 800, 900].map(|y| (image, (x, y))))
    });
    let mut found = None;
    for (image, at) in spots {
        let answer =
            asked(vec![unlisted_reply(image, at), six_field_reply("none", "", false, 1)]).await;
        if let Some(id) = created_instance(&answer) {
            assert_eq!(
                (answer.status, call_purposes(&answer).len()),
                (Status::NoMatch, 2),
                "{}",
                corrections(&answer)
            );
            assert!(answer.candidates.as_ref().unwrap().iter().any(|c| c.id.0 == id));
            found = Some((image, at, id));
            break;
        }
    }
    let (image, at, id) = found.expect("no place in three photographs is without an instance");
    assert_eq!(id as usize, before + 1, "the new instance must have the highest id");

    // The instance is stored and flagged, and has views.
    let instances: Vec<InstanceView> =
        server.client.all_instances(&scene, Levels::All).await.unwrap();
    let instance = instances.last().unwrap();
    assert_eq!((instance.label.as_str(), instance.found_for.as_deref()), (NAME, Some(QUERY)));
    assert!(
        instance.point_count >= 20
            && instance.aabb.size.iter().all(|side| *side > 0.0)
            && !instance.views.is_empty()
    );
    for picture in ["frame", "crop"] {
        let bytes = server
            .client
            .bytes(&format!("v1/scenes/{scene}/instances/{id}/views/0.jpg?picture={picture}"))
            .await
            .unwrap();
        image::load_from_memory(&bytes).unwrap();
    }

    // On the next question it is a candidate by its name, and the model chooses it.
    let answer = asked(vec![six_field_reply(id, &format!("{id} -> {NAME}"), true, 1)]).await;
    assert_eq!(
        (answer.status, answer.answer.predicted_id.map(|id| id.0), call_purposes(&answer).len()),
        (Status::Grounded, Some(id), 1)
    );
    assert_eq!(answer.aabb, Some(instance.aabb));

    // It is listed now. Pointing at the same place again creates no second instance.
    let answer =
        asked(vec![unlisted_reply(image, at), six_field_reply("none", "", false, 1)]).await;
    let instances = server.client.all_instances(&scene, Levels::All).await.unwrap();
    assert_eq!(
        instances.len(),
        before + 1 + usize::from(created_instance(&answer).is_some()),
        "{}",
        corrections(&answer)
    );
    let again =
        instances.iter().filter(|other| other.id.0 != id && other.aabb.iou(&instance.aabb) >= 0.5);
    assert_eq!(again.count(), 0, "{}", corrections(&answer));
    server.stop().await;
}

/// The model chooses an instance and draws the box of the whole object, of which the instance is a
/// piece.
#[tokio::test(flavor = "multi_thread")]
async fn a_chosen_piece_is_replaced_by_the_object_in_the_box() {
    let script = Script::default();
    let (server, scene) = start_server(vlm_config(&script.serve(vec![says("-")]).await)).await;
    let before = server.client.all_instances(&scene, Levels::All).await.unwrap().len();
    let plain = builtin_answer(&server, &scene).await;
    let chosen = plain.candidates.as_ref().unwrap()[0].clone();
    // Boxes in the whole photographs below the crops of the chosen candidate.
    let boxes = [0, 1].into_iter().flat_map(|column| {
        let left = 340 * column;
        [(10, 560, 330, 940), (60, 560, 280, 900), (10, 600, 170, 900), (170, 600, 330, 900)]
            .map(|(x, top, right, bottom)| (left + x, top, left + right, bottom))
    });
    let mut replaced = None;
    for (left, top, right, bottom) in boxes {
        script.take();
        script.next(vec![says(&format!(
            "Predicted ID: {id}\nExplanation: it is a piece of it\nCandidate Names: {id} -> {NAME}\nTarget name matches?: true\n\
             Anchor ID: unknown\nRelation used: none\nSeen at: 2, {left}, {top}, {right}, {bottom}, {NAME}",
            id = chosen.id
        ))]);
        let answer = server.client.ground(&scene, &request_by(ReasonerChoice::Vlm)).await.unwrap();
        assert_eq!((answer.status, call_purposes(&answer).len()), (Status::Grounded, 1));
        let id = answer.answer.predicted_id.unwrap();
        if id == chosen.id {
            assert_eq!(answer.aabb, Some(chosen.aabb), "{}", corrections(&answer));
        } else {
            replaced = Some((answer, id));
            break;
        }
    }
    let (answer, id) = replaced.expect("no box holds anything but the chosen instance");
    let told = format!("instance {id} fits the object better than the chosen {}", chosen.id);
    assert!(corrections(&answer).contains(&told), "{}", corrections(&answer));
    assert_ne!(answer.aabb, Some(chosen.aabb));
    let other = |id| answer.alternatives.iter().all(|other| other.id != id);
    assert!(other(chosen.id) && other(id), "the piece is no alternative");
    assert_eq!(answer.answer.candidate_names[&id.0], NAME);
    let instances = server.client.all_instances(&scene, Levels::All).await.unwrap();
    let found = instances.iter().find(|instance| instance.id == id).unwrap();
    assert_eq!(answer.aabb, Some(found.aabb));
    assert!(instances.len() <= before + 1);
    server.stop().await;
}

/// All images of the question are on the one picture that the model accepts. A place in it belongs to
/// the photograph that lies there.
#[tokio::test(flavor = "multi_thread")]
async fn a_place_in_a_combined_picture_becomes_an_instance() {
    const MAX_PX: u32 = 1600;
    let script = Script::default();
    let vlm = VlmConfig {
        vlm_max_images: Some(1),
        vlm_max_image_px: Some(MAX_PX),
        ..vlm_config(&script.serve(vec![says("-")]).await)
    };
    let (server, scene) = start_server(vlm).await;
    let spots = (60..1000).step_by(90).flat_map(|x| (60..1000).step_by(90).map(move |y| (x, y)));
    let mut found = None;
    for at in spots {
        script.take();
        script.next(vec![unlisted_reply(3, at), six_field_reply("none", "", false, 1)]);
        let answer = server.client.ground(&scene, &ask(QUERY)).await.unwrap();
        if let Some(seen) = &answer.seen {
            assert_eq!(seen.picture, "call-1-images-1");
        }
        if let Some(id) = created_instance(&answer) {
            assert!(corrections(&answer).contains("in candidate-"), "{}", corrections(&answer));
            found = Some((answer, id));
            break;
        }
    }
    let (answer, id) = found.expect("no place in the picture is without an instance");
    let instances = server.client.all_instances(&scene, Levels::All).await.unwrap();
    assert_eq!(
        (instances.last().unwrap().id.0, instances.last().unwrap().label.as_str()),
        (id, NAME)
    );
    for sent in script.take() {
        assert_eq!(count_images(&sent), 1);
        let text = user_text(&sent);
        assert!(text.contains("picture 1 holds images 1 to "), "{text}");
        assert!(text.contains("rim of the whole picture that the image is part of"), "{text}");
    }
    let picture = format!("v1/answers/{}/evidence/call-1-images-1.jpg", answer.id);
    let picture = image::load_from_memory(&server.client.bytes(&picture).await.unwrap()).unwrap();
    assert!(picture.width().max(picture.height()) <= MAX_PX);
    server.stop().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn photographs_are_shown_when_no_candidate_matches() {
    let script = Script::default();
    let encoder = ModelsConfig { masks: "builtin".into(), ..tiny_models() };
    let vlm = vlm_config(&script.serve(vec![says("-")]).await);
    let server =
        TestServer::start_on(tempfile::tempdir().unwrap(), LimitsConfig::default(), vlm, encoder)
            .await;
    let scene = server.upload_and_parse(sample_scan()).await.id;
    let asked = async |prompt: PromptVersion, answers: Vec<Scripted>| {
        script.take();
        script.next(answers);
        let answer =
            server.client.ground(&scene, &GroundRequest { prompt, ..ask(QUERY) }).await.unwrap();
        (answer, script.take().remove(0))
    };
    let none = || six_field_reply("none", "", false, 1);
    let told = "photographs of the room with nothing drawn in";
    let (answer, body) = asked(PromptVersion::Revised, vec![none()]).await;
    let best = answer.candidates.as_ref().unwrap().iter().map(|c| c.score).fold(0.0, f32::max);
    assert!(best < 0.5 && user_text(&body).contains(told), "{best}: {}", user_text(&body));
    let pictures = count_images(&body);
    let (_, paper) = asked(PromptVersion::Paper, vec![none()]).await;
    assert!(!user_text(&paper).contains(told));

    // A place in the last photograph belongs to that frame: what is there becomes an instance.
    let spots =
        [200, 350, 500, 650, 800].into_iter().flat_map(|x| [400, 550, 700, 850].map(|y| (x, y)));
    let mut found = None;
    for at in spots {
        let (answer, _) =
            asked(PromptVersion::Revised, vec![unlisted_reply(pictures, at), none()]).await;
        assert_eq!(answer.trace.as_ref().unwrap().calls[0].error, None);
        if let Some(id) = created_instance(&answer) {
            assert!(corrections(&answer).contains("in photograph-2"), "{}", corrections(&answer));
            found = Some(id);
            break;
        }
    }
    let id = found.expect("no place in the photograph is without an instance");
    let instances = server.client.all_instances(&scene, Levels::All).await.unwrap();
    assert_eq!(
        (instances.last().unwrap().id.0, instances.last().unwrap().label.as_str()),
        (id, NAME)
    );
    server.stop().await;
}
