//! Scenes that grow: added frames, stable ids, and what appeared, disappeared and moved.

use crate::test_scans::{EIGHTHS, Scan, THINGS, Thing};
use crate::test_server::{TestServer, ask, expect_problem, wait_for_job};
use futures::future::join_all;
use reqwest::Method;
use std::collections::BTreeMap;
use std::time::Duration;
use uniground_client::Client;
use uniground_core::grounding::Status;
use uniground_types::changes::{ChangedThing, Changes};
use uniground_types::corrections::Change;
use uniground_types::instances::{InstanceView, Levels};
use uniground_types::job::JobState;
use uniground_types::placement::{FrameChoice, SceneToMap};
use uniground_types::question::GroundRequest;
use uniground_types::scenes::{Scene, SceneChange};

/// Camera positions between the eight of the first upload, so that instances are seen from all
/// sides.
const BETWEEN: [f32; 8] = [0.04, 0.165, 0.29, 0.415, 0.54, 0.665, 0.79, 0.915];
/// A yellow box in a place that was empty.
const YELLOW: Thing = ([-0.2, -1.3, 0.0], [0.2, -1.0, 0.5], [210, 190, 30]);
/// The blue box at another place.
const MOVED: Thing = ([-1.6, -0.3, 0.0], [-1.1, 0.1, 0.4], [30, 60, 190]);
const FLOOR: Thing = THINGS[0];
const SOFA: Thing = THINGS[1];
const BLUE: Thing = THINGS[2];
const GREEN: Thing = THINGS[3];

async fn add_frames(client: &Client, scene: &str, frames: &Scan) -> Scene {
    let created = client.add_frames(scene, FrameChoice::Source, frames.zip()).await.unwrap();
    let job = wait_for_job(client, &created.job.unwrap().id).await;
    assert_eq!(job.error, None, "{job:?}");
    client.scene(scene).await.unwrap()
}

async fn list_things(client: &Client, scene: &str) -> Vec<InstanceView> {
    client.all_instances(scene, Levels::Things).await.unwrap()
}

/// Returns the instance whose box has the same center as this box of the room.
fn instance_at<'a>(instances: &'a [InstanceView], thing: &Thing) -> &'a InstanceView {
    let off = |instance: &InstanceView| {
        (0..3)
            .map(|i| (instance.aabb.center[i] - f32::midpoint(thing.0[i], thing.1[i])).powi(2))
            .sum::<f32>()
            .sqrt()
    };
    let near: Vec<&InstanceView> =
        instances.iter().filter(|instance| off(instance) < 0.15).collect();
    assert_eq!(near.len(), 1, "{thing:?}: {near:?}");
    near[0]
}

fn box_centers(changes: &[ChangedThing]) -> Vec<[f32; 3]> {
    changes.iter().map(|thing| thing.aabb.center.coords.into()).collect()
}

/// Returns whether nothing changed. The floor may show more of itself.
fn is_unchanged(changes: &Changes) -> bool {
    let seen = changes.first_seen.iter().all(|thing| thing.aabb.size.z < 0.1);
    seen && Changes { first_seen: Vec::new(), ..changes.clone() }.is_empty()
}

fn is_near(center: [f32; 3], thing: &Thing) -> bool {
    (0..3).all(|i| (center[i] - f32::midpoint(thing.0[i], thing.1[i])).abs() < 0.12)
}

