//! A bundle: a folder with `model.json`, networks and, for text, a tokenizer.

use super::ModelError;
use super::onnx_file::read_onnx;
use camino::{Utf8Path, Utf8PathBuf};
use serde::{Deserialize, Serialize};
use sha2::{Digest, Sha256};
use std::fs::{self, File};
use std::io;
use uniground_types::models::Role;

/// The file that describes a bundle. A folder without it is not a bundle.
pub const MANIFEST: &str = "model.json";

/// The content of `model.json`.
#[derive(Debug, Clone, PartialEq)]
#[allow(clippy::large_enum_variant)] // A process has a handful of manifests.
pub enum Manifest {
    /// `kind` is `dual-encoder`: pictures and words in one space.
    DualEncoder(DualEncoderManifest),
    /// `kind` is `promptable-segmenter`: points in a picture become masks.
    PromptableSegmenter(SegmenterManifest),
}

/// `model.json` of a dual encoder.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct DualEncoderManifest {
    /// 1 to 100 letters, digits, dots, dashes and underscores.
    pub name: String,
    /// Length of an embedding, 1 to 65536. The same for pictures and words.
    pub embedding_dim: usize,
    /// The network that embeds pictures.
    pub image: ImageTower,
    /// The network that embeds words. It can be the same file as that of `image`; every call then
    /// feeds both, with blanks for the other.
    pub text: TextTower,
    /// Factor that cosines are multiplied with before they are compared as likelihoods. 100 for
    /// CLIP and similar models.
    #[serde(default = "default_logit_scale")]
    pub logit_scale: f32,
    /// License of the weights, for people. Empty when not stated.
    #[serde(default)]
    pub licence: String,
    /// Source of the weights, for people. Empty when not stated.
    #[serde(default)]
    pub source: String,
}

fn default_logit_scale() -> f32 {
    100.0
}

impl DualEncoderManifest {
    /// Returns whether both towers are one network.
    #[must_use]
    pub fn is_joint(&self) -> bool {
        self.image.file == self.text.file
    }
}

/// The network that embeds pictures, and its input format.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct ImageTower {
    /// Name of the network's file, in the bundle's folder.
    pub file: String,
    /// Name of the tensor of pictures: `[batch, 3, height, width]`, 32-bit floats.
    pub input: String,
    /// Name of the tensor of embeddings: `[batch, embedding_dim]`, not yet of unit length.
    pub output: String,
    /// Width and height, pixels.
    pub size: [u32; 2],
    /// How a picture is resized to `size`.
    pub resize: Resize,
    /// Filter of the resizing.
    pub interpolation: Interpolation,
    /// Subtracted from values in `0..=1`: red, green, blue.
    pub mean: [f32; 3],
    /// Divisor after subtracting `mean`, above 0: red, green, blue.
    pub std: [f32; 3],
    /// Whether a call can contain several pictures.
    #[serde(default = "default_true")]
    pub dynamic_batch: bool,
}

fn default_true() -> bool {
    true
}

/// The network that embeds words, and its tokenizer.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct TextTower {
    /// Name of the network's file, in the bundle's folder.
    pub file: String,
    /// Name of the tensor of token ids: `[batch, context_length]`, 64-bit integers.
    pub input_ids: String,
    /// Name of the tensor of 1 for tokens and 0 for padding, shaped like `input_ids`; `None` when
    /// the network has none.
    pub attention_mask: Option<String>,
    /// Name of the tensor of embeddings: `[batch, embedding_dim]`, not yet of unit length.
    pub output: String,
    /// Name of the tokenizer's file, in the bundle's folder, usually `tokenizer.json`. If it pads,
    /// then with `pad_id`.
    pub tokenizer: String,
    /// Number of tokens per sentence, including padding, 1 to 65536. Longer sentences are
    /// truncated.
    pub context_length: usize,
    /// Id of the padding token. 0 when not stated.
    #[serde(default)]
    pub pad_id: u32,
    /// Whether sentences are lower-cased before the tokenizer reads them.
    #[serde(default)]
    pub lowercase: bool,
    /// The prompt that a noun is inserted into before it is embedded: "a photo of a {}." for towers
    /// trained on captions.
    #[serde(default = "default_prompt")]
    pub template: String,
}

fn default_prompt() -> String {
    "{}".into()
}

/// `model.json` of a promptable segmenter.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct SegmenterManifest {
    /// The network's architecture.
    pub family: Family,
    /// 1 to 100 letters, digits, dots, dashes and underscores.
    pub name: String,
    /// The network that runs once per picture.
    pub encoder: SegmenterEncoder,
    /// The network that runs for every batch of prompts.
    pub decoder: SegmenterDecoder,
    /// License of the weights, for people. Empty when not stated.
    #[serde(default)]
    pub licence: String,
    /// Source of the weights, for people. Empty when not stated.
    #[serde(default)]
    pub source: String,
}

