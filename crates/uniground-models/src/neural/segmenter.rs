//! A promptable segmenter: a picture is encoded once, then points in it are asked for masks (paper:
//! SAM; SAM 2 and `MobileSAM` alike).

use super::ModelError;
use super::bundle::{Bundle, SegmenterManifest, ValueRange};
use super::network::{Direction, Element, Input, Network, Tensor, Values};
use super::pixels::{append_planes, fit};
use image::RgbImage;
use serde::{Deserialize, Serialize};

/// Encoder and decoder, loaded and checked against their manifest.
pub struct Segmenter {
    manifest: SegmenterManifest,
    encoder: Box<dyn Network>,
    decoder: Box<dyn Network>,
}

/// A picture as the decoder wants it.
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

/// Points in picture pixels (column, row; 0 = centre of the first pixel), each with what it says of
/// what is wanted.
#[derive(Debug, Clone, PartialEq)]
pub struct Prompt {
    /// Each with what it means; a box is given by two of its corners.
    pub points: Vec<((f32, f32), PointLabel)>,
}

/// What a point of a prompt says about the thing that is wanted.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum PointLabel {
    /// The point lies beside it.
    Outside,
    /// The point lies on it.
    Inside,
    /// Corner of the box around it, least column and row.
    BoxTopLeft,
    /// Corner of the box around it, largest column and row.
    BoxBottomRight,
}

impl Prompt {
    /// Points that all lie on what is wanted, in picture pixels (column, row).
    #[must_use]
    pub fn inside(points: impl IntoIterator<Item = (f32, f32)>) -> Self {
        Self { points: points.into_iter().map(|p| (p, PointLabel::Inside)).collect() }
    }
}

/// One of the masks a prompt may mean, at the decoder's resolution.
#[derive(Debug, Clone, PartialEq)]
pub struct LowMask {
    /// Row-major, `mask_size` squared; above the threshold = inside.
    pub logits: Vec<f32>,
    /// The model's own opinion of the mask, its IoU with what was meant.
    pub predicted_iou: f32,
    /// Which of the decoder's masks this is.
    pub index: usize,
}

