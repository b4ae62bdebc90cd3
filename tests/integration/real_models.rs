//! Real weights against golden outputs of the Python runtime, and their results in annotated rooms.
//! These tests need `make models` and take minutes: `make test-models` runs them.

use crate::shared_scenes::development_rooms;
use camino::{Utf8Path, Utf8PathBuf};
use image::RgbImage;
use serde::Deserialize;
use serde_json::Value;
use std::collections::BTreeSet;
use std::fs;
use std::process::Command;
use std::time::Duration;
use uniground_core::models::neural::{
    DualEncoder, Engine, Models, OnnxRuntime, PointLabel, Prompt, RuntimeSettings, Segmenter,
};
use uniground_core::parsing::checkpoints::Checkpoints;
use uniground_core::parsing::masks::sam::{EncodedFrames, SamMasks};
use uniground_core::parsing::{self, ParsingSettings, Perception};
use uniground_core::progress::Progress;
use uniground_endpoints::inference::RemoteServer;
use uniground_evaluation::annotated::AnnotatedRoom;
use uniground_evaluation::annotations::Annotations;
use uniground_evaluation::segmentation::score_instances;
use uniground_evaluation::systems::{NamedBy, embed_and_name, instances_of};

fn repository_root() -> &'static Utf8Path {
    Utf8Path::new(env!("CARGO_MANIFEST_DIR"))
}

fn golden_file(path: &str) -> Utf8PathBuf {
    let file = repository_root().join("../shared/models/golden").join(path);
    assert!(file.exists(), "{file} is missing");
    file
}

fn engine() -> OnnxRuntime {
    OnnxRuntime::load(&RuntimeSettings {
        library: Some(repository_root().join(".onnxruntime/libonnxruntime.so")),
        ..RuntimeSettings::default()
    })
    .unwrap()
}

fn encoder() -> std::sync::Arc<DualEncoder> {
    Models::default()
        .with_encoder(&engine(), &repository_root().join("models/clip-vitb16-lite"))
        .unwrap()
        .encoder
        .unwrap()
}

fn segmenter() -> std::sync::Arc<Segmenter> {
    Models::default()
        .with_segmenter(&engine(), &repository_root().join("models/sam2-hiera-tiny"))
        .unwrap()
        .segmenters
        .remove(0)
}

/// Loads an annotated room from the folder next to the checkout.
fn load_room(name: &str, scratch: &tempfile::TempDir) -> AnnotatedRoom {
    AnnotatedRoom::load(
        &repository_root().join("../shared/scenes"),
        name,
        Utf8Path::from_path(scratch.path()).unwrap(),
    )
    .unwrap()
}

/// Returns only the first room, which saves a quarter of an hour; `FULL=1` returns all.
fn select_rooms<T>(all: &[T]) -> &[T] {
    if std::env::var_os("FULL").is_some() { all } else { &all[..1] }
}

fn load_image(path: &str) -> RgbImage {
    image::open(golden_file(path)).unwrap().into_rgb8()
}

/// Reads the rows of a two-dimensional `.npy` file of 32-bit floats.
fn read_rows(path: &str, dim: usize) -> Vec<Vec<f32>> {
    let bytes = fs::read(golden_file(path)).unwrap();
    let start = 10 + usize::from(u16::from_le_bytes([bytes[8], bytes[9]]));
    let values: Vec<f32> =
        bytes[start..].as_chunks::<4>().0.iter().map(|b| f32::from_le_bytes(*b)).collect();
    values.chunks_exact(dim).map(<[f32]>::to_vec).collect()
}

fn cosine(a: &[f32], b: &[f32]) -> f32 {
    let norm = |v: &[f32]| v.iter().map(|x| x * x).sum::<f32>().sqrt();
    a.iter().zip(b).map(|(x, y)| x * y).sum::<f32>() / (norm(a) * norm(b))
}

fn to_strings(value: &Value) -> Vec<String> {
    serde_json::from_value(value.clone()).unwrap()
}

#[cfg(target_arch = "x86_64")]
fn has_vnni() -> bool {
    is_x86_feature_detected!("avx512vnni") || is_x86_feature_detected!("avxvnni")
}
#[cfg(not(target_arch = "x86_64"))]
fn has_vnni() -> bool {
    false
}

