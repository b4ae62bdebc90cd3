//! A bundle: a folder with `model.json`, networks and, for text, a tokenizer.

use super::ModelError;
use camino::{Utf8Path, Utf8PathBuf};
use serde::Deserialize;
use sha2::{Digest, Sha256};
use std::fs::{self, File};
use std::io;

pub const MANIFEST: &str = "model.json";

/// `model.json`.
#[derive(Debug, Clone, PartialEq)]
pub enum Manifest {
    DualEncoder(DualEncoderManifest),
    PromptableSegmenter(SegmenterManifest),
}

#[derive(Debug, Clone, PartialEq, Deserialize)]
pub struct DualEncoderManifest {
    pub name: String,
    pub embedding_dim: usize,
    pub image: ImageTower,
    pub text: TextTower,
    /// What cosines are multiplied with before they are compared as likelihoods; 100 for CLIP and its kin.
    #[serde(default = "usual_scale")]
    pub logit_scale: f32,
    #[serde(default)]
    pub licence: String,
    #[serde(default)]
    pub source: String,
}

fn usual_scale() -> f32 {
    100.0
}

#[derive(Debug, Clone, PartialEq, Deserialize)]
pub struct ImageTower {
    pub file: String,
    pub input: String,
    pub output: String,
    /// Width and height, pixels.
    pub size: [u32; 2],
    pub resize: Resize,
    pub interpolation: Interpolation,
    pub mean: [f32; 3],
    pub std: [f32; 3],
    /// Several pictures fit into one call.
    #[serde(default = "yes")]
    pub dynamic_batch: bool,
}

fn yes() -> bool {
    true
}

#[derive(Debug, Clone, PartialEq, Deserialize)]
pub struct TextTower {
    pub file: String,
    pub input_ids: String,
    pub attention_mask: Option<String>,
    pub output: String,
    pub tokenizer: String,
    pub context_length: usize,
    #[serde(default)]
    pub pad_id: u32,
    /// What a noun is put into before it is embedded: "a photo of a {}." for towers trained on captions.
    #[serde(default = "plain")]
    pub template: String,
}

fn plain() -> String {
    "{}".into()
}

#[derive(Debug, Clone, PartialEq, Deserialize)]
pub struct SegmenterManifest {
    pub family: Family,
    pub name: String,
    pub encoder: SegmenterEncoder,
    pub decoder: SegmenterDecoder,
    #[serde(default)]
    pub licence: String,
    #[serde(default)]
    pub source: String,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Family {
    Sam,
    Sam2,
}

#[derive(Debug, Clone, PartialEq, Deserialize)]
pub struct SegmenterEncoder {
    pub file: String,
    pub input: String,
    pub outputs: FeatureNames,
    pub size: u32,
    pub resize: Resize,
    pub interpolation: Interpolation,
    pub value_range: ValueRange,
    pub mean: [f32; 3],
    pub std: [f32; 3],
}

/// Tensor names by role.
#[derive(Debug, Clone, Default, PartialEq, Eq, Deserialize)]
pub struct FeatureNames {
    pub image_embed: Option<String>,
    pub high_res_feats_0: Option<String>,
    pub high_res_feats_1: Option<String>,
}

impl FeatureNames {
    /// Those there are, by role.
    pub fn each(&self) -> impl Iterator<Item = (&'static str, &str)> {
        [("image_embed", &self.image_embed), ("high_res_feats_0", &self.high_res_feats_0), ("high_res_feats_1", &self.high_res_feats_1)]
            .into_iter()
            .filter_map(|(role, name)| Some((role, name.as_deref()?)))
    }

