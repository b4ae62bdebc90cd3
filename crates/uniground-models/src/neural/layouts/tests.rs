//! Tiny random networks in `tests/data/hub`, written by the exporters themselves
//! (`make hub-layouts`). Expected outputs are those of torch.

use super::*;
use crate::neural::bundle::{Bundle, Family};
use crate::neural::tests::{cosine, engine};
use crate::neural::{DualEncoder, Models, PointLabel, Prompt, Segmenter};
use camino::Utf8PathBuf;
use image::RgbImage;
use serde::Deserialize;
use std::fs;
use std::sync::Arc;

/// A layout, placed in a bundle's folder as a user's command does.
struct Placed {
    source: Utf8PathBuf,
    selection: Selection,
    folder: Utf8PathBuf,
    _keep: tempfile::TempDir,
}

fn hub(layout: &str) -> Utf8PathBuf {
    Utf8Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/data/hub").join(layout)
}

fn listing(folder: &Utf8Path) -> Vec<String> {
    let below = |folder: &Utf8Path| {
        let mut names: Vec<String> = folder
            .read_dir_utf8()
            .map(|entries| entries.map(|e| e.unwrap().file_name().to_owned()).collect())
            .unwrap_or_default();
        names.sort();
        names
    };
    let networks = below(&folder.join("onnx")).into_iter().map(|name| format!("onnx/{name}"));
    below(folder).into_iter().chain(networks).collect()
}

fn place(layout: &str, precision: Option<Precision>) -> Placed {
    let source = hub(layout);
    let selection = select(&listing(&source), precision).unwrap();
    let keep = tempfile::tempdir().unwrap();
    let folder = Utf8PathBuf::from_path_buf(keep.path().to_owned()).unwrap();
    for path in selection
        .networks
        .files()
        .into_iter()
        .chain(selection.side_files.iter().map(String::as_str))
    {
        fs::copy(source.join(path), folder.join(path.rsplit('/').next().unwrap())).unwrap();
    }
    Placed { source, selection: selection.flattened(), folder, _keep: keep }
}

impl Placed {
    fn describe(&self) -> Result<Manifest, ModelError> {
        let about = About { name: "test".into(), ..About::default() };
        describe(&self.folder, &self.selection, &about)
    }

    fn load(&self) -> Models {
        let manifest = self.describe().unwrap();
        Bundle::write(&self.folder, manifest.clone()).unwrap();
        assert_eq!(Bundle::read(&self.folder).unwrap().manifest, manifest, "it is read as written");
        let engine = engine();
        let models = match manifest {
            Manifest::DualEncoder(_) => Models::default().with_encoder(&engine, &self.folder),
            Manifest::PromptableSegmenter(_) => {
                Models::default().with_segmenter(&engine, &self.folder)
            }
        };
        models.unwrap_or_else(|e| panic!("{}: {e}", self.source))
    }

    fn encoder(&self) -> Arc<DualEncoder> {
        self.load().encoder.unwrap()
    }

    fn segmenter(&self) -> Arc<Segmenter> {
        self.load().segmenters.remove(0)
    }

    fn golden<T: serde::de::DeserializeOwned>(&self) -> T {
        serde_json::from_str(&fs::read_to_string(self.source.join("golden.json")).unwrap()).unwrap()
    }

    fn picture(&self, file: &str) -> RgbImage {
        image::open(self.source.join(file)).unwrap().into_rgb8()
    }
}

#[derive(Deserialize)]
struct EncoderGolden {
    logit_scale: f32,
    texts: Vec<TextGolden>,
    pictures: Vec<PictureGolden>,
}

#[derive(Deserialize)]
struct TextGolden {
    text: String,
    embedding: Vec<f32>,
}

#[derive(Deserialize)]
struct PictureGolden {
    file: String,
    embedding: Vec<f32>,
}

