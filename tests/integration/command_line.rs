//! The command line: questions without a server, scenes by name, and errors that say what to do.

use crate::scripted_model::{Script, fails};
use crate::test_scans::Scan;
use crate::test_server::TestServer;
use camino::{Utf8Path, Utf8PathBuf};
use serde_json::Value;
use std::fs;
use std::process::{Command, Output};
use uniground::config::{LimitsConfig, VlmConfig};

const ROOM: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/examples/living_room.zip");
/// All subcommands of the program.
const SUBCOMMANDS: [&str; 18] = [
    "serve",
    "demo",
    "ground",
    "upload",
    "scenes",
    "batch",
    "key",
    "import",
    "parse",
    "eval",
    "models",
    "doctor",
    "gc",
    "backup",
    "restore",
    "openapi",
    "completions",
    "man",
];

/// A working directory with an isolated home and environment.
struct WorkDir(tempfile::TempDir);

impl WorkDir {
    fn new() -> Self {
        Self(tempfile::tempdir().unwrap())
    }

    fn path(&self) -> &Utf8Path {
        Utf8Path::from_path(self.0.path()).unwrap()
    }

    fn put(&self, name: &str, content: &[u8]) -> Utf8PathBuf {
        let path = self.path().join(name);
        fs::write(&path, content).unwrap();
        path
    }

    fn program(&self, args: &[&str]) -> Command {
        let mut program = Command::new(env!("CARGO_BIN_EXE_uniground"));
        program
            .args(args)
            .current_dir(self.path())
            .env("XDG_CACHE_HOME", self.path().join("cache"));
        ["UNIGROUND_SERVER", "UNIGROUND_API_KEY", "RUST_LOG"].iter().for_each(|name| {
            program.env_remove(name);
        });
        program
    }

    fn run(&self, args: &[&str]) -> Output {
        self.program(args).output().unwrap()
    }

    /// Runs the program off the async threads, because the server in this process has to answer it.
    async fn ask(&self, args: &[&str]) -> Output {
        let mut program = self.program(args);
        tokio::task::spawn_blocking(move || program.output()).await.unwrap().unwrap()
    }
}

fn stdout_text(output: &Output) -> String {
    String::from_utf8(output.stdout.clone()).unwrap()
}

fn stderr_text(output: &Output) -> String {
    String::from_utf8(output.stderr.clone()).unwrap()
}

#[track_caller]
fn stdout_json(output: &Output) -> Value {
    assert!(output.status.success(), "{}", stderr_text(output));
    serde_json::from_slice(&output.stdout).unwrap()
}

#[test]
fn a_local_scan_is_queried_without_a_server_and_parsed_once() {
    let dir = WorkDir::new();
    let ask = |question: &str| dir.run(&["ground", ROOM, question, "--json"]);
    let first = ask("the mug on the coffee table");
    let answer = stdout_json(&first);
    assert_eq!(
        (&answer["status"], &answer["answer"]["relation_used"]),
        (&"uncertain".into(), &"on the coffee table".into())
    );
    assert!(answer["box"]["center"].is_array() && answer.get("evidence").is_none(), "{answer}");
    assert!(stderr_text(&first).contains("parsed in "), "{}", stderr_text(&first));
    let again = ask("the orange stool");
    assert_eq!(stdout_json(&again)["scene_id"], answer["scene_id"]);
    assert_eq!(stderr_text(&again), "", "the second run must not parse again");
    assert!(dir.path().join("cache/uniground/blobs/parses").is_dir());
}

#[test]
fn local_folders_and_clouds_can_be_queried() {
    let dir = WorkDir::new();
    let room = dir.path().join("my room");
    for (name, content) in &Scan::neutral().0 {
        let path = room.join(name);
        fs::create_dir_all(path.parent().unwrap()).unwrap();
        fs::write(path, content).unwrap();
    }
    let first =
        dir.run(&["ground", "my room", "the red sofa", "--cache", "kept", "--observer=-2,0,90"]);
    assert!(
        first.status.success() && stdout_text(&first).contains("uncertain"),
        "{}{}",
        stdout_text(&first),
        stderr_text(&first)
    );
    assert!(stderr_text(&first).contains("cached in kept"), "{}", stderr_text(&first));
    let again = stdout_json(&dir.run(&[
        "ground",
        "my room",
        "the red sofa",
        "--cache",
        "kept",
        "--observer=-2,0,90",
        "--json",
    ]));
    assert_eq!(again["direction_convention"], "observer");
    let cloud = dir.put("hall.ply", &Scan::cloud_only().0["cloud.ply"]);
    let answer = stdout_json(&dir.run(&[
        "ground",
        cloud.as_str(),
        "the red sofa",
        "--up",
        "z",
        "--cache",
        "kept",
        "--frame",
        "source",
        "--json",
    ]));
    assert_eq!(answer["in_frame"]["frame"], "source");
}

