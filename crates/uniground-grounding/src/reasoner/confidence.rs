//! Calibrates confidence: how often an answer with a given belief is right. Beliefs come from
//! scores, and scores from different sources of names deserve different trust.
//!
//! `scripts/fit-confidence.py` fits `confidence.tsv` to the answers of `uniground eval`.

use crate::SceneView;
use std::sync::LazyLock;
use uniground_language::{Meaning, Phrase};

/// The source of an object's name.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum NamesFrom {
    /// Sizes, places and colors.
    Measures,
    /// An image and text encoder that saw instances of a segmenter.
    Encoder,
    /// An image and text encoder that saw instances of the built-in masks, whose crops are worse.
    EncoderOfBuiltinMasks,
    /// A person or a vision-language model that looked at the instance, or its geometry where a
    /// wall, floor or ceiling is asked for. These beliefs are not changed.
    Given,
}

impl NamesFrom {
    /// Returns the source of what a target's noun is compared with, for the instance at an index.
    pub fn of(scene: SceneView, target: &Phrase, index: usize) -> Self {
        Self::of_meaning(scene, &target.meaning(), index)
    }

    /// Returns the same for the meaning of the target.
    pub fn of_meaning(scene: SceneView, meaning: &Meaning, index: usize) -> Self {
        let is_asked_structure = match meaning {
            Meaning::Structure(structure) => scene.instances[index].structure == Some(*structure),
            Meaning::Instance(id) => scene.instances[index].id == *id,
            _ => false,
        };
        match scene.names.get(index) {
            Some(_) => Self::Given,
            None if is_asked_structure => Self::Given,
            None => match scene.appearance {
                Some(appearance) if appearance.of_builtin_masks => Self::EncoderOfBuiltinMasks,
                Some(_) => Self::Encoder,
                None => Self::Measures,
            },
        }
    }

    /// Returns how likely the first name of the instance at an index is right, `0..=1`.
    pub fn name_confidence(scene: SceneView, index: usize) -> f32 {
        let source = Self::of(scene, &Phrase::default(), index);
        let instance = &scene.instances[index];
        if source == Self::Given || instance.structure.is_some() {
            return 1.0;
        }
        let all: f32 = instance.names.iter().map(|guess| guess.score).sum();
        let first = instance.names.first().map_or(0.0, |guess| guess.score);
        share_right(if all > 0.0 { first / all } else { 0.0 }, source)
    }

    /// Returns the share of answers with this belief that are right.
    pub fn share_right(self, belief: f32) -> f32 {
        share_right(belief, self)
    }

    fn curve(self) -> &'static [(f32, f32)] {
        static CURVES: LazyLock<[Vec<(f32, f32)>; 3]> = LazyLock::new(|| SOURCES.map(read));
        match self {
            Self::Measures => &CURVES[0],
            Self::Encoder => &CURVES[1],
            Self::EncoderOfBuiltinMasks => &CURVES[2],
            Self::Given => &[],
        }
    }
}

/// The sources in the table.
const SOURCES: [&str; 3] = ["measures", "encoder", "encoder-builtin-masks"];

/// Reads belief and share of right answers of one source.
fn read(source: &str) -> Vec<(f32, f32)> {
    let lines = include_str!("confidence.tsv").lines();
    let of_source =
        lines.filter_map(|line| line.strip_prefix(source)?.strip_prefix('\t')?.split_once('\t'));
    of_source
        .filter_map(|(belief, share)| Some((belief.parse().ok()?, share.parse().ok()?)))
        .collect()
}

/// Returns the share of answers with this belief that are right.
pub(super) fn share_right(belief: f32, names: NamesFrom) -> f32 {
    let curve = names.curve();
    let after = curve.partition_point(|(at, _)| *at <= belief);
    match (after.checked_sub(1).and_then(|before| curve.get(before)), curve.get(after)) {
        (Some((x, low)), Some((next, high))) => low + (high - low) * (belief - x) / (next - x),
        (Some((_, share)), None) => *share,
        (None, _) => belief,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn confidence_never_decreases_with_belief() {
        for names in [
            NamesFrom::Measures,
            NamesFrom::Encoder,
            NamesFrom::EncoderOfBuiltinMasks,
            NamesFrom::Given,
        ] {
            let shares: Vec<f32> =
                (0..=100_u8).map(|i| share_right(f32::from(i) / 100.0, names)).collect();
            assert!(shares.windows(2).all(|pair| pair[0] <= pair[1]), "{names:?}: {shares:?}");
            assert!(
                shares[0] == 0.0 && shares[100] <= 1.0 && shares[100] > 0.3,
                "{names:?}: {shares:?}"
            );
        }
        assert_eq!(share_right(0.7, NamesFrom::Given), 0.7);
        assert!(
            share_right(0.9, NamesFrom::Measures) < 0.9,
            "measures never reach that confidence"
        );
    }

    #[test]
    fn sources_have_tables_of_their_own() {
        let sources = [NamesFrom::Measures, NamesFrom::EncoderOfBuiltinMasks, NamesFrom::Encoder];
        let sure = sources.map(|names| share_right(1.0, names));
        assert!(sure.windows(2).all(|pair| pair[0] < pair[1]), "{sure:?}");
    }

    #[test]
    fn every_line_of_the_table_is_read() {
        let lines =
            include_str!("confidence.tsv").lines().filter(|line| !line.starts_with('#')).count();
        assert_eq!(lines, SOURCES.iter().map(|source| read(source).len()).sum::<usize>());
    }
}
