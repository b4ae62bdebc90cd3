//! Chooses networks among the files of a repository or a folder, by the names that exporters give
//! them.

use serde::{Deserialize, Serialize};
use std::fmt;

/// The precision of a network's weights, by the names of Transformers.js.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
#[allow(missing_docs)] // The names are those of the files.
pub enum Precision {
    #[default]
    Fp32,
    Fp16,
    /// 8 bits, signed or unsigned.
    Q8,
    Int8,
    Uint8,
    Q4,
    Q4f16,
    Bnb4,
}

impl Precision {
    /// All precisions, the most exact ones first.
    pub const ALL: [Self; 8] = [
        Self::Fp32,
        Self::Fp16,
        Self::Q8,
        Self::Int8,
        Self::Uint8,
        Self::Q4f16,
        Self::Q4,
        Self::Bnb4,
    ];

    /// Returns its name on the command line.
    #[must_use]
    pub fn name(self) -> &'static str {
        match self {
            Self::Fp32 => "fp32",
            Self::Fp16 => "fp16",
            Self::Q8 => "q8",
            Self::Int8 => "int8",
            Self::Uint8 => "uint8",
            Self::Q4 => "q4",
            Self::Q4f16 => "q4f16",
            Self::Bnb4 => "bnb4",
        }
    }

    /// Returns what is appended to a network's name.
    fn suffix(self) -> &'static str {
        match self {
            Self::Fp32 => "",
            Self::Fp16 => "_fp16",
            Self::Q8 => "_quantized",
            Self::Int8 => "_int8",
            Self::Uint8 => "_uint8",
            Self::Q4 => "_q4",
            Self::Q4f16 => "_q4f16",
            Self::Bnb4 => "_bnb4",
        }
    }
}

impl fmt::Display for Precision {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.name())
    }
}

/// The networks of a bundle, by their paths among the files.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Networks {
    /// A dual encoder of two networks.
    Towers {
        /// Embeds pictures.
        image: String,
        /// Embeds words.
        text: String,
    },
    /// A dual encoder of one network that reads pictures and words.
    Joint {
        /// Embeds both.
        file: String,
    },
    /// A promptable segmenter.
    Segmenter {
        /// Runs once per picture.
        encoder: String,
        /// Runs for every batch of prompts.
        decoder: String,
    },
}

impl Networks {
    /// Returns the paths of the networks.
    #[must_use]
    pub fn files(&self) -> Vec<&str> {
        match self {
            Self::Towers { image, text } => vec![image, text],
            Self::Joint { file } => vec![file],
            Self::Segmenter { encoder, decoder } => vec![encoder, decoder],
        }
    }

    fn map(&self, path: impl Fn(&str) -> String) -> Self {
        match self {
            Self::Towers { image, text } => Self::Towers { image: path(image), text: path(text) },
            Self::Joint { file } => Self::Joint { file: path(file) },
            Self::Segmenter { encoder, decoder } => {
                Self::Segmenter { encoder: path(encoder), decoder: path(decoder) }
            }
        }
    }
}

/// The files of a bundle, by their paths.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Selection {
    /// The networks.
    pub networks: Networks,
    /// Their precision.
    pub precision: Precision,
    /// Configurations, tokenizer and license, as far as they exist.
    pub side_files: Vec<String>,
}

impl Selection {
    /// Returns the same files without folders, as they are placed in a bundle.
    #[must_use]
    pub fn flattened(&self) -> Self {
        let base = |path: &str| base_name(path).to_owned();
        Self {
            networks: self.networks.map(base),
            precision: self.precision,
            side_files: self.side_files.iter().map(|path| base(path)).collect(),
        }
    }
}

/// Returns a path without its folders.
fn base_name(path: &str) -> &str {
    path.rsplit('/').next().unwrap_or(path)
}

fn extension(path: &str) -> &str {
    base_name(path).rsplit_once('.').map_or("", |(_, extension)| extension)
}