/// The architecture of a segmenter. It decides which features the decoder reads.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Family {
    /// SAM and `MobileSAM`: one embedding of the picture.
    Sam,
    /// SAM 2: finer features in addition to the embedding.
    Sam2,
}

/// The network that encodes the picture, and its input format.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct SegmenterEncoder {
    /// Name of the network's file, in the bundle's folder.
    pub file: String,
    /// Name of the tensor of the picture, 32-bit floats: `[1, 3, size, size]`, or
    /// `[height, width, 3]` of values 0 to 255 for a network that normalizes and pads itself.
    pub input: String,
    /// Output tensors. `image_embed` must be among them.
    pub outputs: FeatureNames,
    /// Width and height of its input, pixels, 1 to 4096.
    pub size: u32,
    /// How a picture is resized to `size`. Cropping is refused.
    pub resize: Resize,
    /// Filter of the resizing.
    pub interpolation: Interpolation,
    /// The value range that `mean` and `std` refer to.
    pub value_range: ValueRange,
    /// Subtracted from the values: red, green, blue.
    pub mean: [f32; 3],
    /// Divisor after subtracting `mean`, above 0: red, green, blue.
    pub std: [f32; 3],
}

/// Tensor names by role.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct FeatureNames {
    /// Embedding of the whole picture.
    pub image_embed: Option<String>,
    /// The finest features, a quarter of the input's side; `None` for SAM.
    pub high_res_feats_0: Option<String>,
    /// Finer features, an eighth of the input's side; `None` for SAM.
    pub high_res_feats_1: Option<String>,
    /// Embedding of the positions in `image_embed`, where the encoder makes it.
    #[serde(default)]
    pub image_positions: Option<String>,
}

impl FeatureNames {
    /// Returns the existing tensors, by role.
    pub fn iter(&self) -> impl Iterator<Item = (&'static str, &str)> {
        [
            ("image_embed", &self.image_embed),
            ("high_res_feats_0", &self.high_res_feats_0),
            ("high_res_feats_1", &self.high_res_feats_1),
            ("image_positions", &self.image_positions),
        ]
        .into_iter()
        .filter_map(|(role, name)| Some((role, name.as_deref()?)))
    }

    /// Returns the tensor's name for a role such as `image_embed`, or `None` if there is no such
    /// tensor.
    #[must_use]
    pub fn get(&self, role: &str) -> Option<&str> {
        self.iter().find(|(r, _)| *r == role).map(|(_, name)| name)
    }
}

/// The network that turns prompts into masks.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct SegmenterDecoder {
    /// Name of the network's file, in the bundle's folder.
    pub file: String,
    /// Input tensors.
    pub inputs: DecoderInputs,
    /// Output tensors.
    pub outputs: DecoderOutputs,
    /// Width and height of the output masks, pixels, 1 to 4096.
    pub mask_size: usize,
    /// Number of masks per prompt, 1 to 16.
    pub num_masks: usize,
    /// First mask that is a candidate for a prompt with one point, counted from 0. All later masks
    /// are candidates too.
    pub multimask_first: usize,
    /// The mask for a prompt with several points, counted from 0. `None`: such prompts are treated
    /// like a single point.
    pub single_mask: Option<usize>,
    /// Whether a call can contain several prompts.
    pub dynamic_batch: bool,
    /// Number of prompts per call, 1 to 1024. Always one without `dynamic_batch`.
    pub max_batch: usize,
    /// The same on a GPU, 1 to 1024: more prompts take hardly longer there. `None`: the value of
    /// `max_batch`.
    #[serde(default)]
    pub accelerated_batch: Option<u16>,
    /// Whether prompts get an additional padding point, labeled -1. For SAM only those without a
    /// box, for SAM 2 all.
    pub pad_point: bool,
    /// Logit above which a pixel is inside.
    pub mask_threshold: f32,
}