#[tokio::test]
async fn ids_are_stable_and_changes_are_reported() {
    let server = TestServer::start().await;
    let client = &server.client;
    let scene = server.upload_and_parse(Scan::of_room(&THINGS, &EIGHTHS).zip()).await;
    let before = list_things(client, &scene.id).await;
    let (sofa, blue, green) = (
        instance_at(&before, &SOFA).clone(),
        instance_at(&before, &BLUE).clone(),
        instance_at(&before, &GREEN).clone(),
    );
    let renamed = Change::Rename { instance_id: sofa.id, name: "old settee".into() };
    client.correct(&scene.id, &renamed).await.unwrap();

    // The blue box has moved, the green one is gone, a yellow one is new.
    let now = [FLOOR, SOFA, MOVED, YELLOW];
    let later = add_frames(client, &scene.id, &Scan::of_room(&now, &BETWEEN)).await;
    assert_eq!((later.parse_version, later.import.as_ref().unwrap().frames), (2, 16));
    let after = list_things(client, &scene.id).await;
    let same = instance_at(&after, &SOFA);
    assert_eq!(
        (same.id, same.given_name.as_deref()),
        (sofa.id, Some("old settee")),
        "an unchanged instance keeps its id and name"
    );
    assert!((same.aabb.size - sofa.aabb.size).norm() < 0.05, "{same:?}");
    let yellow = instance_at(&after, &YELLOW);
    let moved = instance_at(&after, &MOVED);
    let last = before.iter().map(|thing| thing.id.0).max().unwrap();
    assert!(
        yellow.id.0 > last && moved.id.0 > last,
        "an id is reused: {} and {} after {last}",
        yellow.id,
        moved.id
    );

    let told = client.changes_since(&scene.id, 1).await.unwrap();
    assert_eq!((told.from.version, told.to.version, told.alignment), (1, 2, None));
    let Changes { appeared, gone, moved: elsewhere, regrouped, first_seen, not_seen, unchanged } =
        told.changes;
    assert_eq!(appeared.iter().map(|thing| thing.id).collect::<Vec<_>>(), [yellow.id]);
    assert_eq!(gone.iter().map(|thing| thing.id).collect::<Vec<_>>(), [green.id]);
    assert_eq!(
        elsewhere.iter().map(|moved| (moved.before.id, moved.after.id)).collect::<Vec<_>>(),
        [(blue.id, moved.id)]
    );
    assert!((elsewhere[0].distance_m - (moved.aabb.center - blue.aabb.center).norm()).abs() < 1e-3);
    assert!(regrouped.is_empty() && not_seen.is_empty(), "{regrouped:?} {not_seen:?}");
    // Only floor may be seen for the first time.
    assert!(first_seen.iter().all(|thing| thing.aabb.size.z < 0.1), "{first_seen:?}");
    assert!(unchanged >= 1, "the sofa");

    // A removed instance is still returned by id but is never an answer.
    let gone: InstanceView = client
        .all_instances(&scene.id, Levels::All)
        .await
        .unwrap()
        .into_iter()
        .find(|thing| thing.id == green.id)
        .unwrap();
    assert!(gone.gone && gone.dismissed, "{gone:?}");
    let answer = client.ground(&scene.id, &ask("the green trash can")).await.unwrap();
    assert_ne!(answer.answer.predicted_id, Some(green.id));
    let known = GroundRequest { min_confidence: Some(0.5), ..ask("the old settee") };
    let answer = client.ground(&scene.id, &known).await.unwrap();
    assert_eq!((answer.status, answer.answer.predicted_id), (Status::Grounded, Some(sofa.id)));
    for file in ["cloud.ply", "instances.ply", "points.bin", "thumbnail.jpg"] {
        assert!(
            !client.bytes(&format!("v1/scenes/{}/{file}", scene.id)).await.unwrap().is_empty(),
            "{file}"
        );
    }
    let picture = format!("v1/scenes/{}/instances/{}/views/0.jpg", scene.id, yellow.id);
    image::load_from_memory(&client.bytes(&picture).await.unwrap()).unwrap();
    server.stop().await;
}

/// Corrections and added frames do not block each other.
#[tokio::test]
async fn corrections_during_an_update_are_preserved() {
    let server = TestServer::start().await;
    let client = &server.client;
    let scene = server.upload_and_parse(Scan::of_room(&THINGS, &EIGHTHS).zip()).await;
    let sofa = instance_at(&list_things(client, &scene.id).await, &SOFA).id;
    let frames = Scan::of_room(&THINGS, &BETWEEN);
    let created = client.add_frames(&scene.id, FrameChoice::Source, frames.zip()).await.unwrap();
    let job = created.job.unwrap().id;
    // One correction before the update and one during it.
    for name in ["settee", "old settee"] {
        client
            .correct(&scene.id, &Change::Rename { instance_id: sofa, name: name.into() })
            .await
            .unwrap();
        while client.job(&job).await.unwrap().state == JobState::Queued {
            tokio::time::sleep(Duration::from_millis(5)).await;
        }
    }
    assert_eq!(wait_for_job(client, &job).await.error, None);
    let after = list_things(client, &scene.id).await;
    assert_eq!(client.scene(&scene.id).await.unwrap().parse_version, 2);
    assert_eq!(
        (instance_at(&after, &SOFA).id, instance_at(&after, &SOFA).given_name.as_deref()),
        (sofa, Some("old settee"))
    );
    server.stop().await;
}

