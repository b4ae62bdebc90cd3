//! The OpenAPI description, committed and served, and its documentation page.

use crate::test_server::TestServer;

#[tokio::test]
async fn the_committed_description_equals_the_served_one() {
    let server = TestServer::start().await;
    let served: serde_json::Value =
        serde_json::from_slice(&server.client.bytes("openapi.json").await.unwrap()).unwrap();
    let file = concat!(env!("CARGO_MANIFEST_DIR"), "/openapi/openapi.json");
    let committed: serde_json::Value =
        serde_json::from_slice(&std::fs::read(file).unwrap()).unwrap();
    assert!(
        committed == served,
        "openapi/openapi.json differs from the served description: run `make openapi`"
    );
    server.stop().await;
}

#[test]
fn every_operation_has_a_summary_and_answers_have_all_fields() {
    let openapi = serde_json::to_value(uniground::http::openapi()).unwrap();
    let mut ids = std::collections::BTreeSet::new();
    for (path, operations) in openapi["paths"].as_object().unwrap() {
        for (method, operation) in operations.as_object().unwrap() {
            assert!(
                operation["summary"].as_str().is_some_and(|s| !s.is_empty()),
                "{method} {path} has no summary"
            );
            assert!(
                ids.insert(operation["operationId"].to_string()),
                "{method} {path}: another operation has its id"
            );
        }
    }
    let answer = &openapi["components"]["schemas"]["Answer"]["properties"];
    for field in ["box", "oriented_box", "status", "answer", "candidates", "timings_ms", "models"] {
        assert!(answer.get(field).is_some(), "Answer has no {field}");
    }
    for field in [
        "predicted_id",
        "explanation",
        "candidate_names",
        "target_name_matches",
        "anchor_id",
        "relation_used",
    ] {
        assert!(
            openapi["components"]["schemas"]["SixFields"]["properties"].get(field).is_some(),
            "SixFields has no {field}"
        );
    }
}

#[tokio::test]
async fn the_documentation_page_loads_only_local_files() {
    let server = TestServer::start().await;
    let page = String::from_utf8(server.client.bytes("docs/").await.unwrap()).unwrap();
    assert!(page.contains("swagger-ui"), "{page}");
    let mut loaded = 0;
    for reference in page.split(['"', '\'']).filter(|r| {
        ["js", "css"].contains(&r.rsplit('.').next().unwrap_or_default()) || r.starts_with("http")
    }) {
        assert!(!reference.contains("//"), "the page loads {reference}");
        assert!(
            !server
                .client
                .bytes(&format!("docs/{}", reference.trim_start_matches("./")))
                .await
                .unwrap()
                .is_empty()
        );
        loaded += 1;
    }
    assert!(loaded >= 2, "{page}");
    assert!(server.url().starts_with("http://127.0.0.1:"), "{}", server.url());
    server.stop().await;
}
