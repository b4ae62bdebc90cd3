//! Scores what an instance carries, lacks or has as a part: "with the book on it", "without books",
//! "with the orange seat".

use super::{Assessor, CARRIED, MAX_ANCHORS, unchecked_factor};
use crate::fit::{colors_fit, most_plausible};
use crate::relations;
use uniground_language::{Phrase, With};

/// Factor of a score when the instance lacks what it should carry.
const NOT_CARRIED: f32 = 0.1;
/// The same factor for a small object or a part that should be there: they are seldom found.
const SMALL_NOT_FOUND: f32 = 0.6;

/// Parts of objects ("the stool with the orange seat" describes the stool's own color), each with
/// the nouns known to have it. No nouns: any object.
const PARTS: &[(&str, &[&str])] = &[
    ("seat", &[]),
    ("back", &[]),
    ("backrest", &[]),
    ("leg", &[]),
    ("arm", &["armchair", "sofa", "office chair"]),
    ("armrest", &["armchair", "sofa", "office chair"]),
    ("handle", &[]),
    ("drawer", &["dresser", "nightstand", "filing cabinet", "desk", "cabinet"]),
    ("wheel", &["office chair", "cart", "suitcase", "bicycle"]),
    ("caster", &["office chair", "cart"]),
    ("top", &[]),
    ("frame", &[]),
    ("cushion", &["sofa", "armchair", "bench"]),
    ("shade", &["floor lamp", "desk lamp"]),
    ("lid", &[]),
    ("base", &[]),
    ("pattern", &[]),
    ("stripe", &[]),
    ("upholstery", &[]),
    ("edge", &[]),
    ("door", &[]),
    ("foot", &[]),
    ("body", &[]),
    ("paint", &[]),
    ("cover", &[]),
    ("rim", &[]),
    ("border", &[]),
    ("trim", &[]),
    ("button", &[]),
    ("cap", &[]),
    ("strap", &[]),
    ("front", &[]),
    ("panel", &[]),
    ("fabric", &[]),
];
/// Factor of a score when the phrase asks for a part that the instance is not known to have.
const ODD_PART: f32 = 0.4;
/// The same factor where a part has a color that was not measured on the instance: parts are small.
const PART_OF_OTHER_COLOR: f32 = 0.25;

/// Returns whether a phrase names a part of furniture, which no parse finds by itself.
pub(crate) fn is_part(phrase: &Phrase) -> bool {
    PARTS
        .iter()
        .any(|(part, _)| phrase.head == *part || phrase.head.strip_suffix('s') == Some(*part))
}

