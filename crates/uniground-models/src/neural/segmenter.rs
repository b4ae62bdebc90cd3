//! A promptable segmenter: a picture is encoded once, then masks are computed from points in it
//! (paper: SAM; also SAM 2, `MobileSAM` and `EdgeTAM`).

use super::ModelError;
use super::bundle::{Bundle, Family, SegmenterManifest, ValueRange};
use super::network::{Direction, Element, Input, Network, Pattern, Tensor, Values};
use super::pixels::{append_planes, resize_to_fit};
use image::RgbImage;
use serde::{Deserialize, Serialize};
use std::time::Instant;

/// Encoder and decoder, loaded and checked against their manifest.
pub struct Segmenter {
    manifest: SegmenterManifest,
    encoder: Box<dyn Network>,
    decoder: Box<dyn Network>,
    /// Whether the encoder reads pixels, `[height, width, 3]` of values 0 to 255, and normalizes
    /// and pads them itself.
    reads_pixels: bool,
    layout: PromptLayout,
    /// Seconds per picture and per prompt, measured when the networks were loaded.
    measured_s: (f32, f32),
}

/// The shapes and types that a decoder declares for its prompts.
#[derive(Debug, Clone, Copy)]
struct PromptLayout {
    /// Whether prompts follow a dimension of pictures: `[1, prompts, points, 2]`.
    by_picture: bool,
    /// Whether labels are integers.
    integer_labels: bool,
}

impl PromptLayout {
    /// Returns a shape of this layout: `shape` begins with the number of prompts.
    fn shape(self, shape: &[usize]) -> Vec<usize> {
        let leading: &[usize] = if self.by_picture { &[1] } else { &[] };
        [leading, shape].concat()
    }

    /// Returns a required shape of this layout.
    fn pattern(self, pattern: Pattern) -> Vec<Option<usize>> {
        let leading: &[Option<usize>] = if self.by_picture { &[Some(1)] } else { &[] };
        [leading, pattern].concat()
    }
}

/// The encoded picture, the input of the decoder.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Encoded {
    features: Vec<Feature>,
    /// Network pixels per picture pixel.
    scale: (f32, f32),
}

#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
struct Feature {
    shape: Vec<usize>,
    values: Vec<f32>,
}

/// A prompt: points in picture pixels (column, row; 0 = center of the first pixel), each with a
/// label.
#[derive(Debug, Clone, PartialEq)]
pub struct Prompt {
    /// Points with labels. A box is given by two of its corners.
    pub points: Vec<((f32, f32), PointLabel)>,
}

/// The relation of a prompt's point to the wanted object.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum PointLabel {
    /// The point lies outside of the object.
    Outside,
    /// The point lies on the object.
    Inside,
    /// Corner of the object's box with the smallest column and row.
    BoxTopLeft,
    /// Corner of the object's box with the largest column and row.
    BoxBottomRight,
}

impl Prompt {
    /// Creates a prompt of points that all lie on the object, in picture pixels (column, row).
    #[must_use]
    pub fn from_inside_points(points: impl IntoIterator<Item = (f32, f32)>) -> Self {
        Self { points: points.into_iter().map(|p| (p, PointLabel::Inside)).collect() }
    }

    /// Creates a prompt of the object's box, in picture pixels (column, row).
    #[must_use]
    pub fn from_box(top_left: (f32, f32), bottom_right: (f32, f32)) -> Self {
        let corners =
            [(top_left, PointLabel::BoxTopLeft), (bottom_right, PointLabel::BoxBottomRight)];
        Self { points: corners.to_vec() }
    }
}

/// A candidate mask for a prompt, at the decoder's resolution.
#[derive(Debug, Clone, PartialEq)]
pub struct LowMask {
    /// Row-major, `mask_size` squared. Above the threshold: inside.
    pub logits: Vec<f32>,
    /// The model's estimate of the mask's IoU with the wanted object.
    pub predicted_iou: f32,
    /// Index among the decoder's masks.
    pub index: usize,
}

