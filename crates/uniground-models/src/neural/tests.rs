//! Tests with the tiny bundles in `tests/data`: random weights, every code path, expected outputs
//! from the Python runtime.

use super::bundle::Bundle;
use super::*;
use camino::Utf8Path;
use image::RgbImage;
use serde::Deserialize;
use std::fs;
use std::sync::Arc;

fn data(path: &str) -> Utf8PathBuf {
    Utf8Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/data").join(path)
}

/// Loads the library that `make test` downloads. Without it these tests fail. They are never
/// skipped.
pub fn engine() -> OnnxRuntime {
    let named = std::env::var("ORT_DYLIB_PATH").is_ok();
    let library = (!named).then(|| {
        Utf8Path::new(env!("CARGO_MANIFEST_DIR")).join("../../.onnxruntime/libonnxruntime.so")
    });
    let settings = RuntimeSettings { library, threads: Some(2), ..RuntimeSettings::default() };
    OnnxRuntime::load(&settings)
        .unwrap_or_else(|e| panic!("{e}; download it with `uniground models fetch onnxruntime`"))
}

pub fn tiny_encoder() -> Arc<DualEncoder> {
    Models::default().with_encoder(&engine(), &data("tiny-dual-encoder")).unwrap().encoder.unwrap()
}

pub fn tiny_segmenter(name: &str) -> Arc<Segmenter> {
    Models::default().with_segmenter(&engine(), &data(name)).unwrap().segmenters.remove(0)
}

fn picture(path: &str) -> RgbImage {
    image::open(data(path)).unwrap().into_rgb8()
}

pub fn cosine(a: &[f32], b: &[f32]) -> f32 {
    let norm = |v: &[f32]| v.iter().map(|x| x * x).sum::<f32>().sqrt();
    a.iter().zip(b).map(|(x, y)| x * y).sum::<f32>() / (norm(a) * norm(b))
}

#[derive(Deserialize)]
struct EncoderGolden {
    images: Vec<String>,
    texts: Vec<String>,
    image_embeds: Vec<Vec<f32>>,
    text_embeds: Vec<Vec<f32>>,
}

#[test]
fn embeddings_match_the_python_runtime() {
    let golden: EncoderGolden = serde_json::from_str(
        &fs::read_to_string(data("tiny-dual-encoder/golden/golden.json")).unwrap(),
    )
    .unwrap();
    let encoder = tiny_encoder();
    let pictures: Vec<RgbImage> = golden
        .images
        .iter()
        .map(|name| picture(&format!("tiny-dual-encoder/golden/{name}.png")))
        .collect();
    for (embedded, expected) in
        encoder.embed_pictures(&pictures).unwrap().iter().zip(&golden.image_embeds)
    {
        assert!(cosine(embedded, expected) > 0.999_99, "{}", cosine(embedded, expected));
        assert!((embedded.iter().map(|v| v * v).sum::<f32>() - 1.0).abs() < 1e-4);
    }
    for (text, expected) in golden.texts.iter().zip(&golden.text_embeds) {
        let embedded = encoder.embed_text(text).unwrap();
        assert!(cosine(embedded.vector.as_deref().unwrap(), expected) > 0.999_99, "{text}");
        assert_eq!(embedded.cut, text.len() > 100, "{text}");
        assert_eq!(encoder.embed_text(text).unwrap(), embedded, "the second call uses the cache");
    }
}

#[test]
fn embedding_does_not_depend_on_its_batch() {
    let encoder = tiny_encoder();
    assert!(encoder.batch_size() > 1);
    let pictures: Vec<RgbImage> = (0..11)
        .map(|i| {
            RgbImage::from_fn(90, 70, |x, y| image::Rgb([(x * i) as u8, (y * 3) as u8, i as u8]))
        })
        .collect();
    let together = encoder.embed_pictures(&pictures).unwrap();
    for (picture, together) in pictures.iter().zip(together) {
        let alone = encoder.embed_pictures(std::slice::from_ref(picture)).unwrap().remove(0);
        assert!(cosine(&alone, &together) > 0.999_99);
    }
}

