//! Archives that cannot become a scene. Each is refused with a stable code and a message that names
//! the faulty file, and nothing of it is stored.

use crate::test_scans::{Scan, ply_header};
use crate::test_server::{TestServer, ask, expect_problem, wait_for_job};
use std::io::{Cursor, Write};
use uniground_storage::JobState;

const ZIP: &str = "application/zip";

fn zip_with_entry(name: &str) -> Vec<u8> {
    let mut zip = zip::ZipWriter::new(Cursor::new(Vec::new()));
    zip.start_file(name, zip::write::SimpleFileOptions::default()).unwrap();
    zip.write_all(b"x").unwrap();
    zip.finish().unwrap().into_inner()
}

/// Description, media type and bytes of an upload; status, code and words of the refusal.
type Case = (&'static str, &'static str, Vec<u8>, u16, &'static str, &'static str);

fn invalid_uploads() -> Vec<Case> {
    let scan = Scan::frames_only;
    let whole = scan().zip();
    let truncated = whole[..whole.len() * 2 / 3].to_vec();
    vec![
        (
            "a pose on the moon",
            ZIP,
            scan().with("pose/2.txt", "1 0 0 4e8 0 1 0 0 0 0 1 0 0 0 0 1").zip(),
            422,
            "pose_invalid",
            "pose/2.txt",
        ),
        (
            "the focal length of a moonshot",
            ZIP,
            scan().edit("intrinsic.txt", "100 0", "1e30 0").zip(),
            422,
            "intrinsics_invalid",
            "focal length",
        ),
        (
            "a depth picture cut short",
            ZIP,
            with_cut_depth().zip(),
            422,
            "scene_file_malformed",
            "depth/6.png",
        ),
        (
            "a colored picture for depth",
            ZIP,
            Scan::frames_only()
                .with("depth/6.png", Scan::frames_only().0["color/6.png"].clone())
                .zip(),
            422,
            "scene_file_malformed",
            "16-bit gray",
        ),
        (
            "half a TUM sequence",
            ZIP,
            half_a_tum_sequence().zip(),
            422,
            "layout_incomplete",
            "groundtruth.txt",
        ),
        (
            "a JPEG cut short",
            ZIP,
            with_cut_jpeg().zip(),
            422,
            "scene_file_malformed",
            "color/5.jpg",
        ),
        (
            "a manifest in another encoding",
            ZIP,
            Scan::neutral().with("scene.json", b"\xff\xfe{\0}\0".to_vec()).zip(),
            422,
            "scene_file_malformed",
            "UTF-8",
        ),
        (
            "a folder for a file",
            ZIP,
            Scan::neutral().edit("scene.json", "pose/4.txt", "pose").zip(),
            422,
            "scene_file_malformed",
            "pose",
        ),
        (
            "a name no disk takes",
            ZIP,
            zip_with_entry(&"x".repeat(300)),
            422,
            "archive_entry_unsafe",
            "xxx",
        ),
        ("not an archive", ZIP, b"hello".to_vec(), 422, "archive_unreadable", "zip"),
        ("nothing at all", ZIP, Vec::new(), 422, "archive_unreadable", "empty"),
        (
            "a photograph",
            "image/jpeg",
            vec![0xff, 0xd8, 0xff, 0xe0, 0, 16],
            422,
            "archive_unreadable",
            "picture",
        ),
        ("a video", ZIP, b"\0\0\0\x18ftypmp42".to_vec(), 422, "archive_unreadable", "video"),
        (
            "a form that never comes to its file",
            "multipart/form-data; boundary=x",
            [
                b"--x\r\ncontent-disposition: form-data; name=\"a\"\r\nx: ".to_vec(),
                vec![b'a'; 4 << 20],
            ]
            .concat(),
            400,
            "malformed_form",
            "no file within the first",
        ),
        (
            "a form without a file",
            "multipart/form-data; boundary=x",
            b"--x\r\ncontent-disposition: form-data; name=\"a\"\r\n\r\n1\r\n--x--\r\n".to_vec(),
            400,
            "malformed_form",
            "curl -F",
        ),
        ("a zip cut short", ZIP, truncated, 422, "archive_unreadable", "zip"),
        (
            "a path out of the archive",
            ZIP,
            zip_with_entry("../../evil.txt"),
            422,
            "archive_entry_unsafe",
            "evil.txt",
        ),
        (
            "an absolute path",
            ZIP,
            zip_with_entry("/etc/evil"),
            422,
            "archive_entry_unsafe",
            "/etc/evil",
        ),
        (
            "a list of parts of its own",
            ZIP,
            scan()
                .with(
                    "grown.json",
                    r#"{"format": "uniground-grown/1", "parts": [{"hash": "a"}, {"hash": "b"}]}"#,
                )
                .zip(),
            422,
            "archive_entry_unsafe",
            "grown.json",
        ),
        (
            "parts of its own",
            ZIP,
            scan().with("parts/0/pose/0.txt", "x").zip(),
            422,
            "archive_entry_unsafe",
            "parts/0/pose/0.txt",
        ),
        (
            "checksums of its own",
            ZIP,
            scan().with(".sha256sums", "x").zip(),
            422,
            "archive_entry_unsafe",
            ".sha256sums",
        ),
        ("holiday photos", ZIP, zip_with_entry("beach.jpg"), 422, "unknown_layout", "beach.jpg"),
        (
            "no intrinsics",
            ZIP,
            scan().without("intrinsic.txt").zip(),
            422,
            "intrinsics_missing",
            "intrinsic.txt",
        ),
        (
            "half a camera matrix",
            ZIP,
            scan().with("intrinsic.txt", "100 0 59.5").zip(),
            422,
            "scene_file_malformed",
            "intrinsic.txt",
        ),
        (
            "words for numbers",
            ZIP,
            scan().edit("intrinsic.txt", "44.5", "middle").zip(),
            422,
            "scene_file_malformed",
            "middle",
        ),
        (
            "a focal length of zero",
            ZIP,
            scan().with("intrinsic.txt", "0 0 59.5 0 0 44.5 0 0 1").zip(),
            422,
            "intrinsics_invalid",
            "color/0.png",
        ),
        (
            "another camera's matrix",
            ZIP,
            scan().edit("intrinsic.txt", "59.5", "900").zip(),
            422,
            "intrinsics_invalid",
            "outside 120x90",
        ),
        (
            "a pose too few",
            ZIP,
            scan().without("pose/3.txt").zip(),
            422,
            "frame_count_mismatch",
            "color/3.png",
        ),
        (
            "a picture too few",
            ZIP,
            scan().without("color/7.png").zip(),
            422,
            "frame_count_mismatch",
            "depth/7.png",
        ),
        (
            "a pose of NaN",
            ZIP,
            scan().with("pose/2.txt", "nan ".repeat(16)).zip(),
            422,
            "pose_invalid",
            "pose/2.txt",
        ),
        (
            "a short pose",
            ZIP,
            scan().with("pose/2.txt", "1 0 0 0").zip(),
            422,
            "scene_file_malformed",
            "pose/2.txt",
        ),
        (
            "a mirrored pose",
            ZIP,
            scan().with("pose/2.txt", "-1 0 0 0 0 1 0 0 0 0 1 0 0 0 0 1").zip(),
            422,
            "pose_invalid",
            "frame 2",
        ),
        (
            "a picture that is none",
            ZIP,
            scan().with("color/5.png", "tea").zip(),
            422,
            "scene_file_malformed",
            "color/5.png",
        ),
        ("all poses lost", ZIP, lost_everywhere().zip(), 422, "no_usable_frames", "8 poses"),
        (
            "a manifest that is no JSON",
            ZIP,
            Scan::neutral().with("scene.json", "{").zip(),
            422,
            "scene_file_malformed",
            "scene.json",
        ),
        (
            "an unknown field",
            ZIP,
            Scan::neutral().edit("scene.json", "\"up\"", "\"upp\"").zip(),
            422,
            "scene_file_malformed",
            "upp",
        ),
        (
            "another format",
            ZIP,
            Scan::neutral().edit("scene.json", "scene/1", "scene/9").zip(),
            422,
            "scene_file_malformed",
            "uniground-scene/9",
        ),
        (
            "no intrinsics in the manifest",
            ZIP,
            Scan::neutral().edit("scene.json", "\"intrinsics\"", "\"depth_intrinsics\"").zip(),
            422,
            "intrinsics_missing",
            "frame 0",
        ),
        (
            "a file that is not there",
            ZIP,
            Scan::neutral().edit("scene.json", "depth/4.png", "depth/44.png").zip(),
            422,
            "scene_file_missing",
            "depth/44.png",
        ),
        (
            "a manifest that looks outside",
            ZIP,
            Scan::neutral().edit("scene.json", "pose/4.txt", "../4.txt").zip(),
            422,
            "archive_entry_unsafe",
            "../4.txt",
        ),
        (
            "a cloud that is none",
            ZIP,
            Scan::cloud_only().with("cloud.ply", "hello").zip(),
            422,
            "scene_file_malformed",
            "cloud.ply",
        ),
        (
            "no frames and no points",
            ZIP,
            empty_manifest().zip(),
            422,
            "scene_empty",
            "no frames and no points",
        ),
    ]
}

