//! Calibration: combines appearance and measures into how well words fit an instance.
//!
//! A cosine alone is not comparable: some instances are close to every word, some words to every
//! instance. What a word shares with all pictures is subtracted, and likelihoods over a vocabulary,
//! the lexicon's nouns, do the same for instances. Sizes and supports rule out confusions of the
//! pictures.

use super::attributes::{self, Lexicon, Noun};
use super::neural::{DualEncoder, ModelError};
use rayon::prelude::*;
use std::sync::Arc;
use uniground_geometry::scene::{Embeddings, Instance, NameGuess, Norms};

/// Maximum number of names of an instance.
const KEPT_NAMES: usize = 5;
/// Minimum share of the total likelihood of a name that is reported.
const MIN_NAME_SHARE: f32 = 0.02;
/// Weight of the logarithm of the measures' fit, relative to the scaled cosine.
const MEASURES_WEIGHT: f32 = 2.0;
/// Lower bound of the fit. It limits the penalty, because boxes are never exact.
const LEAST_FIT: f32 = 0.02;
/// Fit of a word without known measures.
const UNKNOWN_FIT: f32 = 0.3;
/// Share of a word's cosine with all pictures that is subtracted.
const SHARED_WEIGHT: f32 = 1.0;
/// Weight of how common a noun is: a usual thing is `e` times less likely than a common one, a rare
/// one `e²` times.
const COMMONNESS_WEIGHT: f32 = 5.0;
/// Divisor of logits. Without it, likelihoods would be as sharp as in the tower's training. With
/// it, names that come close count as well.
const TEMPERATURE: f32 = 4.0;

/// Returns the cosine of every instance with a word, without the part that the word shares with all
/// pictures of the scene.
#[must_use]
pub fn comparable_cosines(embeddings: &Embeddings, word: &[f32]) -> Vec<f32> {
    let shared = SHARED_WEIGHT * embeddings.shared_cosine(word);
    embeddings.cosines(word).into_iter().map(|cosine| cosine - shared).collect()
}

/// Returns how well measures fit, as a summand to a scaled cosine.
fn measures_logit(fit: Option<f32>) -> f32 {
    MEASURES_WEIGHT * fit.unwrap_or(UNKNOWN_FIT).max(LEAST_FIT).ln()
}

/// Returns how common a noun's things are in rooms, as a summand to a scaled cosine.
fn commonness_logit(noun: &Noun) -> f32 {
    COMMONNESS_WEIGHT * (noun.prior - 1.0)
}

/// Returns the fit of a word to an instance, `0..=1`: 1 when nothing in the vocabulary fits better.
/// `cosine` is one of [`comparable_cosines`]; `fit` is the fit of its measures, if the lexicon has
/// them.
#[must_use]
pub fn fit(cosine: f32, logit_scale: f32, fit: Option<f32>, norms: Norms) -> f32 {
    ((logit_scale * cosine + measures_logit(fit) - norms.joint) / TEMPERATURE).exp().min(1.0)
}

