//! Bundles from the hub, from zip files and from folders: by the functions and by the program.

use crate::local_hub::{
    FIRST, LocalHub, MODEL, Mood, SECOND, TOKEN, files_below, hex, layout_folder,
};
use crate::test_server::{Process, ask, upload_and_parse};
use axum::Router;
use camino::{Utf8Path, Utf8PathBuf};
use sha2::{Digest, Sha256};
use std::cell::RefCell;
use std::fs::{self, File};
use std::io::{Cursor, Write};
use std::process::{Command, Output, Stdio};
use std::time::Duration;
use tokio::runtime::Runtime;
use uniground::bundles::{AddError, AddOptions, Added, HubSettings, Lock, add, install_locked};
use uniground::packages::Event;
use uniground_core::models::neural::layouts::Precision;
use uniground_core::models::neural::{Role, list};
use zip::write::{SimpleFileOptions, ZipWriter};

/// A hub and an empty folder of bundles.
struct Bench {
    hub: LocalHub,
    settings: HubSettings,
    models: Utf8PathBuf,
    pauses: RefCell<Vec<Duration>>,
    _folder: tempfile::TempDir,
}

impl Bench {
    fn new(layout: &str, mood: Mood) -> Self {
        let hub = LocalHub::start(layout, mood);
        let folder = tempfile::tempdir().unwrap();
        let root = Utf8PathBuf::from_path_buf(folder.path().to_owned()).unwrap();
        let settings = HubSettings {
            endpoint: hub.endpoint().parse().unwrap(),
            token: None,
            cache: Some(root.join("cache")),
            is_offline: false,
        };
        let pauses = RefCell::default();
        Self { hub, settings, models: root.join("models"), pauses, _folder: folder }
    }

    fn add_as(&self, source: &str, change: impl Fn(&mut AddOptions)) -> Result<Added, AddError> {
        let pause = |duration| self.pauses.borrow_mut().push(duration);
        let mut options = AddOptions {
            models: &self.models,
            name: None,
            precision: None,
            update: false,
            hub: &self.settings,
            pause: &pause,
        };
        change(&mut options);
        add(&source.parse().unwrap(), &options, &mut |_: Event| {})
    }

    fn add(&self) -> Result<Added, AddError> {
        self.add_as(MODEL, |_| {})
    }

    fn lock(&self) -> Lock {
        Lock::read(&self.models).unwrap()
    }

    fn names(&self, bundle: &str) -> Vec<String> {
        files_below(&self.models.join(bundle)).into_keys().collect()
    }
}

/// The manifest is made from the files, everything is pinned, and the second time nothing is asked.
#[test]
fn a_model_of_the_hub_is_installed_once() {
    let bench = Bench::new("clip-split", Mood::Fine);
    let added = bench.add().unwrap();
    assert_eq!(added.name, "tiny-clip");
    assert_eq!(
        bench.names("tiny-clip"),
        [
            "config.json",
            "model.json",
            "preprocessor_config.json",
            "text_model.onnx",
            "tokenizer.json",
            "tokenizer_config.json",
            "vision_model.onnx"
        ]
    );
    let listed = list(&bench.models).unwrap();
    assert_eq!((listed.len(), listed[0].role, &listed[0].problem), (1, Some(Role::Encoder), &None));
    assert_eq!(listed[0].licence, "mit");
    assert_eq!(listed[0].source, format!("{MODEL}@{FIRST}"));
    let lock = bench.lock();
    let locked = &lock.bundles["tiny-clip"];
    assert_eq!((locked.source.as_str(), locked.revision.as_deref()), (MODEL, Some(FIRST)));
    assert_eq!(locked.precision, Some(Precision::Fp32));
    let network = &locked.files["vision_model.onnx"];
    let bytes = &bench.hub.files()["onnx/vision_model.onnx"];
    assert_eq!(network.path, "onnx/vision_model.onnx");
    assert_eq!(network.sha256, hex(Sha256::new_with_prefix(bytes)));
    bench.hub.take_requests();
    assert_eq!(bench.add().unwrap(), added);
    assert!(bench.hub.take_requests().is_empty(), "an installed model needs no request");
    // Another precision is another bundle; the pinned commit is kept.
    let small = bench.add_as(MODEL, |options| options.precision = Some(Precision::Q8)).unwrap();
    assert_eq!(small.name, "tiny-clip-q8");
    assert!(bench.names("tiny-clip-q8").contains(&"vision_model_quantized.onnx".to_owned()));
}

