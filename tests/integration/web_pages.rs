//! What web pages need of the service: other origins, signed links, conditional requests, ranges,
//! and images.

use crate::test_scans::Scan;
use crate::test_server::{
    Process, TestServer, assert_contains, expect_problem, serve_command, upload_and_parse,
    wait_for_job,
};
use camino::Utf8Path;
use reqwest::{Method, StatusCode, header};
use std::process::Stdio;
use uniground_client::Client;
use uniground_types::links::LinkRequest;
use uniground_types::scene::FrameList;
use uniground_types::scenes::Created;

const KEY: &str = "ug_0123456789abcdef";
const PAGE: &str = "https://robots.example";

fn start_with_origin(page: &str, data: &Utf8Path, key: bool) -> Process {
    let mut command = serve_command(data, "127.0.0.1:0");
    command.args(["--cors-origin", page]).stderr(Stdio::null());
    if key {
        command.env("UNIGROUND_API_KEY", KEY);
    }
    Process::spawn(&mut command)
}

#[tokio::test]
async fn only_allowed_origins_can_send_requests() {
    let data = tempfile::tempdir().unwrap();
    let process = start_with_origin(PAGE, Utf8Path::from_path(data.path()).unwrap(), false);
    let client = &process.client;
    let preflight = async |origin: &str| {
        let request = client.request(Method::OPTIONS, "v1/scenes").header("origin", origin);
        let request = request.header("access-control-request-method", "POST");
        request
            .header("access-control-request-headers", "authorization,content-type")
            .send()
            .await
            .unwrap()
    };
    let answer = preflight(PAGE).await;
    assert_eq!(
        (answer.status(), &answer.headers()["access-control-allow-origin"]),
        (StatusCode::OK, &PAGE.parse().unwrap())
    );
    for named in ["authorization", "content-type", "idempotency-key", "range"] {
        assert!(
            answer.headers()["access-control-allow-headers"].to_str().unwrap().contains(named),
            "{named}"
        );
    }
    assert!(
        !preflight("https://evil.example")
            .await
            .headers()
            .contains_key("access-control-allow-origin")
    );
    let listed =
        client.request(Method::GET, "v1/scenes").header("origin", PAGE).send().await.unwrap();
    assert_eq!(listed.headers()["access-control-allow-origin"], PAGE);
    assert_contains(
        listed.headers()["access-control-expose-headers"].to_str().unwrap(),
        "retry-after",
    );
    // A page of the server itself; a client that is not a browser; an allowed origin.
    let made = async |origin: Option<&str>, site: Option<&str>| {
        let request = client
            .request(Method::POST, "v1/links")
            .json(&LinkRequest { paths: vec!["/v1/scenes".into()], expires_in_s: 60 });
        let request =
            origin.into_iter().fold(request, |request, origin| request.header("origin", origin));
        site.into_iter()
            .fold(request, |request, site| request.header("sec-fetch-site", site))
            .send()
            .await
            .unwrap()
    };
    let own =
        format!("http://{}", client.request(Method::GET, "").build().unwrap().url().authority());
    for (origin, site) in [
        (None, None),
        (Some(&*own), None),
        (Some(PAGE), Some("cross-site")),
        (Some("https://behind.example"), Some("same-origin")),
    ] {
        assert_eq!(made(origin, site).await.status(), StatusCode::OK, "{origin:?} {site:?}");
    }
    for (origin, site) in
        [(Some("https://evil.example"), None), (Some("null"), None), (None, Some("cross-site"))]
    {
        let refused = made(origin, site).await;
        let told: uniground_types::problem::Problem = refused.json().await.unwrap();
        assert_eq!(
            (told.status, told.code.as_str()),
            (403, "origin_not_allowed"),
            "{origin:?} {site:?}"
        );
    }
    assert_eq!(process.terminate(), Some(0));

    let refused = serve_command(Utf8Path::from_path(data.path()).unwrap(), "127.0.0.1:0")
        .args(["--cors-origin", "*"])
        .output()
        .unwrap();
    assert!(
        !refused.status.success()
            && String::from_utf8_lossy(&refused.stderr).contains("--cors-origin"),
        "{refused:?}"
    );
}

