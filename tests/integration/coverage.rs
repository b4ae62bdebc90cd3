//! Parts of a room that no camera saw: their share, and poses that look at them.

use crate::test_scans::{EIGHTHS, Scan, THINGS, Thing};
use crate::test_server::{TestServer, ask, assert_contains, expect_problem};
use uniground_core::grounding::Status;
use uniground_types::answer::Answer;
use uniground_types::approach::{ApproachRequest, ApproachStatus, Robot};
use uniground_types::coverage::Coverage;
use uniground_types::question::{GroundRequest, Region};

const ROBOT: Robot = Robot { radius_m: 0.2, height_m: 1.3, eye_height_m: 1.2, reach_m: None };
/// The cameras that do not show the corner at positive x and y.
const WITHOUT_CORNER: [f32; 5] = [0.0, 0.125, 0.25, 0.375, 0.875];

/// A room of 5 x 5 m with four walls.
fn walled_room() -> Vec<Thing> {
    let wall = |low: [f32; 2], high: [f32; 2]| {
        ([low[0], low[1], 0.0], [high[0], high[1], 2.2], [220, 215, 205])
    };
    let walls = [
        wall([-2.6, -2.6], [2.6, -2.5]),
        wall([-2.6, 2.5], [2.6, 2.6]),
        wall([-2.6, -2.6], [-2.5, 2.6]),
        wall([2.5, -2.6], [2.6, 2.6]),
    ];
    THINGS.into_iter().filter(|(_, max, _)| max[1] < 1.0 || max[2] <= 0.0).chain(walls).collect()
}

async fn ask_for_piano(server: &TestServer, scene: &str, within: Option<Region>) -> Answer {
    let request = GroundRequest { within, ..ask("is there a piano?") };
    server.client.ground(scene, &request).await.unwrap()
}

fn coverage_of(answer: &Answer) -> &Coverage {
    answer.coverage.as_ref().unwrap()
}

#[tokio::test(flavor = "multi_thread")]
async fn answers_about_missing_objects_say_how_much_of_the_room_was_seen() {
    let server = TestServer::start().await;
    let room = walled_room();
    let seen = server.upload_and_parse(Scan::of_room(&room, &EIGHTHS).zip()).await;
    let partly = server.upload_and_parse(Scan::of_room(&room, &WITHOUT_CORNER).zip()).await;
    let all = ask_for_piano(&server, &seen.id, None).await;
    let some = ask_for_piano(&server, &partly.id, None).await;
    assert_eq!((some.status, some.no_match_reason), (Status::Uncertain, None), "{}", some.text);
    let (of_all, of_some) = (coverage_of(&all), coverage_of(&some));
    assert!(
        of_some.seen_share < of_all.seen_share - 0.05 && of_some.may_be_unseen,
        "{} and {}",
        of_all.seen_share,
        of_some.seen_share
    );
    let percent = (100.0 * of_some.seen_share).floor();
    assert_contains(
        &some.text,
        format!("I saw {percent} % of the room; no camera looked at the rest."),
    );
    // The answer is stored with it. Answers with an object have none.
    assert_eq!(server.client.answer(&some.id).await.unwrap(), some);
    let request = GroundRequest { min_confidence: Some(0.0), ..ask("the blue box") };
    let found = server.client.ground(&partly.id, &request).await.unwrap();
    assert_eq!((found.status, found.coverage), (Status::Grounded, None));

    // The largest part is the corner, and the pose looks at it.
    let corner = &of_some.regions[0];
    assert_eq!(corner.number, 1);
    let center = corner.aabb.center;
    assert!(center.x > 1.0 && center.y > 1.0, "{corner:?}");
    let request = ApproachRequest::for_unseen_region(1, ROBOT);
    let told = server.client.approach(&partly.id, &request).await.unwrap();
    assert_eq!(told.status, ApproachStatus::Found, "{}", told.detail);
    assert_eq!((told.unseen_region.as_ref(), &told.target), (Some(corner), &None));
    for pose in &told.poses {
        let ([x, y, _], [to_x, to_y, _]) = (pose.position, pose.look_at);
        let yaw_rad = (to_y - y).atan2(to_x - x);
        assert!((yaw_rad - pose.yaw_rad).abs() < 1e-3 && to_x > 0.5 && to_y > 0.5, "{pose:?}");
        assert!(pose.distance_m >= 0.5 && pose.visible_share > 0.3, "{pose:?}");
    }
    // After looking there, the room is seen: these cameras were missing.
    let whole = Region { polygon: Some(corner_square()), ..Region::default() };
    let here = ask_for_piano(&server, &partly.id, Some(whole.clone())).await;
    let there = ask_for_piano(&server, &seen.id, Some(whole)).await;
    assert!(coverage_of(&here).seen_share < 0.5 * coverage_of(&there).seen_share);
    assert_contains(&here.text, "of that part of the room");
    let sky = Region { min_z: Some(50.0), ..Region::default() };
    assert_eq!(ask_for_piano(&server, &partly.id, Some(sky)).await.coverage, None);
    server.stop().await;
}

