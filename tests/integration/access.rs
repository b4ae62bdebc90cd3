//! Access to the server: which addresses it may listen on and which routes require a key.

use crate::server::{Process, TestServer, command};
use camino::Utf8Path;
use reqwest::Method;
use std::io::{BufRead, BufReader};
use std::process::Stdio;
use uniground_client::Client;

const KEY: &str = "ug_0123456789abcdef";
/// Routes that need no key.
const PUBLIC: [&str; 2] = ["/healthz", "/readyz"];

#[test]
fn an_open_door_to_the_network_is_refused() {
    let data = tempfile::tempdir().unwrap();
    let refused = command(Utf8Path::from_path(data.path()).unwrap(), "0.0.0.0:0").output().unwrap();
    let message = String::from_utf8_lossy(&refused.stderr);
    assert_eq!(refused.status.code(), Some(1), "{message}");
    assert!(message.contains("UNIGROUND_API_KEY"), "{message}");
}

#[tokio::test]
async fn with_a_key_every_route_but_health_and_the_description_wants_it() {
    let data = tempfile::tempdir().unwrap();
    let mut child = command(Utf8Path::from_path(data.path()).unwrap(), "127.0.0.1:0")
        .env("UNIGROUND_API_KEY", KEY)
        .stdout(Stdio::piped())
        .stderr(Stdio::null())
        .spawn()
        .unwrap();
    let mut line = String::new();
    BufReader::new(child.stdout.take().unwrap()).read_line(&mut line).unwrap();
    let address = line.trim().strip_prefix("listening on ").unwrap().to_owned();
    let (anonymous, known) =
        (Client::new(&address, None).unwrap(), Client::new(&address, Some(KEY.into())).unwrap());
    let wrong = Client::new(&address, Some("ug_something_else".into())).unwrap();

    let openapi: serde_json::Value =
        serde_json::from_slice(&anonymous.bytes("openapi.json").await.unwrap()).unwrap();
    let mut asked = 0;
    for (path, operations) in openapi["paths"].as_object().unwrap() {
        for method in operations.as_object().unwrap().keys() {
            let method: Method = method.to_uppercase().parse().unwrap();
            for client in [&anonymous, &wrong] {
                let response = client
                    .request(method.clone(), path.trim_start_matches('/'))
                    .send()
                    .await
                    .unwrap();
                let expected_open = PUBLIC.contains(&path.as_str());
                assert_eq!(
                    response.status().as_u16() == 401,
                    !expected_open,
                    "{method} {path}: {}",
                    response.status()
                );
                if !expected_open {
                    assert_eq!(response.headers()["www-authenticate"], "Bearer");
                }
            }
            asked += 1;
        }
    }
    assert!(asked >= 15, "only {asked} operations found");
    assert_eq!(known.scenes(1, None).await.unwrap().scenes, []);
    let process = Process { client: known, child };
    assert_eq!(process.terminate(), Some(0));
}

#[tokio::test]
async fn the_documentation_page_needs_nothing_from_outside() {
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
    assert!(server.url().starts_with("http://127.0.0.1:"));
    server.stop().await;
}