#[tokio::test]
async fn signed_links_show_images_without_a_key() {
    let data = tempfile::tempdir().unwrap();
    let process = start_with_origin(PAGE, Utf8Path::from_path(data.path()).unwrap(), true);
    let address = process.client.request(Method::GET, "").build().unwrap().url().clone();
    let known = Client::new(address.as_str(), Some(KEY.into())).unwrap();
    let scene = upload_and_parse(&known, "application/zip", Scan::neutral().zip()).await;
    let below = format!("/v1/scenes/{}", scene.id);
    let paths = vec![
        format!("{below}/thumbnail.jpg"),
        format!("{below}/*"),
        format!("/v1/jobs/{}/events", scene.job_id.unwrap()),
    ];
    let links = known.links(&LinkRequest { paths, expires_in_s: 60 }).await.unwrap().links;
    // Without a key from here on.
    let status = async |path: &str| {
        process
            .client
            .request(Method::GET, path.trim_start_matches('/'))
            .send()
            .await
            .unwrap()
            .status()
    };
    assert_eq!(status(&format!("{below}/thumbnail.jpg")).await, StatusCode::UNAUTHORIZED);
    assert_eq!(status(links[0].url.as_ref().unwrap()).await, StatusCode::OK);
    assert_eq!(
        status(&format!("{below}/cloud.ply?link={}", links[0].token)).await,
        StatusCode::UNAUTHORIZED
    );
    for path in
        ["points.bin", "frames", "instances/1/views/0.jpg?picture=crop", "instances?limit=1"]
    {
        let separator = if path.contains('?') { '&' } else { '?' };
        assert_eq!(
            status(&format!("{below}/{path}{separator}link={}", links[1].token)).await,
            StatusCode::OK,
            "{path}"
        );
    }
    // Events are requested like a browser's `EventSource` does.
    let events = process
        .client
        .request(Method::GET, links[2].url.as_ref().unwrap().trim_start_matches('/'))
        .send()
        .await
        .unwrap();
    assert_eq!(events.headers()[header::CONTENT_TYPE], "text/event-stream");
    assert_contains(events.text().await.unwrap(), "succeeded");
    // Links allow reading only.
    let wrong = process.client.request(
        Method::DELETE,
        &format!("{}?link={}", below.trim_start_matches('/'), links[1].token),
    );
    assert_eq!(wrong.send().await.unwrap().status(), StatusCode::UNAUTHORIZED);
    let asking = process.client.request(
        Method::POST,
        &format!("{}/ground?link={}", below.trim_start_matches('/'), links[1].token),
    );
    let asked = asking.json(&serde_json::json!({"query": "the sofa"})).send().await.unwrap();
    assert_eq!(asked.status(), StatusCode::UNAUTHORIZED, "a link must not allow questions");
    assert_eq!(known.scene(&scene.id).await.unwrap().id, scene.id);
    assert_eq!(process.terminate(), Some(0));
}

#[tokio::test]
async fn conditional_and_range_requests_are_supported() {
    let server = TestServer::start().await;
    let scene = server.upload_and_parse(Scan::neutral().zip()).await;
    let get = async |path: &str, headers: &[(&str, &str)]| {
        let request = server.client.request(Method::GET, &format!("v1/scenes/{}{path}", scene.id));
        headers
            .iter()
            .fold(request, |request, (name, value)| request.header(*name, *value))
            .send()
            .await
            .unwrap()
    };
    let drawn = "/frames/0/photograph.jpg?instances=true";
    for path in [
        "",
        "/instances",
        "/frames",
        "/cloud.ply",
        "/points.bin",
        "/thumbnail.jpg",
        "/instances/1/views/0.jpg",
        drawn,
    ] {
        let first = get(path, &[]).await;
        assert_eq!(
            (first.status(), &first.headers()["cache-control"]),
            (StatusCode::OK, &"private, no-cache".parse().unwrap()),
            "{path}"
        );
        let mark = first.headers()["etag"].to_str().unwrap().to_owned();
        let again = get(path, &[("if-none-match", &mark)]).await;
        assert_eq!(
            (again.status(), again.headers()["etag"].to_str().unwrap()),
            (StatusCode::NOT_MODIFIED, &*mark),
            "{path}"
        );
        assert!(again.bytes().await.unwrap().is_empty());
        assert_eq!(
            get(path, &[("if-none-match", "\"other\"")]).await.status(),
            StatusCode::OK,
            "{path}"
        );
    }
    // A renamed scene has a new entity tag.
    let mark = get("", &[]).await.headers()["etag"].clone();
    server.client.rename_scene(&scene.id, "other").await.unwrap();
    assert_ne!(get("", &[]).await.headers()["etag"], mark);

    // Ranges, for clients that read a cloud piece by piece, and HEAD requests.
    let whole = get("/points.bin", &[]).await.bytes().await.unwrap();
    let part = get("/points.bin", &[("range", "bytes=0-43")]).await;
    assert_eq!(part.status(), StatusCode::PARTIAL_CONTENT);
    assert_eq!(
        part.headers()["content-range"].to_str().unwrap(),
        format!("bytes 0-43/{}", whole.len())
    );
    assert_eq!(part.bytes().await.unwrap(), whole[..44]);
    let points = u32::from_le_bytes(whole[4..8].try_into().unwrap());
    assert_eq!((&whole[..4], u64::from(points)), (&b"UGP1"[..], scene.counts.unwrap().points));
    assert_eq!(whole.len(), 32 + 12 * points as usize);
    let mark = get("/points.bin", &[]).await.headers()["etag"].to_str().unwrap().to_owned();
    assert_eq!(
        get("/points.bin", &[("range", "bytes=0-43"), ("if-range", &mark)]).await.status(),
        StatusCode::PARTIAL_CONTENT
    );
    assert_eq!(
        get("/points.bin", &[("range", "bytes=0-43"), ("if-range", "\"other\"")]).await.status(),
        StatusCode::OK
    );
    let beyond = get("/points.bin", &[("range", "bytes=999999999-")]).await;
    assert_eq!(beyond.status(), StatusCode::RANGE_NOT_SATISFIABLE);
    let head = server
        .client
        .request(Method::HEAD, &format!("v1/scenes/{}/points.bin", scene.id))
        .send()
        .await
        .unwrap();
    assert_eq!(
        (head.status(), head.headers()["content-length"].to_str().unwrap()),
        (StatusCode::OK, &*whole.len().to_string())
    );

    // Compression for clients that accept it, except for images and ranges.
    let taken = [("accept-encoding", "zstd, br;q=0.9, gzip;q=0.8")];
    for (path, is_compressed) in
        [("/instances", true), ("/cloud.ply", true), ("/thumbnail.jpg", false)]
    {
        assert_eq!(
            get(path, &taken).await.headers().contains_key("content-encoding"),
            is_compressed,
            "{path}"
        );
    }
    assert!(
        !get("/points.bin", &[taken[0], ("range", "bytes=0-9999")])
            .await
            .headers()
            .contains_key("content-encoding")
    );
    assert!(get("/cloud.ply", &taken).await.headers()["etag"].to_str().unwrap().starts_with("W/"));
    server.stop().await;
}