/// Files beside the networks, in the root.
const SIDE_FILES: [&str; 6] = [
    "config.json",
    "preprocessor_config.json",
    "processor_config.json",
    "special_tokens_map.json",
    "tokenizer.json",
    "tokenizer_config.json",
];

fn is_license(path: &str) -> bool {
    let upper = path.to_ascii_uppercase();
    !path.contains('/') && (upper.starts_with("LICENSE") || upper.starts_with("LICENCE"))
}

/// Chooses the networks. `files` are paths relative to the root. Without a `precision`: the most
/// exact one that exists.
///
/// # Errors
/// Returns what was expected and found.
pub fn select(files: &[String], precision: Option<Precision>) -> Result<Selection, String> {
    let networks: Vec<&str> =
        files.iter().map(String::as_str).filter(|path| extension(path) == "onnx").collect();
    let precisions: Vec<Precision> =
        precision.map_or_else(|| Precision::ALL.to_vec(), |wanted| vec![wanted]);
    let found = precisions
        .iter()
        .find_map(|precision| Some((find_networks(&networks, *precision)?, *precision)));
    let Some((chosen, precision)) = found else {
        let there = Precision::ALL
            .into_iter()
            .filter(|precision| find_networks(&networks, *precision).is_some())
            .map(Precision::name)
            .collect::<Vec<_>>();
        return Err(match (precision, there.is_empty()) {
            (Some(wanted), false) => {
                format!("there is no {wanted}, but there is {}", there.join(", "))
            }
            _ => not_recognized(files, &networks),
        });
    };
    let is_side_file = |path: &&String| SIDE_FILES.contains(&path.as_str()) || is_license(path);
    Ok(Selection {
        networks: chosen,
        precision,
        side_files: files.iter().filter(is_side_file).cloned().collect(),
    })
}

fn not_recognized(files: &[String], networks: &[&str]) -> String {
    const EXPECTED: &str = "expected vision_model.onnx and text_model.onnx, model.onnx, or an \
                            encoder and a decoder, in the root or in onnx/";
    const SHOWN: usize = 8;
    if networks.is_empty() {
        let weights =
            files.iter().any(|path| ["safetensors", "bin", "pt", "pth"].contains(&extension(path)));
        let advice = if weights {
            " The weights are there in another format: look for a repository of the same model \
             with ONNX files, or export it (docs/MODELS.md)."
        } else {
            ""
        };
        return format!("there are no ONNX networks; {EXPECTED}.{advice}");
    }
    let mut shown = networks.iter().take(SHOWN).copied().collect::<Vec<_>>().join(", ");
    if networks.len() > SHOWN {
        shown.push_str(", …");
    }
    format!("the networks are not recognized; {EXPECTED}, found {shown}")
}

/// Returns the networks with a precision, in the root or in a folder `onnx`.
fn find_networks(networks: &[&str], precision: Precision) -> Option<Networks> {
    let named = |stem: &str| {
        let file = format!("{stem}{}.onnx", precision.suffix());
        ["onnx/", ""].iter().find_map(|folder| {
            networks
                .iter()
                .find(|path| **path == format!("{folder}{file}"))
                .map(|p| (*p).to_owned())
        })
    };
    if let (Some(image), Some(text)) = (named("vision_model"), named("text_model")) {
        return Some(Networks::Towers { image, text });
    }
    if let (Some(encoder), Some(decoder)) =
        (named("vision_encoder"), named("prompt_encoder_mask_decoder"))
    {
        return Some(Networks::Segmenter { encoder, decoder });
    }
    if let Some(file) = named("model") {
        return Some(Networks::Joint { file });
    }
    // Exporters of SAM name the two networks after the model.
    let of_precision: Vec<&str> =
        networks.iter().copied().filter(|path| precision_of(path) == precision).collect();
    let with = |word: &str| -> Vec<&str> {
        let has = |path: &&str| base_name(path).to_ascii_lowercase().contains(word);
        of_precision.iter().copied().filter(has).collect()
    };
    let only = |found: &[&str]| match found {
        [path] => Some((*path).to_owned()),
        _ => None,
    };
    // Of a decoder for one mask and one for several, the latter: a point can mean a part or a whole.
    let decoders = with("decoder");
    let several: Vec<&str> =
        decoders.iter().copied().filter(|path| path.contains("multi")).collect();
    let (encoder, decoder) = (only(&with("encoder"))?, only(&decoders).or_else(|| only(&several))?);
    (encoder != decoder).then_some(Networks::Segmenter { encoder, decoder })
}

