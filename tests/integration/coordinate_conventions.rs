//! The same room in different coordinate conventions gives the same scene.

use crate::archives::Scan;
use crate::server::{TestServer, ask, parsed};
use nalgebra::{Matrix4, Vector4};
use uniground_core::geometry::up_axis::UpAxis;

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

fn z_to_y_up() -> Matrix4<f32> {
    Matrix4::new(1., 0., 0., 0., 0., 0., 1., 0., 0., -1., 0., 0., 0., 0., 0., 1.)
}

fn opencv_to_opengl() -> Matrix4<f32> {
    Matrix4::from_diagonal(&Vector4::new(1., -1., -1., 1.))
}

#[tokio::test]
async fn axes_directions_and_units_are_only_a_matter_of_writing() {
    let server = TestServer::start().await;
    let reference = server.parsed(Scan::neutral().zip()).await;
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
            "world-to-camera poses",
            declare(
                with_poses(Scan::neutral(), |pose| pose.try_inverse().unwrap()),
                "\"pose\":\"world_to_camera\"",
            ),
            UpAxis::Z,
        ),
    ] {
        let scene = parsed(&server.client, "application/zip", scan.zip()).await;
        assert_eq!(scene.import.unwrap().up, up, "{what}");
        let found = server.client.ground(&scene.id, &ask("the red sofa")).await.unwrap();
        let found = found.aabb.unwrap_or_else(|| panic!("{what}: {found:?}"));
        assert!(found.iou(&sofa) > 0.9, "{what}: {found:?} instead of {sofa:?}");
    }
    server.stop().await;
}