/// Input tensors of the decoder, by role.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct DecoderInputs {
    /// Tensors from the encoder. Each must be among its outputs.
    #[serde(flatten)]
    pub features: FeatureNames,
    /// Name of the tensor of points: `[batch, points, 2]` or `[1, batch, points, 2]`, x and y in
    /// network pixels.
    pub point_coords: String,
    /// Name of the tensor of point labels, floats or 64-bit integers, shaped like `point_coords`
    /// without its last dimension; 0 outside, 1 inside, 2 and 3 corners of a box, -1 padding.
    pub point_labels: String,
    /// Name of the tensor of boxes, `[1, boxes, 4]`, here always without boxes: corners of a box
    /// are points. `None` when the network has no such input.
    #[serde(default)]
    pub boxes: Option<String>,
    /// Whether points labeled 2 and 3 are corners of a box. Prompts with a box are refused
    /// otherwise.
    #[serde(default = "default_true")]
    pub box_corners: bool,
    /// Name of the tensor of an initial mask: `[batch, 1, mask_size, mask_size]`, here all 0.
    /// `None` when the network has no such input.
    pub mask_input: Option<String>,
    /// Name of the tensor that says whether `mask_input` is used, here 0. Present exactly when
    /// `mask_input` is.
    pub has_mask_input: Option<String>,
    /// Name of the tensor of the size that the network enlarges masks to, here `mask_size`, because
    /// `outputs.masks` are read before they are enlarged. `None` when the network has no such
    /// input.
    pub orig_im_size: Option<String>,
}

/// Output tensors of the decoder, by role.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct DecoderOutputs {
    /// Name of the tensor of logits: `[batch, num_masks, mask_size, mask_size]`, with a leading 1
    /// where `point_coords` has one.
    pub masks: String,
    /// Name of the tensor of each mask's predicted IoU: `[batch, num_masks]`, likewise.
    pub iou: String,
}

/// How a picture is resized to the network's input size.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Resize {
    /// Both sides are scaled to the size, ignoring the aspect ratio.
    Squash,
    /// The shorter side is scaled to the size, and the center is cropped.
    ShortestCenterCrop,
    /// The longer side is scaled to the size, and the rest is filled with the mean color.
    #[serde(alias = "longest-side-pad")]
    LongestPad,
}

/// Resizing filter. It widens when shrinking (antialias), like Pillow's.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Interpolation {
    /// Linear interpolation between two neighbors along each axis.
    Bilinear,
    /// Catmull-Rom interpolation of four neighbors along each axis.
    Bicubic,
}

/// The value range of a segmenter's mean and std.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub enum ValueRange {
    /// Unchanged values, 0 to 255.
    #[serde(rename = "0-255")]
    Bytes,
    /// Values divided by 255, 0 to 1.
    #[serde(rename = "0-1")]
    Unit,
}

/// A folder with a valid manifest. Its networks are not loaded.
#[derive(Debug, Clone, PartialEq)]
pub struct Bundle {
    /// The folder that contains `model.json`.
    pub folder: Utf8PathBuf,
    /// The checked manifest.
    pub manifest: Manifest,
}

impl Bundle {
    /// Reads the manifest in a folder and checks it.
    ///
    /// # Errors
    /// Returns [`ModelError::Bundle`], which names `model.json` and the field.
    pub fn read(folder: &Utf8Path) -> Result<Self, ModelError> {
        let file = folder.join(MANIFEST);
        let wrong = |why: String| ModelError::Bundle { file: file.clone(), why };
        let text = fs::read_to_string(&file).map_err(|e| wrong(e.to_string()))?;
        let manifest = Manifest::parse_checked(&text).map_err(wrong)?;
        Ok(Self { folder: folder.to_owned(), manifest })
    }

    /// Writes a manifest into a folder, as `model.json`.
    ///
    /// # Errors
    /// Returns [`ModelError::Bundle`]: the manifest is not valid, or the file cannot be written.
    pub fn write(folder: &Utf8Path, manifest: Manifest) -> Result<Self, ModelError> {
        let file = folder.join(MANIFEST);
        let wrong = |why: String| ModelError::Bundle { file: file.clone(), why };
        manifest
            .check()
            .map_err(|(field, expected)| wrong(format!("{field}: expected {expected}")))?;
        let text = manifest.to_json().map_err(|e| wrong(e.to_string()))?;
        fs::write(&file, text).map_err(|e| wrong(e.to_string()))?;
        Ok(Self { folder: folder.to_owned(), manifest })
    }

    /// Returns the manifest's name. The folder may have another name.
    #[must_use]
    pub fn name(&self) -> &str {
        match &self.manifest {
            Manifest::DualEncoder(m) => &m.name,
            Manifest::PromptableSegmenter(m) => &m.name,
        }
    }

    /// Returns the path of a file of the bundle. Does not access the disk.
    #[must_use]
    pub fn path(&self, file: &str) -> Utf8PathBuf {
        self.folder.join(file)
    }

    /// Returns the networks, then the tokenizer if there is one.
    #[must_use]
    pub fn files(&self) -> (Vec<&str>, Option<&str>) {
        self.manifest.files()
    }