/// Pictures and words of every layout of a dual encoder are embedded as torch does.
#[test]
fn dual_encoders_equal_torch() {
    for layout in ["clip-split", "clip-joint", "siglip-split", "siglip-joint", "metaclip2-split"] {
        let placed = place(layout, None);
        let encoder = placed.encoder();
        let golden: EncoderGolden = placed.golden();
        if layout.ends_with("joint") {
            let ratio = encoder.logit_scale() / golden.logit_scale;
            assert!((ratio - 1.0).abs() < 0.01, "{layout}: scale {}", encoder.logit_scale());
        }
        for TextGolden { text, embedding } in &golden.texts {
            // SigLIP 2 was trained on lower case, but its tokenizer keeps capitals.
            if layout == "siglip-joint" && text.to_lowercase() != *text {
                continue;
            }
            let found = encoder.embed_text(text).unwrap().vector.unwrap();
            let likeness = cosine(&found, embedding);
            assert!(likeness > 0.999_9, "{layout}: {text:?}: {likeness}");
        }
        for PictureGolden { file, embedding } in &golden.pictures {
            let found = encoder.embed_pictures(&[placed.picture(file)]).unwrap().remove(0);
            let likeness = cosine(&found, embedding);
            assert!(likeness > 0.999, "{layout}: {file}: {likeness}");
        }
    }
}

/// Other precisions of the same networks load, and stay close.
#[test]
fn other_precisions_are_close() {
    for precision in [Precision::Fp16, Precision::Q8] {
        let placed = place("clip-split", Some(precision));
        let encoder = placed.encoder();
        for TextGolden { text, embedding } in placed.golden::<EncoderGolden>().texts {
            let found = encoder.embed_text(&text).unwrap().vector.unwrap();
            let likeness = cosine(&found, &embedding);
            assert!(likeness > 0.98, "{precision}: {text:?}: {likeness}");
        }
    }
}

#[derive(Deserialize)]
struct SegmenterGolden {
    size: u32,
    mask_size: usize,
    pictures: Vec<PromptedPicture>,
}

#[derive(Deserialize)]
struct PromptedPicture {
    file: String,
    prompts: Vec<PromptGolden>,
}

#[derive(Deserialize)]
struct PromptGolden {
    points: Vec<(f32, f32)>,
    labels: Vec<u8>,
    iou: Vec<f32>,
    masks: Vec<Vec<f32>>,
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
}

/// Masks of every layout of a segmenter equal those of torch.
#[test]
fn segmenters_equal_torch() {
    for layout in ["sam-split", "sam2", "edgetam", "sam-official"] {
        let placed = place(layout, None);
        let segmenter = placed.segmenter();
        let golden: SegmenterGolden = placed.golden();
        assert_eq!(segmenter.mask_size(), golden.mask_size, "{layout}");
        for PromptedPicture { file, prompts } in &golden.pictures {
            let picture = placed.picture(file);
            let encoded = segmenter.encode(&picture).unwrap();
            let all: Vec<Prompt> = prompts.iter().map(PromptGolden::prompt).collect();
            let decoded = segmenter.decode(&encoded, &all).unwrap();
            // A resized picture may differ by a rounding step in a few pixels.
            let is_exact = picture.width() == golden.size && picture.height() == golden.size;
            let (tolerance, least) = if is_exact { (1e-3, 0.999_99) } else { (0.02, 0.998) };
            for (masks, expected) in decoded.iter().zip(prompts) {
                for mask in masks {
                    let iou = (mask.predicted_iou - expected.iou[mask.index]).abs();
                    assert!(iou < tolerance, "{layout}: {file}: the IoU differs by {iou}");
                    let likeness = cosine(&mask.logits, &expected.masks[mask.index]);
                    assert!(likeness > least, "{layout}: {file}: cosine of logits {likeness}");
                }
            }
            // Together or alone, a prompt has the same masks.
            let alone = segmenter.decode(&encoded, &all[..1]).unwrap().remove(0);
            for (a, b) in alone.iter().zip(&decoded[0]) {
                assert!(a.logits.iter().zip(&b.logits).all(|(a, b)| (a - b).abs() < 1e-3));
            }
        }
    }
}

