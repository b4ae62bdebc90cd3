//! Calibration: how well words fit an instance by what it looks like and what it measures,
//! together.
//!
//! A cosine says little by itself: some instances are near every word, some words near every
//! instance. Likelihoods over a vocabulary, the lexicon's nouns, make cosines comparable; sizes and
//! supports rule out what pictures confuse.

use super::attributes::{self, Lexicon, Noun};
use super::neural::{DualEncoder, ModelError};
use rayon::prelude::*;
use std::sync::Arc;
use uniground_geometry::scene::{Embeddings, Instance, NameGuess, Norms};

/// How many names an instance keeps.
const KEPT_NAMES: usize = 5;
/// Names below this share of the belief are not worth telling.
const MIN_NAME_SHARE: f32 = 0.02;
/// Weight of the logarithm of the fit of measures, beside the scaled cosine.
const MEASURES_WEIGHT: f32 = 2.0;
/// A misfit can not speak louder: boxes are never exact.
const LEAST_FIT: f32 = 0.02;
/// What measures say about a word of which none are known.
const UNKNOWN_FIT: f32 = 0.3;
/// Likelihoods are as sharp as the tower was trained to be; names that come close count as well.
const TEMPERATURE: f32 = 4.0;

/// How well measures fit, as a summand beside a scaled cosine.
fn measured(fit: Option<f32>) -> f32 {
    MEASURES_WEIGHT * fit.unwrap_or(UNKNOWN_FIT).max(LEAST_FIT).ln()
}

/// Fit of a word to an instance, `0..=1`: 1 when nothing in the vocabulary fits better. `fit` is
/// that of its measures, where the lexicon knows them.
#[must_use]
pub fn fit(cosine: f32, logit_scale: f32, fit: Option<f32>, norms: Norms) -> f32 {
    ((logit_scale * cosine + measured(fit) - norms.joint) / TEMPERATURE).exp().min(1.0)
}

/// A noun and its vector.
type Word = (&'static Noun, Arc<[f32]>);

/// Every noun of the lexicon that the text tower knows, as a vector.
fn vocabulary(encoder: &DualEncoder) -> Result<Vec<Word>, ModelError> {
    let embedded = |noun: &'static Noun| Ok((noun, encoder.embed_name(&noun.name)?.vector));
    let embedded: Vec<_> =
        Lexicon::get().nouns().par_iter().map(embedded).collect::<Result<_, ModelError>>()?;
    Ok(embedded.into_iter().filter_map(|(noun, vector)| Some((noun, vector?))).collect())
}

/// Names what was seen by appearance and measures; what was not keeps the names its measures gave
/// it. `rows` holds one unit vector per instance, zero for what was not seen.
///
/// # Errors
/// [`ModelError`]: a failed call.
pub fn name_all(
    instances: &mut [Instance],
    encoder: &DualEncoder,
    rows: &[f32],
) -> Result<Embeddings, ModelError> {
    let embeddings = Embeddings::new(encoder.dim(), rows);
    let vocabulary = vocabulary(encoder)?;
    let scale = encoder.logit_scale();
    let cosines: Vec<Vec<f32>> =
        vocabulary.par_iter().map(|(_, word)| embeddings.cosines(word)).collect();
    let norms = instances
        .par_iter_mut()
        .enumerate()
        .map(|(i, instance)| {
            let by_appearance: Vec<f32> =
                cosines.iter().map(|of_word| scale * of_word[i]).collect();
            let jointly: Vec<f32> = vocabulary
                .iter()
                .zip(&by_appearance)
                .map(|((noun, _), logit)| {
                    logit + measured(Some(attributes::noun_fit(noun, instance)))
                })
                .collect();
            let norms = Norms { appearance: log_sum(&by_appearance), joint: log_sum(&jointly) };
            if embeddings.is_seen(i) && instance.structure.is_none() {
                instance.names = best_names(&vocabulary, &jointly, norms.joint);
            }
            norms
        })
        .collect();
    Ok(embeddings.with_norms(norms))
}

fn best_names(vocabulary: &[Word], logits: &[f32], norm: f32) -> Vec<NameGuess> {
    let mut order: Vec<usize> = (0..logits.len()).collect();
    order.sort_by(|&a, &b| logits[b].total_cmp(&logits[a]).then(a.cmp(&b)));
    let guess = |i: usize| NameGuess {
        name: vocabulary[i].0.name.clone(),
        score: (logits[i] - norm).exp().min(1.0),
    };
    order
        .into_iter()
        .take(KEPT_NAMES)
        .map(guess)
        .filter(|guess| guess.score >= MIN_NAME_SHARE)
        .collect()
}

/// Logarithm of the sum of exponentials.
fn log_sum(logits: &[f32]) -> f32 {
    let most = logits.iter().copied().fold(f32::MIN, f32::max);
    most + logits.iter().map(|logit| (logit - most).exp()).sum::<f32>().ln()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::neural::tests::tiny_encoder;
    use uniground_geometry::scene::Support;
    use uniground_testing::thing;

    #[test]
    fn shares_add_up_and_what_was_not_seen_keeps_its_names() {
        let encoder = tiny_encoder();
        let mut instances: Vec<Instance> = (1..=2)
            .map(|id| thing(id, [0.0, 0.0], [2.1, 0.9, 0.8], 0.0, Support::Floor, [120; 3]))
            .collect();
        attributes::name_all(&mut instances);
        let before = instances[1].names.clone();
        let seen = encoder.embed_text("a sofa").unwrap().vector.unwrap();
        let rows: Vec<f32> = seen.iter().copied().chain(vec![0.0; encoder.dim()]).collect();
        let embeddings = name_all(&mut instances, &encoder, &rows).unwrap();
        assert_eq!(instances[1].names, before);
        assert!(instances[0].names.iter().map(|guess| guess.score).sum::<f32>() <= 1.001);
        let norms = embeddings.norms()[0];
        assert!(norms.joint <= norms.appearance, "a misfit only takes away");
        assert_eq!(fit(1.0, 100.0, Some(1.0), Norms { appearance: 0.0, joint: 10.0 }), 1.0);
        assert!(fit(0.2, 100.0, Some(0.1), norms) < fit(0.2, 100.0, Some(0.9), norms));
    }
}
