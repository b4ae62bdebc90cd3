//! Tools of the Model Context Protocol on the wire. Real clients are tested in `tests/mcp`.

use crate::test_server::{TestServer, assert_contains};
use base64::Engine;
use base64::engine::general_purpose::STANDARD;
use reqwest::{Method, StatusCode, header};
use serde_json::{Value, json};
use std::io::{BufRead, BufReader, Write};
use std::process::{Command, Stdio};
use uniground_client::Client;
use uniground_types::keys::{NewKey, Scope};

async fn send_message(client: &Client, message: &Value) -> (StatusCode, String) {
    let request = client
        .request(Method::POST, "mcp")
        .header(header::ACCEPT, "application/json, text/event-stream");
    let response =
        request.header("mcp-protocol-version", "2025-06-18").json(message).send().await.unwrap();
    (response.status(), response.text().await.unwrap())
}

async fn call_method(client: &Client, method: &str, params: Value) -> Value {
    let (status, text) = send_message(
        client,
        &json!({"jsonrpc": "2.0", "id": 7, "method": method, "params": params}),
    )
    .await;
    let reply: Value = serde_json::from_str(&text).unwrap_or_else(|_| panic!("{status}: {text}"));
    assert!(status == 200 && reply["id"] == 7 && reply["result"].is_object(), "{reply:#}");
    reply["result"].clone()
}

async fn call_tool(client: &Client, tool: &str, arguments: Value) -> Value {
    call_method(client, "tools/call", json!({"name": tool, "arguments": arguments})).await
}

#[tokio::test]
async fn an_agent_grounds_a_target_and_gets_an_approach_pose() {
    let server = TestServer::start().await;
    let scene = server.upload_and_parse(uniground_service::sample::LIVING_ROOM.to_vec()).await;
    let client = &server.client;
    let hello = json!({"protocolVersion": "2025-06-18", "capabilities": {}, "clientInfo": {"name": "test", "version": "1"}});
    let welcome = call_method(client, "initialize", hello).await;
    assert_eq!(
        (&welcome["protocolVersion"], &welcome["serverInfo"]["name"]),
        (&json!("2025-06-18"), &json!("uniground"))
    );
    assert_contains(welcome["instructions"].as_str().unwrap(), "list_scenes");

    let tools = call_method(client, "tools/list", json!({})).await;
    let names: Vec<&str> = tools["tools"]
        .as_array()
        .unwrap()
        .iter()
        .map(|tool| tool["name"].as_str().unwrap())
        .collect();
    assert_eq!(
        names,
        [
            "list_scenes",
            "ground",
            "find_in_scenes",
            "list_objects",
            "get_object",
            "relations",
            "approach",
            "render_view"
        ]
    );
    let text = tools.to_string();
    assert!(!text.contains("#/components/"), "schemas must contain no references");

    let scenes = call_tool(client, "list_scenes", json!({"name": "LIVING"})).await;
    assert_eq!(
        scenes["structuredContent"]["scenes"][0]["scene_id"],
        scene.id.as_str(),
        "{scenes:#}"
    );
    assert_eq!(
        call_tool(client, "list_scenes", json!({"name": "no such"})).await["structuredContent"]["scenes"],
        json!([])
    );
    let answer = call_tool(
        client,
        "ground",
        json!({"scene_id": scene.id, "query": "the mug on the coffee table"}),
    )
    .await;
    let found = &answer["structuredContent"];
    assert_eq!(
        (&found["status"], &answer["isError"]),
        (&json!("uncertain"), &json!(false)),
        "{answer:#}"
    );
    // Clients without structured content get the same as text.
    let as_text: Value =
        serde_json::from_str(answer["content"][0]["text"].as_str().unwrap()).unwrap();
    assert_eq!(&as_text, found);
    let mug = found["targets"][0]["id"].as_u64().unwrap();

    let anywhere =
        call_tool(client, "find_in_scenes", json!({"query": "the mug on the coffee table"})).await;
    let anywhere = &anywhere["structuredContent"];
    assert_eq!(
        (&anywhere["looked_into"], &anywhere["found"][0]["scene_id"]),
        (&json!(1), &json!(scene.id)),
        "{anywhere:#}"
    );
    assert_eq!(anywhere["found"][0]["targets"][0]["id"], mug);
    let elsewhere =
        call_tool(client, "find_in_scenes", json!({"query": "the mug", "labels": {"floor": "9"}}))
            .await;
    assert_eq!(elsewhere["structuredContent"]["found"], json!([]));

    let listed =
        call_tool(client, "list_objects", json!({"scene_id": scene.id, "name": "mug"})).await;
    assert!(
        listed["structuredContent"]["objects"]
            .as_array()
            .unwrap()
            .iter()
            .any(|object| object["instance_id"] == mug),
        "{listed:#}"
    );
    let object =
        call_tool(client, "get_object", json!({"scene_id": scene.id, "instance_id": mug})).await;
    assert_eq!(
        (&object["structuredContent"]["id"], &object["content"][1]["mimeType"]),
        (&json!(mug), &json!("image/jpeg"))
    );
    let relations =
        call_tool(client, "relations", json!({"scene_id": scene.id, "instance_id": mug})).await;
    assert!(relations["content"][0]["text"].as_str().unwrap().contains("table"), "{relations:#}");

    let robot = json!({"radius_m": 0.2, "height_m": 1.3, "eye_height_m": 1.2});
    let stand = call_tool(
        client,
        "approach",
        json!({"scene_id": scene.id, "instance_id": mug, "robot": robot}),
    )
    .await;
    assert_eq!(stand["structuredContent"]["status"], "found", "{stand:#}");
    for arguments in [
        json!({"scene_id": scene.id, "instance_ids": [mug]}),
        json!({"scene_id": scene.id, "instance_ids": [mug], "view": "photograph"}),
        json!({"scene_id": scene.id}),
    ] {
        let view = call_tool(client, "render_view", arguments).await;
        let jpeg = STANDARD.decode(view["content"][0]["data"].as_str().unwrap()).unwrap();
        assert!(image::load_from_memory(&jpeg).unwrap().width() >= 320);
    }

    let resources = call_method(client, "resources/list", json!({})).await;
    let report = resources["resources"]
        .as_array()
        .unwrap()
        .iter()
        .find(|one| one["uri"].as_str().unwrap().ends_with("/report"))
        .unwrap();
    let read = call_method(client, "resources/read", json!({"uri": report["uri"]})).await;
    let report: Value =
        serde_json::from_str(read["contents"][0]["text"].as_str().unwrap()).unwrap();
    assert_eq!(report["scene_id"], scene.id.as_str(), "{report:#}");
    server.stop().await;
}