/// `MobileSAM`'s encoder normalizes and pads itself. Its masks are those of the same network without
/// that.
#[test]
fn encoders_that_read_pixels_equal_torch() {
    let placed = place("mobile-sam", None);
    let Manifest::PromptableSegmenter(mut manifest) = placed.describe().unwrap() else {
        panic!("it is a segmenter");
    };
    assert_eq!((manifest.encoder.size, manifest.decoder.mask_size), (1024, 256));
    // The tiny network has another size, which its file does not state.
    (manifest.encoder.size, manifest.decoder.mask_size) = (64, 16);
    Bundle::write(&placed.folder, Manifest::PromptableSegmenter(manifest)).unwrap();
    let models = Models::default().with_segmenter(&engine(), &placed.folder).unwrap();
    let segmenter = &models.segmenters[0];
    let official = place("sam-official", None);
    for PromptedPicture { file, prompts } in &official.golden::<SegmenterGolden>().pictures {
        let encoded = segmenter.encode(&official.picture(file)).unwrap();
        let all: Vec<Prompt> = prompts.iter().map(PromptGolden::prompt).collect();
        let decoded = segmenter.decode(&encoded, &all).unwrap();
        for (masks, expected) in decoded.iter().zip(prompts) {
            for mask in masks {
                let likeness = cosine(&mask.logits, &expected.masks[mask.index]);
                assert!(likeness > 0.998, "{file}: cosine of logits {likeness}");
            }
        }
    }
}

#[test]
fn boxes_are_refused_where_the_network_has_none() {
    let segmenter = place("sam-split", None).segmenter();
    let encoded = segmenter.encode(&RgbImage::new(64, 48)).unwrap();
    let boxed = Prompt {
        points: vec![
            ((4.0, 4.0), PointLabel::BoxTopLeft),
            ((20.0, 30.0), PointLabel::BoxBottomRight),
        ],
    };
    let error = segmenter.decode(&encoded, &[boxed]).unwrap_err().to_string();
    assert!(error.contains("takes no boxes"), "{error}");
}

#[test]
fn families_are_told_apart_by_their_features() {
    for (layout, family) in
        [("sam-split", Family::Sam), ("sam2", Family::Sam2), ("sam-official", Family::Sam)]
    {
        let Manifest::PromptableSegmenter(manifest) = place(layout, None).describe().unwrap()
        else {
            panic!("{layout} is a segmenter");
        };
        assert_eq!(manifest.family, family, "{layout}");
        assert_eq!(manifest.decoder.inputs.boxes.is_some(), family == Family::Sam2, "{layout}");
    }
}

/// A change to a layout's files.
type Change = fn(&Utf8Path);

/// What is not understood is refused, naming the file, what was expected and what was found.
#[test]
fn unknown_layouts_are_refused() {
    let cases: [(&str, Change, &[&str]); 6] = [
        (
            "clip-split",
            |p| fs::remove_file(p.join("preprocessor_config.json")).unwrap(),
            &["preprocessor_config.json", "missing"],
        ),
        (
            "clip-split",
            |p| fs::remove_file(p.join("tokenizer.json")).unwrap(),
            &["tokenizer.json", "missing"],
        ),
        (
            "clip-split",
            |p| {
                fs::copy(p.join("text_model.onnx"), p.join("vision_model.onnx")).unwrap();
            },
            &["vision_model.onnx", "has the input input_ids", "expected only pixel_values"],
        ),
        (
            "clip-split",
            |p| fs::write(p.join("vision_model.onnx"), "version https://git-lfs").unwrap(),
            &["vision_model.onnx", "Git LFS"],
        ),
        (
            "siglip-split",
            |p| fs::write(p.join("config.json"), r#"{"model_type": "unheard-of"}"#).unwrap(),
            &["vision_model.onnx", "expected an output image_embeds, found", "pooler_output"],
        ),
        (
            "sam-split",
            |p| fs::write(p.join("preprocessor_config.json"), "{").unwrap(),
            &["preprocessor_config.json", "EOF"],
        ),
    ];
    for (layout, change, expected) in cases {
        let placed = place(layout, None);
        change(&placed.folder);
        let error = placed.describe().unwrap_err().to_string();
        assert!(expected.iter().all(|part| error.contains(part)), "{layout}: {error}");
    }
}