    /// Returns the external files that hold a network's weights, if it is larger than one ONNX file
    /// can be.
    ///
    /// # Errors
    /// Returns [`ModelError::Bundle`]: the network cannot be read, or its weights lie outside of
    /// the folder or are missing.
    pub fn external_weights(&self, network: &str) -> Result<Vec<String>, ModelError> {
        let file = self.path(network);
        let wrong = |why: String| ModelError::Bundle { file: file.clone(), why };
        let named = read_onnx(&file)
            .map_err(|e| match e.kind() {
                io::ErrorKind::NotFound => wrong("the file is missing".into()),
                _ => wrong(e.to_string()),
            })?
            .external_data;
        for name in &named {
            if !is_file(name) {
                return Err(wrong(format!(
                    "its weights must be in the same folder, but it refers to {name:?}"
                )));
            }
            if !self.path(name).is_file() {
                return Err(wrong(format!("its weights file {name} is missing")));
            }
        }
        Ok(named.into_iter().collect())
    }

    /// Returns the SHA-256 over names and contents of the manifest, the files it names and their
    /// external weights, and over `also`; hexadecimal.
    ///
    /// # Errors
    /// Returns [`ModelError::Bundle`], which names the missing file.
    pub fn fingerprint(&self, with_networks: bool, also: &[String]) -> Result<String, ModelError> {
        let (networks, tokenizer) = self.files();
        let mut digest = Sha256::new();
        let mut names = vec![MANIFEST.to_owned()];
        for network in networks.into_iter().filter(|_| with_networks) {
            names.push(network.to_owned());
            names.extend(self.external_weights(network)?);
        }
        names.extend(tokenizer.map(str::to_owned));
        for name in names {
            let file = self.path(&name);
            let wrong =
                |e: io::Error| ModelError::Bundle { file: file.clone(), why: e.to_string() };
            digest.update(&name);
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
const DUAL_ENCODER: &str = "dual-encoder";
const PROMPTABLE_SEGMENTER: &str = "promptable-segmenter";

impl Manifest {
    /// Returns the networks, then the tokenizer if there is one.
    #[must_use]
    pub fn files(&self) -> (Vec<&str>, Option<&str>) {
        match self {
            Self::DualEncoder(m) => {
                let mut networks: Vec<&str> = vec![&m.image.file, &m.text.file];
                networks.dedup();
                (networks, Some(&m.text.tokenizer))
            }
            Self::PromptableSegmenter(m) => (vec![&m.encoder.file, &m.decoder.file], None),
        }
    }

    /// Returns the license of the weights, for people. Empty when not stated.
    #[must_use]
    pub fn licence(&self) -> &str {
        match self {
            Self::DualEncoder(m) => &m.licence,
            Self::PromptableSegmenter(m) => &m.licence,
        }
    }

    /// Returns what the bundle can be used for.
    #[must_use]
    pub fn role(&self) -> Role {
        match self {
            Self::DualEncoder(_) => Role::Encoder,
            Self::PromptableSegmenter(_) => Role::Masks,
        }
    }

    /// Returns the source of the weights, for people. Empty when not stated.
    #[must_use]
    pub fn source(&self) -> &str {
        match self {
            Self::DualEncoder(m) => &m.source,
            Self::PromptableSegmenter(m) => &m.source,
        }
    }

    /// Returns the manifest with another name.
    #[must_use]
    pub fn named(mut self, name: &str) -> Self {
        match &mut self {
            Self::DualEncoder(m) => name.clone_into(&mut m.name),
            Self::PromptableSegmenter(m) => name.clone_into(&mut m.name),
        }
        self
    }

    /// Parses the text of `model.json` and checks it.
    ///
    /// # Errors
    /// Returns a message that names the field.
    pub fn parse_checked(text: &str) -> Result<Self, String> {
        let manifest = Self::parse(text)?;
        manifest.check().map_err(|(field, expected)| format!("{field}: expected {expected}"))?;
        Ok(manifest)
    }

    fn parse(text: &str) -> Result<Self, String> {
        fn parse_named<T: serde::de::DeserializeOwned>(
            manifest: serde_json::Value,
        ) -> Result<T, String> {
            serde_path_to_error::deserialize(manifest).map_err(|e| e.to_string())
        }
        let manifest: serde_json::Value = serde_json::from_str(text).map_err(|e| e.to_string())?;
        match manifest["kind"].as_str() {
            Some(DUAL_ENCODER) => parse_named(manifest).map(Self::DualEncoder),
            Some(PROMPTABLE_SEGMENTER) => parse_named(manifest).map(Self::PromptableSegmenter),
            _ => Err(format!("kind: expected {DUAL_ENCODER} or {PROMPTABLE_SEGMENTER}")),
        }
    }

    /// Returns the text of `model.json`.
    ///
    /// # Errors
    /// Returns an error for a number that JSON does not have.
    pub fn to_json(&self) -> serde_json::Result<String> {
        #[derive(Serialize)]
        struct Tagged<'a, T> {
            kind: &'static str,
            #[serde(flatten)]
            manifest: &'a T,
        }
        let mut text = match self {
            Self::DualEncoder(manifest) => {
                serde_json::to_string_pretty(&Tagged { kind: DUAL_ENCODER, manifest })
            }
            Self::PromptableSegmenter(manifest) => {
                serde_json::to_string_pretty(&Tagged { kind: PROMPTABLE_SEGMENTER, manifest })
            }
        }?;
        text.push('\n');
        Ok(text)
    }

    fn check(&self) -> Result<(), (&'static str, &'static str)> {
        let spread = |std: &[f32; 3]| std.iter().all(|s| s.is_finite() && *s > 0.0);
        let rules: &[(&str, bool, &str)] = match self {
            Self::DualEncoder(m) => &[
                ("name", is_name(&m.name), NAME_RULE),
                ("embedding_dim", (1..=65_536).contains(&m.embedding_dim), "1 to 65536"),
                (
                    "image.size",
                    m.image.size.iter().all(|s| (1..=MAX_SIDE).contains(s)),
                    "1 to 4096 pixels each",
                ),
                ("image.std", spread(&m.image.std), "above 0"),
                ("image.file", is_file(&m.image.file), FILE_RULE),
                ("text.file", is_file(&m.text.file), FILE_RULE),
                ("text.tokenizer", is_file(&m.text.tokenizer), FILE_RULE),
                ("logit_scale", m.logit_scale.is_finite() && m.logit_scale > 0.0, "above 0"),
                ("text.template", m.text.template.contains("{}"), "a text that contains {}"),
                (
                    "text.context_length",
                    (1..=65_536).contains(&m.text.context_length),
                    "1 to 65536",
                ),
            ],
            Self::PromptableSegmenter(m) => &[
                ("name", is_name(&m.name), NAME_RULE),
                ("encoder.size", (1..=MAX_SIDE).contains(&m.encoder.size), "1 to 4096 pixels"),
                ("encoder.std", spread(&m.encoder.std), "above 0"),
                (
                    "encoder.resize",
                    m.encoder.resize != Resize::ShortestCenterCrop,
                    "squash or longest-side-pad",
                ),
                ("encoder.file", is_file(&m.encoder.file), FILE_RULE),
                ("decoder.file", is_file(&m.decoder.file), FILE_RULE),
                (
                    "encoder.outputs.image_embed",
                    m.encoder.outputs.image_embed.is_some(),
                    "the name of a tensor",
                ),
                (
                    "decoder.inputs",
                    m.decoder
                        .inputs
                        .features
                        .iter()
                        .all(|(role, _)| m.encoder.outputs.get(role).is_some()),
                    "only features that encoder.outputs has",
                ),
                (
                    "decoder.inputs",
                    m.decoder.inputs.features.high_res_feats_0.is_some()
                        == (m.family == Family::Sam2),
                    "high_res_feats for the family sam2, none for sam",
                ),
                (
                    "decoder.inputs.has_mask_input",
                    m.decoder.inputs.mask_input.is_some()
                        == m.decoder.inputs.has_mask_input.is_some(),
                    "mask_input and has_mask_input to be both set or both null",
                ),
                (
                    "decoder.mask_size",
                    (1..=MAX_SIDE as usize).contains(&m.decoder.mask_size),
                    "1 to 4096 pixels",
                ),
                ("decoder.num_masks", (1..=16).contains(&m.decoder.num_masks), "1 to 16"),
                (
                    "decoder.multimask_first",
                    m.decoder.multimask_first < m.decoder.num_masks,
                    "below num_masks",
                ),
                (
                    "decoder.single_mask",
                    m.decoder.single_mask.is_none_or(|i| i < m.decoder.num_masks),
                    "below num_masks",
                ),
                ("decoder.max_batch", (1..=1024).contains(&m.decoder.max_batch), "1 to 1024"),
                (
                    "decoder.accelerated_batch",
                    m.decoder.accelerated_batch.is_none_or(|n| (1..=1024).contains(&n)),
                    "1 to 1024",
                ),
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
    (1..=100).contains(&name.len())
        && name.chars().all(|c| c.is_ascii_alphanumeric() || ".-_".contains(c))
}

fn is_file(name: &str) -> bool {
    is_name(name) && !name.starts_with('.')
}