fn corner_square() -> Vec<[f64; 2]> {
    vec![[1.5, 1.5], [2.4, 1.5], [2.4, 2.4], [1.5, 2.4]]
}

#[tokio::test(flavor = "multi_thread")]
async fn scans_without_frames_do_not_say_what_was_seen() {
    let server = TestServer::start().await;
    let scene = server.upload_and_parse(Scan::cloud_only().zip()).await;
    let answer = ask_for_piano(&server, &scene.id, None).await;
    assert_eq!((answer.status, &answer.coverage), (Status::Uncertain, &None));
    assert!(!answer.text.contains('%'), "{}", answer.text);
    let wrong = [
        (ApproachRequest::for_unseen_region(1, ROBOT), "/unseen_region"),
        (ApproachRequest::for_unseen_region(0, ROBOT), "/unseen_region"),
        (ApproachRequest { unseen_region: Some(1), ..ApproachRequest::for_query("a", ROBOT) }, ""),
    ];
    for (request, pointer) in wrong {
        let problem = expect_problem(server.client.approach(&scene.id, &request).await);
        assert_eq!((problem.status, problem.code.as_str()), (422, "invalid_request"));
        assert_eq!(problem.errors[0].pointer, pointer);
    }
    let framed = server.upload_and_parse(Scan::frames_only().zip()).await;
    let request = ApproachRequest::for_unseen_region(99, ROBOT);
    let problem = expect_problem(server.client.approach(&framed.id, &request).await);
    assert_contains(&problem.errors[0].detail, "unseen regions");
    server.stop().await;
}

/// The pictures are named by their times, in milliseconds.
#[tokio::test(flavor = "multi_thread")]
async fn objects_have_the_time_of_the_newest_frame_that_shows_them() {
    let server = TestServer::start().await;
    let mut scan = Scan::frames_only();
    for i in 0..EIGHTHS.len() {
        let time = 1_305_031_102_000_u64 + 250 * i as u64;
        for (folder, end) in [("color", "png"), ("depth", "png"), ("pose", "txt")] {
            let file = scan.0.remove(&format!("{folder}/{i}.{end}")).unwrap();
            scan.0.insert(format!("{folder}/{time}.{end}"), file);
        }
    }
    let scene = server.upload_and_parse(scan.zip()).await;
    let client = &server.client;
    let request = GroundRequest { min_confidence: Some(0.0), ..ask("the blue box") };
    let answer = client.ground(&scene.id, &request).await.unwrap();
    let last_seen = answer.last_seen.clone().unwrap();
    assert!(
        ("2011-05-10T12:38:22Z".."2011-05-10T12:38:24").contains(&last_seen.as_str()),
        "{last_seen}"
    );
    assert_eq!(answer.targets[0].last_seen, answer.last_seen);
    let listed = client.instances(&scene.id, 100).await.unwrap().instances;
    let of = |id| listed.iter().find(|instance| instance.id == id).unwrap();
    assert_eq!(of(answer.targets[0].id).last_seen, answer.last_seen);
    // The floor is in all pictures.
    let newest = listed.iter().filter_map(|instance| instance.last_seen.as_deref()).max();
    assert_eq!(newest, Some("2011-05-10T12:38:23.75Z"));
    // Numbered pictures have no times.
    let other = server.upload_and_parse(Scan::frames_only().zip()).await;
    let answer = client.ground(&other.id, &request).await.unwrap();
    assert_eq!(answer.last_seen, None);
    server.stop().await;
}