/// What arrived before a connection was lost is not requested again, by the same process or by the
/// next one.
#[test]
fn downloads_are_resumed() {
    let bench = Bench::new("clip-split", Mood::BreaksOff);
    let error = bench.add().unwrap_err();
    assert!(error.is_unreachable(), "{error}");
    let network = &bench.hub.files()["onnx/vision_model.onnx"];
    let partial = bench.models.join(".staging/tiny-clip/vision_model.onnx.partial");
    let arrived = fs::metadata(&partial).unwrap().len();
    assert!(arrived > network.len() as u64 / 2, "each attempt adds half of the rest: {arrived}");
    assert!(!bench.models.join("tiny-clip/model.json").exists());
    bench.hub.set_mood(Mood::Fine);
    bench.hub.take_requests();
    bench.add().unwrap();
    let ranges: Vec<String> =
        bench.hub.take_requests().into_iter().filter_map(|(_, r)| r).collect();
    assert_eq!(ranges, [format!("bytes={arrived}-")]);
    assert_eq!(&fs::read(bench.models.join("tiny-clip/vision_model.onnx")).unwrap(), network);
    assert!(!partial.exists());
}

#[test]
fn files_that_differ_from_the_published_ones_are_not_installed() {
    let bench = Bench::new("clip-split", Mood::Altered);
    let error = bench.add().unwrap_err().to_string();
    assert!(error.contains("onnx/vision_model.onnx has the SHA-256"), "{error}");
    assert!(!bench.models.join("tiny-clip").exists());
    let left = files_below(&bench.models.join(".staging/tiny-clip"));
    assert!(!left.keys().any(|name| name.contains("vision_model")), "{:?}", left.keys());
    bench.hub.set_mood(Mood::Fine);
    bench.add().unwrap();
    // Pinned hashes also hold where the hub states others.
    fs::remove_file(bench.models.join("tiny-clip/vision_model.onnx")).unwrap();
    bench.hub.set_mood(Mood::Rewritten);
    bench.add().unwrap();
}

#[test]
fn refusals_say_what_to_do_and_never_show_the_token() {
    let mut bench = Bench::new("clip-split", Mood::Gated);
    let error = bench.add().unwrap_err().to_string();
    assert!(error.contains("consent to terms") && error.contains("HF_TOKEN"), "{error}");
    assert!(error.contains("/acme/tiny-clip"), "{error}");
    bench.settings.token = Some("hf_other".into());
    let error = bench.add().unwrap_err().to_string();
    assert!(error.contains("has not given") && !error.contains("hf_other"), "{error}");
    bench.settings.token = Some(TOKEN.into());
    bench.add().unwrap();
    assert!(!bench.hub.has_leaked(), "the storage must not see the token");
    for (source, expected) in [
        ("hub:acme/tiny-clip@no-such-tag", "there is no branch, tag or full commit no-such-tag"),
        ("hub:acme/nothing", "does not exist"),
    ] {
        let error = bench.add_as(source, |options| options.name = Some("x")).unwrap_err();
        assert!(error.to_string().contains(expected), "{error}");
    }
}

#[test]
fn a_busy_hub_is_asked_again_when_it_says() {
    let bench = Bench::new("clip-split", Mood::Busy);
    bench.add().unwrap();
    let pauses = bench.pauses.borrow();
    assert!(pauses.len() > 1 && pauses.iter().all(|p| *p == Duration::from_secs(2)), "{pauses:?}");
}