/// A noun and its vector.
type Word = (&'static Noun, Arc<[f32]>);

/// Returns the vectors of all nouns of the lexicon that the text tower knows.
fn embed_vocabulary(encoder: &DualEncoder) -> Result<Vec<Word>, ModelError> {
    let embedded = |noun: &'static Noun| Ok((noun, encoder.embed_name(&noun.name)?.vector));
    let embedded: Vec<_> =
        Lexicon::get().nouns().par_iter().map(embedded).collect::<Result<_, ModelError>>()?;
    Ok(embedded.into_iter().filter_map(|(noun, vector)| Some((noun, vector?))).collect())
}

/// Names instances with pictures by appearance and measures. Instances without pictures keep the
/// names from their measures. `rows` holds one unit vector per instance, or zero without pictures.
///
/// # Errors
/// Returns a [`ModelError`]: a failed call.
pub fn name_all(
    instances: &mut [Instance],
    encoder: &DualEncoder,
    rows: &[f32],
) -> Result<Embeddings, ModelError> {
    let embeddings = Embeddings::new(encoder.dim(), rows).with_shared_mean();
    let vocabulary = embed_vocabulary(encoder)?;
    let scale = encoder.logit_scale();
    let cosines: Vec<Vec<f32>> =
        vocabulary.par_iter().map(|(_, word)| comparable_cosines(&embeddings, word)).collect();
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
                    logit + measures_logit(Some(attributes::noun_fit(noun, instance)))
                })
                .collect();
            let norms =
                Norms { appearance: log_sum_exp(&by_appearance), joint: log_sum_exp(&jointly) };
            if embeddings.is_seen(i) && instance.structure.is_none() {
                // Only a name is likelier for a common thing: who asks for a rare one has seen it.
                let expected: Vec<f32> = vocabulary
                    .iter()
                    .zip(&jointly)
                    .map(|((noun, _), logit)| logit + commonness_logit(noun))
                    .collect();
                instance.names = best_names(&vocabulary, &expected, log_sum_exp(&expected));
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

/// Returns the logarithm of the sum of exponentials.
fn log_sum_exp(logits: &[f32]) -> f32 {
    let most = logits.iter().copied().fold(f32::MIN, f32::max);
    most + logits.iter().map(|logit| (logit - most).exp()).sum::<f32>().ln()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::neural::tests::tiny_encoder;
    use proptest::prelude::*;
    use uniground_geometry::scene::{Structure, Support};
    use uniground_testing::thing;

    #[test]
    fn scores_sum_to_at_most_one_and_unseen_instances_keep_their_names() {
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
        assert!(norms.joint <= norms.appearance, "measures only lower the norm");
        assert_eq!(fit(1.0, 100.0, Some(1.0), Norms { appearance: 0.0, joint: 10.0 }), 1.0);
        assert!(fit(0.2, 100.0, Some(0.1), norms) < fit(0.2, 100.0, Some(0.9), norms));
    }

    #[track_caller]
    fn assert_near(found: f32, expected: f32, what: &str) {
        assert!((found - expected).abs() < 1e-4, "{what}: {found}, expected {expected}");
    }

    #[test]
    fn measures_add_twice_their_logarithm_with_a_lower_bound() {
        let e = std::f32::consts::E;
        assert_near(measures_logit(Some(1.0)), 0.0, "a perfect fit adds nothing");
        assert_near(measures_logit(Some(1.0 / e)), -2.0, "2 ln (1/e)");
        assert_near(measures_logit(Some(0.5)), -1.386_294, "2 ln 0.5");
        assert_near(measures_logit(None), -2.407_946, "2 ln 0.3: measures unknown");
        // 2 ln 0.02 is the lower bound.
        for fit in [0.02, 0.019, 1e-6, 0.0] {
            assert_near(measures_logit(Some(fit)), -7.824_046, &format!("{fit}"));
        }
        assert!(measures_logit(Some(0.021)) > -7.73, "2 ln 0.021 = -7.7265");
    }

    #[test]
    fn rare_things_are_less_likely_by_the_square_of_e() {
        let of = |name: &str| commonness_logit(Lexicon::get().find(name).unwrap());
        assert_near(of("chair"), 0.0, "common");
        let nouns = Lexicon::get().nouns();
        let least = nouns.iter().map(commonness_logit).fold(0.0, f32::min);
        assert_near(least, -2.0, "rare");
        assert!(nouns.iter().any(|noun| (commonness_logit(noun) + 1.0).abs() < 1e-4), "usual");
    }

    #[test]
    fn fit_is_the_fourth_root_of_the_likelihood_share() {
        let norms = Norms { appearance: 1000.0, joint: 38.0 };
        // exp((100 * 0.3 + 0 - 38) / 4) = exp(-2).
        assert_near(fit(0.3, 100.0, Some(1.0), norms), (-2.0_f32).exp(), "appearance alone");
        // exp((30 - 2 - 38) / 4) = exp(-2.5).
        let misfit = Some(1.0 / std::f32::consts::E);
        assert_near(fit(0.3, 100.0, misfit, norms), (-2.5_f32).exp(), "with measures");
        // exp((30 - 2.407946 - 38) / 4) = exp(-2.6019865).
        assert_near(fit(0.3, 100.0, None, norms), (-2.601_986_5_f32).exp(), "measures unknown");
        // A cosine below zero: exp((-1 + 0 - 3) / 4) = exp(-1).
        let norms = Norms { appearance: 0.0, joint: 3.0 };
        assert_near(fit(-0.1, 10.0, Some(1.0), norms), (-1.0_f32).exp(), "negative cosine");
        // As good as the whole vocabulary together, or better: the fit is capped at 1.
        assert_eq!(fit(0.3, 10.0, Some(1.0), norms), 1.0);
        assert_eq!(fit(0.9, 10.0, Some(1.0), norms), 1.0);
        assert!(fit(0.29, 10.0, Some(1.0), norms) < 1.0);
    }

    #[test]
    fn log_sum_exp_is_the_logarithm_of_the_sum_of_exponentials() {
        let of_shares = |shares: &[f32]| {
            log_sum_exp(&shares.iter().map(|share| share.ln()).collect::<Vec<_>>())
        };
        assert_near(of_shares(&[1.0, 2.0, 3.0]), 6.0_f32.ln(), "1 + 2 + 3");
        assert_near(of_shares(&[0.5, 0.25]), 0.75_f32.ln(), "1/2 + 1/4");
        assert_near(log_sum_exp(&[7.5]), 7.5, "one alone");
        assert_near(log_sum_exp(&[0.0; 8]), 8.0_f32.ln(), "eight ones");
        // Far from zero nothing overflows or vanishes.
        assert_near(log_sum_exp(&[100.0, 100.0]), 100.0 + 2.0_f32.ln(), "large");
        assert_near(log_sum_exp(&[-100.0, -100.0]), -100.0 + 2.0_f32.ln(), "small");
        assert_near(log_sum_exp(&[-200.0, 100.0]), 100.0, "far apart");
    }

    /// Returns the first nouns of the lexicon with zero vectors, which the tests do not use.
    fn words(count: usize) -> Vec<Word> {
        Lexicon::get().nouns()[..count].iter().map(|noun| (noun, Arc::from([0.0; 2]))).collect()
    }

    #[test]
    fn best_five_names_are_returned_with_their_shares() {
        let vocabulary = words(8);
        let name = |i: usize| vocabulary[i].0.name.clone();
        let told = |shares: [f32; 8], norm: f32| {
            let logits = shares.map(|share| share.ln() + 3.0);
            let names = best_names(&vocabulary, &logits, norm);
            names.into_iter().map(|guess| (guess.name, guess.score)).collect::<Vec<_>>()
        };
        let found = told([0.1, 0.3, 0.05, 0.2, 0.04, 0.15, 0.1, 0.06], 3.0);
        // Of the two with 0.1, the first comes first. Only five names are returned.
        let expected = [(1, 0.3), (3, 0.2), (5, 0.15), (0, 0.1), (6, 0.1)];
        assert_eq!(found.len(), expected.len(), "{found:?}");
        for ((word, score), (i, share)) in found.iter().zip(expected) {
            assert_eq!(*word, name(i), "{found:?}");
            assert_near(*score, share, word);
        }
        // Below 2 % there is no name.
        let found = told([0.019, 0.5, 0.021, 0.01, 0.4, 1e-3, 1e-4, 0.018], 3.0);
        let found: Vec<String> = found.into_iter().map(|(word, _)| word).collect();
        assert_eq!(found, [name(1), name(4), name(2)]);
        // A share never exceeds 1.
        let found = told([0.5, 4.0, 1e-3, 1e-3, 1e-3, 1e-3, 1e-3, 1e-3], 3.0);
        assert_eq!(found[0], (name(1), 1.0));
        assert_near(found[1].1, 0.5, "the second name");
        assert!(told([1e-3; 8], 3.0).is_empty());
        assert!(best_names(&[], &[], 0.0).is_empty());
    }

    #[test]
    fn structure_keeps_its_names_and_has_norms_like_things() {
        let encoder = tiny_encoder();
        let mut instances: Vec<Instance> = (1..=3)
            .map(|id| thing(id, [0.0, 0.0], [2.1, 0.9, 0.8], 0.0, Support::Floor, [120; 3]))
            .collect();
        let given = vec![NameGuess { name: "given".into(), score: 0.5 }];
        instances.iter_mut().for_each(|instance| instance.names.clone_from(&given));
        instances[1].structure = Some(Structure::Wall);
        let seen = encoder.embed_text("a sofa").unwrap().vector.unwrap();
        let unseen = vec![0.0; encoder.dim()];
        let rows = [&seen[..], &seen[..], &unseen[..]].concat();
        let embeddings = name_all(&mut instances, &encoder, &rows).unwrap();
        assert_ne!(instances[0].names, given, "seen, and a thing");
        assert_eq!(instances[1].names, given, "seen, and a wall");
        assert_eq!(instances[2].names, given, "not seen");

        // Computes the norms in double precision from each noun's own vector.
        let nouns = Lexicon::get().nouns();
        let words: Vec<_> = nouns
            .iter()
            .map(|noun| encoder.embed_name(&noun.name).unwrap().vector.unwrap())
            .collect();
        let norms_of = |i: usize| {
            let row = embeddings.row(i);
            let (mut appearance, mut joint) = (0.0_f64, 0.0_f64);
            for (noun, word) in nouns.iter().zip(&words) {
                let cosine: f64 = row.iter().zip(&**word).map(|(a, b)| f64::from(a * b)).sum();
                let shared = f64::from(embeddings.shared_cosine(word));
                let likelihood = (f64::from(encoder.logit_scale()) * (cosine - shared)).exp();
                let fit = f64::from(attributes::noun_fit(noun, &instances[i]));
                appearance += likelihood;
                joint += likelihood * fit.max(0.02).powi(2);
            }
            [appearance.ln(), joint.ln()]
        };
        for i in 0..3 {
            let Norms { appearance, joint } = embeddings.norms()[i];
            let expected = norms_of(i).map(|norm| norm as f32);
            for (found, expected) in [appearance, joint].into_iter().zip(expected) {
                assert!((found - expected).abs() < 1e-2, "{i}: {found}, expected {expected}");
            }
        }
    }

    #[test]
    fn what_a_word_shares_with_all_pictures_is_subtracted() {
        // Twenty instances that show the same, and two that show something else.
        let rows: Vec<f32> =
            [[1.0, 0.0]; 20].into_iter().chain([[0.5, 0.75]; 2]).flatten().collect();
        let embeddings = Embeddings::new(2, &rows).with_shared_mean();
        // The mean: (20 + 1, 1.5) / 42.
        let found = comparable_cosines(&embeddings, &[1.0, 0.0]);
        assert_near(found[0], 1.0 - 21.0 / 42.0, "close to all");
        assert_near(found[21], 0.5 - 21.0 / 42.0, "close to all, seen by another");
        let found = comparable_cosines(&embeddings, &[0.0, 1.0]);
        assert_near(found[0], -1.5 / 42.0, "close to two");
        assert_near(found[21], 0.75 - 1.5 / 42.0, "close to two, seen by one of them");
    }

    proptest! {
        #[test]
        fn better_cosine_or_measures_never_lower_the_fit(
            cosines in prop::array::uniform2(-1.0_f32..1.0),
            fits in prop::array::uniform2(0.0_f32..=1.0),
            joint in -10.0_f32..120.0,
        ) {
            let norms = Norms { appearance: 0.0, joint };
            let fit = |cosine, by_size| fit(cosine, 100.0, Some(by_size), norms);
            let (low, high) = (cosines[0].min(cosines[1]), cosines[0].max(cosines[1]));
            let (bad, good) = (fits[0].min(fits[1]), fits[0].max(fits[1]));
            prop_assert!((0.0..=1.0).contains(&fit(low, bad)), "{}", fit(low, bad));
            prop_assert!(fit(low, bad) <= fit(high, bad), "{low} {high}");
            prop_assert!(fit(low, bad) <= fit(low, good), "{bad} {good}");
        }

        #[test]
        fn log_sum_exp_shifts_with_its_logits_and_is_bounded_by_their_maximum(
            logits in prop::collection::vec(-30.0_f32..30.0, 1..20),
            by in -50.0_f32..50.0,
        ) {
            let sum = log_sum_exp(&logits);
            let most = logits.iter().copied().fold(f32::MIN, f32::max);
            prop_assert!(most <= sum && sum <= most + (logits.len() as f32).ln() + 1e-4, "{sum}");
            let moved: Vec<f32> = logits.iter().map(|logit| logit + by).collect();
            prop_assert!((log_sum_exp(&moved) - sum - by).abs() < 1e-3, "{} {sum}", log_sum_exp(&moved));
        }
    }
}
