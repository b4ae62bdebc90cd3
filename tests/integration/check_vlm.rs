//! `uniground models check-vlm` and `serve --vlm-check` against models with each weakness.

use crate::scripted_model::{Script, Scripted, fails, says};
use crate::test_server::{Process, serve_command};
use crate::vlm::six_field_reply;
use camino::Utf8Path;
use serde_json::json;
use std::fs::{self, File};
use std::process::{Command, Output};

fn pictures(number: &str, left: &str, right: &str, green: &str) -> Scripted {
    says(&format!("Number: {number}\nLeft: {left}\nRight: {right}\nGreen: {green}"))
}

fn decision() -> Scripted {
    six_field_reply("none", "1 -> a mug", false, 1)
}

/// Runs the check against a model with these replies. The last one is repeated.
async fn check(replies: Vec<Scripted>, arguments: &[&str]) -> (bool, String, String) {
    let url = Script::default().serve(replies).await;
    check_at(&url, arguments).await
}

async fn check_at(url: &str, arguments: &[&str]) -> (bool, String, String) {
    let mut program = Command::new(env!("CARGO_BIN_EXE_uniground"));
    program
        .args(["models", "check-vlm", "--vlm-url", url, "--vlm-model", "scripted"])
        .args(["--vlm-attempts", "1"])
        .args(arguments)
        .env_remove("UNIGROUND_VLM_API_KEY");
    let output = tokio::task::spawn_blocking(move || program.output()).await.unwrap().unwrap();
    let Output { status, stdout, stderr } = output;
    let text = |bytes| String::from_utf8(bytes).unwrap();
    (status.success(), text(stdout), text(stderr))
}

#[tokio::test(flavor = "multi_thread")]
async fn a_good_model_passes_and_its_costs_are_told() {
    let good = pictures("47", "red", "blue", "720, 300");
    let prices = ["--vlm-prompt-usd", "2", "--vlm-completion-usd", "8", "--questions", "200"];
    let (ok, out, err) = check(vec![good.clone(), decision()], &prices).await;
    assert!(ok, "{out}{err}");
    for expected in [
        "reachable: yes",
        "sees pictures: yes",
        "reads numbers: yes",
        "tells left from right: yes",
        "points at places: yes. It points in thousandths",
        "keeps to the six fields: yes",
        "A question took",
        "200 questions a day: ",
        "US dollars",
    ] {
        assert!(out.contains(expected), "{expected}: {out}");
    }
    let (ok, out, _) = check(vec![good, decision()], &["--json"]).await;
    let findings: serde_json::Value = serde_json::from_str(&out).unwrap();
    assert!(ok && findings.as_array().unwrap().iter().all(|f| f["is_right"] == true), "{out}");
}

#[tokio::test(flavor = "multi_thread")]
async fn each_weakness_is_named_with_what_to_do() {
    let good = || pictures("47", "red", "blue", "720, 300");
    let filter = json!({"choices": [{"message": {"content": null, "refusal": "I cannot look at images."}, "finish_reason": "stop"}]});
    let cases: [(Vec<Scripted>, &str); 8] = [
        (
            vec![says("I am a text model."), decision()],
            "sees pictures: NO. It describes none of them",
        ),
        (
            vec![pictures("74", "red", "blue", "720, 300"), decision()],
            "reads numbers: NO. The tag says 47",
        ),
        (vec![pictures("47", "blue", "red", "720, 300"), decision()], "It swaps them"),
        (vec![pictures("47", "red", "blue", "648, 135"), decision()], "It points in pixels"),
        (
            vec![says("Number: 47\nLeft: red"), decision()],
            "keeps to a format: NO. It left out Right, Green",
        ),
        (
            vec![fails(400, "this model does not support image input")],
            "does not support image input",
        ),
        (vec![Scripted::Json(200, filter)], "I cannot look at images."),
        (vec![good(), says("It is the mug.")], "keeps to the six fields: NO"),
    ];
    for (replies, expected) in cases {
        let (ok, out, err) = check(replies, &[]).await;
        assert!(!ok && out.contains(expected), "{expected}: {out}{err}");
        assert!(err.contains("failed"), "{err}");
    }
    let (ok, out, _) = check_at("http://127.0.0.1:9/v1", &[]).await;
    assert!(!ok && out.contains("reachable: NO") && out.contains("Is the server running"), "{out}");
    let unset = Command::new(env!("CARGO_BIN_EXE_uniground"))
        .args(["models", "check-vlm"])
        .env_remove("UNIGROUND_VLM_URL")
        .output()
        .unwrap();
    assert!(String::from_utf8(unset.stderr).unwrap().contains("--vlm-url"));
}

/// A server warns of what its model gets wrong, and starts all the same.
#[tokio::test(flavor = "multi_thread")]
async fn a_server_checks_its_model_at_startup_on_request() {
    let url = Script::default().serve(vec![pictures("47", "blue", "red", "720, 300")]).await;
    let folder = tempfile::tempdir().unwrap();
    let work = Utf8Path::from_path(folder.path()).unwrap();
    let log = work.join("log");
    let mut command = serve_command(&work.join("data"), "127.0.0.1:0");
    command
        .args(["--vlm-url", &url, "--vlm-model", "scripted", "--vlm-check"])
        .env_remove("RUST_LOG")
        .stderr(File::create(&log).unwrap());
    let process = Process::spawn(&mut command);
    let expected = "vision-language model: tells left from right: NO. It swaps them";
    for _ in 0..100 {
        if fs::read_to_string(&log).unwrap().contains(expected) {
            break;
        }
        tokio::time::sleep(std::time::Duration::from_millis(100)).await;
    }
    let told = fs::read_to_string(&log).unwrap();
    assert!(told.contains(expected) && told.contains("reads numbers: yes"), "{told}");
    process.kill();
}
