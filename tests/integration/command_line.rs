//! The command line: questions without a server, scenes by name, and errors that say what to do.

use crate::archives::Scan;
use crate::scripted_model::{Script, fails};
use crate::server::TestServer;
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
struct Desk(tempfile::TempDir);

impl Desk {
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

fn out(output: &Output) -> String {
    String::from_utf8(output.stdout.clone()).unwrap()
}

fn err(output: &Output) -> String {
    String::from_utf8(output.stderr.clone()).unwrap()
}

#[track_caller]
fn json(output: &Output) -> Value {
    assert!(output.status.success(), "{}", err(output));
    serde_json::from_slice(&output.stdout).unwrap()
}

#[test]
fn a_scan_on_the_disk_is_asked_about_without_a_server_and_parsed_once() {
    let desk = Desk::new();
    let ask = |question: &str| desk.run(&["ground", ROOM, question, "--json"]);
    let first = ask("the mug on the coffee table");
    let answer = json(&first);
    assert_eq!(
        (&answer["status"], &answer["answer"]["relation_used"]),
        (&"grounded".into(), &"on the coffee table".into())
    );
    assert!(answer["box"]["center"].is_array() && answer.get("evidence").is_none(), "{answer}");
    assert!(err(&first).contains("parsed in "), "{}", err(&first));
    let again = ask("the orange stool");
    assert_eq!(json(&again)["scene_id"], answer["scene_id"]);
    assert_eq!(err(&again), "", "nothing is left to do");
    assert!(desk.path().join("cache/uniground/blobs/parses").is_dir());
}

#[test]
fn folders_and_clouds_are_asked_about_as_well() {
    let desk = Desk::new();
    let room = desk.path().join("my room");
    for (name, content) in &Scan::neutral().0 {
        let path = room.join(name);
        fs::create_dir_all(path.parent().unwrap()).unwrap();
        fs::write(path, content).unwrap();
    }
    let first =
        desk.run(&["ground", "my room", "the red sofa", "--cache", "kept", "--observer=-2,0,90"]);
    assert!(
        first.status.success() && out(&first).contains("grounded"),
        "{}{}",
        out(&first),
        err(&first)
    );
    assert!(err(&first).contains("kept in kept"), "{}", err(&first));
    let again = json(&desk.run(&[
        "ground",
        "my room",
        "the red sofa",
        "--cache",
        "kept",
        "--observer=-2,0,90",
        "--json",
    ]));
    assert_eq!(again["direction_convention"], "observer");
    let cloud = desk.put("hall.ply", &Scan::cloud_only().0["cloud.ply"]);
    let answer = json(&desk.run(&[
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
fn what_does_not_go_together_is_wrong_usage() {
    let desk = Desk::new();
    let room = desk.put("room.zip", &Scan::neutral().zip());
    let cases: [(&[&str], &str); 8] = [
        (&["ground"], "<QUESTION>"),
        (&["ground", "the mug"], "ground SCAN QUESTION"),
        (&["ground", "room.zip"], "what is to be found in room.zip"),
        (&["ground", "room.zip", "the mug", "--scene", "hall"], "cannot be used with"),
        (
            &["ground", "room.zip", "the mug", "--server", "http://127.0.0.1:9"],
            "uniground upload SCAN",
        ),
        (&["ground", "the mug", "--scene", "hall", "--observer", "1,2"], "x,y,yaw"),
        (&["ground", "the mug", "--scene", "hall", "--cache", "kept"], "cannot be used with"),
        (&["ground", "room.zip", "the mug", "--frame", "map"], "lies in no map"),
    ];
    for (args, told) in cases {
        let refused = desk.run(args);
        assert_eq!(refused.status.code(), Some(2), "{args:?}: {}", err(&refused));
        assert!(err(&refused).contains(told), "{args:?}: {}", err(&refused));
    }
    assert!(room.exists() && !desk.path().join("cache").exists(), "nothing was begun");
}

#[tokio::test(flavor = "multi_thread")]
async fn a_scan_is_uploaded_listed_and_asked_about_by_its_name() {
    let (server, desk) = (TestServer::start().await, Desk::new());
    let url = server.url();
    desk.put("Living Room.zip", &Scan::neutral().zip());
    let none = desk.ask(&["scenes", "--server", &url]).await;
    assert!(
        none.status.success()
            && out(&none).is_empty()
            && err(&none).contains("uniground upload SCAN"),
        "{}",
        err(&none)
    );
    let uploaded = desk.ask(&["upload", "Living Room.zip", "--server", &url]).await;
    assert!(uploaded.status.success(), "{}", err(&uploaded));
    let id = out(&uploaded).trim().to_owned();
    let next = format!("uniground ground --scene 'Living Room' --server {url} ");
    assert!(
        err(&uploaded).contains("parsed in ") && err(&uploaded).contains(&next),
        "{}",
        err(&uploaded)
    );
    let listed = out(&desk.ask(&["scenes", "--server", &url]).await);
    assert!(
        listed.contains(&id) && listed.contains("Living Room") && listed.contains("ready"),
        "{listed}"
    );
    let listed = json(&desk.ask(&["scenes", "--server", &url, "--json"]).await);
    assert_eq!((&listed[0]["id"], &listed[0]["name"]), (&id.clone().into(), &"Living Room".into()));
    for scene in ["Living Room", "living", &id, &id[..14]] {
        let answer = json(
            &desk
                .ask(&["ground", "--scene", scene, "the red sofa", "--server", &url, "--json"])
                .await,
        );
        assert_eq!(
            (&answer["scene_id"], &answer["status"]),
            (&id.clone().into(), &"grounded".into()),
            "{scene}"
        );
    }
    let questions = desk.put("questions.txt", b"the red sofa\n");
    let batch = desk
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
    assert_eq!(json(&batch)["done"], 1);
    server.stop().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn a_scene_that_nobody_or_several_are_called_is_told_with_what_there_is() {
    let (server, desk) = (TestServer::start().await, Desk::new());
    let url = server.url();
    let scan = desk.put("hall.zip", &Scan::neutral().zip());
    let mut ids = Vec::new();
    for name in ["hall downstairs", "hall upstairs", "kitchen"] {
        let uploaded = json(
            &desk.ask(&["upload", scan.as_str(), "--name", name, "--server", &url, "--json"]).await,
        );
        ids.push(uploaded["id"].as_str().unwrap().to_owned());
    }
    let ask = async |scene: &str| {
        let refused = desk.ask(&["ground", "--scene", scene, "the sofa", "--server", &url]).await;
        assert_eq!(refused.status.code(), Some(1));
        err(&refused)
    };
    let several = ask("hall").await;
    assert!(
        several.contains("any of 2 scenes")
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
async fn nobody_has_to_wait_for_a_parse_and_everybody_may() {
    let (server, desk) = (TestServer::start().await, Desk::new());
    let url = server.url();
    let uploaded = desk.ask(&["upload", ROOM, "--no-wait", "--server", &url]).await;
    assert!(
        uploaded.status.success()
            && err(&uploaded).contains("--scene living_room")
            && err(&uploaded).contains("--wait")
    );
    let early =
        desk.ask(&["ground", "--scene", "living_room", "the orange stool", "--server", &url]).await;
    assert!(!early.status.success() && err(&early).contains("--wait waits"), "{}", err(&early));
    let waited = desk
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
    assert_eq!(json(&waited)["status"], "grounded");
    server.stop().await;
}

/// Every common error ends with what to do.
#[tokio::test(flavor = "multi_thread")]
async fn errors_end_with_what_helps() {
    let desk = Desk::new();
    let away = desk.ask(&["scenes", "--server", "http://user:password@127.0.0.1:9"]).await;
    assert_eq!(away.status.code(), Some(1));
    assert!(
        err(&away).starts_with("uniground: no server answers at http://127.0.0.1:9: "),
        "{}",
        err(&away)
    );
    assert!(
        err(&away).contains("`uniground serve`")
            && err(&away).contains("--server, or UNIGROUND_SERVER"),
        "{}",
        err(&away)
    );
    assert!(!err(&away).contains("password"), "{}", err(&away));

    let server = TestServer::start().await;
    let url = server.url();
    desk.put("notes.zip", b"these are notes");
    desk.put("broken.zip", &Scan::neutral().without("pose/3.txt").zip());
    for (scan, told) in [("notes.zip", "archive_unreadable"), ("broken.zip", "pose/3.txt")] {
        for args in [&["upload", scan, "--server", &url][..], &["ground", scan, "the sofa"]] {
            let refused = desk.ask(args).await;
            assert_eq!(refused.status.code(), Some(1), "{args:?}");
            let help = format!("`uniground import {scan} --check`");
            assert!(
                err(&refused).contains(told)
                    && err(&refused).lines().last().unwrap().contains(&help),
                "{args:?}: {}",
                err(&refused)
            );
        }
    }
    let refused = desk.ask(&["parse", "broken.zip"]).await;
    assert!(err(&refused).contains("`uniground import broken.zip --check`"), "{}", err(&refused));
    server.stop().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn a_key_that_is_missing_is_asked_for() {
    let (server, desk) = (TestServer::start().await, Desk::new());
    let url = server.url();
    let made = desk.ask(&["key", "create", "boss", "--scope", "admin", "--server", &url]).await;
    assert!(made.status.success(), "{}", err(&made));
    let refused = desk.ask(&["scenes", "--server", &url]).await;
    assert!(
        !refused.status.success()
            && err(&refused).lines().last().unwrap().contains("UNIGROUND_API_KEY"),
        "{}",
        err(&refused)
    );
    server.stop().await;
}

/// The output says so prominently when the model was requested but did not decide.
#[tokio::test(flavor = "multi_thread")]
async fn an_answer_without_its_model_says_so() {
    let (script, desk) = (Script::default(), Desk::new());
    let vlm_url = Some(script.serve(vec![fails(500, "out of order")]).await);
    let vlm = VlmConfig {
        vlm_url,
        vlm_model: Some("scripted".into()),
        vlm_attempts: 1,
        vlm_backoff_ms: 1,
        ..VlmConfig::default()
    };
    let server = TestServer::start_configured(LimitsConfig::default(), vlm).await;
    let scene = server.parsed(Scan::neutral().zip()).await.id;
    let answer =
        desk.ask(&["ground", "--scene", &scene, "the red sofa", "--server", &server.url()]).await;
    assert!(answer.status.success(), "{}", err(&answer));
    let told = out(&answer);
    // Output that is not a terminal has no color codes.
    assert!(
        told.contains("\nDEGRADED: a model was to take part") && !told.contains('\u{1b}'),
        "{told}"
    );
    server.stop().await;
}

#[test]
fn shells_complete_every_subcommand() {
    let desk = Desk::new();
    for shell in ["bash", "zsh", "fish", "powershell", "elvish"] {
        let script = desk.run(&["completions", shell]);
        assert!(script.status.success() && script.stderr.is_empty(), "{}", err(&script));
        let script = out(&script);
        for subcommand in SUBCOMMANDS {
            assert!(script.contains(subcommand), "{shell} knows no {subcommand}");
        }
    }
}

#[test]
fn the_manual_has_a_page_for_every_subcommand() {
    let desk = Desk::new();
    let first = out(&desk.run(&["man"]));
    assert!(first.contains(".TH uniground 1"), "{first}");
    for subcommand in SUBCOMMANDS {
        assert!(
            first.contains(&format!("uniground\\-{subcommand}(1)")),
            "{subcommand} is not in {first}"
        );
    }
    assert!(desk.run(&["man", "--out", "pages"]).status.success());
    for subcommand in SUBCOMMANDS {
        let page = fs::read_to_string(desk.path().join(format!("pages/uniground-{subcommand}.1")))
            .unwrap();
        assert!(page.contains(".TH") && page.contains(subcommand), "{page}");
    }
}

/// Commands that maintain a data folder can print JSON.
#[tokio::test]
async fn the_keepers_of_a_data_folder_speak_json() {
    let server = TestServer::start().await;
    server.parsed(Scan::neutral().zip()).await;
    let (data, desk) = (server.give_back().await, Desk::new());
    let folder = Utf8Path::from_path(data.path()).unwrap().as_str();
    let found = json(&desk.run(&["doctor", "--data-dir", folder, "--json"]));
    assert_eq!(
        (&found["is_whole"], found["findings"].as_array().map(Vec::len)),
        (&true.into(), Some(0))
    );
    let backup = json(&desk.run(&["backup", "copy", "--data-dir", folder, "--json"]));
    assert_eq!((&backup["scenes"], &backup["left_out"]), (&1.into(), &Value::Array(Vec::new())));
    let restored = json(&desk.run(&["restore", "copy", "--data-dir", "restored", "--json"]));
    assert_eq!((&restored["scenes"], &restored["restored_to"]), (&1.into(), &"restored".into()));
    fs::create_dir_all(desk.path().join("restored/blobs/answers/stranger")).unwrap();
    let ill = desk.run(&["doctor", "--data-dir", "restored", "--json"]);
    assert!(!ill.status.success());
    let found: Value = serde_json::from_slice(&ill.stdout).unwrap();
    assert_eq!(
        (&found["is_whole"], &found["findings"][0]["trouble"]),
        (&false.into(), &"unclaimed folder".into())
    );
    let refused = desk.run(&["backup", "-", "--data-dir", folder, "--json"]);
    assert!(!refused.status.success() && refused.stdout.is_empty());
}