fn with_cut_jpeg() -> Scan {
    let picture = image::load_from_memory(&Scan::frames_only().0["color/5.png"]).unwrap();
    let jpeg = uniground_core::render::encode_jpeg(&picture.into_rgb8());
    Scan::frames_only().without("color/5.png").with("color/5.jpg", &jpeg[..jpeg.len() / 2])
}

fn with_cut_depth() -> Scan {
    let png = &Scan::frames_only().0["depth/6.png"];
    Scan::frames_only().with("depth/6.png", &png[..png.len() / 2])
}

fn half_a_tum_sequence() -> Scan {
    let list = "1.0 rgb/1.png\n";
    Scan(std::collections::BTreeMap::new())
        .with("rgb.txt", list)
        .with("depth.txt", list)
        .with("rgb/1.png", "x")
        .with("depth/1.png", "x")
}

fn lost_everywhere() -> Scan {
    (0..8).fold(Scan::frames_only(), |scan, i| {
        scan.with(&format!("pose/{i}.txt"), "-inf ".repeat(16))
    })
}

fn empty_manifest() -> Scan {
    Scan(std::collections::BTreeMap::new()).with("scene.json", r#"{"format": "uniground-scene/1"}"#)
}

#[tokio::test]
async fn invalid_archives_are_refused_and_leave_nothing_behind() {
    let server = TestServer::start().await;
    for (what, media_type, archive, status, code, words) in invalid_uploads() {
        let refusal = expect_problem(server.client.create_scene(None, media_type, archive).await);
        assert_eq!(
            (refusal.status, refusal.code.as_str()),
            (status, code),
            "{what}: {}",
            refusal.detail
        );
        assert!(
            refusal.detail.contains(words),
            "{what}: {:?} does not name {words:?}",
            refusal.detail
        );
        assert!(refusal.request_id.is_some(), "{what}");
    }
    assert_eq!(server.client.scenes(10, None).await.unwrap().scenes, []);
    assert_eq!((server.list_folder("blobs/contents"), server.list_folder("tmp")), (vec![], vec![]));
    server.client.bytes("readyz").await.unwrap();
    server.stop().await;
}

/// Errors that appear only when images and clouds are decoded fail the job with the same detail.
#[tokio::test]
async fn errors_found_while_parsing_fail_the_job() {
    let server = TestServer::start().await;
    let png = &Scan::frames_only().0["depth/6.png"];
    // The file looks whole: its first bytes and its end marker are intact.
    let mut broken_png = png.clone();
    broken_png[60..].iter_mut().rev().skip(12).for_each(|byte| *byte = 0);
    let no_depth = (0..8)
        .fold(Scan::frames_only(), |scan, i| scan.with(&format!("depth/{i}.png"), blank_depth()));
    for (what, scan, code, words) in [
        (
            "a depth picture that can not be decoded",
            Scan::frames_only().with("depth/6.png", broken_png),
            "frame_unreadable",
            "depth/6.png",
        ),
        (
            "an empty cloud",
            Scan::cloud_only().with("cloud.ply", ply_header(0)),
            "cloud_empty",
            "cloud.ply",
        ),
        (
            "a cloud cut short",
            Scan::cloud_only().with("cloud.ply", ply_header(5)),
            "scene_file_malformed",
            "cloud.ply",
        ),
        (
            "an empty cloud beside frames",
            Scan::frames_only().with("cloud.ply", ply_header(0)),
            "cloud_empty",
            "cloud.ply",
        ),
        (
            "a cloud in map coordinates",
            Scan::cloud_only().with("cloud.ply", map_cloud()),
            "scene_file_malformed",
            "10 km",
        ),
        ("no depth anywhere", no_depth, "no_usable_frames", "depth"),
    ] {
        let created = server.client.create_scene(None, ZIP, scan.zip()).await.unwrap();
        let job = wait_for_job(&server.client, &created.job.unwrap().id).await;
        let error = job.error.unwrap_or_else(|| panic!("{what}: {:?}", job.message));
        assert_eq!(
            (job.state, error.code.as_str()),
            (JobState::Failed, code),
            "{what}: {}",
            error.detail
        );
        assert!(error.detail.contains(words), "{what}: {:?} does not name {words:?}", error.detail);
        let scene = server.client.scene(&created.scene.id).await.unwrap();
        assert_eq!(scene.error, Some(error), "{what}");
        assert_eq!(
            expect_problem(server.client.ground(&scene.id, &ask("the sofa")).await).code,
            "scene_not_ready",
            "{what}"
        );
    }
    assert_eq!((server.list_folder("blobs/parses"), server.list_folder("tmp")), (vec![], vec![]));
    server.stop().await;
}

#[tokio::test]
async fn frames_with_invalid_poses_are_skipped_with_a_warning() {
    let server = TestServer::start().await;
    let scene = server
        .upload_and_parse(Scan::frames_only().with("pose/3.txt", "-inf ".repeat(16)).zip())
        .await;
    let import = scene.import.unwrap();
    assert_eq!((import.frames, import.frames_skipped), (7, 1));
    assert!(
        import.warnings.iter().any(|w| w.contains("1 of 8 frames skipped")),
        "{:?}",
        import.warnings
    );
    server.stop().await;
}

fn map_cloud() -> Vec<u8> {
    let row =
        [500_000.0_f32, 5_400_000.0, 100.0].into_iter().flat_map(f32::to_le_bytes).chain([9, 9, 9]);
    ply_header(1).into_iter().chain(row).collect()
}

fn blank_depth() -> Vec<u8> {
    let mut bytes = Cursor::new(Vec::new());
    let blank = image::ImageBuffer::<image::Luma<u16>, _>::new(120, 90);
    image::DynamicImage::from(blank).write_to(&mut bytes, image::ImageFormat::Png).unwrap();
    bytes.into_inner()
}