#[derive(Deserialize)]
struct SegmenterGolden {
    image_size: [u32; 2],
    prompts: Vec<PromptGolden>,
}

#[derive(Deserialize)]
struct PromptGolden {
    points: Vec<(f32, f32)>,
    labels: Vec<u8>,
    mask_index: usize,
    all_iou: Vec<f32>,
    rle: Rle,
}

#[derive(Deserialize)]
struct Rle {
    counts: Vec<u32>,
}

impl PromptGolden {
    fn prompt(&self) -> Prompt {
        let label = |label: &u8| {
            [
                PointLabel::Outside,
                PointLabel::Inside,
                PointLabel::BoxTopLeft,
                PointLabel::BoxBottomRight,
            ][usize::from(*label)]
        };
        Prompt { points: self.points.iter().copied().zip(self.labels.iter().map(label)).collect() }
    }

    /// Decodes the mask, column by column. The first run is outside.
    fn columns(&self) -> Vec<bool> {
        self.rle
            .counts
            .iter()
            .enumerate()
            .flat_map(|(i, count)| std::iter::repeat_n(i % 2 == 1, *count as usize))
            .collect()
    }
}

#[test]
fn masks_match_the_python_reference() {
    for bundle in ["tiny-segmenter", "tiny-segmenter-sam"] {
        let segmenter = tiny_segmenter(bundle);
        for name in ["square", "wide"] {
            let golden: SegmenterGolden = serde_json::from_str(
                &fs::read_to_string(data(&format!("{bundle}/golden/{name}.json"))).unwrap(),
            )
            .unwrap();
            let encoded =
                segmenter.encode(&picture(&format!("{bundle}/golden/{name}.png"))).unwrap();
            let scale = segmenter.low_scale(&encoded);
            let prompts: Vec<Prompt> = golden.prompts.iter().map(PromptGolden::prompt).collect();
            let decoded = segmenter.decode(&encoded, &prompts).unwrap();
            for (masks, expected) in decoded.iter().zip(&golden.prompts) {
                let mask = masks.iter().find(|m| m.index == expected.mask_index).unwrap();
                let difference = (mask.predicted_iou - expected.all_iou[mask.index]).abs();
                assert!(difference < 1e-3, "{bundle} {name}: {difference}");
                let [w, h] = golden.image_size;
                let own = (0..w)
                    .flat_map(|x| (0..h).map(move |y| (x as f32, y as f32)))
                    .map(|at| mask.at(at, scale) > segmenter.threshold());
                let (mut both, mut either) = (0, 0);
                for (a, b) in own.zip(expected.columns()) {
                    both += u32::from(a && b);
                    either += u32::from(a || b);
                }
                assert!(
                    f64::from(both) >= 0.99 * f64::from(either),
                    "{bundle} {name}: IoU {both}/{either}"
                );
            }
        }
    }
}

/// Returns a damaged copy of a tiny bundle.
fn damaged_copy(bundle: &str, spoil: impl FnOnce(&Utf8Path)) -> (tempfile::TempDir, Utf8PathBuf) {
    let folder = tempfile::tempdir().unwrap();
    let path = Utf8Path::from_path(folder.path()).unwrap().join(bundle);
    fs::create_dir(&path).unwrap();
    for entry in
        data(bundle).read_dir_utf8().unwrap().map(Result::unwrap).filter(|e| e.path().is_file())
    {
        fs::copy(entry.path(), path.join(entry.file_name())).unwrap();
    }
    spoil(&path);
    (folder, path)
}

fn replace(file: &Utf8Path, from: &str, to: &str) {
    let text = fs::read_to_string(file).unwrap();
    assert!(text.contains(from), "{from}");
    fs::write(file, text.replacen(from, to, 1)).unwrap();
}