/// Errors are tool results that tell the model how to call again.
#[tokio::test]
async fn errors_are_returned_to_the_model_as_tool_results() {
    let server = TestServer::start().await;
    let client = &server.client;
    let nobody = "018f0000-0000-7000-8000-000000000000";
    for (tool, arguments, told) in [
        ("ground", json!({"scene_id": nobody, "query": "the sofa"}), "scene_not_found"),
        ("ground", json!({"scene_id": nobody, "query": " "}), "/query"),
        ("ground", json!({"scene_id": nobody}), "missing field `query`"),
        (
            "ground",
            json!({"scene_id": nobody, "query": "x", "observer": {"position": [0, 0]}}),
            "/observer/position",
        ),
        ("ground", json!({"scene_id": nobody, "question": "the sofa"}), "unknown field `question`"),
        (
            "approach",
            json!({"scene_id": nobody, "robot": {"radius_m": 0.2, "height_m": 1, "eye_height_m": 2}, "query": "x"}),
            "eye_height_m",
        ),
        ("render_view", json!({"scene_id": nobody, "view": "photograph"}), "must name an instance"),
    ] {
        let reply = call_tool(client, tool, arguments.clone()).await;
        let text = reply["content"][0]["text"].as_str().unwrap();
        assert!(reply["isError"] == true && text.contains(told), "{tool} {arguments}: {reply:#}");
    }
    // Some models write the arguments as text.
    let written = call_tool(client, "list_scenes", json!("{}")).await;
    assert!(written["isError"] != true, "{written:#}");
    let params = json!({"name": "list_scenes", "arguments": "all of them"});
    let message = json!({"jsonrpc": "2.0", "id": 1, "method": "tools/call", "params": params});
    let (status, text) = send_message(client, &message).await;
    assert!(status == 200 && text.contains("-32602"), "{status} {text}");
    let (status, text) = send_message(
        client,
        &json!({"jsonrpc": "2.0", "id": 1, "method": "tools/call", "params": {"name": "sing"}}),
    )
    .await;
    assert!(status == 200 && text.contains("there is no tool"), "{status} {text}");
    let (_, text) = send_message(
        client,
        &json!({"jsonrpc": "2.0", "id": 1, "method": "resources/read", "params": {"uri": "file:///etc/passwd"}}),
    )
    .await;
    assert!(text.contains("use uniground://scenes/"), "{text}");
    let (status, _) =
        send_message(client, &json!({"jsonrpc": "2.0", "method": "notifications/initialized"}))
            .await;
    assert_eq!(status, StatusCode::ACCEPTED);

    // Errors of the transport are problems, as on other routes.
    let plain = client
        .request(Method::POST, "mcp")
        .json(&json!({"jsonrpc": "2.0", "id": 1, "method": "ping"}))
        .send()
        .await
        .unwrap();
    assert_eq!(plain.status(), StatusCode::NOT_ACCEPTABLE);
    assert_eq!(plain.headers()[header::CONTENT_TYPE], "application/problem+json");
    for body in ["hello", "[]", ""] {
        let request = client
            .request(Method::POST, "mcp")
            .header(header::ACCEPT, "application/json, text/event-stream");
        let refused = request
            .header(header::CONTENT_TYPE, "application/json")
            .body(body)
            .send()
            .await
            .unwrap();
        assert_eq!(refused.status(), StatusCode::BAD_REQUEST, "{body}");
        assert_eq!(refused.json::<Value>().await.unwrap()["code"], "malformed_json");
    }
    let cursor = call_tool(client, "list_scenes", json!({"cursor": "x"})).await;
    assert!(
        cursor["isError"] == true
            && cursor["content"][0]["text"].as_str().unwrap().contains("next_cursor"),
        "{cursor:#}"
    );
    let get = client
        .request(Method::GET, "mcp")
        .header(header::ACCEPT, "text/event-stream")
        .send()
        .await
        .unwrap();
    assert_eq!(get.status(), StatusCode::METHOD_NOT_ALLOWED);
    server.stop().await;
}

