//! Compares the words of one question with the appearance of every instance.
//!
//! All texts are embedded before anything is decided. So a model can fail here, but not during the
//! decision.

use std::collections::HashMap;
use uniground_geometry::scene::{Embeddings, Norms};
use uniground_language::{Meaning, ParsedQuery, Phrase};
use uniground_models::calibration;
use uniground_models::neural::{DualEncoder, ModelError, TextEmbedding};
use uniground_types::question::{CandidateSource, QueryText};

/// How a shortlist is made.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct ShortlistScoring {
    /// Where candidates come from. The other fields configure the encoder's part, where an encoder
    /// has embedded the scene.
    pub from: CandidateSource,
    /// The words whose embedding is compared with the instances.
    pub query_text: QueryText,
    /// Whether the cosine is compared with those of all nouns of the lexicon, so that an instance
    /// close to every word gains nothing by it (docs/METHOD.md, section 2). Otherwise the plain
    /// cosine counts.
    pub calibrated: bool,
}

/// Cosines of a question's words with every instance.
#[derive(Debug, Clone)]
pub struct Appearance {
    logit_scale: f32,
    norms: Vec<Norms>,
    seen: Vec<bool>,
    /// Comparable cosines by word, then by instance index. Words that the text tower does not know are
    /// missing.
    of_word: HashMap<String, Vec<f32>>,
    shortlist: Option<Vec<f32>>,
    /// Whether the pictures show instances that were made from the built-in masks. Such crops often
    /// show a part of a thing, or more than it.
    pub(super) of_builtin_masks: bool,
    /// Whether the sentence was truncated because it is longer than the text tower reads.
    pub cut: bool,
}

impl Appearance {
    /// Embeds every noun of a question, and the question itself.
    ///
    /// # Errors
    /// [`ModelError`]: a failed call.
    pub fn of(
        query: &str,
        parsed: &ParsedQuery,
        encoder: &DualEncoder,
        embeddings: &Embeddings,
        scoring: ShortlistScoring,
    ) -> Result<Self, ModelError> {
        let mut words = Vec::new();
        parsed.phrases().into_iter().for_each(|phrase| nouns_within(phrase, &mut words));
        words.sort_unstable();
        words.dedup();
        let mut of_word = HashMap::new();
        for word in words {
            if let Some(vector) = encoder.embed_name(&word)?.vector {
                of_word.insert(word, calibration::comparable_cosines(embeddings, &vector));
            }
        }
        let TextEmbedding { vector, cut } =
            sentence(query, &parsed.target, encoder, scoring.query_text)?;
        let (logit_scale, norms) = (encoder.logit_scale(), embeddings.norms().to_vec());
        let scores = |vector: &[f32]| match scoring.calibrated {
            true => calibration::comparable_cosines(embeddings, vector)
                .iter()
                .zip(&norms)
                .map(|(cosine, n)| (logit_scale * cosine - n.appearance).exp())
                .collect(),
            false => embeddings.cosines(vector),
        };
        let seen: Vec<bool> = (0..embeddings.len()).map(|i| embeddings.is_seen(i)).collect();
        // Without a single picture every cosine is zero. Names are more informative then.
        let vector = vector.filter(|_| seen.contains(&true));
        let shortlist = vector.map(|vector| scores(&vector));
        let of_builtin_masks = false;
        Ok(Self { logit_scale, norms, seen, of_word, shortlist, of_builtin_masks, cut })
    }

    /// Sets whether the instances were made from the built-in masks. False before.
    #[must_use]
    pub fn of_builtin_masks(self, of_builtin_masks: bool) -> Self {
        Self { of_builtin_masks, ..self }
    }

    /// Returns the fit of a word to the instance at an index; `None` for an instance without
    /// pictures and for a word the tower does not know.
    pub(super) fn fit(&self, word: &str, index: usize, measured: Option<f32>) -> Option<f32> {
        if !*self.seen.get(index)? {
            return None;
        }
        Some(calibration::fit(
            self.of_word.get(word)?[index],
            self.logit_scale,
            measured,
            self.norms[index],
        ))
    }

    /// Returns the shortlist scores by index; `None` when the tower knows none of the words, or no
    /// instance has pictures.
    pub(super) fn shortlist(&self) -> Option<&[f32]> {
        self.shortlist.as_deref()
    }
}

/// Collects the nouns that a phrase and the phrases within it may mean.
fn nouns_within(phrase: &Phrase, words: &mut Vec<String>) {
    match phrase.meaning() {
        Meaning::Nouns(nouns) => words.extend(nouns.iter().map(|noun| noun.name.clone())),
        Meaning::Unknown => words.push(phrase.head.clone()),
        Meaning::Anything | Meaning::Structure(_) | Meaning::Instance(_) => {}
    }
    for other in phrase.could_be.iter().chain(&phrase.other_things) {
        nouns_within(&Phrase { head: other.clone(), ..Phrase::default() }, words);
    }
    let anchors = phrase.relations.iter().flat_map(|relation| &relation.anchors);
    anchors
        .chain(phrase.with.iter().map(|with| &with.phrase))
        .for_each(|inner| nouns_within(inner, words));
}

/// Embeds the words that the shortlist uses as one unit vector, and reports whether the end of the
/// sentence was truncated.
fn sentence(
    query: &str,
    target: &Phrase,
    encoder: &DualEncoder,
    text: QueryText,
) -> Result<TextEmbedding, ModelError> {
    let full = encoder.embed_text(query)?;
    let target = match text {
        QueryText::Full => None,
        QueryText::Target | QueryText::Mean => encoder.embed_name(&target.text())?.vector,
    };
    let vector = match (text, full.vector, target) {
        (QueryText::Mean, Some(a), Some(b)) => {
            let sum: Vec<f32> = a.iter().zip(b.iter()).map(|(x, y)| x + y).collect();
            let norm = sum.iter().map(|v| v * v).sum::<f32>().sqrt();
            if norm > 0.0 { Some(sum.iter().map(|v| v / norm).collect()) } else { Some(a) }
        }
        (QueryText::Target, full, None) => full,
        (QueryText::Target, _, target) => target,
        (_, full, target) => full.or(target),
    };
    Ok(TextEmbedding { vector, cut: full.cut && text != QueryText::Target })
}

#[cfg(test)]
mod tests {
    use super::*;
    use uniground_language::parse;
    use uniground_testing::tiny_encoder;

    #[test]
    fn instances_without_pictures_have_no_appearance_score() {
        let (encoder, query) = (tiny_encoder(), "the red chair");
        let looked = |rows: &[f32]| {
            let embeddings =
                Embeddings::new(encoder.dim(), rows).with_norms(vec![Norms::default(); 2]);
            Appearance::of(query, &parse(query), &encoder, &embeddings, ShortlistScoring::default())
                .unwrap()
        };
        let mut rows = vec![0.0; encoder.dim() * 2];
        assert!(looked(&rows).shortlist().is_none());
        rows[0] = 1.0;
        let half_seen = looked(&rows);
        assert_eq!(half_seen.shortlist().map(<[f32]>::len), Some(2));
        assert_eq!(
            half_seen.fit("chair", 1, None),
            None,
            "an instance without pictures has no appearance"
        );
    }
}
