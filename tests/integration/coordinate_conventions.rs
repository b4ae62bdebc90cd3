//! The same room in different coordinate conventions gives the same scene.

use crate::shared_scenes::shared_scene;
use crate::test_scans::Scan;
use crate::test_server::{TestServer, ask, upload_and_parse};
use nalgebra::{Matrix4, Vector4};
use std::fs;
use uniground_core::geometry::up_axis::UpAxis;
use uniground_core::grounding::Status;

/// Rewrites every pose of the test room.
fn with_poses(scan: Scan, rewrite: impl Fn(Matrix4<f32>) -> Matrix4<f32>) -> Scan {
    (0..8).fold(scan, |scan, i| {
        let name = format!("pose/{i}.txt");
        let text = String::from_utf8(scan.0[&name].clone()).unwrap();
        let values: Vec<f32> = text.split_whitespace().map(|v| v.parse().unwrap()).collect();
        let rewritten = rewrite(Matrix4::from_row_slice(&values));
        let rows: Vec<String> =
            rewritten.row_iter().map(|r| r.iter().map(|v| format!("{v:.7} ")).collect()).collect();
        scan.with(&name, rows.join("\n"))
    })
}

/// Maps (x, y, z) to (x, z, -y).
fn z_to_y_up() -> Matrix4<f32> {
    Matrix4::new(1., 0., 0., 0., 0., 0., 1., 0., 0., -1., 0., 0., 0., 0., 0., 1.)
}

fn opencv_to_opengl() -> Matrix4<f32> {
    Matrix4::from_diagonal(&Vector4::new(1., -1., -1., 1.))
}

/// Returns the rotation from ROS body axes (x forward, y left, z up) to OpenCV's.
fn opencv_to_ros() -> Matrix4<f32> {
    Matrix4::new(0., -1., 0., 0., 0., 0., -1., 0., 1., 0., 0., 0., 0., 0., 0., 1.)
}

#[tokio::test]
async fn declared_and_detected_conventions_give_the_same_scene() {
    let server = TestServer::start().await;
    let reference = server.upload_and_parse(Scan::neutral().zip()).await;
    let sofa =
        server.client.ground(&reference.id, &ask("the red sofa")).await.unwrap().aabb.unwrap();
    let y_up = |scan| with_poses(scan, |pose| z_to_y_up() * pose);
    let declare = |scan: Scan, field: &str| {
        scan.edit("scene.json", "\"name\"", &format!("{field}, \"name\""))
    };
    for (what, scan, up) in [
        (
            "Y up, declared",
            y_up(Scan::neutral().edit("scene.json", "\"up\":\"z\"", "\"up\":\"y\"")),
            UpAxis::Y,
        ),
        ("Y up, found by the cameras", y_up(Scan::frames_only()), UpAxis::Y),
        (
            "OpenGL cameras",
            declare(
                with_poses(Scan::neutral(), |pose| pose * opencv_to_opengl()),
                "\"camera_axes\":\"opengl\"",
            ),
            UpAxis::Z,
        ),
        (
            "ROS body axes, declared",
            declare(
                with_poses(Scan::neutral(), |pose| pose * opencv_to_ros()),
                "\"camera_axes\":\"ros\"",
            ),
            UpAxis::Z,
        ),
        (
            "ROS body axes, detected",
            with_poses(Scan::neutral(), |pose| pose * opencv_to_ros()),
            UpAxis::Z,
        ),
        (
            "world-to-camera poses",
            declare(
                with_poses(Scan::neutral(), |pose| pose.try_inverse().unwrap()),
                "\"pose\":\"world_to_camera\"",
            ),
            UpAxis::Z,
        ),
    ] {
        let scene = upload_and_parse(&server.client, "application/zip", scan.zip()).await;
        assert_eq!(scene.import.unwrap().up, up, "{what}");
        let found = server.client.ground(&scene.id, &ask("the red sofa")).await.unwrap();
        let found = found.aabb.unwrap_or_else(|| panic!("{what}: {found:?}"));
        assert!(found.iou(&sofa) > 0.9, "{what}: {found:?} instead of {sofa:?}");
    }
    server.stop().await;
}

/// Inverted poses are detected and read correctly, with a warning that names them, with and without
/// a cloud.
#[tokio::test]
async fn inverted_poses_are_detected_and_corrected() {
    let server = TestServer::start().await;
    for scan in
        [Scan::frames_only().with("cloud.ply", crate::test_scans::cloud()), Scan::frames_only()]
    {
        let import = server
            .upload_and_parse(with_poses(scan, |pose| pose.try_inverse().unwrap()).zip())
            .await
            .import
            .unwrap();
        assert!(
            import.warnings.iter().any(|w| w.contains("world_to_camera")),
            "{:?}",
            import.warnings
        );
        assert!(import.reprojection_agreement.unwrap() > 0.6, "{import:?}");
    }
    server.stop().await;
}

/// Real scans without an up axis are leveled by their cameras.
#[tokio::test]
async fn real_scans_are_leveled() {
    for (name, up) in [("redkitchen.zip", UpAxis::NegY), ("hololens.zip", UpAxis::Y)] {
        let Some(folder) = shared_scene(name) else { return };
        let server = TestServer::start().await;
        let scene = upload_and_parse(
            &server.client,
            "application/zip",
            fs::read(folder.join(name)).unwrap(),
        )
        .await;
        let import = scene.import.unwrap();
        println!(
            "{name}: up {}, agreement {:?}, {:?}",
            import.up.name(),
            import.reprojection_agreement,
            scene.counts.unwrap()
        );
        assert_eq!(import.up, up, "{name}");
        assert!(import.reprojection_agreement.unwrap() > 0.4, "{name}: {import:?}");
        // A room is a few meters high, whatever its length.
        assert!((1.0..6.0).contains(&scene.extent.unwrap().size.z), "{name}: {:?}", scene.extent);
        let answer = server.client.ground(&scene.id, &ask("the theremin")).await.unwrap();
        assert_eq!(answer.status, Status::NoMatch);
        server.stop().await;
    }
}