#[test]
fn conflicting_options_are_usage_errors() {
    let dir = WorkDir::new();
    let room = dir.put("room.zip", &Scan::neutral().zip());
    let cases: [(&[&str], &str); 8] = [
        (&["ground"], "<QUESTION>"),
        (&["ground", "the mug"], "ground SCAN QUESTION"),
        (&["ground", "room.zip"], "the question is missing"),
        (&["ground", "room.zip", "the mug", "--scene", "hall"], "cannot be used with"),
        (
            &["ground", "room.zip", "the mug", "--server", "http://127.0.0.1:9"],
            "uniground upload SCAN",
        ),
        (&["ground", "the mug", "--scene", "hall", "--observer", "1,2"], "x,y,yaw"),
        (&["ground", "the mug", "--scene", "hall", "--cache", "kept"], "cannot be used with"),
        (&["ground", "room.zip", "the mug", "--frame", "map"], "--frame map cannot be used"),
    ];
    for (args, told) in cases {
        let refused = dir.run(args);
        assert_eq!(refused.status.code(), Some(2), "{args:?}: {}", stderr_text(&refused));
        assert!(stderr_text(&refused).contains(told), "{args:?}: {}", stderr_text(&refused));
    }
    assert!(
        room.exists() && !dir.path().join("cache").exists(),
        "a usage error must not start anything"
    );
}

