//! Promptable segmenters: SAM and SAM 2 of Transformers.js and Optimum, and networks with the tensor
//! names of SAM's own export script.

use super::super::ModelError;
use super::super::bundle::{
    DecoderInputs, DecoderOutputs, Family, FeatureNames, Interpolation, Resize, SegmenterDecoder,
    SegmenterEncoder, SegmenterManifest, ValueRange,
};
use super::super::network::{Element, Port};
use super::pictures::Preprocessing;
use super::ports::{find, fixed};
use super::side_files::SideFiles;
use super::{About, Graph};

/// Prompts per call on a CPU, where more take proportionally longer, and on a GPU.
const MAX_BATCH: usize = 2;
const ACCELERATED_BATCH: u16 = 32;

/// Mean and deviation of `ImageNet`'s colors, which all models of the family use.
const MEAN: [f32; 3] = [0.485, 0.456, 0.406];
const STD: [f32; 3] = [0.229, 0.224, 0.225];

/// Side of the input of SAM's encoders, pixels.
const SAM_SIZE: u32 = 1024;

/// What the encoder gives to the decoder.
struct Features {
    family: Family,
    made: FeatureNames,
    read: FeatureNames,
}

pub fn describe(
    encoder: &Graph,
    decoder: &Graph,
    side: &SideFiles,
    about: &About,
) -> Result<SegmenterManifest, ModelError> {
    let pixels =
        encoder.input(&["pixel_values", "image", "images", "input_image"], Element::F32)?;
    encoder.expect_only(&[&pixels.name])?;
    if !matches!(pixels.shape.len(), 3 | 4) {
        return Err(encoder.wrong(format!(
            "{} has the shape {:?}, expected [1, 3, height, width] or [height, width, 3]",
            pixels.name, pixels.shape
        )));
    }
    let features = features(encoder, decoder)?;
    let points = decoder.input(&["input_points", "point_coords"], Element::F32)?;
    let labels = find(decoder.inputs(), &["input_labels", "point_labels"])
        .ok_or_else(|| decoder.wrong("expected an input input_labels or point_labels"))?;
    let name_of = |names: &[&str]| find(decoder.inputs(), names).map(|port| port.name.clone());
    let inputs = DecoderInputs {
        features: features.read,
        point_coords: points.name.clone(),
        point_labels: labels.name.clone(),
        boxes: name_of(&["input_boxes"]),
        // Optimum's export of the first SAM has no embeddings for corners among its labels.
        box_corners: points.name != "input_points" || features.family == Family::Sam2,
        mask_input: name_of(&["mask_input"]),
        has_mask_input: name_of(&["has_mask_input"]),
        orig_im_size: name_of(&["orig_im_size"]),
    };
    expect_only_known(decoder, &inputs)?;
    let masks = decoder.output(&["pred_masks", "low_res_masks", "masks"])?;
    if masks.name == "masks" && inputs.orig_im_size.is_some() {
        return Err(decoder.wrong(
            "has only masks of the picture's size; export it with the output low_res_masks",
        ));
    }
    let iou = decoder.output(&["iou_scores", "iou_predictions"])?;
    let pictures = preprocessing(side, pixels, &inputs, features.family, encoder)?;
    let is_official = points.name == "point_coords" && features.family == Family::Sam;
    // SAM's own export has the answer for several points first, then three for a single one.
    let num_masks =
        fixed(masks, 2).or_else(|| fixed(iou, 0)).unwrap_or(if is_official { 4 } else { 3 });
    let has_single = is_official && num_masks == 4;
    let batch_dimension = points.shape.len().saturating_sub(3);
    let dynamic_batch = points.shape.get(batch_dimension).is_none_or(|batch| *batch < 0);
    Ok(SegmenterManifest {
        family: features.family,
        name: about.name.clone(),
        encoder: SegmenterEncoder {
            file: encoder.name.clone(),
            input: pixels.name.clone(),
            outputs: features.made,
            size: pictures.size[0],
            resize: pictures.resize,
            interpolation: pictures.interpolation,
            value_range: ValueRange::Unit,
            mean: pictures.mean,
            std: pictures.std,
        },
        decoder: SegmenterDecoder {
            file: decoder.name.clone(),
            mask_size: fixed(masks, 0)
                .or_else(|| side.number(&["/mask_decoder_config/mask_size"]))
                .unwrap_or_else(|| low_size(pictures.size[0] as usize, side)),
            outputs: DecoderOutputs { masks: masks.name.clone(), iou: iou.name.clone() },
            // With a list of boxes, Transformers leaves the padding to the caller.
            pad_point: is_official || inputs.boxes.is_some(),
            inputs,
            num_masks,
            multimask_first: usize::from(has_single),
            single_mask: has_single.then_some(0),
            dynamic_batch,
            max_batch: MAX_BATCH,
            accelerated_batch: Some(ACCELERATED_BATCH),
            mask_threshold: 0.0,
        },
        licence: about.licence.clone(),
        source: about.source.clone(),
    })
}

