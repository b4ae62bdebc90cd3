//! Dual encoders: separate towers of Transformers.js, or one network of Optimum.

use super::super::ModelError;
use super::super::bundle::{DualEncoderManifest, ImageTower, TextTower};
use super::super::dual_encoder::read_tokenizer;
use super::super::network::{Element, Port};
use super::pictures::Preprocessing;
use super::ports::{find, fixed};
use super::side_files::SideFiles;
use super::{About, Graph};

/// What a family of models has in common, and their files do not state.
struct Family {
    /// Whether the pooled output is the embedding. Other families project it.
    is_pooled: bool,
    /// Factor of cosines in the training's likelihoods.
    logit_scale: f32,
    /// The prompt that a noun is inserted into.
    template: &'static str,
    lowercase: bool,
    /// Length of a sentence where `config.json` leaves out the family's default.
    context_length: Option<usize>,
    /// Length of an embedding, likewise.
    dimension: Option<usize>,
}

/// CLIP, `MetaCLIP` and models with the same architecture. Their scale is trained up to its bound.
const CLIP: Family = Family {
    is_pooled: false,
    logit_scale: 100.0,
    template: "a photo of a {}.",
    lowercase: false,
    context_length: Some(77),
    dimension: Some(512),
};

/// `SigLIP` and `SigLIP` 2: the published models have scales of 110 to 118. Their bias shifts all
/// words alike and cancels where words are compared.
const SIGLIP: Family = Family {
    is_pooled: true,
    logit_scale: 115.0,
    template: "This is a photo of {}.",
    lowercase: true,
    context_length: Some(64),
    dimension: Some(768),
};

const OTHER: Family = Family { context_length: None, dimension: None, ..CLIP };

impl Family {
    fn of(model_type: &str) -> &'static Self {
        match model_type {
            "siglip" | "siglip2" => &SIGLIP,
            "clip" | "metaclip_2" => &CLIP,
            _ => &OTHER,
        }
    }
}

pub fn describe(
    image: &Graph,
    text: &Graph,
    side: &SideFiles,
    about: &About,
) -> Result<DualEncoderManifest, ModelError> {
    let family = Family::of(side.model_type());
    let known: &[&str] = match image.name == text.name {
        true => &["pixel_values", "input_ids", "attention_mask"],
        false => &["pixel_values"],
    };
    image.expect_only(known)?;
    let pixels = image.input(&["pixel_values"], Element::F32)?;
    let ids = text.input(&["input_ids"], Element::I64)?;
    let mask = match find(text.inputs(), &["attention_mask"]) {
        Some(_) => Some(text.input(&["attention_mask"], Element::I64)?.name.clone()),
        None => None,
    };
    if image.name != text.name {
        text.expect_only(&["input_ids", "attention_mask"])?;
    }
    let names = |projected: &'static str| match family.is_pooled {
        true => vec![projected, "pooler_output"],
        false => vec![projected],
    };
    let embedded = image.output(&names("image_embeds"))?;
    let worded = text.output(&names("text_embeds"))?;
    let embedding_dim = dimension(&[embedded, worded], side, family)
        .ok_or_else(|| image.wrong("neither the network nor config.json states its dimensions"))?;
    let pictures = Preprocessing::read(side)?;
    let [width, height] = pictures.size.map(|s| s as usize);
    if fixed(pixels, 0).is_some_and(|w| w != width) || fixed(pixels, 1).is_some_and(|h| h != height)
    {
        return Err(image.wrong(format!(
            "{} has the shape {:?}, but {} states {width} x {height} pixels",
            pixels.name, pixels.shape, side.pictures_file
        )));
    }
    Ok(DualEncoderManifest {
        name: about.name.clone(),
        embedding_dim,
        image: ImageTower {
            file: image.name.clone(),
            input: pixels.name.clone(),
            output: embedded.name.clone(),
            size: pictures.size,
            resize: pictures.resize,
            interpolation: pictures.interpolation,
            mean: pictures.mean,
            std: pictures.std,
            dynamic_batch: pixels.shape.first().is_none_or(|batch| *batch < 0),
        },
        text: TextTower {
            file: text.name.clone(),
            input_ids: ids.name.clone(),
            attention_mask: mask,
            output: worded.name.clone(),
            tokenizer: TOKENIZER.into(),
            context_length: context_length(ids, side, family).ok_or_else(|| {
                text.wrong("neither the network nor config.json states the length of a sentence")
            })?,
            pad_id: pad_id(side)?,
            lowercase: family.lowercase,
            template: family.template.into(),
        },
        logit_scale: family.logit_scale,
        licence: about.licence.clone(),
        source: about.source.clone(),
    })
}

const TOKENIZER: &str = "tokenizer.json";

fn dimension(outputs: &[&Port], side: &SideFiles, family: &Family) -> Option<usize> {
    outputs.iter().find_map(|port| fixed(port, 0).filter(|_| port.shape.len() == 2)).or_else(|| {
        let stated = match family.is_pooled {
            true => side.number(&["/text_config/projection_size", "/vision_config/hidden_size"]),
            false => side.number(&["/projection_dim"]),
        };
        stated.or(family.dimension)
    })
}

/// Limit of tokenizers without a limit: they state a huge number.
const MAX_CONTEXT: usize = 4096;

fn context_length(ids: &Port, side: &SideFiles, family: &Family) -> Option<usize> {
    let of_tokenizer = || {
        let length = side.tokenizer["model_max_length"].as_u64()?;
        usize::try_from(length).ok().filter(|length| (1..=MAX_CONTEXT).contains(length))
    };
    fixed(ids, 0)
        .or_else(|| side.number(&["/text_config/max_position_embeddings"]))
        .or_else(of_tokenizer)
        .or(family.context_length)
}

/// Returns the id of the padding token: the tokenizer's own, or that of the token that the
/// configurations name. `config.json` has another one for some CLIP models, so it comes last.
fn pad_id(side: &SideFiles) -> Result<u32, ModelError> {
    let file = side.folder.join(TOKENIZER);
    let wrong = |why: String| ModelError::Bundle { file: file.clone(), why };
    if !file.is_file() {
        return Err(wrong("the file is missing; it cuts sentences into tokens".into()));
    }
    let tokenizer = read_tokenizer(&file)?;
    if let Some(padding) = tokenizer.get_padding() {
        return Ok(padding.pad_id);
    }
    if side.tokenizer["padding_side"] == "left" {
        return Err(ModelError::Bundle {
            file: side.folder.join("tokenizer_config.json"),
            why: "padding_side is left, expected right".into(),
        });
    }
    if let Some(token) = side.pad_token() {
        return tokenizer
            .token_to_id(token)
            .ok_or_else(|| wrong(format!("does not have the padding token {token:?}")));
    }
    let stated = side.number(&["/text_config/pad_token_id"]).and_then(|id| u32::try_from(id).ok());
    stated.ok_or_else(|| wrong("no file states the padding token".into()))
}