#[tokio::test]
async fn repeated_updates_report_each_change_once() {
    let server = TestServer::start().await;
    let client = &server.client;
    let scene = server.upload_and_parse(Scan::of_room(&THINGS, &EIGHTHS).zip()).await;
    let before = list_things(client, &scene.id).await;
    // The same room: nothing changes.
    let same = Scan::of_room(&THINGS, &BETWEEN);
    add_frames(client, &scene.id, &same).await;
    let told = client.changes_since(&scene.id, 1).await.unwrap();
    assert!(is_unchanged(&told.changes), "{told:?}");
    let again = list_things(client, &scene.id).await;
    for thing in [&SOFA, &BLUE, &GREEN] {
        assert_eq!(instance_at(&again, thing).id, instance_at(&before, thing).id);
    }

    // A yellow box appears and disappears again.
    let came = add_frames(
        client,
        &scene.id,
        &Scan::of_room(&[FLOOR, SOFA, BLUE, GREEN, YELLOW], &BETWEEN),
    )
    .await;
    assert_eq!(came.parse_version, 3);
    let told = client.changes_since(&scene.id, 1).await.unwrap();
    assert!(
        told.changes.appeared.len() == 1
            && is_near(box_centers(&told.changes.appeared)[0], &YELLOW),
        "{told:?}"
    );
    let went = add_frames(client, &scene.id, &same).await;
    assert_eq!((went.parse_version, went.import.unwrap().frames), (4, 32));
    assert!(is_unchanged(&client.changes_since(&scene.id, 1).await.unwrap().changes));
    let told = client.changes_since(&scene.id, 3).await.unwrap();
    assert!(
        told.changes.gone.len() == 1 && is_near(box_centers(&told.changes.gone)[0], &YELLOW),
        "{told:?}"
    );
    assert!(client.changes_since(&scene.id, 4).await.unwrap().changes.is_empty());
    for since in [0, 5] {
        assert_eq!(
            expect_problem(client.changes_since(&scene.id, since).await).code,
            "no_version",
            "{since}"
        );
    }

    // A parse of all frames from scratch gives the same instances under the same ids.
    let job = client
        .parse(
            &scene.id,
            &serde_json::json!({"settings": {"parsing": {"merging": {"min_points": 31}}}}),
        )
        .await
        .unwrap();
    assert_eq!(wait_for_job(client, &job.id).await.error, None);
    let again = list_things(client, &scene.id).await;
    for thing in [&SOFA, &BLUE, &GREEN] {
        assert_eq!(instance_at(&again, thing).id, instance_at(&before, thing).id);
    }
    client.changes_since(&scene.id, 1).await.unwrap();

    // Deleting the scene deletes all its frames.
    client.delete_scene(&scene.id).await.unwrap();
    for folder in ["blobs/contents", "blobs/parses", "blobs/checkpoints"] {
        assert_eq!(server.list_folder(folder), Vec::<String>::new(), "{folder}");
    }
    server.stop().await;
}

