//! Invalid requests: each is answered with a problem, and the server keeps serving.

use crate::test_scans::Scan;
use crate::test_server::{TestServer, ask, expect_problem, post_raw};
use reqwest::Method;
use serde_json::Value;
use std::io::Write;
use uniground_types::placement::SceneToMap;
use uniground_types::problem::Problem;
use uniground_types::scenes::SceneChange;

#[tokio::test]
async fn invalid_questions_name_the_field() {
    let server = TestServer::start().await;
    let scene = server.upload_and_parse(Scan::neutral().zip()).await;
    let path = format!("v1/scenes/{}/ground", scene.id);
    let long = format!(r#"{{"query": "{}"}}"#, "x".repeat(10_000));
    for (body, status, code, pointer) in [
        ("{", 400, "malformed_json", None),
        ("", 400, "malformed_json", None),
        (r#"{"query": "a"} trailing"#, 400, "malformed_json", None),
        ("[]", 422, "invalid_request", Some("")),
        ("{}", 422, "invalid_request", Some("")),
        (r#"{"query": ""}"#, 422, "invalid_request", Some("/query")),
        (r#"{"query": "   "}"#, 422, "invalid_request", Some("/query")),
        (&long, 422, "invalid_request", Some("/query")),
        (r#"{"query": 7}"#, 422, "invalid_request", Some("/query")),
        (r#"{"query": "the sofa", "top_k": 0}"#, 422, "invalid_request", Some("/top_k")),
        (r#"{"query": "the sofa", "top_k": 1000000}"#, 422, "invalid_request", Some("/top_k")),
        (r#"{"query": "the sofa", "top_k": -1}"#, 422, "invalid_request", Some("/top_k")),
        (r#"{"query": "the sofa", "top-k": 1}"#, 422, "invalid_request", Some("/top-k")),
        (
            r#"{"query": "the sofa", "reasoner": "oracle"}"#,
            422,
            "invalid_request",
            Some("/reasoner"),
        ),
        (
            r#"{"query": "the sofa", "observer": {"position": [0, 0], "yaw_rad": 0}}"#,
            422,
            "invalid_request",
            Some("/observer/position"),
        ),
        (r#"{"query": "the sofa", "timeout_s": 0}"#, 422, "invalid_request", Some("/timeout_s")),
        (
            r#"{"query": "the sofa", "max_cost_usd": -1}"#,
            422,
            "invalid_request",
            Some("/max_cost_usd"),
        ),
        (r#"{"query": "the sofa", "reasoner": "vlm"}"#, 409, "vlm_not_configured", None),
    ] {
        let refusal = post_raw(&server.client, &path, "application/json", body).await;
        let shown = &body[..body.len().min(80)];
        assert_eq!(
            (refusal.status, refusal.code.as_str()),
            (status, code),
            "{shown}: {}",
            refusal.detail
        );
        if let Some(pointer) = pointer {
            assert_eq!(refusal.errors[0].pointer, pointer, "{shown}: {}", refusal.detail);
        }
    }
    let form =
        post_raw(&server.client, &path, "application/x-www-form-urlencoded", "query=sofa").await;
    assert_eq!((form.status, form.code.as_str()), (415, "unsupported_media_type"));
    let gzip = |text: &str| {
        let mut gzip = flate2::write::GzEncoder::new(Vec::new(), flate2::Compression::fast());
        gzip.write_all(text.as_bytes()).unwrap();
        gzip.finish().unwrap()
    };
    let encoded = async |encoding: &str, body: Vec<u8>| {
        let request = server.client.request(Method::POST, &path);
        let request = request.header("content-type", "application/json");
        let response = request.header("content-encoding", encoding).body(body).send().await;
        let response = response.unwrap();
        (response.status().as_u16(), response.json::<Value>().await.unwrap())
    };
    let (status, answer) = encoded("gzip", gzip(r#"{"query": "the sofa"}"#)).await;
    assert_eq!((status, &answer["query"]), (200, &Value::from("the sofa")));
    let bomb = gzip(&" ".repeat(8 << 20));
    assert!(bomb.len() < 1 << 20);
    for (encoding, body, status, code) in [
        ("gzip", bomb, 413, "body_too_large"),
        ("gzip", b"{}".to_vec(), 400, "malformed_json"),
        ("br", b"{}".to_vec(), 415, "unsupported_media_type"),
    ] {
        let (told, problem) = encoded(encoding, body).await;
        assert_eq!((told, &problem["code"]), (status, &Value::from(code)), "{problem}");
    }
    // Unusual words are valid questions.
    for query in [
        "🛋️🛋️🛋️",
        "'; DROP TABLE scenes; --",
        "the the of of",
        "ソファはどこ",
        "the sofa left of left of the sofa not not",
    ] {
        server.client.ground(&scene.id, &ask(query)).await.unwrap();
    }
    server.stop().await;
}

#[tokio::test]
async fn unknown_ids_and_routes_are_not_found() {
    let server = TestServer::start().await;
    let scene = server.upload_and_parse(Scan::neutral().zip()).await;
    let nobody = "018f0000-0000-7000-8000-000000000000";
    for (path, code) in [
        (format!("v1/scenes/{nobody}"), "scene_not_found"),
        ("v1/scenes/not-an-id".into(), "scene_not_found"),
        (format!("v1/scenes/{nobody}/instances"), "scene_not_found"),
        (format!("v1/scenes/{}/instances/9999", scene.id), "instance_not_found"),
        (format!("v1/scenes/{}/instances/0", scene.id), "instance_not_found"),
        (format!("v1/scenes/{}/instances/first", scene.id), "not_found"),
        (format!("v1/scenes/{}/instances/1/views/99.jpg", scene.id), "view_not_found"),
        (format!("v1/scenes/{}/instances/1/views/0.gif", scene.id), "view_not_found"),
        (format!("v1/jobs/{nobody}"), "job_not_found"),
        (format!("v1/jobs/{nobody}/events"), "job_not_found"),
        (format!("v1/answers/{nobody}"), "answer_not_found"),
        (format!("v1/answers/{nobody}/evidence/global.jpg"), "answer_not_found"),
        ("v1/rooms".into(), "no_such_route"),
    ] {
        let refusal = expect_problem(server.client.bytes(&path).await);
        assert_eq!(
            (refusal.status, refusal.code.as_str()),
            (404, code),
            "{path}: {}",
            refusal.detail
        );
    }
    assert_eq!(expect_problem(server.client.cancel_job(nobody).await).code, "job_not_found");
    assert_eq!(
        expect_problem(server.client.ground(nobody, &ask("the sofa")).await).code,
        "scene_not_found"
    );
    server.stop().await;
}

#[tokio::test]
async fn invalid_methods_parameters_and_settings_are_problems() {
    let server = TestServer::start().await;
    let scene = server.upload_and_parse(Scan::neutral().zip()).await;
    let response = server.client.request(Method::PUT, "v1/scenes").send().await.unwrap();
    assert_eq!(
        (
            response.status().as_u16(),
            response.headers()["allow"].to_str().unwrap().contains("POST")
        ),
        (405, true)
    );
    assert_eq!(response.headers()["content-type"], "application/problem+json");

    for path in ["v1/scenes?limit=0", "v1/scenes?limit=many", "v1/scenes?size=3"] {
        let refusal = expect_problem(server.client.bytes(path).await);
        assert_eq!(
            (refusal.status, refusal.code.as_str()),
            (422, "invalid_request"),
            "{path}: {}",
            refusal.detail
        );
    }
    let parse = format!("v1/scenes/{}/parse", scene.id);
    for (body, pointer) in [
        (
            r#"{"settings": {"parsing": {"merging": {"thresholds": []}}}}"#,
            "/settings/parsing/merging/thresholds",
        ),
        (
            r#"{"settings": {"parsing": {"merging": {"threshold": 1}}}}"#,
            "/settings/parsing/merging/threshold",
        ),
        (r#"{"preset": "fancy"}"#, "/preset"),
    ] {
        let refusal = post_raw(&server.client, &parse, "application/json", body).await;
        assert_eq!(
            (refusal.status, refusal.errors[0].pointer.as_str()),
            (422, pointer),
            "{}",
            refusal.detail
        );
    }
    assert_eq!(
        expect_problem(server.client.rename_scene(&scene.id, " ").await).errors[0].pointer,
        "/name"
    );
    server.stop().await;
}

/// Query parsers accept `NaN` and `inf` as numbers, and a large JSON number becomes an infinite
/// `f32`.
#[tokio::test]
async fn non_finite_numbers_are_refused_by_field() {
    let server = TestServer::start().await;
    let scene = server.upload_and_parse(Scan::neutral().zip()).await;
    for word in ["NaN", "nan", "inf", "-inf", "infinity", "1e999", "-1"] {
        for (method, path, pointer) in [
            (Method::POST, format!("v1/scenes?metres_per_unit={word}"), "metres_per_unit"),
            (Method::POST, format!("v1/batches?max_cost_usd={word}"), "/max_cost_usd"),
            (Method::GET, format!("v1/scenes/{}/floor?height_m={word}", scene.id), "height_m"),
            (Method::GET, format!("v1/scenes/{}/floor.png?height_m={word}", scene.id), "height_m"),
        ] {
            let request = server
                .client
                .request(method, &path)
                .header("content-type", "application/jsonl")
                .body("{}");
            let refusal: Problem = request.send().await.unwrap().json().await.unwrap();
            assert_eq!(
                (refusal.status, refusal.errors[0].pointer.as_str()),
                (422, pointer),
                "{path}: {}",
                refusal.detail
            );
        }
    }
    for metres in ["0", "0.0000001", "1e7"] {
        let path = format!("v1/scenes?metres_per_unit={metres}");
        let refusal = post_raw(&server.client, &path, "application/zip", "PK").await;
        assert_eq!(
            (refusal.status, refusal.errors[0].pointer.as_str()),
            (422, "metres_per_unit"),
            "{}",
            refusal.detail
        );
    }
    let (scene, robot) = (&scene.id, r#""radius_m": 0.25, "height_m": 1.3, "eye_height_m": 1.2"#);
    for (path, body, pointer) in [
        ("ground", r#"{"query": "a", "min_confidence": 1e39}"#.to_owned(), "/min_confidence"),
        ("ground", r#"{"query": "a", "timeout_s": 1e39}"#.into(), "/timeout_s"),
        (
            "ground",
            r#"{"query": "a", "observer": {"position": [0, 0, 1e10], "yaw_rad": 0}}"#.into(),
            "/observer/position",
        ),
        (
            "ground",
            r#"{"query": "a", "observer": {"position": [0, 0, 0], "yaw_rad": 1e39}}"#.into(),
            "/observer/yaw_rad",
        ),
        (
            "approach",
            format!(
                r#"{{"instance_id": 1, "robot": {{{robot}}}, "from": {{"x": 1e300, "y": 0}}}}"#
            ),
            "/from",
        ),
        (
            "approach",
            format!(r#"{{"instance_id": 1, "robot": {{{robot}}}, "max_distance_m": 1e39}}"#),
            "/max_distance_m",
        ),
        (
            "parse",
            r#"{"settings": {"import": {"metres_per_unit": 1e300}}}"#.into(),
            "/settings/import/metres_per_unit",
        ),
    ] {
        let refusal = post_raw(
            &server.client,
            &format!("v1/scenes/{scene}/{path}"),
            "application/json",
            &body,
        )
        .await;
        assert_eq!(
            (refusal.status, refusal.errors[0].pointer.as_str()),
            (422, pointer),
            "{body}: {}",
            refusal.detail
        );
    }
    let place = SceneToMap { rotation: [0.0, 0.0, 0.0, 1.0], translation_m: [1e300, 0.0, 0.0] };
    let change = SceneChange { scene_to_map: Some(Some(place)), ..SceneChange::default() };
    assert_eq!(
        expect_problem(server.client.change_scene(scene, &change).await).errors[0].pointer,
        "/scene_to_map/translation_m"
    );
    server.stop().await;
}

/// Checks every route that takes an idempotency key, by the OpenAPI description.
#[tokio::test]
async fn an_invalid_idempotency_key_is_refused() {
    let server = TestServer::start().await;
    let description: Value =
        serde_json::from_slice(&server.client.bytes("openapi.json").await.unwrap()).unwrap();
    let mut routes = 0;
    for (path, operations) in description["paths"].as_object().unwrap() {
        let takes_key = |operation: &Value| {
            operation["parameters"]
                .as_array()
                .is_some_and(|all| all.iter().any(|p| p["name"] == "Idempotency-Key"))
        };
        if !takes_key(&operations["post"]) {
            continue;
        }
        routes += 1;
        let path = path
            .trim_start_matches('/')
            .replace("{scene_id}", "018f0000-0000-7000-8000-000000000000");
        for key in [String::new(), "k".repeat(256), "k".repeat(60_000)] {
            let request =
                server.client.request(Method::POST, &path).header("idempotency-key", &key);
            let request =
                request.header("tus-resumable", "1.0.0").header("content-type", "application/json");
            let refusal: Problem = request
                .header("upload-length", "7")
                .body("{}")
                .send()
                .await
                .unwrap()
                .json()
                .await
                .unwrap();
            let named = refusal.errors.first().map(|error| error.pointer.as_str());
            assert_eq!(
                (refusal.status, named),
                (422, Some("Idempotency-Key")),
                "{path}, {} bytes: {}",
                key.len(),
                refusal.detail
            );
        }
    }
    assert!(routes >= 6, "only {routes} routes found");
    server.stop().await;
}

/// Cursors are accepted only in the form in which they are returned: braces or capitals would
/// compare as different texts.
#[tokio::test]
async fn an_invalid_cursor_is_refused() {
    let server = TestServer::start().await;
    let id = "01a1ff70-0000-7000-8000-00000000000a";
    for list in ["v1/scenes", "v1/answers", "v1/jobs", "v1/batches", "v1/keys", "v1/audit"] {
        for cursor in [
            "%7B%7D".into(),
            format!("%7B{id}%7D"),
            id.to_uppercase(),
            format!("urn:uuid:{id}"),
            "x".into(),
            String::new(),
        ] {
            let refusal =
                expect_problem(server.client.bytes(&format!("{list}?cursor={cursor}")).await);
            assert_eq!(
                (refusal.status, refusal.errors[0].pointer.as_str()),
                (422, "cursor"),
                "{list} {cursor:?}"
            );
        }
        assert!(server.client.bytes(&format!("{list}?cursor={id}")).await.is_ok(), "{list}");
    }
    server.stop().await;
}

#[tokio::test]
async fn every_response_carries_its_request_id() {
    let server = TestServer::start().await;
    for path in ["healthz", "readyz", "openapi.json", "docs/", "v1/scenes", "v1/nowhere"] {
        let response = server.client.request(Method::GET, path).send().await.unwrap();
        assert!(response.headers().contains_key("x-request-id"), "{path}");
    }
    let named = server
        .client
        .request(Method::GET, "v1/nowhere")
        .header("x-request-id", "my-own-id")
        .send()
        .await
        .unwrap();
    assert_eq!(named.headers()["x-request-id"], "my-own-id");
    assert_eq!(named.json::<serde_json::Value>().await.unwrap()["request_id"], "my-own-id");
    server.stop().await;
}