/// Returns the precision that a network's name ends with.
fn precision_of(path: &str) -> Precision {
    let stem = base_name(path).trim_end_matches(".onnx");
    Precision::ALL
        .into_iter()
        .find(|precision| *precision != Precision::Fp32 && stem.ends_with(precision.suffix()))
        .unwrap_or(Precision::Fp32)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn chosen(files: &[&str], precision: Option<Precision>) -> Result<Selection, String> {
        select(&files.iter().map(|f| (*f).to_owned()).collect::<Vec<_>>(), precision)
    }

    const TRANSFORMERS_JS: [&str; 9] = [
        "README.md",
        "config.json",
        "tokenizer.json",
        "onnx/model.onnx",
        "onnx/text_model.onnx",
        "onnx/text_model_quantized.onnx",
        "onnx/vision_model.onnx",
        "onnx/vision_model_quantized.onnx",
        "onnx/vision_model_fp16.onnx",
    ];

    #[test]
    fn separate_towers_are_preferred_and_the_precision_is_followed() {
        let towers = |suffix: &str| Networks::Towers {
            image: format!("onnx/vision_model{suffix}.onnx"),
            text: format!("onnx/text_model{suffix}.onnx"),
        };
        let exact = chosen(&TRANSFORMERS_JS, None).unwrap();
        assert_eq!((&exact.networks, exact.precision), (&towers(""), Precision::Fp32));
        assert_eq!(exact.side_files, ["config.json", "tokenizer.json"]);
        let small = chosen(&TRANSFORMERS_JS, Some(Precision::Q8)).unwrap();
        assert_eq!(small.networks, towers("_quantized"));
        assert_eq!(small.flattened().networks.files()[0], "vision_model_quantized.onnx");
        let missing = chosen(&TRANSFORMERS_JS, Some(Precision::Fp16)).unwrap_err();
        assert_eq!(missing, "there is no fp16, but there is fp32, q8");
    }

    #[test]
    fn layouts_are_told_apart_by_their_file_names() {
        assert_eq!(
            chosen(&["model.onnx", "LICENSE.md"], None).unwrap().networks,
            Networks::Joint { file: "model.onnx".into() }
        );
        for [encoder, decoder] in [
            ["onnx/vision_encoder.onnx", "onnx/prompt_encoder_mask_decoder.onnx"],
            ["mobile_sam_image_encoder.onnx", "sam_mask_decoder_multi.onnx"],
            ["sam2_hiera_tiny.encoder.onnx", "sam2_hiera_tiny.decoder.onnx"],
        ] {
            assert_eq!(
                chosen(&[decoder, encoder], None).unwrap().networks,
                Networks::Segmenter { encoder: encoder.into(), decoder: decoder.into() }
            );
        }
    }

    #[test]
    fn other_files_are_refused_with_what_was_found() {
        let safetensors = chosen(&["config.json", "model.safetensors"], None).unwrap_err();
        assert!(safetensors.contains("no ONNX networks"), "{safetensors}");
        assert!(safetensors.contains("another format"), "{safetensors}");
        let two = ["sam_mask_decoder_single.onnx", "sam_mask_decoder_multi.onnx"];
        let found = chosen(&[two[0], two[1], "mobile_sam_image_encoder.onnx"], None).unwrap();
        assert_eq!(found.networks.files()[1], two[1], "the decoder with several masks");
        let ambiguous =
            chosen(&["a_encoder.onnx", "b_encoder.onnx", "b_decoder.onnx"], None).unwrap_err();
        assert!(ambiguous.contains("found a_encoder.onnx, b_encoder.onnx"), "{ambiguous}");
    }
}