    pub fn of(&self, role: &str) -> Option<&str> {
        self.each().find(|(r, _)| *r == role).map(|(_, name)| name)
    }
}

#[derive(Debug, Clone, PartialEq, Deserialize)]
pub struct SegmenterDecoder {
    pub file: String,
    pub inputs: DecoderInputs,
    pub outputs: DecoderOutputs,
    pub mask_size: usize,
    pub num_masks: usize,
    pub multimask_first: usize,
    pub single_mask: Option<usize>,
    pub dynamic_batch: bool,
    pub max_batch: usize,
    pub pad_point: bool,
    pub mask_threshold: f32,
}

#[derive(Debug, Clone, PartialEq, Eq, Deserialize)]
pub struct DecoderInputs {
    #[serde(flatten)]
    pub features: FeatureNames,
    pub point_coords: String,
    pub point_labels: String,
    pub mask_input: Option<String>,
    pub has_mask_input: Option<String>,
    pub orig_im_size: Option<String>,
}

#[derive(Debug, Clone, PartialEq, Eq, Deserialize)]
pub struct DecoderOutputs {
    pub masks: String,
    pub iou: String,
}

/// How a picture becomes as large as the network wants it.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Resize {
    /// Both sides as wanted, whatever the aspect.
    Squash,
    /// The shorter side as wanted, the middle cut out.
    ShortestCenterCrop,
    /// The longer side as wanted, the rest black.
    #[serde(alias = "longest-side-pad")]
    LongestPad,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Interpolation {
    Bilinear,
    Bicubic,
}

/// What mean and std of a segmenter are in.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize)]
pub enum ValueRange {
    #[serde(rename = "0-255")]
    Bytes,
    #[serde(rename = "0-1")]
    Unit,
}

/// A folder with a manifest that makes sense. Its networks are not loaded.
#[derive(Debug, Clone, PartialEq)]
pub struct Bundle {
    pub folder: Utf8PathBuf,
    pub manifest: Manifest,
}

impl Bundle {
    /// # Errors
    /// [`ModelError::Bundle`] naming `model.json` and the field.
    pub fn read(folder: &Utf8Path) -> Result<Self, ModelError> {
        let file = folder.join(MANIFEST);
        let wrong = |why: String| ModelError::Bundle { file: file.clone(), why };
        let text = fs::read_to_string(&file).map_err(|e| wrong(e.to_string()))?;
        let manifest = Manifest::parse(&text).map_err(wrong)?;
        manifest.check().map_err(|(field, expected)| wrong(format!("{field}: expected {expected}")))?;
        Ok(Self { folder: folder.to_owned(), manifest })
    }

    #[must_use]
    pub fn name(&self) -> &str {
        match &self.manifest {
            Manifest::DualEncoder(m) => &m.name,
            Manifest::PromptableSegmenter(m) => &m.name,
        }
    }

    #[must_use]
    pub fn path(&self, file: &str) -> Utf8PathBuf {
        self.folder.join(file)
    }

    /// The networks, then the tokenizer where there is one.
    #[must_use]
    pub fn files(&self) -> (Vec<&str>, Option<&str>) {
        match &self.manifest {
            Manifest::DualEncoder(m) => (vec![&m.image.file, &m.text.file], Some(&m.text.tokenizer)),
            Manifest::PromptableSegmenter(m) => (vec![&m.encoder.file, &m.decoder.file], None),
        }
    }

    /// SHA-256 over names and contents of the manifest and the files it names, and over `also`; hexadecimal.
    ///
    /// # Errors
    /// [`ModelError::Bundle`] naming the file that is missing.
    pub fn fingerprint(&self, with_networks: bool, also: &[String]) -> Result<String, ModelError> {
        let (networks, tokenizer) = self.files();
        let mut digest = Sha256::new();
        for name in std::iter::once(MANIFEST).chain(networks.into_iter().filter(|_| with_networks)).chain(tokenizer) {
            let file = self.path(name);
            let wrong = |e: io::Error| ModelError::Bundle { file: file.clone(), why: e.to_string() };
            digest.update(name);
            digest.update([0]);
            let mut reader = File::open(&file).map_err(wrong)?;
            digest.update(reader.metadata().map_err(wrong)?.len().to_le_bytes());
            io::copy(&mut reader, &mut HashWriter(&mut digest)).map_err(wrong)?;
        }
        also.iter().for_each(|text| digest.update(text));
        Ok(digest.finalize().iter().map(|byte| format!("{byte:02x}")).collect())
    }
}

struct HashWriter<'a>(&'a mut Sha256);

impl io::Write for HashWriter<'_> {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        self.0.update(bytes);
        Ok(bytes.len())
    }

    fn flush(&mut self) -> io::Result<()> {
        Ok(())
    }
}

const MAX_SIDE: u32 = 4096;