impl Segmenter {
    /// Checks the networks against the manifest and runs them once.
    ///
    /// # Errors
    /// Returns a [`ModelError`] that names the file and the tensor.
    pub fn new(
        bundle: &Bundle,
        manifest: &SegmenterManifest,
        encoder: Box<dyn Network>,
        decoder: Box<dyn Network>,
    ) -> Result<Self, ModelError> {
        let (e, d) = (&manifest.encoder, &manifest.decoder);
        let (encoder_file, decoder_file) = (bundle.path(&e.file), bundle.path(&d.file));
        let side = Some(e.size as usize);
        let has_rank = |network: &dyn Network, name: &str, rank: usize| {
            let port = network.signature().inputs.iter().find(|port| port.name == name);
            port.is_some_and(|port| port.shape.len() == rank)
        };
        let reads_pixels = has_rank(encoder.as_ref(), &e.input, 3);
        let pixels: Pattern =
            if reads_pixels { &[None, None, Some(3)] } else { &[None, Some(3), side, side] };
        encoder.signature().expect(&encoder_file, Direction::In, &e.input, Element::F32, pixels)?;
        for (_, name) in e.outputs.iter() {
            encoder.signature().expect(
                &encoder_file,
                Direction::Out,
                name,
                Element::F32,
                &[None; 4],
            )?;
        }
        for (_, name) in d.inputs.features.iter() {
            decoder.signature().expect(
                &decoder_file,
                Direction::In,
                name,
                Element::F32,
                &[None; 4],
            )?;
        }
        let labels =
            decoder.signature().inputs.iter().find(|port| port.name == d.inputs.point_labels);
        let layout = PromptLayout {
            by_picture: has_rank(decoder.as_ref(), &d.inputs.point_coords, 4),
            integer_labels: labels.is_some_and(|port| port.element == Element::I64),
        };
        decoder.signature().expect(
            &decoder_file,
            Direction::In,
            &d.inputs.point_coords,
            Element::F32,
            &layout.pattern(&[None, None, Some(2)]),
        )?;
        decoder.signature().expect(
            &decoder_file,
            Direction::In,
            &d.inputs.point_labels,
            if layout.integer_labels { Element::I64 } else { Element::F32 },
            &layout.pattern(&[None, None]),
        )?;
        if let Some(name) = &d.inputs.boxes {
            decoder.signature().expect(
                &decoder_file,
                Direction::In,
                name,
                Element::F32,
                &[None, None, Some(4)],
            )?;
        }
        let low = Some(d.mask_size);
        if let Some(name) = &d.inputs.mask_input {
            decoder.signature().expect(
                &decoder_file,
                Direction::In,
                name,
                Element::F32,
                &[None, Some(1), low, low],
            )?;
        }
        decoder.signature().expect(
            &decoder_file,
            Direction::Out,
            &d.outputs.masks,
            Element::F32,
            &layout.pattern(&[None, Some(d.num_masks), low, low]),
        )?;
        decoder.signature().expect(
            &decoder_file,
            Direction::Out,
            &d.outputs.iou,
            Element::F32,
            &layout.pattern(&[None, Some(d.num_masks)]),
        )?;
        let mut segmenter = Self {
            manifest: manifest.clone(),
            encoder,
            decoder,
            reads_pixels,
            layout,
            measured_s: (0.0, 0.0),
        };
        // Full batches in two sessions at once: the memory that a parse needs is allocated now, or
        // its lack is reported.
        let start = Instant::now();
        let encoded = segmenter.encode(&RgbImage::new(64, 48))?;
        let encode_s = start.elapsed().as_secs_f32();
        let batch = vec![Prompt::from_inside_points([(32.0, 24.0)]); segmenter.batch_size()];
        let start = Instant::now();
        let (here, there) = rayon::join(
            || segmenter.decode(&encoded, &batch),
            || segmenter.decode(&encoded, &batch),
        );
        here.and(there)?;
        let prompt_s = start.elapsed().as_secs_f32() / (2 * batch.len()) as f32;
        segmenter.measured_s = (encode_s, prompt_s);
        Ok(segmenter)
    }

    /// Returns the seconds that one picture took when the model was loaded.
    #[must_use]
    pub fn picture_s(&self) -> f32 {
        self.measured_s.0
    }

    /// Returns the seconds per prompt, with two calls at once, when the model was loaded.
    #[must_use]
    pub fn prompt_s(&self) -> f32 {
        self.measured_s.1
    }

    /// Returns the width and height of the output masks.
    #[must_use]
    pub fn mask_size(&self) -> usize {
        self.manifest.decoder.mask_size
    }