#[tokio::test]
async fn thumbnails_photographs_and_points_are_served() {
    let server = TestServer::start().await;
    let sample = server.client.request(Method::POST, "v1/scenes/sample").send().await.unwrap();
    assert_eq!(sample.status(), StatusCode::ACCEPTED);
    let Created { scene, job } = sample.json().await.unwrap();
    assert_eq!(scene.name, uniground_service::sample::NAME);
    let early =
        expect_problem(server.client.bytes(&format!("v1/scenes/{}/thumbnail.jpg", scene.id)).await);
    assert_eq!(early.code, "scene_not_ready");
    assert_eq!(wait_for_job(&server.client, &job.unwrap().id).await.error, None);
    let small =
        server.client.bytes(&format!("v1/scenes/{}/thumbnail.jpg", scene.id)).await.unwrap();
    let small = image::load_from_memory(&small).unwrap().into_rgb8();
    let drawn = small.pixels().filter(|p| p.0 != [250, 250, 250]).count();
    assert!((small.width(), small.height()) == (320, 240) && drawn > 320 * 240 / 5, "{drawn}");
    let frames = server.client.bytes(&format!("v1/scenes/{}/frames", scene.id)).await.unwrap();
    let frames: FrameList = serde_json::from_slice(&frames).unwrap();
    let index = frames.frames[0].index;
    let photograph = async |with: &str| {
        let bytes = server
            .client
            .bytes(&format!("v1/scenes/{}/frames/{index}/photograph.jpg{with}", scene.id))
            .await
            .unwrap();
        image::load_from_memory(&bytes).unwrap().into_rgb8()
    };
    let (plain, drawn) = (photograph("").await, photograph("?instances=true").await);
    assert_eq!((plain.width(), plain.height()), (frames.frames[0].width, frames.frames[0].height));
    let changed = plain
        .pixels()
        .zip(drawn.pixels())
        .filter(|(a, b)| a.0.iter().zip(b.0).any(|(a, b)| a.abs_diff(b) > 40))
        .count();
    assert!(
        changed > plain.pixels().len() / 10,
        "instances must be drawn over the photograph ({changed} pixels)"
    );
    let missing = expect_problem(
        server.client.bytes(&format!("v1/scenes/{}/frames/9999/photograph.jpg", scene.id)).await,
    );
    assert_eq!((missing.status, missing.code.as_str()), (404, "frame_not_found"));
    // Lists omit large fields.
    let listed = server.client.scenes(10, None).await.unwrap().scenes.remove(0);
    assert!(listed.settings.is_none() && listed.report.is_none() && listed.counts.is_some());
    assert!(server.client.scene(&scene.id).await.unwrap().settings.is_some());
    server.stop().await;
}

/// A parse of a version that stored no points and thumbnails still shows them.
#[tokio::test]
async fn parses_of_earlier_versions_have_points_and_thumbnails() {
    let server = TestServer::start().await;
    let scene = server.upload_and_parse(Scan::neutral().zip()).await;
    let bytes = async |file: &str| {
        server.client.bytes(&format!("v1/scenes/{}/{file}", scene.id)).await.unwrap()
    };
    let kept = (bytes("points.bin").await, bytes("thumbnail.jpg").await);
    let parse = server.data().join("blobs/parses").join(&server.list_folder("blobs/parses")[0]);
    let sums = std::fs::read_to_string(parse.join(".sha256sums")).unwrap();
    let before: String = sums
        .lines()
        .filter(|line| !line.ends_with("points.bin") && !line.ends_with("thumbnail.jpg"))
        .map(|line| format!("{line}\n"))
        .collect();
    std::fs::write(parse.join(".sha256sums"), before).unwrap();
    for file in ["points.bin", "thumbnail.jpg"] {
        std::fs::remove_file(parse.join(file)).unwrap();
    }
    assert_eq!((bytes("points.bin").await, bytes("thumbnail.jpg").await), kept);
    assert_eq!(bytes("points.bin").await, kept.0);
    server.stop().await;
}
