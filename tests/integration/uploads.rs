//! Uploads: the content decides the type, and large ones are streamed.

use crate::archives::Scan;
use crate::server::{TestServer, finished};
use reqwest::Method;
use uniground_types::scenes::{Created, SceneStatus};

#[tokio::test]
async fn any_content_type_will_do() {
    let server = TestServer::start().await;
    let made = async |query: &str, media_type: &str, body: Vec<u8>| {
        let request = server.client.request(Method::POST, &format!("v1/scenes{query}"));
        let response = request.header("content-type", media_type).body(body).send().await.unwrap();
        assert_eq!(response.status(), 202, "{media_type}: {}", response.text().await.unwrap());
        let Created { scene, job } = response.json().await.unwrap();
        assert_eq!(finished(&server.client, &job.unwrap().id).await.error, None, "{media_type}");
        server.client.scene(&scene.id).await.unwrap()
    };
    let scan = Scan::neutral();
    let form = |name: &str, file: &[u8]| {
        let head = format!(
            "--x\r\ncontent-disposition: form-data; name=\"a\"\r\n\r\n1\r\n--x\r\ncontent-disposition: form-data; name=\"scan\"; filename=\"{name}\"\r\n\r\n"
        );
        [head.as_bytes(), file, b"\r\n--x--\r\n"].concat()
    };
    const FORM: &str = "multipart/form-data; boundary=x";
    // curl's default media type; a wrong one; a browser's form.
    for (media_type, body) in [
        ("application/x-www-form-urlencoded", scan.zip()),
        ("application/octet-stream", scan.tar()),
        ("application/x-tar", scan.zip()),
        (FORM, form("room.zip", &scan.zip())),
    ] {
        assert_eq!(made("", media_type, body).await.name, "test room", "{media_type}");
    }
    // A bare cloud, and a text file of numbers that its name marks as a cloud.
    let cloud = Scan::cloud_only().0.remove("cloud.ply").unwrap();
    let scene = made("?up=z&name=bare", "application/octet-stream", cloud).await;
    assert_eq!((scene.status, scene.import.unwrap().format.as_str()), (SceneStatus::Ready, "ply"));
    let square = |z: f32| {
        (0..900)
            .map(move |i| format!("{} {} {z}\n", (i % 30) as f32 * 0.05, (i / 30) as f32 * 0.05))
    };
    let lines: String = square(0.0).chain(square(1.0)).collect();
    let scene = made("?up=z", FORM, form("points.xyz", lines.as_bytes())).await;
    assert_eq!(
        (scene.import.unwrap().format.as_str(), scene.counts.unwrap().points),
        ("xyz", 1800)
    );
    server.stop().await;
}