    /// Returns the number of prompts per call.
    #[must_use]
    pub fn batch_size(&self) -> usize {
        if self.manifest.decoder.dynamic_batch { self.manifest.decoder.max_batch } else { 1 }
    }

    /// Returns the logit above which a pixel is inside a mask.
    #[must_use]
    pub fn threshold(&self) -> f32 {
        self.manifest.decoder.mask_threshold
    }

    /// Encodes a picture, once for all its prompts.
    ///
    /// # Errors
    /// Returns a [`ModelError`]: a failed call.
    pub fn encode(&self, picture: &RgbImage) -> Result<Encoded, ModelError> {
        let e = &self.manifest.encoder;
        let size = [e.size, e.size];
        let fitted = resize_to_fit(picture, size, e.resize, e.interpolation);
        let divisor = match e.value_range {
            ValueRange::Bytes => 1.0,
            ValueRange::Unit => 255.0,
        };
        let mut values = Vec::new();
        let shape = if self.reads_pixels {
            values.extend(fitted.picture.as_raw().iter().map(|value| f32::from(*value)));
            vec![fitted.picture.height() as usize, fitted.picture.width() as usize, 3]
        } else {
            append_planes(&fitted.picture, size, divisor, e.mean, e.std, &mut values);
            vec![1, 3, e.size as usize, e.size as usize]
        };
        let input = Input { name: &e.input, shape, values: Values::F32(&values) };
        let names: Vec<&str> = self.roles().filter_map(|(role, _)| e.outputs.get(role)).collect();
        let made = self.encoder.run(&[input], &names)?;
        let features =
            made.into_iter().map(|Tensor { shape, values }| Feature { shape, values }).collect();
        Ok(Encoded { features, scale: fitted.scale })
    }

    /// Returns the features that the decoder reads, by role.
    fn roles(&self) -> impl Iterator<Item = (&'static str, &str)> {
        self.manifest.decoder.inputs.features.iter()
    }

    /// Returns the candidate masks of each prompt: several masks for one point; for more points the
    /// single mask, if the model has one.
    ///
    /// All prompts of a call have the same number of points. Padding points would be tokens of
    /// their own and change the answer.
    ///
    /// # Errors
    /// Returns a [`ModelError`]: a failed call.
    pub fn decode(
        &self,
        encoded: &Encoded,
        prompts: &[Prompt],
    ) -> Result<Vec<Vec<LowMask>>, ModelError> {
        let mut decoded = Vec::with_capacity(prompts.len());
        for alike in
            prompts.chunk_by(|a, b| a.points.len() == b.points.len() && a.has_box() == b.has_box())
        {
            for batch in alike.chunks(self.batch_size()) {
                decoded.extend(self.decode_batch(encoded, batch)?);
            }
        }
        Ok(decoded)
    }

