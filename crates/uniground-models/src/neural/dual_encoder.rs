//! Embeds pictures and words in one space (paper: the Perception Encoder; also CLIP and `SigLIP`).

use super::ModelError;
use super::bundle::{Bundle, DualEncoderManifest, ImageTower, TextTower};
use super::network::{Direction, Element, Input, Network, Tensor, Values};
use super::pixels::{append_planes, resize_to_fit};
use camino::{Utf8Path, Utf8PathBuf};
use image::{Rgb, RgbImage};
use std::collections::HashMap;
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Instant;
use tokenizers::{PaddingParams, PaddingStrategy, Tokenizer, TruncationParams};

/// The embedding of a sentence.
#[derive(Debug, Clone, PartialEq)]
pub struct TextEmbedding {
    /// Unit length. `None` when the text tower knows none of the words.
    pub vector: Option<Arc<[f32]>>,
    /// Whether the sentence was longer than the tower's context and was truncated.
    pub cut: bool,
}

/// An image tower and a text tower.
pub struct DualEncoder {
    manifest: DualEncoderManifest,
    image: Arc<dyn Network>,
    /// The same network as `image` where both towers are one file.
    text: Arc<dyn Network>,
    /// What a call for pictures feeds to the text inputs, and the other way round. Empty for
    /// separate towers.
    blank: BlankInputs,
    tokenizer: Tokenizer,
    /// Number of pictures per call.
    batch: usize,
    /// Seconds per picture, measured when the networks were loaded.
    picture_s: f32,
    /// Cache of queries. Queries repeat: the same scene gets the same questions, and every phrase
    /// is compared with the same names.
    queries: Mutex<HashMap<String, TextEmbedding>>,
}

/// Values for the inputs of the tower that a call does not need. A runtime demands all inputs of a
/// network.
#[derive(Default)]
struct BlankInputs {
    ids: Vec<i64>,
    mask: Vec<i64>,
    picture: Vec<f32>,
}

/// Number of pictures per call if batching does not change the results.
const BATCH: usize = 8;
/// Maximum number of cached queries. When it is exceeded, the whole cache is cleared.
const MAX_QUERIES: usize = 20_000;
/// Output of a joint network: a picture's logit of every sentence.
const LOGITS: &str = "logits_per_image";
/// Factors of cosines that training leads to. Anything else is a rounding error.
const LOGIT_SCALES: std::ops::RangeInclusive<f32> = 1.0..=1000.0;
/// Minimum cosine between embeddings of the same picture in different batches. Below it, pictures
/// are embedded one at a time.
const INDEPENDENT: f32 = 0.9999;

impl DualEncoder {
    /// Checks the networks against the manifest and runs them once.
    ///
    /// # Errors
    /// Returns a [`ModelError`] that names the file and the tensor.
    pub fn new(
        bundle: &Bundle,
        manifest: &DualEncoderManifest,
        image: Arc<dyn Network>,
        text: Arc<dyn Network>,
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
        let tokenizer = load_tokenizer(bundle.path(&manifest.text.tokenizer), &manifest.text)?;
        let blank = match manifest.is_joint() {
            true => BlankInputs {
                ids: vec![i64::from(manifest.text.pad_id); manifest.text.context_length],
                mask: vec![1; manifest.text.context_length],
                picture: vec![
                    0.0;
                    3 * manifest.image.size.iter().map(|s| *s as usize).product::<usize>()
                ],
            },
            false => BlankInputs::default(),
        };
        let mut encoder = Self {
            manifest: manifest.clone(),
            image,
            text,
            blank,
            tokenizer,
            batch: 1,
            picture_s: 0.0,
            queries: Mutex::default(),
        };
        encoder.compute_text("a red chair next to the table")?;
        if let Some(scale) = encoder.measure_logit_scale()? {
            encoder.manifest.logit_scale = scale;
        }
        encoder.batch =
            if manifest.image.dynamic_batch && encoder.is_independent()? { BATCH } else { 1 };
        // After the calls above, which allocate memory.
        let (start, picture) = (Instant::now(), RgbImage::from_pixel(64, 48, Rgb([40, 44, 50])));
        encoder.embed_batch(&vec![picture; encoder.batch])?;
        encoder.picture_s = start.elapsed().as_secs_f32() / encoder.batch as f32;
        Ok(encoder)
    }

    /// Returns the seconds per picture when the model was loaded.
    #[must_use]
    pub fn picture_s(&self) -> f32 {
        self.picture_s
    }

    /// Returns the length of an embedding. It is the same for pictures and words.
    #[must_use]
    pub fn dim(&self) -> usize {
        self.manifest.embedding_dim
    }