#[test]
fn bundle_errors_are_reported_at_load() {
    type Spoil = fn(&Utf8Path);
    let cases: [(&str, Spoil, &[&str]); 12] = [
        ("tiny-dual-encoder", |p| fs::remove_file(p.join("model.json")).unwrap(), &["model.json"]),
        (
            "tiny-dual-encoder",
            |p| fs::remove_file(p.join("text.onnx")).unwrap(),
            &["text.onnx", "missing"],
        ),
        (
            "tiny-dual-encoder",
            |p| {
                fs::write(
                    p.join("image.onnx"),
                    fs::read(p.join("image.onnx")).unwrap().split_at(1000).0,
                )
                .unwrap();
            },
            &["image.onnx"],
        ),
        (
            "tiny-dual-encoder",
            |p| replace(&p.join("model.json"), "\"embedding_dim\": 64", "\"embedding_dim\": 65"),
            &["image.onnx", "image_embeds", "[?, 65]"],
        ),
        (
            "tiny-dual-encoder",
            |p| replace(&p.join("model.json"), "pixel_values", "pixels"),
            &["image.onnx", "pixels", "pixel_values"],
        ),
        (
            "tiny-dual-encoder",
            |p| replace(&p.join("model.json"), "\"pad_id\": 0", "\"pad_id\": 7"),
            &["tokenizer.json", "pads with 0"],
        ),
        (
            "tiny-dual-encoder",
            |p| replace(&p.join("model.json"), "squash", "stretch"),
            &["model.json", "image.resize"],
        ),
        (
            "tiny-dual-encoder",
            |p| replace(&p.join("model.json"), "image.onnx", "../image.onnx"),
            &["image.file", "same folder"],
        ),
        (
            "tiny-dual-encoder",
            |p| fs::write(p.join("tokenizer.json"), "{}").unwrap(),
            &["tokenizer.json"],
        ),
        (
            "tiny-segmenter",
            |p| replace(&p.join("model.json"), "\"size\": 128", "\"size\": 256"),
            &["encoder.onnx", "image", "[?, 3, 256, 256]"],
        ),
        (
            "tiny-segmenter",
            |p| replace(&p.join("model.json"), "\"num_masks\": 3", "\"num_masks\": 5"),
            &["decoder.onnx", "masks"],
        ),
        (
            "tiny-segmenter",
            |p| replace(&p.join("model.json"), "\"sam2\"", "\"sam\""),
            &["decoder.inputs", "sam2"],
        ),
    ];
    for (bundle, spoil, expected) in cases {
        let (_folder, path) = damaged_copy(bundle, spoil);
        let error = verify(&engine(), &path).unwrap_err().to_string();
        assert!(expected.iter().all(|word| error.contains(word)), "{expected:?}: {error}");
    }
}

#[test]
fn network_without_dynamic_batch_gets_one_picture_per_call() {
    let (_folder, path) = damaged_copy("tiny-dual-encoder", |p| {
        replace(&p.join("model.json"), "\"dynamic_batch\": true", "\"dynamic_batch\": false");
    });
    assert_eq!(
        Models::default().with_encoder(&engine(), &path).unwrap().encoder.unwrap().batch_size(),
        1
    );
}

#[test]
fn bundle_of_the_wrong_kind_is_refused() {
    let error = Models::default()
        .with_segmenter(&engine(), &data("tiny-dual-encoder"))
        .unwrap_err()
        .to_string();
    assert!(error.contains("promptable-segmenter"), "{error}");
}

#[test]
fn non_finite_values_are_refused() {
    // A standard deviation this small gives infinite pixels.
    let (_folder, path) = damaged_copy("tiny-dual-encoder", |p| {
        replace(&p.join("model.json"), "\"std\": [\n   0.5", "\"std\": [\n   1e-45");
    });
    let error = verify(&engine(), &path).unwrap_err();
    assert!(matches!(error, ModelError::NotFinite { .. }), "{error}");
}