#[test]
#[ignore = "needs models: make test-models"]
fn clip_embeddings_equal_the_python_runtime() {
    let known: Value = serde_json::from_str(
        &fs::read_to_string(golden_file("clip-vitb16-lite/golden.json")).unwrap(),
    )
    .unwrap();
    let encoder = encoder();
    assert_eq!(encoder.batch_size(), 1, "its activations are quantized over the batch");
    let expected = read_rows("clip-vitb16-lite/image_embeds.npy", encoder.dim());
    // The reference was computed with VNNI instructions. Other CPUs round 8-bit products otherwise.
    let least = if has_vnni() { 0.999 } else { 0.97 };
    for (files, least) in
        [(to_strings(&known["resized"]), least), (to_strings(&known["images"]), 0.97)]
    {
        let pictures: Vec<RgbImage> =
            files.iter().map(|f| load_image(&format!("clip-vitb16-lite/{f}"))).collect();
        for ((own, expected), file) in
            encoder.embed_pictures(&pictures).unwrap().iter().zip(&expected).zip(&files)
        {
            println!("{file}: cosine {:.6}", cosine(own, expected));
            assert!(cosine(own, expected) >= least, "{file}");
        }
    }
    for (text, expected) in to_strings(&known["texts"])
        .iter()
        .zip(read_rows("clip-vitb16-lite/text_embeds.npy", encoder.dim()))
    {
        match encoder.embed_text(text).unwrap().vector {
            Some(own) => {
                assert!(cosine(&own, &expected) >= 0.999, "{text}: {}", cosine(&own, &expected));
            }
            None => assert!(expected.iter().all(|v| *v == 0.0), "{text}"),
        }
    }
}

#[derive(Deserialize)]
struct Masks {
    image_size: [u32; 2],
    prompts: Vec<MaskPrompt>,
}

