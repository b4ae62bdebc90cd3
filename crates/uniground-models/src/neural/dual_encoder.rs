//! Pictures and words in one space (paper: the Perception Encoder; CLIP and `SigLIP` alike).

use super::ModelError;
use super::bundle::{Bundle, DualEncoderManifest, TextTower};
use super::network::{Direction, Element, Input, Network, Tensor, Values};
use super::pixels::{append_planes, fit};
use camino::Utf8PathBuf;
use image::{Rgb, RgbImage};
use std::collections::HashMap;
use std::sync::{Arc, Mutex, PoisonError};
use tokenizers::Tokenizer;

/// A sentence in the common space.
#[derive(Debug, Clone, PartialEq)]
pub struct TextEmbedding {
    /// Unit length; `None` when the tower knows none of the words.
    pub vector: Option<Arc<[f32]>>,
    /// The sentence was longer than the tower's context: its end was not read.
    pub cut: bool,
}

/// An image tower and a text tower.
pub struct DualEncoder {
    manifest: DualEncoderManifest,
    image: Box<dyn Network>,
    text: Box<dyn Network>,
    tokenizer: Tokenizer,
    /// Pictures per call.
    batch: usize,
    /// Queries come again: the same scene is asked the same things, and every phrase is looked up
    /// among the same names.
    queries: Mutex<HashMap<String, TextEmbedding>>,
}

/// Pictures per call where that changes no answer.
const BATCH: usize = 8;
/// Remembered queries; past that all are forgotten at once.
const MAX_QUERIES: usize = 20_000;
/// Embeddings of the same picture in different company agree at least this well, or pictures go
/// alone.
const INDEPENDENT: f32 = 0.9999;

impl DualEncoder {
    /// Checks the networks against the manifest and runs them once.
    ///
    /// # Errors
    /// [`ModelError`] naming file and tensor.
    pub fn new(
        bundle: &Bundle,
        manifest: &DualEncoderManifest,
        image: Box<dyn Network>,
        text: Box<dyn Network>,
    ) -> Result<Self, ModelError> {
        let [width, height] = manifest.image.size.map(|s| Some(s as usize));
        let (dim, context) = (Some(manifest.embedding_dim), Some(manifest.text.context_length));
        let (image_file, text_file) =
            (bundle.path(&manifest.image.file), bundle.path(&manifest.text.file));
        image.signature().expect(
            &image_file,
            Direction::In,
            &manifest.image.input,
            Element::F32,
            &[None, Some(3), height, width],
        )?;
        image.signature().expect(
            &image_file,
            Direction::Out,
            &manifest.image.output,
            Element::F32,
            &[None, dim],
        )?;
        text.signature().expect(
            &text_file,
            Direction::In,
            &manifest.text.input_ids,
            Element::I64,
            &[None, context],
        )?;
        if let Some(mask) = &manifest.text.attention_mask {
            text.signature().expect(
                &text_file,
                Direction::In,
                mask,
                Element::I64,
                &[None, context],
            )?;
        }
        text.signature().expect(
            &text_file,
            Direction::Out,
            &manifest.text.output,
            Element::F32,
            &[None, dim],
        )?;
        let tokenizer = tokenizer(bundle.path(&manifest.text.tokenizer), &manifest.text)?;
        let mut encoder = Self {
            manifest: manifest.clone(),
            image,
            text,
            tokenizer,
            batch: 1,
            queries: Mutex::default(),
        };
        encoder.compute_text("a red chair next to the table")?;
        encoder.batch =
            if manifest.image.dynamic_batch && encoder.is_independent()? { BATCH } else { 1 };
        Ok(encoder)
    }

    /// Length of an embedding; the same for pictures and words.
    #[must_use]
    pub fn dim(&self) -> usize {
        self.manifest.embedding_dim
    }

    /// Pictures per call: 1 where the network takes no more, or an embedding depends on its
    /// neighbours, as with activations quantised over the whole batch.
    #[must_use]
    pub fn batch(&self) -> usize {
        self.batch
    }

