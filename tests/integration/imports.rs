//! Import of scans from the server's own disk.

use crate::test_scans::Scan;
use crate::test_server::{
    Process, TestServer, expect_problem, post_raw, serve_command, wait_for_job,
};
use camino::Utf8Path;
use std::fs;
use std::os::unix::fs::symlink;
use uniground_types::job::JobState;
use uniground_types::scenes::{ImportRequest, SceneStatus};

/// Returns a folder with `scans/room.zip`, the same scan unpacked as `scans/room/`, and a scan
/// outside of `scans`.
fn prepare_disk() -> tempfile::TempDir {
    let disk = tempfile::tempdir().unwrap();
    let root = Utf8Path::from_path(disk.path()).unwrap();
    let zip = Scan::neutral().zip();
    for place in ["scans/room.zip", "room.zip"] {
        fs::create_dir_all(root.join(place).parent().unwrap()).unwrap();
        fs::write(root.join(place), &zip).unwrap();
    }
    let mut archive = zip::ZipArchive::new(std::io::Cursor::new(zip)).unwrap();
    archive.extract(root.join("scans/room")).unwrap();
    fs::create_dir(root.join("scans/nothing")).unwrap();
    symlink(root.join("room.zip"), root.join("scans/link.zip")).unwrap();
    symlink("room.zip", root.join("scans/again.zip")).unwrap();
    disk
}

#[tokio::test]
async fn a_scan_below_the_import_folder_needs_no_upload() {
    let (data, disk) = (tempfile::tempdir().unwrap(), prepare_disk());
    let root = Utf8Path::from_path(disk.path()).unwrap().join("scans");
    let mut command = serve_command(Utf8Path::from_path(data.path()).unwrap(), "127.0.0.1:0");
    let process = Process::spawn(command.arg("--import-root").arg(&root));
    let client = &process.client;
    let first = client.import_scene(&ImportRequest::from_path("room.zip")).await.unwrap();
    assert_eq!(wait_for_job(client, &first.job.unwrap().id).await.state, JobState::Succeeded);
    // A symbolic link that stays below the folder is accepted; the same bytes are parsed once.
    let again = client
        .import_scene(&ImportRequest {
            name: Some("again".into()),
            ..ImportRequest::from_path("again.zip")
        })
        .await
        .unwrap();
    assert_eq!(
        (again.scene.content_hash.as_str(), again.scene.name.as_str()),
        (first.scene.content_hash.as_str(), "again")
    );
    let folder = client.import_scene(&ImportRequest::from_path("room")).await.unwrap();
    assert_eq!(wait_for_job(client, &folder.job.unwrap().id).await.state, JobState::Succeeded);
    let [zipped, unpacked] = [first.scene.id, folder.scene.id];
    let (zipped, unpacked) =
        (client.scene(&zipped).await.unwrap(), client.scene(&unpacked).await.unwrap());
    assert_eq!((unpacked.status, &unpacked.counts), (SceneStatus::Ready, &zipped.counts));
    let stored = client
        .import_scene(&ImportRequest {
            parse: false,
            ..ImportRequest::from_path("./room/../room.zip")
        })
        .await
        .unwrap();
    assert!(stored.job.is_none());

    let (outside, absolute) = ("../room.zip", root.join("room.zip"));
    for path in [outside, "link.zip", "no such", "/etc/passwd", "room.zip/x", ""] {
        let refused = expect_problem(client.import_scene(&ImportRequest::from_path(path)).await);
        let expected =
            if path.is_empty() { (422, "invalid_request") } else { (404, "import_not_found") };
        assert_eq!((refused.status, refused.code.as_str()), expected, "{path:?}: {refused:?}");
        assert!(!refused.detail.contains(disk.path().to_str().unwrap()), "{}", refused.detail);
    }
    // An absolute path below the folder is accepted too.
    client.import_scene(&ImportRequest::from_path(absolute)).await.unwrap();
    let refused = expect_problem(client.import_scene(&ImportRequest::from_path("nothing")).await);
    assert_eq!((refused.status, refused.errors[0].pointer.as_str()), (422, "/path"), "{refused:?}");
    assert!(!refused.detail.contains(disk.path().to_str().unwrap()), "{}", refused.detail);
    fs::write(root.join("room/grown.json"), "{}").unwrap();
    let refused = expect_problem(client.import_scene(&ImportRequest::from_path("room")).await);
    assert_eq!(
        (refused.status, refused.code.as_str()),
        (422, "archive_entry_unsafe"),
        "{refused:?}"
    );
    for metres in ["0", "-1", "1e300"] {
        let body = format!(r#"{{"path": "room.zip", "metres_per_unit": {metres}}}"#);
        let refused = post_raw(client, "v1/scenes/import", "application/json", &body).await;
        assert_eq!(
            (refused.status, refused.errors[0].pointer.as_str()),
            (422, "/metres_per_unit"),
            "{metres}: {refused:?}"
        );
    }
    let refused =
        post_raw(client, "v1/scenes/import", "application/json", r#"{"file": "room.zip"}"#).await;
    assert_eq!((refused.status, refused.code.as_str()), (422, "invalid_request"));
    assert_eq!(process.terminate(), Some(0));
}

#[tokio::test]
async fn imports_are_refused_without_an_import_folder() {
    let server = TestServer::start().await;
    let refused =
        expect_problem(server.client.import_scene(&ImportRequest::from_path("etc/passwd")).await);
    assert_eq!((refused.status, refused.code.as_str()), (403, "import_not_allowed"));
    server.stop().await;
}