#[derive(Deserialize)]
struct MaskPrompt {
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

#[test]
#[ignore = "needs models: make test-models"]
fn sam2_masks_equal_the_python_reference() {
    let segmenter = segmenter();
    for name in ["room1_0", "room1_10", "redkitchen_0", "hololens_0"] {
        let known: Masks = serde_json::from_str(
            &fs::read_to_string(golden_file(&format!("sam2-hiera-tiny/{name}.json"))).unwrap(),
        )
        .unwrap();
        let encoded =
            segmenter.encode(&load_image(&format!("sam2-hiera-tiny/{name}.png"))).unwrap();
        let scale = segmenter.low_scale(&encoded);
        let [w, h] = known.image_size;
        for asked in &known.prompts {
            const LABELS: [PointLabel; 4] = [
                PointLabel::Outside,
                PointLabel::Inside,
                PointLabel::BoxTopLeft,
                PointLabel::BoxBottomRight,
            ];
            let points = asked
                .points
                .iter()
                .copied()
                .zip(asked.labels.iter().map(|l| LABELS[usize::from(*l)]))
                .collect();
            let masks = segmenter.decode(&encoded, &[Prompt { points }]).unwrap().remove(0);
            let mask = masks.iter().find(|m| m.index == asked.mask_index).unwrap();
            let columns = asked
                .rle
                .counts
                .iter()
                .enumerate()
                .flat_map(|(i, n)| std::iter::repeat_n(i % 2 == 1, *n as usize));
            let own = (0..w).flat_map(|x| (0..h).map(move |y| (x as f32, y as f32)));
            let (mut both, mut either) = (0, 0);
            for (at, expected) in own.zip(columns) {
                let own = mask.at(at, scale) > segmenter.threshold();
                both += u32::from(own && expected);
                either += u32::from(own || expected);
            }
            let iou = f64::from(both) / f64::from(either);
            println!(
                "{name}, mask {}: IoU {iou:.4}, predicted {:.3} ({:.3})",
                mask.index, mask.predicted_iou, asked.all_iou[mask.index]
            );
            assert!(iou >= 0.95, "{name}");
        }
    }
}

/// The tokens of a Perception Encoder equal those of `open_clip`'s tokenizer.
#[test]
#[ignore = "needs models: make test-models"]
fn perception_encoder_tokens_equal_open_clip() {
    let tokenizer =
        tokenizers::Tokenizer::from_file(repository_root().join("models/pe-tokenizer.json"))
            .unwrap();
    let known: Value =
        serde_json::from_str(&fs::read_to_string(golden_file("pe-tokenizer.json")).unwrap())
            .unwrap();
    let expected: Vec<Vec<u32>> = serde_json::from_value(known["input_ids"].clone()).unwrap();
    let texts = to_strings(&known["texts"]);
    for (text, expected) in texts.iter().zip(&expected) {
        assert_eq!(tokenizer.encode(text.as_str(), true).unwrap().get_ids(), expected, "{text:?}");
    }
    println!("{} of {} sentences equal", texts.len(), texts.len());
}

/// Instances from masks of SAM 2 tiny, compared with the prototype's figures.
#[test]
#[ignore = "needs models: make test-models"]
fn sam2_masks_segment_annotated_rooms() {
    for &(name, least) in select_rooms(&[("room1", [0.93, 0.84]), ("room2", [0.83, 0.66])]) {
        let scratch = tempfile::tempdir().unwrap();
        let room = load_room(name, &scratch);
        let frames = EncodedFrames::new(segmenter(), None, 0).unwrap();
        let settings = ParsingSettings::default();
        let masks = SamMasks {
            frames: &frames,
            settings: settings.sam_masks,
            segments: settings.rgbd_masks,
            name: "sam2-hiera-tiny".into(),
        };
        let perception = Perception::with_masks(&masks);
        let parsed = parsing::parse(
            room.bundle.clone(),
            &perception,
            &settings,
            &Checkpoints::disabled(),
            &Progress::silent(),
        )
        .unwrap();
        let score = score_instances(
            &parsed.instances,
            &parsed.instance_of_point,
            &room.objects(200),
            &room.truth,
        );
        let recall = score.box_recall();
        println!(
            "{name}: box recall {recall:.3?}, point-set recall {:.3?}, {} instances",
            score.point_recall(),
            parsed.instances.len()
        );
        assert!(recall[0] >= least[0] && recall[1] >= least[1], "{name}: {recall:?}");
    }
}

/// Object names as queries over annotated instances, by appearance alone: recall among the first
/// five.
#[test]
#[ignore = "needs models: make test-models"]
fn clip_retrieves_annotated_objects_by_name() {
    let encoder = encoder();
    for &(name, least, least_calibrated) in
        select_rooms(&[("room1", 0.95, 0.95), ("room2", 0.72, 0.84)])
    {
        let scratch = tempfile::tempdir().unwrap();
        let room = load_room(name, &scratch);
        let folder = repository_root().join("../shared/scenes");
        let (annotations, _) = Annotations::read(&Annotations::find_file(&folder, name).unwrap());
        let cloud = &room.bundle.cloud;
        let mut instances = instances_of(&annotations, cloud, NamedBy::Encoder);
        let settings = ParsingSettings::default();
        let seen = embed_and_name(
            &annotations,
            &mut instances,
            cloud,
            &room.bundle.frames,
            &encoder,
            &settings,
        )
        .unwrap();
        // Structure is not an object; names come from the annotations.
        let things: Vec<usize> = (0..instances.len())
            .filter(|&i| instances[i].structure.is_none() && seen.is_seen(i))
            .collect();
        let named = |i: usize| annotations.objects[i].name.as_str();
        let names: BTreeSet<&str> = things.iter().map(|&i| named(i)).collect();
        for (scores, least) in
            [("plain cosine", least), ("against the vocabulary", least_calibrated)]
        {
            let (mut first, mut in_five) = (0, 0);
            for name in &names {
                let cosines = encoder
                    .embed_name(name)
                    .unwrap()
                    .vector
                    .map_or_else(|| vec![0.0; seen.len()], |v| seen.cosines(&v));
                let score = |i: usize| match scores {
                    "plain cosine" => cosines[i],
                    _ => encoder.logit_scale() * cosines[i] - seen.norms()[i].appearance,
                };
                let mut order = things.clone();
                order.sort_by(|&a, &b| score(b).total_cmp(&score(a)).then(a.cmp(&b)));
                first += u32::from(named(order[0]) == *name);
                in_five += u32::from(order.iter().take(5).any(|&i| named(i) == *name));
            }
            let share = |count: u32| f64::from(count) / names.len() as f64;
            println!(
                "{name}, {scores}: {} names over {} instances: first {:.3}, in five {:.3}",
                names.len(),
                things.len(),
                share(first),
                share(in_five)
            );
            assert!(share(in_five) >= least, "{name}");
        }
    }
}

/// The whole system with built-in masks and CLIP answers at least half of the expressions with the
/// right box.
#[test]
#[ignore = "needs models: make test-models"]
fn questions_about_parsed_rooms_are_answered_with_clip() {
    let rooms = development_rooms(select_rooms(&["room1", "room2"]))
        .expect("make test-models checks that the rooms exist");
    let out = tempfile::tempdir().unwrap();
    let output = Command::new(env!("CARGO_BIN_EXE_uniground"))
        .args(["eval", rooms.path().to_str().unwrap(), "--out", out.path().to_str().unwrap()])
        .args([
            "--matrix",
            "source=parsed;encoder=clip-vitb16-lite",
            "--models",
            repository_root().join("models").as_str(),
        ])
        .args([
            "--onnxruntime-lib",
            repository_root().join(".onnxruntime/libonnxruntime.so").as_str(),
        ])
        .output()
        .unwrap();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let report: Value =
        serde_json::from_slice(&fs::read(out.path().join("report.json")).unwrap()).unwrap();
    let right = report["cells"][0]["figures"]["complete"][0]["value"].as_f64().unwrap();
    println!("parsed, rgbd masks and CLIP: Acc@.25 {right:.3}");
    assert!(right >= 0.5, "{right}");
}

/// The same networks behind a real inference server (`tests/kserve/server.py`) give the same
/// results.
#[test]
#[ignore = "needs an inference server: make test-models"]
fn local_and_remote_inference_give_the_same_results() {
    let address =
        std::env::var("KSERVE_URL").expect("KSERVE_URL: scripts/test-models.sh starts a server");
    let remote = RemoteServer::new(&address, Duration::from_mins(1)).unwrap();
    let pictures: Vec<RgbImage> = (1..12)
        .map(|i| {
            RgbImage::from_fn(70, 50, |x, y| image::Rgb([(x * i) as u8, (y * 2) as u8, i as u8]))
        })
        .collect();
    let data = repository_root().join("crates/uniground-models/tests/data");
    let of_hub = repository_root().join("target/kserve");
    for bundle in [data.join("tiny-dual-encoder"), of_hub.join("siglip"), of_hub.join("clip-joint")]
    {
        let [here, there] = [&engine() as &dyn Engine, &remote].map(|engine| {
            Models::default().with_encoder(engine, &bundle).unwrap().encoder.unwrap()
        });
        let embedded = [&here, &there].map(|encoder| encoder.embed_pictures(&pictures).unwrap());
        for (a, b) in embedded[0].iter().zip(&embedded[1]) {
            assert!(cosine(a, b) > 0.999_99, "{bundle}: cosine {}", cosine(a, b));
        }
        let words = [&here, &there]
            .map(|encoder| encoder.embed_text("the small blue mug").unwrap().vector.unwrap());
        assert!(cosine(&words[0], &words[1]) > 0.999_99, "{bundle}");
    }
    let prompts: Vec<Prompt> =
        (0..20).map(|i| Prompt::from_inside_points([(i as f32 * 3.0, 20.0)])).collect();
    let masks = |segmenter: &Segmenter| {
        segmenter.decode(&segmenter.encode(&pictures[3]).unwrap(), &prompts).unwrap()
    };
    for bundle in [data.join("tiny-segmenter"), of_hub.join("sam"), of_hub.join("sam2")] {
        let [here, there] = [&engine() as &dyn Engine, &remote].map(|engine| {
            Models::default().with_segmenter(engine, &bundle).unwrap().segmenters.remove(0)
        });
        for (a, b) in masks(&here).iter().flatten().zip(masks(&there).iter().flatten()) {
            let differ = (a.predicted_iou - b.predicted_iou).abs();
            assert!(differ < 1e-4, "{bundle}: {differ}");
            assert!(a.logits.iter().zip(&b.logits).all(|(x, y)| (x - y).abs() < 1e-3), "{bundle}");
        }
    }
}
