//! Real weights against golden outputs of the Python runtime, and what they find in annotated rooms. These need `make models` first and
//! take minutes: `make test-models` runs them.

use camino::{Utf8Path, Utf8PathBuf};
use image::RgbImage;
use serde::Deserialize;
use serde_json::Value;
use std::fs;
use uniground::models::neural::{DualEncoder, Engine, Models, PointLabel, Prompt, RuntimeSettings, Segmenter};

fn root() -> &'static Utf8Path {
    Utf8Path::new(env!("CARGO_MANIFEST_DIR"))
}

fn golden(path: &str) -> Utf8PathBuf {
    let file = root().join("../shared/models/golden").join(path);
    assert!(file.exists(), "{file} is missing");
    file
}

fn engine() -> Engine {
    Engine::local(&RuntimeSettings { library: Some(root().join(".onnxruntime/libonnxruntime.so")), ..RuntimeSettings::default() }).unwrap()
}

fn encoder() -> std::sync::Arc<DualEncoder> {
    Models::default()
        .with_encoder(&engine(), &root().join("models/clip-vitb16-lite"))
        .unwrap()
        .encoder
        .unwrap()
}

fn segmenter() -> std::sync::Arc<Segmenter> {
    Models::default()
        .with_segmenter(&engine(), &root().join("models/sam2-hiera-tiny"))
        .unwrap()
        .segmenter
        .unwrap()
}

fn picture(path: &str) -> RgbImage {
    image::open(golden(path)).unwrap().into_rgb8()
}

/// The rows of a two-dimensional `.npy` file of 32-bit floats.
fn rows(path: &str, dim: usize) -> Vec<Vec<f32>> {
    let bytes = fs::read(golden(path)).unwrap();
    let start = 10 + usize::from(u16::from_le_bytes([bytes[8], bytes[9]]));
    let values: Vec<f32> = bytes[start..].as_chunks::<4>().0.iter().map(|b| f32::from_le_bytes(*b)).collect();
    values.chunks_exact(dim).map(<[f32]>::to_vec).collect()
}

fn cosine(a: &[f32], b: &[f32]) -> f32 {
    let norm = |v: &[f32]| v.iter().map(|x| x * x).sum::<f32>().sqrt();
    a.iter().zip(b).map(|(x, y)| x * y).sum::<f32>() / (norm(a) * norm(b))
}

fn strings(value: &Value) -> Vec<String> {
    serde_json::from_value(value.clone()).unwrap()
}

#[test]
#[ignore = "needs models: make test-models"]
fn clip_embeddings_are_those_of_the_python_runtime() {
    let known: Value = serde_json::from_str(&fs::read_to_string(golden("clip-vitb16-lite/golden.json")).unwrap()).unwrap();
    let encoder = encoder();
    assert_eq!(encoder.batch(), 1, "its activations are quantised over the batch");
    let expected = rows("clip-vitb16-lite/image_embeds.npy", encoder.dim());
    for (files, least) in [(strings(&known["resized"]), 0.999), (strings(&known["images"]), 0.97)] {
        let pictures: Vec<RgbImage> = files.iter().map(|f| picture(&format!("clip-vitb16-lite/{f}"))).collect();
        for ((own, expected), file) in encoder.embed_pictures(&pictures).unwrap().iter().zip(&expected).zip(&files) {
            println!("{file}: cosine {:.6}", cosine(own, expected));
            assert!(cosine(own, expected) >= least, "{file}");
        }
    }
    for (text, expected) in strings(&known["texts"]).iter().zip(rows("clip-vitb16-lite/text_embeds.npy", encoder.dim())) {
        match encoder.embed_text(text).unwrap().vector {
            Some(own) => assert!(cosine(&own, &expected) >= 0.999, "{text}: {}", cosine(&own, &expected)),
            None => assert!(expected.iter().all(|v| *v == 0.0), "{text}"),
        }
    }
}

#[derive(Deserialize)]
struct Masks {
    image_size: [u32; 2],
    prompts: Vec<Asked>,
}

#[derive(Deserialize)]
struct Asked {
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
fn sam2_masks_are_those_of_the_python_reference() {
    let segmenter = segmenter();
    for name in ["room1_0", "room1_10", "redkitchen_0", "hololens_0"] {
        let known: Masks = serde_json::from_str(&fs::read_to_string(golden(&format!("sam2-hiera-tiny/{name}.json"))).unwrap()).unwrap();
        let encoded = segmenter.encode(&picture(&format!("sam2-hiera-tiny/{name}.png"))).unwrap();
        let scale = segmenter.low_scale(&encoded);
        let [w, h] = known.image_size;
        for asked in &known.prompts {
            const LABELS: [PointLabel; 4] = [PointLabel::Outside, PointLabel::Inside, PointLabel::BoxTopLeft, PointLabel::BoxBottomRight];
            let points = asked.points.iter().copied().zip(asked.labels.iter().map(|l| LABELS[usize::from(*l)])).collect();
            let masks = segmenter.decode(&encoded, &[Prompt { points }]).unwrap().remove(0);
            let mask = masks.iter().find(|m| m.index == asked.mask_index).unwrap();
            let columns = asked.rle.counts.iter().enumerate().flat_map(|(i, n)| std::iter::repeat_n(i % 2 == 1, *n as usize));
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