#[test]
fn an_unreachable_hub_is_reported_with_advice() {
    let mut bench = Bench::new("clip-split", Mood::Fine);
    // A port without a listener.
    let gone = std::net::TcpListener::bind("127.0.0.1:0").unwrap().local_addr().unwrap();
    bench.settings.endpoint = format!("http://me:secret@{gone}/").parse().unwrap();
    let error = bench.add().unwrap_err();
    assert!(error.is_unreachable());
    let text = error.to_string();
    assert!(text.contains("HF_ENDPOINT") && !text.contains("secret"), "{text}");
}

/// The folder of the hub's own tools is read, and is enough without a connection.
#[test]
fn the_cache_of_the_hub_is_used_offline() {
    let mut bench = Bench::new("clip-split", Mood::Fine);
    bench.settings.is_offline = true;
    let error = bench.add().unwrap_err().to_string();
    assert!(error.contains("HF_HUB_OFFLINE"), "{error}");
    let repository = bench.settings.cache.clone().unwrap().join("models--acme--tiny-clip");
    fs::create_dir_all(repository.join("refs")).unwrap();
    fs::write(repository.join("refs/main"), SECOND).unwrap();
    let snapshot = repository.join("snapshots").join(SECOND);
    fs::create_dir_all(&snapshot).unwrap();
    fs::write(snapshot.join("README.md"), "---\ntags: [a]\nlicense: mit\n---\n# CLIP\n").unwrap();
    for (path, bytes) in bench.hub.files() {
        let file = repository.join("snapshots").join(SECOND).join(path);
        fs::create_dir_all(file.parent().unwrap()).unwrap();
        fs::write(file, bytes).unwrap();
    }
    // The cache calls its files by their hashes, so a damaged one is noticed.
    let network = repository.join("snapshots").join(SECOND).join("onnx/vision_model.onnx");
    let mut bytes = fs::read(&network).unwrap();
    let blob = repository.join("blobs").join(hex(Sha256::new_with_prefix(&bytes)));
    fs::create_dir(blob.parent().unwrap()).unwrap();
    bytes[100] ^= 1;
    fs::write(&blob, &bytes).unwrap();
    fs::remove_file(&network).unwrap();
    std::os::unix::fs::symlink(&blob, &network).unwrap();
    let error = bench.add().unwrap_err().to_string();
    assert!(error.contains("vision_model.onnx is not in the hub's cache"), "{error}");
    bytes[100] ^= 1;
    fs::write(&blob, &bytes).unwrap();
    bench.add().unwrap();
    assert_eq!(bench.lock().bundles["tiny-clip"].revision.as_deref(), Some(SECOND));
    assert_eq!(list(&bench.models).unwrap()[0].licence, "mit", "from the model card");
    assert!(bench.hub.take_requests().is_empty());
    // With a connection, only the description is requested.
    bench.settings.is_offline = false;
    bench.hub.set_commit(SECOND);
    bench.add_as(MODEL, |options| options.name = Some("again")).unwrap();
    assert_eq!(bench.hub.take_requests().len(), 1);
}