#[tokio::test]
async fn unrelated_or_missing_frames_are_refused_and_change_nothing() {
    let server = TestServer::start().await;
    let client = &server.client;
    let scene = server.upload_and_parse(Scan::frames_only().zip()).await;
    let content = server.list_folder("blobs/contents");
    // The same images with poses a meter higher and upside down.
    let mut elsewhere = Scan::of_room(&THINGS, &[0.1, 0.5]);
    for i in 0..2 {
        let text = String::from_utf8(elsewhere.0[&format!("pose/{i}.txt")].clone()).unwrap();
        let rows: Vec<Vec<f32>> =
            text.lines().map(|row| row.split(' ').map(|v| v.parse().unwrap()).collect()).collect();
        let line = |row: &[f32], by: f32, plus: f32| {
            format!("{} {} {} {}\n", by * row[0], by * row[1], by * row[2], by * row[3] + plus)
        };
        let turned = format!(
            "{}{}{}0 0 0 1\n",
            line(&rows[0], 1.0, 0.0),
            line(&rows[1], -1.0, 0.0),
            line(&rows[2], -1.0, 4.0)
        );
        elsewhere.0.insert(format!("pose/{i}.txt"), turned.into_bytes());
    }
    for (frames, code) in [
        (elsewhere.zip(), "frames_do_not_fit"),
        (Scan::cloud_only().zip(), "no_usable_frames"),
        (Scan::frames_only().without("intrinsic.txt").zip(), "intrinsics_missing"),
        (b"no archive".to_vec(), "archive_unreadable"),
        (Scan::frames_only().with("grown.json", "{}").zip(), "archive_entry_unsafe"),
    ] {
        let refused =
            expect_problem(client.add_frames(&scene.id, FrameChoice::Source, frames).await);
        assert_eq!((refused.code.as_str(), refused.status), (code, 422), "{refused:?}");
    }
    let refused = expect_problem(
        client.add_frames(&scene.id, FrameChoice::Map, Scan::frames_only().zip()).await,
    );
    assert_eq!(refused.code, "no_map");
    let refused = expect_problem(
        client.add_frames("nobody", FrameChoice::Source, Scan::frames_only().zip()).await,
    );
    assert_eq!(refused.code, "scene_not_found");
    assert_eq!(server.list_folder("blobs/contents"), content, "refused frames must not be stored");
    assert_eq!(client.scene(&scene.id).await.unwrap(), scene);
    assert_eq!(server.list_folder("tmp"), Vec::<String>::new());
    server.stop().await;
}

/// A robot gives poses in its map, and repeats the request when it received no response.
#[tokio::test]
async fn frames_in_map_coordinates_are_placed_and_added_once_per_key() {
    let server = TestServer::start().await;
    let client = &server.client;
    let scene = server.upload_and_parse(Scan::frames_only().zip()).await;
    // A quarter turn and a shift: the map's x is the scene's -y.
    let s = std::f64::consts::FRAC_1_SQRT_2;
    let to_map = SceneToMap { rotation: [0.0, 0.0, s, s], translation_m: [10.0, 20.0, 0.5] };
    let change = SceneChange { scene_to_map: Some(Some(to_map)), ..SceneChange::default() };
    client.change_scene(&scene.id, &change).await.unwrap();
    let mut frames = Scan::of_room(&[FLOOR, SOFA, BLUE, GREEN, YELLOW], &[0.1, 0.4, 0.7]);
    for i in 0..3 {
        let text = String::from_utf8(frames.0[&format!("pose/{i}.txt")].clone()).unwrap();
        let rows: Vec<Vec<f32>> =
            text.lines().map(|row| row.split(' ').map(|v| v.parse().unwrap()).collect()).collect();
        let line = |row: &[f32], by: f32, plus: f32| {
            format!("{} {} {} {}\n", by * row[0], by * row[1], by * row[2], by * row[3] + plus)
        };
        let in_map = format!(
            "{}{}{}0 0 0 1\n",
            line(&rows[1], -1.0, 10.0),
            line(&rows[0], 1.0, 20.0),
            line(&rows[2], 1.0, 0.5)
        );
        frames.0.insert(format!("pose/{i}.txt"), in_map.into_bytes());
    }
    let send = || async {
        let request =
            client.request(Method::POST, &format!("v1/scenes/{}/frames?world=map", scene.id));
        let response =
            request.header("idempotency-key", "look-7").body(frames.zip()).send().await.unwrap();
        assert_eq!(response.status(), 202);
        response.json::<BTreeMap<String, serde_json::Value>>().await.unwrap()
    };
    let first = send().await;
    wait_for_job(client, first["job"]["id"].as_str().unwrap()).await;
    let again = send().await;
    assert_eq!(again["job"]["id"], first["job"]["id"]);
    let after = client.scene(&scene.id).await.unwrap();
    assert_eq!((after.parse_version, after.import.unwrap().frames), (2, 11));
    let told = client.changes_since(&scene.id, 1).await.unwrap();
    assert!(
        told.changes.appeared.len() == 1
            && is_near(box_centers(&told.changes.appeared)[0], &YELLOW),
        "{told:?}"
    );
    let other = client
        .request(Method::POST, &format!("v1/scenes/{}/frames", scene.id))
        .header("idempotency-key", "look-7")
        .body(Scan::frames_only().zip());
    assert_eq!(other.send().await.unwrap().status(), 422);
    server.stop().await;
}