#[tokio::test]
async fn keys_are_required_and_foreign_origins_are_refused() {
    let server = TestServer::start().await;
    let ping = json!({"jsonrpc": "2.0", "id": 1, "method": "tools/list"});
    let foreign = server
        .client
        .request(Method::POST, "mcp")
        .header(header::ORIGIN, "https://evil.example")
        .header("sec-fetch-site", "cross-site");
    let foreign = foreign
        .header(header::ACCEPT, "application/json, text/event-stream")
        .json(&ping)
        .send()
        .await
        .unwrap();
    assert_eq!(foreign.status(), StatusCode::FORBIDDEN);
    let new = NewKey {
        name: "agent".into(),
        scope: Scope::Read,
        expires_at: None,
        requests_per_minute: None,
        max_scenes: None,
        daily_usd: None,
    };
    let key = server.client.create_key(&new).await.unwrap();
    assert_eq!(send_message(&server.client, &ping).await.0, StatusCode::UNAUTHORIZED);
    let agent = Client::new(&server.url(), Some(key.secret)).unwrap();
    assert_eq!(send_message(&agent, &ping).await.0, StatusCode::OK);
    server.stop().await;
}

/// Stdout carries only protocol messages, and the program ends when its stdin closes.
#[test]
fn the_stdio_transport_serves_a_data_folder() {
    let data = tempfile::tempdir().unwrap();
    let mut program = Command::new(env!("CARGO_BIN_EXE_uniground"));
    program
        .args(["mcp", "--masks", "builtin", "--encoder", "builtin", "--data-dir"])
        .arg(data.path());
    let mut program = program
        .stdin(Stdio::piped())
        .stdout(Stdio::piped())
        .stderr(Stdio::piped())
        .spawn()
        .unwrap();
    let mut stdin = program.stdin.take().unwrap();
    let mut lines = BufReader::new(program.stdout.take().unwrap()).lines();
    let hello = json!({"protocolVersion": "2025-11-25", "capabilities": {}, "clientInfo": {"name": "test", "version": "1"}});
    let mut say = |message: Value| writeln!(stdin, "{message}").unwrap();
    say(json!({"jsonrpc": "2.0", "id": 1, "method": "initialize", "params": hello}));
    let welcome: Value = serde_json::from_str(&lines.next().unwrap().unwrap()).unwrap();
    assert_eq!(welcome["result"]["protocolVersion"], "2025-11-25");
    say(json!({"jsonrpc": "2.0", "method": "notifications/initialized"}));
    say(
        json!({"jsonrpc": "2.0", "id": 2, "method": "tools/call", "params": {"name": "list_scenes", "arguments": {}}}),
    );
    let scenes: Value = serde_json::from_str(&lines.next().unwrap().unwrap()).unwrap();
    assert_eq!(scenes["result"]["structuredContent"], json!({"scenes": [], "next_cursor": null}));
    drop(stdin);
    assert!(lines.next().is_none() && program.wait().unwrap().success());
}