#[test]
fn another_revision_replaces_the_files_of_the_first() {
    let bench = Bench::new("clip-split", Mood::Fine);
    bench.add_as(MODEL, |options| options.name = Some("mine")).unwrap();
    bench.hub.set_commit(SECOND);
    bench.add_as(MODEL, |options| options.name = Some("mine")).unwrap();
    assert_eq!(bench.lock().bundles["mine"].revision.as_deref(), Some(FIRST), "pinned");
    let q8 = |options: &mut AddOptions| {
        (options.name, options.update, options.precision) =
            (Some("mine"), true, Some(Precision::Q8));
    };
    let silently = |options: &mut AddOptions| {
        q8(options);
        options.update = false;
    };
    let error = bench.add_as(MODEL, silently).unwrap_err().to_string();
    assert!(error.contains("has fp32") && error.contains("--update"), "{error}");
    bench.add_as(MODEL, q8).unwrap();
    assert_eq!(bench.lock().bundles["mine"].revision.as_deref(), Some(SECOND));
    // A bundle that is gone comes back as it was pinned.
    fs::remove_dir_all(bench.models.join("mine")).unwrap();
    bench.add_as(MODEL, |options| options.name = Some("mine")).unwrap();
    assert_eq!(bench.lock().bundles["mine"].precision, Some(Precision::Q8));
    // Without the lock, the manifest still says where it comes from.
    fs::remove_file(bench.models.join("models.lock")).unwrap();
    bench.hub.take_requests();
    bench.add_as(MODEL, |options| options.name = Some("mine")).unwrap();
    assert!(bench.hub.take_requests().is_empty());
    let other = format!("{MODEL}@{FIRST}");
    let error = bench.add_as(&other, |options| options.name = Some("mine")).unwrap_err();
    assert!(error.to_string().contains("another bundle"), "{error}");
    assert!(!bench.names("mine").contains(&"vision_model.onnx".to_owned()));
    // A folder that something else made is left alone.
    fs::create_dir(bench.models.join("own")).unwrap();
    fs::write(bench.models.join("own/model.json"), "{}").unwrap();
    let error = bench.add_as(MODEL, |options| options.name = Some("own")).unwrap_err().to_string();
    assert!(error.contains("--as"), "{error}");
}

/// A zip file, with a folder around its files or without, and a folder on this machine.
#[test]
fn zip_files_and_folders_are_accepted_the_same_way() {
    let bench = Bench::new("sam-split", Mood::Fine);
    for around in ["", "export/"] {
        let mut archive = ZipWriter::new(Cursor::new(Vec::new()));
        for (path, bytes) in bench.hub.files() {
            archive.start_file(format!("{around}{path}"), SimpleFileOptions::default()).unwrap();
            archive.write_all(bytes).unwrap();
        }
        let bytes = archive.finish().unwrap().into_inner();
        let runtime = Runtime::new().unwrap();
        let listener = runtime.block_on(tokio::net::TcpListener::bind("127.0.0.1:0")).unwrap();
        let address = listener.local_addr().unwrap();
        let sha256 = hex(Sha256::new_with_prefix(&bytes));
        let router = Router::new().fallback(move || async move { bytes });
        runtime.spawn(async move { axum::serve(listener, router).await });
        let zip = format!("http://{address}/my-sam.zip");
        let wrong = bench.add_as(&format!("{zip}#sha256={}", "0".repeat(64)), |_| {}).unwrap_err();
        assert!(wrong.to_string().contains("has the SHA-256"), "{wrong}");
        let name = if around.is_empty() { "plain" } else { "around" };
        let added = bench
            .add_as(&format!("{zip}#sha256={sha256}"), |options| options.name = Some(name))
            .unwrap();
        assert!(added.folder.join("model.json").is_file());
        let placed = bench.names(name);
        assert!(!placed.iter().any(|file| file.contains("archive")), "{placed:?}");
    }
    let source = layout_folder("sam-split");
    let added = bench.add_as(source.as_str(), |options| options.name = Some("local")).unwrap();
    let own = bench.add_as(added.folder.as_str(), |options| options.name = Some("copy")).unwrap();
    assert!(own.folder.join("model.json").is_file(), "a bundle with a manifest is accepted too");
    let listed = list(&bench.models).unwrap();
    let names: Vec<&str> = listed.iter().map(|bundle| bundle.name.as_str()).collect();
    assert_eq!(names, ["around", "copy", "local", "plain"]);
    assert!(listed.iter().all(|b| b.role == Some(Role::Masks) && b.problem.is_none()));
}