    fn decode_batch(
        &self,
        encoded: &Encoded,
        prompts: &[Prompt],
    ) -> Result<Vec<Vec<LowMask>>, ModelError> {
        let d = &self.manifest.decoder;
        if !d.inputs.box_corners && prompts.iter().any(Prompt::has_box) {
            return Err(self.decoder_error("this network takes no boxes".into()));
        }
        let (count, low) = (prompts.len(), d.mask_size);
        // SAM 2 reads a box as two points; SAM has embeddings of its own for it.
        let padded = d.pad_point && (self.manifest.family == Family::Sam2 || !prompts[0].has_box());
        let points = prompts[0].points.len() + usize::from(padded);
        let (mut coords, mut labels) =
            (Vec::with_capacity(count * points * 2), Vec::with_capacity(count * points));
        for prompt in prompts {
            for &((x, y), label) in &prompt.points {
                coords.extend([x * encoded.scale.0, y * encoded.scale.1]);
                labels.push(label.value());
            }
            if padded {
                coords.extend([0.0, 0.0]);
                labels.push(-1.0);
            }
        }
        let mut inputs: Vec<Input> = self
            .roles()
            .zip(&encoded.features)
            .map(|((_, name), f)| Input {
                name,
                shape: f.shape.clone(),
                values: Values::F32(&f.values),
            })
            .collect();
        inputs.push(Input {
            name: &d.inputs.point_coords,
            shape: self.layout.shape(&[count, points, 2]),
            values: Values::F32(&coords),
        });
        let integers: Vec<i64> = labels.iter().map(|label| *label as i64).collect();
        inputs.push(Input {
            name: &d.inputs.point_labels,
            shape: self.layout.shape(&[count, points]),
            values: match self.layout.integer_labels {
                true => Values::I64(&integers),
                false => Values::F32(&labels),
            },
        });
        if let Some(name) = &d.inputs.boxes {
            inputs.push(Input { name, shape: vec![1, 0, 4], values: Values::F32(&[]) });
        }
        let enlarged = [low as f32; 2];
        if let Some(name) = &d.inputs.orig_im_size {
            inputs.push(Input { name, shape: vec![2], values: Values::F32(&enlarged) });
        }
        let no_mask = vec![0.0; count * low * low];
        if let (Some(mask), Some(has_mask)) = (&d.inputs.mask_input, &d.inputs.has_mask_input) {
            inputs.push(Input {
                name: mask,
                shape: vec![count, 1, low, low],
                values: Values::F32(&no_mask),
            });
            inputs.push(Input { name: has_mask, shape: vec![1], values: Values::F32(&[0.0]) });
        }
        let made = self.decoder.run(&inputs, &[&d.outputs.masks, &d.outputs.iou])?;
        let [masks, iou] = &made[..] else {
            return Err(self.decoder_error("expected two outputs".into()));
        };
        if masks.shape != self.layout.shape(&[count, d.num_masks, low, low])
            || iou.shape != self.layout.shape(&[count, d.num_masks])
        {
            return Err(self.decoder_error(format!(
                "unexpected output shapes {:?} and {:?}",
                masks.shape, iou.shape
            )));
        }
        Ok((0..count)
            .map(|i| {
                let choice = match d.single_mask {
                    Some(single) if prompts[i].points.len() > 1 => single..single + 1,
                    _ => d.multimask_first..d.num_masks,
                };
                choice
                    .map(|index| {
                        let at = i * d.num_masks + index;
                        LowMask {
                            logits: masks.values[at * low * low..(at + 1) * low * low].to_vec(),
                            predicted_iou: iou.values[at],
                            index,
                        }
                    })
                    .collect()
            })
            .collect())
    }

    fn decoder_error(&self, why: String) -> ModelError {
        ModelError::Run { network: self.manifest.decoder.file.clone(), why }
    }

    /// Returns whether prompts may be boxes.
    #[must_use]
    pub fn takes_boxes(&self) -> bool {
        self.manifest.decoder.inputs.box_corners
    }

    /// Returns low-resolution mask pixels per picture pixel, along x and y.
    #[must_use]
    pub fn low_scale(&self, encoded: &Encoded) -> (f32, f32) {
        let k = self.manifest.decoder.mask_size as f32 / self.manifest.encoder.size as f32;
        (encoded.scale.0 * k, encoded.scale.1 * k)
    }
}

impl Prompt {
    fn has_box(&self) -> bool {
        self.points
            .iter()
            .any(|(_, label)| matches!(label, PointLabel::BoxTopLeft | PointLabel::BoxBottomRight))
    }
}

impl PointLabel {
    fn value(self) -> f32 {
        match self {
            Self::Outside => 0.0,
            Self::Inside => 1.0,
            Self::BoxTopLeft => 2.0,
            Self::BoxBottomRight => 3.0,
        }
    }
}

impl LowMask {
    /// Returns the logit at a position in the picture: bilinear between the four nearest cells,
    /// with the border extended. `(x, y)` are picture pixels, `scale` is [`Segmenter::low_scale`].
    #[must_use]
    pub fn at(&self, (x, y): (f32, f32), scale: (f32, f32)) -> f32 {
        let size = self.logits.len().isqrt();
        let last = size as f32 - 1.0;
        let u = ((x + 0.5) * scale.0 - 0.5).clamp(0.0, last);
        let v = ((y + 0.5) * scale.1 - 0.5).clamp(0.0, last);
        let (u0, v0) = (u as usize, v as usize);
        let (u1, v1) = ((u0 + 1).min(size - 1), (v0 + 1).min(size - 1));
        let (fu, fv) = (u - u0 as f32, v - v0 as f32);
        let row =
            |v: usize| self.logits[v * size + u0] * (1.0 - fu) + self.logits[v * size + u1] * fu;
        row(v0) * (1.0 - fv) + row(v1) * fv
    }
}