impl Segmenter {
    /// Checks the networks against the manifest and runs them once.
    ///
    /// # Errors
    /// [`ModelError`] naming file and tensor.
    pub fn new(
        bundle: &Bundle,
        manifest: &SegmenterManifest,
        encoder: Box<dyn Network>,
        decoder: Box<dyn Network>,
    ) -> Result<Self, ModelError> {
        let (e, d) = (&manifest.encoder, &manifest.decoder);
        let (encoder_file, decoder_file) = (bundle.path(&e.file), bundle.path(&d.file));
        let side = Some(e.size as usize);
        encoder.signature().expect(
            &encoder_file,
            Direction::In,
            &e.input,
            Element::F32,
            &[None, Some(3), side, side],
        )?;
        for (_, name) in e.outputs.each() {
            encoder.signature().expect(
                &encoder_file,
                Direction::Out,
                name,
                Element::F32,
                &[None; 4],
            )?;
        }
        for (_, name) in d.inputs.features.each() {
            decoder.signature().expect(
                &decoder_file,
                Direction::In,
                name,
                Element::F32,
                &[None; 4],
            )?;
        }
        decoder.signature().expect(
            &decoder_file,
            Direction::In,
            &d.inputs.point_coords,
            Element::F32,
            &[None, None, Some(2)],
        )?;
        decoder.signature().expect(
            &decoder_file,
            Direction::In,
            &d.inputs.point_labels,
            Element::F32,
            &[None, None],
        )?;
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
            &[None, Some(d.num_masks), low, low],
        )?;
        decoder.signature().expect(
            &decoder_file,
            Direction::Out,
            &d.outputs.iou,
            Element::F32,
            &[None, Some(d.num_masks)],
        )?;
        let segmenter = Self { manifest: manifest.clone(), encoder, decoder };
        // Whole batches in two places at once: what a parse will need is taken now, or the lack of
        // it told.
        let encoded = segmenter.encode(&RgbImage::new(64, 48))?;
        let batch = vec![Prompt::inside([(32.0, 24.0)]); segmenter.batch()];
        let (here, there) = rayon::join(
            || segmenter.decode(&encoded, &batch),
            || segmenter.decode(&encoded, &batch),
        );
        here.and(there)?;
        Ok(segmenter)
    }

    /// Width and height of the masks that come out.
    #[must_use]
    pub fn mask_size(&self) -> usize {
        self.manifest.decoder.mask_size
    }

    /// Prompts per call.
    #[must_use]
    pub fn batch(&self) -> usize {
        if self.manifest.decoder.dynamic_batch { self.manifest.decoder.max_batch } else { 1 }
    }

    /// Logit above which a pixel is inside a mask.
    #[must_use]
    pub fn threshold(&self) -> f32 {
        self.manifest.decoder.mask_threshold
    }

    /// Encodes a picture, once for all its prompts.
    ///
    /// # Errors
    /// [`ModelError`]: a failed call.
    pub fn encode(&self, picture: &RgbImage) -> Result<Encoded, ModelError> {
        let e = &self.manifest.encoder;
        let size = [e.size, e.size];
        let fitted = fit(picture, size, e.resize, e.interpolation);
        let divisor = match e.value_range {
            ValueRange::Bytes => 1.0,
            ValueRange::Unit => 255.0,
        };
        let mut values = Vec::new();
        append_planes(&fitted.picture, size, divisor, e.mean, e.std, &mut values);
        let side = e.size as usize;
        let input =
            Input { name: &e.input, shape: vec![1, 3, side, side], values: Values::F32(&values) };
        let names: Vec<&str> = self.roles().filter_map(|(role, _)| e.outputs.of(role)).collect();
        let made = self.encoder.run(&[input], &names)?;
        let features =
            made.into_iter().map(|Tensor { shape, values }| Feature { shape, values }).collect();
        Ok(Encoded { features, scale: fitted.scale })
    }

    /// The features the decoder reads, by role.
    fn roles(&self) -> impl Iterator<Item = (&'static str, &str)> {
        self.manifest.decoder.inputs.features.each()
    }

    /// The masks each prompt may mean: several for one point, the single one, where the model has
    /// one, for more.
    ///
    /// All prompts of a call have the same number of points: points that are none would be tokens
    /// of their own and change the answer.
    ///
    /// # Errors
    /// [`ModelError`]: a failed call.
    pub fn decode(
        &self,
        encoded: &Encoded,
        prompts: &[Prompt],
    ) -> Result<Vec<Vec<LowMask>>, ModelError> {
        let mut decoded = Vec::with_capacity(prompts.len());
        for alike in
            prompts.chunk_by(|a, b| a.points.len() == b.points.len() && a.has_box() == b.has_box())
        {
            for batch in alike.chunks(self.batch()) {
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
        let (count, low) = (prompts.len(), d.mask_size);
        let padded = d.pad_point && !prompts[0].has_box();
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
            shape: vec![count, points, 2],
            values: Values::F32(&coords),
        });
        inputs.push(Input {
            name: &d.inputs.point_labels,
            shape: vec![count, points],
            values: Values::F32(&labels),
        });
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
            return Err(self.wrong("two outputs were expected".into()));
        };
        if masks.shape != [count, d.num_masks, low, low] || iou.shape != [count, d.num_masks] {
            return Err(self.wrong(format!(
                "the outputs have the shapes {:?} and {:?}",
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

    fn wrong(&self, why: String) -> ModelError {
        ModelError::Run { network: self.manifest.decoder.file.clone(), why }
    }

    /// Where a picture's pixel lies on a low-resolution mask: low-resolution pixels per picture
    /// pixel, along x and y.
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
    /// The logit at a place of the picture: bilinear between the four nearest cells, the border
    /// continued. `(x, y)` are picture pixels, `scale` is [`Segmenter::low_scale`].
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