    /// One unit vector per picture. What is in the same call changes nothing.
    ///
    /// # Errors
    /// [`ModelError`]: a failed call, or a picture without an embedding.
    pub fn embed_pictures(&self, pictures: &[RgbImage]) -> Result<Vec<Vec<f32>>, ModelError> {
        let mut embedded = Vec::with_capacity(pictures.len());
        for batch in pictures.chunks(self.batch) {
            embedded.extend(self.embed_batch(batch)?);
        }
        Ok(embedded)
    }

    fn embed_batch(&self, pictures: &[RgbImage]) -> Result<Vec<Vec<f32>>, ModelError> {
        let tower = &self.manifest.image;
        let [width, height] = tower.size.map(|s| s as usize);
        let mut values = Vec::with_capacity(pictures.len() * 3 * width * height);
        for picture in pictures {
            let fitted = fit(picture, tower.size, tower.resize, tower.interpolation);
            append_planes(&fitted.picture, tower.size, 255.0, tower.mean, tower.std, &mut values);
        }
        let input = Input {
            name: &tower.input,
            shape: vec![pictures.len(), 3, height, width],
            values: Values::F32(&values),
        };
        let made = self.image.run(&[input], &[&tower.output])?;
        let rows = self.rows(&tower.file, &tower.output, made, pictures.len())?;
        let failed = || ModelError::Run {
            network: tower.file.clone(),
            why: "a picture has the embedding zero".into(),
        };
        rows.chunks_exact(self.dim()).map(|row| normalised(row).ok_or_else(failed)).collect()
    }

    /// The output as rows, if it has the shape that was declared.
    fn rows(
        &self,
        file: &str,
        tensor: &str,
        made: Vec<Tensor>,
        count: usize,
    ) -> Result<Vec<f32>, ModelError> {
        match made.into_iter().next() {
            Some(Tensor { shape, values }) if shape == [count, self.dim()] => Ok(values),
            other => Err(ModelError::Run {
                network: file.into(),
                why: format!(
                    "{tensor} has the shape {:?}, expected [{count}, {}]",
                    other.map(|t| t.shape),
                    self.dim()
                ),
            }),
        }
    }

    /// A sentence in the common space, computed once.
    ///
    /// # Errors
    /// [`ModelError`]: a failed call.
    pub fn embed_text(&self, text: &str) -> Result<TextEmbedding, ModelError> {
        let known = |queries: &Mutex<HashMap<String, TextEmbedding>>| {
            queries.lock().unwrap_or_else(PoisonError::into_inner).get(text).cloned()
        };
        if let Some(embedding) = known(&self.queries) {
            return Ok(embedding);
        }
        let embedding = self.compute_text(text)?;
        let mut queries = self.queries.lock().unwrap_or_else(PoisonError::into_inner);
        if queries.len() >= MAX_QUERIES {
            queries.clear();
        }
        queries.insert(text.to_owned(), embedding.clone());
        Ok(embedding)
    }

    /// A noun in the common space, put into the words the tower was trained with.
    ///
    /// # Errors
    /// [`ModelError`]: a failed call.
    pub fn embed_name(&self, noun: &str) -> Result<TextEmbedding, ModelError> {
        self.embed_text(&self.manifest.text.template.replacen("{}", noun, 1))
    }

    /// What cosines are multiplied with to become likelihoods.
    #[must_use]
    pub fn logit_scale(&self) -> f32 {
        self.manifest.logit_scale
    }

    fn compute_text(&self, text: &str) -> Result<TextEmbedding, ModelError> {
        let tower = &self.manifest.text;
        let Tokens { ids, mask, cut } = self.tokens(text)?;
        let shape = vec![1, tower.context_length];
        let mut inputs =
            vec![Input { name: &tower.input_ids, shape: shape.clone(), values: Values::I64(&ids) }];
        if let Some(name) = &tower.attention_mask {
            inputs.push(Input { name, shape, values: Values::I64(&mask) });
        }
        let made = self.text.run(&inputs, &[&tower.output])?;
        let row = self.rows(&tower.file, &tower.output, made, 1)?;
        Ok(TextEmbedding { vector: normalised(&row).map(Into::into), cut })
    }

