//! The committed OpenAPI description equals the served one.

use crate::server::TestServer;

#[tokio::test]
async fn openapi_json_equals_what_the_server_serves() {
    let server = TestServer::start().await;
    let served: serde_json::Value =
        serde_json::from_slice(&server.client.bytes("openapi.json").await.unwrap()).unwrap();
    let file = concat!(env!("CARGO_MANIFEST_DIR"), "/openapi/openapi.json");
    let committed: serde_json::Value =
        serde_json::from_slice(&std::fs::read(file).unwrap()).unwrap();
    assert!(
        committed == served,
        "openapi/openapi.json is not what the server serves: run `make openapi`"
    );
    server.stop().await;
}

#[test]
fn every_operation_and_field_says_what_it_is() {
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