impl Assessor<'_> {
    /// Multiplies scores by how well each instance has (or lacks) what the phrase says: "with the
    /// book on it", "with four chairs", "without books", "with the orange seat".
    pub(super) fn apply_with(&self, With { phrase, absent }: &With, scores: &mut [f32]) {
        let singular =
            |part: &str| phrase.head == part || phrase.head.strip_suffix('s') == Some(part);
        if let Some((_, of)) = PARTS.iter().find(|(part, _)| singular(part)) {
            let known = |i: usize| of.is_empty() || of.iter().any(|noun| self.is_named(i, noun));
            for (i, score) in scores.iter_mut().enumerate().filter(|(_, s)| **s > 0.0) {
                let fit = colors_fit(self.scene, phrase, i).max(PART_OF_OTHER_COLOR)
                    * if known(i) { 1.0 } else { ODD_PART };
                *score *= match *absent {
                    true if !of.is_empty() && known(i) => ODD_PART,
                    true => 1.0,
                    false => fit,
                };
            }
            return;
        }
        let found = self.assess(phrase);
        if let Some(share) = unchecked_factor(
            std::slice::from_ref(phrase),
            std::slice::from_ref(&found),
            SMALL_NOT_FOUND,
        ) {
            if !absent {
                scores.iter_mut().for_each(|score| *score *= share);
            }
            return;
        }
        let plausible = most_plausible(scores, usize::MAX).into_iter().map(|(i, _)| i);
        let fits = self.carried(phrase, &found.total, plausible);
        // Where no instance carries such an object, detection missed it: books on a shelf are
        // seldom found one by one.
        let missed = !absent && fits.iter().all(|(_, fit)| *fit < CARRIED);
        let mut shares = vec![NOT_CARRIED; scores.len()];
        for (i, fit) in fits {
            let fit = NOT_CARRIED + (1.0 - NOT_CARRIED) * fit;
            shares[i] = if *absent {
                1.0 + NOT_CARRIED - fit
            } else {
                fit.max(if missed { SMALL_NOT_FOUND } else { 0.0 })
            };
        }
        scores.iter_mut().zip(shares).for_each(|(score, share)| *score *= share);
    }

    /// Returns how well each of some instances carries what a phrase says, `0..=1`, given how well
    /// every instance fits the phrase.
    pub(crate) fn carried(
        &self,
        phrase: &Phrase,
        fits: &[f32],
        instances: impl Iterator<Item = usize>,
    ) -> Vec<(usize, f32)> {
        let things = most_plausible(fits, MAX_ANCHORS);
        let best = things.iter().map(|t| t.1).fold(f32::EPSILON, f32::max);
        let fit_of = |i: usize| {
            let carried = |&(t, _): &(usize, f32)| {
                let (thing, own) = (&self.solids[t], &self.solids[i]);
                let held = relations::on(thing, own).max(relations::inside(thing, own));
                held.max(0.6 * relations::around(thing, own))
            };
            let others = || things.iter().filter(|(t, _)| *t != i);
            match phrase.count {
                None => others().map(|t| t.1 * carried(t)).fold(0.0, f32::max),
                // An object around the instance counts if it is close.
                Some(count) => {
                    let found: f32 = others()
                        .map(|t| t.1 / best * ((carried(t) - 0.3) / 0.2).clamp(0.0, 1.0))
                        .sum();
                    best.min(1.0) / (1.0 + ((found - count as f32) / 0.6).powi(2))
                }
            }
        };
        instances.map(|i| (i, fit_of(i))).collect()
    }

    fn is_named(&self, index: usize, noun: &str) -> bool {
        let phrase = || Phrase { head: noun.to_owned(), ..Phrase::default() };
        match self.scene.names.get(index) {
            Some(name) => name.fit(&phrase(), &phrase().meaning()) > 0.0,
            None => self.scene.instances[index].names.iter().any(|guess| guess.name == noun),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::direction::DirectionConvention;
    use crate::{NameIndex, SceneView};
    use uniground_geometry::boxes::Aabb;
    use uniground_geometry::color::{ColorHistogram, ColorName};
    use uniground_geometry::scene::{Instance, NameGuess, Support};
    use uniground_geometry::{Point3, Vector3};
    use uniground_models::attributes;
    use uniground_testing::thing;

    /// Returns a desk of 0.6 m by 0.8 m (diagonal 1 m) that is 1 m high.
    fn desk(id: u32, x: f32) -> Instance {
        named("desk", thing(id, [x, 0.0], [0.6, 0.8, 1.0], 0.0, Support::Floor, [90; 3]))
    }

    fn lamp(id: u32, x: f32, base: f32) -> Instance {
        named("lamp", thing(id, [x, 0.0], [0.2, 0.2, 0.4], base, Support::Floor, [90; 3]))
    }

    /// Returns a lamp `gap` meters from the side of a desk at `x`.
    fn lamp_beside(id: u32, x: f32, gap: f32) -> Instance {
        lamp(id, x + 0.3 + 0.1 + gap, 0.0)
    }

    fn named(name: &str, instance: Instance) -> Instance {
        Instance { given_name: Some(name.into()), ..instance }
    }

    fn red(share: f32, instance: Instance) -> Instance {
        let mut shares = [0.0; 12];
        shares[ColorName::Red as usize] = share;
        shares[ColorName::Green as usize] = 1.0 - share;
        Instance { colors: ColorHistogram(shares), ..instance }
    }

    fn with_assessor<T>(instances: &[Instance], of: impl FnOnce(&Assessor) -> T) -> T {
        let names = NameIndex::of(instances);
        let extent = Aabb { center: Point3::origin(), size: Vector3::repeat(20.0) };
        let scene = SceneView { instances, extent, names: &names, appearance: None };
        of(&Assessor::new(scene, DirectionConvention::Viewer.into()))
    }

    fn noun_phrase(head: &str) -> Phrase {
        Phrase { head: head.into(), ..Phrase::default() }
    }

    /// Returns the scores of instances that should carry this object, or lack it.
    fn scores_with(
        instances: &[Instance],
        scores: &[f32],
        phrase: Phrase,
        absent: bool,
    ) -> Vec<f32> {
        let mut scores = scores.to_vec();
        with_assessor(instances, |assessor| {
            assessor.apply_with(&With { phrase, absent }, &mut scores);
        });
        scores
    }

    #[track_caller]
    fn assert_close(found: &[f32], by_hand: &[f32]) {
        let same = found.len() == by_hand.len()
            && found.iter().zip(by_hand).all(|(a, b)| (a - b).abs() < 5e-4);
        assert!(same, "{found:?}, expected {by_hand:?}");
    }

    #[test]
    fn instances_without_the_required_object_keep_ten_percent() {
        let room = [desk(1, 0.0), desk(2, 60.0), lamp(3, 0.0, 1.0)];
        // 0.1 + 0.9 · fit, or 1 + 0.1 less that.
        assert_close(
            &scores_with(&room, &[1.0, 0.5, 0.0], noun_phrase("lamp"), false),
            &[1.0, 0.05, 0.0],
        );
        assert_close(
            &scores_with(&room, &[1.0, 0.5, 0.0], noun_phrase("lamp"), true),
            &[0.1, 0.5, 0.0],
        );
        // A low score is multiplied by the same tenth.
        assert_close(
            &scores_with(&room, &[0.2, 1.0, 0.0], noun_phrase("lamp"), true),
            &[0.02, 1.0, 0.0],
        );
    }

    #[test]
    fn objects_around_an_instance_count_sixty_percent_of_carried_ones() {
        // Around a desk halves at 0.3 m + 0.25 · 1 m = 0.55 m: 0.6 · 0.5; 0.1 + 0.9 · 0.3.
        let room = [desk(1, 0.0), desk(2, 60.0), lamp_beside(3, 0.0, 0.55)];
        assert_close(
            &scores_with(&room, &[1.0, 1.0, 0.0], noun_phrase("lamp"), false),
            &[0.37, 0.1, 0.0],
        );
        assert_close(
            &scores_with(&room, &[1.0, 1.0, 0.0], noun_phrase("lamp"), true),
            &[0.73, 1.0, 0.0],
        );
        // Inside counts as on: a whole lamp in a wardrobe 1 m high.
        let room = [desk(1, 0.0), desk(2, 60.0), lamp(3, 0.0, 0.3)];
        assert_close(
            &scores_with(&room, &[1.0, 1.0, 0.0], noun_phrase("lamp"), false),
            &[1.0, 0.1, 0.0],
        );
    }

    #[test]
    fn object_that_no_instance_carries_counts_as_undetected() {
        // 0.6 · 0.4 = 0.24 is not carried, 0.6 · 0.43333 = 0.26 is: 0.55 m · √1.5 and · √1.30769.
        let scores_with = |gap: f32, absent| {
            let room = [desk(1, 0.0), lamp_beside(2, 0.0, gap)];
            scores_with(&room, &[1.0, 0.0], noun_phrase("lamp"), absent)
        };
        assert_close(&scores_with(0.673_61, false), &[0.6, 0.0]);
        assert_close(&scores_with(0.628_95, false), &[0.334, 0.0]);
        // "Without" ignores the factor for undetected objects: 1.1 - (0.1 + 0.9 · 0.24).
        assert_close(&scores_with(0.673_61, true), &[0.784, 0.0]);
    }

    #[test]
    fn carried_objects_count_by_their_own_fit() {
        // A lamp that is half red: 0.1 + 0.9 · 0.5.
        let room = [desk(1, 0.0), desk(2, 60.0), red(0.3, lamp(3, 0.0, 1.0))];
        let phrase = Phrase { colors: vec![ColorName::Red], ..noun_phrase("lamp") };
        assert_close(&scores_with(&room, &[1.0, 1.0, 0.0], phrase, false), &[0.55, 0.1, 0.0]);
    }

    #[test]
    fn instances_do_not_carry_themselves() {
        let room = [desk(1, 0.0), lamp(2, 0.0, 1.0), lamp(3, 9.0, 0.0)];
        assert_close(
            &scores_with(&room, &[0.0, 1.0, 1.0], noun_phrase("lamp"), false),
            &[0.0, 0.6, 0.6],
        );
    }

    #[test]
    fn count_mismatch_lowers_the_score() {
        let lamps = |count: Option<u32>| Phrase { count, ..noun_phrase("lamp") };
        let two = [desk(1, 0.0), lamp(2, -0.15, 1.0), lamp(3, 0.15, 1.0), desk(4, 9.0)];
        let one = [desk(1, 0.0), lamp(2, -0.15, 1.0), desk(3, 9.0)];
        // The exact count scores 1. One off: 1 / (1 + (1 / 0.6)²) = 0.264706; 0.1 + 0.9 of it.
        assert_close(&scores_with(&two, &[1.0, 0.0, 0.0, 0.0], lamps(Some(2)), false)[..1], &[1.0]);
        assert_close(
            &scores_with(&one, &[1.0, 0.0, 0.0], lamps(Some(2)), false)[..1],
            &[0.338_235],
        );
        assert_close(
            &scores_with(&two, &[1.0, 0.0, 0.0, 0.0], lamps(Some(1)), false)[..1],
            &[0.338_235],
        );
        assert_close(&scores_with(&one, &[1.0, 0.0, 0.0], lamps(Some(1)), false)[..1], &[1.0]);
        // Both are half red: each fits as well as the best one, which fits by a half.
        let two = two.map(|thing| red(0.3, thing));
        let red_ones = Phrase { colors: vec![ColorName::Red], ..lamps(Some(2)) };
        assert_close(&scores_with(&two, &[1.0, 0.0, 0.0, 0.0], red_ones, false)[..1], &[0.55]);
    }

    #[test]
    fn counts_include_objects_close_around_the_instance() {
        let count = Phrase { count: Some(1), ..noun_phrase("lamp") };
        let scores_with = |gap: f32| {
            let room = [desk(1, 0.0), lamp_beside(2, 0.0, gap)];
            scores_with(&room, &[1.0, 0.0], count.clone(), false)[0]
        };
        // Carried by 0.4: (0.4 - 0.3) / 0.2 = 0.5 of one. 0.6 / (1 + (gap / 0.55)²) is 0.4 at
        // 0.55 m · √0.5; 1 / (1 + (0.5 / 0.6)²) = 0.590164, and 0.1 + 0.9 of it.
        assert_close(&[scores_with(0.388_91)], &[0.631_148]);
        // From 0.5 on it counts as one: √0.2 · 0.55 m.
        assert_close(&[scores_with(0.245_97)], &[1.0]);
        assert_close(&[scores_with(0.05)], &[1.0]);
        // Below 0.3 it counts as none: one off, 0.338235.
        assert_close(&[scores_with(0.6)], &[0.338_235]);
    }

    #[test]
    fn undetected_objects_keep_sixty_percent_and_unknown_words_are_ignored() {
        let room = [desk(1, 0.0), lamp(2, 0.0, 1.0)];
        assert_close(&scores_with(&room, &[1.0, 0.5], noun_phrase("piano"), false), &[0.6, 0.3]);
        assert_close(&scores_with(&room, &[1.0, 0.5], noun_phrase("piano"), true), &[1.0, 0.5]);
        assert_close(&scores_with(&room, &[1.0, 0.5], noun_phrase("zorblax"), false), &[1.0, 0.5]);
    }

    #[test]
    fn part_color_is_checked_on_the_whole_instance() {
        let room = [red(1.0, desk(1, 0.0)), red(0.3, desk(2, 3.0)), red(0.0, desk(3, 6.0))];
        let seat = |head: &str| Phrase { colors: vec![ColorName::Red], ..noun_phrase(head) };
        // Parts are small: a part whose color was not measured keeps a quarter.
        for head in ["seat", "seats"] {
            assert_close(
                &scores_with(&room, &[1.0, 0.8, 1.0], seat(head), false),
                &[1.0, 0.4, 0.25],
            );
        }
        assert_close(&scores_with(&room, &[1.0, 0.8, 1.0], seat("seat"), true), &[1.0, 0.8, 1.0]);
        assert_close(
            &scores_with(&room, &[1.0, 0.0, 1.0], noun_phrase("seat"), false),
            &[1.0, 0.0, 1.0],
        );
    }

    #[test]
    fn unusual_part_keeps_forty_percent() {
        let room = [desk(1, 0.0), lamp(2, 5.0, 0.0)];
        assert_close(&scores_with(&room, &[1.0, 1.0], noun_phrase("drawer"), false), &[1.0, 0.4]);
        // "Without drawers" lowers instances known to have drawers, and no others.
        assert_close(&scores_with(&room, &[1.0, 1.0], noun_phrase("drawer"), true), &[0.4, 1.0]);
        // Any object can have a frame.
        assert_close(&scores_with(&room, &[1.0, 1.0], noun_phrase("frame"), false), &[1.0, 1.0]);
        assert_close(&scores_with(&room, &[1.0, 1.0], noun_phrase("frame"), true), &[1.0, 1.0]);
        let red_drawer = Phrase { colors: vec![ColorName::Red], ..noun_phrase("drawers") };
        let room = [red(0.3, desk(1, 0.0)), red(0.3, lamp(2, 5.0, 0.0))];
        assert_close(&scores_with(&room, &[1.0, 1.0], red_drawer, false), &[0.5, 0.2]);
    }

    #[test]
    fn guessed_names_are_used_where_no_name_is_given() {
        let guess = |name: &str| vec![NameGuess { name: name.into(), score: 0.5 }];
        let plain = |id, name| Instance { given_name: None, names: guess(name), ..desk(id, 0.0) };
        let room = [plain(1, "desk"), plain(2, "sofa")];
        with_assessor(&room, |assessor| {
            assert!(assessor.is_named(0, "desk") && !assessor.is_named(1, "desk"));
        });
        let room = [named("sofa", plain(1, "desk")), desk(2, 5.0)];
        with_assessor(&room, |assessor| {
            assert!(!assessor.is_named(0, "desk"), "the given name takes precedence");
            assert!(assessor.is_named(1, "desk") && !assessor.is_named(1, "sofa"));
        });
    }

    #[test]
    fn nouns_in_the_parts_table_are_in_the_lexicon() {
        for noun in PARTS.iter().flat_map(|(_, of)| *of) {
            assert!(
                attributes::Lexicon::get().nouns().iter().any(|known| known.name == *noun),
                "{noun}"
            );
        }
    }
}