    /// Returns the number of pictures per call. 1 if the network takes no more, or if an embedding
    /// depends on the rest of its batch, as with activations quantized over the whole batch.
    #[must_use]
    pub fn batch_size(&self) -> usize {
        self.batch
    }

    /// Returns one unit vector per picture. The result does not depend on the other pictures of a
    /// call.
    ///
    /// # Errors
    /// Returns a [`ModelError`]: a failed call, or a picture without an embedding.
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
            let fitted = resize_to_fit(picture, tower.size, tower.resize, tower.interpolation);
            append_planes(&fitted.picture, tower.size, 255.0, tower.mean, tower.std, &mut values);
        }
        let mut inputs = vec![Input {
            name: &tower.input,
            shape: vec![pictures.len(), 3, height, width],
            values: Values::F32(&values),
        }];
        if self.manifest.is_joint() {
            inputs.extend(self.text_inputs(&self.blank.ids, &self.blank.mask));
        }
        let made = self.image.run(&inputs, &[&tower.output])?;
        let rows = self.expect_rows(&tower.file, &tower.output, made, pictures.len())?;
        let failed = || ModelError::Run {
            network: tower.file.clone(),
            why: "the embedding of a picture is zero".into(),
        };
        rows.chunks_exact(self.dim()).map(|row| normalize(row).ok_or_else(failed)).collect()
    }

    /// Returns the output as rows, if it has the declared shape.
    fn expect_rows(
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

    /// Returns the embedding of a sentence, from the cache if possible.
    ///
    /// # Errors
    /// Returns a [`ModelError`]: a failed call.
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

    /// Returns the embedding of a noun, inserted into the prompt that the tower was trained with.
    ///
    /// # Errors
    /// Returns a [`ModelError`]: a failed call.
    pub fn embed_name(&self, noun: &str) -> Result<TextEmbedding, ModelError> {
        self.embed_text(&self.manifest.text.template.replacen("{}", noun, 1))
    }

    /// Returns the factor that turns cosines into logits of likelihoods.
    #[must_use]
    pub fn logit_scale(&self) -> f32 {
        self.manifest.logit_scale
    }

    fn compute_text(&self, text: &str) -> Result<TextEmbedding, ModelError> {
        let tower = &self.manifest.text;
        let Tokens { ids, mask, cut } = self.tokenize(text)?;
        let mut inputs = self.text_inputs(&ids, &mask);
        if self.manifest.is_joint() {
            let ImageTower { input, size: [width, height], .. } = &self.manifest.image;
            inputs.push(Input {
                name: input,
                shape: vec![1, 3, *height as usize, *width as usize],
                values: Values::F32(&self.blank.picture),
            });
        }
        let made = self.text.run(&inputs, &[&tower.output])?;
        let row = self.expect_rows(&tower.file, &tower.output, made, 1)?;
        Ok(TextEmbedding { vector: normalize(&row).map(Into::into), cut })
    }

    /// Returns the inputs of the text tower for one sentence.
    fn text_inputs<'a>(&'a self, ids: &'a [i64], mask: &'a [i64]) -> Vec<Input<'a>> {
        let tower = &self.manifest.text;
        let shape = vec![1, tower.context_length];
        let mut inputs =
            vec![Input { name: &tower.input_ids, shape: shape.clone(), values: Values::I64(ids) }];
        if let Some(name) = &tower.attention_mask {
            inputs.push(Input { name, shape, values: Values::I64(mask) });
        }
        inputs
    }

    fn tokenize(&self, text: &str) -> Result<Tokens, ModelError> {
        let failed =
            |why: String| ModelError::Run { network: self.manifest.text.tokenizer.clone(), why };
        let lowered = self.manifest.text.lowercase.then(|| text.to_lowercase());
        let text = lowered.as_deref().unwrap_or(text);
        let encoding = self.tokenizer.encode(text, true).map_err(|e| failed(e.to_string()))?;
        if encoding.len() != self.manifest.text.context_length {
            return Err(failed(format!(
                "got {} tokens, but the text tower expects {}",
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

    /// Returns the factor between cosines and the logits of a network that computes both. Its
    /// weights hold the factor, and no file states it.
    fn measure_logit_scale(&self) -> Result<Option<f32>, ModelError> {
        let has_logits = self.image.signature().outputs.iter().any(|port| port.name == LOGITS);
        if !self.manifest.is_joint() || !has_logits {
            return Ok(None);
        }
        let (image, text) = (&self.manifest.image, &self.manifest.text);
        let [width, height] = image.size.map(|s| s as usize);
        let tokens = [self.tokenize("a chair")?, self.tokenize("the blue sky over the sea")?];
        let ids: Vec<i64> = tokens.iter().flat_map(|t| t.ids.iter().copied()).collect();
        let mask: Vec<i64> = tokens.iter().flat_map(|t| t.mask.iter().copied()).collect();
        let mut inputs = self.text_inputs(&ids, &mask);
        inputs.iter_mut().for_each(|input| input.shape[0] = tokens.len());
        inputs.push(Input {
            name: &image.input,
            shape: vec![1, 3, height, width],
            values: Values::F32(&self.blank.picture),
        });
        let made = self.image.run(&inputs, &[LOGITS, &image.output, &text.output])?;
        let [logits, picture, words] = &made[..] else { return Ok(None) };
        let dim = self.dim();
        if logits.values.len() != 2 || words.values.len() != 2 * dim {
            return Ok(None);
        }
        let cosine = |row: &[f32]| Some(dot(&normalize(row)?, &normalize(&picture.values)?));
        let (Some(first), Some(second)) =
            (cosine(&words.values[..dim]), cosine(&words.values[dim..]))
        else {
            return Ok(None);
        };
        // A bias is the same for both.
        let scale = (logits.values[0] - logits.values[1]) / (first - second);
        Ok(Some(scale).filter(|scale| LOGIT_SCALES.contains(scale)))
    }

    /// Returns whether a picture's embedding is the same alone and in a batch.
    fn is_independent(&self) -> Result<bool, ModelError> {
        let [width, height] = self.manifest.image.size;
        let noise = |salt: u32| {
            RgbImage::from_fn(width, height, |x, y| {
                let mixed = (x.wrapping_mul(0x9e37_79b1) ^ y.wrapping_mul(0x85eb_ca6b) ^ salt)
                    .wrapping_mul(0xc2b2_ae35);
                Rgb([(mixed >> 24) as u8, (mixed >> 16) as u8, (mixed >> 8) as u8])
            })
        };
        // One uniform and dark, one noisy: their value ranges differ as much as possible.
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

/// Largest tokenizer. In memory it takes fifteen times as much; those of large vocabularies have
/// 35 MB.
const MAX_TOKENIZER_BYTES: u64 = 64 << 20;

/// Reads a tokenizer of a limited size.
///
/// # Errors
/// Returns [`ModelError::Bundle`], which names the file.
pub(super) fn read_tokenizer(file: &Utf8Path) -> Result<Tokenizer, ModelError> {
    let wrong = |why: String| ModelError::Bundle { file: file.to_owned(), why };
    let bytes = file.metadata().map_err(|e| wrong(e.to_string()))?.len();
    if bytes == 0 || bytes > MAX_TOKENIZER_BYTES {
        return Err(wrong(format!(
            "the file has {bytes} bytes, expected at most {} MB",
            MAX_TOKENIZER_BYTES >> 20
        )));
    }
    Tokenizer::from_file(file).map_err(|e| wrong(e.to_string()))
}

/// Reads a tokenizer that pads and truncates to the tower's context length.
fn load_tokenizer(file: Utf8PathBuf, tower: &TextTower) -> Result<Tokenizer, ModelError> {
    let wrong = |why: String| ModelError::Bundle { file: file.clone(), why };
    let mut tokenizer = read_tokenizer(&file)?;
    let padding = tokenizer.get_padding().cloned();
    if let Some(pad_id) = padding.as_ref().map(|own| own.pad_id)
        && pad_id != tower.pad_id
    {
        return Err(wrong(format!("pads with {pad_id}, but text.pad_id is {}", tower.pad_id)));
    }
    tokenizer.with_padding(Some(PaddingParams {
        strategy: PaddingStrategy::Fixed(tower.context_length),
        pad_to_multiple_of: None,
        pad_id: tower.pad_id,
        ..padding.unwrap_or_default()
    }));
    let truncation = TruncationParams {
        max_length: tower.context_length,
        stride: 0,
        ..tokenizer.get_truncation().cloned().unwrap_or_default()
    };
    tokenizer.with_truncation(Some(truncation)).map_err(|e| wrong(e.to_string()))?;
    Ok(tokenizer)
}

/// Normalizes to unit length. Returns `None` for the zero vector.
#[must_use]
pub fn normalize(vector: &[f32]) -> Option<Vec<f32>> {
    let norm = vector.iter().map(|v| f64::from(*v) * f64::from(*v)).sum::<f64>().sqrt() as f32;
    (norm > 1e-6).then(|| vector.iter().map(|v| v / norm).collect())
}

fn dot(a: &[f32], b: &[f32]) -> f32 {
    a.iter().zip(b).map(|(x, y)| x * y).sum()
}