/// Returns the side of a mask before it is enlarged: four per patch of the picture's embedding.
fn low_size(size: usize, side: &SideFiles) -> usize {
    let patch = side.number(&["/prompt_encoder_config/patch_size", "/vision_config/patch_size"]);
    size / patch.unwrap_or(16).max(1) * 4
}

fn features(encoder: &Graph, decoder: &Graph) -> Result<Features, ModelError> {
    // Transformers numbers three levels, the finest one first.
    let levels = ["image_embeddings.0", "image_embeddings.1", "image_embeddings.2"];
    let finest = [levels[0], "high_res_feats_0"];
    let finer = [levels[1], "high_res_feats_1"];
    let whole = [levels[2], "image_embed", "image_embeddings"];
    let positions = ["image_positional_embeddings"];
    let names = |ports: &[Port]| {
        let name = |names: &[&str]| find(ports, names).map(|port| port.name.clone());
        FeatureNames {
            image_embed: name(&whole),
            high_res_feats_0: name(&finest),
            high_res_feats_1: name(&finer),
            image_positions: name(&positions),
        }
    };
    let (mut made, read) = (names(encoder.outputs()), names(decoder.inputs()));
    // A single output needs no name.
    if made.image_embed.is_none()
        && let [only] = encoder.outputs()
    {
        made.image_embed = Some(only.name.clone());
    }
    for (graph, feature) in [(encoder, &made.image_embed), (decoder, &read.image_embed)] {
        if feature.is_none() {
            return Err(graph.wrong(format!("expected {}", whole.join(" or "))));
        }
    }
    if let Some((role, name)) = read.iter().find(|(role, _)| made.get(role).is_none()) {
        return Err(
            encoder.wrong(format!("does not give {role}, which the decoder reads ({name})"))
        );
    }
    let family = match (&read.high_res_feats_0, &read.high_res_feats_1) {
        (Some(_), Some(_)) => Family::Sam2,
        (None, None) => Family::Sam,
        _ => return Err(decoder.wrong("reads only one of the two finer levels of features")),
    };
    if family == Family::Sam {
        (made.high_res_feats_0, made.high_res_feats_1) = (None, None);
    }
    Ok(Features { family, made, read })
}

fn expect_only_known(decoder: &Graph, inputs: &DecoderInputs) -> Result<(), ModelError> {
    let optional =
        [&inputs.boxes, &inputs.mask_input, &inputs.has_mask_input, &inputs.orig_im_size];
    let mut known: Vec<&str> = inputs.features.iter().map(|(_, name)| name).collect();
    known.extend([inputs.point_coords.as_str(), inputs.point_labels.as_str()]);
    known.extend(optional.into_iter().flatten().map(String::as_str));
    decoder.expect_only(&known)
}

/// Returns how pictures are prepared: as the configuration states, or as the family is known to be
/// for networks without one.
fn preprocessing(
    side: &SideFiles,
    pixels: &Port,
    inputs: &DecoderInputs,
    family: Family,
    encoder: &Graph,
) -> Result<Preprocessing, ModelError> {
    let interpolation = Interpolation::Bilinear;
    if pixels.shape.len() == 3 {
        // The network normalizes and pads to the size that all of SAM's encoders have.
        return Ok(Preprocessing {
            size: [SAM_SIZE; 2],
            resize: Resize::LongestPad,
            interpolation,
            mean: [0.0; 3],
            std: [1.0; 3],
        });
    }
    let fixed_size = fixed(pixels, 0).and_then(|size| u32::try_from(size).ok());
    let pictures = match side.pictures.is_null() {
        false => Preprocessing::read(side)?,
        true if inputs.point_coords == "point_coords" => {
            let size = fixed_size.ok_or_else(|| {
                encoder.wrong("neither the network nor preprocessor_config.json states its size")
            })?;
            let resize = if family == Family::Sam2 { Resize::Squash } else { Resize::LongestPad };
            Preprocessing { size: [size, size], resize, interpolation, mean: MEAN, std: STD }
        }
        true => return Preprocessing::read(side),
    };
    let [width, height] = pictures.size;
    if width != height || fixed_size.is_some_and(|size| size != width) {
        return Err(encoder.wrong(format!(
            "{} has the shape {:?}, but pictures of {width} x {height} pixels are configured",
            pixels.name, pixels.shape
        )));
    }
    Ok(pictures)
}