#[tokio::test(flavor = "multi_thread")]
async fn a_scene_can_be_uploaded_listed_and_queried_by_name() {
    let (server, dir) = (TestServer::start().await, WorkDir::new());
    let url = server.url();
    dir.put("Living Room.zip", &Scan::neutral().zip());
    let none = dir.ask(&["scenes", "--server", &url]).await;
    assert!(
        none.status.success()
            && stdout_text(&none).is_empty()
            && stderr_text(&none).contains("uniground upload SCAN"),
        "{}",
        stderr_text(&none)
    );
    let uploaded = dir.ask(&["upload", "Living Room.zip", "--server", &url]).await;
    assert!(uploaded.status.success(), "{}", stderr_text(&uploaded));
    let id = stdout_text(&uploaded).trim().to_owned();
    let next = format!("uniground ground --scene 'Living Room' --server {url} ");
    assert!(
        stderr_text(&uploaded).contains("parsed in ") && stderr_text(&uploaded).contains(&next),
        "{}",
        stderr_text(&uploaded)
    );
    let listed = stdout_text(&dir.ask(&["scenes", "--server", &url]).await);
    assert!(
        listed.contains(&id) && listed.contains("Living Room") && listed.contains("ready"),
        "{listed}"
    );
    let listed = stdout_json(&dir.ask(&["scenes", "--server", &url, "--json"]).await);
    assert_eq!((&listed[0]["id"], &listed[0]["name"]), (&id.clone().into(), &"Living Room".into()));
    for scene in ["Living Room", "living", &id, &id[..14]] {
        let answer = stdout_json(
            &dir.ask(&["ground", "--scene", scene, "the red sofa", "--server", &url, "--json"])
                .await,
        );
        assert_eq!(
            (&answer["scene_id"], &answer["status"]),
            (&id.clone().into(), &"uncertain".into()),
            "{scene}"
        );
    }
    let questions = dir.put("questions.txt", b"the red sofa\n");
    let batch = dir
        .ask(&[
            "batch",
            "run",
            questions.as_str(),
            "--scene",
            "living",
            "--out",
            "answers",
            "--json",
            "--server",
            &url,
        ])
        .await;
    assert_eq!(stdout_json(&batch)["done"], 1);
    server.stop().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn an_unknown_or_ambiguous_scene_name_lists_the_candidates() {
    let (server, dir) = (TestServer::start().await, WorkDir::new());
    let url = server.url();
    let scan = dir.put("hall.zip", &Scan::neutral().zip());
    let mut ids = Vec::new();
    for name in ["hall downstairs", "hall upstairs", "kitchen"] {
        let uploaded = stdout_json(
            &dir.ask(&["upload", scan.as_str(), "--name", name, "--server", &url, "--json"]).await,
        );
        ids.push(uploaded["id"].as_str().unwrap().to_owned());
    }
    let ask = async |scene: &str| {
        let refused = dir.ask(&["ground", "--scene", scene, "the sofa", "--server", &url]).await;
        assert_eq!(refused.status.code(), Some(1));
        stderr_text(&refused)
    };
    let several = ask("hall").await;
    assert!(
        several.contains("matches 2 scenes")
            && several.contains(&ids[0])
            && several.contains(&ids[1]),
        "{several}"
    );
    assert!(!several.contains("kitchen") && several.contains("`uniground scenes`"), "{several}");
    for unknown in ["cellar", "018f0000-0000-7000-8000-000000000000"] {
        let told = ask(unknown).await;
        assert!(
            told.contains("there is no scene") && told.contains("`uniground scenes`"),
            "{told}"
        );
        assert!(ids.iter().all(|id| told.contains(id)) && told.contains("kitchen"), "{told}");
    }
    server.stop().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn uploads_return_at_once_unless_wait_is_given() {
    let (server, dir) = (TestServer::start().await, WorkDir::new());
    let url = server.url();
    let uploaded = dir.ask(&["upload", ROOM, "--no-wait", "--server", &url]).await;
    assert!(
        uploaded.status.success()
            && stderr_text(&uploaded).contains("--scene living_room")
            && stderr_text(&uploaded).contains("--wait"),
        "{}",
        stderr_text(&uploaded)
    );
    let early =
        dir.ask(&["ground", "--scene", "living_room", "the orange stool", "--server", &url]).await;
    assert!(
        !early.status.success() && stderr_text(&early).contains("--wait waits"),
        "{}",
        stderr_text(&early)
    );
    let waited = dir
        .ask(&[
            "ground",
            "--scene",
            "living_room",
            "the orange stool",
            "--server",
            &url,
            "--wait",
            "--json",
        ])
        .await;
    assert_eq!(stdout_json(&waited)["status"], "uncertain");
    server.stop().await;
}

/// Every common error ends with what to do.
#[tokio::test(flavor = "multi_thread")]
async fn errors_end_with_what_to_do() {
    let dir = WorkDir::new();
    let away = dir.ask(&["scenes", "--server", "http://user:password@127.0.0.1:9"]).await;
    assert_eq!(away.status.code(), Some(1));
    assert!(
        stderr_text(&away)
            .starts_with("uniground: cannot connect to the server at http://127.0.0.1:9: "),
        "{}",
        stderr_text(&away)
    );
    assert!(
        stderr_text(&away).contains("`uniground serve`")
            && stderr_text(&away).contains("--server, or UNIGROUND_SERVER"),
        "{}",
        stderr_text(&away)
    );
    assert!(!stderr_text(&away).contains("password"), "{}", stderr_text(&away));

    let server = TestServer::start().await;
    let url = server.url();
    dir.put("notes.zip", b"these are notes");
    dir.put("broken.zip", &Scan::neutral().without("pose/3.txt").zip());
    for (scan, told) in [("notes.zip", "archive_unreadable"), ("broken.zip", "pose/3.txt")] {
        for args in [&["upload", scan, "--server", &url][..], &["ground", scan, "the sofa"]] {
            let refused = dir.ask(args).await;
            assert_eq!(refused.status.code(), Some(1), "{args:?}");
            let help = format!("`uniground import {scan} --check`");
            assert!(
                stderr_text(&refused).contains(told)
                    && stderr_text(&refused).lines().last().unwrap().contains(&help),
                "{args:?}: {}",
                stderr_text(&refused)
            );
        }
    }
    let refused = dir.ask(&["parse", "broken.zip"]).await;
    assert!(
        stderr_text(&refused).contains("`uniground import broken.zip --check`"),
        "{}",
        stderr_text(&refused)
    );
    server.stop().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn a_missing_api_key_is_reported_with_the_variable_to_set() {
    let (server, dir) = (TestServer::start().await, WorkDir::new());
    let url = server.url();
    let made = dir.ask(&["key", "create", "boss", "--scope", "admin", "--server", &url]).await;
    assert!(made.status.success(), "{}", stderr_text(&made));
    let refused = dir.ask(&["scenes", "--server", &url]).await;
    assert!(
        !refused.status.success()
            && stderr_text(&refused).lines().last().unwrap().contains("UNIGROUND_API_KEY"),
        "{}",
        stderr_text(&refused)
    );
    server.stop().await;
}

/// The output says so prominently when the model was requested but did not decide.
#[tokio::test(flavor = "multi_thread")]
async fn an_answer_without_the_requested_model_says_so() {
    let (script, dir) = (Script::default(), WorkDir::new());
    let vlm_url = Some(script.serve(vec![fails(500, "out of order")]).await);
    let vlm = VlmConfig {
        vlm_url,
        vlm_model: Some("scripted".into()),
        vlm_attempts: 1,
        vlm_backoff_ms: 1,
        ..VlmConfig::default()
    };
    let server = TestServer::start_configured(LimitsConfig::default(), vlm).await;
    let scene = server.upload_and_parse(Scan::neutral().zip()).await.id;
    let answer =
        dir.ask(&["ground", "--scene", &scene, "the red sofa", "--server", &server.url()]).await;
    assert!(answer.status.success(), "{}", stderr_text(&answer));
    let told = stdout_text(&answer);
    // Output that is not a terminal has no color codes.
    assert!(
        told.contains("\nDEGRADED: a model could not be used") && !told.contains('\u{1b}'),
        "{told}"
    );
    server.stop().await;
}

#[test]
fn shell_completions_contain_every_subcommand() {
    let dir = WorkDir::new();
    for shell in ["bash", "zsh", "fish", "powershell", "elvish"] {
        let script = dir.run(&["completions", shell]);
        assert!(script.status.success() && script.stderr.is_empty(), "{}", stderr_text(&script));
        let script = stdout_text(&script);
        for subcommand in SUBCOMMANDS {
            assert!(script.contains(subcommand), "{shell} does not complete {subcommand}");
        }
    }
}

#[test]
fn the_manual_has_a_page_for_every_subcommand() {
    let dir = WorkDir::new();
    let first = stdout_text(&dir.run(&["man"]));
    assert!(first.contains(".TH uniground 1"), "{first}");
    for subcommand in SUBCOMMANDS {
        assert!(
            first.contains(&format!("uniground\\-{subcommand}(1)")),
            "{subcommand} is not in {first}"
        );
    }
    assert!(dir.run(&["man", "--out", "pages"]).status.success());
    for subcommand in SUBCOMMANDS {
        let page =
            fs::read_to_string(dir.path().join(format!("pages/uniground-{subcommand}.1"))).unwrap();
        assert!(page.contains(".TH") && page.contains(subcommand), "{page}");
    }
}

/// Commands that maintain a data folder can print JSON.
#[tokio::test]
async fn maintenance_commands_print_json() {
    let server = TestServer::start().await;
    server.upload_and_parse(Scan::neutral().zip()).await;
    let (data, dir) = (server.stop_and_keep_data().await, WorkDir::new());
    let folder = Utf8Path::from_path(data.path()).unwrap().as_str();
    let found = stdout_json(&dir.run(&["doctor", "--data-dir", folder, "--json"]));
    assert_eq!(
        (&found["is_whole"], found["findings"].as_array().map(Vec::len)),
        (&true.into(), Some(0))
    );
    let backup = stdout_json(&dir.run(&["backup", "copy", "--data-dir", folder, "--json"]));
    assert_eq!((&backup["scenes"], &backup["left_out"]), (&1.into(), &Value::Array(Vec::new())));
    let restored = stdout_json(&dir.run(&["restore", "copy", "--data-dir", "restored", "--json"]));
    assert_eq!((&restored["scenes"], &restored["restored_to"]), (&1.into(), &"restored".into()));
    fs::create_dir_all(dir.path().join("restored/blobs/answers/stranger")).unwrap();
    let ill = dir.run(&["doctor", "--data-dir", "restored", "--json"]);
    assert!(!ill.status.success(), "{}", stderr_text(&ill));
    let found: Value = serde_json::from_slice(&ill.stdout).unwrap();
    assert_eq!(
        (&found["is_whole"], &found["findings"][0]["trouble"]),
        (&false.into(), &"unclaimed folder".into())
    );
    let refused = dir.run(&["backup", "-", "--data-dir", folder, "--json"]);
    assert!(
        !refused.status.success() && refused.stdout.is_empty(),
        "{}{}",
        stdout_text(&refused),
        stderr_text(&refused)
    );
}