#[test]
fn missing_and_unusable_libraries_are_reported() {
    let load = |library: Option<&str>, provider| {
        OnnxRuntime::load(&RuntimeSettings {
            library: library.map(Into::into),
            provider,
            threads: None,
        })
    };
    let missing = load(Some("/nowhere/libonnxruntime.so"), Provider::Cpu).unwrap_err().to_string();
    assert!(missing.contains("/nowhere/libonnxruntime.so"), "{missing}");
    engine();
    let other =
        load(Some(concat!(env!("CARGO_MANIFEST_DIR"), "/Cargo.toml")), Provider::Cpu).unwrap_err();
    assert!(matches!(other, ModelError::BadLibrary { .. }), "{other}");
    let runtime = engine();
    let error = load(Some(runtime.library.as_str()), Provider::Cuda).unwrap_err().to_string();
    assert!(error.starts_with("cuda is not available"), "{error}");
}

#[test]
fn fingerprint_changes_with_the_files() {
    let of = |path: &Utf8Path| verify(&engine(), path).unwrap().loaded.remove(0).fingerprint;
    let (_folder, same) = damaged_copy("tiny-segmenter", |_| {});
    let (_other, changed) =
        damaged_copy("tiny-segmenter", |p| replace(&p.join("model.json"), "MIT-0", "MIT"));
    assert_eq!(of(&same), of(&data("tiny-segmenter")));
    assert_ne!(of(&changed), of(&same));
}

/// The same decoder with its weights in a separate file, as in networks over 2 GB.
#[test]
fn external_weights_are_loaded_and_fingerprinted() {
    let external = |path: &Utf8Path| {
        for file in ["decoder.onnx", "decoder.onnx.data"] {
            fs::copy(data("external-weights").join(file), path.join(file)).unwrap();
        }
    };
    let (_folder, beside) = damaged_copy("tiny-segmenter", external);
    let loaded = verify(&engine(), &beside).unwrap();
    let within = verify(&engine(), &data("tiny-segmenter")).unwrap();
    let picture =
        image::RgbImage::from_fn(64, 48, |x, y| image::Rgb([(x * 4) as u8, (y * 5) as u8, 90]));
    let masks = |models: &Models| {
        let segmenter = &models.segmenters[0];
        let encoded = segmenter.encode(&picture).unwrap();
        segmenter.decode(&encoded, &[Prompt::from_inside_points([(20.0, 20.0)])]).unwrap()
    };
    assert_eq!(masks(&loaded), masks(&within));

    // Changing one byte of a weight gives another model.
    let (_other, changed) = damaged_copy("tiny-segmenter", |path| {
        external(path);
        let file = path.join("decoder.onnx.data");
        let mut bytes = fs::read(&file).unwrap();
        bytes[100] ^= 1;
        fs::write(&file, bytes).unwrap();
    });
    let fingerprint = |path: &Utf8Path| Bundle::read(path).unwrap().fingerprint(true, &[]).unwrap();
    assert_ne!(fingerprint(&changed), fingerprint(&beside));
    let (_gone, missing) = damaged_copy("tiny-segmenter", |path| {
        external(path);
        fs::remove_file(path.join("decoder.onnx.data")).unwrap();
    });
    let error = verify(&engine(), &missing).unwrap_err().to_string();
    assert!(error.contains("weights file decoder.onnx.data is missing"), "{error}");
}

#[test]
fn bundles_in_a_folder_are_listed_with_their_problems() {
    let (folder, _) =
        damaged_copy("tiny-dual-encoder", |p| fs::remove_file(p.join("text.onnx")).unwrap());
    let listed = list(Utf8Path::from_path(folder.path()).unwrap()).unwrap();
    assert_eq!(
        (listed[0].name.as_str(), listed[0].role),
        ("tiny-dual-encoder", Some(Role::Encoder))
    );
    assert_eq!(listed[0].problem.as_deref(), Some("missing: text.onnx"));
    assert!(list(&data("")).unwrap().iter().all(|bundle| bundle.problem.is_none()));
}