/// Two scans of one room, the second with another origin.
#[tokio::test]
async fn two_scans_of_a_room_are_aligned_and_compared() {
    let server = TestServer::start().await;
    let client = &server.client;
    let first = server.upload_and_parse(Scan::of_room(&THINGS, &EIGHTHS).zip()).await;
    let mut second = Scan::of_room(&[FLOOR, SOFA, MOVED, YELLOW], &EIGHTHS);
    let (sin, cos) = 0.05_f32.sin_cos();
    for i in 0..8 {
        let text = String::from_utf8(second.0[&format!("pose/{i}.txt")].clone()).unwrap();
        let rows: Vec<Vec<f32>> =
            text.lines().map(|row| row.split(' ').map(|v| v.parse().unwrap()).collect()).collect();
        let line = |x: f32, y: f32, z: f32, plus: f32| {
            let at =
                |column: usize| x * rows[0][column] + y * rows[1][column] + z * rows[2][column];
            format!("{} {} {} {}\n", at(0), at(1), at(2), at(3) + plus)
        };
        let moved = format!(
            "{}{}{}0 0 0 1\n",
            line(cos, -sin, 0.0, 0.12),
            line(sin, cos, 0.0, -0.08),
            line(0.0, 0.0, 1.0, 0.03)
        );
        second.0.insert(format!("pose/{i}.txt"), moved.into_bytes());
    }
    let second = server.upload_and_parse(second.zip()).await;
    let told = client.changes_to(&first.id, &second.id, true).await.unwrap();
    let alignment = told.alignment.unwrap();
    let off: f64 =
        alignment.translation_m.iter().zip([0.12, -0.08, 0.03]).map(|(a, b)| (a - b).abs()).sum();
    assert!(
        off < 0.03 && (alignment.rotation[2] * 2.0 - 0.05).abs() < 0.01 && alignment.rms_m < 0.02,
        "{alignment:?}"
    );
    let before = list_things(client, &first.id).await;
    let Changes { appeared, gone, moved, unchanged, .. } = told.changes.clone();
    assert_eq!(
        gone.iter().map(|thing| thing.id).collect::<Vec<_>>(),
        [instance_at(&before, &GREEN).id],
        "{told:?}"
    );
    assert_eq!(
        moved.iter().map(|moved| moved.before.id).collect::<Vec<_>>(),
        [instance_at(&before, &BLUE).id],
        "{told:?}"
    );
    assert!(appeared.len() == 1 && unchanged >= 1, "{told:?}");

    // Another room does not match.
    let far = server
        .upload_and_parse(
            Scan::of_room(
                &[
                    ([-2.0, -2.0, -4.0], [2.0, 2.0, -3.9], [90; 3]),
                    ([0.5, 0.5, -3.9], [1.5, 1.5, -3.0], [200; 3]),
                ],
                &EIGHTHS,
            )
            .zip(),
        )
        .await;
    let refused = expect_problem(client.changes_to(&first.id, &far.id, true).await);
    assert_eq!(refused.code, "scans_apart", "{refused:?}");
    server.stop().await;
}

/// Comparing two scans takes seconds, so only a few run at once; the others get an error with a
/// retry time.
#[tokio::test(flavor = "multi_thread")]
async fn concurrent_comparisons_are_limited() {
    let server = TestServer::start().await;
    let first = server.upload_and_parse(Scan::of_room(&THINGS, &EIGHTHS).zip()).await;
    let second = server.upload_and_parse(Scan::of_room(&THINGS, &BETWEEN).zip()).await;
    let compared = (0..40).map(|_| server.client.changes_to(&first.id, &second.id, false));
    let (done, refused): (Vec<_>, Vec<_>) =
        join_all(compared).await.into_iter().partition(Result::is_ok);
    let counts = (done.len(), refused.len());
    for refused in refused {
        let refused = expect_problem(refused);
        assert_eq!((refused.status, refused.code.as_str()), (429, "overloaded"), "{refused:?}");
    }
    assert!(counts.0 > 0 && counts.1 > 0, "{counts:?} were compared and refused");
    // Afterwards a comparison is accepted again.
    server.client.changes_to(&first.id, &second.id, false).await.unwrap();
    server.stop().await;
}