    fn tokens(&self, text: &str) -> Result<Tokens, ModelError> {
        let failed =
            |why: String| ModelError::Run { network: self.manifest.text.tokenizer.clone(), why };
        let encoding = self.tokenizer.encode(text, true).map_err(|e| failed(e.to_string()))?;
        if encoding.len() != self.manifest.text.context_length {
            return Err(failed(format!(
                "{} tokens, the text tower reads {}",
                encoding.len(),
                self.manifest.text.context_length
            )));
        }
        Ok(Tokens {
            ids: encoding.get_ids().iter().copied().map(i64::from).collect(),
            mask: encoding.get_attention_mask().iter().copied().map(i64::from).collect(),
            cut: !encoding.get_overflowing().is_empty(),
        })
    }

    /// Whether a picture's embedding is the same alone and in company.
    fn is_independent(&self) -> Result<bool, ModelError> {
        let [width, height] = self.manifest.image.size;
        let noise = |salt: u32| {
            RgbImage::from_fn(width, height, |x, y| {
                let mixed = (x.wrapping_mul(0x9e37_79b1) ^ y.wrapping_mul(0x85eb_ca6b) ^ salt)
                    .wrapping_mul(0xc2b2_ae35);
                Rgb([(mixed >> 24) as u8, (mixed >> 16) as u8, (mixed >> 8) as u8])
            })
        };
        // One flat and dark, one loud: their ranges differ as much as ranges can.
        let pictures = [RgbImage::from_pixel(width, height, Rgb([40, 44, 50])), noise(1)];
        let together = self.embed_batch(&pictures)?;
        for (picture, in_company) in pictures.iter().zip(together) {
            let alone = self.embed_batch(std::slice::from_ref(picture))?.remove(0);
            if dot(&alone, &in_company) < INDEPENDENT {
                return Ok(false);
            }
        }
        Ok(true)
    }
}

struct Tokens {
    ids: Vec<i64>,
    mask: Vec<i64>,
    cut: bool,
}

/// Reads a tokenizer and holds it to the tower's context.
fn tokenizer(file: Utf8PathBuf, tower: &TextTower) -> Result<Tokenizer, ModelError> {
    let context_length = tower.context_length;
    let wrong = |why: String| ModelError::Bundle { file: file.clone(), why };
    let tokenizer = Tokenizer::from_file(&file).map_err(|e| wrong(e.to_string()))?;
    let short = tokenizer.encode("a", true).map_err(|e| wrong(e.to_string()))?;
    let found = short.len();
    let truncation = tokenizer.get_truncation().map(|t| t.max_length);
    if found != context_length || truncation != Some(context_length) {
        let truncation =
            truncation.map_or("nothing".to_owned(), |length| format!("{length} tokens"));
        return Err(wrong(format!(
            "pads to {found} tokens and cuts at {truncation}, the text tower reads {context_length}: tokenizer and tower disagree"
        )));
    }
    match short.get_ids().last() {
        Some(&pad) if pad == tower.pad_id => Ok(tokenizer),
        other => {
            Err(wrong(format!("pads with {other:?}, the text tower expects {}", tower.pad_id)))
        }
    }
}

/// Unit length, or nothing for the zero vector.
#[must_use]
pub fn normalised(vector: &[f32]) -> Option<Vec<f32>> {
    let norm = vector.iter().map(|v| f64::from(*v) * f64::from(*v)).sum::<f64>().sqrt() as f32;
    (norm > 1e-6).then(|| vector.iter().map(|v| v / norm).collect())
}

fn dot(a: &[f32], b: &[f32]) -> f32 {
    a.iter().zip(b).map(|(x, y)| x * y).sum()
}