impl Manifest {
    fn parse(text: &str) -> Result<Self, String> {
        fn named<T: serde::de::DeserializeOwned>(manifest: serde_json::Value) -> Result<T, String> {
            serde_path_to_error::deserialize(manifest).map_err(|e| e.to_string())
        }
        let manifest: serde_json::Value = serde_json::from_str(text).map_err(|e| e.to_string())?;
        match manifest["kind"].as_str() {
            Some("dual-encoder") => named(manifest).map(Self::DualEncoder),
            Some("promptable-segmenter") => named(manifest).map(Self::PromptableSegmenter),
            _ => Err("kind: expected dual-encoder or promptable-segmenter".into()),
        }
    }

    fn check(&self) -> Result<(), (&'static str, &'static str)> {
        let spread = |std: &[f32; 3]| std.iter().all(|s| s.is_finite() && *s > 0.0);
        let rules: &[(&str, bool, &str)] = match self {
            Self::DualEncoder(m) => &[
                ("name", is_name(&m.name), NAME_RULE),
                ("embedding_dim", (1..=65_536).contains(&m.embedding_dim), "1 to 65536"),
                ("image.size", m.image.size.iter().all(|s| (1..=MAX_SIDE).contains(s)), "1 to 4096 pixels each"),
                ("image.std", spread(&m.image.std), "above 0"),
                ("image.file", is_file(&m.image.file), FILE_RULE),
                ("text.file", is_file(&m.text.file), FILE_RULE),
                ("text.tokenizer", is_file(&m.text.tokenizer), FILE_RULE),
                ("logit_scale", m.logit_scale.is_finite() && m.logit_scale > 0.0, "above 0"),
                ("text.template", m.text.template.contains("{}"), "a text with {} in it"),
                ("text.context_length", (1..=65_536).contains(&m.text.context_length), "1 to 65536"),
            ],
            Self::PromptableSegmenter(m) => &[
                ("name", is_name(&m.name), NAME_RULE),
                ("encoder.size", (1..=MAX_SIDE).contains(&m.encoder.size), "1 to 4096 pixels"),
                ("encoder.std", spread(&m.encoder.std), "above 0"),
                ("encoder.resize", m.encoder.resize != Resize::ShortestCenterCrop, "squash or longest-side-pad"),
                ("encoder.file", is_file(&m.encoder.file), FILE_RULE),
                ("decoder.file", is_file(&m.decoder.file), FILE_RULE),
                ("encoder.outputs.image_embed", m.encoder.outputs.image_embed.is_some(), "the name of a tensor"),
                (
                    "decoder.inputs",
                    m.decoder.inputs.features.each().all(|(role, _)| m.encoder.outputs.of(role).is_some()),
                    "only features the encoder has",
                ),
                (
                    "decoder.inputs",
                    m.decoder.inputs.features.high_res_feats_0.is_some() == (m.family == Family::Sam2),
                    "high_res_feats for the family sam2, none for sam",
                ),
                ("decoder.inputs.orig_im_size", m.decoder.inputs.orig_im_size.is_none(), "null: masks are enlarged here"),
                (
                    "decoder.inputs.has_mask_input",
                    m.decoder.inputs.mask_input.is_some() == m.decoder.inputs.has_mask_input.is_some(),
                    "both mask inputs or none",
                ),
                ("decoder.mask_size", (1..=MAX_SIDE as usize).contains(&m.decoder.mask_size), "1 to 4096 pixels"),
                ("decoder.num_masks", (1..=16).contains(&m.decoder.num_masks), "1 to 16"),
                ("decoder.multimask_first", m.decoder.multimask_first < m.decoder.num_masks, "below num_masks"),
                ("decoder.single_mask", m.decoder.single_mask.is_none_or(|i| i < m.decoder.num_masks), "below num_masks"),
                ("decoder.max_batch", (1..=1024).contains(&m.decoder.max_batch), "1 to 1024"),
                ("decoder.mask_threshold", m.decoder.mask_threshold.is_finite(), "a number"),
            ],
        };
        rules
            .iter()
            .find(|(_, fine, _)| !fine)
            .map_or(Ok(()), |&(field, _, expected)| Err((field, expected)))
    }
}

const NAME_RULE: &str = "1 to 100 letters, digits, dots, dashes and underscores";
const FILE_RULE: &str = "the name of a file in the same folder";

fn is_name(name: &str) -> bool {
    (1..=100).contains(&name.len()) && name.chars().all(|c| c.is_ascii_alphanumeric() || ".-_".contains(c))
}

fn is_file(name: &str) -> bool {
    is_name(name) && !name.starts_with('.')
}