/// The lock alone brings everything back, with the pinned commit.
#[test]
fn a_lock_reinstalls_what_it_pins() {
    let bench = Bench::new("clip-split", Mood::Fine);
    bench.add_as(MODEL, |options| options.precision = Some(Precision::Q8)).unwrap();
    let pinned = bench.lock();
    fs::remove_dir_all(bench.models.join("tiny-clip-q8")).unwrap();
    let pause = |_| {};
    let options = AddOptions {
        models: &bench.models,
        name: None,
        precision: None,
        update: false,
        hub: &bench.settings,
        pause: &pause,
    };
    let added = install_locked(&options, &mut |_: Event| {}).unwrap();
    let added: Vec<Added> = added.into_iter().map(Result::unwrap).collect();
    assert_eq!(added.iter().map(|a| a.name.as_str()).collect::<Vec<_>>(), ["tiny-clip-q8"]);
    assert_eq!(bench.lock(), pinned);
    pinned.bundles["tiny-clip-q8"].verify(&added[0].folder).unwrap();
    fs::write(added[0].folder.join("config.json"), "{}").unwrap();
    assert!(pinned.bundles["tiny-clip-q8"].verify(&added[0].folder).is_err());
    fs::write(bench.models.join("models.lock"), r#"{"version": 2, "bundles": {}}"#).unwrap();
    let error = Lock::read(&bench.models).unwrap_err().to_string();
    assert!(error.contains("models.lock") && error.contains("version 2"), "{error}");
}

/// Names become folders: none leads out of the folder of bundles, from the command line or from a
/// lock of somebody else.
#[test]
fn names_of_bundles_stay_in_their_folder() {
    let bench = Bench::new("clip-split", Mood::Fine);
    fs::create_dir_all(&bench.models).unwrap();
    let outside = bench.models.parent().unwrap().join("precious");
    fs::create_dir(&outside).unwrap();
    fs::write(outside.join("config.json"), "mine").unwrap();
    for name in ["../precious", "/precious", "", ".", "..", ".staging", "auto", "models.lock"] {
        let error = bench.add_as(MODEL, |options| options.name = Some(name)).unwrap_err();
        assert!(error.to_string().contains("cannot be the name of a bundle"), "{error}");
    }
    let lock = serde_json::json!({"version": 1, "bundles": {"../precious": {"source": MODEL, "files": {}}}});
    fs::write(bench.models.join("models.lock"), lock.to_string()).unwrap();
    let error = bench.add().unwrap_err().to_string();
    assert!(error.contains("models.lock") && error.contains("cannot be the name"), "{error}");
    assert_eq!(files_below(&outside), [("config.json".into(), b"mine".to_vec())].into());
    assert!(bench.hub.take_requests().is_empty());
}

/// A size that is not that of the file ends the download at once, and other answers after a few
/// attempts.
#[test]
fn downloads_end_whatever_the_server_does() {
    for (mood, expected) in [
        (Mood::WrongSize, "bytes, but"),
        (Mood::Down, "answers 503 Service Unavailable; tried 5 times"),
    ] {
        let bench = Bench::new("clip-split", mood);
        let error = bench.add().unwrap_err().to_string();
        assert!(error.contains(expected), "{mood:?}: {error}");
        assert!(bench.hub.take_requests().len() < 12, "{mood:?}");
    }
}

/// The program in an empty folder, with the hub's variables and without this machine's bundles.
fn program(work: &Utf8Path, endpoint: &str, arguments: &[&str]) -> Command {
    let mut program = Command::new(env!("CARGO_BIN_EXE_uniground"));
    program.args(arguments).current_dir(work).env_clear().envs([
        ("HOME", work.as_str()),
        ("HF_ENDPOINT", endpoint),
        ("PATH", "/usr/bin:/bin"),
    ]);
    let library = std::env::var("ORT_DYLIB_PATH").map_or_else(
        |_| Utf8Path::new(env!("CARGO_MANIFEST_DIR")).join(".onnxruntime/libonnxruntime.so"),
        Utf8PathBuf::from,
    );
    program.env("ORT_DYLIB_PATH", library);
    program
}

fn output_of(program: &mut Command) -> (bool, String, String) {
    let Output { status, stdout, stderr } = program.output().unwrap();
    let text = |bytes| String::from_utf8(bytes).unwrap();
    (status.success(), text(stdout), text(stderr))
}

/// Every layout is added, verified, and listed as what it is.
#[test]
fn the_program_adds_and_verifies_every_layout() {
    for (layout, role) in [
        ("clip-split", "encoder"),
        ("clip-joint", "encoder"),
        ("siglip-split", "encoder"),
        ("siglip-joint", "encoder"),
        ("metaclip2-split", "encoder"),
        ("sam-split", "masks"),
        ("sam2", "masks"),
        ("edgetam", "masks"),
        ("sam-official", "masks"),
    ] {
        let bench = Bench::new(layout, Mood::Fine);
        let work = bench.models.parent().unwrap();
        let endpoint = bench.hub.endpoint();
        let (ok, out, err) = output_of(&mut program(work, &endpoint, &["models", "add", MODEL]));
        assert!(ok, "{layout}: {err}");
        assert!(out.contains(&format!("tiny-clip works as --{role} on cpu")), "{layout}: {out}");
        assert!(out.contains("s per picture"), "{layout}: {out}");
        assert!(err.contains(&format!("{MODEL}: license mit")), "{layout}: {err}");
        let (ok, out, err) = output_of(&mut program(work, &endpoint, &["models", "verify"]));
        assert!(ok && out.contains("tiny-clip works"), "{layout}: {err}");
        let (_, listed, _) = output_of(&mut program(work, &endpoint, &["models", "list"]));
        assert!(listed.contains(&format!("--{role}")) && listed.contains("mit"), "{listed}");
        // A changed file is noticed, though it would load.
        let config = bench.models.join("tiny-clip/config.json");
        if config.is_file() {
            fs::write(config, "{}").unwrap();
            let (ok, _, err) = output_of(&mut program(work, &endpoint, &["models", "verify"]));
            assert!(!ok && err.contains("was changed after installation"), "{layout}: {err}");
        }
    }
}

/// `models describe` prints the manifest that `models add` would write, and names what is missing.
#[test]
fn networks_in_a_folder_are_described() {
    let bench = Bench::new("sam-split", Mood::Fine);
    let work = bench.models.parent().unwrap();
    let folder = layout_folder("sam-split");
    let describe = |arguments: &[&str]| {
        output_of(&mut program(
            work,
            "http://127.0.0.1:9/",
            &[&["models", "describe"], arguments].concat(),
        ))
    };
    let (ok, out, err) = describe(&[folder.as_str()]);
    assert!(ok, "{err}");
    let manifest: serde_json::Value = serde_json::from_str(&out).unwrap();
    assert_eq!(manifest["kind"], "promptable-segmenter");
    assert_eq!(manifest["encoder"]["resize"], "longest-pad");
    let (ok, _, err) = describe(&[layout_folder("clip-split").as_str()]);
    assert!(!ok && err.contains("models add` also takes networks in onnx/"), "{err}");
}

/// From an empty folder: a server that names a model of the hub installs it, parses and answers, and
/// starts again without a connection.
#[tokio::test(flavor = "multi_thread")]
async fn a_server_installs_the_model_that_it_names() {
    let hub =
        tokio::task::spawn_blocking(|| LocalHub::start("clip-split", Mood::Gated)).await.unwrap();
    let temporary = tempfile::tempdir().unwrap();
    let work = Utf8Path::from_path(temporary.path()).unwrap();
    let serve = |endpoint: &str, data: &str| {
        let mut command = program(
            work,
            endpoint,
            &[
                "serve",
                "--listen",
                "127.0.0.1:0",
                "--data-dir",
                data,
                "--masks",
                "builtin",
                "--encoder",
                MODEL,
            ],
        );
        command.env("HF_TOKEN", TOKEN);
        command
    };
    let log = work.join("log");
    let mut command = serve(&hub.endpoint(), "data");
    command.env_remove("HF_TOKEN").stderr(File::create(&log).unwrap());
    let (ok, _, _) = output_of(command.stdout(Stdio::null()));
    assert!(!ok, "without a token the server does not start");
    let told = fs::read_to_string(&log).unwrap();
    assert!(told.contains("HF_TOKEN"), "{told}");

    let mut command = serve(&hub.endpoint(), "data");
    command.stderr(File::create(&log).unwrap());
    let process = Process::spawn(&mut command);
    let models = process.client.models().await.unwrap().models;
    assert_eq!(models.iter().map(|m| m.name.as_str()).collect::<Vec<_>>(), ["tiny-clip"]);
    let room = fs::read(concat!(env!("CARGO_MANIFEST_DIR"), "/examples/living_room.zip")).unwrap();
    let scene = upload_and_parse(&process.client, "application/zip", room).await;
    for question in QUESTIONS {
        let answer = process.client.ground(&scene.id, &ask(question)).await.unwrap();
        assert!(!answer.text.is_empty(), "{question}");
    }
    process.kill();
    let told = fs::read_to_string(&log).unwrap();
    assert!(told.contains("license=\"mit\"") && !told.contains(TOKEN), "{told}");

    // A second start asks nobody.
    hub.take_requests();
    let process = Process::spawn(&mut serve("http://127.0.0.1:9/", "data"));
    assert_eq!(process.client.models().await.unwrap().models.len(), 1);
    process.kill();
    assert!(hub.take_requests().is_empty());
    tokio::task::spawn_blocking(|| drop(hub)).await.unwrap();
}

const QUESTIONS: [&str; 10] = [
    "the sofa",
    "the lamp next to the sofa",
    "the red chair",
    "how many chairs are there",
    "what is on the table",
    "the largest window",
    "the television",
    "is there a plant",
    "the cup closest to the television",
    "how far is the sofa from the door",
];

/// A download that is killed goes on where it was, in the next process.
#[test]
fn a_killed_download_is_resumed_by_the_next_process() {
    const LARGE: usize = 40 << 20;
    let mut files = files_below(&layout_folder("clip-split"));
    // Blanks after a JSON text change nothing but the size.
    files.get_mut("tokenizer.json").unwrap().resize(LARGE, b' ');
    let hub = LocalHub::serve(files, Mood::Slow);
    let temporary = tempfile::tempdir().unwrap();
    let work = Utf8Path::from_path(temporary.path()).unwrap();
    let add = ["models", "add", MODEL];
    let mut process = program(work, &hub.endpoint(), &add)
        .stdout(Stdio::null())
        .stderr(Stdio::null())
        .spawn()
        .unwrap();
    let partial = work.join("models/.staging/tiny-clip/tokenizer.json.partial");
    let arrived = loop {
        let arrived = fs::metadata(&partial).map_or(0, |m| m.len());
        if arrived > 2 << 20 {
            break arrived;
        }
        assert!(process.try_wait().unwrap().is_none(), "the download ended too early");
        std::thread::sleep(Duration::from_millis(5));
    };
    process.kill().unwrap();
    process.wait().unwrap();
    assert!(list(&work.join("models")).unwrap().is_empty(), "half a bundle is none");
    // What another attempt left is not taken along.
    fs::write(work.join("models/.staging/tiny-clip/stray.onnx.partial"), "rest").unwrap();
    hub.set_mood(Mood::Fine);
    hub.take_requests();
    let (ok, out, err) = output_of(&mut program(work, &hub.endpoint(), &add));
    assert!(ok && out.contains("tiny-clip works"), "{err}");
    assert!(!work.join("models/tiny-clip/stray.onnx.partial").exists());
    let ranges: Vec<String> = hub.take_requests().into_iter().filter_map(|(_, r)| r).collect();
    let from: u64 = ranges[0].trim_start_matches("bytes=").trim_end_matches('-').parse().unwrap();
    assert!(ranges.len() == 1 && from >= arrived, "{ranges:?} after {arrived} bytes");
}
